"""Shadows in indirect light, found from the lights, as a term."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.transport.cut import Cut
from rimlight.transport.replay import ChosenVertex

from .points import FromPoints, placement_and_point
from .term import Job


class IndirectShadowsTerm(FromPoints):
    """Edges as the lights see them, by the shadows on what lights the vertices of paths."""

    name, effort = "shadows in indirect light", 3.0

    def planned(self, job: Job) -> PlannedTerm:
        lights = len(self.boundary(job)) if self.boundary(job) is not None else 0
        count = job.counts.shading * job.pixels if lights else 0
        return self.plan(count, job.rays_of_path, f"{lights} lights", "no light is scattered twice, or no edge moves")

    def boundary(self, job: Job) -> object | None:
        return job.boundaries.indirect

    def reflected(
        self, job: Job, ray: mi.Ray3f, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[ChosenVertex | Cut, ...]]:
        shadows = job.boundaries.indirect
        placement, point, cuts = placement_and_point(job, shadows.silhouettes, ray, sampler, beyond=1)
        L = shadows.at(job.tracer, placement, point, sampler, choice)
        with dr.resume_grad():
            return L * point.β, cuts
