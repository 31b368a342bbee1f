"""The vertices of subpaths, written down, so that whole paths can be put together from them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class VertexTable:
    """A table of the vertices of subpaths: for each sample and each number along it, 28 bytes; 4 more if there are
    mirrors, and 8 more if there are instances.

    width : number of samples. last : number of the last vertex that it has room for; the first is 1.
    """

    def __init__(self, scene: mi.Scene, width: int, last: int):
        self.width, self.last = width, max(last, 1)
        n = width * self.last
        self._p, self._uv = dr.empty(mi.Float, 3 * n), dr.empty(mi.Float, 2 * n)
        mirrors = any(s.bsdf() is None or s.bsdf().flags() & mi.BSDFFlags.Delta for s in scene.shapes())
        self._lobe = dr.empty(mi.Float, n) if mirrors else None
        instances = any(s.class_name() == "Instance" for s in scene.shapes())
        names = ("prim", "shape", *(("shape_index", "instance") if instances else ()))
        self._whole = {name: dr.empty(mi.UInt32, n) for name in names}

    def note(
        self,
        number: mi.UInt32,
        p: mi.Point3f,
        pi: mi.PreliminaryIntersection3f,
        mirrors: mi.Bool,
        lobe: mi.Float,
        active: mi.Bool,
    ) -> None:
        """A vertex of each sample.

        mirrors : does the subpath go on from there as a perfect mirror or smooth glass has it? lobe : then, the random
        number by which that was chosen.
        """
        row, active = self._row(dr.arange(mi.UInt32, self.width), number), active & (number <= self.last)
        dr.scatter(self._p, p, row, active, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(self._uv, pi.prim_uv, row, active, mode=dr.ReduceMode.NoConflicts)
        if self._lobe is not None:
            dr.scatter(self._lobe, lobe, row, active, mode=dr.ReduceMode.NoConflicts)
        prim = (pi.prim_index << 1) | dr.select(mirrors, mi.UInt32(1), 0)
        whole = {"prim": prim, "shape": pi.shape, "shape_index": pi.shape_index, "instance": pi.instance}
        for name, target in self._whole.items():
            value = whole[name]
            value = value if isinstance(value, mi.UInt32) else dr.reinterpret_array(mi.UInt32, value)
            dr.scatter(target, value, row, active, mode=dr.ReduceMode.NoConflicts)

    def close(self) -> None:
        """All is written."""
        dr.eval(self._p, self._uv, self._lobe, self._whole)

    def vertex(
        self, lane: mi.UInt32, number: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Point3f, mi.PreliminaryIntersection3f, mi.Bool]:
        """What was noted. The distance of the intersection is not known: it is 0, or infinite where nothing is."""
        row = self._row(lane, number)
        pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(row))
        pi.t = dr.select(active, mi.Float(0), dr.inf)
        pi.valid = mi.Bool(active)
        whole = {name: dr.gather(mi.UInt32, values, row, active) for name, values in self._whole.items()}
        pi.prim_uv, pi.prim_index = dr.gather(mi.Point2f, self._uv, row, active), whole["prim"] >> 1
        pi.shape = dr.reinterpret_array(mi.ShapePtr, whole["shape"])
        if "instance" in whole:
            pi.shape_index = whole["shape_index"]
            pi.instance = dr.reinterpret_array(mi.ShapePtr, whole["instance"])
        return dr.gather(mi.Point3f, self._p, row, active), pi, active & ((whole["prim"] & 1) != 0)

    def lobe(self, lane: mi.UInt32, number: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The random number of a vertex that mirrors."""
        return dr.gather(mi.Float, self._lobe, self._row(lane, number), active)

    def _row(self, lane: mi.UInt32, number: mi.UInt32) -> mi.UInt32:
        return (number - 1) * self.width + lane
