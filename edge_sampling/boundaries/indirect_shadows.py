"""Shadows in indirect light: what edges do by the shadows that they throw on what lights the visible surfaces.

As in `shadow_boundary.py`, a shadow is found from its light: from a point y of the light past an edge to the point x
of a surface. There, the light that x reflects jumps; a vertex z of a path from the camera sees it. With x written over
area, the derivative of what z reflects gains

    ∮ f_z cos θ_z · cos θ_x / |x − z|² · f_x L_y · n · (ẋ_shadow − ẋ) dl,

with the normal n of the curve in the surface, away from the lit side, and the motion ẋ that the interior term has:
x is a material point, or near z that where a fixed direction from z meets the surface. For lights without size, there
is no other way to find these shadows. Those of lamps are found from the points x, too (`shading_boundary.py`), and are
divided between the two: see `share`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.silhouettes import Placement
from rimlight.edge_sampling.geometry.meshes import is_smooth
from rimlight.edge_sampling.parametrisation import material_point
from rimlight.edge_sampling.rays import spawn_ray_to

from .shadow_boundary import SeenShadow, ShadowBoundary, fall, thrown
from .tracer import ShadingPoint, Tracer


def share(point: ShadingPoint, density: mi.Float) -> mi.Float:
    """Part of the shadows of lamps that is found from the lamps, as far as a vertex of a path and the one before are
    concerned: the less, the more likely these two find each other, since they are close, or since one is glossy.

    density : by area, with which one is found from the other by sampling the BSDF.
    """
    return dr.rcp(1 + dr.square(density * dr.square(point.vicinity.radius)))


def is_bent(lamp: mi.Shape) -> bool:
    """Is a lamp shaded with other normals than those of its faces? Then the shadows in its light, where it arrives
    indirectly, are found from points alone."""
    return lamp.is_mesh() and is_smooth(lamp)


class IndirectShadows(ShadowBoundary):
    """Samples the shadows that points of paths see."""

    def counts(self, emitter: mi.Emitter) -> bool:
        on_surface = bool(emitter.flags() & mi.EmitterFlags.Surface)
        return super().counts(emitter) and not (on_surface and is_bent(emitter.get_shape()))

    def at(
        self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> mi.Spectrum:
        """One sample of what each point reflects of shadows: mi.Spectrum, (N,), zero, with its gradient.

        placement : of the shapes, attached. choice : uniform in [0, 1).
        """
        scene, z = tracer.scene, point.si
        with dr.suspend_grad():
            light = self._point_on_light(scene, choice * len(self), z.time, sampler)
            edge = self._edge(placement, light, sampler)
            shadow = fall(scene, light, edge)

            # ---------------------- From the point to the shadow ----------------------

            active = shadow.active & point.active & tracer.scatters(point.depth + 1)
            si = shadow.fallen.compute_surface_interaction(shadow.ray, mi.RayFlags.All, active)
            d = si.p - z.p
            r2 = dr.squared_norm(d)
            active &= r2 > 0
            ω = d * dr.rsqrt(dr.select(active, r2, 1))
            si.wi = si.to_local(-ω)
            si.wavelengths = z.wavelengths
            f, pdf = z.bsdf().eval_pdf(mi.BSDFContext(), z, z.to_local(ω), active)
            active &= dr.any(f != 0)
            active &= ~scene.ray_test(spawn_ray_to(scene, z, si.p), active)
            cos_over_r2 = dr.abs_dot(si.n, ω) / r2
            ours = dr.select(light.on_surface, share(point, pdf * cos_over_r2), 1)
            ray = mi.RayDifferential3f(shadow.ray)
            ray.wavelengths = z.wavelengths
            weight = f * dr.select(active, cos_over_r2 * ours, 0)
            view = SeenShadow(mi.Point2f(0), ray, weight, shadow.fallen, si, None, active)
            met, jump, active = self._arriving(scene, light, edge, shadow, view, share=True)

            # ---------------------- The boundary on the surface ----------------------

            tangent, towards_light = (thrown(v, light, edge, shadow) for v in (edge.tangent, edge.lit))
            n_dl = dr.cross(shadow.facing, tangent) * (len(self) / (edge.sample.density * light.density))
            n_dl = dr.mulsign(n_dl, -dr.dot(n_dl, towards_light))
            active &= dr.isfinite(dr.squared_norm(n_dl)) & dr.any(jump != 0)
            n_dl = dr.select(active, n_dl, 0)
            far, n = point.vicinity.around(z.bsdf()).far(r2), si.n

        with dr.resume_grad():
            m = material_point(shadow.ray, shadow.fallen, active).p
            x = self._moving(scene, placement, light, edge, shadow, m, met, active)
            slid = z.p + ω * (dr.dot(m - z.p, n) / dr.select(active, dr.dot(ω, n), 1))
            held = dr.lerp(slid, m, far)
            moved = (x - dr.detach(x)) - (held - dr.detach(held))
            return jump * dr.dot(n_dl, dr.select(active, moved, 0))
