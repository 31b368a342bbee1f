"""How strong interreflections are is told from what is in shadow."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rimlight import ggx
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import alternation, in_shadow, output, simulation
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import Guess
from rimlight.inverse.photometric_stereo.evidence import Judge, Kind, left_out

ALBEDO = 0.7


def matte(**options) -> Dataset:
    given = {"shape": "folds", "size": 28, "lights": 16, "spread": 70, "spp": 64, "seed": 3, **options}
    bsdf = f"diffuse:{ALBEDO},{ALBEDO},{ALBEDO}"
    return simulation.simulate(simulation.Options(bsdf=bsdf, **given), progress=False)[0]


def synthetic(factor: float, ambiguous: float) -> tuple[Dataset, np.ndarray, np.ndarray]:
    """A set, interreflections, and what is in shadow: a third, of which the images have `factor` times these; but a
    part, `ambiguous`, is lit."""
    rng, mask = np.random.default_rng(0), np.ones((20, 20), bool)
    indirect = rng.uniform(0.01, 0.1, (400, 12, 1)).repeat(3, 2)
    hidden = rng.random((400, 12)) < 1 / 3
    lit = ~hidden | (rng.random(hidden.shape) < ambiguous)
    values = factor * indirect + lit[..., None] + 0.002 * rng.standard_normal((400, 12, 1))
    lights = simulation.spiral(12, 50)
    return Dataset(values.astype(np.float32), mask, lights, np.ones((12, 3))), indirect, hidden


@pytest.mark.parametrize("factor", [0.0, 0.3, 1.0, 1.4])
def test_the_factor_is_found(factor: float) -> None:
    """Ratios scatter by at most 0.2, so 1600 of them tell their median to 0.2 · 1.25 / 40, of which these are 4
    standard errors."""
    found = in_shadow.strength(*synthetic(factor, 0))
    assert found == pytest.approx(factor, abs=0.025)


def test_lit_values_hardly_change_it() -> None:
    """Of a wrong shape, some values are lit that should be in shadow."""
    assert in_shadow.strength(*synthetic(0.0, 0.3)) < 0.1
    assert in_shadow.strength(*synthetic(1.0, 0.9)) == in_shadow.LARGEST


def test_what_tells_nothing() -> None:
    data, indirect, hidden = synthetic(1.0, 0)
    assert np.isnan(in_shadow.strength(data, indirect, np.zeros_like(hidden)))
    assert np.isnan(in_shadow.strength(data, 1e-6 * indirect, hidden))
    # Lamps that did not light, and values that are cut off below a floor, are not dark for want of interreflections
    off = data.values.copy()
    off[:, :4] *= 1e-3
    assert in_shadow.strength(dataclasses.replace(data, values=off), indirect, hidden) == pytest.approx(1, abs=0.03)
    cut = np.where(data.values < 0.05, 0, data.values)
    assert in_shadow.strength(dataclasses.replace(data, values=cut), indirect, hidden) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize(("longest", "low", "high"), [(2, 0, 0.1), (6, 0.85, 1.15)])
def test_of_a_path_traced_set(longest: int, low: float, high: float) -> None:
    """With the true normals and colour. Those of a mesh with a vertex for each pixel are a few percent off."""
    data, lobes = matte(max_depth=longest), ggx.read_dictionary()[0]
    P, K, _ = data.values.shape
    options = ps.Options(brightness=0, max_depth=6)
    judge = Judge(data, lobes, left_out(data, 0), np.ones((P, K), np.float32), 0, "trimmed")
    work = alternation.Alternations(data, lobes, Kind(), judge, options, np.random.default_rng(0))
    weights = np.zeros((len(lobes), 3))
    weights[np.isnan(lobes.eta)] = ALBEDO
    guess = Guess(data.truth, np.ones(P), np.ones(K), weights)
    view = work.view(guess, work.integrate(guess))
    assert low <= view.strength <= high


def test_images_without_interreflections_are_not_given_any() -> None:
    """Of folds, these would make the result worse than the start."""
    data = matte(max_depth=2, noise=0.005)
    options = ps.Options(resolutions=(1.0,), iterations=(2,), brightness=0, materials="one", coat=False)
    found = ps.reconstruct(data, options, progress=False)
    assert found.strength < 0.2 or found.verdict == "start"
    assert found.error <= angles(found.start, data.truth).mean() + 0.05
    told = output.judgement(found)
    assert found.verdict == "start" or any("are multiplied by" in text for text in told)
