"""Where a reconstruction starts: checked data, the scale of their values, and a diffuse guess by least squares."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from rimlight import ggx
from rimlight.edge_sampling.refusals import InputError

from . import calibration, glossy, least_squares
from .dataset import ALL_BLACK, Dataset
from .direct import DirectModel, Guess
from .rendering import Domain, unlit
from .vectors import unit

if TYPE_CHECKING:
    from .reconstruction import Options

log = logging.getLogger(__name__)

#: Pixels without which there is no surface.
FEWEST = 9

#: Fits of albedos and of the BSDF, in turns, to the normals of a glossy surface.
SETTLING = 4

#: Pixels from which it is told whether clipped values are of use, at most, and parts of the lights that are left out
#: in turns for that. Deviations count at most so much, of the mean value of the pixel.
JUDGED, PARTS, MOST = 1000, 5, 0.5


def clipped(data: Dataset, size: float) -> np.ndarray:
    """Which values of a level are clipped, even in part: (P, K), bool."""
    return data.clipped if size == 1 else data.blocks(round(1 / size))[1](data.clipped.astype(np.float32)) > 0


def counts(data: Dataset, level: Dataset, size: float, dark: float) -> np.ndarray:
    """How much values of a level count, (P, K): 0 for the darkest of each pixel, for what is clipped, even in part, and
    for images without light."""
    bright = least_squares.brightest(level.luminance, dark)
    return (bright & ~clipped(data, size) & level.lit).astype(np.float32)


def method(data: Dataset, level: Dataset, size: float, options: Options) -> tuple[str, np.ndarray | None]:
    """By which method the start of a level is found, and from which values, (P, K), bool, or from all (None).

    It is that of the options, from all values, unless some are clipped. Then it may be from those that are not clipped,
    or not dark either; and least squares from these, for what is too bright is known then. But few may be left, or
    those in shadow. So a fifth of the lights after the other is left out, and what predicts their values best is taken,
    if it is better than the first by more than the standard error of this difference: of the pixels and of the lights,
    for deviations that all pixels have in common under one light say as much as one.
    """
    given = options.start, None
    if not data.clipped.any() or level.values.shape[1] <= least_squares.FEWEST:
        return given
    pixels = np.unique(np.linspace(0, len(level.values) - 1, JUDGED).astype(int))
    directions, irradiance = flat(level).lighting()
    values = least_squares.as_at_infinity(level.luminance, irradiance)[pixels].astype(np.float64)
    directions = directions if directions.ndim == 2 else directions[pixels]
    lit, over = least_squares.brightest(level.luminance, options.dark), clipped(data, size)
    usable = ~over, lit & ~over
    mean = np.maximum(values.mean(1, keepdims=True), 1e-30)

    def off(name: str, used: np.ndarray | None) -> np.ndarray:
        each = np.zeros(values.shape)
        for part in range(PARTS):
            out = np.arange(values.shape[1]) % PARTS == part
            lights = directions[..., ~out, :]
            weights = None if used is None else least_squares.weights_of(used[pixels][:, ~out], lights)
            b = least_squares.METHODS[name](values[:, ~out], lights, weights)
            predicted = np.maximum(least_squares.predicted(b, directions[..., out, :]), 0)
            more = predicted - values[:, out]
            more[over[pixels][:, out] & (more > 0)] = 0  # what is clipped may have been brighter
            each[:, out] = lit[pixels][:, out] * np.minimum(np.abs(more) / mean, MOST)
        return each

    first = off(*given)
    names = dict.fromkeys((options.start, "least squares"))
    gains = {(name, k): first - off(name, used) for name in names for k, used in enumerate(usable)}
    (name, k), gain = max(gains.items(), key=lambda item: item[1].sum())
    return (name, usable[k]) if sure(gain) else given


def sure(gain: np.ndarray) -> bool:
    """Is the sum of what deviations are less by, (P, K), more than its standard error: of the pixels, and of the
    lights?"""
    return bool(gain.sum() > np.sqrt(sum(total.size * total.var() for total in (gain.sum(0), gain.sum(1)))))


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


def scale(data: Dataset, lobes: ggx.Lobes, options: Options) -> float:
    """By which values are multiplied, so that albedos are those of real things."""
    if not options.brightness:
        return 1.0
    plane = flat(data)
    directions, irradiance = plane.lighting()
    b = [
        least_squares.trimmed(least_squares.as_at_infinity(data.values[..., c], irradiance), directions)
        for c in range(3)
    ]
    median = max(np.median(np.linalg.norm(x, axis=1)) for x in b)
    if not median > 0:  # where more than half of the pixels are black, nothing tells it
        return 1.0
    found = options.brightness / np.pi / median
    if np.isnan(lobes.alpha).all():
        return found
    pixels = np.unique(np.linspace(0, len(data.values) - 1, JUDGED).astype(int))
    values = least_squares.as_at_infinity(data.luminance, irradiance)[pixels]
    counts = least_squares.brightest(values, options.dark)
    # Of metal, little is diffuse, and highlights would need weights of lobes that sum to more than 1
    needed = np.median(glossy.search(found * values, counts, plane.mean_directions())[1])
    eta = np.nanmax(lobes.eta)
    return found / max(needed * ((eta + 1) / (eta - 1)) ** 2, 1)


def flat(data: Dataset) -> DirectModel:
    """Of a plane at the distance of the object, across the view."""
    domain = Domain(data)
    points = domain.points(np.full(domain.wide.sum(), domain.distance))
    return DirectModel(data, ggx.Lobes((np.nan,), (np.nan,)), points=points)


def guess(
    data: Dataset,
    lobes: ggx.Lobes,
    counts: np.ndarray,
    options: Options,
    of: tuple[str, np.ndarray | None] | None = None,
) -> Guess:
    """Diffuse, with exposures. of : as of `method`; default: the method of the options, from all values."""
    plane = flat(data)
    directions, irradiance = plane.lighting()
    values = least_squares.as_at_infinity(data.luminance, irradiance)
    name, usable = of or (options.start, None)
    counted = least_squares.weights_of(usable, directions)
    solve = lambda values, lights: least_squares.METHODS[name](values, lights, counted)
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


def glossy_guess(data: Dataset, lobes: ggx.Lobes, counts: np.ndarray, guess: Guess) -> Guess:
    """Another one, with the normals of a glossy surface and the material that explains the values with them."""
    plane = flat(data)
    values = least_squares.as_at_infinity(data.luminance, plane.lighting()[1]) / guess.exposures
    normals = glossy.search(values, counts, plane.mean_directions())[0]
    # Beside a diffuse material, highlights would be outliers, and stay so: begin with all glossy lobes
    weights = np.repeat(~np.isnan(lobes.alpha)[:, None] / len(lobes), 3, axis=1)
    found = replace(guess, normals=normals, albedo=np.ones(len(normals)), weights=weights)
    model = DirectModel(data, lobes, points=np.array(plane.points).reshape(-1, 3), counts=counts)
    for _ in range(SETTLING):
        model.fit_normals(found, steps=1, turn=False)
        found.albedo /= np.median(found.albedo)
        model.fit_bsdf(found, np.random.default_rng(0), turn=False)
    return found


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
