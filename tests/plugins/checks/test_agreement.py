"""The comparison of a derivative with its reference: it can fail, and does not when it should not."""

from __future__ import annotations

import numpy as np
import pytest

from rimlight.checks import Agreement, FiniteDifferences, compare

RUNS = 16


def truth(seed: int = 0) -> np.ndarray:
    """A derivative that is large in one half of the image, and small in the other."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(32, 32, 3)) * np.where(np.arange(32) < 16, 1, 0.1)[:, None]


def runs(mean: np.ndarray, noise: float, seed: int) -> np.ndarray:
    return mean + noise * np.random.default_rng(1000 + seed).normal(size=(RUNS, *mean.shape))


def reference(mean: np.ndarray, noise: float, seed: int) -> FiniteDifferences:
    found = runs(mean, noise, seed)
    return FiniteDifferences(found.mean(0), found.std(0, ddof=1) / np.sqrt(RUNS), 0 * mean, {})


def agreement(g: np.ndarray, noise: float = 0.1, seed: int = 0, **options) -> Agreement:
    return compare(runs(g, noise, 2 * seed + 1), reference(truth(), 0.1, 2 * seed), **options)


@pytest.mark.parametrize("noise", [0.01, 0.1, 1, 10])
def test_noise_alone_passes(noise):
    found = [agreement(truth(), noise, seed) for seed in range(20)]
    assert not any(a.faults() for a in found)
    scales, errors = np.array([(a.scale, a.scale_error) for a in found]).T
    assert abs(scales.mean() - 1) < 4 * errors.mean() / np.sqrt(20)
    assert 0.4 * errors.mean() < scales.std() < 1.5 * errors.mean()


def test_few_pixels_pass():
    """Of which the means vary more."""
    mean = np.zeros((16, 16, 3))
    mean[3, 4:7] = [1, 2, 3]
    noise = 0.1 * (mean != 0)
    found = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        images = mean + noise * rng.normal(size=(RUNS, 16, 16, 1))  # channels share their noise
        exact = FiniteDifferences(mean, 0 * mean, 0 * mean, {})
        found.append(compare(images, exact))
    assert sum(bool(a.faults()) for a in found) <= 1
    assert compare(1.2 * images, exact).faults()


def test_a_noisy_reference_does_not_look_larger():
    found = [compare(runs(truth(), 0.01, 1 + seed), reference(truth(), 3, 100 + seed)) for seed in range(20)]
    scales, errors = np.array([(a.scale, a.scale_error) for a in found]).T
    assert abs(scales.mean() - 1) < 4 * errors.mean() / np.sqrt(20)


def test_channels_that_share_their_noise_do_not_count_as_independent():
    """As in every render of the reference: the standard error of the scale is that of the scales."""
    mean = np.abs(truth().mean(2, keepdims=True)) * np.array([1.0, 0.9, 0.8])
    scales, errors = [], []
    for seed in range(200):
        noise = np.random.default_rng(seed).normal(size=(2, RUNS, 32, 32, 1))
        differences = mean + 0.3 * noise[0]
        r = FiniteDifferences(differences.mean(0), differences.std(0, ddof=1) / np.sqrt(RUNS), 0 * mean, {})
        found = compare(mean + 0.01 * noise[1], r)
        scales.append(found.scale)
        errors.append(found.scale_error)
    assert np.std(scales, ddof=1) == pytest.approx(np.mean(errors), rel=0.2)


@pytest.mark.parametrize("factor", [0.98, 1.02, 0.0, -1.0])
def test_a_factor_shows(factor):
    assert "scale" in agreement(factor * truth()).faults()[0]


def test_what_is_missing_where_the_derivative_is_small_shows():
    g = truth()
    g[8:24, 18:30] = 0
    found = agreement(g, 0.01)
    assert abs(found.scale - 1) < 0.005
    assert any("4 × 4 pixels" in fault for fault in found.faults())


def test_one_wrong_pixel_shows():
    g = truth()
    g[3, 4, 1] += 1
    assert any("a pixel" in fault for fault in agreement(g).faults())


def test_a_small_error_everywhere_shows():
    """Of alternating sign, so that neither the projection nor the sums see it."""
    g = truth() + 0.1 * (-1.0) ** np.add.outer(np.arange(32), np.arange(32))[..., None]
    assert any("z²" in fault for fault in agreement(g).faults())


def test_noise_has_an_upper_limit():
    found = agreement(truth(), 1.0)
    assert not found.faults(noise=1.5 * found.own_noise)
    assert "noise" in found.faults(noise=0.5 * found.own_noise)[0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_fails(value):
    found = runs(truth(), 0.1, 1)
    found[3, 2, 1, 0] = value
    assert compare(found, reference(truth(), 0.1, 0)).faults() == ["it is not finite"]


def test_reference_that_is_not_finite():
    """Not even to be compared with: whatever is compared with NaN is false."""
    wrong = reference(truth(), 0.1, 0)
    wrong.mean[3, 2, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        compare(runs(truth(), 0.1, 1), wrong)


def test_zero():
    nothing = np.zeros((8, 8, 3))
    zero = FiniteDifferences(nothing, nothing, nothing, {})
    assert not compare(np.zeros((2, 8, 8, 3)), zero).faults()
    assert compare(np.ones((2, 8, 8, 3)), zero).faults()


def test_shapes():
    with pytest.raises(ValueError, match=r"at least two runs of shape \(32, 32, 3\), got 1"):
        compare(truth()[None], reference(truth(), 0.1, 0))
    with pytest.raises(ValueError, match="compare"):
        compare(np.zeros((4, 2, 2, 3)), reference(truth(), 0.1, 0))
