"""Instances of shape groups that move, and past which something moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, cube_vertices, diffuse, horizontal, light, mesh, scene
from random_scenes import ball

#: Middle and half of the size of what a chair is made of; legs and back stand a little in the seat.
PARTS = [((0, 0.45, 0), (0.25, 0.04, 0.25)), ((0, 0.75, 0.22), (0.24, 0.3, 0.03))]
PARTS += [((x, 0.21, z), (0.03, 0.21, 0.03)) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]


def chair() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces."""
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    vertices = [np.multiply(corners, size) + middle for middle, size in PARTS]
    faces = [np.array(CUBE_FACES) + 8 * k for k in range(len(PARTS))]
    return np.concatenate(vertices), np.concatenate(faces)


def place(k: int) -> mi.ScalarTransform4f:
    """Of a chair, of which one is reflected, and others are stretched."""
    x, z = k % 5, k // 5
    stretch = [-1 if k == 8 else 1, 1 + 0.1 * x, 1]
    at = mi.ScalarTransform4f().translate([0.8 * (x - 2), 0.02, 0.9 * (z - 1)])
    return at.rotate([0, 1, 0], 40 * k + 170).scale(stretch)


def chairs() -> mi.Scene:
    """Twenty instances of a chair."""
    vertices, faces = chair()
    wood = mesh("chair", vertices, faces, bsdf=diffuse(0.7, 0.5, 0.3))
    shapes: dict[str, Any] = {"group": {"type": "shapegroup", "chair": wood}}
    for k in range(20):
        shapes[f"chair{k}"] = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place(k)}
    return scene(sensor=camera((0.4, 1.9, -2.6), (0, 0.5, 0)), **room(), **shapes)


def room() -> dict[str, mi.Mesh]:
    floor = horizontal((0, 0, 0), 3, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    lamp = horizontal((0.6, 3, -0.8), 0.6, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(10, 10, 9))
    return {"floor": floor, "lamp": lamp}


def boxes(apart: bool = False) -> mi.Scene:
    """Three instances of two boxes, one of them reflected, and a board before them. apart : as six meshes."""
    parts = {"a": (0.3 * cube_vertices(), (0.8, 0.5, 0.3)), "b": (0.2 * cube_vertices() + [0, 0.5, 0], (0.3, 0.5, 0.8))}
    make = lambda name, vertices, colour, faces: mesh(name, vertices, faces, bsdf=diffuse(*colour))
    shapes: dict[str, Any] = {
        "group": {"type": "shapegroup", **{name: make(name, *part, CUBE_FACES) for name, part in parts.items()}}
    }
    for k in range(3):
        to_world = mi.ScalarTransform4f().translate([k - 1, 0.45, 0.3 * k]).rotate([0, 1, 0.2], 40 * k)
        to_world = to_world.scale([1, 1 + 0.2 * k, -1 if k == 1 else 1])
        shapes[f"box{k}"] = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}
        if apart:
            del shapes[f"box{k}"]
            for name, (vertices, colour) in parts.items():
                placed = np.array([list(to_world @ mi.ScalarPoint3f(*v)) for v in vertices])
                faces = np.array(CUBE_FACES)[:, ::-1] if k == 1 else CUBE_FACES
                shapes[f"box{k}{name}"] = make(f"box{k}{name}", placed, colour, faces)
    board = mesh("board", 0.4 * cube_vertices() + [0.2, 0.5, -1.0], CUBE_FACES, bsdf=diffuse(0.6, 0.3, 0.6))
    return scene(sensor=camera((0.6, 2.2, -5), (0, 0.4, 0)), **room(), board=board, **shapes)


