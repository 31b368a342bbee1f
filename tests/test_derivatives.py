"""Derivative images against finite differences: every case of `cases.py`, in terms of the reference's and their own standard errors."""

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rimlight.edge_sampling import FiniteDifferences, Motion, derivative_image


@pytest.fixture(autouse=True)
def forget_kernels(free_memory):
    yield
    dr.flush_kernel_cache()


def measure(case: cases.Case, seeds: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean derivative image over seeds, and its standard error."""
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    integrator = mi.load_dict({"type": "direct_edge", **case.integrator})
    n = seeds or case.seeds
    images = np.array([derivative_image(scene, integrator, motion, spp=case.spp, seed=i) for i in range(n)], np.float64)
    return images.mean(0), images.std(0, ddof=1) / np.sqrt(n)


def compare(mean: np.ndarray, error: np.ndarray, reference: FiniteDifferences) -> tuple[float, np.ndarray]:
    """Relative L1 error, and z-scores.

    A standard error from a few runs is itself uncertain, most of all where few runs saw anything: the variances of the 3 × 3 neighbours are
    pooled, and never trusted below a thousandth of the image's scale. What the step of the differences changes is an error of the reference, too.
    """
    scale = np.abs(reference.mean).max()
    variance = pool(error**2) + pool(reference.standard_error.astype(float) ** 2) + reference.step_error**2 + (1e-3 * scale) ** 2
    difference = mean - reference.mean
    return np.abs(difference).sum() / np.abs(reference.mean).sum(), difference / np.sqrt(variance)


def pool(variance: np.ndarray) -> np.ndarray:
    padded = np.pad(variance, ((1, 1), (1, 1), (0, 0)), mode="edge")
    neighbours = [padded[i : i + variance.shape[0], j : j + variance.shape[1]] for i in range(3) for j in range(3)]
    return np.maximum(np.mean(neighbours, axis=0), variance)


@pytest.mark.parametrize("case", cases.CASES, ids=lambda c: c.name)
def test_agrees_with_finite_differences(case, record_property):
    reference = FiniteDifferences.read(case.reference)
    relative, z = compare(*measure(case), reference)
    print(f"{case.name}: relative L1 {relative:.4f}, largest |z| {np.abs(z).max():.2f}")
    assert np.isfinite(z).all()
    assert relative <= case.tolerance
    assert np.abs(z).max() <= 4


def test_comparison_can_fail():
    """A derivative that is 5 % too large, or misses a term, is noticed."""
    case = cases.case("cube_depth")
    reference = FiniteDifferences.read(case.reference)
    relative, z = compare(1.05 * reference.mean, 0 * reference.standard_error, reference)
    assert relative > case.tolerance
    assert np.abs(z).max() > 4
