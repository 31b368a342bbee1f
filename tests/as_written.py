"""Scenes as users write them, in which something was wrong at first that no other scene had."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from building import camera, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball

CORNERS = [[-1, -0.8, 0.2], [1, -0.8, -0.1], [-1, 0.9, 0.3], [1, 0.9, 0]]
COORDINATES = [[0, 0], [1, 0], [0, 1], [1, 1]]


def checkered_board() -> mi.Scene:
    """A checkerboard over which texture coordinates may slide."""
    checkers = {
        "type": "checkerboard",
        "color0": 0.1,
        "color1": 0.8,
        "to_uv": mi.ScalarTransform3f().rotate(20).scale([3, 3]),
    }
    bsdf = {"type": "twosided", "both": {"type": "diffuse", "reflectance": checkers}}
    return scene(
        sensor=camera(),
        board=mesh("board", CORNERS, [[0, 2, 1], [1, 2, 3]], uv=COORDINATES, bsdf=bsdf),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.5)),
        lamp=horizontal((0.3, 3, 0.2), 0.5, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(8, 8, 8)),
    )


def behind_hidden_lamps() -> mi.Scene:
    """A board behind a ball and a plate that shine, but are hidden from the camera."""
    return scene(
        sensor=camera((0, 0, -5)),
        board=mesh("board", CORNERS, [[0, 2, 1], [1, 2, 3]], bsdf=diffuse(0.6, two_sided=True)),
        plate=quad((-0.8, -1.2, -2), (0, 1.5, 0), (1, 0, 0.2), "plate", bsdf=diffuse(0.0), emitter=light(0.5, 1, 2)),
        ball={"type": "sphere", "center": [0.3, 0.4, -1.5], "radius": 0.7, "emitter": light(3, 2, 1)},
    )


def coarse_ball() -> mi.Scene:
    """Whose normals may turn, as photometric stereo turns them."""
    p, _, uv, faces = ball(SIDES)
    return scene(
        sensor=camera(),
        ball=mesh("ball", p, faces, normals=True, uv=uv, bsdf=diffuse(0.6, 0.4, 0.3)),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.5)),
        lamp={"type": "point", "position": [2, 4, -1], "intensity": 20.0},
    )


SIDES = 6
TURNS = np.random.default_rng(4).uniform(-1, 1, 3 * (SIDES + 1) * (2 * SIDES + 1)).round(2).tolist()
SLIDE = {"key": "board.vertex_texcoords", "direction": [0.6, -0.5, 0.6, 0.2, -0.4, -0.1, 0.7, 0.6]}

#: Of each case: scene, motion, step, integrator.
AS_WRITTEN = {
    "sliding_checkers": (checkered_board, SLIDE, 5e-3, {"type": "direct_edge"}),
    "turning_normals": (
        coarse_ball,
        {"key": "ball.vertex_normals", "direction": TURNS},
        4e-3,
        {"type": "direct_edge"},
    ),
    "behind_hidden_lamps": (
        behind_hidden_lamps,
        {"key": "board.vertex_positions", "direction": [1, 0.3, 0.2]},
        5e-3,
        {"type": "direct_edge", "hide_emitters": True},
    ),
}
