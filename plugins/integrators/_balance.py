"""How samples are divided among the terms of a derivative, so that a given time leaves the least error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

#: Derivatives from which the noise of each term is measured.
RUNS = 4

#: The least share: measured noise may lack what is rare.
LEAST = 1 / 2

#: The largest share: costs are reckoned, and not measured.
MOST = 8


@dataclass(frozen=True)
class Balance:
    """What `EdgeIntegrator.balance` has measured, by the names of the terms.

    Attributes
    ----------
    noise
        Mean absolute deviation of one derivative from its mean, summed over the film, relative to the sum of the
        absolute values of that mean; with the same number of samples per pixel in each term.
    cost
        About how long a sample per pixel takes, relative to all terms together.
    shares
        By what the samples of each term are multiplied from now on. All together cost as much as before, or less where
        limits leave nothing else.
    """

    noise: dict[str, float]
    cost: dict[str, float]
    shares: dict[str, float]

    @property
    def gain(self) -> float:
        """By what the variance falls in the same time, if the terms are independent of each other."""
        after = sum(self.noise[k] ** 2 / share for k, share in self.shares.items())
        before = sum(self.noise[k] ** 2 for k in self.shares)
        return before / after if after > 0 else 1.0

    def __str__(self) -> str:
        rows = [
            f"{name:26} noise {self.noise[name]:7.2%}  cost {self.cost[name]:6.1%}  samples x {share:.2f}"
            for name, share in self.shares.items()
        ]
        return "\n".join([*rows, f"variance in the same time: 1 / {self.gain:.2f}"])


def balanced(images: dict[str, np.ndarray], cost: dict[str, float], fixed: set[str]) -> Balance:
    """The shares with the least variance for the same cost: in proportion to the noise of each term over the square
    root of its cost (optimal allocation, Neyman 1934).

    images : derivatives of each term, (runs, H, W, C), linear. cost : of each term. fixed : terms with a share of 1.
    """
    norm = np.abs(sum(a.mean(0) for a in images.values())).sum() or 1.0
    noise, total = {}, sum(cost.values()) or 1.0
    for name, a in images.items():
        deviation = np.abs(a - a.mean(0)).mean(0).sum()
        noise[name] = float(deviation * np.sqrt(len(a) / (len(a) - 1)) / norm)
    cost = {name: c / total for name, c in cost.items()}
    free = [name for name, c in cost.items() if c > 0 and name not in fixed]
    wanted = np.array([noise[name] / np.sqrt(cost[name]) for name in free])
    costs = np.array([cost[name] for name in free])
    shares = np.ones(len(free))
    if np.isfinite(wanted).all() and wanted.any():
        clipped = lambda scale: np.clip(scale * wanted, LEAST, MOST)
        more = lambda scale: costs @ clipped(scale) - costs.sum()
        largest = MOST / wanted[wanted > 0].min()
        shares = clipped(brentq(more, 0, largest) if more(largest) > 0 else largest)
    found = dict(zip(free, map(float, shares), strict=True))
    return Balance(noise, cost, {name: found.get(name, 1.0) for name, c in cost.items() if c > 0})
