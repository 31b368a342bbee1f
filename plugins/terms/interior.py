"""The interior term: how radiance changes where nothing jumps."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.transport.cut import Cut

from .sampling import over_film
from .term import INTERIOR, FilmSamples, Job, Sample, Term


class InteriorTerm(Term):
    """Camera paths, as the image has them: their first vertex is attached, the rest is differentiated by replay."""

    name, of_property = INTERIOR, "sppc"

    def planned(self, job: Job) -> PlannedTerm:
        path = job.rays_of_path
        replayed = (job.segments > 2) * 2 * (path - 3)
        return self.plan(job.counts.interior * job.pixels, path + replayed, "always", '"sppc" is 0')

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        return [lambda: self._samples(job)]

    def _samples(self, job: Job) -> FilmSamples:
        sampler, _ = over_film(job.sensor, job.seed, job.counts.weights)
        ray, ray_weight, position = job.sample_rays(sampler)
        if not job.counts.interior:
            return FilmSamples(position, Sample(mi.Spectrum(0), mi.Float(0)), ray.wavelengths, 1.0, job.weights)
        rays, held = Cut(job.mode), job.tracer.held
        of_held = {}
        if held is not None:
            pi = job.tracer.first_hit(ray, True)
            # Used again in the kernels of the sensor's gradients.
            dr.eval(dr.detach(ray), pi)
            with dr.resume_grad():
                stretch = held.stretch(job.tracer.scene, ray, pi, held.are(ray, pi, mi.Bool(True)))
                of_held = {"pi": pi, "stretch": rays.array(stretch)}
        found = job.tracer.radiance(rays(ray), sampler, mi.Bool(True), attached=True, **of_held)
        with dr.resume_grad():
            value = Sample(mi.Spectrum(found.L * ray_weight), mi.Float(0))
        weight = dr.detach(ray_weight)
        return FilmSamples(position, value, ray.wavelengths, 1.0, job.weights, found.rest, weight, (rays,))
