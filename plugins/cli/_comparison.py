"""A derivative against finite differences, in units of their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rimlight.edge_sampling import FiniteDifferences, z_scores

#: `check` fails above this mean z² (at most about 1 without any bias) ...
MAX_MEAN_Z2 = 2.0

#: ... or if more than this share of the values is beyond 5 standard errors: a bias may be confined to a few pixels.
MAX_FAR = 0.003


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
    """Compare two estimates, (H, W, C), in units of their joint standard error, see `z_scores`."""
    f = reference.mean
    alive = (derivative != 0) | (f != 0)
    if not alive.any():
        return Comparison(0, 0, 0, 0, 0, 0, 0)
    z = np.abs(z_scores(derivative, error, f, reference.standard_error, reference.step_error))[alive]
    noise = np.hypot(error, reference.standard_error)
    total = max(float(np.abs(f).sum()), np.finfo(np.float32).tiny)
    return Comparison(
        relative_l1=float(np.abs(derivative - f).sum() / total),
        noise_l1=float(np.sqrt(2 / np.pi) * noise.sum() / total),
        mean_z=float(z.mean()),
        max_z=float(z.max()),
        mean_z2=float((z**2).mean()),
        far=float((z > 5).mean()),
        count=int(alive.sum()),
    )
