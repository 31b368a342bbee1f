"""Lines at which the textures of meshes jump, as edges: pieces of those of `texture_lines.py`, one for each triangle
that a line crosses.

The camera and points of a path see them as they see edges. (What has no such lines, and what mirrors show of them, is
found on the film: `terms/bisection.py`.)
A line moves with its triangle, and over it, if the texture coordinates change. A face belongs to both of its sides.
Where it runs along an edge at which something else jumps as well, that edge counts, and the line does not.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .device_edges import COPLANAR
from .edges import WHOLE, EdgeKind, Edges
from .grids import is_grid
from .interpolated import texture_slides
from .meshes import (
    Geometry,
    faces,
    has_interpolated_normals,
    has_texcoords,
    inner,
    normals_of,
    texcoords_of,
    texture_coordinates,
    vertices,
)
from .texture_lines import jumps_at_every_edge, lattices

#: Vertices that stand for a piece: its two ends, and a point on each side of it.
VERTICES = 4

#: Most pieces of one mesh. A finer texture is left out.
MOST = 2**17

#: Most lines across a mesh, in one direction, that count where they rest on their surface. More of them light others as
#: their mean does, and to sample them one by one would be noisy.
COARSE = 8

#: How far beside a line to look, in units in the last place of the coordinate that is whole there.
BESIDE_TEXTURE = 64

#: A vertex lies on a line if that coordinate is whole up to so many of these units.
ON_LINE, EPSILON = 16, float(np.finfo(np.float32).eps)


class TextureEdges:
    """The pieces of all meshes, in their order. For each mesh there is space for as many as `capacities` says; what is
    not needed has the length 0.

    geometry : the meshes. Those whose textures are too fine are left out.
    every : do fine textures count, too, that rest on their surface?
    """

    DRJIT_STRUCT = dict.fromkeys(("_corners", "_beyond", "_rows", "_sizes"))  # for `dr.freeze`

    def __init__(self, geometry: Geometry, *, every: bool):
        self._meshes, self._left_out, self._every = geometry.meshes, set(), every
        self._lattices = {
            i: found
            for i, m in enumerate(self._meshes)
            if not is_grid(m) and has_texcoords(inner(m)) and (found := lattices(inner(m)))
        }
        self.capacities = dict.fromkeys(self._lattices, 0)
        #: Flat-shaded meshes with lines along their edges.
        self.along_edges: set[int] = set()
        #: Most lines across each mesh, in one direction.
        self._across = dict.fromkeys(self._lattices, 0)
        self._at: dict[int, mi.Float] = {}
        self._pieces: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        #: Of each piece: the corners of its triangle, among all vertices; if it runs along an edge of a flat-shaded
        #: mesh, from the first to the second, and the third of the face beyond, else of its own; the coefficients of u,
        #: v, and 1 in the function that is 0 on the line; and the size of the terms of that.
        self._corners: list[mi.UInt32] = []
        self._beyond = mi.UInt32(0)
        self._rows: list[mi.Float] = []
        self._sizes = mi.Float(1)

    def shapes(self, sliding: Sequence[mi.Shape]) -> list[mi.Shape]:
        """Those whose lines count. sliding : those over which they move."""
        known = {i: inner(self._meshes[i]) for i in self._lattices if i not in self._left_out}
        return [s for i, s in known.items() if not self._is_fine(i) or s in sliding]

    def on_film(self, besides: Sequence[mi.Shape]) -> list[int]:
        """Numbers of the meshes whose lines the camera sees as edges: of all that are not left out, but of `besides`,
        and of those whose lines are not where their textures jump on some GPUs."""
        return [
            i
            for i, found in self._lattices.items()
            if self.capacities[i]
            and i not in self._left_out
            and inner(self._meshes[i]) not in besides
            and not any(lattice.step for lattice in found)
        ]

    def _is_fine(self, i: int) -> bool:
        return not self._every and self._across[i] > COARSE

    @property
    def fine(self) -> np.ndarray:
        """Which pieces count only if they move over their surface: (capacity,), bool."""
        return np.repeat([self._is_fine(i) for i in self.capacities], list(self.capacities.values()))

    @property
    def capacity(self) -> int:
        """Number of pieces for which there is space."""
        return sum(self.capacities.values())

    @property
    def vertices(self) -> int:
        """Number of the vertices that stand for the pieces."""
        return VERTICES * self.capacity

    def find(self) -> bool:
        """Find the pieces, as the texture coordinates are now; return whether there is now more space for them, or
        others count. On the host, and reads from the device: not in frozen functions."""
        uv = {i: dr.detach(texcoords_of(inner(self._meshes[i]))) for i in self._lattices}
        changed = [i for i, a in uv.items() if i not in self._at or a.index != self._at[i].index]
        if not changed:
            return False
        self._at, before, were_fine = uv, dict(self.capacities), self.fine
        for i in changed:
            self._pieces[i] = self._of_mesh(i)
            count = len(self._pieces[i][0])
            if count > self.capacities[i]:
                self.capacities[i] = count if before[i] == 0 else 1 << (2 * count - 1).bit_length()
        if not self.capacity:
            return False
        offsets = np.cumsum([0, *(m.vertex_count() for m in self._meshes)])
        corners, rows = [np.zeros((0, 4), np.int64)], [np.zeros((0, 4))]
        for i, (triangle, row) in self._pieces.items():
            rest = self.capacities[i] - len(triangle)
            corners += [triangle + offsets[i], np.zeros((rest, 4), np.int64)]
            rows += [row, np.tile([0.0, 0, -1, 1], (rest, 1))]
        corners, rows = np.concatenate(corners), np.concatenate(rows).astype(np.float32)
        # Not in NumPy's memory, for frozen functions.
        of_corners = [mi.UInt32(corners[:, k].astype(np.uint32)) + dr.opaque(mi.UInt32, 0) for k in range(4)]
        *self._corners, self._beyond = of_corners
        *self._rows, self._sizes = (mi.Float(rows[:, k].copy()) * dr.opaque(mi.Float, 1) for k in range(4))
        dr.eval(self._corners, self._beyond, self._rows, self._sizes)
        return self.capacities != before or bool((self.fine != were_fine).any())

    def _of_mesh(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices of the triangles of the pieces of a mesh, and the corners beyond, (P, 4); and their coefficients and
        sizes, (P, 4)."""
        mesh = inner(self._meshes[i])
        face, uv = faces(mesh).astype(np.int64), texture_coordinates(mesh).astype(np.float64)
        self._left_out.discard(i)
        self.along_edges.discard(i)
        self._across[i] = 0
        smooth = has_interpolated_normals(mesh)
        goes_on = [vertices(mesh), uv, *([np.array(dr.detach(normals_of(mesh))).reshape(-1, 3)] if smooth else [])]
        beyond = _corners_beyond(np.concatenate(goes_on, 1), face)
        inside = (beyond >= 0) & (not jumps_at_every_edge(mesh))  # its edges count by themselves
        which, corners, rows = [np.zeros(0, np.int64)], [np.zeros((0, 4), np.int64)], [np.zeros((0, 4))]
        for lattice in self._lattices[i]:
            for row in lattice.matrix:
                at = uv @ row[:2] + row[2]
                size = np.maximum(lattice.size, np.abs(at))
                self._across[i] = max(self._across[i], np.floor(at.max()) - np.floor(at.min()))
                at = np.where(np.abs(at - np.round(at)) <= ON_LINE * EPSILON * size, np.round(at), at)[face]
                # A line along an edge belongs to the face below it.
                lower, upper = np.floor(at.min(1)), np.floor(at.max(1))
                count = np.where(np.isfinite(upper - lower), upper - lower, 0).astype(np.int64)
                if sum(map(len, which)) + count.sum() > MOST:
                    self._left_out.add(i)
                    return np.zeros((0, 4), np.int64), np.zeros((0, 4))
                of = np.repeat(np.arange(len(face)), count)
                k = lower[of] + 1 + np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
                on_line = at[of] == k[:, None]
                along = np.stack([on_line[:, j] & on_line[:, (j + 1) % 3] for j in range(3)], 1)
                keep = ~(along & ~inside[of]).any(1)
                row_of = [*(np.full(len(k), x) for x in row[:2]), row[2] - k, np.maximum(lattice.size, np.abs(k))]
                which.append(of[keep])
                if not smooth and along.any():
                    self.along_edges.add(i)
                side = np.where(smooth, 0, along.argmax(1))
                turned = face[of[:, None], (side[:, None] + np.arange(3)) % 3]
                third = np.where(smooth | ~along.any(1), turned[:, 2], beyond[of, side])
                corners.append(np.column_stack([turned, third])[keep])
                rows.append(np.stack(row_of, 1)[keep])
        which, corners, rows = np.concatenate(which), np.concatenate(corners), np.concatenate(rows)
        # Lines of several textures may coincide.
        line = rows[:, :3] / np.linalg.norm(rows[:, :2], axis=1, keepdims=True)
        line *= np.where(line[:, :1] + np.sqrt(2) * line[:, 1:2] < 0, -1, 1)
        first = np.unique(np.column_stack([which, np.round(line, 6) + 0.0]), axis=0, return_index=True)[1]
        return corners[first], rows[first]

    # ---------------------- As edges ----------------------

    def points(self, of_meshes: list[mi.Float]) -> list[mi.Point3f]:
        """The vertices of all pieces: their first ends, their second ends, and points on each side: `VERTICES` times
        (capacity,), world space; the ends attached.

        of_meshes : positions of the vertices of each mesh, (3 V,).
        """
        positions = dr.concat(of_meshes)
        corners, height = self._triangles(positions)
        above = [h >= 0 for h in height]
        crossed = (above[0] != above[1]) | (above[0] != above[2])
        crossed &= ~self._on_crease(positions)
        # The corner that has the line between itself and the two others, first.
        for k in (1, 2):
            alone = (above[k] != above[0]) & (above[k] != above[3 - k])
            corners[0], corners[k] = dr.select(alone, corners[k], corners[0]), dr.select(alone, corners[0], corners[k])
            height[0], height[k] = dr.select(alone, height[k], height[0]), dr.select(alone, height[0], height[k])
        ends = []
        for k in (1, 2):
            t = dr.select(crossed, height[0], 0) / dr.select(crossed, height[0] - height[k], 1)
            ends.append(mi.Point3f(dr.lerp(corners[0], corners[k], t)))
        with dr.suspend_grad():
            (a, b), normal = (dr.detach(p) for p in ends), dr.cross(corners[1] - corners[0], corners[2] - corners[0])
            aside = dr.cross(b - a, dr.normalize(normal))
            sides = [mi.Point3f(a + dr.select(crossed, s * aside, 0)) for s in (1, -1)]
        return [*ends, *sides]

    def _on_crease(self, positions: mi.Float) -> mi.Bool:
        """Which pieces run along edges at which flat faces meet, and do not move over these? Detached."""
        p, piece, rests, start = dr.detach(positions), dr.arange(mi.UInt32, self.capacity), mi.Bool(True), 0
        for i, capacity in self.capacities.items():
            if texture_slides(inner(self._meshes[i])):
                rests &= (piece < start) | (piece >= start + capacity)
            start += capacity
        a, b, c, beyond = (dr.gather(mi.Point3f, p, corner) for corner in (*self._corners, self._beyond))
        first, second = (dr.normalize(dr.cross(b - a, other - a)) for other in (c, beyond))
        return rests & (dr.norm(dr.cross(first, second)) > COPLANAR)

    def beside(self, positions: mi.Float, piece: mi.UInt32) -> mi.Float:
        """How far beside a line rays tell its sides, scene units; detached."""
        (a, b, c), (f, g, h) = self._triangles(dr.detach(positions), piece)
        n = dr.cross(b - a, c - a)
        slope = dr.norm(dr.cross(n, (g - f) * (c - a) - (h - f) * (b - a))) / dr.squared_norm(n)
        size = dr.gather(mi.Float, self._sizes, piece)
        aside = dr.detach(BESIDE_TEXTURE * dr.epsilon(mi.Float) * size / slope)
        return dr.select(dr.isfinite(aside), aside, 0)

    def _triangles(
        self, positions: mi.Float, piece: mi.UInt32 | None = None
    ) -> tuple[list[mi.Point3f], list[mi.Float]]:
        """The triangles of pieces: their corners, and there the function that is 0 on the line; attached."""
        piece = dr.arange(mi.UInt32, self.capacity) if piece is None else piece
        no_uv = lambda m: dr.zeros(mi.Float, 2 * m.vertex_count())
        uv = dr.concat(
            [texcoords_of(inner(m)) if i in self._lattices else no_uv(m) for i, m in enumerate(self._meshes)]
        )
        a, b, c = (dr.gather(mi.Float, x, piece) for x in self._rows)
        corners, height = [], []
        least = ON_LINE * EPSILON * dr.gather(mi.Float, self._sizes, piece)
        for index in self._corners:
            vertex = dr.gather(mi.UInt32, index, piece)
            corners.append(dr.gather(mi.Point3f, positions, vertex))
            at = dr.gather(mi.Point2f, uv, vertex)
            over = a * at.x + b * at.y + c
            height.append(dr.select(dr.abs(over) <= least, over - dr.detach(over), over))
        return corners, height

    def as_edges(self, vertices: int) -> Edges:
        """The pieces as edges. vertices : number of those that come before theirs."""
        n = self.capacity
        k = np.arange(n, dtype=np.uint32) + np.uint32(vertices)
        mesh = np.repeat(np.array(list(self.capacities), np.uint32), list(self.capacities.values()))
        ends = np.stack([k, k + n], 1)
        return Edges(
            vertices=np.stack([ends, ends], 1),
            opposite=np.stack([k + 2 * n, k + 3 * n], 1),
            mesh=np.stack([mesh, mesh], 1),
            kind=np.full(n, EdgeKind.JUMP, np.uint8),
            count=np.full(n, 2, np.uint32),
            is_line=np.zeros(n, bool),
            part=np.broadcast_to(WHOLE, (n, 2, 2)),
            joined=np.zeros(n, bool),
        )


def _corners_beyond(values: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Which sides of faces, from a vertex to the next one, have one other face beyond them on which all that vertices
    have in `values` goes on, and that is turned the same way: the third vertex of that, (F, 3); otherwise −1."""
    place = np.unique(values, axis=0, return_inverse=True)[1].reshape(-1)[face]
    ends = np.stack([place, np.roll(place, -1, 1)], 2).reshape(-1, 2)
    _, number, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    number, corner = number.reshape(-1), np.roll(face, -2, 1).reshape(-1)
    # Of both sides of an edge, the sums of what the one and the other have.
    of_both = np.bincount(number, corner, len(count)).astype(np.int64)
    forwards = np.bincount(number, ends[:, 0] < ends[:, 1], len(count)).astype(np.int64)
    one = (count == 2) & (forwards == 1)
    return np.where(one[number], of_both[number] - corner, -1).reshape(-1, 3)
