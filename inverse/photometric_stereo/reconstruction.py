"""Shape and reflectance from photometric stereo (Bangaru 2019, algorithm 1), with the inner problems solved directly.

In turns: the BSDF, the normals and albedos, and the exposures of the images, given what surfaces hide and what they
reflect on each other; then depth from normals, and from it the shadows and interreflections, by path tracing. Each
alternation makes the interreflections of a better surface, and so on (Nayar et al. 1991), from coarse images to fine.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy import ndimage
from tqdm import tqdm

from rimlight import ggx

from . import calibration, least_squares
from .dataset import LUMINANCE, Dataset, angles, unit
from .direct import DirectModel, Guess
from .refinement import Descent, descend
from .rendering import Domain, Rendering

#: Share of the newest interreflections in their running mean.
AVERAGED = 0.25

#: Exposures that seem to be off by less (logarithm) are taken as stated: shapes and BSDFs explain so much as well.
STATED = 0.02

#: Alternations before a coat is thought of: with the normals of the start, anything may look like one.
SETTLED = 3

#: Fits of the BSDF and of normals in turns, in each alternation: rendering takes longer.
INNER = 3


@dataclass(frozen=True, kw_only=True)
class Options:
    """How shape and reflectance are reconstructed.

    Raises
    ------
    ValueError : an option is out of its range.
    """

    start: Literal["least squares", "trimmed", "reweighted"] = "trimmed"
    """Normals at the start."""
    reflectance: bool = True
    """Fit the BSDF. Otherwise the surface is Lambertian, and only its colour is fitted."""
    coat: bool | None = None
    """May light be diffuse under a smooth coat, as that of plastics? Default: if there is strong evidence."""
    albedo: bool = True
    """A factor of the BSDF for each pixel."""
    exposures: bool = True
    """Estimate the exposure of each image."""
    dark: float = 0.2
    """Part of the values of each pixel, the darkest, that do not count."""
    shadows: bool = True
    """Leave out values in shadows that the surface itself casts."""
    max_depth: int = 3
    """Longest path: 2 is direct light, 3 adds one interreflection."""
    spp: int = 8
    """Samples per pixel of interreflections."""
    smoothing: float = 1.5
    """Interreflections are smoothed over so many pixels (standard deviation), since normals inherit their noise."""
    resolutions: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Sizes of the images, relative to the data."""
    iterations: tuple[int, ...] = (10, 6, 4)
    """Alternations at each of them, at most."""
    tolerance: float = 0.02
    """Alternations end when normals turn by less than this in the mean, degrees."""
    descent: Descent = dataclasses.field(default_factory=Descent)
    """Steps along derivatives of path-traced images, after the last alternation."""
    bilateral: float | None = None
    """Sharpness of discontinuities of depth; see `integrate`."""
    brightness: float = 0.6
    """Albedo of the brightest colour of a median pixel, where the scale of the images is unknown: from it follow the
    interreflections. 0: the scale is known, values are radiances under lights of irradiance 1 (times intensity)."""
    seed: int = 0
    """Of all random numbers."""

    def __post_init__(self):
        if len(self.resolutions) != len(self.iterations) or not self.resolutions:
            raise ValueError(
                f'ps: "resolutions" and "iterations" must be as many, got {self.resolutions}, {self.iterations}'
            )
        if self.start not in least_squares.METHODS:
            raise ValueError(f'ps: "start" must be one of {", ".join(least_squares.METHODS)}, got {self.start}')
        if min(self.iterations) < 1:
            raise ValueError(f'ps: "iterations" must be at least 1 each, got {self.iterations}')
        if not all(0 < r <= 1 and 1 / r == round(1 / r) for r in self.resolutions):
            raise ValueError(f'ps: "resolutions" must be 1 or 1 over a whole number, got {self.resolutions}')
        if not 0 <= self.dark < 1:
            raise ValueError(f'ps: "dark" must be in [0, 1), got {self.dark}')
        if self.max_depth < 2 or self.spp < 1 or not 0 <= self.smoothing < np.inf:
            raise ValueError(
                'ps: "max_depth" must be at least 2, "spp" 1 and "smoothing" 0, got '
                f"{self.max_depth}, {self.spp}, {self.smoothing}"
            )


