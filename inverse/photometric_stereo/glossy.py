"""Normals of glossy surfaces, metal above all, without a diffuse start: what explains the values of a pixel best.

Of metal, highlights are a hundred times as bright as all else, and least squares are 20 degrees off. From there, no
alternation finds the right normals. But a pixel has few unknowns: a normal, the width of one lobe, and how strong this
and a diffuse one are. How strong follows from the values, and so a thousand normals can all be tried.
"""

from __future__ import annotations

import numpy as np

from .vectors import spiral, unit

#: Roughness of the lobes (alpha of GGX), and normals that are tried, with their largest angle to the camera, degrees.
ALPHAS, NORMALS, SPREAD = (0.04, 0.08, 0.13, 0.2, 0.3, 0.45), 1000, 82.0

#: Squares of residuals are divided by the value and this part of the mean of the pixel: highlights are not all.
DARK = 0.1

#: Pixels that are treated at a time, for memory.
BLOCK = 500


def search(values: np.ndarray, counts: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals, (P, 3), a few degrees off those that explain the values best; and the weights of the glossy lobes
    with them, (P,), of a Fresnel factor of 1. Pixels that are black face the camera.

    values, counts : (P, K), and how much they count. lights : (K, 3), directions. The camera is towards +z.
    """
    tried = spiral(NORMALS, SPREAD)
    diffuse, lobes = _shapes(tried, lights)
    normals, weights = np.tile([0.0, 0, 1], (len(values), 1)), np.zeros(len(values))
    for i in range(0, len(values), BLOCK):
        v = values[i : i + BLOCK].astype(np.float64)
        w = counts[i : i + BLOCK] / (np.maximum(v, 0) + DARK * v.mean(1, keepdims=True) + np.finfo(np.float32).tiny)
        fits = [_fit(v, w, diffuse, lobe) for lobe in lobes]
        each, most = np.arange(len(v)), np.zeros(len(v))
        for explained, weight in fits:
            best = explained.argmax(1)
            better = np.flatnonzero(explained[each, best] > most)
            most[better] = explained[better, best[better]]
            normals[i + better], weights[i + better] = tried[best[better]], weight[better, best[better]]
    return normals, weights


def _shapes(normals: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a diffuse lobe of all normals reflects of all lights, (N, K); and GGX lobes, (L, N, K)."""
    cosine = np.maximum(normals @ lights.T, 0)
    half = np.maximum(normals @ unit(lights + np.array([0.0, 0, 1])).T, 0)
    view = normals[:, 2:]
    lobes = []
    for a in ALPHAS:
        masking = lambda c, a=a: 2 * c / (c + np.sqrt(a * a + (1 - a * a) * c * c))
        lobe = a * a / (half**2 * (a * a - 1) + 1) ** 2 * masking(cosine) * masking(view) / (4 * np.pi * view)
        lobes.append(np.where(cosine > 0, lobe, 0))
    return cosine, np.array(lobes)


def _fit(values: np.ndarray, weights: np.ndarray, diffuse: np.ndarray, lobe: np.ndarray) -> tuple[np.ndarray, ...]:
    """Weighted squares that multiples of two shapes explain, not negative, with each normal; and the second multiple:
    (P, N)."""
    weighted = weights * values
    aa, ab, bb = (weights @ (x * y).T + 1e-30 for x, y in ((diffuse, diffuse), (diffuse, lobe), (lobe, lobe)))
    va, vb = weighted @ diffuse.T, weighted @ lobe.T
    determinant = aa * bb * (1 + 1e-9) - ab * ab
    a, b = (va * bb - vb * ab) / determinant, (vb * aa - va * ab) / determinant
    both, second = (a > 0) & (b > 0), va * va / aa < vb * vb / bb
    explained = np.where(both, a * va + b * vb, np.maximum(va * va / aa, vb * vb / bb))
    return explained, np.where(both, b, second * vb / bb)
