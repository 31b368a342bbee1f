"""Photometric stereo: least squares, of diffuse surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from rimlight.inverse.photometric_stereo import least_squares
from rimlight.inverse.photometric_stereo.dataset import angles
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit


@pytest.mark.parametrize(("name", "degrees"), [("ball", 4.10), ("bear", 8.39)])
def test_published_errors_of_least_squares(diligent, name: str, degrees: float) -> None:
    """Shi et al. 2019, table 3, whose values are cut at 1."""
    data = diligent(name)
    found = least_squares.normals(np.clip(data.luminance, 0, 1), data.lights, "least squares")
    assert angles(found, data.truth).mean() == pytest.approx(degrees, abs=0.01)


def lambertian(P: int = 200, K: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """values : (P, K), all lit. lights : (K, 3). normals, (P, 3), and albedos, (P,)."""
    rng = np.random.default_rng(0)
    lights = spiral(K, 40)
    normals = unit(np.c_[rng.uniform(-0.5, 0.5, (P, 2)), np.ones(P)])
    albedo = rng.uniform(0.2, 0.9, P)
    values = albedo[:, None] * (normals @ lights.T)
    assert values.min() > 0
    return values, lights, normals, albedo


@pytest.mark.parametrize("each", [False, True], ids=["one direction", "a direction for each pixel"])
@pytest.mark.parametrize("method", least_squares.METHODS)
def test_diffuse_surfaces_are_exact(method: str, each: bool) -> None:
    values, lights, normals, albedo = lambertian()
    if each:
        lights = unit(lights + np.random.default_rng(1).normal(0, 0.05, (len(values), 1, 3)))
        values = albedo[:, None] * np.einsum("pi,pki->pk", normals, lights)
    assert angles(least_squares.normals(values, lights, method), normals).max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(least_squares.METHODS[method](values, lights), axis=1), albedo, rtol=1e-6)


def test_highlights_and_shadows() -> None:
    """A fifth of the values has no light, and a fifth too much: only least squares suffer."""
    values, lights, normals, _ = lambertian()
    rank = np.argsort(np.argsort(np.random.default_rng(2).random(values.shape), axis=1), axis=1)
    wrong = np.where(rank < 4, 0, np.where(rank >= 20, values + 1.5, values))
    error = {
        method: angles(least_squares.normals(wrong, lights, method), normals).mean() for method in least_squares.METHODS
    }
    assert error["least squares"] > 5
    assert error["trimmed"] < 1e-4
    assert error["reweighted"] < 0.2


def test_weights_of_least_squares() -> None:
    """Values without weight do not count; with too few others, the solution is finite."""
    values, lights, normals, albedo = lambertian(8)
    weights = np.ones_like(values)
    weights[:, :3] = 0
    wrong = values.copy()
    wrong[:, :3] = 7
    np.testing.assert_allclose(
        least_squares.least_squares(wrong, lights, weights), albedo[:, None] * normals, atol=1e-9
    )
    weights[:, 2:] = 0
    assert np.isfinite(least_squares.least_squares(wrong, lights, weights)).all()


def test_normals_face_the_camera() -> None:
    values, lights, _, _ = lambertian()
    assert (least_squares.normals(-values, lights, "least squares")[:, 2] > 0).all()
    with pytest.raises(ValueError, match='ps: unknown method "robust", expected one of least squares, trimmed'):
        least_squares.normals(values, lights, "robust")
