"""Outlines that points see in perfect mirrors, and through glass, as a term."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling.boundaries.tracer import ShadingPoint
from rimlight.transport.chain_rays import PointRays
from rimlight.transport.cut import Cut
from rimlight.transport.film_chains import Chains, Parting, Segment
from rimlight.transport.paths import Vertex
from rimlight.transport.replay import Chain, MovingVertex, written
from rimlight.transport.tracer import camera_vertex
from rimlight.transport.walk import Walk

from .jumps import bisect, find_segment, jump_and_motion
from .points import FromPoints
from .term import Job

#: Segments of the directions at a point, among which one is chosen whose ends differ.
CANDIDATES = 8

#: Most rays that one sample traces besides those of a path: for plans.
RAYS = 2 * (3 * CANDIDATES + 11)


class MirroredTerm(FromPoints):
    """Edges of the light that perfect mirrors and glass throw on other surfaces.

    They are looked for as on the film: along a segment of the directions at a point of each path.
    """

    name, effort, beyond = "mirrors from points", 3.0, 1

    def planned(self, job: Job) -> PlannedTerm:
        count = job.counts.shading * job.pixels if self.boundary(job) else 0
        why = "perfect mirrors or glass may throw light on other surfaces"
        return self.plan(
            count, RAYS + 2 * job.rays_of_path, why, "no perfect mirrors or glass, no indirect light, or nothing moves"
        )

    def boundary(self, job: Job) -> bool:
        return job.boundaries.mirrored

    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        point, chosen = job.tracer.point(ray, walk, job.mode, beyond=self.beyond)
        si, scene = dr.detach(point.si), job.tracer.scene
        both = point.active & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
        rays = PointRays(scene, si, point.depth - 1, dr.detach(mi.Ray3f(ray)), both & (sampler.next_1d() < 0.5))
        chains = Chains(job.tracer, rays, job.boundaries)
        corners = mi.ScalarPoint2f(rays.offset), mi.ScalarPoint2f(rays.offset + rays.size)
        segment = bisect(chains, find_segment(chains, *corners, sampler, CANDIDATES), sampler)
        middle = segment.middle
        active = point.active & (segment.weight > 0) & dr.all((middle >= corners[0]) & (middle < corners[1]))
        weight = rays.weight(middle, active) * dr.select(both, 2, mi.Float(1)) * point.β
        active &= dr.any(weight != 0)
        # What is found here is used again in the kernels of the gradients, which are not to look for it again.
        sampler.schedule_state()
        dr.eval(segment, weight, active)
        at, moving = self._where_they_part(job, chains, segment, point, active)
        jump, _, factor, g = jump_and_motion(job, chains, segment, at, rays.like, moving, sampler)
        with dr.resume_grad():
            L = mi.Spectrum(dr.select(active, jump * weight, 0)) * (factor * (g - dr.detach(g)))
        return L, (moving,) if chosen is None else (moving, chosen)

    @staticmethod
    def _where_they_part(
        job: Job, chains: Chains, segment: Segment, point: ShadingPoint, active: mi.Bool
    ) -> tuple[Parting, MovingVertex]:
        """Where the chains from both ends of a segment part, and the vertex before, as it moves."""
        scene, depths = job.tracer.scene, job.tracer.depths
        first = chains.first(segment.start, active), chains.first(segment.end, active)
        follow = lambda log: chains.part(first, segment, active, log)
        log, at = written(scene, first[0].ray, 2, depths, follow, lambda at: at.a.depth)
        behind = at.found & (at.a.depth > 2)
        at.found = behind
        last = log.vertex(dr.maximum(at.a.depth, 3) - 1, behind)
        # Wherever the first mirror is, the direction from which the point looks into it turns the chain.
        since = mi.UInt32(1)
        start = camera_vertex(first[0].ray, first[0].pi)
        chain = Chain(scene, point.vicinity, held=job.tracer.held)
        where = last, behind, since, job.mode
        return at, MovingVertex(chain, first[0].ray, start, log, *where, onwards=True, at_first=point.si)
