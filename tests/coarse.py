"""Coarse smooth-shaded meshes, whose light other surfaces see: where interpolated normals turn away, it jumps."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from building import camera, diffuse, film, light, mesh, quad, scene
from random_scenes import ball


def beside_wall(*, glossy: bool = False, n: int = 3) -> Callable[[], mi.Scene]:
    """A lamp shines on a coarse ball. The camera sees a wall, which only the ball lights.

    glossy : is it of rough metal? n : the ball has 2 n × n quads.
    """

    def build() -> mi.Scene:
        points, _, _, faces = ball(n)
        turned = np.array(mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 37).matrix)[:3, :3]
        bsdf = {"type": "roughconductor", "alpha": 0.4} if glossy else diffuse(0.8, 0.7, 0.6)
        return scene(
            sensor=camera((1, -0.3, -4), (-1, -0.2, -0.6), fov=14, film=film(width=16, height=16)),
            ball=mesh("ball", 0.5 * points @ turned.T + [-0.1, 0, 0], faces, normals=True, bsdf=bsdf),
            wall=quad((-1, -1, -2), (0, 2.5, 0), (0, 0, 4), "wall", bsdf=diffuse(0.8, two_sided=True)),
            # In the plane of the wall, which it does not light.
            lamp=quad((-1, 1.6, -0.4), (0, 0.8, 0), (0, 0, 0.8), "lamp", bsdf=diffuse(0), emitter=light(30, 30, 30)),
        )

    return build


def hill() -> mi.Scene:
    """A sheet with a smooth-shaded hill in its middle, in the light of a point."""
    x = np.linspace(-1, 1, 9)
    X, Z = np.meshgrid(x, x)
    high = (np.abs(X) < 0.3) & (np.abs(Z) < 0.6)
    points = np.stack([X, 0.3 * high, Z], -1).reshape(-1, 3)
    corner = (9 * np.arange(8)[:, None] + np.arange(8)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 9, 1], corner[:, None] + [1, 9, 10]])
    lamp = {"type": "point", "position": [1.5, 1.3, 0.1], "intensity": {"type": "rgb", "value": 5.0}}
    ground = mesh("hill", points, faces, normals=True, bsdf=diffuse(0.5))
    return scene(sensor=camera((0, 3, 3), fov=40, film=film(width=16, height=16)), hill=ground, lamp=lamp)


NORMALS = {"key": "ball.vertex_normals", "direction": [0.3]}

#: Scene, motion, step, integrator.
COARSE = {
    "coarse_normals": (beside_wall(), NORMALS, 0.1, "prb_edge"),
    "coarse_slides": (beside_wall(), {"key": "ball.vertex_positions", "direction": [-1, 0.3, 0.2]}, 4e-2, "bdpt_edge"),
    "coarse_camera": (beside_wall(), {"key": "sensor.to_world", "direction": [0, 0.3, 1]}, 2e-1, "bdpt_edge"),
    "coarse_metal": (beside_wall(glossy=True), NORMALS, 0.1, "bdpt_edge"),
    "coarse_hill": (hill, {"key": "hill.vertex_normals", "direction": [0.3, 0, 0.2] * 81}, 6e-3, "prb_edge"),
}
