"""Shadows on what the camera sees, found from the lights, as a term."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm, counted
from rimlight.edge_sampling import FilmPart

from .sampling import over_film, seed_of
from .term import FilmSamples, Job, Sample, Term


class ShadowsTerm(Term):
    """Edges as the lights see them, on each part of the film."""

    name, effort = "shadows from lights", 3.0

    def planned(self, job: Job) -> PlannedTerm:
        shadows, shading = job.boundaries.shadows, job.boundaries.shading
        count = job.counts.shading * job.pixels if shadows is not None else 0
        lights = len(shadows) if shadows is not None else 0
        why_not = "no lights but the environment" if shading is not None else nothing_at_points(job)
        return self.plan(count, 3, counted(lights, "light"), why_not)

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        if job.boundaries.shadows is None:
            return []
        return [partial(self._samples, job, i, part) for i, part in enumerate(job.parts)]

    def _samples(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        shading = job.boundaries.shading
        seed = seed_of(self.name, job.seed, i)
        sampler, _ = over_film(job.sensor, seed, job.counts.shading, part.sensor.film())
        share = shading is not None and shading.emission_at_first
        s = job.boundaries.shadows.sample(job.tracer, part.sensor, sampler, share=share)
        with dr.resume_grad():
            value = Sample(mi.Spectrum(s.value * (job.weights * part.area)), mi.Float(0))
            return FilmSamples(part.to_film(s.position), value, s.wavelengths, 0.0, 0)


def nothing_at_points(job: Job) -> str:
    """Why there are no boundaries in light that is reflected."""
    if not job.boundaries.anything_moves:
        return "nothing moves"
    return "nothing is lit" if job.counts.shading else '"sppi" is 0'
