"""Shapes that cut through each other: what `cases.py` has of lines which are no edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball
from rooms import walls


def lamp() -> mi.Mesh:
    return horizontal((0.6, 3, -0.8), 0.6, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(8, 8, 7))


def cube(size: float = 0.45, centre=(0.1, 0.25, 0), name: str = "cube", **bsdf: Any) -> mi.Mesh:
    vertices = size * cube_vertices() + centre
    return mesh(name, vertices, CUBE_FACES, bsdf=bsdf or diffuse(0.8, 0.5, 0.3))


LOOK = ((0.6, 1.6, -3.4), (0.1, 0.2, 0))


def sunk_cube() -> mi.Scene:
    """A turned cube stands a little in the floor."""
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    return scene(sensor=camera(*LOOK), cube=cube(), floor=floor, lamp=lamp())


def sunk_in_gloss() -> mi.Scene:
    """The same before a wall, on a floor that reflects it: each surface sees the lines."""
    gloss = {"type": "roughconductor", "alpha": 0.25}
    around = {k: v for k, v in walls().items() if k != "floor"}
    floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0), "floor", bsdf=gloss)
    at = {"centre": (-0.5, 0.2, 0.5), "size": 0.4}
    bulb = horizontal((0.1, 1.9, -0.2), 0.3, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(14, 12, 10))
    return scene(sensor=camera((0.9, 1.4, -3.2), (-0.2, 0.6, 0.2)), **around, floor=floor, cube=cube(**at), lamp=bulb)


def sunk_ball() -> mi.Scene:
    """A smooth-shaded ball, less than half of it in the floor, which it overhangs: under a sky, and a lamp."""
    vertices, _, _, faces = ball(12)
    thing = mesh("ball", 0.5 * vertices + [0.1, 0.2, 0], faces, normals=True, bsdf=diffuse(0.8, 0.5, 0.3))
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    bulb = {"type": "point", "position": [0.6, 3, -1.5], "intensity": 10.0}
    return scene(sensor=camera(*LOOK), ball=thing, floor=floor, bulb=bulb, sky=constant(0.5))


def cut_lamp() -> mi.Scene:
    """A black board goes through a lamp, of which the floor sees less on one of its sides."""
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    shade = horizontal((0.1, 1.2, 0.2), 0.6, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(8, 7, 6))
    board = quad((0.15, 0.9, -0.7), (0.1, 0.5, 0), (0.1, 0, 1.8), "board", bsdf=diffuse(0.0))
    return scene(sensor=camera((0.4, 2.0, -3.6), (0, 0.5, 0)), floor=floor, lamp=shade, board=board)


def knot() -> mi.Scene:
    """A mesh that cuts through itself: two cubes that are one mesh."""
    other = 0.35 * cube_vertices() @ np.diag([1, 1.4, 0.8]) + [0.3, 0.1, -0.2]
    vertices = np.concatenate([0.4 * cube_vertices(), other])
    faces = np.concatenate([CUBE_FACES, np.array(CUBE_FACES) + 8])
    colours = np.repeat([[0.8, 0.4, 0.2], [0.2, 0.5, 0.8]], 8, 0)
    bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    both = mesh("knot", np.add(vertices, [0, 0.8, 0]), faces, colours=colours, bsdf=bsdf)
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, two_sided=True))
    return scene(sensor=camera((0.6, 1.6, -3.4), (0.1, 0.7, 0)), knot=both, floor=floor, lamp=lamp())


def spike() -> mi.Scene:
    """Half of a pyramid lies in a floor, with whose triangles it has the corner at its tip in common."""
    base = [[1.5, y, z] for y, z in ((-0.5, -0.4), (0.6, -0.6), (0.5, 0.4), (-0.4, 0.5))]
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]]
    tip = np.array([-0.5, 0, -0.2])
    thing = mesh("spike", np.add([[0, 0, 0], *base], tip), faces, bsdf=diffuse(0.8, 0.5, 0.3, two_sided=True))
    around = [[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]]
    fan = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4]]
    floor = mesh("floor", np.array([tip, *around]), fan, bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    return scene(sensor=camera(*LOOK), spike=thing, floor=floor, lamp=lamp())


def sunk_sphere() -> mi.Scene:
    """A sphere stands a little in the floor, before a wall."""
    thing = {"type": "sphere", "center": [0.1, 0.3, 0], "radius": 0.5, "bsdf": diffuse(0.8, 0.5, 0.3)}
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    wall = quad((-2, -0.5, 0.9), (4, 0, 0), (0, 2.5, 0), "wall", bsdf=diffuse(0.7, 0.4, 0.4, two_sided=True))
    return scene(sensor=camera(*LOOK), ball=thing, floor=floor, wall=wall, lamp=lamp())


def pillar() -> mi.Scene:
    """A cylinder leans in the floor, a disk cuts through both, and a sphere through the cylinder."""
    colour = lambda *c: diffuse(*c, two_sided=True)
    axis = {
        "type": "cylinder",
        "p0": [-0.3, -0.5, 0.2],
        "p1": [0.5, 1.1, 0],
        "radius": 0.3,
        "bsdf": colour(0.8, 0.5, 0.3),
    }
    plate = {
        "type": "disk",
        "to_world": mi.ScalarTransform4f().translate([0.1, 0.1, -0.1]).rotate([0.8, 0.6, 0], 60).scale(0.8),
        "bsdf": colour(0.3, 0.7, 0.4),
    }
    knob = {"type": "sphere", "center": [0.45, 0.7, -0.2], "radius": 0.3, "bsdf": colour(0.3, 0.3, 0.8)}
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=colour(0.5, 0.6, 0.7))
    return scene(sensor=camera(*LOOK), axis=axis, plate=plate, knob=knob, floor=floor, lamp=lamp())


def cut_bulb() -> mi.Scene:
    """A sphere that shines, half sunk in a board, whose light falls on a floor."""
    bulb = {"type": "sphere", "center": [0.1, 0.9, 0], "radius": 0.3, "bsdf": diffuse(0.0), "emitter": light(9, 8, 7)}
    board = quad((-0.4, 1.0, -0.5), (1.0, -0.1, 0), (0, 0, 1), "board", bsdf=diffuse(0.0, two_sided=True))
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    return scene(sensor=camera((0.4, 2.0, -3.6), (0, 0.5, 0)), bulb=bulb, board=board, floor=floor)


def divided(at: int, corner, u, v) -> tuple[np.ndarray, np.ndarray]:
    """A face that is divided in at × at quads: its vertices and triangles. Its normal is u × v."""
    x, y = (g.ravel() / at for g in np.mgrid[: at + 1, : at + 1])
    i = np.arange((at + 1) ** 2).reshape(at + 1, at + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.asarray(corner) + x[:, None] * np.asarray(u) + y[:, None] * np.asarray(v), faces


def patchwork() -> mi.Scene:
    """T-junctions: the faces of a cube are divided 1, 2 and 3 times, each by itself, and so are a floor and a wall."""
    x, y, z = turned = 0.8 * np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    lower, upper = -turned.sum(0) / 2 + [0.1, 0.7, 0], turned.sum(0) / 2 + [0.1, 0.7, 0]
    sides = [(1, lower, y, x), (2, lower, z, y), (3, lower, x, z), (1, upper, -x, -y), (2, upper, -y, -z)]
    points, triangles, count = [], [], 0
    for side in (*sides, (3, upper, -z, -x)):
        p, f = divided(*side)
        points, triangles, count = [*points, p], [*triangles, f + count], count + len(p)
    thing = mesh("cube", np.concatenate(points), np.concatenate(triangles), bsdf=diffuse(0.8, 0.5, 0.3))
    colour = diffuse(0.5, 0.6, 0.7, two_sided=True)
    floor = mesh("floor", *divided(3, (-2, 0, -2), (0, 0, 3), (4, 0, 0)), bsdf=colour)
    wall = mesh("wall", *divided(2, (-2, 0, 1), (0, 2, 0), (4, 0, 0)), bsdf=diffuse(0.6, 0.4, 0.4, two_sided=True))
    return scene(sensor=camera(*LOOK), cube=thing, floor=floor, wall=wall, lamp=lamp())


SLIDE = {"key": "cube.vertex_positions", "direction": [1, 0, 0.3]}
TURN = {"key": "cube.vertex_positions", "rotate": [0.3, 1, 0.2]}
SINK = {"key": "cube.vertex_positions", "direction": [0, -1, 0]}
RISE = {"key": "floor.vertex_positions", "direction": [0, 1, 0]}
CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0]}
BALL = {"key": "ball.vertex_positions", "direction": [0.77, 0.5, -0.3]}
BOARD = {"key": "board.vertex_positions", "direction": [1, 0.2, 0]}
DEFORM = {"key": "knot.vertex_positions", "direction": [1, 0.3, 0], "vertices": list(range(8))}
TILT = {"key": "spike.vertex_positions", "direction": [0, 1, 0.7], "vertices": [1, 2, 3, 4]}
BALL_SLIDES = {"key": "ball.to_world", "direction": [1, 0, 0.3]}
BALL_SINKS = {"key": "ball.to_world", "direction": [0, -1, 0]}
AXIS = {"key": "axis.to_world", "rotate": [0.3, 0.2, 1]}
KNOB = {"key": "knob.to_world", "direction": [1, 0.2, 0.3]}
BULB = {"key": "bulb.to_world", "direction": [0.3, 1, 0]}

#: Of each case: scene, motion, step, max_depth.
CUTS: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "sunk_cube_slides": (sunk_cube, SLIDE, 3e-3, 2),
    "sunk_cube_turns": (sunk_cube, TURN, 6e-3, 2),
    "sunk_cube_sinks": (sunk_cube, SINK, 3e-3, 2),
    "sunk_cube_floor": (sunk_cube, RISE, 3e-3, 2),
    "sunk_cube_camera": (sunk_cube, CAMERA, 3e-3, 2),
    "sunk_cube_light": (sunk_cube, SLIDE, 3e-3, 3),
    "sunk_in_gloss": (sunk_in_gloss, SLIDE, 3e-3, 3),
    "sunk_ball": (sunk_ball, BALL, 4e-3, 2),
    "cut_lamp": (cut_lamp, BOARD, 6e-3, 2),
    "knot": (knot, DEFORM, 4e-3, 2),
    "spike": (spike, TILT, 4e-3, 2),
    "patchwork_turns": (patchwork, TURN, 6e-3, 2),
    "patchwork_camera": (patchwork, CAMERA, 3e-3, 2),
    "patchwork_light": (patchwork, SLIDE, 3e-3, 3),
}

#: The same, where spheres, disks and cylinders are cut.
CURVES: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "sunk_sphere_slides": (sunk_sphere, BALL_SLIDES, 3e-3, 2),
    "sunk_sphere_floor": (sunk_sphere, RISE, 3e-3, 2),
    "sunk_sphere_camera": (sunk_sphere, CAMERA, 3e-3, 2),
    "sunk_sphere_light": (sunk_sphere, BALL_SINKS, 3e-3, 3),
    "pillar_turns": (pillar, AXIS, 4e-3, 2),
    "pillar_knob": (pillar, KNOB, 3e-3, 2),
    "cut_bulb": (cut_bulb, BULB, 4e-3, 2),
}
