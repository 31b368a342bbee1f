"""What passes over the film, of surfaces whose points are held, as a term."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import Projection
from rimlight.edge_sampling.projection.sensors import frame
from rimlight.transport.chain_rays import FilmRays

from .sampling import in_a_row, seed_of, size
from .term import FilmSamples, Job, Sample, Term

#: Steps in which a reconstruction filter is tabulated, to choose places from: of its radius.
STEPS = 64

#: What passes, in plans.
WHAT = "fine textures, or polished curved shapes, move over the film"

#: Between which the slope of a filter is measured, pixels.
BESIDE = 2**-9


class PassingTerm(Term):
    """Surfaces whose points are held (`edge_sampling/first_points.py`) pass over the film with the velocity u̇. To a
    pixel with the filter k, that adds ∫ L ∇k · u̇ du, and where the film ends, it loses what leaves it.

    Places on both sides of the middle of a pixel, where the slope of its filter is opposite, are looked at with equal
    random numbers: what they have in common cancels. For the box filter, they are on the borders of the pixel.
    """

    name, of_property = "passing surfaces", "sppp"

    def planned(self, job: Job) -> PlannedTerm:
        makers = len(self.samples(job))
        film = job.sensor.film()
        count = 0
        if makers:
            width, height = film.crop_size()
            count = 2 * each_way(job) * width * height + (makers > 1) * 2 * sum(size(film)) * job.counts.film
        return self.plan(count, 2 * job.rays_of_path, WHAT, "none does that")

    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        if job.tracer.held is None:
            return []
        inside = partial(self._over_borders, job)
        return [inside] if job.sensor.film().rfilter().is_box_filter() else [inside, partial(self._off_film, job)]

    def _over_borders(self, job: Job) -> FilmSamples:
        """In and out of each pixel, along both axes."""
        film, each = job.sensor.film(), each_way(job)
        width, height = (int(n) for n in film.crop_size())
        count = 2 * each * width * height
        sampler = in_a_row(job.sensor, seed_of(self.name, job.seed), count)
        lane = dr.arange(mi.UInt32, count)
        pixel, of_pixel = lane // (2 * each), lane % (2 * each)
        middle = mi.Point2f(pixel % width, pixel // width) + 0.5 + mi.ScalarVector2f(film.crop_offset())
        off, aside, slope = slope_sample(film.rfilter(), (of_pixel // 2 + sampler.next_1d()) / each, sampler)
        along_x = of_pixel % 2 == 0
        axis = mi.Vector2f(dr.select(along_x, mi.Float(1), 0), dr.select(along_x, mi.Float(0), 1))
        middle_of_both = middle + aside * mi.Vector2f(axis.y, axis.x)
        rays, sides = FilmRays(job.sensor, sampler), []
        for sign in (1, -1):
            u = middle_of_both + sign * off * axis
            sides.append(self._passing(job, rays, u, sign * slope * axis, sampler.clone()))
        with dr.resume_grad():
            value = Sample((sides[0] + sides[1]) * (job.weights / each), mi.Float(0))
        return FilmSamples(middle, value, rays.at(middle)[0].wavelengths, 0.0, 0, one_pixel=True)

    def _off_film(self, job: Job) -> FilmSamples:
        """Out of what is sampled: at its border, filters that are wider than a pixel have not come to their end."""
        film, spp = job.sensor.film(), job.counts.film
        (width, height), lower = map(float, size(film)), mi.ScalarPoint2f(frame(film)[0])
        count = 2 * sum(size(film)) * spp
        sampler = in_a_row(job.sensor, seed_of(self.name, job.seed, 1), count)
        s = (dr.arange(mi.Float, count) + sampler.next_1d()) / spp
        upright = s >= 2 * width
        s -= dr.select(upright, 2 * width, 0)
        length = dr.select(upright, mi.Float(height), width)
        far = mi.Float(s >= length)
        s -= far * length
        u = lower + mi.Point2f(dr.select(upright, far * width, s), dr.select(upright, s, far * height))
        inwards = (1 - 2 * far) * mi.Vector2f(mi.Float(upright), mi.Float(~upright))
        rays = FilmRays(job.sensor, sampler)
        passing = self._passing(job, rays, u, inwards, sampler)
        with dr.resume_grad():
            value = Sample(passing * (job.weights / spp), mi.Float(0))
        return FilmSamples(u, value, rays.at(u)[0].wavelengths, 0.0, 0)

    @staticmethod
    def _passing(job: Job, rays: FilmRays, u: mi.Point2f, n: mi.Vector2f, sampler: mi.Sampler) -> mi.Spectrum:
        """L n · u̇ at the positions u: zero, with its gradient."""
        sensor, held = job.sensor, job.tracer.held
        ray, weight = rays.at(u)
        ray, weight = dr.detach(ray), dr.detach(weight)
        pi = job.tracer.first_hit(ray, True)
        lower, upper = frame(sensor.film())
        there = held.are(ray, pi, dr.all((u >= lower) & (u <= upper)))
        L, _ = job.tracer.seen(ray, pi, sampler, there, None, None)
        L = dr.select(there, L * weight, 0)
        # The gradient of each number of the sensor is a kernel of its own: let none of them trace rays again.
        dr.eval(L, pi, ray, there, n)
        with dr.resume_grad():
            lens = rays.lens if sensor.needs_aperture_sample() else None
            return L * dr.dot(n, held.velocity(ray, pi, there, Projection(sensor), lens))


def each_way(job: Job) -> int:
    """Pairs of samples in each pixel, along each axis."""
    return -(-job.counts.film // 2)


def slope_sample(rfilter: mi.ReconstructionFilter, number: mi.Float, sampler: mi.Sampler) -> tuple:
    """A place where a filter of two dimensions slopes: how far from the middle, ≥ 0, along an axis along which it
    slopes; how far along the other one; and the slope there, over the density of such places of that sign. Pixels.

    number : uniform in [0, 1): along the border of the box filter, else from the middle.
    """
    if rfilter.is_box_filter():
        return mi.Float(0.5), number - 0.5, mi.Float(-1)
    radius = rfilter.radius()
    slope_at = lambda x: (rfilter.eval(x + BESIDE) - rfilter.eval(x - BESIDE)) / (2 * BESIDE)
    off, density = _tabulated(lambda x: dr.abs(slope_at(x)), radius, number, sampler.next_1d())
    other = 2 * sampler.next_1d() - 1
    aside, density_aside = _tabulated(lambda x: dr.abs(rfilter.eval(x)), radius, dr.abs(other), sampler.next_1d())
    slope = slope_at(off) * rfilter.eval(aside) / (density * 0.5 * density_aside)
    return off, dr.mulsign(aside, other), slope


def _tabulated(f: Callable[[mi.Float], mi.Float], radius: float, a: mi.Float, b: mi.Float) -> tuple[mi.Float, mi.Float]:
    """A number between 0 and the radius, about in proportion to f, and its density. a, b : uniform in [0, 1)."""
    values = f((dr.arange(mi.Float, STEPS) + 0.5) * (radius / STEPS))
    values += 1e-3 * dr.max(values)
    sums = dr.cumsum(values)
    dr.eval(values, sums)
    total = dr.gather(mi.Float, sums, STEPS - 1)
    step = dr.binary_search(0, STEPS - 1, lambda i: dr.gather(mi.Float, sums, i) <= a * total)
    return (step + b) * (radius / STEPS), dr.gather(mi.Float, values, step) / total * (STEPS / radius)
