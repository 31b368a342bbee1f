"""The one object that traces paths: for the interior term, and for the sides of boundaries."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.horizon import Horizon, turn_to_side
from rimlight.edge_sampling.boundaries.tracer import ShadingPoint
from rimlight.edge_sampling.parametrisation import material_point, seen_by_camera

from .paths import Depths, Replay, Vertex, choose_vertex, scattered_light
from .scattering import Scattering


@dataclass
class Radiance:
    """Light along camera rays.

    L : mi.Spectrum, (N,); where wanted, attached to the first vertex of its path.
    valid : mi.Bool, (N,); does the ray meet a surface, or a visible environment? The alpha channel.
    rest : None, or what differentiates the rest of the path.
    """

    L: mi.Spectrum
    valid: mi.Bool
    rest: Replay | None = None


class PathTracer:
    """Traces the paths of an integrator in a scene. Call it with gradients suspended: it resumes them where they
    belong.

    integrator : tells `depths` and `hide_emitters`.
    """

    def __init__(self, scene: mi.Scene, integrator: mi.ad.common.ADIntegrator):
        self.scene = scene
        self.depths: Depths = integrator.depths
        self.hide_emitters: bool = integrator.hide_emitters
        self._skip_area_emitters = integrator.skip_area_emitters

    def scatters(self, depth: mi.UInt32 | int) -> mi.Bool | bool:
        """May a vertex of this number reflect direct light?"""
        return self.depths.scatters(depth)

    # ---------------------- From the camera ----------------------

    def radiance(
        self,
        ray: mi.Ray3f,
        sampler: mi.Sampler,
        active: mi.Bool,
        *,
        attached: bool,
        horizon: Horizon | None = None,
    ) -> Radiance:
        """Estimate the radiance along camera rays.

        horizon : on which side of the horizon of interpolated normals the first hit is; None: as it is.
        """
        scene = self.scene
        active = active & (self.depths.max_depth > 0)
        L = mi.Spectrum(0)

        # ---------------------- First hit ----------------------

        pi = self.first_hit(ray, active)
        si = seen_by_camera(ray, pi, active, attached=attached)
        if horizon is not None:
            turn_to_side(si, ray, horizon)
        with dr.resume_grad(when=attached):
            if not self.hide_emitters:
                L += si.emitter(scene).eval(si, active)
        bsdf = si.bsdf(ray)
        backdrop = active & (scene.environment() is not None and not self.hide_emitters)
        active &= si.is_valid()
        scattering = Scattering(scene, attached=attached)
        if not self.scatters(1):
            return Radiance(L, backdrop | scattering.stops(ray, pi, sampler, active))

        # ---------------------- Light that it scatters ----------------------

        direct, onwards = scattering.scatter(si, bsdf, sampler, active)
        with dr.resume_grad(when=attached):
            L += direct
        valid = backdrop | (active & ~onwards.through)
        if not self.scatters(2):
            return Radiance(L, valid | scattering.stops(onwards.ray, onwards.pi, sampler, active & onwards.through))
        first = _camera_vertex(ray, pi)
        β = dr.select(active, dr.detach(onwards.weight), 0)
        second = Vertex(mi.Ray3f(onwards.ray), onwards.pi, first.depth + 1, β, mi.Float(onwards.η))
        again = sampler.clone() if attached else None
        indirect, stopped = scattered_light(scene, sampler, second, self.depths, active)
        valid |= onwards.through & stopped
        with dr.resume_grad(when=attached):
            L += dr.select(β != 0, indirect * onwards.weight / β, 0)
        rest = Replay(scene, again, first, second, self.depths, active, si.p, indirect) if attached else None
        return Radiance(L, valid, rest)

    def first_hit(self, ray: mi.Ray3f, active: mi.Bool | bool) -> mi.PreliminaryIntersection3f:
        """What camera rays meet."""
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if self.hide_emitters:
            skip = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (an array of pointers)
            onwards = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, skip).spawn_ray(ray.d)
            pi[skip] = self._skip_area_emitters(self.scene, onwards, True, skip)
        return pi

    def seen(
        self, ray: mi.Ray3f, sampler: mi.Sampler, active: mi.Bool, horizon: Horizon | None
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Radiance and alpha along camera rays, detached."""
        found = self.radiance(ray, sampler, active, attached=False, horizon=horizon)
        return found.L, dr.select(found.valid, mi.Float(1), 0)

    # ---------------------- From points of a path ----------------------

    def point(self, ray: mi.Ray3f, sampler: mi.Sampler) -> ShadingPoint:
        """One vertex of each path at which light is scattered."""
        pi = self.first_hit(ray, True)
        vertex, chosen = _camera_vertex(ray, pi), pi.is_valid()
        if self.scatters(2):
            vertex, chosen = choose_vertex(self.scene, sampler, vertex, self.depths, chosen)
        at_first = vertex.depth == 1
        with dr.resume_grad():
            si = seen_by_camera(ray, pi, at_first, attached=True)
            if self.scatters(2):
                si = dr.select(at_first, si, material_point(vertex.ray, vertex.pi, chosen, mi.RayFlags.All))
        return ShadingPoint(si, vertex.depth, vertex.β, chosen)

    def scattered(self, ray, pi, depth, sampler, active) -> mi.Spectrum:
        """Light that is scattered, by what a ray from a vertex meets, back to this vertex of number `depth`. Detached.

        ray, pi : the ray and what it meets. sampler : for the paths beyond. active : mi.Bool, (N,)
        """
        beyond = Vertex(mi.Ray3f(ray), pi, depth + 1, dr.full(mi.Spectrum, 1, dr.width(active)), mi.Float(1))
        return scattered_light(self.scene, sampler, beyond, self.depths, active)[0]


def _camera_vertex(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> Vertex:
    one = dr.full(mi.UInt32, 1, dr.width(pi.t))
    return Vertex(dr.detach(mi.Ray3f(ray)), pi, one, dr.full(mi.Spectrum, 1, dr.width(one)), mi.Float(1))
