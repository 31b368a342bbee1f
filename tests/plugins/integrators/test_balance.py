"""Samples divided among the terms: other numbers, the same derivative."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from frozen import first_cause

import rimlight
from rimlight.checks import FiniteDifferences, Motion, compare, derivative_image
from rimlight.integrators._balance import LEAST, balanced

#: The largest noise of a derivative, relative to its L1 norm.
NOISE = 0.1


def noisy(sizes: dict[str, float]) -> dict[str, np.ndarray]:
    """Images of terms, around 1, with noise of these sizes."""
    random = np.random.default_rng(0)
    return {name: 1 + size * random.normal(size=(4, 16, 16, 3)) for name, size in sizes.items()}


def blocker() -> tuple[mi.Scene, Motion]:
    case = cases.case("shadow_blocker")
    scene = case.scene()
    return scene, Motion(scene, **case.motion)


def attach(motion: Motion) -> None:
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    dr.forward(theta, dr.ADFlag.ClearEdges)


def test_shares_follow_noise_and_cost():
    """Twice the noise: twice the samples. Four times the cost: half of them. All together cost what they did."""
    found = balanced(noisy({"a": 0.2, "b": 0.1, "c": 0.1}), {"a": 1, "b": 1, "c": 4}, set())
    assert found.shares["a"] / found.shares["b"] == pytest.approx(2, rel=0.1)
    assert found.shares["b"] / found.shares["c"] == pytest.approx(2, rel=0.1)
    assert sum(found.shares[k] * found.cost[k] for k in "abc") == pytest.approx(1)
    # Of variances .04, .01, .01 and costs 1, 1, 4: (Σ σ √c)² against Σ σ² Σ c.
    assert found.gain == pytest.approx(0.06 * 6 / 0.5**2, rel=0.1)
    assert "samples x" in str(found)


def test_shares_have_limits():
    """What shows no noise keeps some samples; what a number was given for, all; what costs nothing is not there."""
    found = balanced(noisy({"a": 0.2, "b": 0, "c": 0.1, "d": 0}), {"a": 1, "b": 1, "c": 1, "d": 0}, {"c"})
    assert found.shares["b"] == LEAST
    assert found.shares["c"] == 1
    assert "d" not in found.shares
    assert found.shares["a"] == pytest.approx(2 - LEAST)


def test_nothing_is_noisy():
    assert balanced({"a": np.zeros((4, 2, 2, 3))}, {"a": 1}, set()).shares == {"a": 1}


@pytest.mark.parametrize(
    ("name", "shares"),
    [
        ("shadow_blocker", None),
        ("open_air", {"interior": 2.6, "film boundary": 0.3, "shadows from lights": 0.5, "edges from points": 1.4}),
        ("cube_depth", {"interior": 0.2, "film boundary": 2.0}),
    ],
)
def test_derivatives_stay_the_same(name, shares):
    """shares : None: as they are measured."""
    case = cases.case(name)
    scene, integrator = case.scene(), mi.load_dict(case.integrator)
    motion = Motion(scene, **case.motion)
    if shares is None:
        attach(motion)
        found = integrator.balance(scene, motion.params, spp=8)
        shares = found.shares
        assert found.gain > 1.05
        assert integrator.shares == shares
        assert max(shares.values()) > 1.2
    integrator.shares = shares
    images = [derivative_image(scene, integrator, motion, spp=case.spp, seed=i) for i in range(case.runs)]
    agreement = compare(np.array(images, np.float64), FiniteDifferences.read(case.reference))
    print(agreement)
    assert not agreement.faults(noise=NOISE)
    # And backward.
    forward = np.array(images[0], np.float64)
    key = case.motion["key"]
    dr.enable_grad(motion.params[key])
    motion.params.update()
    integrator.render_backward(scene, motion.params, dr.ones(mi.TensorXf, forward.shape), seed=0, spp=case.spp)
    gradient = np.array(dr.grad(motion.params[key]), np.float64).reshape(-1, 3)
    assert (gradient * case.motion["direction"]).sum() == pytest.approx(forward.sum(), rel=1e-2)


def test_plans_tell_the_samples():
    scene, motion = blocker()
    integrator = mi.load_dict({"type": "direct_edge"})
    integrator.shares = {"interior": 2, "shadows from lights": 0.26}
    attach(motion)
    plan = rimlight.plan(scene, motion.params, integrator=integrator, spp=8)
    pixels = cases.RES**2
    assert plan.term("interior").samples == 16 * pixels
    assert plan.term("shadows from lights").samples == 2 * pixels
    assert (
        rimlight.plan(scene, motion.params, integrator=integrator, spp=1).term("shadows from lights").samples == pixels
    )


def test_given_numbers_stay():
    scene, motion = blocker()
    integrator = mi.load_dict({"type": "direct_edge", "sppi": 4})
    attach(motion)
    found = integrator.balance(scene, motion.params, spp=4)
    assert found.shares["shadows from lights"] == 1


def test_what_cannot_be_measured_is_refused():
    scene, motion = blocker()
    integrator = mi.load_dict({"type": "direct_edge"})
    with pytest.raises(RuntimeError, match="none of the parameters carries a gradient"):
        integrator.balance(scene, motion.params)
    dr.enable_grad(motion.params["blocker.vertex_positions"])  # but along no motion
    motion.params.update()
    with pytest.raises(RuntimeError, match="measured are zero"):
        integrator.balance(scene, motion.params, spp=1)
    assert integrator.shares == {}
    attach(motion)
    for kind in ("rig", "aov_edge"):
        other = mi.load_dict({"type": kind, **({"aovs": "dd:depth"} if kind == "aov_edge" else {})})
        with pytest.raises(RuntimeError, match="direct_edge or prb_edge"):
            other.balance(scene, motion.params)


def test_a_frozen_function_cannot_measure():
    scene, motion = blocker()
    integrator = mi.load_dict({"type": "direct_edge"})
    attach(motion)

    @dr.freeze
    def measure(x):
        integrator.balance(scene, motion.params)
        return x

    with pytest.raises(RuntimeError) as error:
        measure(mi.Float([1, 2]))
    assert "call `balance` before it" in first_cause(error.value)
