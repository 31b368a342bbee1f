"""Scenes in which light goes through opacity masks: leaves, veils, and what is seen through them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball


def opacity(filter_type: str, lowest: float, highest: float) -> dict:
    """Texels of 5 × 6 opacities; of a leaf, these are 0 or 1."""
    texels = np.random.default_rng(4).uniform(lowest, highest, (5, 6, 1))
    texels = np.round(texels) if (lowest, highest) == (0, 1) else texels
    image = mi.Bitmap(texels.astype(np.float32))
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": filter_type, "wrap_mode": "clamp"}


def mask(texture: dict) -> dict:
    return {"type": "mask", "opacity": texture, "nested": diffuse(0.3, 0.6, 0.1, two_sided=True)}


def leaf() -> dict:
    return mask(opacity("nearest", 0, 1))


def veil() -> dict:
    return mask(opacity("bilinear", 0.1, 0.9))


def glow() -> mi.Mesh:
    return lit_wall(emitter=light(6, 5, 4))


def lit_wall(**emitter: dict) -> mi.Mesh:
    return quad((2.4, 0.05, -1.4), (0, 0, 2.8), (0, 1.4, 0), "glow", bsdf=diffuse(0.7), **emitter)


def beside_leaf(
    bsdf: Callable[[], dict] = veil,
    wall: Callable[[], mi.Mesh] = glow,
    height: float = 4,
    fov: float = 24,
    **more: Callable[[], Any],
) -> Callable[[], mi.Scene]:
    """A floor, seen from above; out of the frame, a leaf stands on it, and behind that a cube before a lamp."""

    def build() -> mi.Scene:
        T = mi.ScalarTransform4f
        leaf = {"type": "rectangle", "id": "leaf", "bsdf": bsdf()}
        leaf["to_world"] = T().translate([1.25, 0.72, 0.05]).rotate([0, 1, 0], -85).scale([1.1, 0.7, 1])
        return scene(
            sensor=camera((0.1, height, 0), (0.1, 0, 0.01), fov=fov),
            floor=horizontal((0, 0, 0), 3, "floor", bsdf=diffuse(0.7)),
            leaf=leaf,
            cube=mesh("cube", 0.22 * cube_vertices() + [1.75, 0.5, -0.2], CUBE_FACES, bsdf=diffuse(0.6, 0.3, 0.2)),
            glow=wall(),
            sky=constant(0.1),
            **{k: v() for k, v in more.items()},
        )

    return build


def behind_leaf(floor: Callable[[], dict] = lambda: diffuse(0.7), **more: Callable[[], Any]) -> Callable[[], mi.Scene]:
    """A cube over a floor, seen through a leaf that fills the frame."""

    def build() -> mi.Scene:
        T = mi.ScalarTransform4f
        leaf = {"type": "rectangle", "id": "leaf", "bsdf": veil()}
        leaf["to_world"] = T().translate([0.4, 1.6, -2.6]).rotate([1, 0, 0], -20).scale([1.6, 1.6, 1])
        ground = {"type": "rectangle", "id": "floor", "bsdf": floor()}
        ground["to_world"] = T().rotate([1, 0, 0], -90).scale(2)
        return scene(
            sensor=camera((0.6, 2.2, -4), (0, 0.3, 0), fov=35),
            floor=ground,
            leaf=leaf,
            cube=mesh("cube", 0.35 * cube_vertices() + [0.1, 0.8, 0], CUBE_FACES, bsdf=diffuse(0.6, 0.3, 0.2)),
            sky=constant(0.2),
            **{k: v() for k, v in more.items()},
        )

    return build


def coarse_ball(bsdf: Callable[[], dict], **before: Callable[[], dict]) -> Callable[[], mi.Scene]:
    """A coarse smooth-shaded ball in the sun, before a wall that glows. before : what it is seen through."""

    def build() -> mi.Scene:
        points, *_, faces = ball(4)
        turned = np.array(mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 37).matrix)[:3, :3]
        centred = 0.6 * points @ turned.T + [0, 0.4, 0]
        return scene(
            sensor=camera((0.6, 1.2, -3.4), (0, 0.4, 0), fov=35),
            ball=mesh("ball", centred, faces, normals=True, bsdf=bsdf()),
            wall=quad((-2, -1, 1.5), (4, 0, 0), (0, 3, 0), "wall", bsdf=diffuse(0), emitter=light(0.4, 0.3, 0.2)),
            sun={"type": "directional", "direction": [0.5, -1, 0.7], "irradiance": {"type": "rgb", "value": 3.0}},
            sky=constant(0.3),
            **{k: v() for k, v in before.items()},
        )

    return build


def pane() -> dict:
    T = mi.ScalarTransform4f
    to_world = T().translate([0.3, 1, -2]).rotate([1, 0, 0], -15).scale(2)
    return {"type": "rectangle", "id": "pane", "to_world": to_world, "bsdf": {"type": "thindielectric"}}


def thin_cloth() -> dict:
    return {"type": "mask", "opacity": 0.6, "nested": diffuse(0.7, two_sided=True)}


def shiny_leaf() -> mi.Scene:
    """A leaf of plastic, which is let through in part, and scatters or reflects the rest."""
    plastic = {"type": "twosided", "nested": {"type": "plastic", "diffuse_reflectance": 0.5}}
    bsdf = {"type": "mask", "opacity": opacity("nearest", 0.1, 0.9), "nested": plastic}
    sheet = quad((-1, -0.4, -0.6), (2, 0, 0.5), (0, 1.8, 0.3), "sheet", bsdf=bsdf, uv=[[0, 0], [1, 0], [0, 1], [1, 1]])
    return scene(
        sensor=camera((0.6, 1.2, -3.4), (0, 0.4, 0), fov=35),
        sheet=sheet,
        cube=mesh("cube", 0.3 * cube_vertices() + [0.1, 0.4, 0.8], CUBE_FACES, bsdf=diffuse(0.6, 0.3, 0.2)),
        sky=constant(0.4),
        point=point((-0.6, 3.0, -1.4), 12.0),
    )


def ceiling() -> mi.Mesh:
    return horizontal((-0.6, 3.5, 0.4), 0.4, "lamp", down=True, emitter=light(14, 12, 10))


def point(position=(1.42, 0.6, 0.15), intensity: float = 3.0) -> dict:
    return {"type": "point", "position": list(position), "intensity": {"type": "rgb", "value": intensity}}


def point_above() -> dict:
    return point((-0.6, 3.0, 0.4), 12.0)


def checkers() -> dict:
    colours = {"color0": 0.1, "color1": 0.8, "to_uv": mi.ScalarTransform3f().scale([6, 5])}
    return {"type": "diffuse", "reflectance": {"type": "checkerboard", **colours}}


CUBE = {"key": "cube.vertex_positions", "direction": [0.2, 0.3, 1]}
GLOW = {"key": "glow.vertex_positions", "direction": [0.2, 0.3, 1]}
MOVES = {"key": "leaf.to_world", "direction": [0.2, 0.3, 1]}
BALL = {"key": "ball.vertex_positions", "direction": [1, 0.3, 0.2]}
CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0.4]}
OPACITY = {"key": "leaf.bsdf.opacity.data", "direction": [1]}

#: Of each case: scene, motion, step, max_depth.
LEAVES: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "veil_glow": (beside_leaf(), GLOW, 8e-2, 3),
    "null_glow": (beside_leaf(lambda: {"type": "null"}), GLOW, 8e-2, 3),
    "veil_cube": (beside_leaf(), CUBE, 8e-2, 4),
    "veil_camera": (beside_leaf(), CAMERA, 4e-2, 4),
    "veil_opacity": (beside_leaf(), OPACITY, 5e-2, 4),
    "leaf_moves": (beside_leaf(leaf, height=1.6, fov=56), MOVES, 8e-2, 4),
    "leaf_shadow": (beside_leaf(leaf, wall=lit_wall, point=point), CUBE, 4e-2, 4),
    "behind_veil_point": (behind_leaf(lamp=point_above), CUBE, 4e-3, 4),
    "behind_veil_checkers": (behind_leaf(floor=checkers, lamp=ceiling), CAMERA, 4e-3, 4),
}

#: The same, of what the camera sees through veils, with less noise.
SEEN_THROUGH: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "coarse_behind_pane": (coarse_ball(lambda: diffuse(0.7), pane=pane), BALL, 2e-3, 3),
    "coarse_veil": (coarse_ball(thin_cloth), BALL, 2e-3, 3),
    "shiny_leaf": (shiny_leaf, CAMERA, 2e-3, 3),
}
