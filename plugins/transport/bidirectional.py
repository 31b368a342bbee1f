"""Camera paths that are connected with light subpaths, and the images of both."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.rays import spawn_ray, spawn_ray_to, spawn_ray_to_light

from .emission import Emission
from .film_views import FilmViews
from .found_light import LightEnd, OnePath, Total, Way
from .light_subpaths import LightVertex, Ways, camera_towards, light_towards, looking, smooth
from .paths import Depths, Vertex
from .scattering import Scattering
from .subpath_weights import Shorter, weight
from .vertex_table import VertexTable

#: What becomes of the light of camera paths.
Light = TypeVar("Light", Total, OnePath)


class CameraPaths:
    """Camera paths, each of which shares the vertex of one light subpath with few others.

    hide_emitters : are emitters invisible for the sensor? ways : which ways to make paths count.
    """

    def __init__(self, scene: mi.Scene, emission: Emission, depths: Depths, ways: Ways, *, hide_emitters: bool):
        self.scene, self.emission, self.depths, self.ways = scene, emission, depths, ways
        self.hide_emitters = hide_emitters
        self.stops = Scattering(scene, attached=False).stops

    def from_camera(
        self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, u: mi.Point2f, views: FilmViews
    ) -> tuple[Vertex, Shorter]:
        """The first vertex of paths, and how else it might have been found. pi : what camera rays meet. u : their
        positions on the film, pixels."""
        # Behind hidden emitters, pi.t is not the distance from the sensor.
        seen = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, pi.is_valid())
        arrival = views.arrival(ray, seen.p, u) * dr.square(pi.t)
        first = pi.is_valid() & (arrival > 0)
        n = dr.width(u)
        shorter = Shorter(dr.select(first, views.per_path / arrival, 0), dr.zeros(mi.Float, n))
        one, no = dr.full(mi.UInt32, 1, n), mi.Bool(False)
        return Vertex(ray, pi, one, dr.full(mi.Spectrum, 1, n), mi.Float(1), no, no), shorter

    def trace(
        self,
        first: Vertex,
        shorter: Shorter | None,
        sampler: mi.Sampler,
        light: LightVertex,
        got: Light,
        active: mi.Bool,
        *,
        table: VertexTable | None = None,
        turn: Callable[[mi.SurfaceInteraction3f, mi.Ray3f, mi.Bool], None] | None = None,
        shines: bool = True,
    ) -> tuple[Light, mi.Bool]:
        """Light that arrives by way of a vertex, without its β, but for what the sensor sees of light subpaths; and do
        paths meet, there or farther on, a surface that they do not go through?

        shorter : how else the vertex might have been found; None: there is no other way.
        light : one vertex of each light subpath.
        got : what becomes of the light. table : for all vertices.
        turn : changes the surface at the vertex. shines : does what that emits count?
        """
        scene, depths = self.scene, self.depths
        n, start = dr.width(first.depth), mi.UInt32(first.depth)
        if shorter is None:
            shorter = Shorter(dr.zeros(mi.Float, n), dr.zeros(mi.Float, n))

        def bounce(got, valid, ray, pi, β, η, shorter, number, before, active, sampler):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            if turn is not None:
                turn(si, ray, active & (number == start))
            end = LightEnd(dr.select(si.is_valid(), si.p, mi.Point3f(ray.d)), si.emitter(scene))
            shining = active if shines else active & (number > start)
            L = β * self._emitted(si, before, shorter, number, shining)
            got = got.add(L, Way(number - 1, mi.Bool(False), mi.Bool(False), end), sampler, active)
            cosine = dr.abs_dot(si.n, ray.d)
            active &= si.is_valid()
            met = mi.Bool(active)
            valid |= self.stops(ray, pi, sampler, active & ~depths.scatters(number))
            active &= depths.scatters(number) & (cosine > 0)
            shorter = shorter.at(pi.t, cosine)
            bsdf = si.bsdf(ray)
            connects = active & smooth(bsdf)
            if self.emission.any:
                L, end = self._from_lights(si, bsdf, shorter, number, sampler, connects)
                got = got.add(β * L, Way(number, mi.Bool(True), mi.Bool(False), end), sampler, connects)
            if depths.scatters(2):
                L = self._connected(si, bsdf, shorter, number, light, connects)
                got = got.add(β * L, Way(number, mi.Bool(False), mi.Bool(True), end), sampler, connects)
            before = mi.Point3f(si.p)
            numbers = sampler.next_1d(active), sampler.next_2d(active)
            ray, scattered, ratio, shorter, through, mirrors = self._onwards(si, bsdf, shorter, numbers, active)
            if table is not None:
                table.note(number, si.p, pi, mirrors, numbers[0], met)
            valid |= active & ~through
            β *= scattered
            η *= ratio
            number += 1
            p = dr.minimum(dr.max(β) * dr.square(η), 0.95)
            ends = number > depths.rr_depth
            active &= dr.any(β != 0) & (~ends | (sampler.next_1d(active) < p))
            β = dr.select(ends, β / p, β)
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            return got, valid, ray, pi, β, η, shorter, number, before, active, sampler

        ray, β, no = mi.Ray3f(first.ray), dr.full(mi.Spectrum, 1, n), dr.full(mi.Bool, False, n)
        state = (got, no, ray, first.pi, β, dr.ones(mi.Float, n), shorter, mi.UInt32(start), mi.Point3f(ray.o))
        state += (no | (active & (depths.max_depth > 0)), sampler)
        return dr.while_loop(state, lambda *s: s[-2], bounce, label="camera paths")[:2]

    def _emitted(self, si, before, shorter: Shorter, number, active) -> mi.Spectrum:
        """What the vertex itself emits, weighted. shorter : before it is known where the vertex is."""
        emitter = si.emitter(self.scene)
        active = active & (emitter != None) & self.ways.counts(0, number + 1)  # noqa: E711
        if self.hide_emitters:
            active &= number > 1
        at = dr.zeros(mi.Interaction3f, dr.width(si.p))
        at.p, at.time = before, si.time
        ds = mi.DirectionSample3f(self.scene, si, at)
        reachable = active & (number > 1)
        pdf, arrival = self.emission.met(at, ds, reachable)
        w = weight(pdf * shorter.one, arrival * shorter.more)
        return emitter.eval(si, active) * dr.select(reachable, w, 1)

    def _from_lights(self, si, bsdf, shorter: Shorter, number, sampler, active) -> tuple[mi.Spectrum, LightEnd]:
        """What the vertex reflects of a light sample, weighted, and where on the light that is."""
        light = self.emission.sample(si, sampler.next_2d(active), active)
        active = active & (light.pdf > 0) & self.ways.counts(1, number + 1)
        here = camera_towards(si, bsdf, shorter, light.ds.d, active)
        met = dr.select(light.ds.delta, 0, here.pdf / light.pdf)
        w = weight(met, light.arrival / light.pdf * dr.abs_dot(si.n, light.ds.d) * here.shorter)
        L = here.f * light.weight * w
        active &= dr.any(L != 0)
        active &= ~self.scene.ray_test(spawn_ray_to_light(self.scene, si, light.ds), active)
        infinite = mi.has_flag(light.ds.emitter.flags(), mi.EmitterFlags.Infinite)
        end = LightEnd(dr.select(infinite, mi.Point3f(light.ds.d), light.ds.p), light.ds.emitter)
        return dr.select(active, L, 0), end

    def _connected(self, si, bsdf, shorter: Shorter, number, light: LightVertex, active) -> mi.Spectrum:
        """What the vertex reflects of what that of its light subpath sends there, weighted."""
        subpath = dr.arange(mi.UInt32, dr.width(number)) % dr.width(light.number)
        vertex = dr.gather(LightVertex, light, subpath, active)
        active = active & (vertex.number > 0) & self.depths.scatters(number + vertex.number)
        active &= self.ways.counts(vertex.number + 1, number + 1)
        ray = vertex.ray
        y = vertex.pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        d = y.p - si.p
        r2 = dr.squared_norm(d)
        active &= r2 > 0
        d = d * dr.rsqrt(r2)
        there = light_towards(y, y.bsdf(ray), vertex.shorter, -d, active)
        here = camera_towards(si, bsdf, shorter, d, active)
        w = weight(
            here.pdf * dr.abs_dot(y.n, d) / r2 * there.shorter,
            there.pdf * dr.abs_dot(si.n, d) / r2 * here.shorter,
        )
        L = here.f * there.f * vertex.β * (w / r2)
        active &= dr.any(L != 0)
        active &= ~self.scene.ray_test(spawn_ray_to(self.scene, si, y.p), active)
        return dr.select(active, L, 0)

    def _onwards(self, si, bsdf, shorter: Shorter, numbers, active):
        """The next ray, what is scattered from there over its density, the relative index of refraction, the weights
        there, and does the ray go on as if nothing was there, or as a perfect mirror has it?"""
        bs, scattered = bsdf.sample(mi.BSDFContext(), si, *numbers, active)
        through, mirrored = (mi.has_flag(bs.sampled_type, f) for f in (mi.BSDFFlags.Null, mi.BSDFFlags.Delta))
        d = si.to_world(bs.wo)
        importance = mi.BSDFContext(mi.TransportMode.Importance)
        back = bsdf.pdf(importance, looking(si, bs.wo), si.wi, active & ~mirrored)
        active = active & (bs.pdf > 0)
        shorter = shorter.beyond(dr.abs_dot(si.n, d), bs.pdf, back, mirrored)
        return (
            spawn_ray(self.scene, si, d, through),
            dr.select(active, scattered, 0),
            bs.eta,
            shorter,
            through,
            mirrored,
        )
