"""How well a state of a reconstruction predicts values that were left out: what decides between states and materials.

Of each pixel, the values under some lights are left out: under a few lights all, and of blocks of pixels those under
others. What is a pixel's own (its normal, its albedo or colour) and the BSDF are found once more from the values that
are kept, and predict the others. A state that explains the images for a wrong reason does that badly.

What predicts values well may still have wrong normals. So normals are found twice, from one half of the lights and from
the other: those of a wrong model depend on where the lights are.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np

from rimlight import ggx

from . import least_squares
from .dataset import Dataset
from .direct import DirectModel, Guess, own

#: Part of the lights that are left out whole, and part of those of each block of pixels; its width, pixels.
WHOLE, OF_BLOCKS, BLOCK = 0.1, 0.1, 8

#: Fewest lights of which any can be left out, for three must be kept; and of which any are left out whole.
FEWEST, FEWEST_WHOLE = 4, 8

#: Pixels by which an object is judged.
JUDGED = 800

#: Fits of the BSDF and of what is a pixel's own, in turns, to the values that are kept.
REFITS = 2

#: Steps by which normals follow one half of the lights, and fewest values of a pixel that tell its normal.
STEPS, TELLING = 4, 3

#: Normals of both halves differ at most so much, degrees: more is as wrong.
FAR = 30.0

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
        if self.several:
            guess.base_eta = self.base_eta(lobes)
        if self.several and guess.base is None:
            matte = np.isnan(lobes.alpha)
            guess.base = guess.albedo[:, None] * guess.weights[matte].sum(0)
            guess.weights[matte] = 0
            guess.albedo = np.ones_like(guess.albedo)
        return guess


def left_out(data: Dataset, seed: int) -> np.ndarray:
    """Which values are left out: (P, K), bool. None of them if there are too few lights."""
    P, K, _ = data.values.shape
    found = np.zeros((P, K), bool)
    if K < FEWEST:
        return found
    rng = np.random.default_rng([seed, 17])
    whole = max(round(WHOLE * K), 1) if K >= FEWEST_WHOLE else 0
    lights = rng.permutation(K)
    found[:, lights[:whole]] = True
    rows, columns = np.nonzero(data.mask)
    _, block = np.unique(np.stack([rows // BLOCK, columns // BLOCK]), axis=1, return_inverse=True)
    count = max(round(OF_BLOCKS * K), 1)
    chosen = np.stack([rng.permutation(lights[whole:])[:count] for _ in range(block.max() + 1)])
    found[np.arange(P)[:, None], chosen[block.ravel()]] = True
    return found


def halves(lights: np.ndarray) -> list[np.ndarray]:
    """Ways to part lights, (K, 3), in halves: which are in the first, (K,), bool. Left and right, below and above, two
    opposite quadrants and the others, inside and outside."""
    x, y = (lights[:, :2] - np.median(lights[:, :2], axis=0)).T
    away = np.hypot(x, y)
    return [x > 0, y > 0, x * y > 0, away > np.median(away)]


def mean_angle(apart: np.ndarray) -> np.ndarray:
    """Of `Judge.apart`, (W, P, 3), over its ways that are known, degrees, (P,). NaN where none is."""
    off = np.linalg.norm(apart, axis=2)
    told = np.isfinite(off)
    total = np.where(told, np.degrees(2 * np.arcsin(off / 2)), 0).sum(0)
    return np.divide(total, told.sum(0), out=np.full(len(total), np.nan), where=told.any(0))


@dataclass(frozen=True)
class Judge:
    """Of the states of one size.

    left : (P, K), what is left out. counts : (P, K), which values count, for all states alike. seed : of its random
    numbers. start : the method of the start, one of `least_squares.METHODS`. usable : (P, K), bool, the values that
    this uses; None: all.
    """

    data: Dataset
    lobes: ggx.Lobes
    left: np.ndarray
    counts: np.ndarray
    seed: int
    start: str
    usable: np.ndarray | None = None

    @property
    def able(self) -> bool:
        """Are there lights enough, so that values are left out that count?"""
        pixels = self.pixels()
        return bool((self.left[pixels] & (self.counts[pixels] > 0)).any())

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
        lights: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Mean deviation of what is predicted from what was left out, of each of its pixels, over their mean values.

        seen, indirect : what the depth of the state hides, (P, K), and reflects, (P, K, 3).
        lights : directions and irradiance, as of `DirectModel.lighting`. If they are given, the state is a start: its
            normals are those that the method of the start finds from what is kept, and stay as they are.
        """
        pixels = self.pixels()
        few = self._few(pixels)
        left, counts, seen = self.left[pixels], self.counts[pixels], seen[pixels]
        kept = (counts * seen * ~left).astype(np.float32)
        indirect = None if indirect is None else indirect[pixels]
        model = DirectModel(few, self.lobes, points=points[pixels], counts=kept, indirect=indirect)
        trial, turn = kind.of(guess.of(pixels), self.lobes), lights is None
        if not turn:
            trial.normals = self._started(few, pixels, trial.exposures, ~left, _of(lights, pixels))
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

    def apart(
        self,
        guess: Guess,
        points: np.ndarray,
        seen: np.ndarray,
        indirect: np.ndarray | None,
        *,
        lights: tuple[np.ndarray, np.ndarray] | None = None,
        pixels: np.ndarray | None = None,
    ) -> np.ndarray:
        """Differences between the normals that one half of the lights tells and those of the other, (W, P', 3), for W
        ways to part the lights: at most as long as those of normals `FAR` apart. NaN where halves do not tell normals.

        pixels : others than its own. The rest is as of `errors`; the material is that of the guess.
        """
        pixels = self.pixels() if pixels is None else pixels
        few, counts = self._few(pixels), (self.counts[pixels] * seen[pixels]).astype(np.float32)
        indirect = None if indirect is None else indirect[pixels]
        model = DirectModel(few, self.lobes, points=points[pixels], counts=counts, indirect=indirect)
        lights = None if lights is None else _of(lights, pixels)

        def found(half: np.ndarray) -> np.ndarray:
            if lights is not None:
                return self._started(few, pixels, guess.exposures, np.broadcast_to(half, counts.shape), lights)
            model.counts = own(counts * half)
            turned = guess.of(pixels)
            model.fit_normals(turned, steps=STEPS)
            return turned.normals

        every, most = [], 2 * np.sin(np.radians(FAR) / 2)
        lit = self.data.lit  # what is without light would spoil the half that it is in
        for first in halves(model.mean_directions()[lit]):
            half, other = np.zeros((2, len(lit)), bool)
            half[lit], other[lit] = first, ~first
            told = np.minimum(*((counts[:, part] > 0).sum(1) for part in (half, other))) >= TELLING
            off = found(half) - found(other)
            off *= np.minimum(1, most / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-12))
            every.append(np.where(told[:, None], off, np.nan))
        return np.array(every)

    def _few(self, pixels: np.ndarray) -> Dataset:
        """The data of some pixels, their numbers ascending."""
        mask = np.zeros_like(self.data.mask)
        mask[tuple(x[pixels] for x in np.nonzero(self.data.mask))] = True
        return replace(self.data, mask=mask, values=self.data.values[pixels], truth=None)

    def _started(
        self,
        few: Dataset,
        pixels: np.ndarray,
        exposures: np.ndarray,
        kept: np.ndarray,
        lights: tuple[np.ndarray, np.ndarray],
    ) -> np.ndarray:
        """Normals of some pixels by the method of the start, from values that are kept. As many are of each pixel."""
        directions, irradiance = lights
        count = kept.sum(1).min()
        chosen = np.argsort(~kept, axis=1, kind="stable")[:, :count]
        values = least_squares.as_at_infinity(few.luminance / exposures, irradiance)
        values = np.take_along_axis(values, chosen, 1)
        at = directions[chosen] if directions.ndim == 2 else np.take_along_axis(directions, chosen[..., None], 1)
        usable = None if self.usable is None else np.take_along_axis(self.usable[pixels], chosen, 1)
        return least_squares.normals(values, at, self.start, usable)


def _of(lights: tuple[np.ndarray, np.ndarray], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions and irradiance at some pixels."""
    directions, irradiance = lights
    return lights if directions.ndim == 2 else (directions[pixels], irradiance[pixels])
