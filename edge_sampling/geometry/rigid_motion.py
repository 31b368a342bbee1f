"""Which meshes have only moved as a whole, and which have changed their shape?"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .beside import rounding
from .meshes import Geometry, vertices


class Shapes:
    """The shapes of meshes, as they were when they were last found to be new.

    Three vertices of a mesh, and the normal of their plane, are a frame. If all of its vertices have kept their place
    in it, up to rounding, the mesh has moved, turned, or been scaled alike in all directions.
    """

    def __init__(self, geometry: Geometry):
        self._frames = [_far_apart(vertices(m)) for m in geometry.meshes]
        self._before: list[mi.Float | None] = [None] * len(geometry.meshes)

    def changed(self, positions: list[mi.Float]) -> set[int]:
        """The meshes that have another shape than before; at first, all. Reads from the device.

        positions : of the vertices of each mesh, (3 V,), detached.
        """
        pairs = zip(self._before, positions, strict=True)
        asked = [i for i, (old, new) in enumerate(pairs) if old is not None and old.index != new.index]
        changed = {i for i, old in enumerate(self._before) if old is None}
        if asked:
            flags = dr.concat([mi.UInt32(self._differs(i, positions[i])) for i in asked])
            changed |= {i for i, flag in zip(asked, flags.numpy().tolist(), strict=True) if flag}
        for i in changed:
            self._before[i] = positions[i]
        return changed

    def _differs(self, mesh: int, positions: mi.Float) -> mi.Bool:
        here = []
        for p in (self._before[mesh], positions):
            o, a, b = (dr.gather(mi.Point3f, p, dr.opaque(mi.UInt32, v)) for v in self._frames[mesh])
            across = dr.cross(a - o, b - o)
            axes = mi.Matrix3f(a - o, b - o, across * dr.rsqrt(dr.norm(across)))
            here.append((o, axes.T, dr.unravel(mi.Point3f, p)))
        (old_origin, old, before), (origin, new, now) = here
        expected = origin + new @ (dr.rcp(old) @ (before - old_origin))
        return dr.any(~(dr.norm(expected - now) <= rounding(before, now)))


def _far_apart(p: np.ndarray) -> tuple[int, int, int]:
    """Three vertices of (V, 3) that are far from one another, and from being on one line."""
    a = int(np.argmax(np.linalg.norm(p - p[0], axis=1)))
    return 0, a, int(np.argmax(np.linalg.norm(np.cross(p - p[0], p[a] - p[0]), axis=1)))
