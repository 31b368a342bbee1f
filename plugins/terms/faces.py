"""The planes of faces, as a term."""

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


class FacePlanesTerm(FromPoints):
    """What faces hide from themselves, where other normals than theirs shade."""

    name, effort = "planes of faces", 1.0

    def planned(self, job: Job) -> PlannedTerm:
        count = job.counts.shading * job.pixels if self.boundary(job) is not None else 0
        why_not = "nothing that moves" if job.counts.shading else '"sppi" is 0'
        return self.plan(count, 1 + job.rays_of_path, "interpolated normals, or normal maps, in soft light", why_not)

    def boundary(self, job: Job) -> object | None:
        return job.boundaries.planes

    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        point, chosen = job.tracer.point(ray, walk, job.mode)
        L = job.boundaries.planes.sample(job.tracer, point, sampler)
        with dr.resume_grad():
            return L * point.β, () if chosen is None else (chosen,)
