"""Meshes that meet in lines which are no edges, or edges of both.

Where meshes cut through each other, the line of the cut is no edge, so its jump cannot be sampled. Where open edges lie
on one another without having their end points in common (a T-junction), they are not welded, so a jump counts twice.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from .device_edges import DeviceEdges
from .edges import Edges
from .meshes import Geometry

#: An edge that ends on a face, or lies in it, does not cut it. Relative to its length; cosine of the angle.
TOUCHES = 1e-3

#: An end point lies on an edge within this distance, relative to the length of the edge; edges are parallel within this
#: sine.
ON_EDGE = 1e-5
PARALLEL = 1e-4

#: At most so many pairs of an edge and an end point near it are looked at: a soup of long triangles has too many.
PAIRS = 10**7


def intersecting_meshes(scene: mi.Scene, geometry: Geometry, edges: Edges) -> set[tuple[int, int]]:
    """Pairs of meshes, by their numbers, of which an edge of one goes through a face of the other.

    Each edge is traced as a ray, once: an edge that meets several meshes tells of the first one only.
    """
    if not len(edges):
        return set()
    with dr.suspend_grad():
        device = DeviceEdges(edges)
        a, b = device.end_points(geometry.positions(), dr.arange(mi.UInt32, len(edges)))
        length = dr.norm(b - a)
        ray = mi.Ray3f(dr.lerp(a, b, TOUCHES), (b - a) / length)
        ray.maxt = length * (1 - 2 * TOUCHES)
        active = (length > 0) & dr.isfinite(length)
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        cuts = active & si.is_valid() & (dr.abs_dot(si.n, ray.d) > TOUCHES)
        hit = dr.full(mi.UInt32, len(geometry.meshes), len(edges))
        for i, mesh in enumerate(geometry.meshes):
            hit[si.shape == mi.ShapePtr(mesh)] = i
        cuts, hit = np.array(cuts), np.array(hit)
    own = edges.mesh[:, 0]
    cuts &= (hit < len(geometry.meshes)) & (hit[:, None] != edges.mesh).all(1)
    return {tuple(sorted(map(int, pair))) for pair in np.unique(np.stack([own[cuts], hit[cuts]], 1), axis=0)}


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
