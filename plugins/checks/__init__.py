"""Checks of derivatives, of your own scenes, too: motions, finite differences, and whether two estimates agree."""

from .agreement import Agreement, compare, two_sides
from .finite_differences import FiniteDifferences, finite_differences
from .motion import Motion, derivative_image
from .zscores import mean_and_error, z_scores

__all__ = [
    "Agreement",
    "FiniteDifferences",
    "Motion",
    "compare",
    "derivative_image",
    "finite_differences",
    "mean_and_error",
    "two_sides",
    "z_scores",
]
