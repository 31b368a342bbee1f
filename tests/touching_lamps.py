"""Lamps that touch what they light, and what changes in their scenes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, diffuse, horizontal, light, mesh, quad, scene

WHITE = {"bsdf": diffuse(0.7, 0.65, 0.6, two_sided=True)}


def strip() -> mi.Scene:
    """A strip at the top of a channel that is open below, through the walls of which it passes."""
    along = (0, 0, 1.6)
    return scene(
        sensor=camera((0.5, -0.1, -1.3), (-0.05, 0.8, 0.1)),
        left=quad((-0.2, 0.6, -0.8), along, (0, 0.6, 0), "left", **WHITE),
        right=quad((0.2, 0.6, -0.8), (0, 0.6, 0), along, "right", **WHITE),
        lamp=quad((-0.25, 1, -0.7), (0.5, 0, 0), (0, 0, 1.4), "lamp", bsdf=diffuse(0.0), emitter=light(3, 2.5, 2)),
        floor=horizontal((0, -0.5, 0), 2, "floor", bsdf=diffuse(0.5)),
    )


def window() -> mi.Scene:
    """A window in the reveal of a wall, above a floor."""
    left, right, low, high, wall, back = -0.4, 0.4, 0.5, 1.2, 1.0, 1.45
    deep = (0, 0, back - wall)
    reveal = {
        "sill": quad((left, low, wall), deep, (right - left, 0, 0), "sill", **WHITE),
        "lintel": quad((left, high, wall), (right - left, 0, 0), deep, "lintel", **WHITE),
        "jamb": quad((left, low, wall), (0, high - low, 0), deep, "jamb", **WHITE),
        "other_jamb": quad((right, low, wall), deep, (0, high - low, 0), "other_jamb", **WHITE),
    }
    around = {
        "below": quad((-2, 0, wall), (0, low, 0), (4, 0, 0), "below", **WHITE),
        "above": quad((-2, high, wall), (0, 0.6, 0), (4, 0, 0), "above", **WHITE),
        "beside": quad((-2, low, wall), (0, high - low, 0), (2 + left, 0, 0), "beside", **WHITE),
        "other_side": quad((right, low, wall), (0, high - low, 0), (2 - right, 0, 0), "other_side", **WHITE),
    }
    pane = quad(
        (left, low, 1.35), (0, high - low, 0), (right - left, 0, 0), "pane", bsdf=diffuse(0.0), emitter=light(2, 2, 1.8)
    )
    floor = horizontal((0, 0, -1), 2, "floor", bsdf=diffuse(0.4, 0.5, 0.6))
    return scene(sensor=camera((0.9, 1.1, -0.8), (-0.1, 0.75, 1.2)), **reveal, **around, pane=pane, floor=floor)


def boxes(name: str, corners: list[tuple[np.ndarray, np.ndarray]]) -> mi.Mesh:
    """Boxes along the axes, by their lower and upper corners, as one mesh."""
    cube = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    v = [np.asarray(lower) + cube * np.subtract(upper, lower) for lower, upper in corners]
    f = [np.array(CUBE_FACES) + 8 * i for i in range(len(corners))]
    return mesh(name, np.concatenate(v), np.concatenate(f), **WHITE)


def wide_window() -> mi.Scene:
    """A window as wide as the wall in a reveal with thin mouldings and bars, before a room full of boxes; the camera
    is close to the reveal."""
    left, right, low, high, wall, back = -2.5, 2.5, 0.8, 2.3, 1.0, 1.3
    deep, across = (0, 0, back - wall), (right - left, 0, 0)
    around = {
        "sill": quad((left, low, wall), deep, across, "sill", **WHITE),
        "lintel": quad((left, high, wall), across, deep, "lintel", **WHITE),
        "jamb": quad((left, low, wall), (0, high - low, 0), deep, "jamb", **WHITE),
        "other_jamb": quad((right, low, wall), deep, (0, high - low, 0), "other_jamb", **WHITE),
        "below": quad((-3.2, 0, wall), (0, low, 0), (6.4, 0, 0), "below", **WHITE),
        "beside": quad((-3.2, low, wall), (0, high - low, 0), (left + 3.2, 0, 0), "beside", **WHITE),
    }
    pane = quad(
        (left, low, back - 0.02), (0, high - low, 0), across, "pane", bsdf=diffuse(0.0), emitter=light(2, 2, 1.8)
    )
    thin = [((x - 0.015, low, back - 0.08), (x + 0.015, high, back - 0.04)) for x in np.arange(left + 0.5, right, 0.5)]
    for k in range(4):
        z, out = wall + 0.03 + 0.05 * k, 0.02 + 0.008 * k
        thin.append(((left, low, z), (right, low + out, z + 0.02)))
        thin.append(((left, low, z), (left + out, high, z + 0.02)))
    rng = np.random.default_rng(0)
    middle, half = rng.uniform([-3, 0, -3], [3, 1.2, 0.6], (60, 3)), rng.uniform(0.03, 0.2, (60, 3))
    furniture = boxes("furniture", list(zip(middle - half, middle + half, strict=True)))
    floor = horizontal((0, 0, -1), 3.2, "floor", bsdf=diffuse(0.4, 0.5, 0.6))
    view = camera((-1.2, 1.7, -0.2), (-2.4, 0.65, 1.05))
    return scene(sensor=view, **around, mouldings=boxes("mouldings", thin), furniture=furniture, pane=pane, floor=floor)


def bulb() -> mi.Scene:
    """A ball that shines stands on a floor, beside a board."""
    ball = {
        "type": "sphere",
        "to_world": mi.ScalarTransform4f().translate([-0.3, 0.25, 0]).scale(0.25),
        "bsdf": diffuse(0.0),
        "emitter": light(1, 2, 3),
    }
    floor = horizontal((0, 0, 0), 1.5, "floor", bsdf=diffuse(0.6, 0.6, 0.5))
    board = quad((0.15, 0.05, -0.2), (0, 0.25, 0), (0.05, 0, 0.4), "board", **WHITE)
    return scene(sensor=camera((0.2, 1.1, -2.2), (0, 0.05, 0)), floor=floor, board=board, ball=ball)


CAMERA_ALONG = {"key": "sensor.to_world", "direction": [1, 0, 0]}
LEFT_ASIDE = {"key": "left.vertex_positions", "direction": [1, 0, 0]}
BALL_ALONG = {"key": "ball.to_world", "direction": [1, 0, 0]}
BOARD_ALONG = {"key": "board.vertex_positions", "direction": [1, 0, 0.5]}
PANE_IN = {"key": "pane.vertex_positions", "direction": [0, 0, 1]}

#: Of each case: scene, motion, step, longest path.
TOUCHING = {
    "strip_camera": (strip, CAMERA_ALONG, 2e-3, 2),
    "strip_wall": (strip, LEFT_ASIDE, 3e-3, 2),
    "window_camera": (window, CAMERA_ALONG, 6e-3, 4),
    "window_moves": (window, PANE_IN, 6e-3, 2),
    "wide_window_camera": (wide_window, CAMERA_ALONG, 3e-3, 2),
}
