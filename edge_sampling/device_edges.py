"""The edges of a scene on the device: end points, and which of them are boundaries as seen from a point."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .edges import EdgeKind, Edges
from .meshes import Geometry

#: Faces whose normals differ by less (sine of the angle) count as coplanar; vertex normals, as equal.
COPLANAR = 1e-5


class DeviceEdges:
    """Topology of `Edges` as Dr.Jit arrays. Vertex positions are given with each call, since they change."""

    def __init__(self, edges: Edges):
        index = lambda a: mi.UInt32(np.ascontiguousarray(a))
        self.count = len(edges)
        self._ends = [[index(edges.vertices[:, side, k]) for k in (0, 1)] for side in (0, 1)]
        self._opposite = [index(edges.opposite[:, side]) for side in (0, 1)]
        self._kind = index(edges.kind)
        self._kinds = set(edges.kind)
        self._any_split = bool((edges.vertices[:, 0] != edges.vertices[:, 1]).any())

    def end_points(self, positions: mi.Float, edge: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
        """End points of edges, world space; of split vertices the mean, so that all copies have a gradient."""
        a, b = self._points_of_side(positions, edge, 0)
        if self._any_split:
            c, d = self._points_of_side(positions, edge, 1)
            a, b = 0.5 * (a + c), 0.5 * (b + d)
        return a, b

    def _points_of_side(self, positions, edge, side):
        return (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, self._ends[side][k], edge)) for k in (0, 1))

    def is_boundary(
        self,
        positions: mi.Float,
        edge: mi.UInt32,
        eye: mi.Point3f,
        *,
        view: mi.Vector3f | None = None,
        radius: mi.Float | float = 0.0,
        geometry: Geometry | None = None,
    ) -> mi.Bool:
        """Is the edge a silhouette, or does something else jump across it? Detached.

        eye, view : the point that looks, or the direction in which an orthographic sensor does.
        radius : of a lens around the eye: silhouettes from any of its points are taken.
        geometry : where given, creases between faces that are both visible count, too (they matter for radiance, not
            for occlusion).
        """
        kind = dr.gather(mi.UInt32, self._kind, edge)
        boundary = kind == int(EdgeKind.JUMP)
        if self._kinds <= {EdgeKind.JUMP}:
            return boundary
        a, b = self.end_points(positions, edge)
        towards = -view if view is not None else eye - a
        normal, sign = [], []
        for opposite in self._opposite:
            o = dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, opposite, edge))
            # Both normals turn about the edge in the same sense: seen edge-on from both sides, faces that overlap have
            # equal signs.
            normal.append(dr.cross(b - a, o - a))
            sign.append(dr.dot(normal[-1], towards))
            # Rounding, and a lens that sees around the edge, leave the sign open: such an edge is taken.
            boundary |= dr.abs(sign[-1]) <= dr.norm(normal[-1]) * (radius + 1e-6 * dr.norm(towards))
        boundary |= sign[0] * sign[1] > 0
        if geometry is not None and EdgeKind.FLAT in self._kinds:
            lengths = dr.squared_norm(normal[0]) * dr.squared_norm(normal[1])
            folded = dr.squared_norm(dr.cross(normal[0], normal[1])) > COPLANAR**2 * lengths
            boundary |= (kind == int(EdgeKind.FLAT)) & folded
        if geometry is not None and EdgeKind.SPLIT in self._kinds:
            normals = geometry.normals()
            for n0, n1 in zip(*(self._points_of_side(normals, edge, side) for side in (0, 1)), strict=True):
                boundary |= (kind == int(EdgeKind.SPLIT)) & (dr.squared_norm(n0 - n1) > COPLANAR**2)
        return boundary
