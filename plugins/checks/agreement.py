"""Do a derivative and its reference agree? Numbers that are pooled over pixels, so that few samples tell much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from rimlight.edge_sampling.refusals import InputError

from .finite_differences import FiniteDifferences
from .zscores import mean_and_error, z_scores

#: Sums over squares of so many pixels are compared, too: a term that is missing somewhere shows there.
SQUARE = 4

#: The mean of the absolute value of a normal variable, in standard deviations.
MEAN_ABSOLUTE = np.sqrt(2 / np.pi)

#: Standard errors come from few runs: noise, and the mean of z², may be so many times what they say.
NOISE, MEAN_Z2 = 1.2, 1.35

#: How often a right derivative may fail by chance.
CHANCE = 1e-4


@dataclass(frozen=True)
class Agreement:
    """How well a derivative image g agrees with its reference r.

    finite : are all values of g numbers?
    zero : is the reference 0 within its noise, so that there is no `scale`?
    scale, scale_error : the projection ⟨g, r⟩ / ⟨r, r⟩ with its standard error; 1 is right. Neither the noise of g nor
        that of r biases it.
    relative : the sum of absolute differences, relative to that of absolute values of r.
    noise, noise_spread : what noise alone would make of `relative`, and the standard deviation of that.
    own_noise : what the noise of g alone would make of it.
    square : the largest absolute z of sums over squares of 4 × 4 pixels, beyond a tolerance.
    pixel : the largest absolute z of a value.
    mean_z2 : mean of z² over the values that are not 0. alive : in how many pixels there are such.
    runs : of g.
    squares, pixels : how many there are.
    tolerance : of `scale`, and of the sums over squares.
    """

    finite: bool
    zero: bool
    scale: float
    scale_error: float
    relative: float
    noise: float
    noise_spread: float
    own_noise: float
    square: float
    pixel: float
    mean_z2: float
    alive: int
    runs: int
    squares: int
    pixels: int
    tolerance: float

    def faults(self, noise: float | None = None) -> list[str]:
        """In which ways they disagree, in words; empty if they agree.

        noise : the largest that `own_noise` may be. Without it, a derivative may agree by being noisy.
        """
        if not self.finite:
            return ["it is not finite"]
        freedom = self.runs - 1
        # The variance of a pixel is at least the mean of its neighbours', which has more degrees of freedom.
        square, pixel = (_limit(count, 3 * freedom) for count in (self.squares, self.pixels))
        # The more pixels, the closer are means to what is expected of them. Channels share their random numbers.
        relative = self.tolerance + NOISE * self.noise + _limit(1, freedom) * self.noise_spread
        mean_z2 = MEAN_Z2 * stats.chi2.isf(CHANCE, self.alive) / self.alive if self.alive else 0
        scale = self.tolerance + _limit(1, freedom) * self.scale_error
        checks = [
            (self.zero or abs(self.scale - 1) <= scale, f"its scale is {self.scale:.4f} ± {self.scale_error:.4f}"),
            (
                self.relative <= relative,
                f"its relative L1 error is {self.relative:.4f}, of which noise explains {self.noise:.4f}",
            ),
            (self.square <= square, f"|z| of 4 × 4 pixels reaches {self.square:.1f}, beyond {square:.1f}"),
            (self.pixel <= pixel, f"|z| of a pixel reaches {self.pixel:.1f}, beyond {pixel:.1f}"),
            (self.mean_z2 <= mean_z2, f"the mean of z² is {self.mean_z2:.2f}, more than {mean_z2:.2f}"),
            (
                noise is None or self.own_noise <= noise,
                f"its noise is {self.own_noise:.4f} of its L1 norm, more than {noise}",
            ),
        ]
        return [fault for holds, fault in checks if not holds]

    def numbers(self) -> dict[str, str]:
        """What was found, in words."""
        scale = "(the reference is 0 within its noise)" if self.zero else f"{self.scale:.4f} ± {self.scale_error:.4f}"
        return {
            "scale": f"{scale} (1 is right)",
            "relative L1": f"{self.relative:.2%} (of noise: {self.noise:.2%}; of its own: {self.own_noise:.2%})",
            "|z|": f"of 4 × 4 pixels {self.square:.1f}, of a pixel {self.pixel:.1f}; mean z² {self.mean_z2:.2f}",
        }

    def __str__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in self.numbers().items())


def compare(derivatives: np.ndarray, reference: FiniteDifferences, *, tolerance: float = 0.005) -> Agreement:
    """Compare independent runs of a derivative, (N, H, W, C), N ≥ 2, with a reference.

    tolerance : how far the reference itself may be off, relative to it: its step is not infinitely small.

    Raises
    ------
    ValueError : there are fewer than two runs, the shapes differ, or the reference is not finite.
    """
    runs = np.asarray(derivatives, np.float64)
    r, r_error, step_error = (
        np.asarray(a, np.float64) for a in (reference.mean, reference.standard_error, reference.step_error)
    )
    if len(runs) < 2 or runs.shape[1:] != r.shape:
        raise InputError(
            f"compare: needs at least two runs of shape {r.shape}, got {len(runs)} of shape {runs.shape[1:]}"
        )
    if not all(np.isfinite(a).all() for a in (r, r_error, step_error)):
        raise InputError("compare: the reference is not finite")
    finite = bool(np.isfinite(runs).all())
    runs = np.nan_to_num(runs, posinf=0, neginf=0)  # to be able to tell what else there is
    g, g_error = mean_and_error(runs)

    # ---------------------- Projection ----------------------
    # The channels of a pixel have the same random numbers: their errors are taken for one.
    together = lambda errors: float((np.abs(errors).sum(2) ** 2).sum())
    # ⟨r, r⟩ without the noise of r, which would make the reference look larger than it is.
    size = float((r**2 - r_error**2).sum())
    size_error = np.sqrt(together(2 * r * r_error) + 2 * together(r_error**2))
    zero = size <= 3 * size_error
    projections = (runs * r).sum((1, 2, 3))
    scale = float(projections.mean() / size) if not zero else np.nan
    # Of few runs, the spread is uncertain; that of their pixels, of which there are many, is not.
    own = max(projections.var(ddof=1) / len(runs), together(r * g_error))
    theirs = together((g - 2 * r) * r_error)
    scale_error = float(np.sqrt(own + theirs) / size) if not zero else np.nan

    # ---------------------- Pixels, and squares of them ----------------------
    total = max(float(np.abs(r).sum()), float(np.finfo(np.float32).tiny))
    error = np.hypot(g_error, r_error)
    spread = np.sqrt((1 - MEAN_ABSOLUTE**2) * (error.sum(2) ** 2).sum())
    z = np.abs(z_scores(g, g_error, r, r_error, step_error))
    alive = (g != 0) | (r != 0)
    sums, sums_error = mean_and_error(np.array([_squares(run) for run in runs]))
    allowed = tolerance * _squares(np.abs(r))
    theirs_error = np.sqrt(_squares(r_error**2))
    beyond = np.maximum(np.abs(sums - _squares(r)) - allowed, 0)
    bias = np.hypot(1e-3 * np.abs(_squares(r)).max(), np.sqrt(_squares(step_error**2)))
    squares = z_scores(beyond, sums_error, np.zeros_like(beyond), theirs_error, bias)
    return Agreement(
        finite=finite,
        zero=bool(zero),
        scale=scale,
        scale_error=scale_error,
        relative=float(np.abs(g - r).sum() / total),
        noise=float(MEAN_ABSOLUTE * error.sum() / total),
        noise_spread=float(spread / total),
        own_noise=float(MEAN_ABSOLUTE * g_error.sum() / total),
        square=float(squares.max()),
        pixel=float(z.max()),
        mean_z2=float((z[alive] ** 2).mean()) if alive.any() else 0.0,
        alive=int(alive.any(2).sum()),
        runs=len(runs),
        squares=squares.size,
        pixels=z.size,
        tolerance=tolerance,
    )


def two_sides(before: FiniteDifferences, after: FiniteDifferences) -> tuple[float, float]:
    """By how much differences to both sides are apart: sum of absolute values, relative to the mean of theirs, so 2 at
    most; and what noise alone would make of it, at most.

    before, after : `finite_differences` with the sides -1 and 1. If they are apart, however small the step is, the
        image has no derivative: it depends on the side.
    """
    size = float((np.abs(before.mean) + np.abs(after.mean)).sum() / 2)
    apart = float(np.abs(after.mean - before.mean).sum())
    # Of a normal distribution, the mean of absolute values is √(2/π) standard deviations.
    noise = float(np.sqrt(2 / np.pi) * (before.standard_error + after.standard_error).sum())
    return (apart / size, noise / size) if size else (0.0, 0.0)


def _limit(count: int, freedom: int) -> float:
    """What the largest of `count` values of |t| exceeds with a probability of `CHANCE` (Šidák)."""
    return float(stats.t.isf((1 - (1 - CHANCE) ** (1 / count)) / 2, freedom))


def _squares(image: np.ndarray) -> np.ndarray:
    """Sums over squares of pixels: (H', W', C)."""
    for axis in (0, 1):
        image = np.add.reduceat(image, np.arange(0, image.shape[axis], SQUARE), axis=axis)
    return image
