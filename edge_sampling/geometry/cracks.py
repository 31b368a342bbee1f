"""T-junctions and cracks: open edges that lie on one another, though they do not have their end points in common; and
the edges of things that stand side by side.

Where a vertex lies inside of an open edge, that edge is divided there, for the purpose of edges alone: the mesh that is
rendered stays as it is. Pieces that then have the same end points are one edge with a face on each side, at which there
is no hole. End points that are a little apart count as one: cracks that are narrower than a tolerance are closed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from . import meshes
from .device_edges import COPLANAR
from .edges import SLIVER, EdgeKind, Edges, Weld
from .meshes import Geometry
from .texture_lines import jumps_at_every_edge

#: An end point closer to the end of an edge than this, relative to its length, is not inside of it.
TOUCHES = 1e-3

#: An end point lies on an edge within this distance, relative to the length of the edge; end points are one within it,
#: relative to the shortest of their edges.
ON_EDGE = 1e-5

#: Edges are parallel within this sine.
PARALLEL = 1e-4

#: Edges of connected surfaces whose boxes meet are looked at if there are at most so many pairs of such surfaces.
SURFACES = 10**4

#: At most so many pairs of an edge and an end point near it are looked at: a soup of long triangles has too many.
PAIRS = 10**7


@dataclass(frozen=True)
class Cracks:
    """Where vertices lie on open edges, or beside the end points of others, and so join them; on the host.

    vertex : (J,), int64; index into `Geometry.positions`, as `ends`.
    ends : (J, 2), int64; of the edge on which it lies. Twice the same vertex: beside this one.
    at : (J,), where on that edge, from 0 to 1.
    mesh : (J, 2), int64; of the edge and of the vertex, index into `Geometry.meshes`.
    distance : (J,), how far it lies beside; 0 where that is mere rounding; scene units.
    tolerance : (J,), how far it may.
    """

    vertex: np.ndarray
    ends: np.ndarray
    at: np.ndarray
    mesh: np.ndarray
    distance: np.ndarray
    tolerance: np.ndarray

    @staticmethod
    def none() -> Cracks:
        index, number = np.zeros((0, 2), np.int64), np.zeros(0)
        return Cracks(index[:, 0], index, number, index, number, number)

    def __len__(self) -> int:
        return len(self.vertex)

    def __add__(self, other: Cracks) -> Cracks:
        return Cracks(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(Cracks)))

    def widest(self) -> dict[tuple[int, int], float]:
        """The widest crack between each two meshes, by their numbers, or within one: scene units."""
        found: dict[tuple[int, int], float] = {}
        for (i, j), width in zip(np.sort(self.mesh, axis=1).tolist(), self.distance.tolist(), strict=True):
            if width > 0:
                found[i, j] = max(found.get((i, j), 0.0), width)
        return found


@dataclass(frozen=True)
class _Open:
    """Open edges, and those beside other surfaces: (n,). ends : (n, 2), vertices. p : (n, 2, 3), their places. length,
    mesh : (n,)."""

    edges: Edges
    ends: np.ndarray
    p: np.ndarray
    length: np.ndarray
    mesh: np.ndarray

    @staticmethod
    def of(edges: Edges, p: np.ndarray) -> _Open:
        ends, length = edges.vertices[:, 0].astype(np.int64), np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
        return _Open(edges, ends, p, length, edges.mesh[:, 0].astype(np.int64))

    def tolerance(self, edge: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far beside an edge, or its ends, a point p may lie; and how far it does by mere rounding."""
        rounding = 8 * np.finfo(np.float32).eps * np.abs(p).max(1)
        return np.maximum(ON_EDGE * self.length[edge], rounding), rounding


def close_cracks(geometry: Geometry, edges: Edges, weld: Weld) -> tuple[Edges, Cracks]:
    """Join the edges that lie on one another. On the host, and cheap: only open edges take part, and those of surfaces
    whose boxes meet.

    Returns the edges, the joined ones last; and where they were joined, and where faces without area were left out.
    """
    edges, cracks = _join(geometry, edges, weld)
    return edges, cracks + _left_out(geometry, weld.slivers)


