"""Is the direction of a single light wrong? Its image is then explained much better by another direction.

A diffuse surface is known from all other images, and an image of it is linear in its light. So the direction that an
image itself shows follows from three equations. No material is diffuse, and all of these directions are a little off:
one is wrong that is much farther off than the others are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import least_squares, start
from .dataset import angles
from .vectors import unit

#: Images without which too few others tell what one of them should be.
FEWEST = 8

#: How much less of the squared values of an image the other direction must leave, and how many times as far from the
#: given one it must be as is usual in this set (the median).
BETTER, FARTHER = 3.0, 3.0

#: Lights whose directions are less wrong do little harm, degrees.
LEAST = 5.0

#: Images of shallow things hardly depend on the directions of their lights, and so whatever else changes them looks
#: like another direction. The mean square of normals along the axis where it is smallest must be this part of the
#: largest.
SHALLOW = 0.03

#: Part of the values of a pixel, the darkest ones, by which it is not judged whether a light does harm.
DARK = 0.2

#: Of the images, at most this part is taken for wrong: of more, it would not be known which ones are right.
MOST = 0.2


@dataclass(frozen=True)
class Wrong:
    """A light. number : of its image. shown : direction that the image shows. off : angle between this and the given
    direction, degrees. left, least : parts of the squared values of the image that the given one and the shown one
    leave unexplained. harmful : are other images predicted better without it?"""

    number: int
    shown: tuple[float, float, float]
    off: float
    left: float
    least: float
    harmful: bool = True


def judged(products: np.ndarray, lights: np.ndarray) -> list[Wrong]:
    """Those of some lights that are wrong, by number.

    products : mean products of the images, (K, K). lights : directions, (K, 3).
    """
    kept, found = np.arange(len(lights)), []
    while len(kept) >= FEWEST:
        shown = [_shown(products, lights, k, kept[kept != k]) for k in kept]
        usual = np.median([wrong.off for wrong in shown])
        told = [w for w in shown if w.left > BETTER * w.least and w.off > max(FARTHER * usual, LEAST)]
        if not told:
            break
        # One at a time: all others seem a little wrong because of it
        worst = max(told, key=lambda w: w.left / max(w.least, 1e-30))
        kept = kept[kept != worst.number]
        found.append(worst)
    if not found:
        return []
    in_space = np.linalg.matrix_rank(lights[kept], tol=least_squares.PLANE * len(lights)) == 3
    P = np.linalg.pinv(lights[kept])
    least, _, largest = np.linalg.eigvalsh(P @ products[np.ix_(kept, kept)] @ P.T)
    told = in_space and least > SHALLOW * largest and len(found) <= MOST * len(lights)
    return sorted(found, key=lambda w: w.number) if told else []


def _shown(products: np.ndarray, lights: np.ndarray, k: int, others: np.ndarray) -> Wrong:
    """The light that an image shows, of a surface that is known from others."""
    P = np.linalg.pinv(lights[others])  # values of the others to albedo times normal
    M, g, square = P @ products[np.ix_(others, others)] @ P.T, P @ products[others, k], products[k, k]
    direction = np.linalg.lstsq(M, g, rcond=1e-9)[0]
    square = max(square, 1e-30)
    # With any exposure
    left = square - max(g @ lights[k], 0) ** 2 / max(lights[k] @ M @ lights[k], 1e-30)
    off = float(angles(direction, lights[k]))
    return Wrong(int(k), tuple(unit(direction)), off, float(left / square), float((square - g @ direction) / square))


def swapped(wrong: list[Wrong], lights: np.ndarray, pair: tuple[int, int]) -> bool:
    """Do the images of two lights, if both are wrong, show each other's? lights : directions, (K, 3)."""
    others = dict(zip(pair, reversed(pair), strict=True))
    both = [light for light in wrong if light.number in others]
    shows_other = [angles(np.array(w.shown), lights[others[w.number]]) < w.off / FARTHER for w in both]
    return len(both) < 2 or all(shows_other)


def harmful(values: np.ndarray, directions: np.ndarray, wrong: np.ndarray, others: np.ndarray, method: str) -> bool:
    """Are images of other lights, of which a fifth is left out at a time, predicted better from the rest of them than
    from these and the wrong lights, by more than the standard error? Of metal, which no start explains, they may not
    be. wrong, others : numbers of lights. method : one of `least_squares.METHODS`."""
    bright = least_squares.brightest(values[:, others], DARK)
    mean = np.maximum(values.mean(1, keepdims=True), 1e-30)

    def off(added: np.ndarray) -> np.ndarray:
        each = np.zeros(bright.shape)
        for part in range(start.PARTS):
            out = np.arange(len(others)) % start.PARTS == part
            kept = np.append(others[~out], added)
            b = least_squares.METHODS[method](values[:, kept], directions[..., kept, :])
            predicted = np.maximum(least_squares.predicted(b, directions[..., others[out], :]), 0)
            each[:, out] = np.minimum(np.abs(predicted - values[:, others[out]]) / mean, start.MOST)
        return bright * each

    return start.sure(off(wrong) - off(np.array([], int)))
