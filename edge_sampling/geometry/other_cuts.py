"""Spheres, disks and cylinders that cut through hair and implicit surfaces: in curves, whose jumps are not sampled."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .meshes import Geometry, is_met

#: Lines over a shape, in each of two directions, along which others are sought.
LINES = 24

#: How far inside of the shape these are, relative to it, so that what only touches it does not count.
INSIDE = 1e-3


def cuts_of_others(scene: mi.Scene, geometry: Geometry) -> list[tuple[mi.Shape, mi.Shape]]:
    """Analytic shapes that cut through another shape that is neither such nor a mesh, and that one. On the host; what
    is much smaller than the analytic shape may be missed."""
    found = []
    if not geometry.others:
        return found
    with dr.suspend_grad():
        for shape in geometry.analytic:
            a, b = _segments(shape)
            length = np.linalg.norm(b - a, axis=1)
            a, b, length = a[length > 0], b[length > 0], length[length > 0]
            point = lambda v: mi.Point3f(*(mi.Float(np.float32(x)) for x in v.T))
            ray = mi.Ray3f(point(a), mi.Vector3f(point((b - a) / length[:, None])))
            ray.maxt = mi.Float(np.float32(length))
            met = scene.ray_intersect_preliminary(ray)
            others = [s for s in geometry.others if shape.bbox().overlaps(s.bbox())]
            found += [(shape, s) for s in others if dr.any(met.is_valid() & is_met(met, mi.ShapePtr(s)))[0]]
    return found


def _segments(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Ends of short lines that cover a shape like a net: (N, 3) each, world space."""
    u, v = np.meshgrid(np.linspace(0, 1, LINES + 1), np.linspace(0, 1, LINES + 1), indexing="ij")
    φ, r = 2 * np.pi * u, 1 - INSIDE
    kind = shape.class_name()
    if kind == "Sphere":
        p = r * np.stack([np.cos(φ) * np.sin(np.pi * v), np.sin(φ) * np.sin(np.pi * v), np.cos(np.pi * v)], -1)
    elif kind == "Cylinder":
        p = np.stack([r * np.cos(φ), r * np.sin(φ), INSIDE + (r - INSIDE) * v], -1)
    else:
        p = np.stack([r * v * np.cos(φ), r * v * np.sin(φ), 0 * v], -1)
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    p = p @ matrix[:3, :3].T + matrix[:3, 3]
    along = lambda first, second: (first.reshape(-1, 3), second.reshape(-1, 3))
    ends = along(p[:-1], p[1:]), along(p[:, :-1], p[:, 1:])
    return tuple(np.concatenate(e) for e in zip(*ends, strict=True))
