"""The curves in which spheres, disks and cylinders cut through meshes, and through each other.

The plane of a triangle cuts a sphere in a circle, a cylinder in an ellipse, a disk in a line. In the frame of the
shape,

    p(φ) = m + u cos φ + v sin φ,        of a disk p(s) = m + u s.

What bounds it (the sides of the triangle, the ends of a cylinder) is linear in p: h·p + w >= 0. So each bound leaves
one arc, from one angle to another. An arc of the curve begins where one bound begins to hold and all others do, and
ends where the next one ceases to: there are at most as many arcs as bounds, or a whole circle if no bound is ever met.

Arcs are cut into pieces, which are chosen as edges are, by their chords. A point of a piece is that of the curve in the
plane across its chord, which Newton's method finds: both surfaces have a signed distance that vanishes there. As the
surfaces move, it stays on both (`stay_on`).

Of two analytic shapes, one is divided into triangles. These only tell where the curve is; its points are on both.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .boxes import box_of
from .common_line import IN_ONE_PLANE, stay_on
from .cut_surfaces import BEYOND, KINDS, STEEP, TURN, WITHIN, Kind, Surface, across, nearest, triangles, trim
from .edges import Edges
from .grids import is_grid
from .intersections import LEAST_SPACE, VERTICES, line_edges
from .meshes import Geometry, faces, positions_of

#: Least depth to which a plane must be sunk in a sphere, relative to its radius.
SUNK = 1e-5

#: Least cosine between a cylinder's axis and a plane, to make an ellipse of two lines.
UPRIGHT = 1e-9

#: Bounds of the arcs of a curve: three sides of a triangle, two ends of a cylinder. And where one may begin: at each of
#: them, or anywhere.
BOUNDS, SLOTS = 5, 6


@dataclass
class Pairs:
    """Analytic shapes, each with a triangle that may cut it: of a mesh, or of another shape, which is then the second
    surface.

    kinds : of both surfaces. frames : four vertices of each. corners : vertices of the triangle.
    slack : how far beyond its ends the first shape is looked for.
    """

    kinds: list[mi.UInt32]
    frames: list[list[mi.UInt32]]
    corners: list[mi.UInt32]
    slack: mi.Float

    @staticmethod
    def of(rows: list[tuple[list[int], np.ndarray, np.ndarray, list[float]]]) -> Pairs:
        """rows : kinds of two surfaces, their frames (F, 2, 4), corners (F, 3), slack."""
        kinds = np.concatenate([np.tile(k, (len(c), 1)) for k, _, c, _ in rows])
        frames, corners = (np.concatenate([row[k] for row in rows]) for k in (1, 2))
        slack = np.concatenate([np.tile(s, len(row[2])) for row in rows for s in row[3]])
        index = lambda a: mi.UInt32(np.ascontiguousarray(a, dtype=np.uint32))
        return Pairs(
            [index(kinds[:, k]) for k in (0, 1)],
            [[index(frames[:, k, i]) for i in range(4)] for k in (0, 1)],
            [index(corners[:, i]) for i in range(3)],
            mi.Float(slack.astype(np.float32)),
        )

    def __len__(self) -> int:
        return dr.width(self.slack)

    def take(self, which: mi.UInt32) -> Pairs:
        of = lambda index: dr.gather(mi.UInt32, index, which)
        frames = [[of(i) for i in frame] for frame in self.frames]
        slack = dr.gather(mi.Float, self.slack, which)
        return Pairs([of(k) for k in self.kinds], frames, [of(c) for c in self.corners], slack)

    def surfaces(self, positions: mi.Float) -> list[Surface]:
        """Both surfaces of each pair."""
        found = []
        for kind, frame in zip(self.kinds, self.frames, strict=True):
            o, *axes = (_vertex(positions, i) for i in frame)
            found.append(Surface(kind, o, *(axis - o for axis in axes)))
        return found


def _vertex(positions: mi.Float, index: mi.UInt32) -> mi.Vector3d:
    return mi.Vector3d(dr.gather(mi.Vector3f, positions, index))


class CutCurves:
    """The curves in which the analytic shapes of a scene cut through its meshes, and through each other.

    There is space for `capacity` pieces. What is not needed has the length 0.

    Parameters
    ----------
    geometry : the shapes.
    """

    DRJIT_STRUCT = dict.fromkeys(  # for `dr.freeze`
        ("_analytic", "_first", "_pairs", "_slot", "_start", "_end", "_divided", "_local", "capacity")
    )

    #: Are its lines straight?
    straight = False

    def __init__(self, geometry: Geometry):
        self._analytic = geometry.analytic
        #: Number of vertices of meshes; then come the frames of the analytic shapes.
        self._first = sum(m.vertex_count() for m in geometry.meshes)
        #: Pairs of overlapping shapes, by their numbers in `Geometry.moving`, and what they were made to.
        self._overlap: list[tuple[int, int]] = []
        self._candidates: Pairs | None = None
        #: Vertices of the shapes that are divided into triangles: their frames, and places in these.
        self._divided: list[mi.UInt32] = []
        self._local: list[mi.Float] = []
        #: The pieces: of which pair and arc, and from which part of it to which.
        self._pairs = self._slot = self._start = self._end = None
        self.capacity = 0
        #: Shapes that may be cut, or could be before, by their numbers in `Geometry.moving`.
        self.shapes: tuple[int, ...] = ()

    # ---------------------- Search ----------------------

    def find(self, geometry: Geometry) -> bool:
        """Find the pieces, as the shapes are now; return whether there is now more space for them, or other shapes may
        cut each other. On the host, and reads from the device: not in frozen functions."""
        if not self._analytic:
            return False
        overlap, before = _overlapping(geometry), (self.shapes, self.capacity)
        if overlap != self._overlap:
            self._overlap, self._candidates = overlap, self._make(geometry, overlap)
        self.shapes = tuple(sorted({*self.shapes, *(i for pair in overlap for i in pair)}))
        lane, count = np.zeros(0, np.uint32), np.zeros(0, np.uint32)
        if overlap:
            with dr.suspend_grad():
                known = self._known([dr.detach(positions_of(m)) for m in geometry.meshes])
                lanes = dr.arange(mi.UInt32, SLOTS * len(self._candidates))
                *_, span, valid = self._arcs(known, self._candidates.take(lanes // SLOTS), lanes % SLOTS)
                pieces = mi.UInt32(dr.clip(dr.ceil(span * (TURN / dr.two_pi)), 1, TURN))
                lane = dr.compress(valid).numpy()
                count = dr.gather(mi.UInt32, pieces, mi.UInt32(lane)).numpy()
        if count.sum() > self.capacity:
            self.capacity = max(LEAST_SPACE, 1 << int(2 * count.sum() - 1).bit_length())
        if self.capacity:
            self._keep(np.repeat(lane, count), np.repeat(count, count), np.arange(count.sum()))
        return bool(self.capacity) and before != (self.shapes, self.capacity)

    def _keep(self, lane: np.ndarray, count: np.ndarray, number: np.ndarray) -> None:
        """Write down the pieces: of which arc they are, into how many that is divided, their numbers among all."""
        first = np.concatenate([[True], lane[1:] != lane[:-1]])[: len(lane)]
        j = number - np.maximum.accumulate(np.where(first, number, 0))
        pad = lambda a: np.pad(a, (0, self.capacity - len(a)))
        if self._candidates is None:
            return
        index = mi.UInt32(pad(lane).astype(np.uint32))
        self._pairs, self._slot = self._candidates.take(index // SLOTS), index % SLOTS
        # (Not in NumPy's memory, for frozen functions.)
        one = dr.opaque(mi.Float, 1)
        self._start, self._end = (mi.Float(pad(x / count).astype(np.float32)) * one for x in (j, j + 1))
        dr.eval(self._pairs, self._slot, self._start, self._end)

    def _make(self, geometry: Geometry, overlap: list[tuple[int, int]]) -> Pairs | None:
        """All pairs of a shape and a triangle of another one. Of two analytic shapes, a disk is divided into triangles,
        or else the smaller one."""
        if not overlap:
            return None
        offsets = np.cumsum([0, *(m.vertex_count() for m in geometry.meshes)])
        rows, local, owner, meshes = [], [], [], len(geometry.meshes)
        next_vertex = self._first + 4 * len(self._analytic)
        for a, b in overlap:
            kind, frame = self._surface(a - meshes)
            if b < meshes:
                corners = faces(geometry.meshes[b]).astype(np.int64) + offsets[b]
                frames = np.stack([np.tile(frame, (len(corners), 1)), corners[:, [0, 1, 2, 1]]], 1)
                rows.append(([kind, Kind.PLANE], frames, corners, [-WITHIN]))
                continue
            other, other_frame = self._surface(b - meshes)
            vertices, divided = triangles(other)
            frames = np.tile(np.stack([frame, other_frame]), (len(divided), 1, 1))
            rows.append(([kind, other], frames, divided + next_vertex, [BEYOND]))
            local.append(vertices)
            owner.append(np.tile(other_frame, (len(vertices), 1)))
            next_vertex += len(vertices)
        if local:
            local, owner = np.concatenate(local).astype(np.float32), np.concatenate(owner).astype(np.uint32)
            self._local = [mi.Float(np.array(local[:, i])) * dr.opaque(mi.Float, 1) for i in range(3)]
            self._divided = [mi.UInt32(np.array(owner[:, i])) + dr.opaque(mi.UInt32, 0) for i in range(4)]
        else:
            self._local, self._divided = [], []
        return Pairs.of(rows)

    def _surface(self, number: int) -> tuple[Kind, np.ndarray]:
        """Kind of an analytic shape, and the vertices of its frame."""
        return KINDS[self._analytic[number].class_name()], self._first + 4 * number + np.arange(4)

    # ---------------------- Where they are ----------------------

    def _frames(self) -> mi.Point3f:
        """Origin of each analytic shape, and the ends of its axes: (4 S,), world space; attached."""
        rows: list[list[mi.Float]] = [[], [], []]
        for shape in self._analytic:
            m = mi.traverse(shape)["to_world"].matrix
            for i, row in enumerate(rows):
                row += [mi.Float(m[i, 3]), *(mi.Float(m[i, j] + m[i, 3]) for j in range(3))]
        return mi.Point3f(*(dr.concat(row) for row in rows))

    def _known(self, of_meshes: list[mi.Float]) -> mi.Float:
        """Vertices of meshes, frames of shapes, and vertices of shapes that are divided; detached."""
        known = dr.concat([dr.detach(p) for p in (*of_meshes, dr.ravel(self._frames()))])
        if not self._divided:
            return known
        o, *axes = (dr.gather(mi.Point3f, known, i) for i in self._divided)
        return dr.concat([known, dr.ravel(o + sum((a - o) * x for a, x in zip(axes, self._local, strict=True)))])

    @staticmethod
    def _arcs(known: mi.Float, pairs: Pairs, slot: mi.UInt32) -> tuple:
        """The curves m, u, v of pairs in the frame of the first shape; start and length of the arc that begins at the
        bound `slot`; and is there one?"""
        shape = pairs.surfaces(known)[0]
        a, b, c = corners = [shape.local(_vertex(known, i)) for i in pairs.corners]
        n = dr.cross(b - a, c - a)
        solid = dr.norm(n) > dr.epsilon(mi.Float) * dr.norm(b - a) * dr.norm(c - a)
        n = dr.normalize(n)
        m, u, v, exists = conic(shape, n, dr.dot(n, a))
        sides = [dr.cross(n, corners[(k + 1) % 3] - corners[k]) for k in range(3)]
        bounds = [(h, -dr.dot(h, q)) for h, q in zip(sides, corners, strict=True)]
        end, slack = dr.select(shape.is_a(Kind.CYLINDER), mi.Float64(1), 0), mi.Float64(pairs.slack)
        for sign, w in ((end, slack), (-end, 1 + slack)):
            bounds.append((mi.Vector3d(0, 0, sign), dr.select(end > 0, w, 1)))
        at = [(dr.dot(h, u), dr.dot(h, v), dr.dot(h, m) + w) for h, w in bounds]
        start, span, valid = arc(at, slot)
        half = dr.safe_sqrt(dr.square(1 + slack) - dr.squared_norm(m))
        line_start, line_span = interval(at, half)
        disk = shape.is_a(Kind.DISK)
        start, span = dr.select(disk, line_start, start), dr.select(disk, line_span, span)
        return (
            m,
            u,
            v,
            start,
            span,
            solid & exists & dr.select(disk, (slot == 0) & (span > 0), valid) & dr.isfinite(span),
        )

    def points(self, of_meshes: list[mi.Float]) -> list[mi.Point3f]:
        """The vertices that stand for the curves: frames of all analytic shapes; then of all pieces the first ends, the
        second ends, and points on both sides; world space. Only the frames are attached.

        of_meshes : positions of the vertices of each mesh, (3 V,).
        """
        with dr.suspend_grad():
            known = self._known(of_meshes)
            m, u, v, start, span, valid = self._arcs(known, self._pairs, self._slot)
            shape, other = surfaces = self._pairs.surfaces(known)
            ends = []
            for part in (self._start, self._end):
                φ = start + span * mi.Float64(part)
                sin, cos = dr.sincos(φ)
                line = shape.is_a(Kind.DISK)
                p = shape.world(m + u * dr.select(line, φ, cos) + v * dr.select(line, 0, sin))
                ends.append(nearest(p, shape, other))
            if self._divided:
                valid &= trim(ends, surfaces)
            first, second = (s.distance(ends[0])[1] for s in surfaces)
            valid &= (self._pairs.slack < 0) | (dr.norm(dr.cross(first, second)) > STEEP)
            a, b = (mi.Point3f(dr.select(valid, p, shape.o)) for p in ends)
            aside = mi.Vector3f(dr.cross(ends[1] - ends[0], first))
            sides = [mi.Point3f(a + dr.select(valid, s * aside, 0)) for s in (1, -1)]
        return [self._frames(), a, b, *sides]

    def point(self, positions: mi.Float, piece: mi.UInt32, t: mi.Float) -> tuple[mi.Point3f, mi.Vector3f]:
        """The points t in [0, 1) of pieces, attached to both surfaces; and their derivatives by t, detached.

        positions : of all vertices, those of the curves among them.
        """
        pairs = self._pairs.take(piece)
        with dr.suspend_grad():
            still = dr.detach(positions)
            a, b = (_vertex(still, self._first_of(k) + piece) for k in (0, 1))
            p, tangent = across(a, b, mi.Float64(t), pairs.surfaces(still))
        p = mi.Point3f(p)
        surfaces = [s.distance(mi.Vector3d(p)) for s in pairs.surfaces(positions)]
        normals, distances = zip(*((dr.detach(n), g - dr.detach(g)) for g, n in surfaces), strict=True)
        return stay_on(p, normals, distances, mi.Bool(True)), mi.Vector3f(tangent)

    def normals(self, positions: mi.Float, piece: mi.UInt32, p: mi.Point3f) -> list[mi.Vector3f]:
        """Of both surfaces at points p of pieces; detached."""
        surfaces = self._pairs.take(piece).surfaces(dr.detach(positions))
        return [mi.Vector3f(s.distance(mi.Vector3d(p))[1]) for s in surfaces]

    def blur(self, positions: mi.Float, piece: mi.UInt32, p: mi.Point3f, to_viewer: mi.Vector3f) -> mi.Float:
        """How far beside points p of pieces rays from a viewer may tell both surfaces apart: scene units. Detached.

        Along the ray, a cylinder is met with an error of its blur over the cosine to its normal n. Beside the piece,
        the distances of both surfaces, with the normals n and m, differ by |(n × m) × d| / |n·d m·d| of how far beside
        it the ray is, in the direction d.
        """
        q, d = mi.Vector3d(p), mi.Vector3d(to_viewer)
        surfaces = self._pairs.take(piece).surfaces(dr.detach(positions))
        normals, ω = [s.distance(q)[1] for s in surfaces], dr.normalize(d)
        apart = dr.maximum(dr.norm(dr.cross(dr.cross(*normals), ω)), STEEP)
        blurred = [s.blur(q + d) * dr.abs_dot(m, ω) for s, m in zip(surfaces, normals[::-1], strict=True)]
        return mi.Float((blurred[0] + blurred[1]) / apart)

    def is_met(
        self, positions: mi.Float, piece: mi.UInt32, p: mi.Point3f, ray: mi.Ray3f, q: mi.Point3f, slack: mi.Float
    ) -> mi.Bool:
        """Does a ray that passes close by a point p of a piece meet one of both surfaces there, at its point q, and not
        the other side of a sphere, behind which the curve is? slack : for rounding."""
        met, start, direction = mi.Bool(False), mi.Vector3d(ray.o), mi.Vector3d(ray.d)
        for s in self._pairs.take(piece).surfaces(dr.detach(positions)):
            off, n = s.distance(mi.Vector3d(q))
            facing = dr.dot(n, direction) * dr.dot(s.distance(mi.Vector3d(p))[1], direction) > 0
            met |= facing & (dr.abs(off) <= mi.Float64(slack) + s.blur(start))
        return met

    # ---------------------- As edges ----------------------

    @property
    def vertices(self) -> int:
        """Number of the vertices that stand for the curves."""
        return 4 * len(self._analytic) + VERTICES * self.capacity

    def _first_of(self, end: int) -> int:
        """The first vertex that is such an end."""
        return self._first + 4 * len(self._analytic) + end * self.capacity

    def as_edges(self, edges: Edges, vertices: int) -> Edges:
        """`edges`, and after them the pieces, as edges that are boundaries from everywhere."""
        return line_edges(edges, self.capacity, vertices + 4 * len(self._analytic))


def conic(shape: Surface, n: mi.Vector3d, d: mi.Float64) -> tuple[mi.Vector3d, mi.Vector3d, mi.Vector3d, mi.Bool]:
    """The curve in which the plane n·p = d cuts a shape, in its frame: m, u, v; and is there one?"""
    x = dr.abs(n.x) <= 0.5
    s = dr.normalize(dr.cross(n, mi.Vector3d(dr.select(x, 1, 0), dr.select(x, 0, 1), 0)))
    r = dr.safe_sqrt(1 - d * d)
    m, u, v = n * d, s * r, dr.cross(n, s) * r
    nz = dr.select(dr.abs(n.z) > UPRIGHT, n.z, UPRIGHT)
    ellipse = mi.Vector3d(0, 0, d / nz), mi.Vector3d(1, 0, -n.x / nz), mi.Vector3d(0, 1, -n.y / nz)
    flat = dr.squared_norm(mi.Vector2d(n.x, n.y))
    line = mi.Vector3d(n.x, n.y, 0) * (d / flat), mi.Vector3d(n.y, -n.x, 0) * dr.rsqrt(flat), mi.Vector3d(0)
    cylinder, disk = shape.is_a(Kind.CYLINDER), shape.is_a(Kind.DISK)
    choose = lambda a, b, c: dr.select(cylinder, b, dr.select(disk, c, a))
    exists = dr.select(disk, flat > IN_ONE_PLANE**2, cylinder | (dr.abs(d) < 1 - SUNK))
    return *(choose(*each) for each in zip((m, u, v), ellipse, line, strict=True)), exists


def arc(at: list, slot: mi.UInt32) -> tuple[mi.Float64, mi.Float64, mi.Bool]:
    """Where an arc begins with a bound, how long it is, and is there one? at : A, B, C of each bound, which holds where
    A cos φ + B sin φ + C >= 0."""
    arcs = []
    for A, B, C in at:
        size = dr.sqrt(A * A + B * B)
        arcs.append((dr.atan2(B, A), dr.safe_acos(-C / size), dr.abs(C) < size, -size >= C))
    whole = slot == BOUNDS
    start, valid = mi.Float64(0), dr.isfinite(at[0][2])
    for k, (middle, half, met, never) in enumerate(arcs):
        start = dr.select(slot == k, middle - half, start)
        valid &= ~never & dr.select(slot == k, met, ~(whole & met))
    span = mi.Float64(dr.two_pi)
    for k, ((A, B, C), (middle, half, met, _)) in enumerate(zip(at, arcs, strict=True)):
        sin, cos = dr.sincos(start)
        valid &= whole | (slot == k) | ~met | (A * cos + B * sin + C >= 0)
        turn = middle + half - start
        turn -= dr.two_pi * dr.floor(turn / dr.two_pi)
        span = dr.select(met & ~whole, dr.minimum(span, dr.select(slot == k, 2 * half, turn)), span)
    return start, span, valid


def interval(at: list, half: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
    """Start and length of the part of a line, from -half to half, where all bounds A s + C >= 0 hold."""
    lower, upper = mi.Float64(-half), mi.Float64(half)
    for A, _, C in at:
        s = -C / A
        lower = dr.select(A > 0, dr.maximum(lower, s), lower)
        upper = dr.select(A < 0, dr.minimum(upper, s), dr.select((A == 0) & (C < 0), lower, upper))
    return lower, upper - lower


def _overlapping(geometry: Geometry) -> list[tuple[int, int]]:
    """Pairs of an analytic shape and another shape whose boxes overlap, by their numbers in `Geometry.moving`. Of two
    analytic shapes, the second is the one to divide."""
    meshes, analytic = geometry.meshes, geometry.analytic
    boxes = np.array([(*b.min, *b.max) for b in (box_of(s) for s in (*meshes, *analytic))], np.float64)
    size = np.linalg.norm(boxes[:, 3:] - boxes[:, :3], axis=1)
    boxes[[*(is_grid(m) for m in meshes), *(False for _ in analytic)]] = np.nan  # which overlap nothing
    found = []
    for k, shape in enumerate(analytic):
        i = len(meshes) + k
        overlap = (boxes[i, :3] <= boxes[:, 3:]).all(1) & (boxes[:, :3] <= boxes[i, 3:]).all(1)
        for j in np.flatnonzero(overlap[: len(meshes)]):
            found.append((i, int(j)))
        for other in range(k):
            j = len(meshes) + other
            if overlap[j]:
                rank = lambda n, s: (s.class_name() == "Disk", -size[n])
                divided = i if rank(i, shape) > rank(j, analytic[other]) else j
                found.append((i + j - divided, divided))
    return found
