"""Shadows in light from surfaces, found from these, as a term."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import DeepShadows
from rimlight.transport.cut import Cut
from rimlight.transport.paths import Vertex
from rimlight.transport.replay import MovingVertex
from rimlight.transport.walk import Walk

from .points import FromPoints, placement_and_point
from .term import Job


class DeepShadowsTerm(FromPoints):
    """Edges as vertices of light subpaths see them."""

    name, effort, beyond = "shadows in light from surfaces", 3.0, 1

    def planned(self, job: Job) -> PlannedTerm:
        count = job.counts.shading * job.pixels if self.boundary(job) is not None else 0
        rays = job.rays_of_path + 4
        return self.plan(count, rays, "light that is scattered", "no light is scattered twice, or no edge moves")

    def boundary(self, job: Job) -> DeepShadows | None:
        return job.boundaries.deep

    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        deep = self.boundary(job)
        placement, point, cuts = placement_and_point(job, deep.silhouettes, ray, walk, self.beyond)
        L = deep.at(job.tracer, placement, point, sampler, choice)
        with dr.resume_grad():
            return L * point.β, cuts
