"""A bounding volume hierarchy over the edges of a scene, on the device: built once, refitted as vertices move.

Every node says where its edges are (a box), how long they are together, and how their planes lie: a face plane is
written q = (n, d), so that with y = (p, −1) the sign of q·y tells on which side a point p is. An edge is a silhouette
as seen from p where its two planes differ in that sign. A node keeps a box around its planes, which rejects, and their
first two moments, from which the expected number of silhouettes follows (`edge_importance.py`).
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

#: Edges of a leaf. They are tested one by one.
LEAF = 8


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
    """An edge in a leaf: end points relative to the centre of the tree, its two planes; 1 if it is always a boundary, 0
    if as a silhouette only; and 1 if it is a crease, see `Node`."""

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
    """Complete binary trees over groups of edges, one beside the other in flat arrays.

    The order of the edges in the leaves is found once, by halving each node at the median along its longest side; it
    stays good enough while a shape moves or deforms moderately. All else is computed from the vertex positions by
    `refit`, level by level on the device.

    Parameters
    ----------
    geometry : the meshes.
    edges : their edges, on the host.
    groups : indices into `edges`, a tree for each; without the empty ones.
    always : (E,), bool, which edges count from wherever they are seen, besides open ones; None: no others.
    """

    _NUMBERS = ("leaf_size", "leaves", "bottoms", "device_node_offsets", "device_leaf_offsets")
    DRJIT_STRUCT = dict.fromkeys(  # for `dr.freeze`
        ("device_edges", "centre", "slot_edge", "_used", "_open", "nodes", "slots", *_NUMBERS)
    )

    def __init__(self, geometry: Geometry, edges: Edges, groups: list[np.ndarray], always: np.ndarray | None = None):
        self.geometry = geometry
        self.device_edges = DeviceEdges(edges, geometry)
        position = geometry.host_positions()
        ends = position[edges.vertices[:, 0]]
        ends = np.where(np.isfinite(ends), ends, 0)
        centres = ends[:, 0] + edges.part[:, 0].mean(1, keepdims=True) * (ends[:, 1] - ends[:, 0])
        # Opaque, like the offsets below: scenes that differ in numbers only share their kernels.
        self.centre = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in np.median(centres, axis=0)))
        slots, self.leaves, leaf_size = [], [], 0
        self.node_offsets, self.leaf_offsets = [0], [0]
        for group in groups:
            order = _order(centres[group])
            slots.append(np.where(order < 0, -1, group[order]))
            leaves = len(order)
            leaf_size = max(leaf_size, int((order >= 0).sum(1).max()))
            self.leaves.append(leaves)
            self.node_offsets.append(self.node_offsets[-1] + 2 * leaves)
            self.leaf_offsets.append(self.leaf_offsets[-1] + leaves)
        opaque = lambda numbers: [dr.opaque(mi.UInt32, x) for x in numbers]
        self.leaf_size = dr.opaque(mi.UInt32, leaf_size)
        self.bottoms = opaque(self.leaves)
        self.device_node_offsets, self.device_leaf_offsets = map(opaque, (self.node_offsets, self.leaf_offsets))
        slot = np.concatenate(slots).reshape(-1)
        self.slot_edge = mi.UInt32(np.maximum(slot, 0).astype(np.uint32))
        self._used = mi.Bool(slot >= 0)
        always = edges.count != 2 if always is None else (edges.count != 2) | always
        self._open = mi.Bool(always[np.maximum(slot, 0)])
        #: An array for each packet: several scatters to one array would be as many kernels.
        self.nodes = _zeros(NODE_PACKETS, self.node_offsets[-1])
        self.slots = _zeros(SLOT_PACKETS, self.leaf_offsets[-1] * LEAF)
        # Of the time that the refit of a small tree takes, 95 % are for tracing the same program again.
        self._recorded = dr.freeze(EdgeTree._fitted)

    @property
    def bytes(self) -> int:
        """Memory of the tree on the device, without the edges that it is over."""
        words = sum(dr.width(a) for a in (*self.nodes, *self.slots, self.slot_edge))
        return 4 * words + 2 * dr.width(self._used)

    # ---------------------- Access ----------------------

    def node(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Node:
        """Nodes by their number in all trees together. Of tree k, the root is number `node_offsets[k]` + 1; children
        of its node i are 2i and 2i + 1."""
        return Node.unpack(_gather(self.nodes, index, active))

    def slot(self, index: mi.UInt32, active: mi.Bool | bool = True) -> Slot:
        return Slot.unpack(_gather(self.slots, index, active))

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
            slot = dr.arange(mi.UInt32, dr.width(self.slot_edge))
            slots = _packed(self._slots_of(positions, slot))
            levels: list[list[mi.Float]] = []
            for leaves, first in zip(self.leaves, self.leaf_offsets, strict=False):
                levels += self._levels(slots, leaves, first)
            return [dr.concat(list(packets)) for packets in zip(*levels, strict=True)], slots

    def _levels(self, slots: list[mi.Float], leaves: int, first: int) -> list[list[mi.Float]]:
        """The nodes of one tree, from the first level to the leaves. Each level is an array of its own: Dr.Jit would
        copy one that has all of them before it writes each next level."""
        # Opaque offsets: all levels share one kernel.
        below = _packed(self._leaf(slots, LEAF * (dr.arange(mi.UInt32, leaves) + dr.opaque(mi.UInt32, first))))
        levels, start = [below], leaves
        for level in reversed(range((leaves - 1).bit_length())):
            begin, end = 2**level, min(2 ** (level + 1), leaves)
            child = 2 * dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, 2 * begin - start)
            merged = _packed(_merge(*(Node.unpack(_gather(below, child + k)) for k in (0, 1))))
            levels.insert(0, merged)
            # Of the last level but one, the rest are leaves.
            below = merged if end == 2 * begin else [dr.concat(list(p)) for p in zip(merged, below, strict=True)]
            start = begin
        return [_zeros(NODE_PACKETS, 1), *levels]

    def _slots_of(self, positions: mi.Float, slot: mi.UInt32) -> Slot:
        device_edges = self.device_edges
        edge = self.slot_edge
        a, b = device_edges.end_points(positions, edge)
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
        usable = self._used & dr.isfinite(dr.squared_norm(a)) & dr.isfinite(dr.squared_norm(b))
        a, b = dr.select(usable, a, 0), dr.select(usable, b, 0)
        crease = device_edges.crease(edge, dr.norm(dr.cross(flat[0], flat[1])))
        crease = dr.select(usable & ~always, crease, 0)
        return Slot(a, b, tuple(dr.select(usable, q, 0) for q in planes), mi.Float(always & usable), crease)

    def _leaf(self, slots: list[mi.Float], first: mi.UInt32) -> Node:
        nodes = [self._single(Slot.unpack(_gather(slots, first + k))) for k in range(LEAF)]
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


# ---------------------- Order ----------------------


def _order(centres: np.ndarray) -> np.ndarray:
    """Edges of each leaf: (leaves, LEAF), indices into `centres`, -1 for none. Leaf k is node number `leaves` + k."""
    n = len(centres)
    leaves = -(-n // LEAF)
    size = -(-n // leaves)
    order = np.full(leaves * size, -1)
    order[:n] = np.arange(n)
    # What fills up sorts to the end.
    padded = np.concatenate([centres, np.full((1, 3), np.nan)]).astype(np.float32)
    order = _from_left_to_right(padded, order[None], leaves)
    # Leaves of the last level come after those of the last level but one.
    order = np.roll(order.reshape(leaves, size), -_in_last_level(leaves), axis=0)
    return np.concatenate([order, np.full((leaves, LEAF - size), -1)], axis=1)


def _from_left_to_right(centres: np.ndarray, order: np.ndarray, leaves: int) -> np.ndarray:
    """Halve sets of edges until they are leaves, and return these from left to right: of (sets, edges), in so many
    leaves each, (sets * leaves, edges of a leaf)."""
    while leaves > 1:
        half = 1 << (leaves - 1).bit_length() - 1
        left = (half + min(_in_last_level(leaves), half)) // 2
        where = left * (order.shape[1] // leaves)
        order = _parted(centres, order, where)
        if 2 * left != leaves:
            sides = (order[:, :where], left), (order[:, where:], leaves - left)
            return np.concatenate([_from_left_to_right(centres, *side) for side in sides])
        order, leaves = order.reshape(2 * len(order), -1), left
    return order


def _parted(centres: np.ndarray, order: np.ndarray, where: int) -> np.ndarray:
    """Each set of edges, such that no edge before `where` is beyond one after it, along its longest side."""
    c = centres[order]
    with np.errstate(invalid="ignore"):
        extent = np.fmax.reduce(c, axis=1) - np.fmin.reduce(c, axis=1)
    axis = np.nan_to_num(extent, nan=-1.0).argmax(1)
    key = np.take_along_axis(c, axis[:, None, None], axis=2)[..., 0]
    return np.take_along_axis(order, np.argpartition(key, where, axis=1), axis=1)


def _in_last_level(leaves: int) -> int:
    """How many of the leaves of a complete tree are in its last level."""
    return 2 * leaves - (1 << (leaves - 1).bit_length())
