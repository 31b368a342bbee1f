"""Subpaths that start on lights: each vertex is connected with the sensor, and one is kept for camera paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.rays import spawn_ray, spawn_ray_to

from .emission import Emission
from .film_views import FilmViews
from .found_light import LightEnd, Seen
from .paths import Depths
from .subpath_weights import Shorter, weight
from .vertex_table import VertexTable


class Film(Protocol):
    """Takes what the sensor sees of light subpaths."""

    def nothing(self, count: int) -> Any:
        """What is known before any light is seen, of so many subpaths: a PyTree."""

    def add(self, known: Any, seen: Seen, L: mi.Spectrum, sampler: mi.Sampler, active: mi.Bool) -> Any:
        """What is known then. L : mi.Spectrum, (N,), so that the mean over all samples of the film is the radiance."""


@dataclass
class LightVertex:
    """A vertex of a light subpath. (A Dr.Jit structure: not frozen.)

    o, d, pi : the ray to it, and what that meets.
    β : power that arrives there, over its density and over the cosine under which it does.
    one, more : how the subpath might have been made otherwise, see `Shorter`.
    number : along the subpath, 1 is the first that the light meets; 0: there is none.
    """

    o: mi.Point3f
    d: mi.Vector3f
    pi: mi.PreliminaryIntersection3f
    β: mi.Spectrum
    one: mi.Float
    more: mi.Float
    number: mi.UInt32

    @property
    def shorter(self) -> Shorter:
        return Shorter(self.one, self.more)

    @property
    def ray(self) -> mi.Ray3f:
        return mi.Ray3f(self.o, self.d)


@dataclass
class Towards:
    """A vertex as it is connected with another one. (A Dr.Jit structure: not frozen.)

    f : what a light vertex sends there, by area across the connection, of a power of `LightVertex.β`; or what a camera
        vertex reflects of the light from there.
    pdf : density with which the subpath of the vertex would have gone there.
    shorter : `Shorter.shorter`.
    """

    f: mi.Spectrum
    pdf: mi.Float
    shorter: mi.Float


def looking(si: mi.SurfaceInteraction3f, towards: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """The same point, as it is met by a ray from a direction in local coordinates."""
    turned = mi.SurfaceInteraction3f(si)
    turned.wi = towards
    return turned


def light_towards(si, bsdf, shorter: Shorter, d: mi.Vector3f, active: mi.Bool) -> Towards:
    """A light vertex, towards d in world space. f has the cosine of d.

    What is sent is found as `path` would, by a ray from there: so all BSDFs and shading normals look the same from both
    ends, be they symmetric or not.
    """
    wo = si.to_local(d)
    f, back = bsdf.eval_pdf(mi.BSDFContext(), looking(si, wo), si.wi, active)
    pdf = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Importance), si, wo, active)
    return Towards(f * dr.abs_dot(si.n, d), pdf, shorter.shorter(back))


def camera_towards(si, bsdf, shorter: Shorter, d: mi.Vector3f, active: mi.Bool) -> Towards:
    """A vertex of a camera path, towards d in world space."""
    wo = si.to_local(d)
    f, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    back = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Importance), looking(si, wo), si.wi, active)
    return Towards(f, pdf, shorter.shorter(back))


@dataclass(frozen=True)
class Ways:
    """Which ways to make paths count: those of s vertices from the light and t from the camera, or if there are no such
    numbers, all."""

    s: mi.UInt32 | None = None
    t: mi.UInt32 | None = None

    @staticmethod
    def of(s: int | None, t: int | None) -> Ways:
        """Opaque numbers: all ways share their kernels."""
        return Ways(*(None if n is None else dr.opaque(mi.UInt32, n) for n in (s, t)))

    def counts(self, s: mi.UInt32 | int, t: mi.UInt32 | int) -> mi.Bool:
        return mi.Bool(self.s is None or s == self.s) & (self.t is None or t == self.t)


def smooth(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Can a vertex be connected?"""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


