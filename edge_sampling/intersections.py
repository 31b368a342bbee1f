"""Meshes that cut through each other: the line of the cut is no edge, so its jump cannot be sampled."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .device_edges import DeviceEdges
from .edges import Edges
from .meshes import Geometry

#: An edge that ends on a face, or lies in it, does not cut it. Relative to its length; cosine of the angle.
TOUCHES = 1e-3


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
