"""The film boundary as a term: visibility as seen from the sensor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import FilmPart

from .sampling import in_a_row, seed_of
from .term import FilmSamples, Job, Sample, Term


class FilmTerm(Term):
    """Edges that move over the film, on each of its parts."""

    name, of_property = "film boundary", "sppp"

    def planned(self, job: Job) -> PlannedTerm:
        film, sppp = job.boundaries.film, job.counts.film
        moves = "only lights move" if job.boundaries.anything_moves else "nothing moves"
        count = sum(job.counts.on_line(part.sensor.film()) for part in job.parts) if film is not None else 0
        edges = film.edge_count if film is not None else 0
        why_not = '"sppp" is 0' if film is not None and not sppp else moves
        return self.plan(count, 2 * job.rays_of_path, f"{edges} edges may move on the film", why_not)

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        if job.boundaries.film is None or not job.counts.film:
            return []
        return [partial(self._samples, job, i, part) for i, part in enumerate(job.parts)]

    def _samples(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        count = job.counts.on_line(part.sensor.film())
        sampler = in_a_row(job.sensor, seed_of(self.name, job.seed, i), count)
        s = job.boundaries.film.sample(job.tracer, part.sensor, sampler, count)
        with dr.resume_grad():
            weight = job.weights * part.area
            value = Sample(mi.Spectrum(s.value * weight), s.alpha * weight)
            return FilmSamples(part.to_film(s.position), value, s.wavelengths, 0.0, 0)
