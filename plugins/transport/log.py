"""The vertices of paths, written down, so that they can be visited again from either end."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.refusals import Refusal

from .paths import Vertex
from .scattering import Next, Numbers


class Log:
    """A table of the vertices of paths: for each sample and each number along the path, at most 96 bytes.

    like : mi.Ray3f, of the time and the wavelengths of the paths.
    first, last : numbers of the vertices that it has room for.

    Raises
    ------
    RuntimeError : it would have more numbers than 32 bits can count.
    """

    def __init__(self, scene: mi.Scene, like: mi.Ray3f, first: int, last: int):
        self.time, self.wavelengths = like.time, like.wavelengths
        self.width, self.first, self.last = dr.width(like.o), first, last
        width = self.width
        n = width * max(last + 1 - first, 1)
        if n * max(3, dr.size_v(mi.Spectrum)) >= 2**32:
            raise Refusal(
                f"{width} samples of paths of up to {last} vertices are more than a table can hold: use fewer samples "
                'per pixel and average several seeds, or a lower "max_depth"'
            )
        floats = {"o": 3, "d": 3, "t": 1, "uv": 2, "light": 2, "lobe": 1, "direction": 2}
        self._floats = {name: dr.empty(mi.Float, n * size) for name, size in floats.items()}
        instances = any(s.class_name() == "Instance" for s in scene.shapes())
        whole = ("prim", "shape", *(("shape_index", "instance") if instances else ()))
        self._whole = {name: dr.empty(mi.UInt32, n) for name in whole}
        self._β = dr.empty(mi.Float, n * dr.size_v(mi.Spectrum))
        #: `Vertex.lit`, where it is noted.
        self._lit: mi.Float | None = None

    def _row(self, depth: mi.UInt32) -> mi.UInt32:
        return (depth - self.first) * self.width + dr.arange(mi.UInt32, self.width)

    def arrive(self, depth: mi.UInt32, vertex: Vertex | Next, active: mi.Bool) -> None:
        """Note the ray to a vertex, and what it meets."""
        row, active = self._row(depth), active & (depth <= self.last)
        ray, pi = vertex.ray, vertex.pi
        # The sign of the distance says whether a mirror shows it; the last bit of the triangle, whether it slides.
        t = dr.select(vertex.mirrored, -pi.t, pi.t)
        prim = (pi.prim_index << 1) | dr.select(vertex.slides, mi.UInt32(1), 0)
        for name, value in {"o": ray.o, "d": ray.d, "t": t, "uv": pi.prim_uv}.items():
            dr.scatter(self._floats[name], value, row, active, mode=dr.ReduceMode.NoConflicts)
        whole = {"prim": prim, "shape": pi.shape, "shape_index": pi.shape_index, "instance": pi.instance}
        for name, target in self._whole.items():
            value = whole[name]
            value = value if isinstance(value, mi.UInt32) else dr.reinterpret_array(mi.UInt32, value)
            dr.scatter(target, value, row, active, mode=dr.ReduceMode.NoConflicts)

    def make_room_for_lit(self) -> None:
        """To be called before the first vertex, if `Vertex.lit` is to be noted."""
        self._lit = dr.empty(mi.Float, dr.width(self._β))

    def leave(
        self, depth: mi.UInt32, β: mi.Spectrum, numbers: Numbers, active: mi.Bool, lit: mi.Spectrum | None = None
    ) -> None:
        """Note the throughput to a vertex, and its random numbers. lit : see `Vertex`."""
        row, active = self._row(depth), active & (depth <= self.last)
        dr.scatter(self._β, β, row, active, mode=dr.ReduceMode.NoConflicts)
        if self._lit is not None:
            dr.scatter(self._lit, lit, row, active, mode=dr.ReduceMode.NoConflicts)
        for name in ("light", "lobe", "direction"):
            dr.scatter(self._floats[name], getattr(numbers, name), row, active, mode=dr.ReduceMode.NoConflicts)

    def close(self) -> None:
        """All is written."""
        dr.eval(self._floats, self._whole, self._β, self._lit)

    def vertex(self, depth: mi.UInt32, active: mi.Bool) -> Vertex:
        """What was noted on arrival. Its β is 1."""
        row = self._row(depth)
        number = lambda kind, name: dr.gather(kind, self._floats[name], row, active)
        whole = lambda name: dr.gather(mi.UInt32, self._whole[name], row, active)
        t = number(mi.Float, "t")
        ray = mi.Ray3f(number(mi.Point3f, "o"), number(mi.Vector3f, "d"), self.time, self.wavelengths)
        pi = dr.zeros(mi.PreliminaryIntersection3f, self.width)
        pi.t = dr.select(active, dr.abs(t), dr.inf)
        pi.valid = dr.isfinite(pi.t)
        prim = whole("prim")
        pi.prim_uv, pi.prim_index = number(mi.Point2f, "uv"), prim >> 1
        pi.shape = dr.reinterpret_array(mi.ShapePtr, whole("shape"))
        if "instance" in self._whole:
            pi.shape_index = whole("shape_index")
            pi.instance = dr.reinterpret_array(mi.ShapePtr, whole("instance"))
        return Vertex(ray, pi, depth, mi.Spectrum(1), mi.Float(1), t < 0, (prim & 1) != 0)

    def throughput(self, depth: mi.UInt32, active: mi.Bool) -> tuple[mi.Spectrum, mi.Spectrum]:
        """To a vertex: β, and `Vertex.lit`."""
        β, lit = self._β, self._β if self._lit is None else self._lit
        return tuple(dr.gather(mi.Spectrum, source, self._row(depth), active) for source in (β, lit))

    def numbers(self, depth: mi.UInt32, active: mi.Bool) -> Numbers:
        row = self._row(depth)
        kinds = {"light": mi.Point2f, "lobe": mi.Float, "direction": mi.Point2f}
        return Numbers(*(dr.gather(kind, self._floats[name], row, active) for name, kind in kinds.items()))
