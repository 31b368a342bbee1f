"""The interior term of paths from both ends."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import Batch
from rimlight.transport.bidirectional_tracer import FoundPaths
from rimlight.transport.cut import Cut

from .interior import InteriorTerm
from .sampling import in_a_row, over_film, seed_of
from .term import FilmSamples, Job, Sample


class BidirectionalTerm(InteriorTerm):
    """One path of each camera subpath, and one of each light subpath, in proportion to the light that they bring."""

    def planned(self, job: Job) -> PlannedTerm:
        found = 1 + 3 * max(job.segments - 1, 0) + job.tracer.light_paths * 2 * job.segments
        replayed = 1 + job.tracer.light_paths
        return self.plan(job.counts.interior * job.pixels, round(found + replayed), "always", '"sppc" is 0')

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        if not job.counts.interior:
            return super().samples(job)
        found = cache(lambda: self._find(job))
        return [lambda: self._of_camera(job, *found()), lambda: self._of_lights(job, *found())]

    def _find(self, job: Job) -> tuple[FoundPaths, mi.RayDifferential3f, mi.Spectrum, mi.Point2f]:
        """Paths, camera rays, their weights and film positions."""
        sampler, _ = over_film(job.sensor, job.seed, job.counts.weights)
        ray, ray_weight, u = job.sample_rays(sampler)
        lights = max(1, round(dr.width(u) * job.tracer.light_paths))
        light_sampler = in_a_row(job.sensor, seed_of("light paths", job.seed), lights)
        return job.tracer.find_paths(job.sensor, dr.detach(ray), u, sampler, light_sampler), ray, ray_weight, u

    def _of_camera(self, job: Job, found: FoundPaths, ray, ray_weight, u) -> FilmSamples:
        rays = Cut(job.mode)
        paths = job.tracer.camera_paths(found, rays(ray))
        value, weight = Sample(mi.Spectrum(0), mi.Float(0)), dr.detach(ray_weight)
        return FilmSamples(u, value, ray.wavelengths, 1.0, job.weights, paths, weight, (rays,))

    def _of_lights(self, job: Job, found: FoundPaths, *_) -> FilmSamples:
        rays, seen = Cut(job.mode), found.from_light.way
        ray = camera_ray(job.sensor, seen.u, seen.lens)
        paths = job.tracer.light_paths_seen(found, rays(ray))
        value = Sample(mi.Spectrum(0), mi.Float(0))
        return FilmSamples(seen.u, value, ray.wavelengths, 0.0, 0, paths, mi.Spectrum(1), (rays,))


def camera_ray(sensor: mi.Sensor, u: mi.Point2f, lens: mi.Point2f) -> mi.RayDifferential3f:
    """The ray of a film position, pixels. lens : random numbers for a point of the lens."""
    film = sensor.film()
    size, offset = mi.ScalarVector2f(film.crop_size()), mi.ScalarVector2f(film.crop_offset())
    whole = Batch(sensor) if sensor.class_name() == "BatchSensor" else sensor
    with dr.resume_grad():
        ray, _ = whole.sample_ray_differential(
            time=sensor.shutter_open(), sample1=0, sample2=(u - offset) / size, sample3=lens
        )
    return ray
