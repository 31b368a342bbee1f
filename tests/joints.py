"""Cylinders, disks and spheres that touch: rims that coincide, as where a disk closes a cylinder, and rims that lie on
other surfaces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
from building import camera, diffuse, horizontal, light, quad, scene

LOOK = ((0.9, 1.7, -3.0), (0, 0.35, 0))


def cylinder(bottom, top, radius: float, *colour: float) -> dict[str, Any]:
    bsdf = diffuse(*colour, two_sided=True)
    return {"type": "cylinder", "p0": list(bottom), "p1": list(top), "radius": radius, "bsdf": bsdf}


def disk(centre, radius: float, *colour: float, turn: float = -90) -> dict[str, Any]:
    """Its normal points up."""
    to_world = mi.ScalarTransform4f().translate(list(centre)).rotate([1, 0, 0], turn).scale(radius)
    return {"type": "disk", "to_world": to_world, "bsdf": diffuse(*colour, two_sided=True)}


def floor() -> mi.Mesh:
    return horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))


def lamp() -> mi.Mesh:
    return horizontal((0.9, 2.6, -0.9), 0.5, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(10, 9, 8))


def can() -> mi.Scene:
    """A cylinder that two disks close, above a floor."""
    wall = cylinder((0, 0.2, 0), (0, 0.9, 0), 0.45, 0.8, 0.5, 0.3)
    top, bottom = disk((0, 0.9, 0), 0.45, 0.3, 0.7, 0.4), disk((0, 0.2, 0), 0.45, 0.6, 0.3, 0.3)
    return scene(sensor=camera(*LOOK), wall=wall, top=top, bottom=bottom, floor=floor(), lamp=lamp())


def stack() -> mi.Scene:
    """Two cylinders, one on the other, with a disk between them, and one that closes them."""
    lower, upper = (
        cylinder((0, a, 0), (0, b, 0), 0.4, *c) for a, b, c in ((0.1, 0.5, (0.8, 0.5, 0.3)), (0.5, 1, (0.3, 0.4, 0.8)))
    )
    between, top = disk((0, 0.5, 0), 0.4, 0.9), disk((0, 1, 0), 0.4, 0.3, 0.7, 0.4)
    things = {"lower": lower, "upper": upper, "between": between, "top": top}
    return scene(sensor=camera(*LOOK), **things, floor=floor(), lamp=lamp())


def shut_in(kind: str = "sphere") -> mi.Scene:
    """A disk that nobody sees: in a sphere, or in a can, which it fits."""
    if kind == "sphere":
        shell = {
            "ball": {
                "type": "sphere",
                "center": [0, 0.7, 0],
                "radius": 0.5,
                "bsdf": diffuse(0.8, 0.5, 0.3, two_sided=True),
            }
        }
        plate = disk((0, 0.7, 0), 0.5, 0.9)
    else:
        wall = cylinder((0, 0.2, 0), (0, 0.9, 0), 0.45, 0.8, 0.5, 0.3)
        top, bottom = disk((0, 0.9, 0), 0.45, 0.3, 0.7, 0.4), disk((0, 0.2, 0), 0.45, 0.6, 0.3, 0.3)
        shell, plate = {"wall": wall, "top": top, "bottom": bottom}, disk((0, 0.6, 0), 0.45, 0.9)
    back = quad((-1.5, 0, 1.2), (0, 1.6, 0), (3, 0, 0), "back", bsdf=diffuse(0.7, 0.5, 0.4, two_sided=True))
    return scene(sensor=camera(*LOOK), **shell, plate=plate, floor=floor(), lamp=lamp(), back=back)


CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0]}
LAMP = {"key": "lamp.vertex_positions", "direction": [1, 0.2, 0.4]}


def slide(*names: str, direction=(1, 0.4, 0.3)) -> list[dict[str, Any]]:
    return [{"key": f"{name}.to_world", "direction": list(direction)} for name in names]


CAN = slide("wall", "top", "bottom")

#: Of each case: scene, motion, step, max_depth.
JOINTS: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "can_camera": (can, CAMERA, 3e-3, 2),
    "can_lamp": (can, LAMP, 6e-3, 2),
    "stack_camera": (stack, CAMERA, 3e-3, 3),
}
