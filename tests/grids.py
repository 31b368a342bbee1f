"""Surfaces of grids of signed distances."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
from building import camera, diffuse, film, horizontal, light, quad, scene

LOOK = ((0.9, 1.7, -3.0), (0, 0.45, 0))

#: Side of the box of the grid.
SIDE = 1.5


def distances(n: int) -> np.ndarray:
    """A ball that is blended into a torus: (n, n, n), in units of half the side of the box."""
    x = np.linspace(-1, 1, n)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    ball = np.sqrt(x**2 + (y - 0.25) ** 2 + z**2) - 0.4
    torus = np.hypot(np.hypot(x, z) - 0.55, y + 0.2) - 0.18
    h = np.clip(0.5 + 2.5 * (torus - ball), 0, 1)
    return torus * (1 - h) + ball * h - 0.2 * h * (1 - h)


def torus(n: int) -> np.ndarray:
    """Its axis is one of the grid, as are its planes of symmetry."""
    x = np.linspace(-1, 1, n)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    return np.hypot(np.hypot(x, z) - 0.55, y) - 0.25


def grid(
    normals: str = "smooth", n: int = 64, bsdf: dict | None = None, values: np.ndarray | None = None
) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().translate([-SIDE / 2, -0.2, -SIDE / 2]).scale(SIDE)
    values = distances(n) if values is None else values
    values = mi.TensorXf(values[..., None].astype(np.float32))
    bsdf = bsdf or diffuse(0.8, 0.5, 0.3, two_sided=True)
    return {"type": "sdfgrid", "normals": normals, "grid": values, "to_world": to_world, "bsdf": bsdf}


def lamp(kind: str) -> dict[str, Any]:
    if kind == "point":
        return {"lamp": {"type": "point", "position": [0.9, 2.6, -0.9], "intensity": {"type": "rgb", "value": 9}}}
    if kind == "sky":
        return {"lamp": {"type": "constant", "radiance": {"type": "rgb", "value": 1}}}
    off = diffuse(0.0)
    return {"lamp": horizontal((0.9, 2.6, -0.9), 0.5, "lamp", down=True, bsdf=off, emitter=light(10, 9, 8))}


def on_floor(normals: str = "smooth", n: int = 64, lit: str = "area", rfilter: str = "box") -> mi.Scene:
    """It floats above a floor, before a wall."""
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    wall = quad((-1.5, 0, 1.2), (0, 1.6, 0), (3, 0, 0), "wall", bsdf=diffuse(0.7, 0.5, 0.4, two_sided=True))
    return scene(sensor=camera(*LOOK, film=film(rfilter)), thing=grid(normals, n), floor=floor, wall=wall, **lamp(lit))


def along_axis() -> mi.Scene:
    """A black torus before a bright sky, seen along an axis of its grid, where much of its surface is seen edge-on."""
    sensor = camera((0, SIDE / 2 - 0.2, -3.2), (0, SIDE / 2 - 0.2, 0))
    return scene(sensor=sensor, thing=grid(bsdf=diffuse(0.0, two_sided=True), values=torus(64)), **lamp("sky"))


def ball(n: int = 32) -> np.ndarray:
    x = np.linspace(-1, 1, n)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    return np.sqrt((x - 0.03) ** 2 + (y + 0.05) ** 2 + (z - 0.02) ** 2) - 0.7


def slanted() -> np.ndarray:
    """Two planes, up to a small twist, which leave the box of their grid."""
    x = np.linspace(-1, 1, 9)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    return z + 0.6 * np.abs(x) + 0.2 * y + 0.25 * x * y + 0.05


def in_the_sun(values: Callable[[], np.ndarray]) -> mi.Scene:
    """With `analytic` normals, which jump where voxels meet. The sun is behind the camera: no shadow is seen."""
    sun = {"type": "directional", "direction": [-0.1, -0.25, 1], "irradiance": {"type": "rgb", "value": 3}}
    return scene(sensor=camera((0.3, 0.9, -3.0), (0, 0.5, 0)), thing=grid("analytic", values=values()), sun=sun)


def black(values: np.ndarray | None = None) -> dict[str, Any]:
    return grid(bsdf=diffuse(0.0, two_sided=True), values=torus(32) if values is None else values)


def few_values() -> mi.Scene:
    """A black ball in a grid so coarse that its outline has corners."""
    return scene(sensor=camera((0.63, 1.87, -3.4), (0, 0.45, 0)), thing=black(ball(12)), **lamp("sky"))


def before_mirror() -> mi.Scene:
    mirror = quad((-3, -1, 1.2), (0, 4, 0), (6, 0, 0), "mirror", bsdf={"type": "conductor"})
    return scene(sensor=camera((1.63, 1.27, -2.2), (0, 0.5, 0.6)), thing=black(), mirror=mirror, **lamp("sky"))


def behind_veil() -> mi.Scene:
    bsdf = {"type": "mask", "opacity": 0.5, "nested": diffuse(0.0, two_sided=True)}
    veil = quad((-2, -1, -1.6), (0, 4, 0), (4, 0, 0), "veil", bsdf=bsdf)
    return scene(sensor=camera((0.63, 1.87, -3.4), (0.1, 0.2, 0)), thing=black(), veil=veil, **lamp("sky"))


def bump(n: int = 64) -> list[float]:
    """A motion of the values that is not the same everywhere."""
    x = np.linspace(-1, 1, n)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    return (-0.5 - np.sin(3 * x + 1) * np.cos(2 * z - y)).ravel().tolist()


SLIDES = {"key": "thing.to_world", "direction": [1, 0.5, 0]}
GROWS = {"key": "thing.grid", "direction": [-1.0]}
LAMP = {"key": "lamp.vertex_positions", "direction": [1, 0, 0.5]}

#: Cases whose references take more samples.
LONGER = "grid_slides", "grid_of_few_values", "grid_in_mirror", "grid_behind_veil"

#: Of each case: scene, motion, step, max_depth.
GRIDS: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "grid_slides": (on_floor, SLIDES, 6e-3, 2),
    "grid_slides_gaussian": (partial(on_floor, rfilter="gaussian"), SLIDES, 6e-3, 2),
    "grid_along_axis": (along_axis, SLIDES, 6e-3, 2),
    "grid_of_few_values": (few_values, SLIDES, 6e-3, 2),
    "grid_slides_indirect": (on_floor, SLIDES, 6e-3, 3),
    "grid_grows": (on_floor, GROWS, 4e-3, 2),
    "grid_lamp": (on_floor, LAMP, 1e-2, 2),
    "grid_slides_in_hard_light": (partial(on_floor, lit="point"), SLIDES, 6e-3, 2),
    "grid_of_flat_normals": (partial(in_the_sun, ball), SLIDES, 2e-3, 2),
    "grid_that_ends": (partial(in_the_sun, slanted), SLIDES, 2e-3, 2),
    "grid_in_mirror": (before_mirror, SLIDES, 3e-3, 2),
    "grid_behind_veil": (behind_veil, SLIDES, 6e-3, 2),
    "grid_deforms": (partial(on_floor, "analytic"), {"key": "thing.grid", "direction": bump()}, 4e-3, 2),
}
