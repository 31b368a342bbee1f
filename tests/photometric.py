"""What several tests of photometric stereo share."""

from __future__ import annotations

import numpy as np

from rimlight import ggx

UP = np.array([0.0, 0, 1])

#: A dictionary of one lobe, the Lambertian one.
LAMBERT = ggx.Lobes((np.nan,), (np.nan,))


def glossy(lobes: ggx.Lobes) -> np.ndarray:
    """Weights, (B, 3): plastic, coloured."""
    alpha = np.array(lobes.alpha)
    weights = np.zeros((len(lobes), 3))
    weights[np.isnan(lobes.eta)] = (0.5, 0.35, 0.2)
    weights[np.nanargmin(np.abs(alpha - 0.25))] = 0.4
    return weights


def disc(N: int, centre: tuple[float, float], radius: float) -> np.ndarray:
    v, u = np.mgrid[:N, :N]
    return (u - centre[0]) ** 2 + (v - centre[1]) ** 2 < radius**2
