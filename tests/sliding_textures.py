"""Textures that jump, on surfaces that light others, and slide over them: what `cases.py` has of these. In all of
these scenes, the camera sees a wall alone, which is lit by a floor below the frame, or by a lamp."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from building import camera, diffuse, mesh, quad, scene
from leaves import leaf, veil

#: No line lies on a border, where it would come in as coordinates grow, and not as they fall.
UV = [[0.06, 0.07], [0.06, 0.92], [0.91, 0.07], [0.91, 0.92]]


def wall() -> mi.Mesh:
    return quad((-2, 0, 1.2), (0, 3, 0), (4, 0, 0), "wall", bsdf=diffuse(0.7, 0.6, 0.5, two_sided=True))


def view() -> dict:
    return camera((0, 1.2, -4), (0, 1.2, 2), fov=24)


def texels(scale: float = 1.0) -> dict:
    image = mi.Bitmap(np.float32(scale) * np.random.default_rng(3).uniform(0, 1, (3, 2, 3)).astype(np.float32))
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "nearest"}


def floor(reflectance: dict) -> mi.Mesh:
    corners = [[-1.2, 0, -1.2], [-1.2, 0, 1.2], [1.2, 0, -1.2], [1.2, 0.1, 1.2]]
    bsdf = {"type": "diffuse", "reflectance": reflectance}
    return mesh("floor", corners, [[0, 1, 2], [1, 3, 2]], uv=UV, bsdf=bsdf)


def on_floor(reflectance: Callable[[], dict]) -> Callable[[], mi.Scene]:
    """A lamp below the frame of the camera lights the floor, and not the wall."""
    lamp = {"type": "point", "position": [0.2, 0.9, 0.1], "intensity": 3.0}
    shade = lambda: quad((-1.5, 0.85, 1.0), (3, 0, 0), (0, 1, 0), "shade", bsdf=diffuse(0.0, two_sided=True))
    return lambda: scene(sensor=view(), wall=wall(), floor=floor(reflectance()), shade=shade(), lamp=lamp)


def checkers() -> dict:
    return {"type": "checkerboard", "color0": 0.05, "color1": 0.9}


def lamp(sampling_weight: float = 1.0, **more: dict) -> mi.Scene:
    """A lamp below the frame, whose radiance jumps."""
    corners = [[-0.8, 0, 0.2], [0.8, 0, 0.2], [-0.8, 0.1, 0.9], [0.8, 0.1, 0.9]]
    shines = {"type": "area", "radiance": texels(4.0), "sampling_weight": sampling_weight}
    sheet = mesh("lamp", corners, [[0, 2, 1], [1, 2, 3]], uv=UV, bsdf=diffuse(0.0), emitter=shines)
    return scene(sensor=view(), wall=wall(), lamp=sheet, **more)


def behind_veil(bsdf: dict) -> mi.Scene:
    """The wall sees the floor through a veil, which hangs before it."""
    hangs = {"type": "rectangle", "id": "veil", "bsdf": bsdf}
    hangs["to_world"] = mi.ScalarTransform4f().translate([0.1, 0.6, 0.9]).rotate([1, 0, 0], -20).scale([1.4, 0.55, 1])
    lamp = {"type": "point", "position": [0.2, 0.9, -0.1], "intensity": 3.0}
    return scene(sensor=view(), wall=wall(), floor=floor(checkers()), veil=hangs, lamp=lamp)


SLIDES = {"key": "floor.vertex_texcoords", "direction": [1, 0.4] * 4}
VEIL = {"key": "veil.to_world", "rotate": [0.2, 1, 0.1]}
CAMERA = {"key": "sensor.to_world", "direction": [0.3, 1, 0.2]}

#: Of each case: scene, motion, step, max_depth.
SLIDING = {
    "checkers_throw": (on_floor(checkers), SLIDES, 2e-2, 3),
    "texels_throw": (on_floor(texels), SLIDES, 2e-2, 3),
    "checkers_beside": (on_floor(checkers), CAMERA, 2e-2, 3),
    "veil_turns": (lambda: behind_veil(veil()), VEIL, 4e-2, 4),
    "leaf_turns": (lambda: behind_veil(leaf()), VEIL, 4e-2, 4),
    "lamp_slides": (lamp, {"key": "lamp.vertex_texcoords", "direction": [1, 0.4] * 4}, 2e-2, 2),
}


def unsampled_lamp() -> mi.Scene:
    """The same scene as `lamp`, to Mitsuba's `path`: its light samples would not follow texture coordinates."""
    return lamp(0.0, dark={"type": "point", "position": [0, 0, 9], "intensity": 1e-12})
