"""Unit vectors, and other small things that many modules need."""

from __future__ import annotations

import numpy as np

#: Of linear sRGB; those with which published results on DiLiGenT weigh the channels.
LUMINANCE = np.array([0.2989, 0.5870, 0.1140], np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1; those of length 0 face the camera."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), [0, 0, 1])


def directions_of(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1; those of length 0, or not finite, are (0, 0, 0)."""
    known = np.isfinite(vectors).all(-1, keepdims=True) & vectors.any(-1, keepdims=True)
    return np.where(known, unit(np.where(known, vectors, 0)), 0)


def every(array: np.ndarray, most: int) -> np.ndarray:
    """At most so many rows of an array, evenly."""
    return array[:: -(-len(array) // most) or 1]


def spiral(count: int, spread: float) -> np.ndarray:
    """Directions, (count, 3), evenly spread over the cap about +z of this half-angle, degrees (Fibonacci spiral)."""
    k = np.arange(count)
    z = 1 - (k + 0.5) / count * (1 - np.cos(np.radians(spread)))
    phi, r = k * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)
