"""A derivative against finite differences, in units of their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from rimlight.edge_sampling import FiniteDifferences

#: `check` fails above this mean z². Without any bias, it lies a little above 1.
MAX_MEAN_Z2 = 2.0

#: Share of the largest value around a pixel by which a finite step may falsify it.
SMEARED = 0.02


@dataclass(frozen=True)
class Comparison:
    """How well a derivative agrees with finite differences."""

    relative_l1: float  # sum of the absolute differences / sum of the absolute reference
    noise_l1: float  # what noise alone would make of it
    mean_z: float  # mean of |difference| / standard error, over the values that are not 0
    max_z: float
    mean_z2: float
    count: int  # values that are not 0 in both

    @property
    def agrees(self) -> bool:
        return self.mean_z2 <= MAX_MEAN_Z2

    def __str__(self) -> str:
        if self.count == 0:
            return "result              agree: both are 0 everywhere"
        verdict = "agree" if self.agrees else f"DISAGREE: mean z² is beyond its limit of {MAX_MEAN_Z2:g}"
        return (
            f"relative L1         {self.relative_l1:.2%} (noise alone: {self.noise_l1:.2%})\n"
            f"|z|                 mean {self.mean_z:.2f}, largest {self.max_z:.1f}, mean z² {self.mean_z2:.2f}, "
            f"of {self.count} values\n"
            f"result              {verdict}"
        )


def compare(derivative: np.ndarray, error: np.ndarray, reference: FiniteDifferences) -> Comparison:
    """Compare two estimates, (H, W, C), in units of their joint standard error.

    A finite step smears an edge over its path: some per cent of a value end up in the pixels around it. That, and
    rounding, are allowed for in the standard error; they would otherwise decide where both estimates are free of noise.
    """
    f = reference.mean
    alive = (derivative != 0) | (f != 0)
    if not alive.any():
        return Comparison(0, 0, 0, 0, 0, 0)
    difference = np.abs(derivative - f)[alive]
    noise = np.hypot(error, reference.standard_error)[alive]
    magnitude = np.maximum(np.abs(f)[alive].mean(), np.finfo(np.float32).tiny)
    smeared = SMEARED * maximum_filter(np.abs(f), size=(3, 3, 1))[alive]
    z = difference / np.sqrt(noise**2 + smeared**2 + (1e-3 * magnitude) ** 2)
    total = magnitude * alive.sum()
    return Comparison(
        relative_l1=float(difference.sum() / total),
        noise_l1=float(np.sqrt(2 / np.pi) * noise.sum() / total),
        mean_z=float(z.mean()),
        max_z=float(z.max()),
        mean_z2=float((z**2).mean()),
        count=int(alive.sum()),
    )
