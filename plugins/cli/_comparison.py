"""A derivative against finite differences, in units of their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from rimlight.edge_sampling import FiniteDifferences

#: `check` fails above this mean z² (about 1 without any bias) ...
MAX_MEAN_Z2 = 2.0

#: ... or if more than this share of the values is beyond 5 standard errors: a bias may be confined to a few pixels.
MAX_FAR = 0.003

#: Share of the largest value around a pixel by which a finite step may falsify it.
SMEARED = 0.04


@dataclass(frozen=True)
class Comparison:
    """How well a derivative agrees with finite differences."""

    relative_l1: float  # sum of the absolute differences / sum of the absolute reference
    noise_l1: float  # what noise alone would make of it
    mean_z: float  # mean of |difference| / standard error, over the values that are not 0
    max_z: float
    mean_z2: float
    far: float  # share of the values beyond 5 standard errors
    count: int  # values that are not 0 in both

    @property
    def agrees(self) -> bool:
        return self.mean_z2 <= MAX_MEAN_Z2 and self.far <= MAX_FAR

    def __str__(self) -> str:
        if self.count == 0:
            return "result              agree: both are 0 everywhere"
        limits = f"the limits are mean z² {MAX_MEAN_Z2:g} and {MAX_FAR:.1%} beyond 5"
        return (
            f"relative L1         {self.relative_l1:.2%} (noise alone: {self.noise_l1:.2%})\n"
            f"|z|                 mean {self.mean_z:.2f}, largest {self.max_z:.1f}, mean z² {self.mean_z2:.2f}, "
            f"{self.far:.2%} beyond 5, of {self.count} values\n"
            f"result              {'agree' if self.agrees else 'DISAGREE'}: {limits}"
        )


def compare(derivative: np.ndarray, error: np.ndarray, reference: FiniteDifferences) -> Comparison:
    """Compare two estimates, (H, W, C), in units of their joint standard error.

    The standard error of a pixel is that of the most uncertain pixel around it: where few samples arrive, its own is
    too small. And a finite step smears an edge over its path: some per cent of a value end up in the pixels around.
    """
    f = reference.mean
    around = lambda a: maximum_filter(a, size=(3, 3, 1))
    alive = (derivative != 0) | (f != 0)
    if not alive.any():
        return Comparison(0, 0, 0, 0, 0, 0, 0)
    difference = np.abs(derivative - f)[alive]
    noise = np.hypot(error, reference.standard_error)[alive]
    magnitude = np.maximum(np.abs(f)[alive].mean(), np.finfo(np.float32).tiny)
    allowed = around(np.hypot(np.hypot(error, reference.standard_error), SMEARED * np.abs(f)))[alive]
    z = difference / np.hypot(allowed, 1e-3 * magnitude)  # rounding
    total = magnitude * alive.sum()
    return Comparison(
        relative_l1=float(difference.sum() / total),
        noise_l1=float(np.sqrt(2 / np.pi) * noise.sum() / total),
        mean_z=float(z.mean()),
        max_z=float(z.max()),
        mean_z2=float((z**2).mean()),
        far=float((z > 5).mean()),
        count=int(alive.sum()),
    )
