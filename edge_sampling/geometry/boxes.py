"""Boxes around shapes and scenes.

Mitsuba 3.9 makes one mesh of all those that share a material, where it loads a scene, and does not set the box of that
mesh, nor lets the box of the scene take it in.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def box_of(shape: Any) -> mi.ScalarBoundingBox3f:
    """The box around a shape, which is set if it is not yet. Then, it reads from the device."""
    box = shape.bbox()
    if not box.valid() and isinstance(shape, mi.Mesh):
        shape.recompute_bbox()
        box = shape.bbox()
    return box


def box_around(scene: mi.Scene) -> mi.ScalarBoundingBox3f:
    """The box around all shapes of a scene."""
    box = mi.ScalarBoundingBox3f(scene.bbox())
    for shape in scene.shapes():
        box.expand(box_of(shape))
    return box
