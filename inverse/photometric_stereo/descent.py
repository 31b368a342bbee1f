"""Optimisers for what is constrained: unit normals, and weights on a simplex. Plain arrays in, plain arrays out."""

from __future__ import annotations

import numpy as np

from .vectors import unit


class NormalAdam:
    """Set-adaptive Adam on the unit sphere (Bangaru 2019, sections 2.4.1 and 4.2).

    Gradients are projected on the tangent plane of their normal; the three components of a normal share one second
    moment, so that their direction survives; after the step, normals are normalised again, and what Adam remembers is
    projected on the new plane.

    rate : length of a step where gradients agree, radians. momentum, smooth_scale : of the first and second moments.
    """

    def __init__(self, count: int, rate: float, *, momentum: float = 0.9, smooth_scale: float = 0.99):
        self.rate, self.betas = rate, (momentum, smooth_scale)
        self.mean, self.square, self.steps = np.zeros((count, 3)), np.zeros(count), 0

    def step(self, normals: np.ndarray, gradient: np.ndarray, factor: float = 1.0) -> np.ndarray:
        """New unit normals, (P, 3). factor : of the rate."""
        b1, b2 = self.betas
        self.steps += 1
        g = _tangential(normals, gradient)  # Eq. 2.28
        self.mean = b1 * self.mean + (1 - b1) * g
        self.square = b2 * self.square + (1 - b2) * (g * g).sum(1)
        scale = np.sqrt(self.square / (1 - b2**self.steps))
        scale = np.where(scale > 0, scale, np.inf)
        moved = unit(normals - factor * self.rate / (1 - b1**self.steps) * self.mean / scale[:, None])
        self.mean = _tangential(moved, self.mean)
        return moved


class ExponentiatedGradient:
    """Multiplicative updates of weights that are not negative and sum to at most 1 (Kivinen and Warmuth 1997; Bangaru
    2019, section 4.3), a colour a column; a black lobe has what they lack. Weights of 0 stay 0.

    rate : largest change of the logarithm of a weight where gradients agree: they are divided by the root of their
    mean square, one for each colour.
    """

    def __init__(self, colours: int, rate: float, *, smooth_scale: float = 0.9):
        self.rate, self.beta = rate, smooth_scale
        self.square, self.steps = np.zeros(colours), 0

    def step(self, weights: np.ndarray, gradient: np.ndarray, factor: float = 1.0) -> np.ndarray:
        """New weights, (B, C)."""
        self.steps += 1
        g = np.concatenate([gradient, np.zeros((1, len(self.square)))])
        w = np.concatenate([weights, np.maximum(1 - weights.sum(0, keepdims=True), 0)])
        g = g - (w * g).sum(0) / w.sum(0)  # what all have in common changes nothing
        self.square = self.beta * self.square + (1 - self.beta) * np.max(np.abs(g), axis=0, initial=0) ** 2
        scale = np.sqrt(self.square / (1 - self.beta**self.steps))
        w = w * np.exp(-factor * self.rate * g / np.where(scale > 0, scale, np.inf))
        return (w / w.sum(0))[:-1]


def _tangential(normals: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return vectors - normals * (vectors * normals).sum(1, keepdims=True)
