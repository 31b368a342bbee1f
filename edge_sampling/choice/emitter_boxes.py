"""Boxes around the lights of a scene, and the cones of directions in which they are seen."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.boxes import box_of
from rimlight.edge_sampling.geometry.meshes import Geometry

from .views import Cone

#: Cones are wider than they need be by this part of their sine, so that rounding loses no direction.
SLACK = 1e-3


class EmitterBoxes:
    """The boxes of all emitters, in the order of the scene; those of meshes follow their vertices.

    Parameters
    ----------
    scene : mi.Scene
    geometry : its meshes.
    """

    DRJIT_STRUCT = dict.fromkeys(("lower", "upper", "_lower", "_upper", "_vertex", "_emitter"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene, geometry: Geometry):
        self._shapes = [e.get_shape() for e in scene.emitters()]
        offsets = np.cumsum([0, *(m.vertex_count() for m in geometry.meshes)])
        offset_of = {int(m.ptr): int(offset) for m, offset in zip(geometry.meshes, offsets, strict=False)}
        self._is_mesh = [s is not None and int(s.ptr) in offset_of for s in self._shapes]
        vertex, emitter = [], []
        for i, shape in enumerate(self._shapes):
            if self._is_mesh[i]:
                vertex.append(np.arange(shape.vertex_count()) + offset_of[int(shape.ptr)])
                emitter.append(np.full(shape.vertex_count(), i))
        self._vertex, self._emitter = (
            mi.UInt32(np.concatenate(parts).astype(np.uint32)) if parts else None for parts in (vertex, emitter)
        )
        self._found: np.ndarray | None = None
        self.find_shapes()

    def find_shapes(self) -> None:
        """Find where the lights that are no meshes are now. On the host, so not in frozen functions."""
        lower, upper = [], []
        for shape, is_mesh in zip(self._shapes, self._is_mesh, strict=True):
            box = (np.full(3, -np.inf), np.full(3, np.inf))
            if is_mesh:
                box = box[::-1]
            elif shape is not None:
                found = box_of(shape)
                box = (np.array(found.min), np.array(found.max))
            lower.append(box[0])
            upper.append(box[1])
        # Where there is none, one that counts as everything: Dr.Jit 1.5 cannot freeze empty arrays.
        found = np.array([np.ravel(lower or [-np.inf] * 3), np.ravel(upper or [np.inf] * 3)], np.float32)
        if self._found is not None and (found == self._found).all():
            return  # the same arrays: frozen functions need not be recorded again
        self._found = found
        # Not in NumPy's memory, for frozen functions.
        self._lower, self._upper = (mi.Float(row) * dr.opaque(mi.Float, 1) for row in found)
        dr.eval(self._lower, self._upper)
        self.lower, self.upper = self._lower, self._upper

    def refit(self, positions: mi.Float) -> None:
        """Follow the vertices to `positions`, (3 V,), world space; detached."""
        if self._vertex is None:
            return
        p = dr.gather(mi.Point3f, positions, self._vertex)
        self.lower, self.upper = mi.Float(self._lower), mi.Float(self._upper)
        for k in range(3):
            dr.scatter_reduce(dr.ReduceOp.Min, self.lower, p[k], 3 * self._emitter + k)
            dr.scatter_reduce(dr.ReduceOp.Max, self.upper, p[k], 3 * self._emitter + k)

    def distance(self, emitter: mi.UInt32, x: mi.Point3f) -> mi.Float:
        """How far emitters are from x, at least."""
        lower, upper = (dr.gather(mi.Point3f, bounds, emitter) for bounds in (self.lower, self.upper))
        return dr.norm(dr.maximum(dr.maximum(lower - x, x - upper), 0))

    def cone(self, emitter: mi.UInt32, x: mi.Point3f) -> Cone:
        """The directions in which emitters may be seen from x, world space."""
        lower, upper = (dr.gather(mi.Point3f, bounds, emitter) for bounds in (self.lower, self.upper))
        axis = dr.normalize(0.5 * (lower + upper) - x)
        sin, ahead = mi.Float(0), dr.isfinite(dr.squared_norm(axis))
        for k in range(8):
            corner = mi.Point3f(*(upper[i] if k >> i & 1 else lower[i] for i in range(3)))
            d = dr.normalize(corner - x)
            # By the cross product: the angle may be very small.
            sin = dr.maximum(sin, dr.norm(dr.cross(axis, d)))
            ahead &= dr.dot(axis, d) > 0.1
        sin = dr.minimum(sin * (1 + SLACK) + 1e-6, 1)
        axis = dr.select(ahead, axis, mi.Vector3f(0, 0, 1))
        return Cone(axis, dr.select(ahead, dr.sqrt(1 - sin * sin), -1), sin)
