"""What is taken back to the start: where normals of a result depend so much on which lights tell them that those of the
start tell something beside them."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from scipy import ndimage

from .alternation import Alternations, State, View
from .direct import DirectModel
from .evidence import mean_angle
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
    with those of the other, nearby, with blends between; with at least the share of the start `of_the_whole`. And the
    mean share of the start.

    work : of the kind of the best state. lights : as of `Judge.errors`. view : of the best state.
    """
    P = len(best.guess.normals)
    pixels = np.sort(np.random.default_rng([work.judge.seed, 20]).choice(P, min(JUDGED, P), replace=False))
    both, products = np.empty((2, len(pixels))), np.zeros(3)
    for i in range(0, len(pixels), BLOCK):
        of_view = {"points": view.points, "seen": view.seen, "pixels": pixels[i : i + BLOCK]}
        s = work.judge.apart(start.guess, indirect=None, lights=lights, **of_view)
        b = work.judge.apart(best.guess, indirect=view.indirect, **of_view)
        both[:, i : i + BLOCK] = mean_angle(s), mean_angle(b)
        products += [np.nansum(x) for x in (s * s, s * b, b * b)]
    told = np.isfinite(both[0])
    width = WIDTH * np.sqrt(P / len(pixels))
    of_start, of_best = (_nearby(x[told], pixels[told], work.data.mask, width) for x in both)
    # Where nothing is told nearby, both are 0, and the best state stays
    largest = np.maximum(np.maximum(of_start, of_best), 1e-12)
    against, in_favour = (of_best / largest) ** SHARPNESS, (of_start / largest) ** SHARPNESS
    share = np.divide(against, against + in_favour, out=np.zeros(P), where=against + in_favour > 0)
    share[share < LEAST] = 0
    share = np.maximum(share, of_the_whole(*products))
    if not share.any():
        return best, 0.0
    state = replace(best, guess=copy.deepcopy(best.guess))
    state.guess.normals = unit((1 - share)[:, None] * best.guess.normals + share[:, None] * start.guess.normals)
    counts = (work.judge.counts * view.seen).astype(np.float32)
    model = DirectModel(work.data, work.lobes, points=view.points, counts=counts, indirect=view.indirect)
    model.fit_normals(state.guess, steps=2, free_albedo=work.options.albedo, turn=False)
    state.depth = work.integrate(state.guess)
    return state, float(share.mean())


def of_the_whole(ss: float, sb: float, bb: float) -> float:
    """Share of the start in the mean of start and best state of which the halves agree best (Bates and Granger 1969).

    ss, sb, bb : sums over products of the differences between their halves, of the start with itself, with the best
    state, and of that with itself: how large their errors are, and how far they are the same.
    """
    return float(np.clip((bb - sb) / (ss + bb - 2 * sb), 0, 1)) if bb > sb else 0.0


def _nearby(numbers: np.ndarray, pixels: np.ndarray, mask: np.ndarray, width: float) -> np.ndarray:
    """Gaussian means, (P,), of numbers of some pixels of the mask."""
    rows, columns = (x[pixels] for x in np.nonzero(mask))
    total, weight = np.zeros(mask.shape), np.zeros(mask.shape)
    total[rows, columns], weight[rows, columns] = numbers, 1
    total, weight = (ndimage.gaussian_filter(x, width)[mask] for x in (total, weight))
    return np.divide(total, weight, out=np.zeros(len(total)), where=weight > 1e-9)
