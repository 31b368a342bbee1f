"""z-scores of images, with standard errors that come from a few runs and are uncertain themselves."""

import numpy as np


def z_scores(
    mean: np.ndarray,
    error: np.ndarray,
    reference: np.ndarray,
    reference_error: np.ndarray,
    bias: np.ndarray | float = 0.0,
) -> np.ndarray:
    """(mean − reference) / standard error of the difference: (H, W, C).

    Where few runs saw anything, their spread says little: a pixel takes the mean variance of its 3 × 3 neighbours if
    that is larger, and nothing is trusted below a thousandth of the image's scale.

    bias : a known bound on the error of the reference that is not noise.
    """
    floor = max(1e-3 * np.abs(reference).max(), float(np.finfo(np.float32).tiny))  # an image may be black
    variance = _pooled(error**2) + _pooled(reference_error.astype(float) ** 2)
    return (mean - reference) / np.sqrt(variance + bias**2 + floor**2)


def mean_and_error(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the first axis, and its standard error."""
    return images.mean(0), images.std(0, ddof=1) / np.sqrt(len(images))


def _pooled(variance: np.ndarray) -> np.ndarray:
    height, width = variance.shape[:2]
    padded = np.pad(variance, ((1, 1), (1, 1), (0, 0)), mode="edge")
    neighbours = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
    return np.maximum(np.mean(neighbours, axis=0), variance)
