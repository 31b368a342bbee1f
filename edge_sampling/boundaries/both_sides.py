"""Rays that look at both sides of points of the film boundary."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.beside import clear_of_overhang, compare_depth, rounding

from .film_outlines import Placed
from .tracer import Tracer

#: Rays on both sides, their weights, and what they meet.
Looked = tuple[list, list, list]


class Beside:
    """Looks beside points of the film.

    u, n : mi.Point2f and mi.Vector2f, pixels: the points, and in which direction to look beside them.
    sampler : for what the rays need besides. All of them have the same numbers.
    """

    def __init__(self, tracer: Tracer, at: Placed, sensor: mi.Sensor, u, n, sampler: mi.Sampler):
        self._tracer, self._at, self._sensor, self._u, self._n = tracer, at, sensor, u, n
        self._time = mi.Float(sensor.shutter_open())
        if sensor.shutter_open_time() > 0:
            self._time += sampler.next_1d() * sensor.shutter_open_time()
        self._wavelength = sampler.next_1d() if mi.is_spectral else 0.0

    def at(self, offset: mi.Float, active: mi.Bool) -> Looked:
        """At the positions u − offset n and u + offset n, pixels."""
        projection, lens = self._at.projection, self._at.aperture_sample
        lens = mi.Point2f(0.5) if lens is None else lens
        made = []
        for sign in (-1, 1):
            on_film = (self._u + sign * offset * self._n - projection.crop_offset) / projection.crop_size
            made.append(self._sensor.sample_ray_differential(self._time, self._wavelength, on_film, lens, active))
        rays, weights = ([of[k] for of in made] for k in (0, 1))
        return rays, weights, [self._tracer.first_hit(ray, active) for ray in rays]

    def clear_of_overhangs(self, p: mi.Point3f, aside: mi.Float, looked: Looked, active: mi.Bool) -> Looked:
        """From farther aside, where both rays meet surfaces on which p lies, and one leans over the other: as at the
        foot of a wall that leans outward. See `clear_of_overhang`.

        aside : from how far aside `looked` is, pixels.
        """
        rays, _, met = looked
        touching, surfaces = self._meet_at(p, rays, met, active)
        projection = self._at.projection
        clear = clear_of_overhang(self._tracer.scene, p, rays, surfaces)
        clear *= projection.pixels_per_unit(projection.film(p))
        farther = touching & (clear > aside)
        again = self.at(clear, farther)
        farther, _ = self._meet_at(p, again[0], again[2], farther)
        chosen = tuple(
            [dr.select(farther, there, here) for there, here in zip(*pair, strict=True)]
            for pair in zip(again, looked, strict=True)
        )
        for new, ray in zip(chosen[0], rays, strict=True):
            new.has_differentials = ray.has_differentials  # which `dr.select` forgets
        return chosen

    @staticmethod
    def _meet_at(p: mi.Point3f, rays: list, met: list, active: mi.Bool) -> tuple[mi.Bool, list]:
        """Does p lie in the planes of both surfaces that two rays meet? And these surfaces."""
        surfaces = []
        for ray, pi in zip(rays, met, strict=True):
            surfaces.append(pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active))
            active = active & compare_depth(p, ray, surfaces[-1], rounding(p, ray.o))[0]
        return active, surfaces
