"""What derivatives lack where the far clipping plane of a sensor cuts through shapes, in words for the user. (Cuts of
the near one are sampled, but those through tubes.)"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._plan import listed, names
from rimlight.edge_sampling import film_parts
from rimlight.edge_sampling.geometry.boxes import box_of
from rimlight.edge_sampling.geometry.meshes import vertices
from rimlight.edge_sampling.geometry.tubes import TUBE


def cut_by_clipping_planes(sensor: mi.Sensor, shapes: list[mi.Shape]) -> list[str]:
    """What the derivative lacks where a sensor clips shapes far away.

    shapes : those that move as seen from the sensor.
    """
    limits = []
    for part in film_parts(sensor):
        if hasattr(part.sensor, "far_clip"):
            limits += cut_by_planes(part.sensor, shapes)
    return limits


def cut_by_planes(sensor: mi.Sensor, shapes: list[mi.Shape]) -> list[str]:
    """Of one sensor."""
    far, to_local = sensor.far_clip(), dr.detach(sensor.world_transform()).inverse().matrix
    axis = np.array([to_local[2, k] for k in range(4)], np.float64).ravel()
    lacks = 'the derivative lacks the cut of the {} clipping plane of "{}" through {}; {} its {}_clip, now {:g}.'
    limits, near = [], sensor.near_clip()
    tubes = [s for s in shapes if s.class_name() == TUBE]
    for which, cure, among, depth in (("far", "increase", shapes, far), ("near", "decrease", tubes, near)):
        cut = names(s for s in among if _crosses(s, axis, depth))
        limits += [lacks.format(which, sensor.id(), listed(cut), cure, which, depth)] if cut else []
    return limits


def _crosses(shape: mi.Shape, axis: np.ndarray, depth: float) -> bool:
    """Are there points of a shape on both sides of a plane? axis : (4,), maps points to depths."""
    box = box_of(shape)
    bounds = np.stack([np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel()])
    corners = np.stack(np.meshgrid(*bounds.T), -1).reshape(-1, 3)
    sides = corners @ axis[:3] + axis[3] > depth
    if sides.all() or not sides.any() or not shape.is_mesh():
        return bool(sides.any() and not sides.all())
    sides = vertices(shape).astype(np.float64) @ axis[:3] + axis[3] > depth
    return bool(sides.any() and not sides.all())