def _left_out(geometry: Geometry, slivers: np.ndarray) -> Cracks:
    """The corners of faces without area lie on edges, as long as there is none. slivers : see `Weld`."""
    if not len(slivers):
        return Cracks.none()
    p = geometry.host_positions()[slivers].astype(np.float64)
    along = p[:, 2] - p[:, 1]
    squared = np.square(along).sum(1)
    at = np.einsum("ij,ij->i", p[:, 0] - p[:, 1], along) / squared
    counts = np.cumsum([m.vertex_count() for m in geometry.meshes])
    mesh = np.repeat(np.searchsorted(counts, slivers[:, :1], side="right"), 2, axis=1)
    return Cracks(slivers[:, 0], slivers[:, 1:], at, mesh, np.zeros(len(at)), SLIVER * np.sqrt(squared))


def _join(geometry: Geometry, edges: Edges, weld: Weld) -> tuple[Edges, Cracks]:
    where = np.flatnonzero(edges.open | _beside_others(geometry, edges, weld.surface))
    if len(where) < 2:
        return edges, Cracks.none()
    p = geometry.host_positions()[edges.vertices[where, 0]].astype(np.float64)
    usable = np.isfinite(p).all((1, 2)) & (p[:, 0] != p[:, 1]).any(1)
    where, p = where[usable], p[usable]
    lone = _Open.of(edges.take(where), p)
    joint, joined = _join_ends(lone, weld)
    inside, long, end = _lie_inside(lone)
    if not len(joined) and not len(inside):
        return edges, Cracks.none()
    edge, piece, ends = _divide(joint, long, end, inside.at)
    used, new = _pair(geometry, lone, edge, piece, ends)
    if not len(used):
        return edges, Cracks.none()
    keep = np.ones(len(edges), bool)
    keep[where[used]] = False
    return edges.take(keep) + new, joined + inside


def _beside_others(geometry: Geometry, edges: Edges, surface: np.ndarray) -> np.ndarray:
    """Which edges between two faces of a mesh may lie on edges of another surface, as those of boxes that stand side by
    side, flush at the front: (E,), bool. Not those at which nothing jumps, whether seen or as a silhouette.

    surface : see `Weld`.
    """
    found = np.zeros(len(edges), bool)
    if not len(edges):
        return found
    positions = geometry.host_positions()
    ends = positions[edges.vertices[:, 0]]
    ends = ends.min(1), ends.max(1)
    order = np.argsort(surface, kind="stable")
    first = np.flatnonzero(np.diff(surface[order], prepend=-1))
    low, high = np.minimum.reduceat(ends[0][order], first), np.maximum.reduceat(ends[1][order], first)
    slack = ON_EDGE * (high - low).max(1, keepdims=True)
    low, high = low - slack, high + slack
    bends = (edges.count == 2) & (edges.kind != EdgeKind.SMOOTH) & (edges.mesh[:, 0] == edges.mesh[:, 1])
    bends &= ~_is_coplanar(edges, positions)
    own = np.split(order, first[1:])
    for i, j in _meet(low, high):
        which = own[i][bends[own[i]]]
        found[which] |= (ends[0][which] <= high[j]).all(1) & (ends[1][which] >= low[j]).all(1)
    return found


