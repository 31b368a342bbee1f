"""Photometric stereo of metal: normals that are found without a diffuse start, and scales that lobes can explain."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rimlight import ggx
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import glossy, least_squares, simulation, start
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import DirectModel, Guess
from rimlight.inverse.photometric_stereo.vectors import spiral, unit

LIGHTS = spiral(40, 60)


@pytest.fixture(scope="module")
def metal() -> Dataset:
    options = simulation.Options(bsdf="silver-metallic-paint", size=24, lights=40, spp=16, max_depth=3)
    return simulation.simulate(options, progress=False)[0]


def shown(normals: np.ndarray, diffuse: float, gloss: float, alpha: float) -> np.ndarray:
    """Values, (P, K), of a lobe of the Fresnel factor `gloss` over a diffuse one, by the model of reconstructions."""
    eta = 1.5
    lobes = ggx.Lobes((np.nan, alpha), (np.nan, eta))
    data = Dataset(
        np.ones((len(normals), 40, 3), np.float32), np.ones((len(normals), 1), bool), LIGHTS, np.ones((40, 3))
    )
    factor = gloss / ((eta - 1) / (eta + 1)) ** 2
    weights = np.array([[diffuse], [factor]]) / max(diffuse + factor, 1) * np.ones(3)
    guess = Guess(normals, np.ones(len(normals)), np.ones(40), weights)
    return DirectModel(data, lobes).predicted(guess)[..., 0] * max(diffuse + factor, 1)


@pytest.mark.parametrize(
    ("diffuse", "gloss", "alpha"), [(0.02, 0.5, 0.2), (0.1, 0.3, 0.3), (0.5, 0.0, 0.2), (0.4, 0.04, 0.2)]
)
def test_normals_and_gloss(diffuse: float, gloss: float, alpha: float) -> None:
    """Normals that are tried are about 3 degrees apart. What trimmed least squares find of metal is far off."""
    normals = unit(spiral(60, 50) + np.array([0.03, -0.02, 0]))
    values = shown(normals, diffuse, gloss, alpha)
    found, weights = glossy.search(values, np.ones_like(values), LIGHTS)
    off, of_start = (angles(n, normals).mean() for n in (found, least_squares.normals(values, LIGHTS)))
    print(off, of_start, np.median(weights))
    assert off < 3 and (of_start > 3 * off or gloss < 0.1)
    assert np.median(weights) == pytest.approx(gloss, rel=0.35, abs=0.03)


def test_values_that_do_not_count_do_not() -> None:
    normals, rng = spiral(60, 50), np.random.default_rng(2)
    values = shown(normals, 0.05, 0.4, 0.2)
    counts = (rng.random(values.shape) > 0.2).astype(float)
    found, _ = glossy.search(np.where(counts > 0, values, 0), counts, LIGHTS)
    wrong, _ = glossy.search(np.where(counts > 0, values, 0), np.ones_like(counts), LIGHTS)
    print(angles(found, normals).mean(), angles(wrong, normals).mean())
    assert angles(found, normals).mean() < 3 and angles(wrong, normals).mean() > 4


def test_black_pixels_face_the_camera() -> None:
    """Or the values or the lights that count are none: nothing divides by 0."""
    values, counts = shown(spiral(4, 30), 0.1, 0.3, 0.2), np.ones((4, 40))
    values[1], counts[2] = 0, 0
    with np.errstate(all="raise"):
        found, weights = glossy.search(values, counts, LIGHTS)
    assert np.isfinite(found).all() and np.isfinite(weights).all()
    assert (found[1:3] == [0, 0, 1]).all() and (weights[1:3] == 0).all() and (weights[[0, 3]] > 0).all()


def test_metal_is_reconstructed(metal: Dataset) -> None:
    """Whatever its brightness is taken to be. Its start is kept if alternations begin from it only."""
    options = ps.Options(resolutions=(1.0,), iterations=(2,), materials="one", coat=False)
    found = ps.reconstruct(metal, options, progress=False)
    of_start = np.nanmean(metal.off(found.start))
    print(of_start, found.error, found.kind, found.left_out, found.halves)
    assert found.verdict == "judged" and found.error < 0.4 * of_start


def test_scale_of_metal(metal: Dataset) -> None:
    """Lobes with weights that sum to 1 explain the median pixel, but no more."""
    lobes, options = ggx.read_dictionary()[0], ps.Options()
    found = start.scale(metal, lobes, options)
    diffuse = start.scale(metal, ggx.Lobes((np.nan,), (np.nan,)), options)
    counts = least_squares.brightest(metal.luminance, options.dark)
    _, weights = glossy.search(found * metal.luminance, counts, metal.lights)
    eta = np.nanmax(lobes.eta)
    assert found < 0.5 * diffuse
    assert np.median(weights) == pytest.approx(((eta - 1) / (eta + 1)) ** 2, rel=1e-3)
    brighter = dataclasses.replace(metal, values=7 * metal.values)
    assert start.scale(brighter, lobes, options) == pytest.approx(found / 7, rel=1e-3)
