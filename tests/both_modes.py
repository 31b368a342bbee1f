"""Gradients of backward mode are derivatives of forward mode, weighted."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.checks import Motion, derivative_image


def assert_backward_is_forward(scene: mi.Scene, made: mi.Integrator, motion: Motion) -> None:
    """With the same random numbers."""
    forward = np.array(derivative_image(scene, made, motion, spp=16, seed=3), float)
    weight = np.random.default_rng(0).uniform(0.5, 1, forward.shape)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.apply(θ)
    made.render_backward(scene, motion.params, mi.TensorXf(weight.astype(np.float32)), seed=3, spp=16)
    dr.enqueue(dr.ADMode.Backward, θ)
    dr.traverse(dr.ADMode.Backward)
    size = np.abs(weight * forward).sum()
    assert size > 0 and abs(dr.grad(θ)[0] - (weight * forward).sum()) < 1e-3 * size
