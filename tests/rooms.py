"""Rooms in which things touch, and hard shadows that light other surfaces: what `cases.py` has of interreflections."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from building import camera, constant, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball


def lamp() -> mi.Mesh:
    return horizontal((0.1, 1.9, -0.2), 0.3, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(14, 12, 10))


def walls(front: bool = False) -> dict[str, Any]:
    """Floor, back and left wall of a room of 2 × 2 × 2 units, which share their edges; and with a front, all six."""
    names = ["floor", "back", "left", *(["ceiling", "front", "right"] if front else [])]
    colours = {"floor": (0.7, 0.7, 0.6), "back": (0.6, 0.6, 0.7), "left": (0.7, 0.2, 0.2), "right": (0.2, 0.6, 0.2)}
    corner = {
        "floor": ((-1, 0, -1), (0, 0, 2), (2, 0, 0)),
        "back": ((-1, 0, 1), (0, 2, 0), (2, 0, 0)),
        "left": ((-1, 0, -1), (0, 2, 0), (0, 0, 2)),
        "ceiling": ((-1, 2, -1), (2, 0, 0), (0, 0, 2)),
        "front": ((-1, 0, -1), (2, 0, 0), (0, 2, 0)),
        "right": ((1, 0, -1), (0, 0, 2), (0, 2, 0)),
    }
    return {n: quad(*corner[n], n, bsdf=diffuse(*colours.get(n, (0.7, 0.7, 0.7)), two_sided=True)) for n in names}


def box(centre, half, faces: str, **props: Any) -> mi.Mesh:
    """A box without those of its faces that touch something. faces : of "left right bottom top front back"."""
    v = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float) * half + centre
    quads = {
        "front": (0, 2, 3, 1),
        "back": (4, 5, 7, 6),
        "bottom": (0, 1, 5, 4),
        "top": (2, 6, 7, 3),
        "left": (0, 4, 6, 2),
        "right": (1, 3, 7, 5),
    }
    f = [[q[i] for i in t] for q in (quads[n] for n in faces.split()) for t in ((0, 1, 2), (0, 2, 3))]
    return mesh("box", v, f, **props)


LOOK = ((0.9, 1.4, -3.2), (-0.2, 0.6, 0.2))


def box_along_wall() -> mi.Scene:
    """A box stands on the floor, with its back at the wall."""
    b = box((0, 0.4, 0.65), (0.3, 0.4, 0.35), "left right top front", bsdf=diffuse(0.5, 0.5, 0.7, two_sided=True))
    return scene(sensor=camera(*LOOK), **walls(), box=b, lamp=lamp())


def corner() -> mi.Scene:
    """The camera looks into a corner of a room."""
    return scene(sensor=camera((0.6, 1.0, -1.2), (-0.8, 0.2, 0.8)), **walls(), lamp=lamp())


def ball_on_floor() -> mi.Scene:
    """A smooth ball touches the floor in a point."""
    p, _, _, f = ball(16)
    p = np.asarray(p) * 0.4 + [0.1, 0.4, 0.1]
    b = mesh("ball", p, f, normals=True, bsdf=diffuse(0.6, 0.5, 0.3, two_sided=True))
    return scene(sensor=camera(*LOOK), **walls(), ball=b, lamp=lamp())


def spot_behind_screen() -> mi.Scene:
    """A spot lights the ceiling from behind a screen; the room is lit by the ceiling."""
    spot = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at([-0.7, 0.3, 0.5], [-0.1, 2.0, 0.1], [0, 0, 1]),
        "intensity": 20.0,
        "cutoff_angle": 35.0,
    }
    screen = quad((-0.6, 1.0, -0.2), (0.5, 0, 0), (0, 0, 0.7), "screen", bsdf=diffuse(0.4, two_sided=True))
    room = {**walls(), "ceiling": walls(True)["ceiling"]}
    return scene(sensor=camera((0.7, 0.9, -3.4), (-0.2, 0.35, 1), fov=16), **room, screen=screen, spot=spot)


def sun_through_window() -> mi.Scene:
    """The sun shines past a board on a floor, which lights the wall that the camera sees."""
    board = quad((-0.35, 1.9, 0.0), (0.8, 0, 0), (0, 0.1, 0.6), "board", bsdf=diffuse(0.5, two_sided=True))
    sun = {"type": "directional", "direction": [0.1, -1, -0.05], "irradiance": 4.0}
    return scene(sensor=camera((0.2, 0.8, -3.2), (0.0, 0.75, 1), fov=20), **walls(), board=board, sun=sun)


def rough_panes() -> mi.Scene:
    """Two panes of rough glass before a lamp with a picture, as in Mitsuba's `TranslateGlassPlaneLens`; a matt plate
    slides between them."""
    glass = {"type": "roughdielectric", "distribution": "beckmann", "alpha": 0.8, "int_ior": 1.001, "ext_ior": 1.1}
    pane = lambda name, z: quad((-4, -4, z), (8, 0, 0), (0, 8, 0), name, bsdf=glass)
    x, y = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 1, 16))
    picture = np.stack([x, y, 1 - x * y], -1).astype(np.float32) * 4
    shown = {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True, "wrap_mode": "clamp"}
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -1]),
        "bsdf": diffuse(0.0),
        "emitter": {"type": "area", "radiance": shown},
    }
    plate = quad((-0.5, -0.3, 0.4), (0.5, 0, 0.2), (0, 0.6, 0), "plate", bsdf=diffuse(0.6, 0.3, 0.2, two_sided=True))
    panes = {"front": pane("front", 1), "back": pane("back", 0)}
    spot = {"type": "point", "position": [0.3, 0.8, 0.8], "intensity": 2.0}
    return scene(sensor=camera((0, 0, 2), (0, 0, 0)), **panes, plate=plate, lamp=lamp, spot=spot)


def hidden_shadow() -> mi.Scene:
    """The camera sees a wall, which is lit by a floor below the frame; on that falls the shadow of a black board. All
    of the derivative comes from shadows in indirect light."""
    spot = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at([0, 2.5, 0], [0, 0, 0], [0, 0, 1]),
        "intensity": 20.0,
        "cutoff_angle": 30.0,
        "beam_width": 30.0,
    }
    return scene(
        sensor=camera((0, 1.2, -4), (0, 1.2, 2), fov=24),
        wall=quad((-2, 0, 1.2), (0, 3, 0), (4, 0, 0), "wall", bsdf=diffuse(0.7, 0.6, 0.5, two_sided=True)),
        floor=horizontal((0, 0, 0), 1.2, "floor", bsdf=diffuse(0.6, 0.7, 0.8)),
        board=horizontal((0.08, 2.2, 0.03), 0.1, "board", bsdf=diffuse(0, two_sided=True)),
        spot=spot,
    )


def box_behind_glass() -> mi.Scene:
    """A box well behind a pane of rough glass: its edges count beyond the vicinity of the glass."""
    faces = "left right bottom top front back"
    glass = {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.3, "int_ior": 1.3}
    return scene(
        sensor=camera((0, 0, -2.5), (0, 0, 1), fov=30),
        pane=quad((-1.5, -1.5, 0), (0, 3, 0), (3, 0, 0), "pane", bsdf=glass),
        box=box((0.1, -0.1, 1.0), (0.3, 0.4, 0.3), faces, bsdf=diffuse(0.7, 0.6, 0.5, two_sided=True)),
        back=quad((-3, -3, 2), (0, 6, 0), (6, 0, 0), "back", bsdf=diffuse(0.5, two_sided=True)),
        sky=constant(),
    )


BOX_ALONG = {"key": "box.vertex_positions", "direction": [1, 0, 0]}
DOLLY = {"key": "sensor.to_world", "direction": [-0.53, -0.31, 0.79]}
BALL_ALONG = {"key": "ball.vertex_positions", "direction": [1, 0, 0.5]}
SCREEN_ALONG = {"key": "screen.vertex_positions", "direction": [1, 0, 0.3]}
BOARD_ALONG = {"key": "board.vertex_positions", "direction": [1, 0, 0.3]}

PLATE_ALONG = {"key": "plate.vertex_positions", "direction": [1, 0.3, 0]}

#: Of each case: scene, motion, step.
ROOMS: dict[str, tuple[Callable[[], mi.Scene], dict, float]] = {
    "box_along_wall": (box_along_wall, BOX_ALONG, 6e-3),
    "corner_dolly": (corner, DOLLY, 6e-3),
    "ball_on_floor": (ball_on_floor, BALL_ALONG, 6e-3),
    "spot_behind_screen": (spot_behind_screen, SCREEN_ALONG, 4e-2),
    "sun_through_window": (sun_through_window, BOARD_ALONG, 4e-2),
    "rough_panes": (rough_panes, PLATE_ALONG, 1e-2),
}
