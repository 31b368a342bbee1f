"""Textures with several texels, or bumps, in a pixel: their points are held where the camera sees them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, film, mesh, scene

LOOK = ((0.8, 1.4, -3.2), (0, 0.1, 0))

#: Texels along each side of the fine bitmaps.
TEXELS = 256


def bitmap(seed: int, texels: int = TEXELS, **options: Any) -> dict[str, Any]:
    values = np.random.default_rng(seed).uniform(0.05, 0.95, (texels, texels, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, **options}


def fine(seed: int = 0) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap(seed)}}


def bumpy() -> dict[str, Any]:
    """A rough metal with fine bumps."""
    slopes = np.random.default_rng(2).uniform(0.35, 0.65, (TEXELS, TEXELS, 3)).astype(np.float32)
    slopes[..., 2] = 0.95
    metal = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.25}
    normals = {"type": "bitmap", "bitmap": mi.Bitmap(slopes), "raw": True}
    return {"type": "twosided", "bsdf": {"type": "normalmap", "normalmap": normals, "bsdf": metal}}


def square(name: str, corner, u, v, bsdf: dict[str, Any]) -> mi.Mesh:
    a, u, v = np.array(corner, float), np.array(u, float), np.array(v, float)
    corners = [a, a + u, a + u + v, a + v]
    return mesh(name, corners, [[0, 1, 2], [0, 2, 3]], uv=[(0, 0), (1, 0), (1, 1), (0, 1)], bsdf=bsdf)


def textured_box(bsdf: dict[str, Any]) -> mi.Mesh:
    """A cube, each side of which shows the whole texture."""
    v = 0.45 * cube_vertices() + [0.1, 0.15, 0.2]
    corners, uv, faces = [], [], []
    for side in range(6):
        of = sorted({c for t in CUBE_FACES[2 * side : 2 * side + 2] for c in t})
        flat = int(np.argmin(np.ptp(v[of], axis=0)))
        across = [k for k in range(3) if k != flat]
        uv.extend((v[of][:, across] - v[of][:, across].min(0)) / 0.9)
        faces.extend([[len(corners) + of.index(c) for c in t] for t in CUBE_FACES[2 * side : 2 * side + 2]])
        corners.extend(v[of])
    return mesh("cube", corners, faces, uv=uv, bsdf=bsdf)


def sun() -> dict[str, Any]:
    return {"type": "directional", "direction": [0.4, -1, 0.7], "irradiance": {"type": "rgb", "value": [2, 1.8, 1.5]}}


def stage(
    floor: Callable[[], dict] = fine,
    back: Callable[[], dict] = lambda: diffuse(0.6, 0.5, 0.4, two_sided=True),
    box: Callable[[], dict] = lambda: diffuse(0.3, 0.5, 0.8),
    lamp: Callable[[], dict] = sun,
    **view: Any,
) -> Callable[[], mi.Scene]:
    """A cube over a floor before a wall, in the sun: if nothing else lights them, finite differences have little noise,
    since samples that are spread evenly over a pixel see all of its texels."""

    def build() -> mi.Scene:
        return scene(
            sensor=camera(*LOOK, **{k: v() if callable(v) else v for k, v in view.items()}),
            floor=square("floor", (-2, -0.3, -1.4), (0, 0, 2.5), (4, 0, 0), floor()),
            back=square("back", (-2, -0.6, 1.2), (0, 2.3, 0), (4, 0, 0), back()),
            cube=textured_box(box()),
            lamp=lamp(),
        )

    return build


def ball() -> mi.Scene:
    """A ball with a fine texture on a plain floor, in the sun."""
    to_world = mi.ScalarTransform4f().translate([0.1, 0.4, 0.1]).rotate([0.6, 0.8, 0], 50).scale(0.6)
    return scene(
        sensor=camera(*LOOK, film=gaussian()),
        floor=square("floor", (-2, -0.3, -1.4), (0, 0, 2.6), (4, 0, 0), diffuse(0.6, 0.5, 0.4)),
        ball={"type": "sphere", "to_world": to_world, "bsdf": fine(1)["bsdf"]},
        lamp=sun(),
    )


gaussian = lambda: film("gaussian")
CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0.2]}
LOOK_UP = {"key": "sensor.to_world", "rotate": [1, 0.4, 0.3]}
WALL = {"key": "back.vertex_positions", "direction": [1, 0.5, 0]}
BOX = {"key": "cube.vertex_positions", "rotate": [0.2, 1, 0.1]}

#: Scene, motion, step, and the depth of the paths.
FINE = {
    "fine_camera": (stage(), CAMERA, 1e-3, 2),
    "fine_look": (stage(back=lambda: fine(1), film=gaussian), LOOK_UP, 4e-4, 2),
    "fine_lens": (stage(kind="thinlens", aperture_radius=0.08, focus_distance=3.0), CAMERA, 1e-3, 2),
    "fine_wall": (stage(floor=lambda: diffuse(0.5), back=lambda: fine(1)), WALL, 1e-3, 2),
    "fine_box": (stage(floor=lambda: diffuse(0.5), box=lambda: fine(1), film=gaussian), BOX, 1e-3, 2),
    "fine_ball": (ball, CAMERA, 1e-3, 2),
    "fine_soft_light": (stage(lamp=constant), CAMERA, 1e-3, 3),
    "fine_bumps": (stage(floor=bumpy), CAMERA, 1e-3, 2),
}
