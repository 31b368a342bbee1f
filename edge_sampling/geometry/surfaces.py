"""What rays meet, with the derivatives of its shading normal."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .meshes import has_interpolated_normals, has_texcoords, is_flipped, objects_below


class Surfaces:
    """The surfaces of a scene.

    Mitsuba 3.9 differentiates the normals of all shapes with respect to the texture coordinates, but interpolated
    normals of meshes with respect to barycentric coordinates, and before `flip_normals` turns them round.
    """

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        meshes = [o for o in objects_below(scene).values() if isinstance(o, mi.Mesh) and has_interpolated_normals(o)]
        self._any_other = any(has_texcoords(m) or is_flipped(m) for m in meshes)

    def met(self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """What a ray meets; dn_du and dn_dv are derivatives with respect to the texture coordinates."""
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
        if not self._any_other:
            return si
        on_mesh = active & pi.is_valid() & si.shape.is_mesh()
        sides = []
        for step in (mi.Vector2f(1, 0), mi.Vector2f(0, 1)):
            beyond = mi.PreliminaryIntersection3f(pi)
            beyond.prim_uv = pi.prim_uv + step  # outside of the triangle, in its plane
            sides.append(beyond.compute_surface_interaction(ray, mi.RayFlags.Minimal, on_mesh).p - si.p)
        turned = dr.sign(dr.dot(dr.cross(*sides), si.n))
        du, dv = (
            turned * (a * si.dn_du + b * si.dn_dv) for a, b in (components(v, *sides) for v in (si.dp_du, si.dp_dv))
        )
        si.dn_du, si.dn_dv = dr.select(on_mesh, du, si.dn_du), dr.select(on_mesh, dv, si.dn_dv)
        return si


def components(vector: mi.Vector3f, a: mi.Vector3f, b: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Coefficients of a and b in the part of a vector that lies in their plane; 0 if they are parallel."""
    aa, bb, ab = dr.squared_norm(a), dr.squared_norm(b), dr.dot(a, b)
    along_a, along_b, det = dr.dot(vector, a), dr.dot(vector, b), aa * bb - ab * ab
    scale = dr.select(det > 0, dr.rcp(det), 0)
    return scale * (bb * along_a - ab * along_b), scale * (aa * along_b - ab * along_a)
