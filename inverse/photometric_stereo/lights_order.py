"""Are the lights listed in the order of the images?

The values of a pixel under K lights are `lights @ b` if it is diffuse, so the values of all pixels lie in the space
that the three columns of `lights` span, and in another order of the lights they do not. What they leave unexplained is
compared with what they leave in other orders. It need not be small, for no material is diffuse: an order is as good as
any only if many others leave as little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Images without which too few orders differ.
FEWEST = 6

#: Values above this quantile of their pixel count as that: highlights would outweigh all others.
CAPPED = 0.8

#: Of what is not common to all images, two more dimensions must explain at least this part, as normals do of a diffuse
#: surface: else the images do not tell the order of their lights, such as those of chrome, nearly all of it black.
TOLD = 0.2

#: And normals must differ: if they change the squared values by less than this part, as those of a flat painting, then
#: lights of other exposures, or near ones, look like lights in other directions.
FLAT = 0.005

#: Random orders with which the given one is compared, and the largest part of them that may explain values as well.
ORDERS, CHANCE = 300, 0.05

#: Orders that span nearly the same space (three minus the squared cosines between both) predict the same: they are not
#: compared. A square of lights that is turned by a right angle is such an order.
SAME = 0.1

#: An order that people make by mistake is taken for the right one if the given one leaves so much more unexplained, and
#: if all others predict so large a part of the images better.
BETTER, MOST = 1.2, 0.7

#: How much better others must predict the squared values of two images whose lights are taken to be swapped.
SWAPPED = 3.0

#: Swaps are looked at that explain most, so many.
TRIED = 20


@dataclass(frozen=True)
class Order:
    """names : of the images. chance : part of random orders that explain the values as well as the given one; NaN where
    it is not told. unexplained : part of the squared values. mistake : an order that leaves much less, in words, and
    how much. swapped : numbers of two lights, and how far their images are off what the others predict, now and
    then."""

    names: Sequence[str] = ()
    chance: float = np.nan
    unexplained: float = np.nan
    mistake: tuple[str, float] | None = None
    swapped: tuple[int, int, float, float] | None = None

    @property
    def wrong(self) -> bool:
        """As a whole."""
        return self.mistake is not None or self.chance > CHANCE

    @property
    def known(self) -> bool:
        """Does nothing tell against it? What else is estimated needs the lights."""
        return not self.wrong and self.swapped is None

    def __str__(self) -> str:
        if np.isnan(self.chance):
            return "not judged, too few images, or hardly any light"
        return (
            f"{100 * self.unexplained:.2g} % of the squared values unexplained, in {100 * self.chance:.0f} % of random "
            "orders as little"
        )

    def said(self, file: str) -> list[str]:
        """Warnings. file : of the lights."""
        if self.mistake is not None:
            words, less = self.mistake
            return [
                f"The lights seem to be listed {words}: put right, they explain all but {100 * less:.1f} % of the "
                f"squared values, in their order in {file} all but {100 * self.unexplained:.1f} %. Line k there must "
                "belong to image k."
            ]
        if self.wrong:
            return [
                "The lights are probably in another order than the images, or wrong: in "
                f"{100 * self.chance:.0f} % of random orders they explain the values as well. Line k of {file} must "
                "belong to image k."
            ]
        if self.swapped is not None:
            i, j, now, then = self.swapped
            return [
                f"The lights of {self.names[i]} and {self.names[j]} seem to be swapped: the other images predict these "
                f"two with errors of {100 * now:.0f} %, swapped of {100 * then:.0f} %. Exchange their lines in {file}."
            ]
        return []


def judged(values: np.ndarray, lights: np.ndarray, names: Sequence[str], lit: np.ndarray | None = None) -> Order:
    """values : (P, K), luminances as of lights at infinity. lights : directions, (K, 3). names : of the images. lit :
    numbers of the images that count, default all."""
    lit = np.arange(len(lights)) if lit is None else lit
    if len(lit) < FEWEST:
        return Order(names)
    C, rng = products(values[:, lit]), np.random.default_rng(0)
    if C is None:
        return Order(names)
    *_, third, second, first = np.linalg.eigvalsh(C)
    if second + third < max(TOLD * (1 - first), FLAT):
        return Order(names)
    projector = lambda order: _projector(lights[order[lit]])
    A = projector(np.arange(len(lights)))
    given, off, others, mistakes = 1 - (C * A).sum(), _off(C, A), [], []
    for words, order in [("", rng.permutation(len(lights))) for _ in range(ORDERS)] + _mistakes(len(lights)):
        B = projector(order)
        if 3 - (A * B).sum() < SAME:
            continue
        unexplained = 1 - (C * B).sum()
        if not words:
            others.append(unexplained)
        elif BETTER * unexplained < given and np.mean(_off(C, B) < off) >= MOST:
            mistakes.append((unexplained, words))
    # Of turns of the rig, which explain alike, the first
    least = BETTER * min(mistakes)[0] if mistakes else 0
    mistake = next(((words, unexplained) for unexplained, words in mistakes if unexplained <= least), None)
    return Order(
        names,
        chance=float(np.mean(np.array(others) <= given)) if others else np.nan,
        unexplained=float(given),
        mistake=mistake,
        swapped=_swapped(C, A, lit),
    )


def products(values: np.ndarray) -> np.ndarray | None:
    """Mean products of the images, (K, K), of trace 1; None if all pixels are black in most images. All pixels count
    alike, and highlights little."""
    v = values / np.maximum(values.mean(1, keepdims=True), 1e-12 * max(values.max(), 1e-30))
    v = np.minimum(v, np.quantile(v, CAPPED, axis=1, keepdims=True))
    C = v.T.astype(np.float64) @ v
    return C / np.trace(C) if C.any() else None


def _projector(lights: np.ndarray) -> np.ndarray:
    """On the space of what diffuse pixels show, (K, K)."""
    Q, _ = np.linalg.qr(lights)
    return Q @ Q.T


def _mistakes(K: int) -> list[tuple[str, np.ndarray]]:
    """Orders in which people list lights by mistake, the simplest first: in words, and which light belongs to each
    image."""
    k = np.arange(K)
    found = [("in reverse", k[::-1])]
    text = np.array(sorted(range(K), key=lambda i: str(i + 1)))
    if (text != k).any():
        found.append(("by number, and the images by their names as text (1, 10, 11, 2)", text))
        found.append(("by their names as text (1, 10, 11, 2), and the images by number", np.argsort(text)))
    for shift in sorted(range(1, K), key=lambda shift: min(shift, K - shift)):
        places = "a place" if (count := min(shift, K - shift)) == 1 else f"{count} places"
        found.append((f"{places} too {'late' if shift <= K // 2 else 'early'}", np.roll(k, -shift)))
    return found


def _swapped(C: np.ndarray, A: np.ndarray, lit: np.ndarray) -> tuple[int, int, float, float] | None:
    """Two lights with which swapped both of their images are predicted much better from all others. lit : numbers of
    the images."""
    gain, off, best, found = gains(C, A), _off(C, A), SWAPPED, None
    pairs = np.dstack(np.unravel_index(np.argsort(np.triu(gain, 1), axis=None)[::-1][:TRIED], gain.shape))[0]
    for i, j in pairs:
        if gain[i, j] <= 0 or i >= j:
            continue
        order = np.arange(len(C))
        order[[i, j]] = j, i
        then = _off(C, A[np.ix_(order, order)])
        if (ratio := min(off[i] / then[i], off[j] / then[j])) > best:
            best = ratio
            found = int(lit[i]), int(lit[j]), float(np.sqrt(max(off[i], off[j]))), float(np.sqrt(max(then[i], then[j])))
    return found


def gains(C: np.ndarray, A: np.ndarray) -> np.ndarray:
    """By how much more is explained, the sum of `C * A`, with two of the lights swapped: (K, K)."""
    X, c, a = C @ A, np.diag(C), np.diag(A)
    of_others = X + X.T - np.diag(X)[:, None] - np.diag(X)
    of_others -= (c[:, None] - C) * (A - a[:, None]) + (C - c) * (a - A)
    return 2 * of_others + (c[:, None] - c) * (a - a[:, None])


def _off(C: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Squared deviation of each image from its prediction by all others, over its squared values: (K,)."""
    R = np.eye(len(A)) - A
    return np.diag(R @ C @ R) / np.maximum(1 - np.diag(A), 1e-9) ** 2 / np.maximum(np.diag(C), 1e-30)
