"""Derivatives of what the camera sees in mirrors. Their references are in `test_derivatives.py`."""

from __future__ import annotations

import drjit as dr
import mirrors
import mitsuba as mi
import numpy as np
import pytest
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, derivative_image

INTEGRATORS = {"direct_edge": {"type": "direct_edge"}, "prb_edge": {"type": "prb_edge", "max_depth": 4}}


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize(
    ("make", "key"),
    [
        (mirrors.over_mirror, "cube.vertex_positions"),
        (mirrors.over_mirror, "mirror.vertex_positions"),
        (mirrors.two_mirrors, "sensor.to_world"),
        (mirrors.glass_ball, "ball.to_world"),
    ],
)
def test_gradients_are_those_of_forward_mode(name, make, key):
    scene, made = make(), mi.load_dict(INTEGRATORS[name])
    motion = Motion(scene, key, direction=[1, 0.4, 0.2])
    forward = np.array(derivative_image(scene, made, motion, spp=16, seed=3), float)
    weight = np.random.default_rng(0).uniform(0.5, 1, forward.shape)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.apply(θ)
    made.render_backward(scene, motion.params, mi.TensorXf(weight.astype(np.float32)), seed=3, spp=16)
    dr.enqueue(dr.ADMode.Backward, θ)
    dr.traverse(dr.ADMode.Backward)
    expected = (weight * forward).sum()
    assert abs(dr.grad(θ)[0] - expected) < 1e-3 * np.abs(weight * forward).sum()


@pytest.mark.parametrize("name", INTEGRATORS)
def test_frozen_functions(name):
    assert_frozen_is_unfrozen(mirrors.over_mirror(), mi.load_dict(INTEGRATORS[name]), "cube.vertex_positions")
