"""Spheres, disks and cylinders that cut through hair, and grids and tubes that cut through anything: in curves, whose
jumps are not sampled."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .beside import rounding
from .boxes import box_of
from .grids import grids_of
from .meshes import Geometry, faces, is_met, number_of, vertices
from .tubes import lines_along

#: Lines over a shape, in each of two directions, along which others are sought.
LINES = 24

#: How far inside of the shape these are, relative to it, so that what only touches it does not count.
INSIDE = 1e-3

#: How often a line over the surface of a grid may meet that itself, before it meets another one.
OFTEN = 8


def cuts_of_grids(scene: mi.Scene, geometry: Geometry) -> list[tuple[mi.Shape, mi.Shape]]:
    """Grids, each with another shape that cuts through its surface. On the host."""
    found = []
    with dr.suspend_grad():
        for grid in grids_of(geometry):
            sides = faces(grid)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            p = vertices(grid)[np.unique(np.sort(sides, axis=1), axis=0)]
            numbers = set(_first_met(scene, grid.inner, p[:, 0], p[:, 1]).tolist())
            found += [(grid.inner, s) for s in scene.shapes() if number_of(s) in numbers]
    return found


def cuts_of_tubes(scene: mi.Scene, geometry: Geometry) -> list[tuple[mi.Shape, mi.Shape]]:
    """Tubes, each with another shape that cuts through it. On the host; what is much thinner may be missed."""
    found = []
    with dr.suspend_grad():
        for tube in geometry.tubes:
            numbers = set(_first_met(scene, tube, *lines_along(tube)).tolist())
            found += [(tube, s) for s in scene.shapes() if number_of(s) in numbers]
    return found


def _first_met(scene: mi.Scene, shape: mi.Shape, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Numbers of the first shapes, or instances, that lines from a to b meet besides one shape; 0: none."""
    point = lambda v: mi.Point3f(*(mi.Float(np.ascontiguousarray(x, np.float32)) for x in v.T))
    a, b = point(a), point(b)
    length, own = dr.norm(b - a), mi.ShapePtr(shape)
    d, step = (b - a) / length, rounding(a, b)

    def onwards(t, met, k, active):
        ray = mi.Ray3f(mi.Point3f(a + t * d), d)
        ray.maxt = length - t
        pi = scene.ray_intersect_preliminary(ray, active=active)
        active &= pi.is_valid()
        which = dr.select(pi.instance != None, pi.instance, pi.shape)  # noqa: E711
        other = active & (which != own)
        met = dr.select(other, dr.reinterpret_array(mi.UInt32, which), met)
        t += pi.t + step
        return t, met, k + 1, active & ~other & (t < length) & (k < OFTEN)

    zero = dr.zeros(mi.UInt32, dr.width(length))
    state = (dr.zeros(mi.Float, dr.width(length)), zero, mi.UInt32(zero), length > step)
    return dr.while_loop(state, lambda *s: s[-1], onwards, label="lines over a grid")[1].numpy()


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
            others = [s for s in geometry.others if box_of(shape).overlaps(box_of(s))]
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
