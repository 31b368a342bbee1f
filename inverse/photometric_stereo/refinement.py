"""Descent along derivatives of path-traced images: through all bounces, and with respect to depth, through shadows.

What is left to it by `reconstruction.reconstruct`: there, what surfaces reflect on each other and the shadows that they
cast are taken as they were. Here, they are differentiated (Bangaru 2019, algorithm 1; its section 6.1.2 for depth).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from rimlight.edge_sampling.refusals import InputError

from . import laplacian
from .dataset import Dataset
from .descent import ExponentiatedGradient, NormalAdam
from .direct import HUBER, DirectModel, Guess
from .rendering import Domain, Rendering
from .vectors import unit

log = logging.getLogger(__name__)

#: Share of the weights that is spread over all lobes at the start: descent multiplies, and weights of 0 would stay.
SPREAD = 0.01

#: Of the size of a step of depth: the mean of the squares of the last ones.
MEMORY = 0.9


@dataclass(frozen=True, kw_only=True)
class Descent:
    """How normals, BSDF and depth descend together.

    Raises
    ------
    ValueError : an option is out of its range.
    """

    steps: int = 0
    """Number of steps."""
    spp: int = 1
    """Samples per pixel of the images and of their derivatives."""
    lights: int = 0
    """Number of distant lights that each step uses, chosen at random. 0: all."""
    adaptive: bool = True
    """Sample derivatives where the images differ most."""
    rate: float = 0.002
    """Rate of normals, in radians per step at the start. It falls to a tenth."""
    bsdf_rate: float = 0.05
    """Rate of the logarithms of the weights of the BSDF, per step at the start. It falls to a tenth."""
    depth_rate: float = 0.0
    """Rate of depth, in pixels per step at the start, which falls to a tenth. The shadows that the surface casts are
    differentiated. 0: depth is only integrated from the normals."""
    integrability: float = 0.002
    """If depth descends: fraction by which normals turn towards those of the depth at each step."""

    def __post_init__(self):
        rates = self.rate, self.bsdf_rate, self.depth_rate, self.integrability
        if min(self.steps, self.lights, *rates) < 0 or not np.isfinite(rates).all() or self.spp < 1:
            raise InputError(f'ps: "spp" of the descent must be at least 1, other options 0, got {self}')


def descend(
    rendering: Rendering,
    data: Dataset,
    guess: Guess,
    depth: np.ndarray,
    counts: np.ndarray,
    options: Descent,
    rng: np.random.Generator,
    *,
    bilateral: float | None = None,
    after: Callable[[np.ndarray, float], None] | None = None,
) -> np.ndarray:
    """Change a guess in place. Returns depth, (Q,).

    counts : (P, K), how much values count. With `depth_rate`, those in shadow should, too: they tell of depth.
    after : called after each step with depth and the root mean square residual over the median value. Derivatives that
        are not finite are left out, and logged.
    """
    P, K, _ = data.values.shape
    scale, B = DirectModel(data, rendering.lobes).scale, len(guess.weights)
    normals, bsdf = NormalAdam(P, options.rate), ExponentiatedGradient(3, options.bsdf_rate)
    lack = np.maximum(1 - guess.weights.sum(0), 0)
    guess.weights = (1 - SPREAD) * guess.weights + SPREAD * np.minimum(lack, guess.weights.sum(0)) / B
    domain, square = rendering.domain, 0.0
    integrated = lambda: domain.integrate(guess.normals, bilateral)
    offset = _in_pixels(domain, depth) - _in_pixels(domain, integrated())
    seed = lambda: int(rng.integers(2**31))
    for i in range(options.steps):
        factor = 0.1 ** (i / max(options.steps - 1, 1))
        if options.lights:
            rendering.choose(rng.choice(K, len(rendering.chosen), replace=False))
        rendering.update(guess, depth)
        chosen, counted = rendering.chosen, counts[:, rendering.chosen, None]
        residual = rendering.image(spp=options.spp, seed=seed()) - data.values[:, chosen]
        size = np.linalg.norm(residual, axis=2, keepdims=True)
        w = counted * np.minimum(1, HUBER * scale / np.maximum(size, 1e-20))
        adjoint = w * residual / (scale * P * len(chosen))
        # Other samples than those of the images: else their errors and those of the derivatives would be correlated
        g = rendering.gradient(
            adjoint, spp=options.spp, seed=seed(), depth=options.depth_rate > 0, adaptive=options.adaptive
        )
        if bad := sum(int((~np.isfinite(x)).sum()) for x in g.values()):
            log.warning("ps: step %d: %d numbers of the derivative are not finite, and count as 0", i, bad)
            g = {name: np.where(np.isfinite(x), x, 0) for name, x in g.items()}
        guess.normals = normals.step(guess.normals, g["normals"], factor)
        guess.weights = bsdf.step(guess.weights, g["weights"], factor)
        if options.depth_rate > 0:
            # What normals say of depth is stiff. In its own metric, an offset descends smoothly.
            change = _smoothed(domain, depth, g["depth"])
            square = MEMORY * square + (1 - MEMORY) * float(np.mean(change**2))
            size = np.sqrt(square / (1 - MEMORY ** (i + 1)))
            offset -= options.depth_rate * factor / (size or 1.0) * change
            offset -= offset.mean()
        depth = _moved(domain, integrated(), offset)
        if options.depth_rate > 0 and options.integrability > 0:
            of_depth = domain.normals(depth)
            guess.normals = unit(guess.normals + options.integrability * (of_depth - guess.normals))
            offset = _in_pixels(domain, depth) - _in_pixels(domain, integrated())
        if after is not None:
            total = max(float(counted.sum()), 1.0)
            after(depth, float(np.sqrt((counted * residual**2).sum() / total / 3) / scale))
    return depth


def _in_pixels(domain: Domain, depth: np.ndarray) -> np.ndarray:
    """Depth of which a difference is one in pixels; with a camera, its logarithm in those of the focal length."""
    return depth if domain.camera is None else np.log(depth) * domain.camera[0, 0]


def _moved(domain: Domain, depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return depth + pixels if domain.camera is None else depth * np.exp(pixels / domain.camera[0, 0])


def _smoothed(domain: Domain, depth: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """A gradient with respect to depth in the metric of slopes, in pixels: (L + small)⁻¹ g, with the Laplacian L of the
    pixels. Where depth is steep, neighbours count less: what is in front of something else moves as a whole."""
    number = np.full(domain.wide.shape, -1)
    number[domain.wide] = np.arange(len(depth))
    pairs = np.concatenate(
        [np.stack([a.ravel(), b.ravel()]) for a, b in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1]))], 1
    )
    first, second = pairs[:, (pairs >= 0).all(0)]
    if domain.camera is not None:
        gradient = gradient * depth / domain.camera[0, 0]
    height = _in_pixels(domain, depth)
    stiffness = 1 / (1 + (height[first] - height[second]) ** 2)
    count, i = len(depth), np.arange(len(depth))
    total = lambda pixel: np.bincount(pixel, stiffness, count)
    entries = np.r_[total(first) + total(second) + 1e-4, -stiffness, -stiffness]
    A = sp.csr_matrix((entries, (np.r_[i, first, second], np.r_[i, second, first])))
    return laplacian.solve(A, gradient, np.zeros(count), tolerance=1e-4)
