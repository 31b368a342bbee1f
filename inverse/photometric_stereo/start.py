"""Where a reconstruction starts: checked data, the scale of their values, and a diffuse guess by least squares."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from rimlight import ggx
from rimlight.edge_sampling.refusals import InputError

from . import calibration, least_squares
from .dataset import ALL_BLACK, Dataset
from .direct import DirectModel, Guess
from .rendering import Domain, unlit
from .vectors import unit

if TYPE_CHECKING:
    from .reconstruction import Options

log = logging.getLogger(__name__)

#: Pixels without which there is no surface.
FEWEST = 9


def counts(data: Dataset, level: Dataset, size: float, dark: float) -> np.ndarray:
    """How much values of a level count, (P, K): 0 for the darkest of each pixel, and what is clipped, even in part."""
    clipped = data.clipped
    if size < 1:
        clipped = data.blocks(round(1 / size))[1](clipped.astype(np.float32)) > 0
    return (least_squares.brightest(level.luminance, dark) & ~clipped).astype(np.float32)


def check(data: Dataset) -> None:
    """Raises ValueError for data that tell nothing; logs what makes them tell less."""
    if not data.near:
        least_squares.check_lights(data.lights)
    if not data.values.max() > 0:
        raise InputError(ALL_BLACK)
    if len(data.values) < FEWEST:
        raise InputError(f"ps: the mask has {len(data.values)} pixels, at least {FEWEST} are needed; check mask.png")
    if count := int(unlit(data).sum()):
        log.warning(
            "ps: %d dark pixels at the border of the mask are taken for the background; check mask.png if they are not",
            count,
        )
    if share := data.clipped.mean():
        log.warning(
            "ps: %.2g %% of the values are clipped: they equal the largest one, and do not count; expose less",
            100 * share,
        )


def scale(data: Dataset, options: Options) -> float:
    """By which values are multiplied, so that albedos are those of real things."""
    if not options.brightness:
        return 1.0
    directions, irradiance = flat(data).lighting()
    b = [
        least_squares.trimmed(least_squares.as_at_infinity(data.values[..., c], irradiance), directions)
        for c in range(3)
    ]
    median = max(np.median(np.linalg.norm(x, axis=1)) for x in b)
    # Where more than half of the pixels are black, nothing tells it
    return options.brightness / np.pi / median if median > 0 else 1.0


def flat(data: Dataset) -> DirectModel:
    """Of a plane at the distance of the object, across the view."""
    domain = Domain(data)
    points = domain.points(np.full(domain.wide.sum(), domain.distance))
    return DirectModel(data, ggx.Lobes((np.nan,), (np.nan,)), points=points)


def guess(data: Dataset, lobes: ggx.Lobes, counts: np.ndarray, options: Options) -> Guess:
    """Diffuse, with exposures."""
    plane = flat(data)
    directions, irradiance = plane.lighting()
    values = least_squares.as_at_infinity(data.luminance, irradiance)
    solve = least_squares.METHODS[options.start]
    if data.clipped.any():  # what is too bright is known then, and need not be guessed
        told = least_squares.telling(counts > 0, directions)[:, None]
        solve = lambda values, lights: least_squares.least_squares(values, lights, np.where(told, counts, 1.0))
    exposures = np.ones(plane.K)
    for _ in range(3 if options.exposures else 0):
        predicted = least_squares.predicted(solve(values / exposures, directions), directions)
        exposures *= calibration.exposures(values / exposures, predicted, counts, plane.mean_directions())
    if options.exposures:
        exposures = calibration.with_trend(exposures, values, counts, directions)
    found = solve((values / exposures).astype(np.float64), directions)
    normals, albedo = least_squares.facing(found), np.linalg.norm(found, axis=1)
    weights = np.zeros((len(lobes), 3))
    colour = (data.values / exposures[:, None]).mean((0, 1)) / (data.luminance / exposures).mean()
    weights[np.isnan(lobes.eta)] = np.minimum(np.pi * np.median(albedo) * colour, 1)
    return Guess(normals, np.ones(len(values)), exposures, weights)


def refined(guess: Guess, domain: Domain, data: Dataset, *, before: int, now: int) -> Guess:
    """A guess taken to larger images. domain : of the guess. before, now : sides of their pixels, in those of the
    data."""
    rows, columns = np.nonzero(data.mask)
    pixels = np.c_[guess.normals, guess.albedo, np.empty((len(guess.albedo), 0)) if guess.base is None else guess.base]
    padded = np.zeros((*domain.wide.shape, pixels.shape[1]))
    padded[domain.wide] = pixels[domain.nearest]
    _, nearest = ndimage.distance_transform_edt(~domain.wide, return_indices=True)
    padded = padded[nearest[0], nearest[1]]
    centre = lambda i: (now * i + (now - before) / 2) / before + 1  # the domain is larger by a pixel
    at = [centre(rows), centre(columns)]
    fine = [ndimage.map_coordinates(padded[..., i], at, order=1, mode="nearest") for i in range(padded.shape[2])]
    base = None if guess.base is None else np.stack(fine[4:], 1)
    albedo = fine[3] if base is None else np.round(fine[3])  # of a glaze: there is one, or there is none
    return replace(guess, normals=unit(np.stack(fine[:3], 1)), albedo=albedo, base=base)
