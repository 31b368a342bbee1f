"""Open edges that lie on one another without having their end points in common (T-junctions): they are not welded, so a
jump counts twice."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from .edges import Edges
from .meshes import Geometry

#: An end point closer to the end of an edge than this, relative to its length, is not inside of it.
TOUCHES = 1e-3

#: An end point lies on an edge within this distance, relative to the length of the edge; edges are parallel within this
#: sine.
ON_EDGE = 1e-5
PARALLEL = 1e-4

#: At most so many pairs of an edge and an end point near it are looked at: a soup of long triangles has too many.
PAIRS = 10**7


def t_junctions(geometry: Geometry, edges: Edges) -> set[tuple[int, int]]:
    """Pairs of meshes, by their numbers, of which an open edge of one lies on an open edge of the other, from a point
    inside of this one on; a mesh may form a pair with itself. On the host, and cheap: only open edges take part."""
    edges = edges.take(edges.open)
    if len(edges) < 2:
        return set()
    ends = geometry.host_positions()[edges.vertices[:, 0]].astype(np.float64)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    usable = np.isfinite(length) & (length > 0)
    edges, ends, length = edges.take(usable), ends[usable], length[usable]
    if len(edges) < 2:
        return set()
    middle, axis = ends.mean(1), (ends[:, 1] - ends[:, 0]) / length[:, None]
    # The ball about an edge, without its own end points.
    tree, radius = cKDTree(ends.reshape(-1, 3)), 0.5 * length * (1 - 2 * TOUCHES)
    count = tree.query_ball_point(middle, radius, return_length=True)
    near = np.flatnonzero(count)
    near = near[np.cumsum(count[near]) <= PAIRS]
    if len(near) == 0:
        return set()
    found = np.concatenate(tree.query_ball_point(middle[near], radius[near])).astype(np.int64)
    long, short, end = np.repeat(near, count[near]), found // 2, found % 2
    inside, beyond = ends[short, end], ends[short, 1 - end]
    # Distances from the line of the long edge; single precision may tell no more.
    distance = [np.linalg.norm(np.cross(q - middle[long], axis[long]), axis=1) for q in (inside, beyond)]
    tolerance = np.maximum(ON_EDGE * length[long], 8 * np.finfo(np.float32).eps * np.abs(inside).max(1))
    on = (distance[0] < tolerance) & (distance[1] < tolerance + PARALLEL * length[short])
    pairs = np.sort(np.stack([edges.mesh[long[on], 0], edges.mesh[short[on], 0]], 1), axis=1)
    return {(int(a), int(b)) for a, b in np.unique(pairs, axis=0)}
