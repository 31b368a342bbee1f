"""Normals of images that are too large for memory.

The surface is found from smaller images, means over blocks of pixels: its shadows and interreflections have little that
is finer, and neither has what decides between states. The BSDF, the exposures and both of these then stay as they are,
and each pixel of the full images is fitted by itself, some rows at a time. The mean of the normals of a block stays
what was found and judged; what the fit adds is how they differ inside of it.
"""

from __future__ import annotations

import errno
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import numpy as np
from scipy import ndimage
from tqdm import tqdm

from rimlight.edge_sampling.refusals import InputError

from . import least_squares, nearness
from .alternation import View, shown
from .dataset import LUMINANCE, Dataset, Setup, angles, read_setup
from .direct import DirectModel, Guess, Lighting
from .files import read_pixels, read_truth
from .reconstruction import Options, Result
from .rendering import Rendering
from .vectors import unit

#: Values that are fitted at a time, each of which takes about 100 bytes.
AT_ONCE = 4e6

#: Gauss-Newton steps of each pixel, from the normals of the surface.
STEPS = 8

#: Bytes of a value in the file from which rows are read.
OF_VALUE = 12


@dataclass(frozen=True)
class FullSize:
    """mask : (H, W), of the full images, P pixels. normals : (P, 3). albedo : (P,), of one material, else base :
    (P, 3), as of `Guess`. error : mean angle to the true normals, degrees; None where these are not known."""

    mask: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray | None
    base: np.ndarray | None
    error: float | None


class Between:
    """Takes numbers of coarse pixels to those of full images, which are `step` times as wide: between four, by
    bilinear interpolation. mask : of the coarse ones, (H', W'), P' pixels; beyond, the nearest of them counts."""

    def __init__(self, mask: np.ndarray, step: int):
        self.step, number = step, np.full(mask.shape, -1)
        number[mask] = np.arange(mask.sum())
        rows, columns = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
        self.number = number[rows, columns]

    def block(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The coarse pixel in which full ones lie, or that is nearest: (P,)."""
        H, W = self.number.shape
        return self.number[np.minimum(rows // self.step, H - 1), np.minimum(columns // self.step, W - 1)]

    def weights(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Four coarse pixels for each full one, and their weights: (P, 4) each."""
        below, parts = [], []
        for at, size in zip((rows, columns), self.number.shape, strict=True):
            place = np.clip((2 * at + 1 - self.step) / (2 * self.step), 0, size - 1)
            below.append(np.minimum(place.astype(np.int64), max(size - 2, 0)))
            parts.append((place - below[-1]).astype(np.float32))
        (i, j), (u, v) = below, parts
        H, W = self.number.shape
        corners = [(i + di, j + dj) for di in (0, 1) for dj in (0, 1)]
        pixels = np.stack([self.number[np.minimum(r, H - 1), np.minimum(c, W - 1)] for r, c in corners], 1)
        return pixels, np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], 1)


def check_space(setup: Setup, folder: Path) -> None:
    """Raises ValueError if a folder has no space for the file from which rows are read."""
    needed = OF_VALUE * int(setup.mask.sum()) * len(setup.names)
    there = next(place for place in (folder.resolve(), *folder.resolve().parents) if place.exists())
    if needed > (free := shutil.disk_usage(there).free):
        raise InputError(
            f'ps: normals of the full images need {needed / 2**30:.1f} GiB in "{folder}" for a while, '
            f"{free / 2**30:.1f} GiB are free; name another folder, or leave out --full-size"
        )


