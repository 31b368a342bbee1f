"""Jumps that no projection tells of, as a term: outlines in perfect mirrors and glass, and lines of textures.

It is looked for. Along a short segment of the film, what is seen is compared at both ends, and where it differs, the
segment is bisected. How the jump moves follows from a function that vanishes there (`jumps.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import FilmPart
from rimlight.edge_sampling.parametrisation import Vicinity
from rimlight.edge_sampling.projection.sensors import frame, inside_frame
from rimlight.transport.chain_rays import FilmRays
from rimlight.transport.cut import Cut
from rimlight.transport.film_chains import Chains, Parting, Segment
from rimlight.transport.replay import Chain, MovingVertex, written

from .jumps import CANDIDATES, bisect, find_segment, jump_and_motion
from .sampling import in_a_row, seed_of
from .term import FilmSamples, Job, Sample, Term

#: Where nothing is found to jump in it after all, it is looked at once more, so many times as long.
WIDE = 16

#: What is looked for, in plans.
WHAT = ("perfect mirrors, glass or veils", "textures or beams that jump")

#: Most rays that one sample traces besides those of a path: for plans.
RAYS = 2 * (3 * CANDIDATES + 11)


class BisectionTerm(Term):
    """Outlines of what the camera sees in mirrors, and through glass, and lines at which textures jump."""

    name, of_property = "mirrors and textures", "sppp"

    def planned(self, job: Job) -> PlannedTerm:
        count = sum(job.counts.on_line(part.sensor.film()) for part in job.parts) if self._wanted(job) else 0
        what = [w for w, there in zip(WHAT, (job.boundaries.mirrors, job.boundaries.textures), strict=True) if there]
        why_not = '"sppp" is 0' if what else "neither mirrors, glass, textures nor beams with jumps, or nothing moves"
        rays = RAYS if job.boundaries.shown is None else 2 * RAYS  # as many to lights
        return self.plan(count, rays + 2 * job.rays_of_path, " and ".join(what), why_not)

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        return [partial(self._samples, job, i, part) for i, part in enumerate(job.parts)] if self._wanted(job) else []

    @staticmethod
    def _wanted(job: Job) -> bool:
        return (job.boundaries.mirrors or job.boundaries.textures is not None) and job.counts.film > 0

    def _samples(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        film = part.sensor.film()
        count = job.counts.on_line(film)
        sampler = in_a_row(job.sensor, seed_of(self.name, job.seed, i), count)
        rays = FilmRays(part.sensor, sampler)
        chains = Chains(job.tracer, rays, job.boundaries)
        segment = bisect(chains, find_segment(chains, *frame(film), sampler), sampler)
        # What is found here is used again in the kernels of the gradients, which are not to look for it again.
        sampler.schedule_state()
        dr.eval(segment)
        active = (segment.weight > 0) & inside_frame(segment.middle, film)
        cut = Cut(job.mode)
        with dr.resume_grad():
            ray, weight = rays.at(segment.start)
            ray, again = cut(ray), cut(rays.at(segment.start)[0])
        at, moving = self._where_they_part(job, chains, segment, ray, active)
        jump, alpha, factor, g = jump_and_motion(job, chains, segment, at, again, moving, sampler)
        with dr.resume_grad():
            normal_velocity = factor * (g - dr.detach(g)) * (job.weights * part.area / count)
            value = Sample(mi.Spectrum(jump * normal_velocity * weight), mi.Float(alpha * normal_velocity))
            cuts = (cut,) if moving is None else (moving, cut)
            return FilmSamples(part.to_film(segment.middle), value, ray.wavelengths, 0.0, 0, cuts=cuts)

    @staticmethod
    def _where_they_part(
        job: Job, chains: Chains, segment: Segment, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[Parting, MovingVertex | None]:
        """Where the chains from both ends of a segment part; and behind mirrors, the vertex before, as it moves."""
        first = chains.first(segment.start, active), chains.first(segment.end, active)
        follow = lambda log: chains.part(first, segment, active, log)
        if not job.boundaries.mirrors:
            at, wide = follow(None), segment.widened(0.5 * (WIDE - 1) * segment.length)
            # On large shapes, places so close to each other may be one and the same, but for rounding.
            lost = active & ~at.found
            again = chains.part((chains.first(wide.start, lost), chains.first(wide.end, lost)), wide, lost, None)
            return dr.select(lost, again, at), None
        log, at = written(job.tracer.scene, first[0].ray, 1, job.tracer.depths, follow, lambda at: at.a.depth)
        chain = Chain(job.tracer.scene, Vicinity.of(first[0].pi), held=job.tracer.held)
        behind = at.found & (at.a.depth > 1)
        last = log.vertex(dr.maximum(at.a.depth, 2) - 1, behind)
        one = dr.full(mi.UInt32, 1, dr.width(active))
        return at, MovingVertex(chain, ray, first[0], log, last, behind, one, job.mode, onwards=True)
