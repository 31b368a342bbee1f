"""Where interpolated normals turn away from points, as a term."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.transport.cut import Cut
from rimlight.transport.paths import Vertex
from rimlight.transport.replay import MovingVertex
from rimlight.transport.walk import Walk

from .points import FromPoints
from .term import Job


class HorizonsTerm(FromPoints):
    """What coarse smooth-shaded meshes cease to reflect to points, where their normals turn away from these."""

    name, effort, beyond = "horizons from points", 3.0, 1

    def planned(self, job: Job) -> PlannedTerm:
        count = job.counts.shading * job.pixels if self.boundary(job) is not None else 0
        why_not = "no coarse mesh with interpolated normals in indirect light"
        return self.plan(count, job.rays_of_path, "interpolated normals turn away from points", why_not)

    def boundary(self, job: Job) -> object | None:
        return job.boundaries.horizons

    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        point, chosen = job.tracer.point(ray, walk, job.mode, beyond=self.beyond)
        L = job.boundaries.horizons.sample(job.tracer, point, sampler)
        with dr.resume_grad():
            return L * point.β, () if chosen is None else (chosen,)
