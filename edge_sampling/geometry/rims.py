"""Rims of cylinders and disks that coincide, as where a disk closes a cylinder: one edge with two faces, as between
triangles, and not two open edges.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .curves import CURVES, RIMS, CurveKind
from .meshes import Geometry

#: Rims coincide if they are nowhere farther apart than so many times what single precision can tell apart.
APART = 16

#: Points of a rim that are compared.
POINTS = 8

#: A rim: what it is, and the number of its shape in `Geometry.analytic`.
Rim = tuple[CurveKind, int]


class Rims:
    """Finds which rims coincide.

    Parameters
    ----------
    geometry : the shapes.
    """

    def __init__(self, geometry: Geometry):
        kinds = [(kind, i) for i, s in enumerate(geometry.analytic) for kind in CURVES[s.class_name()]]
        rims = [(kind, i) for kind, i in kinds if kind in RIMS]
        #: Cylinders first: of several rims, two of cylinders are the two sides.
        self._rims: list[Rim] = sorted(rims, key=lambda rim: rim[0] == CurveKind.RIM)
        self._analytic = geometry.analytic
        #: `to_world` of the shapes that have rims, when these were found.
        self._held: dict[int, list[mi.Float]] = {}
        #: Rims that coincide, two or more: the first two are the sides of the edge. See `Geometry.joints`.
        self.joints: tuple[tuple[Rim, ...], ...] = ()

    def find(self) -> bool:
        """Find them, as the shapes are now; return whether they have changed. On the host: not in frozen functions.
        Reads from the device where a shape has moved."""
        shapes = {i: self._analytic[i] for _, i in self._rims}
        if len(shapes) < 2 or all(kind == CurveKind.RIM for kind, _ in self._rims):
            return False
        with dr.suspend_grad():
            now = {i: _entries(s) for i, s in shapes.items()}
        if self._held and all(a.index == b.index for i in now for a, b in zip(now[i], self._held[i], strict=True)):
            return False
        before, self._held = self.joints, now
        rows = dr.concat([x for entries in now.values() for x in entries]).numpy().astype(np.float64)
        self.joints = self._find(dict(zip(now, rows.reshape(-1, 3, 4), strict=True)))
        return self.joints != before

    def _find(self, matrices: dict[int, np.ndarray]) -> tuple[tuple[Rim, ...], ...]:
        """matrices : `to_world` of the shapes that have rims, (3, 4)."""
        points = np.array([_on_rim(kind, matrices[i]) for kind, i in self._rims])
        tolerance = APART * np.finfo(np.float32).eps * np.abs(points).max((1, 2))
        pairs = cKDTree(points.mean(1)).query_pairs(tolerance.max(), output_type="ndarray")
        same = np.zeros(len(pairs), bool)
        for k, (a, b) in enumerate(pairs):
            kind, i = self._rims[b]
            axes, origin = matrices[i][:, :3], matrices[i][:, 3]
            x, y, _ = np.linalg.pinv(axes) @ (points[a] - origin).T
            nearest = _on_rim(kind, matrices[i], np.arctan2(y, x))
            same[k] = np.linalg.norm(nearest - points[a], axis=1).max() <= tolerance[a]
        graph = coo_array((np.ones(same.sum()), tuple(pairs[same].T)), shape=2 * (len(self._rims),))
        _, group = connected_components(graph, directed=False)
        groups = (np.flatnonzero(group == g) for g in np.flatnonzero(np.bincount(group) > 1))
        return tuple(tuple(self._rims[k] for k in members) for members in groups)


def _entries(shape: mi.Shape) -> list[mi.Float]:
    """`to_world`: 12 numbers, row by row; detached."""
    m = mi.traverse(shape)["to_world"].matrix
    return [dr.detach(mi.Float(m[i, j])) for i in range(3) for j in range(4)]


def _on_rim(kind: CurveKind, matrix: np.ndarray, φ: np.ndarray | None = None) -> np.ndarray:
    """Points of a rim at the angles φ in the frame of the shape, or all around: (N, 3), world space."""
    φ = 2 * np.pi * np.arange(POINTS) / POINTS if φ is None else φ
    local = np.stack([np.cos(φ), np.sin(φ), np.full_like(φ, kind == CurveKind.TOP)], 1)
    return local @ matrix[:, :3].T + matrix[:, 3]
