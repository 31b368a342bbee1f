"""Edges that the camera sees in perfect mirrors, and through glass, as a term."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import FilmPart
from rimlight.edge_sampling.boundaries.touch import Touch, touch_outline
from rimlight.edge_sampling.parametrisation import Vicinity
from rimlight.edge_sampling.projection.sensors import frame, inside_frame
from rimlight.transport.cut_rays import CutRays
from rimlight.transport.mirrors import Chains, FilmRays, Parting, Seen
from rimlight.transport.replay import Chain, MovingVertex, written

from .sampling import in_a_row, seed_of
from .term import FilmSamples, Job, Sample, Term

#: Segments of the film among which one is chosen whose ends differ.
CANDIDATES = 8

#: Length of the segments, pixels; and to which they are bisected.
LONGEST, SHORTEST = 1.0, 2.0**-9

#: Part of the segments that are looked at for jumps of which both ends know nothing; and how often those are halved at
#: most before.
HIDDEN, HALVINGS = 0.25, 7

#: Most rays that one sample traces besides those of a path: for plans.
RAYS = 2 * (3 * CANDIDATES + 9)


@dataclass
class Segment:
    """A segment of the film, at whose ends different things are seen.

    start : mi.Point2f, pixels. length : mi.Float, pixels, along `axis`.
    a, b : what is seen at both ends.
    choice : mi.UInt32, of the chains.
    weight : mi.Float, over the density with which one of its length starts here; 0: there is none.
    """

    start: mi.Point2f
    length: mi.Float
    axis: mi.Vector2f
    a: Seen
    b: Seen
    choice: mi.UInt32
    weight: mi.Float

    @property
    def end(self) -> mi.Point2f:
        return self.start + self.length * self.axis

    @property
    def middle(self) -> mi.Point2f:
        return self.start + 0.5 * self.length * self.axis

    def half(self, middle: Seen, sampler: mi.Sampler) -> Segment:
        """One of its halves in which something jumps: any of two, with twice the weight."""
        h = 0.5 * self.length
        left, right = self.a.differs(middle, h), middle.differs(self.b, h)
        both = left & right
        right &= ~left | (sampler.next_1d() < 0.5)
        return Segment(
            dr.select(right, self.middle, self.start),
            h,
            self.axis,
            dr.select(right, middle, self.a),
            dr.select(right, self.b, middle),
            self.choice,
            self.weight * dr.select(both, 2, dr.select(left | right, mi.Float(1), 0)),
        )


class MirrorsTerm(Term):
    """Outlines of what the camera sees in mirrors."""

    name = "edges in mirrors"

    def planned(self, job: Job) -> PlannedTerm:
        count = sum(job.counts.on_line(part.sensor.film()) for part in job.parts) if self._wanted(job) else 0
        return self.plan(count, RAYS + 2 * job.rays_of_path, "perfect mirrors or glass", "no mirrors, or nothing moves")

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        return [partial(self._samples, job, i, part) for i, part in enumerate(job.parts)] if self._wanted(job) else []

    @staticmethod
    def _wanted(job: Job) -> bool:
        return job.boundaries.mirrors and job.counts.film > 0

    def _samples(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        film = part.sensor.film()
        count = job.counts.on_line(film)
        seed = seed_of(self.name, job.seed, i)
        sampler = in_a_row(job.sensor, seed, count)
        rays = FilmRays(part.sensor, sampler)
        chains = Chains(job.tracer, rays)
        segment = bisect(chains, find_segment(chains, film, sampler), sampler)
        u = segment.middle
        active = (segment.weight > 0) & inside_frame(u, film)
        cut = CutRays(job.mode)
        with dr.resume_grad():
            ray, weight = rays.at(segment.start)
        at, moving = self._where_they_part(job, chains, segment, cut(ray), active)
        active &= at.found
        value = self._jump(job, at, segment, moving, sampler, active)
        with dr.resume_grad():
            value = Sample(mi.Spectrum(value * weight * (job.weights * part.area / count)), mi.Float(0))
            return FilmSamples(part.to_film(u), value, ray.wavelengths, 0.0, 0, cuts=(moving, cut))

    @staticmethod
    def _where_they_part(job: Job, chains: Chains, segment: Segment, ray, active) -> tuple[Parting, MovingVertex]:
        """Where the chains from the ends of a segment part, and the vertex before, as it moves."""
        first = chains.first(segment.start, active), chains.first(segment.end, active)
        ends = segment.start, segment.end
        found = []

        def follow(log):
            found[:] = [chains.part(first, ends, segment.axis, segment.choice, active, log)]
            return found[0].a.depth

        log, _ = written(job.tracer.scene, first[0].ray, 1, job.tracer.depths, follow)
        at = found[0]
        chain = Chain(job.tracer.scene, Vicinity.of(first[0].pi))
        last = log.vertex(dr.maximum(at.a.depth, 2) - 1, at.found)
        one = dr.full(mi.UInt32, 1, dr.width(active))
        return at, MovingVertex(chain, ray, first[0], log, last, at.found, one, job.mode, onwards=True)

    @staticmethod
    def _jump(job: Job, at: Parting, segment: Segment, moving: MovingVertex, sampler, active) -> mi.Spectrum:
        """What the motion of the jump does to the image: (N,), zero, with its gradient."""
        tracer, scene = job.tracer, job.tracer.scene
        a_is_near = at.a.pi.t <= at.b.pi.t
        near, far = (at.a.ray, at.a.pi), (at.b.ray, at.b.pi)
        near, far = (tuple(dr.select(a_is_near, x, y) for x, y in zip(p, q)) for p, q in ((near, far), (far, near)))
        active &= near[1].is_valid()
        jump = seen_along(tracer, *near, at.a.depth, sampler.clone(), active, True)
        jump -= seen_along(tracer, *far, at.a.depth, sampler.clone(), active, False)
        jump *= dr.select(a_is_near, at.a.β, -at.a.β)

        ray = at.a.ray
        reach = segment.length * dr.norm(at.along.o + near[1].t * at.along.d)
        touch = touch_outline(scene, ray, near, far, reach, active)
        along, across = (-dr.dot(touch.n, way.o + touch.t * way.d) for way in (at.along, at.across))
        total = dr.square(along) + dr.square(across)
        factor = dr.select(active & (total > 0), -segment.weight * along / total, 0)
        dr.eval(jump, factor)
        with dr.resume_grad():
            g = touch.moved - dr.dot(touch.n, moving.p + touch.t * moving.d)
            return dr.select(active, jump * (factor * (g - dr.detach(g))), 0)


def seen_along(tracer, ray, pi, depth, sampler, active, near: bool) -> mi.Spectrum:
    """Light along a ray from a mirror to a vertex of this number. near : is this just inside of its outline?"""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    L = si.emitter(tracer.scene).eval(si, active)
    return L + tracer.scattered(ray, pi, depth - 1, sampler, active, mi.Bool(near))


def find_segment(chains: Chains, film: mi.Film, sampler: mi.Sampler) -> Segment:
    """Half of a segment of the film, in which something jumps: one of some candidates, in proportion to their weights.

    Most candidates have different ends. The others have equal ends, but something else in their middle: so what is
    smaller than a segment is found as well. Each jump is found in one of these ways only. With the segment halved again
    and again, it is a candidate of the last length at which both ends are equal, or else of the first kind.
    """
    lower, upper = frame(film)
    start = lower - LONGEST
    size = upper - start
    width = sampler.wavefront_size()

    def candidate(k, kept, total, sampler):
        at = sampler.next_2d()
        axis = dr.select(sampler.next_1d() < 0.5, mi.Vector2f(1, 0), mi.Vector2f(0, 1))
        hidden, level = sampler.next_1d() < HIDDEN, sampler.next_1d()
        choice = mi.UInt32(sampler.next_1d() * 2**24)
        halvings = dr.minimum(dr.floor(-dr.log2(dr.maximum(1 - level, 2.0**-24))), HALVINGS)
        p = dr.exp2(-dr.minimum(halvings + 1, HALVINGS))
        length = dr.select(hidden, LONGEST * dr.exp2(-halvings), LONGEST)
        density = length * dr.select(hidden, HIDDEN * p, 1 - HIDDEN) / (2 * size.x * size.y)
        yes = mi.Bool(True)
        where = mi.Point2f(start + at * size)
        a = chains.end(where, axis, choice, yes)
        b = chains.end(where + length * axis, axis, choice, yes)
        middle = chains.end(where + 0.5 * length * axis, axis, choice, yes)
        whole = Segment(where, length, axis, a, b, choice, dr.rcp(density))
        whole.weight = dr.select(a.differs(b, length) == hidden, 0, whole.weight)
        found = whole.half(middle, sampler)
        total += found.weight
        taken = sampler.next_1d() * total < found.weight
        return k + 1, dr.select(taken, found, kept), total, sampler

    nothing = Segment(
        dr.zeros(mi.Point2f, width),
        dr.zeros(mi.Float, width),
        dr.zeros(mi.Vector2f, width),
        Seen.nothing(width),
        Seen.nothing(width),
        dr.zeros(mi.UInt32, width),
        dr.zeros(mi.Float, width),
    )
    _, kept, total, _ = dr.while_loop(
        (dr.zeros(mi.UInt32, width), nothing, dr.zeros(mi.Float, width), sampler),
        lambda k, *_: k < CANDIDATES,
        candidate,
        label="segments of the film",
    )
    kept.weight = total / CANDIDATES
    return kept


def bisect(chains: Chains, segment: Segment, sampler: mi.Sampler) -> Segment:
    """The jump in a segment, to a small part of a pixel."""

    def step(segment, sampler):
        middle = chains.end(segment.middle, segment.axis, segment.choice, mi.Bool(True))
        return segment.half(middle, sampler), sampler

    going = lambda segment, _: (segment.weight > 0) & (segment.length > SHORTEST)
    return dr.while_loop((segment, sampler), going, step, label="bisection")[0]
