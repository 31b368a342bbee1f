"""Sensors that show several views on one film: `batch`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.refusals import Refusal

from .sensors import inside_frame, sampled_border


@dataclass(frozen=True)
class FilmPart:
    """A sensor, and where its own film lies on the film that is rendered.

    sensor : mi.Sensor, no `batch`.
    offset : of its film, pixels.
    scale : pixels of the film that is rendered for one of its own.
    """

    sensor: mi.Sensor
    offset: mi.ScalarVector2f
    scale: mi.ScalarVector2f

    @property
    def area(self) -> float:
        """Of one of its own pixels, in pixels of the film that is rendered."""
        return self.scale.x * self.scale.y

    def inside(self, u: mi.Point2f) -> mi.Bool:
        """Is a position on its own film on it, or where it is sampled around it?"""
        return inside_frame(u, self.sensor.film())

    def to_film(self, u: mi.Point2f) -> mi.Point2f:
        """A position on its own film, on the film that is rendered; pixels."""
        return u * self.scale + self.offset


def film_parts(sensor: mi.Sensor) -> list[FilmPart]:
    """The children of a `batch`, from left to right on its film; of any other sensor, itself.

    Raises
    ------
    RuntimeError : a film of a `batch`, or of one of its children, samples its border.
    """
    if sensor.class_name() != "BatchSensor":
        return [FilmPart(sensor, mi.ScalarVector2f(0), mi.ScalarVector2f(1))]
    children = _children(sensor)
    if any(sampled_border(s.film()) for s in (sensor, *children)):
        raise Refusal(
            f'film boundary: batch sensor "{sensor.id()}" samples the border of its film, where Mitsuba mixes up the '
            'views; set "sample_border" to false.'
        )
    film = sensor.film()
    size = mi.ScalarVector2f(film.crop_size()) / mi.ScalarVector2f(len(children), 1)
    start = mi.ScalarVector2f(film.crop_offset())
    # As `batch` has it, each child shows its whole film, whatever the crop window.
    return [
        FilmPart(s, start + mi.ScalarVector2f(i * size.x, 0), size / mi.ScalarVector2f(s.film().size()))
        for i, s in enumerate(children)
    ]


class Batch:
    """A `batch` sensor whose rays its children make one after the other: the same rays as its own.

    Its own virtual function calls cannot be differentiated: Dr.Jit 1.5 aborts in forward mode.
    """

    def __init__(self, sensor: mi.Sensor):
        self._sensor = sensor
        self._children = [part.sensor for part in film_parts(sensor)]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sensor, name)

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        x = sample2.x * len(self._children)
        index = dr.minimum(mi.UInt32(x), len(self._children) - 1)
        sample2 = mi.Point2f(x - mi.Float(index), sample2.y)
        made, *others = (c.sample_ray_differential(time, sample1, sample2, sample3, active) for c in self._children)
        for i, other in enumerate(others, 1):
            made = dr.select(index == i, other, made)
        return made


def _children(sensor: mi.Sensor) -> list[mi.Sensor]:
    found = []

    class Children(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Sensor):
                found.append(value)

        put_value = put_object = put

    sensor.traverse(Children())
    return found