@dataclass
class Result:
    """normals : (P, 3). depth : (Q,), of the pixels of `domain`. weights : (B, 3), with `scale` the BSDF of the images.
    history : for each alternation, the size of the images, seconds since the start, the root mean square residual over
    the median value, and where the truth is known the mean angular error, degrees."""

    data: Dataset
    lobes: ggx.Lobes
    guess: Guess
    depth: np.ndarray
    domain: object
    start: np.ndarray
    scale: float
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def error(self) -> float | None:
        """Mean angular error, degrees."""
        return None if self.data.truth is None else float(angles(self.guess.normals, self.data.truth).mean())


def reconstruct(
    data: Dataset, options: Options | None = None, *, progress: bool = True, after: Callable | None = None
) -> Result:
    """Normals, depth and reflectance of a data set.

    after : called with the result so far after each alternation.
    """
    options, begin = options or Options(), time.perf_counter()
    lobes, _ = ggx.read_dictionary()
    if not options.reflectance:
        lobes = ggx.Lobes((np.nan,), (np.nan,))
    rng = np.random.default_rng(options.seed)
    scale = _scale(data.at(options.resolutions[0]), options)
    result: Result | None = None
    coarse, rendering = 1, None
    bar = tqdm(total=sum(options.iterations) + options.descent.steps, desc="ps", disable=not progress)

    def record(size: float, residual: float) -> None:
        result.seconds = time.perf_counter() - begin
        entry = {"size": size, "seconds": result.seconds, "residual": residual}
        if result.data.truth is not None:
            entry["error"] = result.error
        result.history.append(entry)
        bar.set_postfix({k: f"{v:.3g}" for k, v in entry.items() if k != "seconds"})
        bar.update()
        if after is not None:
            after(result)

    for size, most in zip(options.resolutions, options.iterations, strict=True):
        level = data.at(size)
        level = dataclasses.replace(level, values=level.values * np.float32(scale))
        counts = (least_squares.ranks(level.luminance) >= options.dark).astype(np.float32)
        del rendering  # and so its BSDF: see `Rendering`
        rendering = Rendering(level, lobes, max_depth=options.max_depth)
        model = DirectModel(level, lobes, counts=counts)
        if result is None:
            guess = _start(level, lobes, counts, options)
            result = Result(level, lobes, guess, np.empty(0), rendering.domain, guess.normals, scale)
        else:
            _refine(result, level, before=coarse, now=round(1 / size))
            guess = result.guess
        result.data, result.domain, coarse = level, rendering.domain, round(1 / size)
        result.depth = rendering.domain.integrate(guess.normals, options.bilateral)
        indirect = None
        for i in range(most):
            before = guess.normals
            rendering.update(guess, result.depth)
            if options.max_depth > 2:
                # The mean of the last ones: less noise, and as the surface hardly changes, hardly older
                new = rendering.indirect(spp=options.spp, seed=int(rng.integers(2**31)))
                _smooth(new, level.mask, options.smoothing)
                if indirect is None:
                    indirect = new
                else:
                    new -= indirect
                    new *= max(1 / (i + 1), AVERAGED)
                    indirect += new
                del new
            seen = counts * rendering.visible(model) if options.shadows else counts
            points = rendering.domain.points(result.depth)
            model = DirectModel(level, lobes, points=points, counts=seen, indirect=indirect)
            coat = False if options.coat is None and len(result.history) < SETTLED else options.coat
            for _ in range(INNER):
                model.fit_bsdf(guess, rng, coat=coat)
                model.fit_normals(guess, steps=2, free_albedo=options.albedo)
            residual = _exposures(model, guess, level, seen, rng, options)
            result.depth = rendering.domain.integrate(guess.normals, options.bilateral)
            turned = float(angles(before, guess.normals).mean())
            record(size, residual)
            if turned < options.tolerance:
                break
    if options.descent.steps:

        def note(depth: np.ndarray, residual: float) -> None:
            result.depth = depth
            record(size, residual)

        counted = np.ones_like(counts) if options.descent.depth_rate else seen
        if options.descent.lights:
            del rendering
            rendering = Rendering(level, lobes, max_depth=options.max_depth, lights=options.descent.lights)
        descend(
            rendering,
            level,
            guess,
            result.depth,
            counted,
            options.descent,
            rng,
            bilateral=options.bilateral,
            after=note,
        )
    bar.close()
    return result


