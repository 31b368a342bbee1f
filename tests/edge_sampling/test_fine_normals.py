"""Which smooth-shaded meshes are rough: `fine_normals.py`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from building import camera, diffuse, film, light, mesh, quad, scene
from random_scenes import ball

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.fine_normals import fine_normals


def before_camera(bumps: float, *, normals: bool = True, res: int = 16):
    """A ball whose radius has bumps that are narrower than a pixel, of this height."""
    points, _, _, faces = ball(64)
    points = points * (1 + bumps * np.sin(40 * points).prod(1, keepdims=True))
    thing = mesh("ball", points, faces, normals=normals, bsdf=diffuse(0.5))
    lamp = quad((-1, 3, -1), (2, 0, 0), (0, 0, 2), "lamp", bsdf=diffuse(0), emitter=light(5, 5, 5))
    return scene(sensor=camera(film=film(width=res, height=res)), ball=thing, lamp=lamp)


@pytest.mark.parametrize(
    ("bumps", "more", "rough"),
    [(0, {}, False), (0.02, {}, True), (0.02, {"normals": False}, False), (0.02, {"res": 256}, False)],
    ids=["smooth", "bumps", "facets", "many pixels"],
)
def test_bumps_that_are_narrower_than_a_pixel(bumps, more, rough):
    of = before_camera(bumps, **more)
    found = fine_normals(of, of.sensors()[0], of.shapes())
    assert [s.id() for s in found] == (["ball"] if rough else [])


def test_what_is_out_of_the_frame_is_not_looked_at():
    of = before_camera(0.02)
    away = scene(sensor=camera((0, 0, -5), (0, 0, -9)), ball=of.shapes()[0])
    assert fine_normals(away, away.sensors()[0], away.shapes()) == []


@pytest.mark.parametrize(
    "motion",
    [
        {"key": "ball.vertex_positions", "direction": [1, 0.3, 0]},
        {"key": "sensor.to_world", "direction": [1, 0.3, 0.2]},
    ],
    ids=["slides", "camera"],
)
def test_same_derivative_with_less_noise(motion):
    found = {}
    for holds in (True, False):
        of = before_camera(0.02)
        integrator = mi.load_dict({"type": "direct_edge"})
        integrator.HOLDS = holds
        moves = Motion(of, **motion)
        runs = [np.array(derivative_image(of, integrator, moves, spp=64, seed=7 + i), np.float64) for i in range(8)]
        found[holds] = np.array(runs).sum(-1).reshape(8, 4, 4, 4, 4).sum((2, 4))
    (a, b), error = (found[True], found[False]), lambda x: x.std(0, ddof=1) / np.sqrt(8)
    z = (a.mean(0) - b.mean(0)) / np.maximum(np.hypot(error(a), error(b)), 1e-9)
    assert np.abs(z).max() < 4.5  # of 16 t-distributed values
    assert error(a).sum() < 0.6 * error(b).sum()
