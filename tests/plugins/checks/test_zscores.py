"""The statistics of the other tests can fail, and do not when they should not."""

import numpy as np
import pytest

from rimlight.checks import mean_and_error, z_scores


@pytest.fixture
def runs():
    rng = np.random.default_rng(0)
    truth = rng.uniform(1, 2, (32, 32, 3))
    return truth, truth + 0.1 * rng.normal(size=(16, 32, 32, 3))


def test_noise_alone_passes(runs):
    truth, images = runs
    z = z_scores(*mean_and_error(images), truth, 0 * truth)
    assert np.abs(z).max() < 5
    assert 0.7 < np.mean(z**2) < 1.1


def test_a_bias_of_two_standard_errors_everywhere_shows(runs):
    truth, images = runs
    mean, error = mean_and_error(images)
    assert np.mean(z_scores(mean + 2 * error, error, truth, 0 * truth) ** 2) > 3


def test_one_wrong_pixel_shows(runs):
    truth, images = runs
    images[:, 3, 4] += 0.3
    assert np.abs(z_scores(*mean_and_error(images), truth, 0 * truth))[3, 4].min() > 5


def test_a_known_bias_is_forgiven(runs):
    truth, images = runs
    images[:, 3, 4] += 0.3
    bias = np.zeros_like(truth)
    bias[3, 4] = 0.3
    assert np.abs(z_scores(*mean_and_error(images), truth, 0 * truth, bias)).max() < 5
