"""What is taken back to the start: where normals of a result depend more on which lights tell them than those of the
start do."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from scipy import ndimage

from .alternation import Alternations, State, View
from .direct import DirectModel
from .vectors import unit

#: Pixels at which this is judged, at most; and at a time, for memory.
JUDGED, BLOCK = 10000, 2**12

#: Standard deviation of the Gaussian by which what is judged is smoothed, pixels, if all are judged.
WIDTH = 6.0

#: How sharply it is decided: the power of the ratio of both angles. Shares of the start that are less stay out.
SHARPNESS, LEAST = 8, 0.05


def taken_back(
    work: Alternations, best: State, start: State, lights: tuple[np.ndarray, np.ndarray], view: View
) -> tuple[State, float]:
    """A state whose normals are those of the best one or of the start, whichever of one half of the lights agree better
    with those of the other, nearby, with blends between; and the part of the surface that is the start's.

    work : of the kind of the best state. lights : as of `Judge.errors`. view : of the best state.
    """
    P = len(best.guess.normals)
    pixels = np.sort(np.random.default_rng([work.judge.seed, 20]).choice(P, min(JUDGED, P), replace=False))
    both = np.empty((2, len(pixels)))
    for i in range(0, len(pixels), BLOCK):
        of_view = {"points": view.points, "seen": view.seen, "pixels": pixels[i : i + BLOCK]}
        both[0, i : i + BLOCK] = work.judge.disagreement(start.guess, indirect=None, lights=lights, **of_view)
        both[1, i : i + BLOCK] = work.judge.disagreement(best.guess, indirect=view.indirect, **of_view)
    told = np.isfinite(both[0])
    width = WIDTH * np.sqrt(P / len(pixels))
    of_start, of_best = (_nearby(x[told], pixels[told], work.data.mask, width) for x in both)
    # Where nothing is told nearby, both are 0, and the best state stays
    largest = np.maximum(np.maximum(of_start, of_best), 1e-12)
    against, in_favour = (of_best / largest) ** SHARPNESS, (of_start / largest) ** SHARPNESS
    share = np.divide(against, against + in_favour, out=np.zeros(P), where=against + in_favour > 0)
    share[share < LEAST] = 0
    if not share.any():
        return best, 0.0
    state = replace(best, guess=copy.deepcopy(best.guess))
    state.guess.normals = unit((1 - share)[:, None] * best.guess.normals + share[:, None] * start.guess.normals)
    counts = (work.judge.counts * view.seen).astype(np.float32)
    model = DirectModel(work.data, work.lobes, points=view.points, counts=counts, indirect=view.indirect)
    model.fit_normals(state.guess, steps=2, free_albedo=work.options.albedo, turn=False)
    state.depth = work.integrate(state.guess)
    return state, float(share.mean())


def _nearby(numbers: np.ndarray, pixels: np.ndarray, mask: np.ndarray, width: float) -> np.ndarray:
    """Gaussian means, (P,), of numbers of some pixels of the mask."""
    rows, columns = (x[pixels] for x in np.nonzero(mask))
    total, weight = np.zeros(mask.shape), np.zeros(mask.shape)
    total[rows, columns], weight[rows, columns] = numbers, 1
    total, weight = (ndimage.gaussian_filter(x, width)[mask] for x in (total, weight))
    return np.divide(total, weight, out=np.zeros(len(total)), where=weight > 1e-9)
