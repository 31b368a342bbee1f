"""Is something added to all values, such as the camera's black level?

It is all that the camera sees where the surface faces away from a light. Light by way of other parts of the surface
differs from place to place and from light to light, so the darkest of these values lie far apart; with a black level
they lie close together, above zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import least_squares

#: Pixels face away from a light if least squares predict a value less than minus this part of that of a pixel that
#: faces the light.
AWAY = 0.05

#: Values that face away without which nothing is told: of all images, and of a part of them.
FEWEST, OF_AN_IMAGE, IMAGES = 100, 5, 0.25

#: Quantiles of these values: the darkest, and those that must lie close to them; and their least ratio.
DARKEST, NEXT, CLOSE = 0.02, 0.25, 0.8

#: Least black level of interest, over the median value.
LEAST = 0.01

#: Largest part of all values that may be darker, by chance.
DARKER = 0.01


@dataclass(frozen=True)
class BlackLevel:
    """level : what seems to be added to all values, 0 if nothing does. part : of the median value. NaN where nothing is
    told."""

    level: float = np.nan
    part: float = np.nan

    def __str__(self) -> str:
        if np.isnan(self.part):
            return "not judged, too few pixels face away from lights"
        return f"{100 * self.part:.0f} % of the median value" if self.part else "none"

    def said(self) -> list[str]:
        """Warnings."""
        if not self.part > 0:
            return []
        return [
            f"About {self.level:.2g} seems to be added to all values, {100 * self.part:.0f} % of the median one: what "
            "faces away from a light has that value in all images. Subtract the camera's black level (what it shows "
            "with its lens covered), and switch off other lights."
        ]


def away(scaled: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Which lights pixels face away from, (P, K), bool. scaled : normals times albedo, (P, 3). lights : directions,
    (K, 3) or (P, K, 3)."""
    return least_squares.predicted(scaled, lights) < -AWAY * np.linalg.norm(scaled, axis=1, keepdims=True)


def judged(pictured: np.ndarray, away: np.ndarray) -> BlackLevel:
    """pictured : (P, K), luminances, not divided by intensities. away : as of the function."""
    median = np.median(pictured)
    if away.sum() < FEWEST or np.mean(away.sum(0) >= OF_AN_IMAGE) < IMAGES or median <= 0:
        return BlackLevel()
    darkest, next_ = np.quantile(pictured[away], [DARKEST, NEXT])
    close = darkest > CLOSE * next_ and np.mean(pictured < CLOSE * next_) <= DARKER
    if not close or darkest <= LEAST * median:
        return BlackLevel(0.0, 0.0)
    return BlackLevel(float(darkest), float(darkest / median))  # on top comes what the surface reflects on itself