def reflected_ball(apart: bool = False) -> mi.Scene:
    """A coarse ball with interpolated normals, which its instance reflects. apart : as a mesh."""
    vertices, _, _, faces = ball(6)
    matt = diffuse(0.8, 0.3, 0.2)
    to_world = mi.ScalarTransform4f().translate([0.1, 0.7, 0]).rotate([0.3, 1, 0.2], 30).scale([-0.7, 0.4, 0.5])
    inside = mesh("ball", vertices, faces, True, bsdf=matt)
    placed = [list(to_world @ mi.ScalarPoint3f(*v)) for v in vertices]
    thing: Any = mesh("thing", placed, np.array(faces)[:, ::-1], True, bsdf=matt)
    params = mi.traverse(thing)
    normals = np.reshape(mi.traverse(inside)["vertex_normals"], (-1, 3)).tolist()
    params["vertex_normals"] = np.ravel([list(to_world @ mi.ScalarNormal3f(*n)) for n in normals]).astype(np.float32)
    params.update()
    shapes: dict[str, Any] = {"thing": thing}
    if not apart:
        instance = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}
        shapes = {"group": {"type": "shapegroup", "ball": inside}, "thing": instance}
    return scene(sensor=camera((0.6, 1.6, -3.4), (0.1, 0.6, 0)), **room(), **shapes)


def stretched_ball(kind: str = "bilinear", n: int = 32, apart: bool = False) -> mi.Scene:
    """A smooth-shaded ball with a picture, which its instance stretches: normals and texture move over it.

    kind : of the picture, see `pictured`. apart : as a mesh.
    """
    vertices, _, uv, faces = ball(n)
    inside = mesh("ball", vertices, faces, True, uv, bsdf=pictured(kind))
    to_world = mi.ScalarTransform4f().translate([0.1, 0.7, 0]).rotate([0.3, 1, 0.2], 30).scale([0.7, 0.4, 0.5])
    shapes: dict[str, Any] = {
        "group": {"type": "shapegroup", "ball": inside},
        "thing": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world},
    }
    if apart:
        placed = [list(to_world @ mi.ScalarPoint3f(*v)) for v in vertices]
        thing: Any = mesh("thing", placed, faces, True, uv, bsdf=pictured(kind))
        normals = np.reshape(mi.traverse(inside)["vertex_normals"], (-1, 3)).tolist()
        params = mi.traverse(thing)
        params["vertex_normals"] = np.ravel([list(to_world @ mi.ScalarNormal3f(*n)) for n in normals])
        params.update()
        shapes = {"thing": thing}
    return scene(sensor=camera((0.6, 1.6, -3.4), (0.1, 0.6, 0)), **room(), **shapes)


def pictured(kind: str) -> dict[str, Any]:
    """A matt material with a picture: of colours, ``bilinear`` or ``nearest``, or a ``checkerboard``; of heights,
    ``bumpmap``; or of opacity, ``mask``."""
    numbers = np.random.default_rng(3).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    picture = lambda texels, of: {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": of}
    if kind == "bumpmap":
        heights = picture(numbers[..., :1], "bilinear")
        return {"type": "bumpmap", "heights": heights, "scale": 0.15, "bsdf": diffuse(0.7)}
    if kind == "mask":
        return {"type": "mask", "opacity": picture(numbers[..., :1], "nearest"), "bsdf": diffuse(0.7, two_sided=True)}
    if kind == "checkerboard":
        squares = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([8, 5, 1])}
        return {"type": "diffuse", "reflectance": squares}
    return {"type": "diffuse", "reflectance": picture(numbers, kind)}


SLIDE = {"key": "chair1.to_world", "direction": [1, 0.2, 0.4]}
TURN = {"key": "chair1.to_world", "rotate": [0.2, 1, 0.1]}

#: Of each case: scene, motion, step, max_depth.
INSTANCES: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "chair_slides": (chairs, SLIDE, 4e-3, 2),
    "chair_turns": (chairs, TURN, 8e-3, 2),
    "stretched_ball": (stretched_ball, {"key": "thing.to_world", "rotate": [1, 0.4, 0.7]}, 6e-3, 2),
    "checkered_instance": (
        lambda: stretched_ball("checkerboard", 12),
        {"key": "thing.to_world", "rotate": [1, 0.4, 0.7], "pivot": [0.1, 0.7, 0]},
        4e-3,
        2,
    ),
}
