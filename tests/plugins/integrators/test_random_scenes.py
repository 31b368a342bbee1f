"""Derivatives of ordinary scenes that nobody chose, and the comparison that judges them.

`make test` looks at a few; `make test-full` at as many as `RIMLIGHT_SCENES` says, 300 by default.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
from random_scenes import STAGES, Comparison, compare, make, statistics

#: With lamps, textures, environment maps and lenses among them; each takes a few seconds.
FEW = (5, 30, 83, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (9, 17, 36, 44, 48)))
SEEDS = range(int(os.environ["RIMLIGHT_SCENES"])) if "RIMLIGHT_SCENES" in os.environ else FEW


@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", SEEDS)
def test_agrees_with_finite_differences(seed):
    row = compare(seed, STAGES if "RIMLIGHT_SCENES" in os.environ else STAGES[:2])
    print(row)
    assert row.agrees, str(row)


def test_a_seed_makes_the_same_scene():
    first, second = make(3), make(3, "multijitter")
    assert first.label == second.label
    for key, value in first.params.items():
        assert np.array_equal(np.array(value), np.array(second.params[key]))


def runs(truth, noise, count, seed, factor=1.0):
    return factor * truth + noise * np.random.default_rng(seed).normal(size=(count, *truth.shape))


@pytest.mark.parametrize("noise", [0.01, 0.3, 1.0])
def test_comparison_is_not_biased_by_noise(noise):
    """Noise of the reference does not make it look larger than it is."""
    truth = np.random.default_rng(0).normal(size=(20, 20, 3)) * (np.arange(20) < 5)[:, None]
    scales = []
    for k in range(20):
        row = Comparison(0, "")
        statistics(runs(truth, noise, 24, 2 * k), runs(truth, noise, 24, 2 * k + 1), row)
        assert row.agrees
        scales.append((row.scale, row.error))
    scale, error = np.array(scales).T
    assert abs(scale.mean() - 1) < 4 * error.mean() / np.sqrt(20)
    assert 0.4 * error.mean() < scale.std() < 2.5 * error.mean()


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_comparison_notices_a_factor(factor):
    truth = np.random.default_rng(0).normal(size=(20, 20, 3))
    row = Comparison(0, "")
    statistics(runs(truth, 0.1, 10, 1), runs(truth, 0.1, 6, 2, factor), row)
    assert not row.agrees


def test_comparison_knows_of_errors_that_all_runs_share():
    truth = np.random.default_rng(0).normal(size=(20, 20, 3)) * (np.arange(20) < 5)[:, None]
    for off, agrees in ((0.05, True), (0.3, False)):
        row = Comparison(0, "")
        statistics(runs(truth, 0.01, 10, 1) + off, runs(truth, 0.01, 6, 2), row, rounding=np.float64(0.05))
        assert row.agrees == agrees


def test_comparison_notices_what_is_missing():
    """A term that is absent where the reference is small does not show in the projection."""
    truth = np.random.default_rng(0).normal(size=(20, 20, 3)) * np.where(np.arange(20) < 10, 1.0, 0.1)[:, None]
    wrong = truth * (np.arange(20) < 10)[:, None]
    row = Comparison(0, "")
    statistics(runs(truth, 0.01, 10, 1), runs(wrong, 0.01, 6, 2), row)
    assert not row.agrees


def test_comparison_notices_what_is_not_finite():
    truth = np.ones((4, 4, 3))
    wrong = runs(truth, 0.1, 6, 2)
    wrong[3, 2, 1, 0] = np.nan
    row = Comparison(0, "")
    statistics(runs(truth, 0.1, 10, 1), wrong, row)
    assert not row.finite and not row.agrees
