"""Random sets of photometric stereo: each fault does what it says, and results are no worse than their start."""

from __future__ import annotations

import numpy as np
import pytest
import random_photometric

from rimlight import ggx
from rimlight.inverse.photometric_stereo import simulation, start
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles


@pytest.fixture(scope="module")
def data() -> Dataset:
    options = simulation.Options(size=24, lights=12, spp=4, max_depth=2)
    return simulation.simulate(options, progress=False)[0]


@pytest.mark.parametrize("name, fault", [(name, fault) for name, _, fault in random_photometric.FAULTS])
def test_faults(data: Dataset, name: str, fault) -> None:
    """They change the set, by something and not by all, and are the same for a seed."""
    found, again = (fault(data, np.random.default_rng(6)) for _ in range(2))
    np.testing.assert_array_equal(found.values, again.values)
    assert (found.values.shape, found.mask.sum()) == (again.values.shape, len(found.values))
    if "lights" in name:
        off = angles(found.lights, data.lights)
        assert 0 < off.max() < 90 and off.mean() < 10
        np.testing.assert_array_equal(found.values, data.values)
    elif name == "border":
        inside = np.linalg.norm(found.truth, axis=1) > 0.5
        np.testing.assert_array_equal(found.values[inside], data.values)
        assert 0 < (~inside).sum() < inside.sum()
    elif name == "holes":
        assert 0.5 * len(data.values) < len(found.values) < len(data.values)
    else:
        change = np.abs(found.values - data.values).mean() / data.values.mean()
        assert 1e-4 < change < 0.7


def test_a_seed_is_a_set() -> None:
    (first, options, row), (again, _, _), (plain, _, without) = (
        random_photometric.make(4001, left) for left in ("", "", "all")
    )
    np.testing.assert_allclose(first.values, again.values, rtol=1e-5)  # sums of samples have no fixed order
    assert options.start in row.label and row.pixels == len(first.values) and not without.faults
    assert len(plain.lights) == len(first.lights)


@pytest.mark.parametrize("seed", [2001, 2005, 2010])
def test_no_set_ends_worse_than_it_starts(seed: int) -> None:
    row = random_photometric.run(seed)
    assert row.holds, str(row)


@pytest.mark.parametrize("seed", [8287, 8408])
def test_starts_of_clipped_images_ask_lights(seed: int) -> None:
    """Of which pixels all predict a few lights better with least squares, but not the lights on the whole: these sets,
    of which less than 2 % of the values are clipped, keep the method that is given, which is better."""
    data, options, _ = random_photometric.make(seed)
    counts, lobes = start.counts(data, data, 1.0, options.dark), ggx.Lobes((np.nan,), (np.nan,))
    given = options.start, None
    error = lambda of: angles(start.guess(data, lobes, counts, options, of).normals, data.truth).mean()
    assert 0 < data.clipped.mean() < 0.02 and start.method(data, data, 1.0, options) == given
    assert error(given) < 0.8 * error(("least squares", ~data.clipped))
