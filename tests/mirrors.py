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


# ---------------------- Textures that jump ----------------------


def checkers(colour0=0.15, colour1=(0.8, 0.6, 0.3), scale=(3, 2), turned: float = 20) -> dict:
    to_uv = mi.ScalarTransform3f().rotate(turned).scale(list(scale))
    colours = {"color0": {"type": "rgb", "value": [colour0] * 3}, "color1": {"type": "rgb", "value": list(colour1)}}
    return {"type": "checkerboard", "to_uv": to_uv, **colours}


def texels(channels: int, seed: int = 0, size=(5, 4), lowest: float = 0.1) -> dict:
    data = np.random.default_rng(seed).uniform(lowest, 0.9, (*size, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


def patterned(kind: str, name: str = "board", at=(0, 0.1, 0), turned=(0.2, 1, 0.1), **bsdf: Any) -> dict:
    place = mi.ScalarTransform4f().translate(list(at)).rotate(list(turned), 35).scale(0.9)
    return {"type": kind, "id": name, "to_world": place, "bsdf": bsdf}


def board(**bsdf: Any) -> mi.Scene:
    """A plate with a pattern before a floor with another one."""
    floor = {"type": "rectangle", "id": "floor", "bsdf": {"type": "diffuse", "reflectance": checkers(scale=(5, 4))}}
    floor["to_world"] = mi.ScalarTransform4f().translate([0, -0.9, 0]).rotate([1, 0, 0], -90).scale(2)
    plate = patterned("rectangle", **bsdf)
    return scene(sensor=camera((0.6, 1.4, -3.4), (0, 0, 0)), board=plate, floor=floor, sky=constant(0.6), lamp=lamp())


def checkerboard() -> mi.Scene:
    return board(type="twosided", nested={"type": "diffuse", "reflectance": checkers()})


def nearest() -> mi.Scene:
    return board(type="twosided", nested={"type": "diffuse", "reflectance": texels(3)})


def leaf() -> mi.Scene:
    opacity = texels(1, seed=2, lowest=-0.6)
    opacity["bitmap"] = mi.Bitmap((np.array(opacity["bitmap"]) > 0.2).astype(np.float32))
    leaf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.7, 0.1]}}}
    return board(type="mask", opacity=opacity, nested=leaf)


def bumps() -> mi.Scene:
    heights = texels(1, seed=4, size=(6, 6))
    heights["filter_type"] = "bilinear"
    return board(type="twosided", nested={"type": "bumpmap", "texture": heights, "scale": 0.3, "bsdf": diffuse(0.6)})


def checkered_ball() -> mi.Scene:
    """A smooth ball with a checkerboard, and what a mirror shows of it."""
    thing = {"type": "sphere", "id": "ball", "center": [0.1, 0.7, 0.1], "radius": 0.5}
    thing["bsdf"] = {"type": "diffuse", "reflectance": checkers(scale=(4, 3))}
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "mirror", bsdf={"type": "conductor"})
    at = camera((0.6, 1.9, -3.4), (0.1, 0.2, 0))
    return scene(sensor=at, ball=thing, mirror=floor, sky=constant(0.4), lamp=lamp())
