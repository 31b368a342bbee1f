"""Polished surfaces, of which the highlights are narrow, and what changes in their scenes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball
from tidy import open_cup


def metal(alpha: float) -> dict:
    return {"type": "twosided", "bsdf": {"type": "roughconductor", "material": "none", "alpha": alpha}}


def lacquer(alpha: float) -> dict:
    colour = {"type": "rgb", "value": [0.3, 0.2, 0.1]}
    return {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": colour}


def cube(name: str, size: float, at, **props) -> mi.Mesh:
    return mesh(name, size * cube_vertices() + at, CUBE_FACES, **props)


def floor(bsdf: dict | None = None) -> mi.Scene:
    """A lamp behind a cube, and a polished floor that shows both."""
    lamp = quad((-0.6, 0.9, 1.6), (0, 0.7, 0), (1.2, 0, 0), "lamp", bsdf=diffuse(0.0), emitter=light(3, 2.5, 2))
    return scene(
        sensor=camera((0.3, 1.2, -2.2), (0, 0, 0.2)),
        floor=horizontal((0, 0, 0), 1.5, "floor", bsdf=bsdf or metal(0.03)),
        cube=cube("cube", 0.16, (-0.15, 0.45, 0.7), bsdf=diffuse(0.3)),
        lamp=lamp,
    )


def table() -> mi.Scene:
    """The same with lacquer, which reflects diffusely, too."""
    return floor(lacquer(0.05))


def sky(light: dict | None = None) -> mi.Scene:
    """A polished floor and a black cube under the sky."""
    return scene(
        sensor=camera((0.3, 1.2, -2.2), (0, 0, 0.2)),
        floor=horizontal((0, 0, 0), 1.5, "floor", bsdf=metal(0.05)),
        cube=cube("cube", 0.16, (-0.15, 0.45, 0.7), bsdf=diffuse(0.0)),
        sky=light or constant(1.0),
    )


def environment() -> mi.Scene:
    """The same under a sky that differs from place to place."""
    picture = np.random.default_rng(1).uniform(0.1, 2, (8, 16, 3)).astype(np.float32)
    return sky({"type": "envmap", "bitmap": mi.Bitmap(picture)})


def wall() -> mi.Scene:
    """A matt floor reflects what a polished wall shows of a lamp: narrow lobes behind the first vertex."""
    lamp = quad((-0.9, 0.3, -0.9), (0, 0.5, 0), (0, 0, 0.5), "lamp", bsdf=diffuse(0.0), emitter=light(6, 5, 4))
    return scene(
        sensor=camera((0.3, 1.2, -2.2), (0, 0, 0.2)),
        floor=horizontal((0, 0, 0), 1.5, "floor", bsdf=diffuse(0.6)),
        wall=quad((-1, 0, 0.9), (0, 1.2, 0), (2, 0, 0), "wall", bsdf=metal(0.05)),
        lamp=lamp,
    )


def caustic() -> mi.Scene:
    """A matt floor, and a metal cube that throws the light of a lamp on it."""
    lamp = quad((-1.3, 0.7, -0.3), (0.3, 0.5, 0), (0, 0, 0.6), "lamp", bsdf=diffuse(0.0), emitter=light(9, 8, 7))
    return scene(
        sensor=camera((0.3, 1.2, -2.2), (0, 0, 0.2)),
        floor=horizontal((0, 0, 0), 1.5, "floor", bsdf=diffuse(0.6)),
        cube=cube("cube", 0.25, (0.1, 0.35, 0.2), bsdf=metal(0.1)),
        lamp=lamp,
    )


def balls() -> mi.Scene:
    """Two polished balls, a sphere and a mesh, which show a lamp, a matt floor and each other."""
    vertices, _, _, faces = ball(16)
    lamp = quad((-0.6, 1.2, -1.2), (1.2, 0, 0), (0, 0.5, 0.5), "lamp", bsdf=diffuse(0.0), emitter=light(6, 5, 4))
    figure = 0.35 * vertices + np.array([-0.45, 0.4, 0])
    return scene(
        sensor=camera((0.3, 1.2, -2.2), (0, 0.3, 0)),
        floor=horizontal((0, -0.1, 0), 1.5, "floor", bsdf=diffuse(0.5)),
        sphere={"type": "sphere", "center": [0.45, 0.45, 0.1], "radius": 0.4, "bsdf": metal(0.05)},
        figure=mesh("figure", figure, faces, normals=True, bsdf=lacquer(0.05)),
        lamp=lamp,
    )


def cup_in_metal() -> mi.Scene:
    """A cup on a floor, seen in a wall of polished metal: its walls lean over its foot."""
    bulb = {"type": "sphere", "center": [1, 2.5, -1.3], "radius": 0.3, "emitter": light(9, 9, 8)}
    return scene(
        sensor=camera((0, 0.8, 0.5), (0.17, 0.42, 2.8), fov=15),
        cup=open_cup((0.2, 0, -1.2), turned=0.11),
        floor=horizontal((0, 0, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4, two_sided=True)),
        wall=quad((-1.5, -0.5, 1.5), (3, 0, 0), (0, 2.5, 0), "wall", bsdf=metal(0.006)),
        bulb=bulb,
        sky=constant(0.3),
    )


CAMERA_ALONG = {"key": "sensor.to_world", "direction": [1, 0, 0]}
CUP_SLIDES = {"key": "cup.vertex_positions", "direction": [1, 0, 0.3]}
CAMERA_TURNS = {"key": "sensor.to_world", "rotate": [0, 1, 0]}
FLOOR_RISES = {"key": "floor.vertex_positions", "direction": [0, 1, 0]}
FLOOR_TILTS = {"key": "floor.vertex_positions", "rotate": [0.2, 0, 1]}
LAMP_ALONG = {"key": "lamp.vertex_positions", "direction": [1, 0.3, 0]}
CUBE_TURNS = {"key": "cube.vertex_positions", "rotate": [0, 1, 0]}
SPHERE_SLIDES = {"key": "sphere.to_world", "direction": [1, 0.3, 0.4]}
FIGURE_SLIDES = {"key": "figure.vertex_positions", "direction": [1, 0.3, 0.4]}
WALL_TILTS = {"key": "wall.vertex_positions", "rotate": [0.3, 1, 0]}

#: Of each case: scene, motion, step, longest path.
POLISHED = {
    "polished_camera": (floor, CAMERA_ALONG, 5e-3, 2),
    "polished_lamp": (floor, LAMP_ALONG, 5e-3, 2),
    "polished_floor": (floor, FLOOR_TILTS, 3e-3, 4),
    "polished_wall": (wall, WALL_TILTS, 3e-3, 3),
    "polished_cube": (caustic, CUBE_TURNS, 4e-2, 3),
    "polished_rises": (wall, FLOOR_RISES, 3e-3, 3),
    "polished_sky": (sky, CAMERA_ALONG, 5e-3, 2),
    "lacquer_camera": (table, CAMERA_ALONG, 5e-3, 2),
    "polished_sphere": (balls, SPHERE_SLIDES, 4e-3, 2),
    "polished_figure": (balls, FIGURE_SLIDES, 4e-3, 2),
    "balls_camera": (balls, CAMERA_ALONG, 4e-3, 3),
    "cup_in_metal": (cup_in_metal, CUP_SLIDES, 5e-3, 3),
}
