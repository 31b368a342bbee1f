"""The lines at which the light of spots and projectors jumps, in the directions in which they shine. Points on them can
be chosen, where `texture_lines.py` can only tell on which side of a line a point is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.beams import off_texture
from rimlight.edge_sampling.geometry.texture_lines import Lattice, lines_of_beam
from rimlight.edge_sampling.lights import Lights

#: Arcs into which the circle is divided around the beam of a spot, so that they are about as long as other lines.
ARCS = 4

#: Lines of a lattice that are closer to a side of the picture, in parts of it, are the side.
AT_SIDE = 1e-5

#: Of a random number, what is left after a choice between so many lines tells a place on the line; else a new one does.
FEW = 256


class BeamLines:
    """The lines of each light: straight ones, and arcs of the circle around the beam of a spot, in coordinates of what
    would be the picture of the light (`on_texture`).

    Parameters
    ----------
    scene : mi.Scene
    lights : its lights.
    """

    DRJIT_STRUCT = dict.fromkeys(("_first", "_count", "_a", "_b", "_round"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene, lights: Lights):
        lines: list[tuple[Sequence[float], Sequence[float], bool]] = []
        first, count = [], []
        #: Lights that have some: their numbers in `Lights`, and the emitters.
        self.beams: list[tuple[int, mi.Emitter]] = []
        for number, i in enumerate(lights.emitter):
            emitter = scene.emitters()[i]
            own = [line for kind in lines_of_beam(emitter) for line in _lines(kind)]
            first.append(len(lines))
            count.append(len(own))
            lines += own
            self.beams += [(number, emitter)] if own else []
        self._first, self._count, self._most = mi.UInt32(first), mi.UInt32(count), max(count, default=0)
        a, b, is_round = zip(*lines, strict=True) if lines else ([], [], [])
        self._a, self._b = (mi.Float([float(x) for p in ends for x in p]) for ends in (a, b))
        self._round = mi.Bool(list(is_round))

    def choose(self, light: mi.UInt32, choice: mi.Float, sampler: mi.Sampler) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """A line of each light, a place t in [0, 1) on it, and the density of both.

        choice : uniform in [0, 1).
        """
        count = dr.gather(mi.UInt32, self._count, light)
        x = choice * count
        k = dr.minimum(mi.UInt32(x), count - 1)
        t = x - k if self._most <= FEW else sampler.next_1d()
        t = dr.clip(t, 0, dr.one_minus_epsilon(mi.Float))
        return dr.gather(mi.UInt32, self._first, light) + k, t, dr.rcp(mi.Float(count))

    def at(self, line: mi.UInt32, t: mi.Float) -> tuple[mi.Point2f, mi.Vector2f]:
        """The place of a point of a line in the picture, and its derivative by t."""
        a, b = (dr.gather(mi.Point2f, ends, line) for ends in (self._a, self._b))
        p, tangent = dr.lerp(a, b, t), mi.Vector2f(b - a)
        s, c = dr.sincos(p.x)
        is_round = dr.gather(mi.Bool, self._round, line)
        p = dr.select(is_round, mi.Point2f(0.5 + 0.5 * c, 0.5 + 0.5 * s), p)
        return p, dr.select(is_round, 0.5 * tangent.x * mi.Vector2f(-s, c), tangent)

    def ray(self, light: mi.UInt32, uv: mi.Point2f) -> tuple[mi.Point3f, mi.Vector3f]:
        """Where a light is, and the direction in which it throws this place of its picture, not normalised; attached to
        the light."""
        o, d = mi.Point3f(0), mi.Vector3f(0, 0, 1)
        for number, emitter in self.beams:
            to_world, local = mi.traverse(emitter)["to_world"], off_texture(emitter, uv)
            o = dr.select(light == number, to_world @ mi.Point3f(0), o)
            d = dr.select(light == number, to_world @ mi.Vector3f(local.x, local.y, 1), d)
        return o, d


def _lines(kind: object) -> Iterator[tuple[Sequence[float], Sequence[float], bool]]:
    """The lines at which a function is whole: two ends, of arcs their angles; and is it an arc?"""
    if isinstance(kind, Lattice):
        for row in kind.matrix:
            yield from ((a, b, False) for a, b in _parallels(*row.tolist()))
    elif kind.emitter.class_name() == "SpotLight":
        angles = np.linspace(0, 2 * np.pi, ARCS + 1)
        yield from (((a, 0), (b, 0), True) for a, b in pairwise(angles))
    else:
        corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
        yield from ((corners[k - 1], corners[k], False) for k in range(4))


def _parallels(a: float, b: float, c: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Where a u + b v + c is whole in the unit square, its sides left out: both ends of each line."""
    n = np.array([a, b])
    size = np.linalg.norm(n)
    if size == 0:
        return
    n, along = n / size, np.array([-n[1], n[0]]) / size
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) @ n
    for k in range(int(np.ceil(corners.min() * size + c)), int(np.floor(corners.max() * size + c)) + 1):
        p = n * (k - c) / size
        with np.errstate(divide="ignore", invalid="ignore"):
            to_sides = np.array([-p / along, (1 - p) / along])  # (side, coordinate)
        parallel = along == 0
        if (parallel & ((p <= 0) | (p >= 1))).any():
            continue
        to_sides = to_sides[:, ~parallel]
        start, end = to_sides.min(axis=0).max(), to_sides.max(axis=0).min()
        middle = p + 0.5 * (start + end) * along
        if start < end and (np.minimum(middle, 1 - middle) > AT_SIDE).all():
            yield p + start * along, p + end * along