def _meet(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Pairs of boxes that meet, in both orders: (P, 2). None, if there are more than `SURFACES`."""
    order = np.argsort(low[:, 0], kind="stable")
    low, high, n = low[order], high[order], len(order)
    # Along the first axis, each box meets those that begin before it ends.
    count = np.maximum(np.searchsorted(low[:, 0], high[:, 0], side="right") - np.arange(n) - 1, 0)
    if count.sum() > PAIRS:
        return np.zeros((0, 2), np.int64)
    i = np.repeat(np.arange(n), count)
    j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + i + 1
    meet = (low[i] <= high[j]).all(1) & (low[j] <= high[i]).all(1)
    pairs = order[np.stack([i[meet], j[meet]], 1)]
    return np.concatenate([pairs, pairs[:, ::-1]]) if 2 * len(pairs) <= SURFACES else np.zeros((0, 2), np.int64)


def _is_coplanar(edges: Edges, p: np.ndarray) -> np.ndarray:
    """Do both faces of edges lie in one plane? (E,), bool."""
    a, b = (p[edges.vertices[:, 0, k]].astype(np.float64) for k in (0, 1))
    n = [np.cross(b - a, p[edges.opposite[:, side]] - a) for side in (0, 1)]
    sine = np.linalg.norm(np.cross(*n), axis=1)
    return sine <= COPLANAR * np.linalg.norm(n[0], axis=1) * np.linalg.norm(n[1], axis=1)


def _join_ends(lone: _Open, weld: Weld) -> tuple[np.ndarray, Cracks]:
    """A number for each end point, (n, 2), equal for those that count as one; and which were joined."""
    place, first, number = np.unique(weld.place[lone.ends], return_index=True, return_inverse=True)
    number = number.reshape(-1, 2)
    edge, p, vertex = first // 2, lone.p.reshape(-1, 3)[first], lone.ends.ravel()[first]
    shortest = np.full(len(place), np.inf)
    np.minimum.at(shortest, number.ravel(), np.repeat(lone.length, 2))
    tree, radius = cKDTree(p), ON_EDGE * shortest
    count = tree.query_ball_point(p, radius, return_length=True)
    several = np.flatnonzero(count > 1)
    if len(several) == 0:
        return number, Cracks.none()
    a = np.repeat(several, count[several])
    b = np.concatenate(tree.query_ball_point(p[several], radius[several])).astype(np.int64)
    distance = np.linalg.norm(p[a] - p[b], axis=1)
    both = (a < b) & (distance <= radius[b])
    a, b, distance = a[both], b[both], distance[both]
    n = len(place)
    joint = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)[1]
    tolerance, rounding = np.minimum(radius[a], radius[b]), lone.tolerance(edge[b], p[b])[1]
    mesh = np.stack([lone.mesh[edge[a]], lone.mesh[edge[b]]], 1)
    wide = np.where(distance > rounding, distance, 0)
    return joint[number], Cracks(vertex[b], np.stack([vertex[a]] * 2, 1), np.zeros(len(a)), mesh, wide, tolerance)


def _lie_inside(lone: _Open) -> tuple[Cracks, np.ndarray, np.ndarray]:
    """Which end points of edges lie inside of other edges that run the same way. Besides: of which edge, (J,), and
    which end points, 2 e + k."""
    middle, axis = lone.p.mean(1), (lone.p[:, 1] - lone.p[:, 0]) / lone.length[:, None]
    # The ball about an edge, without its own end points.
    tree, radius = cKDTree(lone.p.reshape(-1, 3)), 0.5 * lone.length * (1 - 2 * TOUCHES)
    count = tree.query_ball_point(middle, radius, return_length=True)
    near = np.flatnonzero(count)
    near = near[np.cumsum(count[near]) <= PAIRS]
    if len(near) == 0:
        return Cracks.none(), near, near
    end = np.concatenate(tree.query_ball_point(middle[near], radius[near])).astype(np.int64)
    long, short = np.repeat(near, count[near]), end // 2
    point, beyond = lone.p[short, end % 2], lone.p[short, 1 - end % 2]
    beside = lambda q: np.linalg.norm(np.cross(q - middle[long], axis[long]), axis=1)
    tolerance, rounding = lone.tolerance(long, point)
    distance = beside(point)
    on = (distance < tolerance) & (beside(beyond) < tolerance + PARALLEL * lone.length[short])
    long, short, end, point, distance, tolerance = (x[on] for x in (long, short, end, point, distance, tolerance))
    at = np.einsum("ij,ij->i", point - lone.p[long, 0], axis[long]) / lone.length[long]
    mesh, wide = np.stack([lone.mesh[long], lone.mesh[short]], 1), np.where(distance > rounding[on], distance, 0)
    return Cracks(lone.ends.ravel()[end], lone.ends[long], at, mesh, wide, tolerance), long, end


def _divide(
    joint: np.ndarray, long: np.ndarray, end: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pieces into which edges are divided at the end points of others; an edge at which none lies is one piece.

    Returns of which edge each is, (P,); from where to where on it, (P, 2); and the numbers of its end points, (P, 2).
    """
    n = len(joint)
    edge = np.concatenate([np.arange(n), np.arange(n), long])
    place = np.concatenate([np.zeros(n), np.ones(n), at])
    number = np.concatenate([joint[:, 0], joint[:, 1], joint.ravel()[end]])
    # The same point may be an end of several edges.
    first = np.unique(np.stack([edge, number], 1), axis=0, return_index=True)[1]
    order = first[np.lexsort((place[first], edge[first]))]
    edge, place, number = edge[order], place[order], number[order]
    start = np.flatnonzero(edge[1:] == edge[:-1])
    pairs = lambda x: np.stack([x[start], x[start + 1]], 1)
    return edge[start], pairs(place), pairs(number)


def _pair(
    geometry: Geometry, lone: _Open, edge: np.ndarray, piece: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, Edges]:
    """Make one edge of all pieces with the same end points, see `_divide`.

    Returns which edges have such a piece, and what takes their place.
    """
    key = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    shared = np.bincount(key)[key] > 1
    used = np.unique(edge[shared])
    here = np.isin(edge, used)
    edge, piece, ends, key = edge[here], piece[here], ends[here], key[here]
    # Those with two faces first, which stand for all with the same end points.
    order = np.lexsort((-lone.edges.count[edge].astype(np.int64), key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(first, len(order)))
    a, b = order[first], order[first + np.minimum(count - 1, 1)]
    of = lone.edges
    closed, turn = of.count[edge[a]] == 2, ends[a, 0] != ends[b, 0]
    vertices, part = np.stack([lone.ends[edge[a]], lone.ends[edge[b]]], 1), np.stack([piece[a], piece[b]], 1)
    vertices[turn, 1] = vertices[turn, 1, ::-1]
    part[turn, 1] = 1 - part[turn, 1, ::-1]
    vertices[closed, 1], part[closed, 1] = of.vertices[edge[a][closed], 1], part[closed, 0]
    opposite = np.stack([of.opposite[edge[a], 0], of.opposite[edge[b], 0]], 1)
    opposite[closed, 1] = of.opposite[edge[a][closed], 1]
    mesh = np.stack([lone.mesh[edge[a]], lone.mesh[edge[b]]], 1)
    even = np.array([_is_even(m) for m in geometry.meshes])[mesh[:, 0]]
    # As where sides are whole: of faces that run through it in the same direction, one shows its back.
    flat = even & ~closed & (count == 2) & turn & (mesh[:, 0] == mesh[:, 1])
    new = Edges(
        vertices=vertices.astype(np.uint32),
        opposite=opposite,
        mesh=mesh.astype(np.uint32),
        kind=np.select([count == 1, flat], [of.kind[edge[a]], EdgeKind.FLAT], EdgeKind.JUMP).astype(np.uint8),
        count=np.add.reduceat(of.count[edge[order]], first).astype(np.uint32),
        is_line=np.zeros(len(a), bool),
        part=part.astype(np.float32),
        joined=np.ones(len(a), bool),
    )
    return used, new


def _is_even(mesh: object) -> bool:
    """Is the plane of its faces all that differs between the faces of a mesh?"""
    varies = meshes.has_interpolated_normals(mesh) or jumps_at_every_edge(mesh)
    return not varies and meshes.vertex_values(mesh).shape[1] == 0
