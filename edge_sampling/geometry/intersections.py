"""The lines in which meshes cut through each other: boundaries that are edges of neither.

Two triangles that cut each other have a piece of a line in common, along n₁ × n₂. Its ends are where a side of one
goes through the face of the other. So rays along all sides of triangles find the pairs: each triangle has rays of its
own, a little inside of it, which meet the very faces that it cuts. (On the side itself, rays would meet one of several
faces where a side goes through the edge between them, as a box does whose corner stands on the diagonal of a floor.)
Most pairs are found several times, and count once.

Shapes also may stand in a floor exactly along edges of theirs, or of its own. Both surfaces go on, so there is a line,
but none of these triangles goes through another one. There, that which ends at the line from below stands for the
surface: what is in a plane, within rounding, counts as above it, if the surface goes on above it. Where such an edge is
a silhouette, it counts by itself, and the line does not.

The line moves as the planes do. A point p of it has no velocity of its own along the line; across it, ṗ = α n₁ + β n₂
with α and β such that p stays in both planes: nᵢ · ṗ = −ġᵢ, gᵢ = nᵢ · (p − cᵢ) with a corner cᵢ. What is seen on
either side is *not* fixed to the line, as it is to an edge: both surfaces slide past it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from .beside import rounding
from .boxes import box_of
from .common_line import common_line, follow, normal_of, slack_of
from .edges import WHOLE, EdgeKind, Edges, Weld, distinct_rows
from .grids import is_grid
from .half_edges import HalfEdges, edge_key
from .mesh_numbers import first_meshes, numbers_in_groups
from .meshes import Geometry, positions_of, tells_shapes_in_groups
from .rigid_motion import Shapes

#: An edge is followed through at most so many faces.
MOST_FACES = 1024

#: How far inside of its triangle a ray along a side runs, and by how much it is longer than that at both ends, in units
#: of what rounding may be. So it goes through what ends in its triangle unless at a very flat angle.
INSIDE, LONGER = 4, 16

#: Vertices that stand for the line of one pair: its two ends, and a point on each side of it.
VERTICES = 4

#: Corners of the two triangles of a pair; and where the line is an edge of one of them, those opposite to it.
CORNERS, OPPOSITE = 6, 2

#: Least number of pairs for which there is space.
LEAST_SPACE = 64


@dataclass(frozen=True)
class _Walked:
    """Sides of triangles along which rays are traced, see `HalfEdges`: their numbers, and of which meshes they are."""

    side: mi.UInt32
    mesh: mi.UInt32

    def __len__(self) -> int:
        return dr.width(self.side)


class Intersections:
    """The lines in which the meshes of a scene cut through each other, and through themselves.

    Parameters
    ----------
    scene, geometry : the meshes. edges, weld : of them.

    There is space for `capacity` pairs of triangles. What is not needed has the length 0.
    """

    DRJIT_STRUCT = dict.fromkeys(("corners", "rests"))  # for `dr.freeze`

    #: Are its lines straight?
    straight = True

    def __init__(self, scene: mi.Scene, geometry: Geometry, edges: Edges, weld: Weld):
        faces = geometry.faces((True,) * len(geometry.meshes)).astype(np.int64)
        self._corner, self._place, self._place_of = _index(faces.ravel()), weld.place, _index(weld.place)
        self._places = int(weld.place.max(initial=-1)) + 1
        self._beside = lambda: _beside(geometry, edges, weld, faces)
        #: See there.
        self._beyond: mi.UInt32 | None = None
        self._always: mi.Bool | None = None
        self._first_mesh = first_meshes(geometry)
        self._in_group = numbers_in_groups(geometry) if tells_shapes_in_groups() else None
        counts = [m.face_count() for m in geometry.meshes]
        self._counts, self._first_face = counts, _index(np.cumsum([0, *counts]))
        self._meshes = len(counts)
        self._walked: dict[tuple[int, ...], _Walked] = {}
        #: Where the meshes were (held, so that the number of an array is given to no other one).
        self._at: list[mi.Float] | None = None
        self.count = self.capacity = 0
        #: Meshes that may cut each other, since their boxes overlap, or did so before: their numbers. (So a thing that
        #: goes up and down through a floor does not ask for other boundaries each time.)
        self.shapes: tuple[int, ...] = ()
        #: Six vertices of each pair of triangles, and two more, which are one and the same where the line is no edge:
        #: (capacity,) each.
        self.corners: list[mi.UInt32] = []
        #: Which vertices are ends of an edge that lies in another surface, through which its own one goes on: (V,).
        self.rests = dr.opaque(mi.Bool, False, max(len(weld.place), 1))
        #: Meshes that cut through themselves. Others may come to do so when their shapes change.
        self._by_themselves: set[int] = set()
        self._forms = Shapes(geometry)

    # ---------------------- Search ----------------------

    def find(self, scene: mi.Scene, geometry: Geometry) -> bool:
        """Find the pairs of triangles, as the meshes are now; return whether there is now more space for them, or
        other meshes may cut each other. On the host, and reads from the device: not in frozen functions."""
        arrays = [dr.detach(positions_of(m)) for m in geometry.meshes]
        if self._at is not None and all(a.index == b.index for a, b in zip(arrays, self._at, strict=True)):
            return False
        self._at = arrays
        before = self.shapes, self.capacity
        boxes = _overlapping(geometry)
        with dr.suspend_grad():
            grids = {i for i, m in enumerate(geometry.meshes) if is_grid(m)}
            alone = (self._forms.changed(arrays) | self._by_themselves) - grids
            everywhere = {i: np.array([[-np.inf] * 3, [np.inf] * 3]) for i in alone}
            self._search(scene, dr.detach(replace(geometry, lines=()).positions()), boxes | everywhere)
        self.shapes = tuple(sorted({*self.shapes, *boxes, *self._by_themselves}))
        return bool(self.capacity) and before != (self.shapes, self.capacity)

    def _search(self, scene: mi.Scene, positions: mi.Float, boxes: dict[int, np.ndarray]) -> None:
        """Find the pairs, and which meshes cut through themselves. boxes : meshes, and where to look for what cuts
        each: (2, 3)."""
        self.rests = dr.opaque(mi.Bool, False, dr.width(self.rests))
        walked = self._sides_of(tuple(sorted(boxes))) if boxes else ()
        if not len(walked):
            self._keep([], 0)
            return
        within = np.zeros((self._meshes, 2, 3), np.float32)
        within[list(boxes)] = list(boxes.values())
        within = mi.Float(within.ravel())
        counts = self._walk(scene, positions, walked, within)
        ends = dr.cumsum(counts)
        count = int(dr.gather(mi.UInt32, ends, dr.width(ends) - 1)[0])
        found: list[mi.UInt32] = []
        self._by_themselves = set()
        if count:
            reaching = dr.compress(counts > 0)
            start = dr.gather(mi.UInt32, ends - counts, reaching)
            found = [dr.zeros(mi.UInt32, count) for _ in range(2)]
            some = _Walked(*(dr.gather(mi.UInt32, n, reaching) for n in (walked.side, walked.mesh)))
            self._walk(scene, positions, some, within, into=found, start=start)
            found[0] = self._from_below(positions, *found)
            cutting = dr.compress(self._cut(positions, *found))
            count = dr.width(cutting)
        if count:
            found, count = self._each_once(positions, [dr.gather(mi.UInt32, f, cutting) for f in found])
        if count > self.capacity:
            self.capacity = max(LEAST_SPACE, 1 << (2 * count - 1).bit_length())
        self._keep(found if count else [], count)

    def _each_once(self, positions: mi.Float, found: list[mi.UInt32]) -> tuple[list[mi.UInt32], int]:
        """Corners of pairs of triangles, see `corners`, each once, and of repeated triangles once; and how many."""
        pairs = np.stack([f.numpy() for f in found], 1)
        mesh = np.searchsorted(np.cumsum(self._counts), pairs, side="right")
        self._by_themselves = set(mesh[mesh[:, 0] == mesh[:, 1], 0].tolist())
        corners = self._corner.numpy().reshape(-1, 3)[pairs]
        triangle = distinct_rows(np.sort(self._place[corners], axis=2).reshape(-1, 3))[1].reshape(-1, 2)
        first = np.sort(distinct_rows(np.sort(triangle, axis=1))[0])
        of_pairs = [_index(corners.reshape(-1, CORNERS)[first, k]) for k in range(CORNERS)]
        return of_pairs + self._of_edges(positions, *(_index(pairs[first, k]) for k in (0, 1))), len(first)

    def _keep(self, found: list[mi.UInt32], count: int) -> None:
        """Fill up what is not needed with a vertex, which makes triangles without area."""
        self.count = count
        if self.capacity:
            slot = dr.arange(mi.UInt32, self.capacity)
            used = slot < dr.opaque(mi.UInt32, count)
            found = found or [dr.zeros(mi.UInt32, 1)] * (CORNERS + OPPOSITE)
            self.corners = [dr.gather(mi.UInt32, f, slot, used) for f in found]
            dr.eval(self.corners, self.rests)

    def _sides_of(self, meshes: tuple[int, ...]) -> _Walked:
        if self._beyond is None:
            self._beyond, self._always = self._beside()
        if meshes not in self._walked:
            mesh = np.repeat(np.arange(self._meshes), np.multiply(3, self._counts))
            side = np.flatnonzero(np.isin(mesh, meshes))
            self._walked[meshes] = _Walked(_index(side), _index(mesh[side]))
        return self._walked[meshes]

    def _walk(
        self,
        scene: mi.Scene,
        positions: mi.Float,
        walked: _Walked,
        within: mi.Float,
        *,
        into: list[mi.UInt32] | None = None,
        start: mi.UInt32 | None = None,
    ) -> mi.UInt32:
        """Follow each side through all the faces that it goes through, and that may cut its triangle; how many these
        are: (S,).

        within : for each mesh, the lower and the upper corner of a box outside of which nothing cuts it, (6 M,).
        into, start : where to write the numbers of both triangles, from where on for each side.
        """
        own, ends = walked.side // 3, self._corners_of(walked.side)
        a, b, third = (dr.gather(mi.Point3f, positions, c) for c in ends)
        length = dr.norm(b - a)
        d = (b - a) / length
        step = rounding(a, b)
        inwards = third - a - d * dr.dot(d, third - a)
        height = dr.norm(inwards)
        active = (length > 0) & dr.isfinite(length) & (height > 0)
        lower, upper = (dr.gather(mi.Point3f, within, 2 * walked.mesh + k) for k in (0, 1))
        active &= dr.all((dr.maximum(a, b) >= lower - step) & (dr.minimum(a, b) <= upper + step))
        # Inside of the triangle, and a little longer than it: what ends in a face goes through that, too.
        a = a + inwards * (dr.minimum(INSIDE * step, height / 4) / height)
        longer = LONGER * step

        def through(t, count, k, active):
            ray = mi.Ray3f(mi.Point3f(a + t * d), d)
            ray.maxt = length + longer - t
            pi = scene.ray_intersect_preliminary(ray, active=active)
            active &= pi.is_valid()
            # In a shape group, Mitsuba numbers the shapes from 0, or tells the shape itself.
            shape, instance = (dr.reinterpret_array(mi.UInt32, s) for s in (pi.shape, pi.instance))
            number = dr.select(instance != 0, instance, shape)
            mesh = dr.gather(mi.UInt32, self._first_mesh, number, active & (number < dr.width(self._first_mesh)))
            is_mesh = active & (mesh > 0)
            which = pi.shape_index
            if self._in_group is not None:
                which = dr.gather(mi.UInt32, self._in_group, shape, is_mesh & (instance != 0))
            mesh = dr.select(is_mesh, mesh - 1 + dr.select(instance != 0, which, 0), 0)
            face = dr.select(is_mesh, dr.gather(mi.UInt32, self._first_face, mesh) + pi.prim_index, 0)
            # Of the edge between two faces, a ray meets one.
            next_to = self._next_to(positions, face, ray(pi.t), step)
            # Close to a vertex, rays meet the other faces there, and beside a side, that beyond it.
            near = t + pi.t < 2 * longer, t + pi.t > length - 2 * longer
            for met, new in ((face, is_mesh), (next_to, is_mesh & (next_to != face))):
                corners = self._corners_of(3 * met)
                has = [(corners[0] == end) | (corners[1] == end) | (corners[2] == end) for end in ends[:2]]
                found = new & (met != own) & ~((has[0] & near[0]) | (has[1] & near[1]) | (has[0] & has[1]))
                if into is not None:
                    for target, triangle in zip(into, (own, met), strict=True):
                        dr.scatter(target, triangle, start + count, found)
                count += dr.select(found, 1, 0)
            t += pi.t + step
            return t, count, k + 1, active & (t < length + longer) & (k < MOST_FACES)

        width = len(walked)
        zero = dr.zeros(mi.UInt32, width)
        state = (mi.Float(-longer), mi.UInt32(zero), mi.UInt32(zero), active)
        return dr.while_loop(state, lambda *s: s[-1], through, label="sides of triangles through faces")[1]

    def _corners_of(self, side: mi.UInt32) -> list[mi.UInt32]:
        """Vertices of a triangle, those of a side of it first."""
        face, k = side // 3, side % 3
        return [dr.gather(mi.UInt32, self._corner, 3 * face + (k + i) % 3) for i in range(3)]

    def _triangle(self, positions: mi.Float, face: mi.UInt32) -> list[mi.Point3f]:
        return [dr.gather(mi.Point3f, positions, c) for c in self._corners_of(3 * face)]

    def _next_to(self, positions: mi.Float, face: mi.UInt32, p: mi.Point3f, slack: mi.Float) -> mi.UInt32:
        """The face beyond that side of a face on which the point p is; the face itself where it is on none."""
        corners, found = self._triangle(positions, face), mi.UInt32(face)
        for k in range(3):
            a, b = corners[k], corners[(k + 1) % 3]
            near = dr.norm(dr.cross(p - a, b - a)) <= slack * dr.norm(b - a)
            found = dr.select(near, dr.gather(mi.UInt32, self._beyond, 3 * face + k) // 3, found)
        return found

    def _cut(self, positions: mi.Float, own: mi.UInt32, met: mi.UInt32) -> mi.Bool:
        """Do two triangles cut each other?"""
        mine, other = self._triangle(positions, own), self._triangle(positions, met)
        slack = slack_of(mine, other)
        cut = common_line(mine, other)[2]
        for face, corners, plane in ((own, mine, other), (met, other, mine)):
            heights = [dr.dot(normal_of(plane), p - plane[0]) for p in corners]
            goes_through = (heights[0] > slack) | (heights[1] > slack) | (heights[2] > slack)
            cut &= goes_through | self._goes_on(positions, face, plane, slack)[0]
        return cut

    def _from_below(self, positions: mi.Float, own: mi.UInt32, met: mi.UInt32) -> mi.UInt32:
        """In the place of triangles that end from above in the plane of another one, those beyond their side there. Of
        these, a ray may meet the former alone, where the other triangle is at the same place."""
        plane = self._triangle(positions, met)
        slack = slack_of(self._triangle(positions, own), plane)
        goes_on, side = self._goes_on(positions, own, plane, slack, below=True)
        return dr.select(goes_on, dr.gather(mi.UInt32, self._beyond, side) // 3, own)

    def _goes_on(
        self, positions: mi.Float, face: mi.UInt32, plane: list[mi.Point3f], slack: mi.Float, *, below: bool = False
    ) -> tuple[mi.Bool, mi.UInt32]:
        """Has a face a side in a plane, beyond which the surface goes on above that, or below it; and which? Only
        edges of two faces are asked: others count wherever they lie."""
        height = lambda c: dr.dot(normal_of(plane), dr.gather(mi.Point3f, positions, c) - plane[0])
        goes_on, side = dr.full(mi.Bool, False, dr.width(face)), mi.UInt32(3 * face)
        for k in range(3):
            a, b, _ = self._corners_of(3 * face + k)
            above = self._corners_of(dr.gather(mi.UInt32, self._beyond, 3 * face + k))[2]
            here = (dr.abs(height(a)) <= slack) & (dr.abs(height(b)) <= slack)
            here &= height(above) < -slack if below else height(above) > slack
            here &= ~dr.gather(mi.Bool, self._always, 3 * face + k)
            goes_on |= here
            side = dr.select(here, 3 * face + k, side)
        return goes_on, side

    def _of_edges(self, positions: mi.Float, own: mi.UInt32, met: mi.UInt32) -> list[mi.UInt32]:
        """Of lines that are edges of one of two triangles, the vertices opposite to them, below and above the other
        triangle; of other lines, the same one twice. And find which vertices rest."""
        mine, other = self._triangle(positions, own), self._triangle(positions, met)
        slack, opposite = slack_of(mine, other), [mi.UInt32(0), mi.UInt32(0)]
        of_place = dr.zeros(mi.UInt32, self._places)
        # A line that is an edge of both surfaces stays one where either is a silhouette.
        found = [self._goes_on(positions, face, plane, slack) for face, plane in ((own, other), (met, mine))]
        for (goes_on, side), (too, _) in zip(found, found[::-1], strict=True):
            a, b, below = self._corners_of(side)
            above = self._corners_of(dr.gather(mi.UInt32, self._beyond, side))[2]
            opposite = [dr.select(goes_on & ~too, c, o) for c, o in zip((below, above), opposite, strict=True)]
            for end in (a, b):
                dr.scatter(of_place, 1, dr.gather(mi.UInt32, self._place_of, end), goes_on & ~too)
        self.rests = dr.gather(mi.UInt32, of_place, self._place_of) != 0
        return opposite

    # ---------------------- As edges ----------------------

    @property
    def vertices(self) -> int:
        """Number of the vertices that stand for the lines."""
        return VERTICES * self.capacity

    def points(self, of_meshes: list[mi.Float]) -> list[mi.Point3f]:
        """The vertices of all lines, first their lower ends, then their upper ends, then points on both sides:
        `VERTICES` times (capacity,), world space; attached. These are in the first triangle's plane, or where a line is
        an edge, in those of its faces.

        of_meshes : positions of the vertices of each mesh, (3 V,).
        """
        positions = dr.concat(of_meshes)
        corners = [dr.gather(mi.Point3f, positions, c) for c in self.corners]
        first, second, (below, above) = corners[:3], corners[3:CORNERS], corners[CORNERS:]
        is_edge = self.corners[CORNERS] != self.corners[CORNERS + 1]
        with dr.suspend_grad():
            still = [[dr.detach(p) for p in t] for t in (first, second)]
            lower, upper, cut = common_line(*still)
            lower, upper = (dr.select(cut, p, still[0][0]) for p in (lower, upper))
            aside = dr.cross(upper - lower, normal_of(still[0]))
            sides = [mi.Point3f(lower + dr.select(cut, s * aside, 0)) for s in (1, -1)]
            of_edge = dr.detach(below), dr.detach(above)
            sides = [dr.select(is_edge & cut, p, q) for p, q in zip(of_edge, sides, strict=True)]
        return [*(follow(p, first, second, cut) for p in (lower, upper)), *sides]

    def normals(self, positions: mi.Float, line: mi.UInt32, p: mi.Point3f) -> list[mi.Vector3f]:
        """Of both triangles; detached. p : not needed."""
        corners = [dr.gather(mi.Point3f, dr.detach(positions), dr.gather(mi.UInt32, c, line)) for c in self.corners]
        return [normal_of(corners[:3]), normal_of(corners[3:CORNERS])]

    def as_edges(self, edges: Edges, vertices: int) -> Edges:
        """`edges`, and after them these lines, as edges that are boundaries from everywhere.

        vertices : number of those of all meshes, after which those of the lines come.
        """
        return line_edges(edges, self.capacity, vertices)


def line_edges(edges: Edges, n: int, vertices: int) -> Edges:
    """`edges`, and after them n lines in which shapes cut each other, as edges that are boundaries from everywhere.

    vertices : number of those before the first ends of all lines, after which come the second ends, and points on both
        sides.
    """
    k = np.arange(n, dtype=np.uint32) + np.uint32(vertices)
    ends = np.stack([k, k + n], 1)
    lines = Edges(
        vertices=np.stack([ends, ends], 1),
        opposite=np.stack([k + 2 * n, k + 3 * n], 1),
        mesh=np.zeros((n, 2), np.uint32),
        kind=np.full(n, EdgeKind.JUMP, np.uint8),
        count=np.full(n, 4, np.uint32),
        is_line=np.ones(n, bool),
        part=np.broadcast_to(WHOLE, (n, 2, 2)),
        joined=np.zeros(n, bool),
    )
    return edges + lines


def _beside(geometry: Geometry, edges: Edges, weld: Weld, faces: np.ndarray) -> tuple[mi.UInt32, mi.Bool]:
    """Of each side of a triangle, that beyond it, or itself where there is none; and whether the edge has other numbers
    of faces than two, so that it counts wherever it lies, and a line along it would only repeat it: (3 F,)."""
    beyond = HalfEdges.of(weld.place, faces).beyond(faces, geometry.host_positions())
    beyond = np.where(beyond < 0, np.arange(faces.size), beyond)
    n = int(weld.place.max()) + 1
    key = lambda ends: edge_key(*weld.place[ends.astype(np.int64)].T, n)
    goes_on = key(edges.vertices[edges.count == 2, 0])
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], 2).reshape(-1, 2)
    return _index(beyond), mi.Bool(np.isin(key(sides), goes_on, invert=True))


def _overlapping(geometry: Geometry) -> dict[int, np.ndarray]:
    """Meshes whose boxes overlap that of another one: their numbers, and the box around all that they have in common
    with others, (2, 3)."""
    if len(geometry.meshes) < 2:
        return {}
    boxes = np.array([(*b.min, *b.max) for b in (box_of(m) for m in geometry.meshes)], float)
    boxes[[is_grid(m) for m in geometry.meshes]] = np.nan  # which overlap nothing
    lower, upper = boxes[:, :3], boxes[:, 3:]
    overlap = (lower[:, None] <= upper).all(2)
    overlap &= overlap.T
    overlap.ravel()[:: len(boxes) + 1] = False  # of each with itself
    if not overlap.any():
        return {}
    lower, upper = np.maximum(lower[:, None], lower), np.minimum(upper[:, None], upper)
    return {i: np.array([lower[i, row].min(0), upper[i, row].max(0)]) for i, row in enumerate(overlap) if row.any()}


def _index(numbers: np.ndarray) -> mi.UInt32:
    return mi.UInt32(np.ascontiguousarray(numbers, dtype=np.uint32))
