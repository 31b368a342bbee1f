"""Normals of diffuse surfaces: least squares (Woodham 1980), and how to keep shadows and highlights out of them.

All for lights at infinity, or directions of the lights at each pixel: `lights` is (K, 3) or (P, K, 3), `values` (P, K).
"""

from __future__ import annotations

import numpy as np

from .dataset import unit

#: Iterations of reweighted least squares, and the part of a pixel's mean size below which residuals count as small.
ITERATIONS, SMALL = 30, 1e-3


def least_squares(values: np.ndarray, lights: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Albedo times normal of each pixel, (P, 3): weighted least squares of `lights @ b = values`.

    weights : (P, K), default 1. Pixels whose weights leave fewer than three lights get the solution of least length.
    """
    w = np.ones_like(values) if weights is None else weights
    wide = "ki,kj" if lights.ndim == 2 else "pki,pkj"
    M = np.einsum(f"pk,{wide}->pij", w, lights, lights, optimize=True)
    b = np.einsum(f"pk,{wide[: wide.index(',')]}->pi", w * values, lights, optimize=True)
    return (np.linalg.pinv(M, rcond=1e-9, hermitian=True) @ b[..., None])[..., 0]


def ranks(values: np.ndarray) -> np.ndarray:
    """Of the values of each pixel, from 0, the darkest, to 1: (P, K)."""
    return np.argsort(np.argsort(values, axis=1), axis=1) / (values.shape[1] - 1)


def trimmed(values: np.ndarray, lights: np.ndarray, low: float = 0.2, high: float = 0.8) -> np.ndarray:
    """Least squares without the darkest and the brightest values of each pixel: (P, 3)."""
    rank = ranks(values)
    return least_squares(values, lights, ((rank >= low) & (rank <= high)).astype(values.dtype))


def reweighted(values: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Least sums of absolute residuals, by iteratively reweighted least squares: (P, 3)."""
    floor = SMALL * np.abs(values).mean(1, keepdims=True) + np.finfo(np.float32).tiny
    b = least_squares(values, lights)
    for _ in range(ITERATIONS):
        b = least_squares(values, lights, 1 / np.maximum(np.abs(predicted(b, lights) - values), floor))
    return b


def predicted(b: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Values of albedo times normal, (P, 3), without shadows: (P, K)."""
    return b @ lights.T if lights.ndim == 2 else np.einsum("pi,pki->pk", b, lights)


METHODS = {"least squares": least_squares, "trimmed": trimmed, "reweighted": reweighted}


def normals(values: np.ndarray, lights: np.ndarray, method: str = "trimmed") -> np.ndarray:
    """Unit normals, (P, 3), by one of `METHODS`. Those that would face away from the camera are turned to its side.

    Raises
    ------
    ValueError : there is no such method.
    """
    if method not in METHODS:
        raise ValueError(f'ps: unknown method "{method}", expected one of {", ".join(METHODS)}')
    n = unit(METHODS[method](values.astype(np.float64), lights))
    return np.where(n[:, 2:] < 0, n * [1, 1, -1], n)
