"""Shadows on what the camera sees, found from the lights, as a term."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm, counted
from rimlight.edge_sampling import FilmPart
from rimlight.edge_sampling.boundaries.shadow_boundary import ShadowSamples

from .sampling import over_film, seed_of
from .term import FilmSamples, Job, Sample, Term


class ShadowsTerm(Term):
    """Edges as the lights see them, and planes of coarse lamps, on each part of the film."""

    name, effort = "shadows from lights", 2.0

    def planned(self, job: Job) -> PlannedTerm:
        shadows, shading = job.boundaries.shadows, job.boundaries.shading
        planes = job.boundaries.lamp_planes
        what = [counted(len(shadows), "light")] if shadows is not None else []
        what += [f"planes of {counted(planes.count, 'face')} of lamps"] if planes is not None else []
        why_not = "no lights but the environment" if shading is not None else nothing_at_points(job)
        return self.plan(len(what) * job.counts.shading * job.pixels, 3, ", ".join(what), why_not)

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        found = job.boundaries.shadows, job.boundaries.lamp_planes
        make = [m for m, of in zip((self._samples, self._planes), found, strict=True) if of is not None]
        return [partial(m, job, i, part) for m in make for i, part in enumerate(job.parts)]

    def _samples(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        shading = job.boundaries.shading
        seed = seed_of(self.name, job.seed, i)
        sampler, _ = over_film(job.sensor, seed, job.counts.shading, part.sensor.film())
        share = shading is not None and shading.emission_at_first
        s = job.boundaries.shadows.sample(job.tracer, part.sensor, sampler, share=share)
        return self._on_film(job, part, s)

    def _planes(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        seed = seed_of("planes of lamps", job.seed, i)
        sampler, _ = over_film(job.sensor, seed, job.counts.shading, part.sensor.film())
        return self._on_film(job, part, job.boundaries.lamp_planes.sample(job.tracer, part.sensor, sampler))

    @staticmethod
    def _on_film(job: Job, part: FilmPart, s: ShadowSamples) -> FilmSamples:
        with dr.resume_grad():
            value = Sample(mi.Spectrum(s.value * (job.weights * part.area)), mi.Float(0))
            return FilmSamples(part.to_film(s.position), value, s.wavelengths, 0.0, 0)


def nothing_at_points(job: Job) -> str:
    """Why there are no boundaries in light that is reflected."""
    if not job.boundaries.anything_moves:
        return "nothing moves"
    return "nothing is lit" if job.counts.shading else '"sppi" is 0'
