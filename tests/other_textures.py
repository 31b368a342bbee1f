"""Textures that come to jump at other places, as scripts replace them between two steps."""

from __future__ import annotations

import beams
import mitsuba as mi
import numpy as np
from building import camera, constant, diffuse, mesh, scene


def pixels(side: int, scale: float = 1.0) -> np.ndarray:
    return (scale * np.random.default_rng(side).uniform(0.1, 0.9, (side, side, 3))).astype(np.float32)


def picture(side: int, scale: float = 1.0, **options) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels(side, scale)), "raw": True, "wrap_mode": "clamp", **options}


def with_board(bsdf: dict):
    corners, faces = [[-1, -0.8, 0.2], [1, -0.8, -0.1], [-1, 0.9, 0.3], [1, 0.9, 0]], [[0, 2, 1], [1, 2, 3]]
    uv = [[0, 0], [1, 0], [0, 1], [1, 1]]
    board = mesh("board", corners, faces, uv=uv, bsdf={"type": "twosided", "bsdf": bsdf})
    return scene(sensor=camera(), board=board, sky=constant())


def checkers(scale: float) -> dict:
    to_uv = mi.ScalarTransform3f().scale([scale, scale])
    texture = {"type": "checkerboard", "color0": 0.1, "color1": 0.8, "to_uv": to_uv}
    return {"type": "diffuse", "reflectance": texture}


#: Scene, and which parameter gets which value.
TEXTURES = {
    "checkers are scaled": (
        lambda: with_board(checkers(3)),
        "board.bsdf.brdf_0.reflectance.to_uv",
        lambda _: mi.ScalarTransform3f().scale([5, 2]),
    ),
    "checkers come on to the board": (
        lambda: with_board(checkers(0.3)),
        "board.vertex_texcoords",
        lambda uv: 8 * uv,
    ),
    "a picture has more texels": (
        lambda: with_board({"type": "diffuse", "reflectance": picture(4, filter_type="nearest")}),
        "board.bsdf.brdf_0.reflectance.data",
        lambda _: mi.TensorXf(pixels(9)),
    ),
    "bumps have more texels": (
        lambda: with_board({"type": "bumpmap", "heights": picture(3), "scale": 0.6, "bsdf": diffuse(0.5)}),
        "board.bsdf.brdf_0.nested_texture.data",
        lambda _: mi.TensorXf(pixels(8)),
    ),
    "a light throws more texels": (
        lambda: beams.on_cube(
            lambda: {
                "type": "projector",
                "to_world": beams.at(),
                "irradiance": picture(4, 9, filter_type="nearest"),
                "fov": 40.0,
            }
        )(),
        "lamp.irradiance.data",
        lambda _: mi.TensorXf(pixels(9, 9)),
    ),
}