def _scale(data: Dataset, options: Options) -> float:
    """By which values are multiplied, so that albedos are those of real things."""
    if not options.brightness:
        return 1.0
    directions, irradiance = _flat(data).lighting()
    b = [least_squares.trimmed(_over(data.values[..., c], irradiance), directions) for c in range(3)]
    return options.brightness / np.pi / max(np.median(np.linalg.norm(x, axis=1)) for x in b)


def _flat(data: Dataset) -> DirectModel:
    """Of a plane at the distance of the object, across the view."""
    domain = Domain(data)
    points = domain.points(np.full(domain.wide.sum(), domain.distance))
    return DirectModel(data, ggx.Lobes((np.nan,), (np.nan,)), points=points)


def _over(values: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Values as of lights at infinity, (P, K). 0 where a light does not shine."""
    return np.divide(values, irradiance, out=np.zeros(values.shape), where=irradiance > 1e-6 * irradiance.max())


def _start(data: Dataset, lobes: ggx.Lobes, counts: np.ndarray, options: Options) -> Guess:
    """Diffuse, with exposures."""
    flat = _flat(data)
    directions, irradiance = flat.lighting()
    values = _over(data.luminance, irradiance)
    solve = least_squares.METHODS[options.start]
    exposures = np.ones(flat.K)
    for _ in range(3 if options.exposures else 0):
        predicted = least_squares.predicted(solve(values / exposures, directions), directions)
        exposures *= calibration.exposures(values / exposures, predicted, counts, flat.mean_directions())
    normals = least_squares.normals(values / exposures, directions, options.start)
    albedo = np.linalg.norm(solve(values / exposures, directions), axis=1)
    weights = np.zeros((len(lobes), 3))
    colour = (data.values / exposures[:, None]).mean((0, 1)) / (data.luminance / exposures).mean()
    weights[np.isnan(lobes.eta)] = np.minimum(np.pi * np.median(albedo) * colour, 1)
    return Guess(normals, np.ones(len(values)), exposures, weights)


def _exposures(model, guess, data, counts, rng, options) -> float:
    """Take the albedo's median and the exposures' to be 1. Returns the relative residual."""
    if options.albedo:
        guess.albedo /= np.median(guess.albedo)
    pixels = rng.choice(model.P, min(2000, model.P), replace=False)
    predicted = model.predicted(guess, pixels)
    w = counts[pixels]
    residual = np.sqrt((w[..., None] * (predicted - data.values[pixels]) ** 2).sum() / w.sum() / 3) / model.scale
    if options.exposures:
        guess.exposures *= calibration.exposures(
            data.luminance[pixels], predicted @ LUMINANCE, w, model.mean_directions()
        )
        guess.exposures[np.abs(np.log(guess.exposures)) < STATED] = 1
    return float(residual)


def _smooth(pixels: np.ndarray, mask: np.ndarray, width: float) -> None:
    """Gaussian means over the pixels of the mask, of each image of (P, K, 3), in place."""
    if not width:
        return
    share = ndimage.gaussian_filter(mask.astype(np.float32), width)[mask]
    image = np.zeros((*mask.shape, 3), np.float32)
    for k in range(pixels.shape[1]):
        image[mask] = pixels[:, k]
        pixels[:, k] = ndimage.gaussian_filter(image, (width, width, 0))[mask] / share[:, None]


def _refine(result: Result, data: Dataset, *, before: int, now: int) -> None:
    """Take a guess to larger images. before, now : sides of their pixels, in those of the data."""
    rows, columns = np.nonzero(data.mask)
    domain = result.domain
    padded = np.zeros((*domain.wide.shape, 4))
    padded[domain.wide] = np.c_[result.guess.normals, result.guess.albedo][domain.nearest]
    _, nearest = ndimage.distance_transform_edt(~domain.wide, return_indices=True)
    padded = padded[nearest[0], nearest[1]]
    centre = lambda i: (now * i + (now - before) / 2) / before + 1  # the domain is larger by a pixel
    at = [centre(rows), centre(columns)]
    fine = np.stack([ndimage.map_coordinates(padded[..., i], at, order=1, mode="nearest") for i in range(4)], -1)
    result.guess.normals, result.guess.albedo = unit(fine[:, :3]), fine[:, 3]
