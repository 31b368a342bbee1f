"""What rays meet, with the derivatives of its shading normal."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .grids import voxel_of
from .meshes import has_interpolated_normals, has_texcoords, is_flipped, objects_below

#: How far on both sides of a point of a grid its normals are compared: in voxels.
NEXT = 0.01

#: Cosine between the normals of what two rays close by meet, from which on that is one surface, and not something that
#: stands on it.
GOES_ON = 0.5


class Surfaces:
    """The surfaces of a scene.

    Mitsuba 3.9 differentiates the normals of all shapes with respect to the texture coordinates, but interpolated
    normals of meshes with respect to barycentric coordinates, and before `flip_normals` turns them round; and those of
    grids not at all.
    """

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        meshes = [o for o in objects_below(scene).values() if isinstance(o, mi.Mesh) and has_interpolated_normals(o)]
        self._any_other = any(has_texcoords(m) or is_flipped(m) for m in meshes)
        #: Grids, and how far on both sides of a point their normals are compared.
        self._grids = [(s, NEXT * voxel_of(s)) for s in scene.shapes() if s.class_name() == "SDFGrid"]

    def met(self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """What a ray meets; dn_du and dn_dv are derivatives with respect to the texture coordinates."""
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
        for grid, step in self._grids:
            self._differentiate(grid, step, si, ray, pi, active)
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

    @staticmethod
    def _differentiate(grid: mi.Shape, step: float, si, ray: mi.Ray3f, pi, active: mi.Bool) -> None:
        """Give what is met on a grid two vectors that are tangent to it, and the differences of normals along them."""
        on_grid = active & pi.is_valid() & (si.shape == mi.ShapePtr(grid))
        found, here = [], mi.Vector3f(si.sh_frame.n)
        for along in mi.coordinate_system(si.n):
            changes = []
            for sign in (-1, 1):
                beside = mi.Ray3f(ray)
                beside.o = ray.o + sign * step * along
                n = pi.compute_surface_interaction(beside, mi.RayFlags.All, on_grid).sh_frame.n
                changes.append((mi.Vector3f(n) - here) * (sign / step))
            # Where a crease is between, it is no derivative: on the other side of the point, there is none.
            back, forth = changes
            less = dr.squared_norm(back) < dr.squared_norm(forth)
            found.append((mi.Vector3f(along), dr.select(less, back, forth)))
        (u, of_u), (v, of_v) = found
        si.dp_du, si.dp_dv = dr.select(on_grid, u, si.dp_du), dr.select(on_grid, v, si.dp_dv)
        si.dn_du, si.dn_dv = dr.select(on_grid, of_u, si.dn_du), dr.select(on_grid, of_v, si.dn_dv)


def components(vector: mi.Vector3f, a: mi.Vector3f, b: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Coefficients of a and b in the part of a vector that lies in their plane; 0 if they are parallel."""
    aa, bb, ab = dr.squared_norm(a), dr.squared_norm(b), dr.dot(a, b)
    along_a, along_b, det = dr.dot(vector, a), dr.dot(vector, b), aa * bb - ab * ab
    scale = dr.select(det > 0, dr.rcp(det), 0)
    return scale * (bb * along_a - ab * along_b), scale * (aa * along_b - ab * along_a)
