"""Shape and reflectance from photometric stereo (Bangaru 2019, algorithm 1), with the inner problems solved directly.

In turns: the BSDF, the normals and albedos, and the exposures of the images, given what surfaces hide and what they
reflect on each other; then depth from normals, and from it the shadows and interreflections, by path tracing. Each
alternation makes the interreflections of a better surface, and so on (Nayar et al. 1991), from coarse images to fine.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy import ndimage
from tqdm import tqdm

from rimlight import ggx

from . import calibration, least_squares
from .alternation import Alternations, State
from .dataset import Dataset, angles, unit
from .direct import DirectModel, Guess
from .evidence import Judge, Kind, left_out
from .refinement import Descent, descend
from .rendering import Domain, Rendering

log = logging.getLogger(__name__)

#: Pixels without which there is no surface.
FEWEST = 9

#: Alternations of each kind of material, from the best state of the simplest: with the normals of the start, anything
#: may look like a coat.
SETTLED = 3


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
    """May light be diffuse under a smooth coat, as that of plastics? Default: if that predicts better."""
    materials: Literal["one", "several"] | None = None
    """One material, with a factor for each pixel; or several under one glaze: a diffuse colour for each pixel, and
    highlights that all share. Default: what predicts better."""
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

    def kinds(self) -> tuple[Kind, ...]:
        """Of material, that are tried."""
        if not self.reflectance:
            return (Kind(),)
        several = (False, True) if self.materials is None and self.albedo else (self.materials == "several",)
        coat = (False, True) if self.coat is None else (self.coat,)
        return tuple(Kind(s, c) for s in several for c in coat)


@dataclass
class Result:
    """normals : (P, 3). depth : (Q,), of the pixels of `domain`. weights : (B, 3), with `scale` the BSDF of the images.
    kind : of its material. verdict : "start", if that predicts what was left out as well as anything, and so was kept;
    "judged", if something else predicts better; "not judged", with too few lights to leave any out. left_out : how far
    predictions of "start" and "result" are off, in the mean value of each pixel.
    history : for each alternation, the size of the images, seconds since the start, the root mean square residual over
    the median value, and where the truth is known the mean angular error, degrees."""

    data: Dataset
    lobes: ggx.Lobes
    guess: Guess
    depth: np.ndarray
    domain: object
    start: np.ndarray
    scale: float
    kind: Kind
    verdict: str = "not judged"
    left_out: dict[str, float] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0

    def take(self, state: State) -> None:
        """Take over a state of an alternation."""
        self.guess, self.depth, self.kind = state.guess, state.depth, state.kind

    @property
    def normal_map(self) -> np.ndarray:
        """(H, W, 3), 0 outside the mask."""
        return self.data.image(self.guess.normals)

    @property
    def depth_map(self) -> np.ndarray:
        """(H, W), NaN outside the mask."""
        return self.data.image(self.depth[self.domain.inner], np.nan)

    @property
    def error(self) -> float | None:
        """Mean angular error, degrees."""
        return None if self.data.truth is None else float(angles(self.guess.normals, self.data.truth).mean())


def reconstruct(
    data: Dataset, options: Options | None = None, *, progress: bool = True, after: Callable | None = None
) -> Result:
    """Normals, depth and reflectance of a data set.

    Of all states, the one is returned that best predicts values that were left out. `Result.verdict` says if it is the
    start.

    after : called with the result so far after each alternation.

    Raises
    ------
    ValueError : lights lie in a plane, all images are black, or the mask has hardly any pixels.
    """
    options, begin = options or Options(), time.perf_counter()
    lobes, _ = ggx.read_dictionary()
    if not options.reflectance:
        lobes = ggx.Lobes((np.nan,), (np.nan,))
    _check(data)
    rng = np.random.default_rng(options.seed)
    scale = _scale(data.at(options.resolutions[0]), options)
    result, coarse = None, 1
    kinds = options.kinds()
    others = SETTLED * len(kinds) if len(kinds) > 1 else 0
    bar = tqdm(total=sum(options.iterations) + others + options.descent.steps, desc="ps", disable=not progress)

    def record(state: State, residual: float) -> None:
        result.take(state)
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
        counts = _counts(data, level, size, options.dark)
        judge = Judge(level, lobes, left_out(level, options.seed), counts, options.seed, options.start)
        kind = kinds[0] if result is None else result.kind
        work = Alternations(level, lobes, kind, judge, options, rng)
        guess = _start(level, lobes, counts, options)
        start, seen = work.judged_start(guess, _flat(level).lighting()[0], kinds)
        if result is None:
            result = Result(level, lobes, guess, start.depth, work.domain, guess.normals, scale, kind)
            first = copy.deepcopy(start)
            if kind.several:  # which is another guess
                seen = None
        else:
            _refine(result, level, before=coarse, now=round(1 / size))
            first = State(result.guess, work.domain.integrate(result.guess.normals, options.bilateral), kind)
            seen = None
        result.data, result.domain, coarse = level, work.domain, round(1 / size)
        best = work.run(first, most, record, seen)
        if size == options.resolutions[0]:
            settled = best
            for kind in kinds if judge.able and len(kinds) > 1 else ():
                del work
                work = Alternations(level, lobes, kind, judge, options, rng)
                again = dataclasses.replace(copy.deepcopy(settled), left_out=np.nan)
                found = work.run(again, SETTLED, record)
                if found.better_than(best) if kind == best.kind else found.needed_beside(best):
                    best = found
        if start.left_out < best.left_out:
            best = start
        result.take(best)
        result.left_out = {"start": start.left_out, "result": best.left_out}
    result.verdict = "start" if best.start else "judged" if judge.able else "not judged"
    if options.descent.steps:
        _descend(result, work, record, rng)
    bar.close()
    return result


def _counts(data: Dataset, level: Dataset, size: float, dark: float) -> np.ndarray:
    """How much values of a level count, (P, K): 0 for the darkest of each pixel, and what is clipped, even in part."""
    clipped = data.clipped
    if size < 1:
        clipped = data.blocks(round(1 / size))[1](clipped.astype(np.float32)) > 0
    return (least_squares.brightest(level.luminance, dark) & ~clipped).astype(np.float32)


def _check(data: Dataset) -> None:
    """Raises ValueError for data that tell nothing; logs what makes them tell less."""
    if not data.near:
        least_squares.check_lights(data.lights)
    if not data.values.max() > 0:
        raise ValueError("ps: all images are black in the mask; check the images, their exposure and the mask")
    if len(data.values) < FEWEST:
        raise ValueError(f"ps: the mask has {len(data.values)} pixels, at least {FEWEST} are needed; check mask.png")
    if share := data.clipped.mean():
        log.warning(
            "ps: %.2g %% of the values are clipped: they equal the largest one, and do not count; expose less",
            100 * share,
        )


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
    if data.clipped.any():  # what is too bright is known then, and need not be guessed
        told = least_squares.telling(counts > 0, directions)[:, None]
        solve = lambda values, lights: least_squares.least_squares(values, lights, np.where(told, counts, 1.0))
    exposures = np.ones(flat.K)
    for _ in range(3 if options.exposures else 0):
        predicted = least_squares.predicted(solve(values / exposures, directions), directions)
        exposures *= calibration.exposures(values / exposures, predicted, counts, flat.mean_directions())
    found = solve((values / exposures).astype(np.float64), directions)
    normals, albedo = least_squares.facing(found), np.linalg.norm(found, axis=1)
    weights = np.zeros((len(lobes), 3))
    colour = (data.values / exposures[:, None]).mean((0, 1)) / (data.luminance / exposures).mean()
    weights[np.isnan(lobes.eta)] = np.minimum(np.pi * np.median(albedo) * colour, 1)
    return Guess(normals, np.ones(len(values)), exposures, weights)


def _refine(result: Result, data: Dataset, *, before: int, now: int) -> None:
    """Take a guess to larger images. before, now : sides of their pixels, in those of the data."""
    rows, columns = np.nonzero(data.mask)
    domain = result.domain
    guess = result.guess
    pixels = np.c_[guess.normals, guess.albedo, np.empty((len(guess.albedo), 0)) if guess.base is None else guess.base]
    padded = np.zeros((*domain.wide.shape, pixels.shape[1]))
    padded[domain.wide] = pixels[domain.nearest]
    _, nearest = ndimage.distance_transform_edt(~domain.wide, return_indices=True)
    padded = padded[nearest[0], nearest[1]]
    centre = lambda i: (now * i + (now - before) / 2) / before + 1  # the domain is larger by a pixel
    at = [centre(rows), centre(columns)]
    fine = [ndimage.map_coordinates(padded[..., i], at, order=1, mode="nearest") for i in range(padded.shape[2])]
    guess.normals, guess.albedo = unit(np.stack(fine[:3], 1)), fine[3]
    if guess.base is not None:
        guess.base = np.stack(fine[4:], 1)


def _descend(result: Result, work: Alternations, record: Callable, rng: np.random.Generator) -> None:
    """Steps along derivatives of path-traced images, from the best state."""
    options, data, guess = work.options, result.data, result.guess
    if work.kind != result.kind or options.descent.lights:
        several, eta = result.kind.several, result.kind.base_eta(result.lobes)
        work.rendering = Rendering(
            data,
            result.lobes,
            max_depth=options.max_depth,
            lights=options.descent.lights,
            several=several,
            base_eta=eta,
        )
    if options.descent.depth_rate:
        counts = np.ones_like(work.judge.counts)
    else:
        work.rendering.update(guess, result.depth)
        counts = work.judge.counts * (work.rendering.visible(work.flat) if options.shadows else 1)

    def note(depth: np.ndarray, residual: float) -> None:
        record(State(guess, depth, result.kind), residual)

    descend(
        work.rendering, data, guess, result.depth, counts, options.descent, rng, bilateral=options.bilateral, after=note
    )
