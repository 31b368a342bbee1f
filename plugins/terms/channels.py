"""The terms of channels besides light: interior, and film boundary."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling import FilmPart
from rimlight.transport.channels import LABELS
from rimlight.transport.cut import Cut

from .film import FilmTerm
from .interior import InteriorTerm
from .sampling import in_a_row, over_film, seed_of
from .term import FilmSamples, Job


@dataclass
class ChannelSample:
    """The channels of film samples, or their derivatives: `values`, mi.Float, (N,), one for each component."""

    values: list

    @property
    def channels(self) -> list:
        """Numbers of the film besides light, which is black."""
        return list(self.values)

    @property
    def L(self) -> mi.Spectrum:
        return dr.zeros(mi.Spectrum, dr.width(self.values))

    @property
    def alpha(self) -> mi.Float:
        return mi.Float(0)

    def zeros(self, width: int) -> ChannelSample:
        return ChannelSample([dr.zeros(mi.Float, width) for _ in self.values])


class ChannelsTerm(InteriorTerm):
    """What rays that are fixed on the film meet."""

    name = "interior of channels"

    def _samples(self, job: Job) -> FilmSamples:
        sampler, _ = over_film(job.sensor, job.seed, job.counts.weights)
        ray, weight, position = job.sample_rays(sampler)
        shared = ray.wavelengths, 1.0, job.weights
        if not job.counts.interior:
            return FilmSamples(position, ChannelSample([mi.Float(0)] * job.tracer.count), *shared)
        # Differences of neighbouring rays lose their digits where the gradients of these are summed one by one.
        rays = Cut(dr.ADMode.Forward if job.tracer.needs_differentials else job.mode)
        # A sensor that shows nothing there, as outside of a fisheye's circle, has a weight of zero.
        values = job.tracer.values(rays(job.tracer.sized(ray)), dr.any(weight != 0), attached=True)
        return FilmSamples(position, ChannelSample(values), *shared, cuts=(rays,))


class ChannelsOnFilmTerm(FilmTerm):
    """Edges that move over the film, on each of its parts: channels jump where the surfaces on both sides differ."""

    name = "film boundary of channels"

    def _samples(self, job: Job, i: int, part: FilmPart) -> FilmSamples:
        tracer, count = job.tracer, job.counts.on_line(part.sensor.film())
        sampler = in_a_row(job.sensor, seed_of("film boundary", job.seed, i), count)
        points = job.boundaries.film.points(tracer, part.sensor, sampler, count)
        shown = [points.active & dr.any(weight != 0) for weight in points.weights]
        rays = [tracer.sized(ray) for ray in points.rays]
        met = zip(rays, shown, points.met, strict=True)
        sides = [tracer.values(ray, on, attached=False, pi=pi) for ray, on, pi in met]
        jumps = [first - second for first, second in zip(*sides, strict=True)]
        labels = [c.kind in LABELS for c in tracer.channels for _ in c.components]
        jumps = [mi.Float(0) if label else jump for jump, label in zip(jumps, labels, strict=True)]
        if points.sensor_moves:
            # The gradient of each number of the sensor is a kernel of its own: let none of them trace rays again.
            dr.eval(jumps, points.n_dl)
        with dr.resume_grad():
            normal_velocity = dr.dot(points.n_dl, points.velocity) * (job.weights * part.area)
            value = ChannelSample([jump * normal_velocity for jump in jumps])
            return FilmSamples(part.to_film(points.position), value, points.rays[1].wavelengths, 0.0, 0)
