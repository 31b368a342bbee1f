"""Boundaries as shading points see them, as a term."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import Silhouettes, stratified
from rimlight.edge_sampling.boundaries.tracer import ShadingPoint
from rimlight.edge_sampling.choice.silhouettes import Placement
from rimlight.transport.cut import Cut
from rimlight.transport.paths import Vertex
from rimlight.transport.replay import MovingVertex
from rimlight.transport.walk import Walk

from .sampling import over_film, seed_of
from .shadows import nothing_at_points
from .term import FilmSamples, Job, Sample, Term


class FromPoints(Term):
    """What one vertex of each path sees of boundaries.

    beyond : at least so many more vertices may follow that one.
    """

    beyond = 0

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        return [lambda: self._samples(job)] if self.boundary(job) else []

    def _samples(self, job: Job) -> FilmSamples:
        of_rays, walk = walked(job)
        ray, ray_weight, position = job.sample_rays(of_rays.clone())
        seed = seed_of(self.name, job.seed)
        sampler, spp = over_film(job.sensor, seed, job.counts.shading)
        choice = stratified(sampler, seed)
        rays = Cut(job.mode)
        L, cuts = self.reflected(job, rays(ray), walk, sampler, choice)
        with dr.resume_grad():
            value = Sample(mi.Spectrum(L * ray_weight * (job.weights / spp)), mi.Float(0))
        return FilmSamples(position, value, ray.wavelengths, 0.0, spp, cuts=(*cuts, rays))

    @abstractmethod
    def boundary(self, job: Job) -> object:
        """What is sampled; nothing, if it is false."""

    @abstractmethod
    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        """What the boundary does to the light along camera rays: mi.Spectrum, (N,), zero, with its gradient; and where
        that is cut, see `FilmSamples`.

        ray : attached to the camera. walk : along these rays.
        choice : uniform in [0, 1), stratified.
        """


def walked(job: Job) -> tuple[mi.Sampler, Walk | Vertex]:
    """Paths from the camera, of which all terms that look from points take the same if they have as many samples: the
    sampler of their rays, in the state in which `Job.sample_rays` is to have it, and the paths."""
    spp = job.counts.shading
    if spp not in job.walks:
        # Those with another number of samples are not needed again, as a rule, and large.
        job.walks.clear()
        beyond = {t.beyond for t in job.terms if isinstance(t, FromPoints) and t.boundary(job)}
        sampler, _ = over_film(job.sensor, seed_of("paths", job.seed), spp)
        of_rays = sampler.clone()
        ray, _, _ = job.sample_rays(sampler)
        job.walks[spp] = of_rays, job.tracer.walk(dr.detach(ray), sampler, sorted(beyond))
    return job.walks[spp]


class PointsTerm(FromPoints):
    """Edges that hide, from a vertex, light that it would reflect."""

    name, effort = "edges from points", 3.0

    def planned(self, job: Job) -> PlannedTerm:
        count = job.counts.shading * job.pixels if self.boundary(job) is not None else 0
        why = "light that is scattered may be occluded"
        if job.segments <= 2:
            why = "glossy surfaces, an environment, or lamps close to what they light"
        from_lights = job.boundaries.shadows is not None
        why_not = "direct light: found from the lights" if from_lights else nothing_at_points(job)
        return self.plan(count, 1 + job.rays_of_path, why, why_not)

    def boundary(self, job: Job) -> object | None:
        return job.boundaries.shading

    def reflected(
        self, job: Job, ray: mi.Ray3f, walk: Walk | Vertex, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[mi.Spectrum, tuple[MovingVertex | Cut, ...]]:
        silhouettes = job.boundaries.shading.silhouettes
        placement, point, cuts = placement_and_point(job, silhouettes, ray, walk, self.beyond)
        L = job.boundaries.shading.sample(job.tracer, placement, point, sampler, choice)
        with dr.resume_grad():
            return L * point.β, cuts


def placement_and_point(
    job: Job, silhouettes: Silhouettes, ray: mi.Ray3f, walk: Walk | Vertex, beyond: int
) -> tuple[Placement, ShadingPoint, tuple[MovingVertex | Cut, ...]]:
    """Where the shapes are, a point of each path, as `PathTracer.point` has it, and where both are cut."""
    find = lambda: job.tracer.point(ray, walk, job.mode, beyond=beyond)
    # The motion of a chain is found at once, in forward mode: then nothing else may be attached to the shapes yet.
    found = find() if job.tracer.scatters(2) and job.mode == dr.ADMode.Forward else None
    cut = Cut(job.mode)
    with dr.resume_grad():
        placement = silhouettes.placement()
        placement.positions = cut.array(placement.positions)
        if placement.frames is not None:
            placement.frames = cut.array(placement.frames)
    point, chosen = found or find()
    return placement, point, (cut,) if chosen is None else (chosen, cut)
