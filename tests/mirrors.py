"""Edges that are seen in perfect mirrors, and through glass: what `cases.py` has of them."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball


def cube(centre=(0.1, 0.7, 0.1), size: float = 0.4) -> mi.Mesh:
    rotated = cube_vertices() @ np.array(mi.ScalarTransform4f().rotate([0.3, 1, 0.2], 35).matrix)[:3, :3].T
    return mesh("cube", size * rotated + centre, CUBE_FACES, bsdf=diffuse(0.8, 0.5, 0.3))


def lamp() -> mi.Mesh:
    return horizontal((0.6, 3, -0.8), 0.6, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(8, 8, 7))


def over_mirror() -> mi.Scene:
    """A cube over a mirror, a little larger than what the camera sees of it, under a sky."""
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "mirror", bsdf={"type": "conductor"})
    at = camera((0.6, 1.9, -3.4), (0.1, 0.2, 0))
    return scene(sensor=at, cube=cube(), mirror=floor, sky=constant(0.4), lamp=lamp())


def two_mirrors() -> mi.Scene:
    """A cube between two mirrors, which show each other."""
    mirror = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.9, 0.95, 0.9]}}
    back = quad((-1.5, -0.5, 1.2), (0, 2.5, 0), (3, 0, 0.3), "back", bsdf=mirror)
    front = quad((-1.5, -0.5, -1.2), (3, 0, 0), (0, 2.5, 0), "front", bsdf=mirror)
    at = camera((1.9, 1.4, -0.9), (0, 0.5, 0.6))
    return scene(sensor=at, cube=cube(), back=back, front=front, sky=constant(0.4), lamp=lamp())


def pane() -> mi.Scene:
    """A plate of glass before a cube, which is seen in it, and through it."""
    glass = {"type": "dielectric", "int_ior": 1.5}
    plate = mesh("pane", 0.5 * cube_vertices() * [2.2, 2, 0.3] + [0.2, 0.6, -0.9], CUBE_FACES, bsdf=glass)
    floor = horizontal((0, -0.2, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    at = camera((1.2, 1.3, -3.4), (0.1, 0.5, 0))
    return scene(sensor=at, cube=cube(), pane=plate, floor=floor, sky=constant(0.5))


def bar(centre=(0.1, 0.4, 0.8)) -> mi.Mesh:
    vertices = cube_vertices() * [0.12, 0.8, 0.12] + centre
    return mesh("bar", vertices, CUBE_FACES, bsdf=diffuse(0.0), emitter=light(3, 2.5, 2))


def before_bar(shape: dict) -> mi.Scene:
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar(), sky=constant(0.2))


def glass_ball() -> mi.Scene:
    """A ball of glass before a bar that shines."""
    return before_bar({"type": "sphere", "center": [0, 0.4, -0.4], "radius": 0.6, "bsdf": {"type": "dielectric"}})


def mirrored_ball() -> mi.Scene:
    """A mirrored ball beside a bar that shines."""
    shape = {"type": "sphere", "center": [0, 0.4, 0.3], "radius": 0.6, "bsdf": {"type": "conductor"}}
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar((0.5, 0.4, -0.9)), cube=cube((-0.9, 0.5, -0.6), 0.3), sky=constant(0.5))


def faceted() -> mi.Scene:
    """A smooth-shaded mirror of few triangles."""
    vertices, _, _, faces = ball(10)
    shape = mesh("ball", 0.6 * vertices + [0, 0.4, 0.3], faces, normals=True, bsdf={"type": "conductor"})
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar((0.5, 0.4, -0.9)), sky=constant(0.5))
