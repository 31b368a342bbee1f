"""Scenes in which light is hard to find from the camera, and what changes in them: for `bdpt_edge`."""

from __future__ import annotations

from functools import partial

import mitsuba as mi

from rimlight import scenes

RES = 16


def hidden(name: str) -> mi.Scene:
    return mi.load_file(str(scenes.path(name)), res=RES)


WALL = {"key": "right.bsdf.reflectance.value", "direction": [1]}

DOOR = {"key": "door.vertex_positions", "rotate": [0, 1, 0], "pivot": [-0.7, 0, 2.05]}

#: Of each case: scene, motion, step.
HIDDEN = {
    "lampshade_wall": (partial(hidden, "lampshade"), WALL, 5e-2),
    "door": (partial(hidden, "door_ajar"), DOOR, 1e-2),
    "caustic_lamp": (partial(hidden, "glossy_caustic"), {"key": "lamp.to_world", "direction": [1, 0, 0]}, 1e-2),
}
