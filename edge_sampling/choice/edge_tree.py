"""A bounding volume hierarchy over the edges of a scene, on the device: built once, refitted as vertices move.

Every node says where its edges are (a box), how long they are together, and how their planes lie: a face plane is
written q = (n, d), so that with y = (p, −1) the sign of q·y tells on which side a point p is. An edge is a silhouette
as seen from p where its two planes differ in that sign. A node keeps a box around its planes, which rejects, and their
first two moments, from which the expected number of silhouettes follows (`importance.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._collection import no_collection
from rimlight.edge_sampling.geometry.beside import EDGE_ON
from rimlight.edge_sampling.geometry.device_edges import DeviceEdges
from rimlight.edge_sampling.geometry.edges import Edges
from rimlight.edge_sampling.geometry.meshes import Geometry

from .edge_order import LEAF, order, pieces


@dataclass
class Node:
    """What is known of a set of edges; positions are relative to the centre of the tree.

    silhouettes : length of the edges that may be silhouettes, scene units.
    always : length of the edges that are boundaries from wherever they are seen: open ones, and where more than two
        faces meet.
    creases : length of the others across which what is seen may jump, though both faces are seen.
    lower, upper : box around them.
    mean : of the planes of `silhouettes`, weighted by length.
    variance : of the same: 10 numbers, the upper triangle of a symmetric matrix.
    difference : second moment of the difference between the two planes of an edge, likewise.
    plane_lower, plane_upper : box around the planes.
    """

    silhouettes: mi.Float
    always: mi.Float
    creases: mi.Float
    lower: list[mi.Float]
    upper: list[mi.Float]
    mean: list[mi.Float]
    variance: list[mi.Float]
    difference: list[mi.Float]
    plane_lower: list[mi.Float]
    plane_upper: list[mi.Float]

    def pack(self) -> list[mi.Vector4f]:
        """In packets, as they are stored."""
        numbers = [self.silhouettes, self.always, self.creases]
        for field in fields(self)[3:]:
            numbers += getattr(self, field.name)
        numbers += [mi.Float(0)] * (4 * NODE_PACKETS - len(numbers))
        return [mi.Vector4f(*numbers[i : i + 4]) for i in range(0, len(numbers), 4)]

    @staticmethod
    def unpack(packets: list[mi.Vector4f]) -> Node:
        numbers = [x for packet in packets for x in packet]
        parts, start = [], 3
        for size in (3, 3, 4, 10, 10, 4, 4):
            parts.append(numbers[start : start + size])
            start += size
        return Node(*numbers[:3], *parts)


#: Packets of four numbers that make a `Node`, and an edge in a leaf.
NODE_PACKETS, SLOT_PACKETS = 11, 4


@dataclass
class Slot:
    """An edge in a leaf, or a piece of one: end points relative to the centre of the tree, its two planes; 1 if it is
    always a boundary, 0 if as a silhouette only; and 1 if it is a crease, see `Node`."""

    a: mi.Vector3f
    b: mi.Vector3f
    planes: tuple[mi.Vector4f, mi.Vector4f]
    always: mi.Float
    crease: mi.Float

    def pack(self) -> list[mi.Vector4f]:
        a, b = self.a, self.b
        return [*self.planes, mi.Vector4f(a.x, a.y, a.z, self.always), mi.Vector4f(b.x, b.y, b.z, self.crease)]

    @staticmethod
    def unpack(packets: list[mi.Vector4f]) -> Slot:
        p, q, a, b = packets
        return Slot(mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(b.x, b.y, b.z), (p, q), a.w, b.w)


class EdgeTree:
    """Binary trees over groups of edges, in flat arrays: inner nodes first, level by level, then leaves.

    The order of the edges in the leaves is found once, see `order`; it stays good enough while a shape moves or deforms
    moderately. All else is computed from the vertex positions by `refit`, level by level on the device.

    Parameters
    ----------
    geometry : the meshes.
    edges : their edges, on the host.
    groups : indices into `edges`, a tree for each; without the empty ones.
    always : (E,), bool, which edges count from wherever they are seen, besides open ones; None: no others.

    Attributes
    ----------
    roots : mi.UInt32 each, the root of each tree.
    inner : mi.UInt32, number of inner nodes. is_deep : are there any? leaves : number of leaves.
    slot_edge : mi.UInt32, of which edge each slot of a leaf holds a piece.
    """

    _NUMBERS = ("roots", "inner", "is_deep", "leaves", "_children", "_first", "_levels")
    DRJIT_STRUCT = dict.fromkeys(  # for `dr.freeze`
        ("device_edges", "centre", "slot_edge", "_part", "_open", "nodes", "slots", *_NUMBERS)
    )

    def __init__(self, geometry: Geometry, edges: Edges, groups: list[np.ndarray], always: np.ndarray | None = None):
        self.geometry = geometry
        self.device_edges = DeviceEdges(edges, geometry)
        position = geometry.host_positions()
        ends = position[edges.vertices[:, 0]]
        ends = np.where(np.isfinite(ends), ends, 0)
        ends = ends[:, :1] + edges.part[:, 0, :, None] * (ends[:, 1:] - ends[:, :1])
        # Where shapes cut through each other, the lines are numbered anew at each place: what is long does not stay so.
        edge, part = pieces(np.where(edges.is_line, 0, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))
        centres = ends[edge, 0] + part.mean(1, keepdims=True) * (ends[edge, 1] - ends[edge, 0])
        # Opaque, like what follows: scenes that differ in numbers only share their kernels.
        self.centre = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in np.median(centres, axis=0)))
        tree = order(centres, [np.flatnonzero(np.isin(edge, g)) for g in groups], edges.is_line[edge])
        self.leaves, inner = tree.leaves, len(tree.children)
        self.roots = [dr.opaque(mi.UInt32, int(n)) for n in tree.roots]
        self.inner, self.is_deep = dr.opaque(mi.UInt32, inner), inner > 0
        index = lambda a: mi.UInt32(np.ascontiguousarray(a, np.uint32))
        self._children = index(tree.children.ravel() if inner else [0, 0])  # Dr.Jit 1.5 cannot freeze empty arrays
        self._first, self._levels = index(tree.first), tree.levels
        self.slot_edge = index(edge[tree.items])
        #: From where to where on its edge a slot extends; None: no edge is in pieces.
        self._part = [mi.Float(end.copy()) for end in part[tree.items].T] if len(edge) > len(edges) else None
        always = edges.count != 2 if always is None else (edges.count != 2) | always
        self._open = mi.Bool(always[edge[tree.items]])
        #: An array for each packet: several scatters to one array would be as many kernels.
        self.nodes = _zeros(NODE_PACKETS, inner + tree.leaves)
        self.slots = _zeros(SLOT_PACKETS, len(tree.items))
        # Of the time that the refit of a small tree takes, 95 % are for tracing the same program again.
        self._recorded = dr.freeze(EdgeTree._fitted)

    @property
    def bytes(self) -> int:
        """Memory of the tree on the device, without the edges that it is over."""
        words = [*self.nodes, *self.slots, self.slot_edge, self._children, self._first, *(self._part or ())]
        return 4 * sum(map(dr.width, words)) + dr.width(self._open)

    def node(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Node:
        """Nodes by their number in all trees together."""
        return Node.unpack(_gather(self.nodes, index, active))

    def children(self, node: mi.UInt32, active: mi.Bool | bool = True) -> mi.Vector2u:
        """Of inner nodes, the numbers of both."""
        return dr.gather(mi.Vector2u, self._children, node, active)

    def slots_of(self, node: mi.UInt32, active: mi.Bool | bool = True) -> tuple[mi.UInt32, mi.UInt32]:
        """The first slot of a leaf, and how many it has."""
        first, end = (dr.gather(mi.UInt32, self._first, node - self.inner + k, active) for k in (0, 1))
        return first, end - first

    def slot(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Slot:
        return Slot.unpack(_gather(self.slots, index, active))

    def part(self, slot: mi.UInt32, active: mi.Bool | bool = True) -> tuple[mi.Float, mi.Float]:
        """From where to where on its edge a slot extends: 0 and 1, unless that is in pieces."""
        if self._part is None:
            return mi.Float(0), mi.Float(1)
        return tuple(dr.gather(mi.Float, end, slot, active) for end in self._part)

    # ---------------------- Refit ----------------------

    def refit(self, positions: mi.Float) -> None:
        """Follow the vertices to `positions`, (3 V,), world space; detached."""
        if dr.flag(dr.JitFlag.FreezingScope):
            self.nodes, self.slots = self._fitted(positions)  # as a part of what is being recorded
            return
        # What there was would be an argument, and stay in memory beside what comes.
        self.nodes, self.slots = [], []
        with no_collection():
            self.nodes, self.slots = self._recorded(self, positions)

    def _fitted(self, positions: mi.Float) -> tuple[list[mi.Float], list[mi.Float]]:
        """Nodes and slots for these positions."""
        with dr.suspend_grad():
            slots = _packed(self._slots_of(positions))
            leaves = _packed(self._leaf(slots, self.inner + dr.arange(mi.UInt32, self.leaves)))
            # Each level is an array of its own: Dr.Jit would copy one that has all of them before it writes each next
            # level. Opaque offsets: all levels share one kernel.
            levels, end = [leaves], sum(self._levels)
            for count in reversed(self._levels):
                begin = end - count
                children = self.children(dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, begin))
                nodes = [self._below(c, levels[0], dr.opaque(mi.UInt32, end), leaves) for c in children]
                levels.insert(0, _packed(_merge(*nodes)))
                end = begin
            return [dr.concat(list(packets)) for packets in zip(*levels, strict=True)], slots

    def _below(self, child: mi.UInt32, level: list[mi.Float], first: mi.UInt32, leaves: list[mi.Float]) -> Node:
        """Nodes of the level that begins with number `first`, or leaves."""
        is_leaf = child >= self.inner
        of_level, of_leaves = _gather(level, child - first, ~is_leaf), _gather(leaves, child - self.inner, is_leaf)
        return Node.unpack([dr.select(is_leaf, p, q) for p, q in zip(of_leaves, of_level, strict=True)])

    def _slots_of(self, positions: mi.Float) -> Slot:
        device_edges = self.device_edges
        edge = self.slot_edge
        a, b = device_edges.end_points(positions, edge)
        if self._part is not None:
            a, b = (dr.lerp(a, b, end) for end in self._part)
        m = device_edges.normals(positions, edge)
        lengths = [dr.norm(n) for n in m]
        flat = [dr.select(length > 0, n / length, 0) for n, length in zip(m, lengths, strict=True)]
        planes = []
        a, b = mi.Vector3f(a - self.centre), mi.Vector3f(b - self.centre)
        for n in (flat[0], -flat[1]):
            planes.append(mi.Vector4f(n.x, n.y, n.z, dr.dot(n, a)))
        always = self._open | (lengths[0] == 0) | (lengths[1] == 0)
        # What is always a boundary has no planes, but signs that always differ.
        for k, d in ((0, -1), (1, 1)):
            planes[k] = dr.select(always, mi.Vector4f(0, 0, 0, d), planes[k])
        usable = dr.isfinite(dr.squared_norm(a)) & dr.isfinite(dr.squared_norm(b))
        a, b = dr.select(usable, a, 0), dr.select(usable, b, 0)
        crease = device_edges.crease(edge, dr.norm(dr.cross(flat[0], flat[1])))
        crease = dr.select(usable & ~always, crease, 0)
        return Slot(a, b, tuple(dr.select(usable, q, 0) for q in planes), mi.Float(always & usable), crease)

    def _leaf(self, slots: list[mi.Float], node: mi.UInt32) -> Node:
        first, count = self.slots_of(node)
        nodes = [self._single(Slot.unpack(_gather(slots, first + k, k < count))) for k in range(LEAF)]
        while len(nodes) > 1:
            nodes = [_merge(p, q) for p, q in zip(nodes[::2], nodes[1::2], strict=True)]
        return nodes[0]

    @staticmethod
    def _single(s: Slot) -> Node:
        length = dr.norm(s.b - s.a)
        q, r = s.planes
        Δ = q - r
        difference = [Δ[i] * Δ[j] for i, j in _TRIANGLE]
        used = length > 0
        widest = lambda f, empty: [dr.select(used, f(x, y), empty) for x, y in zip(s.a, s.b, strict=True)]
        # Twice as wide as what the test of a single edge lets pass.
        slack = 8 * EDGE_ON * mi.Vector4f(1, 1, 1, dr.norm(s.a) + dr.norm(s.b))
        return Node(
            length * (1 - s.always),
            length * s.always,
            length * s.crease,
            widest(dr.minimum, dr.inf),
            widest(dr.maximum, -dr.inf),
            list(0.5 * (q + r)),
            [x / 12 for x in difference],
            difference,
            list(dr.select(used, dr.minimum(q, r) - slack, dr.inf)),
            list(dr.select(used, dr.maximum(q, r) + slack, -dr.inf)),
        )


# ---------------------- Merging ----------------------

_TRIANGLE = [(i, j) for i in range(4) for j in range(i, 4)]


def _merge(p: Node, q: Node) -> Node:
    total = p.silhouettes + q.silhouettes
    w = dr.select(total > 0, q.silhouettes / total, 0)
    blend = lambda x, y: [dr.lerp(s, t, w) for s, t in zip(x, y, strict=True)]
    pairwise = lambda f, x, y: [f(s, t) for s, t in zip(x, y, strict=True)]
    δ = [t - s for s, t in zip(p.mean, q.mean, strict=True)]
    between = w * (1 - w)
    variance = [v + between * δ[i] * δ[j] for v, (i, j) in zip(blend(p.variance, q.variance), _TRIANGLE, strict=True)]
    return Node(
        total,
        p.always + q.always,
        p.creases + q.creases,
        pairwise(dr.minimum, p.lower, q.lower),
        pairwise(dr.maximum, p.upper, q.upper),
        blend(p.mean, q.mean),
        variance,
        blend(p.difference, q.difference),
        pairwise(dr.minimum, p.plane_lower, q.plane_lower),
        pairwise(dr.maximum, p.plane_upper, q.plane_upper),
    )


def _gather(sources: list[mi.Float], index: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.Vector4f]:
    return [dr.gather(mi.Vector4f, source, index, active) for source in sources]


def _zeros(packets: int, count: int) -> list[mi.Float]:
    return [dr.zeros(mi.Float, 4 * count) for _ in range(packets)]


def _packed(what: Node | Slot) -> list[mi.Float]:
    packed = [dr.ravel(packet) for packet in what.pack()]
    dr.eval(packed)
    return packed
