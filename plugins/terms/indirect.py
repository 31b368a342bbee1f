"""Shadows and borders of beams in indirect light, found from the lights, as a term."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm, counted
from rimlight.edge_sampling import IndirectShadows
from rimlight.transport.cut import Cut
from rimlight.transport.paths import Vertex
from rimlight.transport.replay import MovingVertex
from rimlight.transport.walk import Walk

from .points import FromPoints, placement_and_point
from .term import Job


class IndirectShadowsTerm(FromPoints):
    """Edges as the lights see them, and lines of beams, by what jumps there on what lights the vertices of paths."""

    name, effort, beyond = "shadows in indirect light", 3.0, 1

    def planned(self, job: Job) -> PlannedTerm:
        found = self.boundary(job)
        count = job.counts.shading * job.pixels if found else 0
        why = counted(max(map(len, found), default=0), "light")
        return self.plan(count, job.rays_of_path, why, "no light is scattered twice, or no edge moves")

    def boundary(self, job: Job) -> tuple[IndirectShadows, ...]:
        return job.boundaries.indirect

    def sample(self, boundary: IndirectShadows, *arguments) -> mi.Spectrum:
        """See `IndirectShadows.at`."""
        return boundary.at(*arguments)

    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        boundaries = self.boundary(job)
        placement, point, cuts = placement_and_point(job, boundaries[0].silhouettes, ray, walk, self.beyond)
        L = mi.Spectrum(0)
        for boundary in boundaries:
            of_one = self.sample(boundary, job.tracer, placement, point, sampler, choice)
            with dr.resume_grad():
                L += of_one
        with dr.resume_grad():
            return L * point.β, cuts


class ContinuedShadowsTerm(IndirectShadowsTerm):
    """The same by way of one more vertex, which is found from the shadow."""

    name, beyond = "shadows in indirect light, continued", 2

    def boundary(self, job: Job) -> tuple[IndirectShadows, ...]:
        return job.boundaries.indirect if job.tracer.scatters(3) else ()

    def sample(self, boundary: IndirectShadows, *arguments) -> mi.Spectrum:
        return boundary.onwards(*arguments)
