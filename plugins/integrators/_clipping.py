"""What derivatives lack where the clipping planes of a sensor cut through shapes, in words for the user."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._plan import names
from rimlight.edge_sampling import film_parts
from rimlight.edge_sampling.geometry.meshes import vertices

#: Points of the frame, along each of its sides, at which the near clipping plane is looked at.
POINTS = 128


def cut_by_clipping_planes(sensor: mi.Sensor, shapes: list[mi.Shape]) -> list[str]:
    """What the derivative lacks where a sensor clips shapes.

    shapes : those that move as seen from the sensor.
    """
    limits = []
    for part in film_parts(sensor):
        if hasattr(part.sensor, "near_clip"):
            limits += cut_by_near_plane(part.sensor, shapes) + beyond_far_plane(part.sensor, shapes)
    return limits


def cut_by_near_plane(sensor: mi.Sensor, shapes: list[mi.Shape]) -> list[str]:
    """Within the frame, through spheres, disks and cylinders. (Cuts through meshes are sampled.)"""
    analytic = [s for s in shapes if s.class_name() in ACROSS]
    if not analytic:
        return []
    with dr.suspend_grad():
        across, along = dr.meshgrid(*[dr.linspace(mi.Float, 0, 1, POINTS)] * 2)
        # Camera rays start at that plane.
        starts = sensor.sample_ray(0, 0.5, mi.Point2f(across, along), mi.Point2f(0.5))[0].o
        cut = names(s for s in analytic if _is_cut(s, starts))
    if not cut:
        return []
    return [
        f'the derivative lacks the cut of the near clipping plane of "{sensor.id()}" through {", ".join(cut)}; '
        f"decrease its near_clip, now {sensor.near_clip():g}, or replace them by meshes."
    ]


#: By the class of a shape: a function of its own coordinates that is 0 on its surface, and where that surface ends.
ACROSS = {
    "Sphere": (lambda p: dr.squared_norm(p) - 1, lambda p: mi.Bool(True)),
    "Disk": (lambda p: p.z, lambda p: dr.square(p.x) + dr.square(p.y) < 1),
    "Cylinder": (lambda p: dr.square(p.x) + dr.square(p.y) - 1, lambda p: (p.z > 0) & (p.z < 1)),
}


def _is_cut(shape: mi.Shape, starts: mi.Point3f) -> bool:
    """Is the surface of a shape between neighbours of these points, which are POINTS rows of as many?"""
    value, ends = ACROSS[shape.class_name()]
    p = dr.detach(mi.traverse(shape)["to_world"]).inverse() @ starts
    there = np.array(ends(p) & dr.full(mi.Bool, True, POINTS**2)).reshape(POINTS, POINTS)
    inside = np.array(value(p) < 0).reshape(POINTS, POINTS)
    rows = (inside[1:] != inside[:-1]) & there[1:] & there[:-1]
    columns = (inside[:, 1:] != inside[:, :-1]) & there[:, 1:] & there[:, :-1]
    return bool(rows.any() or columns.any())


def beyond_far_plane(sensor: mi.Sensor, shapes: list[mi.Shape]) -> list[str]:
    """Of the far one."""
    far, to_local = sensor.far_clip(), dr.detach(sensor.world_transform()).inverse().matrix
    axis = np.array([to_local[2, k] for k in range(4)], np.float64).ravel()
    cut = names(s for s in shapes if _crosses(s, axis, far))
    if not cut:
        return []
    return [
        f'the derivative lacks the cut of the far clipping plane of "{sensor.id()}" through {", ".join(cut)}; '
        f"increase its far_clip, now {far:g}."
    ]


def _crosses(shape: mi.Shape, axis: np.ndarray, depth: float) -> bool:
    """Are there points of a shape on both sides of a plane? axis : (4,), maps points to depths."""
    box = shape.bbox()
    bounds = np.stack([np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel()])
    corners = np.stack(np.meshgrid(*bounds.T), -1).reshape(-1, 3)
    sides = corners @ axis[:3] + axis[3] > depth
    if sides.all() or not sides.any() or not shape.is_mesh():
        return bool(sides.any() and not sides.all())
    sides = vertices(shape).astype(np.float64) @ axis[:3] + axis[3] > depth
    return bool(sides.any() and not sides.all())
