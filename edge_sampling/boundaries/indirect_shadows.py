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

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import Reservoir
from rimlight.edge_sampling.choice.silhouettes import Placement
from rimlight.edge_sampling.geometry.meshes import is_smooth
from rimlight.edge_sampling.parametrisation import material_point
from rimlight.edge_sampling.rays import spawn_ray_to

from .shadow_boundary import LightPoint, LitEdge, SeenShadow, Shadow, ShadowBoundary, fall, thrown
from .tracer import ShadingPoint, Tracer

#: Shadows in the light of lamps of which one is kept, in proportion to what it contributes if nothing hides it. In that
#: of lights without size, one is taken as it comes: the borders of a shadow mostly contribute with opposite signs, and
#: a stratified choice leaves less of them by chance than a choice by size.
CANDIDATES = 2

#: What the estimated density of edges, as they are found from lamps, is divided by: see `share`.
AROUND = 0.4


def share(
    density: mi.Float, light_pdf: mi.Float, pdf: mi.Float, cos: mi.Float, near: mi.Float, whole: mi.Float
) -> mi.Float:
    """Part of the shadows of lamps that is found from the lamps: the balance heuristic (Veach 1997) for the density of
    the place x of the shadow, by area, and of the point of the edge, by length.

    From the lamp, a point of it is chosen, then an edge, and x is behind that. From the vertex before, x is sampled by
    the BSDF; then an edge in the directions of the lamp, or of the highlight, if that is smaller.

    density : of x by area as it is sampled from the vertex before. light_pdf, pdf : of the direction from x to the
    lamp, among light samples and among those of the BSDF. cos : of the angle between it and the normal at x. near,
    whole : distances of the edge and of the lamp from x.
    """
    # Not below 0 at the own edges of a lamp, whatever rounding does: both ways must find a part from 0 to 1.
    beyond = dr.maximum(whole - near, 0)
    from_lamp = light_pdf * cos * beyond * dr.rsqrt(light_pdf + pdf) / (AROUND * dr.square(whole) * near)
    part = from_lamp / (from_lamp + density)
    return dr.select(dr.isfinite(part) & dr.isfinite(density), part, 0)


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
            light, edge = self._chosen(scene, placement, point, sampler, choice)
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
            near, whole = dr.norm(edge.p - si.p), dr.norm(light.y - si.p)
            ours = partial(share, pdf * cos_over_r2, cos=dr.abs_dot(si.n, edge.ω), near=near, whole=whole)
            ray = mi.RayDifferential3f(shadow.ray)
            ray.wavelengths = z.wavelengths
            weight = f * dr.select(active, cos_over_r2, 0)
            view = SeenShadow(mi.Point2f(0), ray, weight, shadow.fallen, si, None, active)
            met, jump, active = self._arriving(scene, light, edge, shadow, view, ours)

            # ---------------------- The boundary on the surface ----------------------

            tangent, towards_light = (thrown(v, light, edge, shadow) for v in (edge.tangent, edge.lit))
            n_dl = dr.cross(shadow.facing, tangent) * (len(self) / edge.sample.density)
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

    def _chosen(
        self, scene: mi.Scene, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[LightPoint, LitEdge]:
        """Of a few shadows one. The density of its edge is what an unbiased estimate divides by, that of the point on
        the light included."""
        z, active = point.si, mi.Bool(point.active)
        if not self.any_surface:
            light = self._point_on_light(scene, choice * len(self), z.time, sampler.next_2d())
            return light, self._edge(placement, light, sampler)

        def look(k, on_light, reservoir, sampler):
            at = _OnLight((choice + k) * (len(self) / CANDIDATES), sampler.next_2d())
            light = self._point_on_light(scene, at.choice, z.time, at.numbers)
            edge = self._edge(placement, light, sampler)
            target = self._unshadowed(scene, z, light, edge, fall(scene, light, edge), active)
            edge.sample.density *= light.density
            reservoir, taken = reservoir.take(edge.sample, target, sampler, active)
            return k + 1, dr.select(taken, at, on_light), reservoir, sampler

        width = dr.width(active)
        _, at, reservoir, _ = dr.while_loop(
            (dr.zeros(mi.Float, width), dr.zeros(_OnLight, width), dr.zeros(Reservoir, width), sampler),
            lambda k, *_: active & (k < CANDIDATES),
            look,
            label="shadows",
        )
        light = self._point_on_light(scene, at.choice, z.time, at.numbers)
        return light, self._edge_at(placement, light, reservoir.kept(CANDIDATES))

    def _unshadowed(
        self, scene: mi.Scene, z: mi.SurfaceInteraction3f, light: LightPoint, edge: LitEdge, shadow: Shadow, active
    ) -> mi.Float:
        """About what a shadow does to the light of a point, if nothing hides it, and all surfaces are equal."""
        arrives = dr.abs_dot(shadow.facing, edge.ω) * dr.select(light.on_surface, dr.abs_dot(light.n, edge.ω), 1)
        arrives *= dr.rcp(dr.select(light.far, 1, dr.squared_norm(shadow.x - light.y)))
        return self._reflected(z, light, edge, shadow, arrives, active & shadow.active)

    @staticmethod
    def _reflected(
        z: mi.SurfaceInteraction3f, light: LightPoint, edge: LitEdge, shadow: Shadow, arrives: mi.Float, active
    ) -> mi.Float:
        """What a point reflects of it. arrives : at the surface on which the shadow falls."""
        d = shadow.x - z.p
        r2 = dr.squared_norm(d)
        ω = d * dr.rsqrt(r2)
        f = dr.max(z.bsdf().eval(mi.BSDFContext(), z, z.to_local(ω), active))
        along = dr.norm(dr.cross(shadow.facing, thrown(edge.tangent, light, edge, shadow)))
        return dr.select(active, f * dr.abs_dot(shadow.facing, ω) / r2 * along * arrives, 0)


@dataclass
class _OnLight:
    """The random numbers of a point on a light."""

    choice: mi.Float
    numbers: mi.Point2f
