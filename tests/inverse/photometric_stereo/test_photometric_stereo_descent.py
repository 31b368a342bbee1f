"""Photometric stereo: descent along derivatives of path-traced images."""

from __future__ import annotations

import dataclasses
from copy import deepcopy

import numpy as np
import pytest
from photometric import LAMBERT, UP, bowl, height_field

from rimlight.inverse.photometric_stereo import refinement
from rimlight.inverse.photometric_stereo.dataset import angles
from rimlight.inverse.photometric_stereo.descent import ExponentiatedGradient, NormalAdam
from rimlight.inverse.photometric_stereo.direct import simplex_least_squares
from rimlight.inverse.photometric_stereo.rendering import Rendering
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit


def test_steps_of_normals() -> None:
    """The first goes along the gradient in the tangent plane, by the rate, however long gradients are."""
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(50, 3)))
    gradient = rng.normal(size=(50, 3)) * 10.0 ** rng.uniform(-6, 6, (50, 1))
    gradient[8] = 0
    found = NormalAdam(50, 0.01).step(normals, gradient)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(found[8], normals[8], atol=1e-15)
    others = np.arange(50) != 8
    g, n = gradient[others], normals[others]
    tangential = unit(g - n * (g * n).sum(1, keepdims=True))
    np.testing.assert_allclose(found[others], unit(n - 0.01 * tangential), atol=1e-9)
    half = NormalAdam(50, 0.01).step(normals, gradient, factor=0.5)
    np.testing.assert_allclose(angles(half, normals)[others], np.degrees(np.arctan(0.005)), rtol=1e-6)


def test_normals_converge() -> None:
    """To those that least squares would find, for gradients of very different sizes and with noise."""
    rng = np.random.default_rng(0)
    truth, normals = unit(rng.normal(size=(50, 3)) + 3 * UP), unit(rng.normal(size=(50, 3)) + 3 * UP)
    size = 10.0 ** rng.uniform(-3, 3, (50, 1))
    adam = NormalAdam(50, 0.1)
    for i in range(300):
        noise = 0.1 * rng.normal(size=(50, 3))
        normals = adam.step(normals, size * (normals - truth + noise), factor=0.98**i)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    assert angles(normals, truth).max() < 2


def test_steps_of_weights() -> None:
    """The logarithms of weights fall by what their gradients exceed the mean by, the black lobe's being 0; at most by
    the rate, however large gradients are. Colours have steps of their own."""
    weights = np.array([[0.5, 0.1], [0.2, 0.3], [0, 0.2]])
    gradient = np.array([[3.0, 1e-6], [1.0, -2e-6], [0, 3e-6]])
    found = ExponentiatedGradient(2, 0.1).step(weights, gradient)
    all_w, all_g = np.r_[weights, 1 - weights.sum(0)[None]], np.r_[gradient, np.zeros((1, 2))]
    above = all_g - (all_w * all_g).sum(0)
    expected = all_w * np.exp(-0.1 * above / np.abs(above).max(0))
    np.testing.assert_allclose(found, (expected / expected.sum(0))[:-1], rtol=1e-12)
    half = ExponentiatedGradient(2, 0.1).step(weights, 7 * gradient, factor=0.5)
    expected = all_w * np.exp(-0.05 * above / np.abs(above).max(0))
    np.testing.assert_allclose(half, (expected / expected.sum(0))[:-1], rtol=1e-12)


