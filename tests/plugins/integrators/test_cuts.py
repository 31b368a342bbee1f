"""Derivatives of shapes that cut through each other. Their references are in `test_derivatives.py`."""

from __future__ import annotations

import cuts
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, derivative_image

INTEGRATORS = {"direct_edge": {"type": "direct_edge"}, "prb_edge": {"type": "prb_edge", "max_depth": 3}}


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize(
    ("of", "key"),
    [
        (cuts.sunk_cube, "cube.vertex_positions"),
        (cuts.sunk_cube, "floor.vertex_positions"),
        (cuts.sunk_cube, "sensor.to_world"),
        (cuts.sunk_sphere, "ball.to_world"),
        (cuts.sunk_sphere, "floor.vertex_positions"),
        (cuts.pillar, "knob.to_world"),
    ],
)
def test_gradients_are_those_of_forward_mode(name, of, key):
    scene, made = of(), mi.load_dict(INTEGRATORS[name])
    assert_backward_is_forward(scene, made, Motion(scene, key, direction=[1, 0.4, 0.2]))


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize(
    ("of", "key"), [(cuts.sunk_cube, "cube.vertex_positions"), (cuts.pillar, "floor.vertex_positions")]
)
def test_frozen_functions(name, of, key):
    assert_frozen_is_unfrozen(of(), mi.load_dict(INTEGRATORS[name]), key)


def assert_same(scene: mi.Scene, used: mi.Integrator, motion: dict) -> None:
    """An integrator that was used before gives what a new one does, with other samples."""
    motion, new = Motion(scene, **motion), mi.load_dict(INTEGRATORS["direct_edge"])
    a, b = (np.array(derivative_image(scene, made, motion, spp=512, seed=1), float) for made in (used, new))
    assert (a * b).sum() / (b * b).sum() == pytest.approx(1, abs=0.01)
    assert np.abs(a - b).sum() < 0.05 * np.abs(b).sum()  # other samples: 2 %


def test_lines_are_not_kept_when_meshes_part():
    scene, used = cuts.sunk_cube(), mi.load_dict(INTEGRATORS["direct_edge"])
    params, key = mi.traverse(scene), "cube.vertex_positions"
    still = mi.Float(params[key])
    for height in (0, 0.8, 0.1, 0):
        params[key] = still + mi.Float([0, height, 0] * 8)
        params.update()
        assert_same(scene, used, cuts.SLIDE)


def test_curves_are_not_kept_when_shapes_part():
    scene, used = cuts.sunk_sphere(), mi.load_dict(INTEGRATORS["direct_edge"])
    params, key = mi.traverse(scene), "ball.to_world"
    still = mi.Transform4f(params[key])
    for height in (0, 0.8, 0.1, 0):
        params[key] = mi.Transform4f().translate([0, height, 0]) @ still
        params.update()
        assert_same(scene, used, cuts.BALL_SLIDES)


def test_a_mesh_that_comes_to_cut_through_itself():
    scene, used = cuts.knot(), mi.load_dict(INTEGRATORS["direct_edge"])
    params, key = mi.traverse(scene), "knot.vertex_positions"
    together = mi.Float(params[key])
    for shift in (1, 0.1):
        params[key] = together - mi.Float([shift, 0, 0] * 8 + [0, 0, 0] * 8)
        params.update()
        assert_same(scene, used, cuts.DEFORM)
        assert (not used.search.geometry.lines) == (shift == 1)
