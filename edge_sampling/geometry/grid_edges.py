"""The edges that stand for the surface of a grid: its creases, and the silhouettes of its triangles."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .edges import Edges
from .grids import creases_of, is_grid, slack_of
from .meshes import Geometry

#: Beside edges that stand for the surface of a grid, in units of how far that is from them.
GRID = 1.25

#: At which cosine between its normal and that of a crease the surface of a grid is met there.
ALIKE = 0.5


class GridEdges:
    """Which of the edges of a scene are those of grids, and how far from them the surface is.

    geometry, edges : all of them.
    """

    DRJIT_STRUCT = dict.fromkeys(("any", "_slack", "_sag", "_across", "_open"))  # for `dr.freeze`

    def __init__(self, geometry: Geometry, edges: Edges):
        ends = edges.vertices[:, 0]
        grids = np.array([is_grid(m) for m in geometry.meshes] or [False])[edges.mesh].all(1) & ~edges.is_line
        #: Are there such edges?
        self.any = bool(grids.any())
        self._slack = self._sag = self._across = self._open = None
        if not self.any:
            return
        number = lambda a: mi.Float(np.array(a, np.float32))
        #: How far the surface is from each; negative: it is not of a grid.
        self._slack = number(np.where(grids, slack_of(geometry)[ends].max(1), -1))
        #: How far a crease is from its edge in the plane between two voxels (negative: it is none), and the axis across
        #: that plane.
        sag, across = creases_of(geometry, ends)
        self._sag, self._across = number(np.where(grids, sag, -1)), mi.UInt32(np.array(across))
        #: Does the surface end there, at a side of the grid?
        self._open = mi.Bool(np.array(grids & edges.open))

    def are(self, edge: mi.UInt32) -> mi.Bool:
        """Which edges stand for the surface of a grid, which is somewhere close by?"""
        return dr.gather(mi.Float, self._slack, edge) >= 0 if self.any else mi.Bool(False)

    def are_open(self, edge: mi.UInt32) -> mi.Bool:
        """At which edges does the surface end, at a side of its grid?"""
        return dr.gather(mi.Bool, self._open, edge) if self.any else mi.Bool(False)

    def slack(self, edge: mi.UInt32) -> mi.Float:
        """How far from edges what is rendered may lie: scene units; 0 but for grids."""
        return GRID * dr.maximum(dr.gather(mi.Float, self._slack, edge), 0) if self.any else mi.Float(0)

    def reach(self, edge: mi.UInt32) -> mi.Float:
        """How far from edges the creases of grids, and their borders, may lie: scene units; 0 of other edges."""
        return GRID * dr.maximum(dr.gather(mi.Float, self._sag, edge), 0) if self.any else mi.Float(0)

    def side(
        self, edge: mi.UInt32, p: mi.Point3f, n: mi.Vector3f, size: mi.Float, si: mi.SurfaceInteraction3f
    ) -> mi.UInt32:
        """Where rays meet the surface of a grid beside a point p of a crease: on which side of the plane between two
        voxels, in which the crease lies (1 or 2)? 0: they do not. Beside a border: do they (1), or not (0)?

        n : normal of the surface at p. size : of the triangles there; what is behind an outline is farther off.
        """
        met = self.are(edge) & si.is_valid() & (dr.norm(si.p - p) <= size) & (dr.dot(n, si.n) > ALIKE)
        axis, d = dr.gather(mi.UInt32, self._across, edge), si.p - p
        beyond = dr.select(axis == 0, d.x, dr.select(axis == 1, d.y, d.z)) > 0
        return dr.select(met, dr.select(beyond & ~self.are_open(edge), mi.UInt32(2), 1), 0)

    def parts(self, edge: mi.UInt32, first: mi.UInt32, second: mi.UInt32) -> mi.Bool:
        """Does a crease, or a border, lie between two rays? first, second : see `side`."""
        return (first != second) & (self.are_open(edge) | ((first > 0) & (second > 0)))