def test_weights_converge_on_the_simplex() -> None:
    """To the least of a quadratic, given by `simplex_least_squares`, on its faces and inside."""
    rng = np.random.default_rng(0)
    A = rng.uniform(0, 1, (60, 6))
    truths = np.array([[0.2, 0.3, 0, 0, 0.1, 0.1], [0.9, 0.5, 0, 0.2, 0, 0], [0, 0, 0.6, 0, 0, 0.4]]).T
    gram, moments = A.T @ A, A.T @ A @ truths
    best = np.stack([simplex_least_squares(gram, m) for m in moments.T], 1)
    assert best[:, 0].sum() < 0.75 and best[:, 1].sum() > 1 - 1e-6
    descent, weights = ExponentiatedGradient(3, 0.5), np.full((6, 3), 1 / 7)
    weights[2, 0] = 0
    for i in range(2000):
        weights = descent.step(weights, gram @ weights - moments, factor=0.998**i)
        assert weights.min() >= 0 and weights.sum(0).max() <= 1 + 1e-12 and weights[2, 0] == 0
    loss = lambda x: np.einsum("ic,ij,jc->c", x - truths, gram, x - truths)
    assert (loss(weights) < loss(best) + 1e-4 * loss(np.zeros((6, 3)))).all()
    np.testing.assert_allclose(weights, best, atol=0.01)


def test_descent_refuses_what_it_cannot() -> None:
    with pytest.raises(ValueError, match='"spp" of the descent must be at least 1'):
        refinement.Descent(spp=0)
    with pytest.raises(ValueError, match="other options 0"):
        refinement.Descent(rate=float("nan"))
    scene = bowl(K=4, spread=30)
    camera = np.array([[400.0, 0, 12], [0, 400, 12], [0, 0, 1]])
    with pytest.raises(ValueError, match="pixels are not square"):
        Rendering(dataclasses.replace(scene.data, camera=camera * [[1], [1.2], [1]]), scene.rendering.lobes)


@pytest.mark.parametrize("focal", [0, 400], ids=["orthographic", "perspective"])
def test_heights_of_steps_follow_from_their_shadows(focal: int) -> None:
    """Normals do not tell them. A plateau, in depth; with a camera, from far away."""
    N, true, start = 24, 6.0, 3.0
    lights = unit(spiral(6, 45) + np.array([0.3, 0, 0]))
    flat = lambda x, y: (0 * x, 0.0, 0.0)
    scene = height_field(LAMBERT, np.full((1, 3), 0.5), lights, flat, N=N, mask=np.ones((N, N), bool))
    camera = np.array([[focal, 0, 11.5], [0, focal, 11.5], [0, 0, 1.0]]) if focal else None
    data = dataclasses.replace(scene.data, camera=camera, distance=focal or None)
    rendering = Rendering(data, LAMBERT, max_depth=2)
    v, u = np.nonzero(rendering.domain.wide)
    high = (np.abs(u - 12.5) < 5) & (np.abs(v - 12.5) < 5)
    raised = lambda height: focal * np.exp(-height * high / focal) if focal else height * high
    height = lambda d: (-1 if focal else 1) * (d[high].mean() - d[~high].mean())
    rendering.update(scene.guess, raised(true))
    data = dataclasses.replace(data, values=rendering.image(spp=64, seed=1))
    options = refinement.Descent(steps=25, spp=4, rate=0, bsdf_rate=0, depth_rate=0.3, integrability=0)
    counts = np.ones(data.values.shape[:2], np.float32)
    found: list[float] = []
    refinement.descend(
        rendering, data, deepcopy(scene.guess), raised(start), counts, options, np.random.default_rng(0),
        after=lambda depth, _: found.append(height(depth)),
    )  # fmt: skip
    print(np.round(found, 2))
    assert found[0] < 4 and found[-1] == pytest.approx(true, abs=0.5)


def test_derivatives_that_are_not_finite_are_reported(monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    scene = bowl(K=4, spread=30)
    gradient = Rendering.gradient

    def broken(*args, **options):
        found = gradient(*args, **options)
        found["normals"][3, 1] = np.nan
        return found

    monkeypatch.setattr(Rendering, "gradient", broken)
    guess, counts = deepcopy(scene.guess), np.ones(scene.data.values.shape[:2])
    options = refinement.Descent(steps=2, spp=1)
    refinement.descend(scene.rendering, scene.data, guess, scene.depth, counts, options, np.random.default_rng(0))
    assert "step 1: 1 numbers of the derivative are not finite" in caplog.text
    assert np.isfinite(guess.normals).all()
