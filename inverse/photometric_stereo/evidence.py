"""How well a state of a reconstruction predicts values that were left out: what decides between states and materials.

Of each pixel, the values under some lights are left out: under a few lights all, and of blocks of pixels those under
others. What is a pixel's own (its normal, its albedo or colour) and the BSDF are found once more from the values that
are kept, and predict the others. A state that explains the images for a wrong reason does that badly.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np

from rimlight import ggx

from . import least_squares
from .dataset import Dataset
from .direct import DirectModel, Guess

#: Part of the lights that are left out whole, and part of those of each block of pixels; its width, pixels.
WHOLE, OF_BLOCKS, BLOCK = 0.1, 0.1, 8

#: Fewest lights of which any can be left out: what is kept must be more than what is sought.
FEWEST = 8

#: Pixels by which an object is judged.
JUDGED = 800

#: Fits of the BSDF and of what is a pixel's own, in turns, to the values that are kept.
REFITS = 2

#: Deviations of a prediction count at most so much, of the mean value of the pixel: shadows and highlights that are a
#: pixel beside their place.
MOST = 0.5


@dataclass(frozen=True)
class Kind:
    """Of material. several : colours of pixels under one glaze; else one material times an albedo of pixels.
    coat : is what is diffuse under a smooth coat? (Of one material: it may be.)"""

    several: bool = False
    coat: bool = False

    def base_eta(self, lobes: ggx.Lobes) -> float:
        """Of the coat over diffuse colours."""
        coated = np.isnan(lobes.alpha) & ~np.isnan(lobes.eta)
        return float(np.array(lobes.eta)[coated][0]) if self.coat and coated.any() else np.nan

    def of(self, guess: Guess, lobes: ggx.Lobes) -> Guess:
        """A copy of a guess, in which the material is of this kind."""
        guess = copy.deepcopy(guess)
        if self.several and guess.base is None:
            matte = np.isnan(lobes.alpha)
            guess.base = guess.albedo[:, None] * guess.weights[matte].sum(0)
            guess.weights[matte] = 0
            guess.albedo = np.ones_like(guess.albedo)
            guess.base_eta = self.base_eta(lobes)
        return guess


def left_out(data: Dataset, seed: int) -> np.ndarray:
    """Which values are left out: (P, K), bool. None of them if there are too few lights."""
    P, K, _ = data.values.shape
    found = np.zeros((P, K), bool)
    if K < FEWEST:
        return found
    rng = np.random.default_rng([seed, 17])
    whole = max(round(WHOLE * K), 1)
    lights = rng.permutation(K)
    found[:, lights[:whole]] = True
    rows, columns = np.nonzero(data.mask)
    _, block = np.unique(np.stack([rows // BLOCK, columns // BLOCK]), axis=1, return_inverse=True)
    count = max(round(OF_BLOCKS * K), 1)
    chosen = np.stack([rng.permutation(lights[whole:])[:count] for _ in range(block.max() + 1)])
    found[np.arange(P)[:, None], chosen[block.ravel()]] = True
    return found


@dataclass(frozen=True)
class Judge:
    """Of the states of one size.

    left : (P, K), what is left out. counts : (P, K), which values count, for all states alike. seed : of its random
    numbers. start : the method of the start, one of `least_squares.METHODS`.
    """

    data: Dataset
    lobes: ggx.Lobes
    left: np.ndarray
    counts: np.ndarray
    seed: int
    start: str

    @property
    def able(self) -> bool:
        """Are there lights enough?"""
        return bool(self.left.any())

    def pixels(self) -> np.ndarray:
        """Numbers of those by which it judges, ascending."""
        P = len(self.data.values)
        return np.sort(np.random.default_rng([self.seed, 18]).choice(P, min(JUDGED, P), replace=False))

    def errors(
        self,
        guess: Guess,
        kind: Kind,
        points: np.ndarray,
        seen: np.ndarray,
        indirect: np.ndarray | None,
        *,
        lights: np.ndarray | None = None,
    ) -> np.ndarray:
        """Mean deviation of what is predicted from what was left out, of each of its pixels, over their mean values.

        seen, indirect : what the depth of the state hides, (P, K), and reflects, (P, K, 3).
        lights : directions, (K, 3) or (P, K, 3). If they are given, the state is a start: its normals are those that
            the method of the start finds from what is kept, and stay as they are.
        """
        pixels = self.pixels()
        mask = np.zeros_like(self.data.mask)
        mask[tuple(x[pixels] for x in np.nonzero(self.data.mask))] = True
        few = replace(self.data, mask=mask, values=self.data.values[pixels], truth=None)
        left, counts, seen = self.left[pixels], self.counts[pixels], seen[pixels]
        kept = (counts * seen * ~left).astype(np.float32)
        indirect = None if indirect is None else indirect[pixels]
        model = DirectModel(few, self.lobes, points=points[pixels], counts=kept, indirect=indirect)
        trial, turn = kind.of(guess.of(pixels), self.lobes), lights is None
        if not turn:
            trial.normals = self._started(few, trial.exposures, ~left, lights if lights.ndim == 2 else lights[pixels])
        rng = np.random.default_rng([self.seed, 19])
        for _ in range(REFITS):
            model.fit_bsdf(trial, rng, coat=kind.coat, turn=turn)
            model.fit_normals(trial, steps=2, turn=turn)
        predicted = model.predicted(trial)
        if indirect is not None:
            predicted = (predicted - indirect) * seen[..., None] + indirect
        else:
            predicted *= seen[..., None]
        mean = few.values.mean((1, 2)) + 1e-3 * model.scale
        deviation = np.minimum(np.abs(predicted - few.values).mean(2) / mean[:, None], MOST)
        w = left * counts
        return (w * deviation).sum(1) / np.maximum(w.sum(1), 1e-9)

    def _started(self, few: Dataset, exposures: np.ndarray, kept: np.ndarray, lights: np.ndarray) -> np.ndarray:
        """Normals by the method of the start, from values that are kept. As many are of each pixel."""
        count = kept.sum(1).min()
        chosen = np.argsort(~kept, axis=1, kind="stable")[:, :count]
        values = np.take_along_axis(few.luminance / exposures, chosen, 1)
        at = lights[chosen] if lights.ndim == 2 else np.take_along_axis(lights, chosen[..., None], 1)
        return least_squares.normals(values, at, self.start)
