"""Are the data what their files say? What would make a result wrong without a word, told from the values alone."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from . import axes, black_level, files, least_squares, lights_order, start, wrong_lights
from .axes import Axes
from .black_level import BlackLevel
from .dataset import LUMINANCE, Dataset, angles
from .lights_order import Order
from .rendering import unlit
from .wrong_lights import Wrong

log = logging.getLogger(__name__)

#: Pixels from which this is judged, at most and at least.
PIXELS, FEWEST = 5000, 100


#: Said of an image whose light is wrong.
_LEFT_OUT = "The image is left out of a reconstruction."
_KEPT = "The image is kept in a reconstruction, for other images are not predicted better without it."

#: Pictures are the same whose values differ at most by this part of the largest one: noise alone makes more. Their
#: lights differ if they are more than so many degrees apart.
SAME, APART = 1e-5, 1.0


@dataclass(frozen=True)
class Plausibility:
    """file : of the lights. copies : names of pictures that are the same, though their lights differ, by how many
    degrees. names : of the images. wrong : lights in wrong directions."""

    file: str = files.DIRECTIONS
    order: Order = field(default_factory=Order)
    axes: Axes = field(default_factory=Axes)
    black_level: BlackLevel = field(default_factory=BlackLevel)
    copies: tuple[tuple[str, str, float], ...] = ()
    names: Sequence[str] = ()
    wrong: tuple[Wrong, ...] = ()

    def rows(self) -> list[tuple[str, str]]:
        """What, and how much."""
        return [
            ("order of the lights", str(self.order)),
            ("axes of the lights", str(self.axes)),
            ("black level", str(self.black_level)),
        ]

    def said(self) -> list[str]:
        """Warnings, with what to do, in sentences. Of lights in another order, axes tell nothing."""
        of_axes = [] if self.order.wrong else self.axes.said(self.file)
        copies = [
            f"The pictures {first} and {second} are the same, though their lights are {apart:.0f} degrees apart. Put "
            "the right picture in the place of the copy, or take the copy and its light out."
            for first, second, apart in self.copies
        ]
        wrong = [
            f"The light of {self.names[w.number]} seems to be listed in a wrong direction: another one, {w.off:.0f} "
            f"degrees away, explains all but {100 * w.least:.2g} % of its squared values, the listed one all but "
            f"{100 * w.left:.2g} %. {_LEFT_OUT if w.harmful else _KEPT} Correct line {w.number + 1} of "
            f"{self.file}, or take the image out."
            for w in self.wrong
        ]
        return [*copies, *self.order.said(self.file), *wrong, *of_axes, *self.black_level.said()]


def judged(data: Dataset, method: str = "trimmed") -> Plausibility:
    """Of a data set. What it takes grows with its values: see `block`. method : of the start, as of `Options.start`,
    which says if lights in wrong directions do harm."""
    file = files.LEDS if data.near else files.DIRECTIONS
    shown, lit = ~unlit(data), np.flatnonzero(data.lit)
    if shown.sum() < FEWEST or len(lit) < 3:
        return Plausibility(file)
    mask = data.mask.copy()
    mask[mask] = shown
    data = replace(data, values=data.values[shown], mask=mask, truth=None)
    plane = start.flat(data)
    (directions, irradiance), lights = plane.lighting(), plane.mean_directions()
    if lights[:, 2].max() <= 0 or np.linalg.matrix_rank(lights[lit], tol=least_squares.PLANE * len(lights)) < 3:
        return Plausibility(file)
    values = least_squares.as_at_infinity(data.luminance, irradiance)
    found = least_squares.trimmed(values[:, lit].astype(np.float64), directions[..., lit, :])
    pictured = (data.values * data.intensities.astype(np.float32)) @ LUMINANCE
    names = data.names or [f"image {k + 1}" for k in range(len(lights))]
    order, wrong = lights_order.judged(values, lights, names, lit), []
    if np.isfinite(order.chance) and not order.wrong:
        wrong = _wrong(values, lights, directions, lit, method)
        if order.swapped is not None and not wrong_lights.swapped(wrong, lights, order.swapped[:2]):
            order = replace(order, swapped=None)
    return Plausibility(
        file,
        order,
        axes.judged(data, least_squares.facing(found)) if len(lit) >= axes.FEWEST else Axes(),
        black_level.judged(pictured[:, lit], black_level.away(found, directions[..., lit, :])),
        _copies(pictured, lights, names, lit),
        names,
        tuple(wrong) if order.known else (),
    )


def _wrong(values: np.ndarray, lights: np.ndarray, directions: np.ndarray, lit: np.ndarray, method: str) -> list[Wrong]:
    """Lights in wrong directions, numbered as of all images. As of `lights_order.judged`.

    directions : of all lights, at each pixel if they are near. method : as of `judged`.
    """
    found = wrong_lights.judged(lights_order.products(values[:, lit]), lights[lit])
    numbers = np.array([lit[wrong.number] for wrong in found], int)
    of_wrong = numbers, np.setdiff1d(lit, numbers)
    harmful = bool(found) and wrong_lights.harmful(values.astype(np.float64), directions, *of_wrong, method)
    return [replace(w, number=int(k), harmful=harmful) for w, k in zip(found, numbers, strict=True)]


def _copies(
    pictured: np.ndarray, lights: np.ndarray, names: Sequence[str], lit: np.ndarray
) -> tuple[tuple[str, str, float], ...]:
    """Each picture that is a copy, with the first one that it equals. pictured : (P, K). lit : numbers of those that
    are looked at."""
    found, tolerance = {}, SAME * pictured.max()
    for i, k in enumerate(lit):
        off = np.abs(pictured[:, lit[i + 1 :]] - pictured[:, k, None]).max(0)
        for j in lit[i + 1 :][off <= tolerance]:
            if (apart := float(angles(lights[k], lights[j]))) > APART:
                found.setdefault(j, (names[k], names[j], apart))
    return tuple(found.values())


def checked(data: Dataset, method: str = "trimmed") -> Dataset:
    """A data set of any size without the images whose lights are wrong and do harm, and with its doubts, which are
    logged. method : as of `judged`."""
    step = block(len(data.values))
    found = judged(data.at(1 / step), method) if data.blocks(step)[0].any() else Plausibility()
    for text in (said := found.said()):
        log.warning("ps: %s", text)
    data = replace(data, doubts=(*data.doubts, *said))
    harmful = [wrong.number for wrong in found.wrong if wrong.harmful]
    return data.without(harmful) if harmful else data


def block(pixels: int) -> int:
    """How wide blocks of pixels must be, so that at most about `PIXELS` are left of so many."""
    return max(int(np.ceil(np.sqrt(pixels / PIXELS))), 1)