def find(
    folder: Path | str,
    out: Path | str,
    result: Result,
    options: Options,
    *,
    reduce: int,
    images: int = 0,
    progress: bool = False,
) -> FullSize:
    """Normals and albedos of the full images, of a result from smaller ones.

    folder : of the images. out : where a file is kept for a while, of 12 bytes for each value. result : of
    `dataset.read(folder, images=images, reduce=reduce)`.

    Raises
    ------
    ValueError : the images differ from those of the result. OSError : a file cannot be read, or the disk is full.
    """
    folder, out = Path(folder), Path(out)
    setup = read_setup(folder, images=images)
    kept = [k for k, name in enumerate(setup.names) if name in result.data.names]
    if len(kept) != len(result.data.lights):
        raise InputError("ps: the images of the folder are not those of the result")
    setup = setup.chosen(kept)
    size, data = options.resolutions[-1], result.data
    if np.isfinite(result.away):
        data = nearness.around(data, result.away * size)
    view = _view(data, result, options, size)
    between, (rows, columns) = Between(data.mask, round(reduce / size)), np.nonzero(setup.mask)
    coloured = result.guess.base is not None
    normals, own = np.empty((len(rows), 3), np.float32), np.empty((len(rows), 3 if coloured else 1), np.float32)
    with Pixels(folder, out, setup, data, progress=progress) as pixels:
        at_once = max(int(AT_ONCE) // len(setup.names), 1)
        for i in tqdm(range(0, len(rows), at_once), desc="full size", disable=not progress):
            part = slice(i, i + at_once)
            four = between.weights(rows[part], columns[part])
            guess = _fitted(data, result, view, options, four, *pixels.of(part, result.scale))
            normals[part] = guess.normals
            own[part] = guess.base if coloured else guess.albedo[:, None]
    normals = _with_means(normals, result.guess.normals, between, rows, columns)
    truth = read_truth(folder, setup.mask)
    error = None
    if truth is not None:
        error = float(np.nanmean(np.where(truth.any(1), angles(normals, truth), np.nan)))
    return FullSize(setup.mask, normals, None if coloured else own[:, 0], own if coloured else None, error)


class Pixels:
    """The values of full images, in a file that has no name and goes with this process: image after image.

    data : the same images, smaller; tells what values are divided by, and if some are clipped.
    """

    def __init__(self, folder: Path, out: Path, setup: Setup, data: Dataset, *, progress: bool = False):
        self.intensities, self.clipped = data.intensities.astype(np.float32), bool(data.clipped.any())
        self.largest = 0.0
        self.count = int(setup.mask.sum())
        self.file = tempfile.TemporaryFile(dir=out)  # noqa: SIM115 (closed by `__exit__`)
        try:
            for name in tqdm(setup.names, desc="images", disable=not progress):
                pixels = np.ascontiguousarray(read_pixels(folder / name, setup.mask), np.float32)
                self.largest = max(self.largest, float(pixels.max()))
                self.file.write(pixels)
            self.file.flush()
        except OSError as error:
            self.file.close()
            if error.errno == errno.ENOSPC:
                raise OSError(error.errno, f'the disk of "{out}" is full') from error
            raise

    def __enter__(self) -> Pixels:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def of(self, part: slice, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Of some pixels: values over intensities, times the scale, (P, K, 3), and which are clipped, (P, K)."""
        count = min(part.stop, self.count) - part.start
        found = np.empty((count, len(self.intensities), 3), np.float32)
        for k in range(len(self.intensities)):
            self.file.seek(OF_VALUE * (k * self.count + part.start))
            found[:, k] = np.frombuffer(self.file.read(OF_VALUE * count), np.float32).reshape(count, 3)
        over = (found >= (1 - 1e-4) * self.largest).any(2) & self.clipped
        return found * (np.float32(scale) / self.intensities), over


def _view(data: Dataset, result: Result, options: Options, size: float) -> View:
    """What the surface that was found shows."""
    several, base_eta = result.kind.several, result.kind.base_eta(result.lobes)
    rendering = Rendering(data, result.lobes, max_depth=options.max_depth, several=several, base_eta=base_eta)
    depth = result.depth
    if np.isfinite(result.away):
        depth = nearness.as_near(depth, result.away * size)
    view = shown(rendering, Lighting(data), result.guess, depth, options, options.seed)
    if view.indirect is not None and np.isfinite(result.strength):
        view.indirect *= np.float32(result.strength)
    return view


def _fitted(
    data: Dataset,
    result: Result,
    view: View,
    options: Options,
    four: tuple[np.ndarray, np.ndarray],
    values: np.ndarray,
    clipped: np.ndarray,
) -> Guess:
    """Fit some pixels of the full images. four : as of `Between.weights`."""
    pixels, weights = four

    def there(x: np.ndarray) -> np.ndarray:
        return sum(x[pixels[:, i]] * weights[:, i].reshape(-1, *[1] * (x.ndim - 1)) for i in range(4))

    guess = result.guess
    fitted = replace(guess, normals=unit(there(guess.normals)), albedo=there(guess.albedo))
    if guess.base is not None:  # there is a glaze, or there is none
        fitted = replace(fitted, albedo=np.round(fitted.albedo), base=there(guess.base))
    bright = least_squares.brightest(values @ LUMINANCE, options.dark)
    counts = (bright & ~clipped & data.lit) * there(view.seen.astype(np.float32))
    indirect = None if view.indirect is None else there(view.indirect)
    mask = np.ones((1, len(values)), bool)
    some = replace(data, values=values, mask=mask, truth=None, over=None)
    dr.flush_malloc_cache()
    model = DirectModel(some, result.lobes, points=there(view.points), counts=counts, indirect=indirect)
    model.scale = data.typical
    model.fit_normals(fitted, steps=STEPS, free_albedo=options.albedo)
    return fitted


def _with_means(
    normals: np.ndarray, means: np.ndarray, between: Between, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Normals, (P, 3), whose means over coarse pixels are near `means`, (P', 3): what these lack is interpolated."""
    block, now = between.block(rows, columns), np.zeros(means.shape)
    for c in range(3):
        now[:, c] = np.bincount(block, normals[:, c], len(means))
    lacking = (means - unit(now)).astype(np.float32)
    lacking[np.bincount(block, minlength=len(means)) == 0] = 0
    found = normals.copy()
    for i in range(0, len(rows), int(AT_ONCE)):
        part = slice(i, i + int(AT_ONCE))
        pixels, weights = between.weights(rows[part], columns[part])
        found[part] += sum(lacking[pixels[:, j]] * weights[:, j, None] for j in range(4))
    return unit(found).astype(np.float32)
