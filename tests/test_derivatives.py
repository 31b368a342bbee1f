"""Derivative images against finite differences: every case of `cases.py`, in terms of the reference's and their own
standard errors."""

import cases
import mitsuba as mi
import numpy as np
import pytest

from rimlight.edge_sampling import FiniteDifferences, Motion, derivative_image, mean_and_error, z_scores


def measure(case: cases.Case) -> tuple[np.ndarray, np.ndarray]:
    """Mean derivative image over seeds, and its standard error."""
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    integrator = mi.load_dict(case.integrator)
    return mean_and_error(
        np.array(
            [derivative_image(scene, integrator, motion, spp=case.spp, seed=i) for i in range(case.seeds)], np.float64
        )
    )


def compare(mean: np.ndarray, error: np.ndarray, reference: FiniteDifferences) -> tuple[float, np.ndarray]:
    """Relative L1 error, and z-scores."""
    relative = np.abs(mean - reference.mean).sum() / np.abs(reference.mean).sum()
    return relative, z_scores(mean, error, reference.mean, reference.standard_error, reference.step_error)


@pytest.mark.parametrize("case", cases.CASES, ids=lambda c: c.name)
def test_agrees_with_finite_differences(case):
    if case.needs and not case.needs.exists():
        pytest.skip(f"needs {case.needs}")
    reference = FiniteDifferences.read(case.reference)
    mean, error = measure(case)
    relative, z = compare(mean, error, reference)
    # The mean of |x| is √(2/π) standard deviations.
    noise = np.sqrt(2 / np.pi) * np.hypot(error, reference.standard_error).sum() / np.abs(reference.mean).sum()
    print(f"{case.name}: relative L1 {relative:.4f}, of noise {noise:.4f}, largest |z| {np.abs(z).max():.2f}")
    assert np.isfinite(z).all()
    assert relative <= (max(case.tolerance, 1.5 * noise) if case.noisy else case.tolerance)
    assert np.abs(z).max() <= case.largest_z


def test_comparison_can_fail():
    """A derivative that is 5 % too large is noticed."""
    case = cases.case("cube_depth")
    reference = FiniteDifferences.read(case.reference)
    relative, z = compare(1.05 * reference.mean, 0 * reference.standard_error, reference)
    assert relative > case.tolerance
    assert np.abs(z).max() > 4