class LightSubpaths:
    """Light subpaths. Each keeps one of its vertices for camera paths, by chance and in proportion to its throughput (a
    reservoir of one), which stands for the others: so memory does not grow with their length.

    hide_emitters : are emitters with an area invisible for the sensor?
    ways : which ways to make paths count.
    """

    def __init__(self, scene: mi.Scene, emission: Emission, depths: Depths, ways: Ways, *, hide_emitters: bool):
        self.scene, self.emission, self.depths, self.ways = scene, emission, depths, ways
        self.hides = hide_emitters and emission.any_area

    def trace(
        self,
        sampler: mi.Sampler,
        count: int,
        time: mi.Float,
        views: FilmViews,
        film: Film,
        table: VertexTable | None = None,
    ) -> tuple[LightVertex, LightEnd | None, Any]:
        """Trace them, and hand what the sensor sees of each vertex to `film`. table : for all vertices.

        Returns
        -------
        One vertex of each subpath; where it starts, None if there is no light; and what `film` knows at last.
        """
        kept, known = dr.zeros(LightVertex, count), film.nothing(count)
        if not self.emission.any or not self.depths.scatters(1):
            return kept, None, known
        lane = dr.arange(mi.UInt32, count)
        active = dr.full(mi.Bool, True, count)
        ray, pi, β, shorter, end = self.emission.start(sampler, time, active)
        start = dr.max(β)

        def bounce(known, ray, pi, β, shorter, number, total, w_kept, active, sampler):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            bsdf, met = si.bsdf(ray), mi.Bool(active)
            cosine = dr.abs_dot(si.n, ray.d)
            active &= cosine > 0
            shorter = shorter.at(pi.t, cosine)
            vertex = LightVertex(ray.o, ray.d, pi, β / cosine, shorter.one, shorter.more, number)
            connects = active & smooth(bsdf)
            if views.projects:
                known = self._to_sensor(si, bsdf, vertex, sampler, views, film, known, connects)
            if self.depths.scatters(2):
                # A camera path has a vertex of its own at least.
                w = dr.select(connects & self.depths.scatters(number + 1), dr.max(β), 0)
                total += w
                taken = sampler.next_1d(active) * total < w
                w_kept = dr.select(taken, w, w_kept)
                dr.scatter(kept, vertex, lane, taken)
            numbers = sampler.next_1d(active), sampler.next_2d(active)
            ray, β, shorter, mirrors, active = self._onwards(
                si, bsdf, ray, β, shorter, start, number, numbers, sampler, active
            )
            if table is not None:
                table.note(number, si.p, pi, mirrors, numbers[0], met)
            pi = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            return known, ray, pi, β, shorter, number + 1, total, w_kept, active & pi.is_valid(), sampler

        one, zero = dr.full(mi.UInt32, 1, count), dr.zeros(mi.Float, count)
        active &= pi.is_valid() & (start > 0)
        state = (known, ray, pi, β, shorter, one, zero, mi.Float(zero), active, sampler)
        known, *_, total, w_kept, _, _ = dr.while_loop(state, lambda *s: s[-2], bounce, label="light subpaths")
        dr.eval(kept, total, w_kept, known, end if table is not None else None)
        kept.β *= dr.select(w_kept > 0, total / w_kept, 0)
        return kept, end, known

    def _onwards(self, si, bsdf, ray, β, shorter, start, number, numbers, sampler, active):
        """The next ray, what it carries, and was it sampled from a perfect mirror?"""
        bs, at_mirror = bsdf.sample(mi.BSDFContext(mi.TransportMode.Importance), si, *numbers, active)
        mirrored = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        d = si.to_world(bs.wo)
        cosine, before = dr.abs_dot(si.n, d), dr.abs_dot(si.n, ray.d)
        f, back = bsdf.eval_pdf(mi.BSDFContext(), looking(si, bs.wo), si.wi, active & ~mirrored)
        # A mirror, and the glass that refracts, stands across wi + η wo, whatever its shading normal is. Light spreads
        # with the cosines to that, and surfaces receive it with those to their own normals (Veach 1997, section 5.3).
        across = si.wi + bs.wo * bs.eta
        turned = dr.abs(dr.dot(across, si.wi)) / dr.abs(dr.dot(across, bs.wo))
        refracts = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission) & (bs.eta != 1)
        at_mirror *= dr.select(refracts & dr.isfinite(turned), turned, 1)
        scattered = dr.select(mirrored, at_mirror, f / bs.pdf) * (cosine / before)
        active = active & (bs.pdf > 0) & (cosine > 0) & dr.any(at_mirror != 0)
        shorter = shorter.beyond(cosine, bs.pdf, back, mirrored)
        β = β * dr.select(active, scattered, 0)
        # The end of a path by chance: of what the light has sent, how much is left?
        p = dr.minimum(dr.max(β) / start, 0.95)
        # The sensor is one more segment, as from a camera path that has this many vertices.
        ends = number + 1 >= self.depths.rr_depth
        active &= dr.any(β != 0) & self.depths.scatters(number + 1) & (~ends | (sampler.next_1d(active) < p))
        β = dr.select(ends, β / p, β)
        return spawn_ray(self.scene, si, d, through), β, shorter, mirrored, active

    def _to_sensor(self, si, bsdf, vertex: LightVertex, sampler, views: FilmViews, film: Film, known, active) -> Any:
        lens = sampler.next_2d(active) if views.needs_aperture else mi.Point2f(0.5)
        choice = sampler.next_1d(active) if len(views.parts) > 1 else mi.Float(0)
        view = views.of(si.p, lens, choice, active)
        active = active & (view.arrival > 0)
        if self.hides:
            active &= si.shape.emitter() == None  # noqa: E711 (an array of pointers)
        there = light_towards(si, bsdf, vertex.shorter, view.d, active)
        # Each stands for so many camera paths.
        others = view.arrival / views.per_path
        L = vertex.β * there.f * others
        w = weight(others * dr.abs_dot(si.n, view.d) * there.shorter)
        active &= dr.any(L != 0) & self.ways.counts(vertex.number + 1, 1)
        to_sensor = spawn_ray_to(self.scene, si, dr.fma(view.d, view.distance, si.p))
        active &= ~self._blocked(to_sensor, active)
        return film.add(known, Seen(view.u, lens, vertex.number), L * w, sampler, active)

    def _blocked(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Is there anything on the way to the sensor, but for emitters that it does not see?"""
        scene = self.scene
        if not self.hides:
            return scene.ray_test(ray, active)

        def step(ray, blocked, going):
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
            met = going & pi.is_valid()
            emits = met & (pi.shape.emitter() != None)  # noqa: E711
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, emits)
            onwards = spawn_ray(scene, si, ray.d, True)
            onwards.maxt = ray.maxt - pi.t
            return dr.select(emits, onwards, ray), blocked | (met & ~emits), emits

        return dr.while_loop((ray, mi.Bool(False), active), lambda r, b, going: going, step, label="hidden emitters")[1]
