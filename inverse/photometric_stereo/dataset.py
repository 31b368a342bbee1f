"""Data sets of photometric stereo: images of one view, a light for each, and a mask.

Axes, in all of this package: x to the right, y up, z towards the camera. Rows of arrays go down.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rimlight.edge_sampling.refusals import InputError
from rimlight.leds import Led, read_leds, write_leds

from . import compression, files
from .encoding import ENCODED, JUDGED, looks_encoded
from .files import (
    CAMERA,
    DIRECTIONS,
    DISTANCE,
    INTENSITIES,
    LEDS,
    LIGHT_DISTANCE,
    MASK,
    NAMES,
    read_camera,
    read_mask,
    read_names,
    read_numbers,
    read_pixels,
    read_truth,
)
from .integration import check_camera, ray_matrix
from .vectors import LUMINANCE, directions_of, every

log = logging.getLogger(__name__)

#: Images whose mean is less than this part of the median one are taken to be without light.
DIM = 0.1

#: Said of sets that show nothing.
ALL_BLACK = "ps: all images are black in the mask; check the images, their exposure and the mask"

#: Part of the values that may be as large as the largest one, by chance.
CLIPPED = 1e-3


@dataclass(frozen=True)
class Dataset:
    """K images of P pixels, those of the mask, in the order of its rows.

    Raises
    ------
    ValueError : shapes do not agree; a value is not finite; the mask is empty; there are fewer than three lights; the
        camera is no intrinsic matrix; lights are near without a camera or a distance.
    """

    #: (P, K, 3), float32: linear radiance over the intensity of the light, which is irradiance for lights at infinity.
    values: np.ndarray
    #: (H, W), bool.
    mask: np.ndarray
    #: (K, 3): unit directions towards lights at infinity; or K LEDs, in camera coordinates, as far as known of
    #: intensity 1.
    lights: np.ndarray | tuple[Led, ...]
    #: (K, 3): intensities that `values` have been divided by, linear sRGB.
    intensities: np.ndarray
    #: Intrinsic matrix, (3, 3), pixels; pixel (0, 0) has its centre at (0, 0). None: orthographic.
    camera: np.ndarray | None = None
    #: True normals, (P, 3), if known; (0, 0, 0) of single pixels where they are not.
    truth: np.ndarray | None = None
    #: Of the images.
    names: tuple[str, ...] = ()
    #: Mean (geometric) of the depth of the object, or of each of its parts, along the axis of the camera, in the unit
    #: of the LEDs: normals leave the scale of depth open, and near lights do not. Needed with these only.
    distance: float | None = None
    #: What its files tell of faults, in sentences.
    doubts: tuple[str, ...] = ()
    #: Which values are clipped, even in part, (P, K), bool. None: those that tell it by themselves.
    over: np.ndarray | None = None

    def __post_init__(self):
        P, K, channels = self.values.shape
        if self.mask.sum() != P or channels != 3:
            raise InputError(f"ps: values of the shape {self.values.shape} for {self.mask.sum()} pixels of the mask")
        if not P:
            raise InputError(f"ps: the mask is empty; make white in {MASK} what belongs to the object")
        if len(self.lights) != K or self.intensities.shape != (K, 3):
            raise InputError(
                f"ps: {K} images, {len(self.lights)} lights and {len(self.intensities)} intensities: there must be as "
                "many of each"
            )
        if K < 3:
            raise InputError(f"ps: at least three images are needed, got {K}")
        if bad := int((~np.isfinite(self.values)).any((1, 2)).sum()):
            raise InputError(f"ps: {bad} pixels of the mask have values that are not finite; take them out of the mask")
        check_camera("ps", self.camera)
        if self.near and self.camera is None:
            raise InputError(f"ps: lights at finite distance need a camera; write its matrix to {CAMERA}")
        if self.near and self.distance is None:
            raise InputError(
                f"ps: lights at finite distance need the distance of the object from the camera; write it to {DISTANCE}"
            )
        if self.distance is not None and not 0 < self.distance < np.inf:
            raise InputError(f"ps: the distance must be positive, got {self.distance}")

    @property
    def near(self) -> bool:
        """Are the lights at finite distances?"""
        return not isinstance(self.lights, np.ndarray)

    @functools.cached_property
    def clipped(self) -> np.ndarray:
        """Which values are as large as the image could hold: (P, K), bool."""
        if self.over is not None:
            return self.over
        return as_large_as_possible((self.values * self.intensities.astype(np.float32)).max(2))

    @functools.cached_property
    def lit(self) -> np.ndarray:
        """Which images are not taken to be without light: (K,), bool."""
        means = self.luminance.mean(0)
        return means > DIM * np.median(means)

    @functools.cached_property
    def typical(self) -> float:
        """Median of the values that are not black; 1 if all are."""
        lit = self.values[self.values > 0]
        return float(np.median(lit, overwrite_input=True)) if lit.size else 1.0

    def off(self, normals: np.ndarray) -> np.ndarray:
        """Angle between normals, (P, 3), and the true ones, degrees: (P,). NaN where these are not known."""
        return np.where(self.truth.any(1), angles(normals, self.truth), np.nan)

    @property
    def luminance(self) -> np.ndarray:
        """(P, K)"""
        return self.values @ LUMINANCE

    def with_near_lights(self, away: float) -> Dataset:
        """The data set with its lights at a finite distance: LEDs in a plane across the axis of the camera, in their
        directions from the middle of the object, the mean of its pixels. They shine as brightly in all directions, and
        there as brightly as the distant lights.

        away : of the plane from the middle, along the axis, in the unit of `distance`.

        Raises
        ------
        ValueError : lights are near already, or not on the camera's side; there is no camera or distance.
        """
        if self.near:
            raise InputError(f"ps: lights have positions already; take {LEDS} or {LIGHT_DISTANCE} away")
        if not 0 < away < np.inf:
            raise InputError(f"ps: {LIGHT_DISTANCE}: the distance of the lights must be positive, got {away}")
        if (behind := self.lights[:, 2] <= 0).any():
            raise InputError(
                f"ps: light {int(behind.argmax()) + 1} is not on the side of the camera; describe it in {LEDS}"
            )
        if self.camera is None or self.distance is None:
            raise InputError(f"ps: near lights need {CAMERA} and {DISTANCE}, which tell where the object is")
        rows, columns = np.nonzero(self.mask)
        middle = self.distance * ray_matrix(self.camera) @ (columns.mean(), rows.mean(), 1)
        offsets = self.lights * (away / self.lights[:, 2:])
        leds = tuple(Led(tuple(middle + o), tuple(-o), 0.0, (1.0, 1.0, 1.0)) for o in offsets)
        squared = (offsets**2).sum(1)[:, None]
        values = (self.values / squared).astype(np.float32)
        return replace(self, lights=leds, intensities=self.intensities * squared, values=values)

    def at(self, size: float) -> Dataset:
        """The data set with images of another size: means over those of its pixels that lie in the mask.

        size : width and height over those of these, 1 over a whole number, such as 1/4.

        Raises
        ------
        ValueError : no pixel is left.
        """
        step = round(1 / size)
        if step == 1:
            return self
        mask, mean = self.blocks(step)
        if not mask.any():
            raise InputError(
                f"ps: the mask is too small: at a size of {size:g}, no pixel of it is left; leave this size out of the "
                "resolutions"
            )
        camera = coarser(self.camera, step)
        truth = None if self.truth is None else directions_of(mean(self.truth))
        truth = truth if truth is not None and truth.any() else None
        over = None if self.over is None else mean(self.over.astype(np.float32)) > 0
        values = mean(self.values).astype(np.float32)
        return replace(self, values=values, mask=mask, camera=camera, truth=truth, over=over)

    def without(self, numbers: Sequence[int]) -> Dataset:
        """The data set without some of its images."""
        kept = [k for k in range(len(self.lights)) if k not in numbers]
        lights = tuple(self.lights[k] for k in kept) if self.near else self.lights[kept]
        names = tuple(self.names[k] for k in kept) if self.names else ()
        over = None if self.over is None else self.over[:, kept]
        return replace(
            self, values=self.values[:, kept], lights=lights, intensities=self.intensities[kept], names=names, over=over
        )

    def blocks(self, step: int) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Coarse pixels, of step x step of these: their mask, where at least half of a block is in the mask; and what
        makes means, (P', ...), over each block's pixels of the mask, of numbers of all pixels, (P, ...)."""
        return blocks(self.mask, step)

    def image(self, pixels: np.ndarray, fill: float = 0) -> np.ndarray:
        """(H, W, ...) of numbers of the pixels, (P, ...)."""
        return image_of(self.mask, pixels, fill)


def image_of(mask: np.ndarray, pixels: np.ndarray, fill: float = 0) -> np.ndarray:
    """(H, W, ...) of numbers of the pixels of a mask, (P, ...)."""
    found = np.full((*mask.shape, *pixels.shape[1:]), fill, pixels.dtype)
    found[mask] = pixels
    return found


def as_large_as_possible(pictured: np.ndarray) -> np.ndarray:
    """Which of the values of images, (P, K), are as large as these could hold: where more than `CLIPPED` of all values
    are the largest one, but for rounding."""
    found = pictured >= (1 - 1e-4) * pictured.max()
    return found if CLIPPED < found.mean() < 1 - CLIPPED else np.zeros_like(found)


def blocks(
    mask: np.ndarray, step: int, of: Callable[..., np.ndarray] | None = None
) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Of the pixels of a mask, (H, W): see `Dataset.blocks`. of : in place of means, such as `np.maximum.reduceat`."""
    H, W = (-(-n // step) * step for n in mask.shape)
    whole = np.zeros((H, W), bool)
    whole[: mask.shape[0], : mask.shape[1]] = mask
    coarse = whole.reshape(H // step, step, W // step, step).sum((1, 3)) * 2 >= step * step
    # Coarse pixel of each pixel, and means by sums over them
    target = np.full(coarse.shape, -1)
    target[coarse] = np.arange(coarse.sum())
    rows, columns = np.nonzero(mask)
    group = target[rows // step, columns // step]
    members = np.flatnonzero(group >= 0)
    members = members[np.argsort(group[members], kind="stable")]
    first = np.flatnonzero(np.diff(group[members], prepend=-1))
    counts = np.diff(first, append=len(members))
    if of is not None:
        return coarse, lambda x: of(x[members], first, axis=0)
    mean = lambda x: np.add.reduceat(x[members], first, axis=0) / counts.reshape(-1, *[1] * (x.ndim - 1))
    return coarse, mean


def coarser(camera: np.ndarray | None, step: int) -> np.ndarray | None:
    """The camera whose pixels are blocks of step x step."""
    if camera is None:
        return None
    camera = camera.copy()
    camera[:2, 2] -= (step - 1) / 2  # the centre of the first block lies so far behind that of the first pixel
    camera[:2] /= step
    return camera


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between vectors (..., 3), degrees. Accurate for small ones, too."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


# ---------------------- Folders ----------------------


def read(folder: Path, *, images: int = 0, reduce: int = 1) -> Dataset:
    """Read a folder as DiLiGenT's (Shi et al. 2019): `filenames.txt` (else all pictures but the mask, by name),
    `light_directions.txt` or `leds.csv`, `light_intensities.txt` (default 1), `mask.png`; if there, `K.txt` (3 x 3,
    else orthographic), `distance.txt` (see `Dataset.distance`), `light_distance.txt` (see `Dataset.with_near_lights`),
    and `Normal_gt.mat` or `Normal_gt.exr`.

    Pictures are EXR, PNG or TIFF, which are taken to be linear as DiLiGenT's are, or JPEG, which is decoded from sRGB.
    Those that are black in the mask are left out, and logged. So are doubts about them, which the data set keeps.

    images : read only so many, evenly from their list. 0: all. reduce : means over so many times so many pixels of the
        mask are read, as those of images of less width: of these alone there is memory.

    Raises
    ------
    ValueError : a file says what cannot be; sizes or numbers do not agree. OSError : one cannot be read.
    """
    folder = Path(folder)
    setup = read_setup(folder, images=images)
    names, mask, intensities = setup.names, setup.mask, setup.intensities
    coarse, mean = blocks(mask, reduce)
    _, largest = blocks(mask, reduce, np.maximum.reduceat)
    if mask.any() and not coarse.any():
        raise InputError(f"ps: the mask is too small: of a part of 1/{reduce} of its width, no pixel is left")
    values, lit = np.empty((coarse.sum(), len(names), 3), np.float32), []
    pictured = np.empty((len(values), len(names) if reduce > 1 else 0), np.float32)
    for k, name in enumerate(tqdm(names, desc="images", disable=True if len(names) < 10 else None, leave=False)):
        pixels = read_pixels(folder / name, mask)
        values[:, len(lit)] = (mean(pixels) if reduce > 1 else pixels) / intensities[k]
        if reduce > 1:
            pictured[:, len(lit)] = largest(pixels.max(1))
        if not (values[:, len(lit)] <= 0).all():
            lit.append(k)
    if len(values) and not lit:
        raise InputError(ALL_BLACK)
    if 0 < len(lit) < len(names):
        black = ", ".join(name for k, name in enumerate(names) if k not in lit)
        log.warning("ps: black in the mask, and left out: %s; were these lamps on?", black)
        setup, values, pictured = setup.chosen(lit), values[:, : len(lit)], pictured[:, : len(lit)]
    doubts = files.doubts(folder, setup.names) + compression.judged(folder, setup.names, mask).said()
    few = every(values, JUDGED)
    if not setup.near and looks_encoded(
        few * setup.intensities.astype(np.float32), setup.names, setup.lights, setup.intensities
    ):
        doubts.append(ENCODED)
    for text in doubts:
        log.warning("ps: %s", text)
    data = replace(setup.reduced(reduce).dataset(values, coarse), doubts=tuple(doubts))
    if reduce > 1:
        data = replace(data, over=as_large_as_possible(pictured))
    if (truth := read_truth(folder, mask)) is not None:
        data = replace(data, truth=truth if reduce == 1 else directions_of(mean(truth)))
    return data


@dataclass(frozen=True)
class Setup:
    """What a folder says of its images, none of which is read: as of `Dataset`, and `away`, the distance of LEDs from
    the object of which only the directions are given."""

    names: tuple[str, ...]
    mask: np.ndarray
    lights: np.ndarray | tuple[Led, ...]
    intensities: np.ndarray
    camera: np.ndarray | None
    distance: float | None
    away: float | None

    @property
    def near(self) -> bool:
        return not isinstance(self.lights, np.ndarray)

    def chosen(self, numbers: Sequence[int]) -> Setup:
        """Of some of the images."""
        lights = tuple(self.lights[k] for k in numbers) if self.near else self.lights[numbers]
        names = tuple(self.names[k] for k in numbers)
        return replace(self, names=names, lights=lights, intensities=self.intensities[numbers])

    def reduced(self, step: int) -> Setup:
        """Of images whose pixels are blocks of step x step."""
        return replace(self, camera=coarser(self.camera, step)) if step > 1 else self

    def dataset(self, values: np.ndarray, mask: np.ndarray) -> Dataset:
        """Of these pixels."""
        camera, names = self.camera, self.names
        data = Dataset(values, mask, self.lights, self.intensities, camera, names=names, distance=self.distance)
        return data if self.away is None else data.with_near_lights(self.away)


def read_setup(folder: Path, *, images: int = 0) -> Setup:
    """Read all of a folder but its images. images, and what is raised: as of `read`."""
    names, mask = read_names(folder), read_mask(folder / MASK)
    near = (folder / LEDS).is_file()
    if near:
        leds = read_leds(folder / LEDS)
        intensities = np.array([led.intensity for led in leds])
        lights: np.ndarray | tuple[Led, ...] = tuple(replace(led, intensity=(1.0, 1.0, 1.0)) for led in leds)
    else:
        directions = read_numbers(folder / DIRECTIONS, 3)
        if (lengths := np.linalg.norm(directions, axis=1)).min() == 0:
            raise InputError(f"ps: {DIRECTIONS}, line {lengths.argmin() + 1}: the direction is zero")
        lights = directions / lengths[:, None]
        given = folder / INTENSITIES
        intensities = read_numbers(given, 3, or_one=True) if given.is_file() else np.ones_like(lights)
    if len(lights) != len(names) or len(intensities) != len(names):
        raise InputError(
            f"ps: {folder.name}: {len(names)} images, {len(lights)} lights, {len(intensities)} intensities: there must "
            f"be as many of each; all pictures count that {NAMES} lists, or all that are there: {_few(names)}"
        )
    if (intensities <= 0).any():
        k = int((intensities <= 0).any(1).argmax())
        raise InputError(
            f"ps: {folder.name}: light {k + 1} has no intensity, all three must be above 0; if it was off, take it out "
            f'of the files of the lights, and "{names[k]}" out of the folder or of {NAMES}'
        )
    distance, away = (
        float(read_numbers(folder / name, 1)[0, 0]) if (folder / name).is_file() else None
        for name in (DISTANCE, LIGHT_DISTANCE)
    )
    setup = Setup(tuple(names), mask, lights, intensities, read_camera(folder), distance, away)
    return setup.chosen(np.arange(images) * len(names) // images) if 0 < images < len(names) else setup


def _few(names: Sequence[str]) -> str:
    """The first and the last of many names."""
    return ", ".join(names if len(names) < 6 else [*names[:2], "...", *names[-3:]])


def write(folder: Path, data: Dataset) -> None:
    """Write a folder that `read` reads: EXR images of full precision, whatever the names of the data end with.

    Raises
    ------
    OSError
    """
    from rimlight.exr import write_exr

    folder.mkdir(parents=True, exist_ok=True)
    names = [Path(name).stem + ".exr" for name in data.names or [f"{k + 1:03d}" for k in range(len(data.lights))]]
    for k, name in enumerate(names):
        write_exr(folder / name, {"": data.image(data.values[:, k] * data.intensities[k].astype(np.float32))})
    (folder / NAMES).write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    if data.near:
        pairs = zip(data.lights, data.intensities, strict=True)
        write_leds(folder / LEDS, [replace(led, intensity=tuple(map(float, rgb))) for led, rgb in pairs])
    else:
        np.savetxt(folder / DIRECTIONS, data.lights, "%.9g")
        np.savetxt(folder / INTENSITIES, data.intensities, "%.9g")
    if data.camera is not None:
        np.savetxt(folder / CAMERA, data.camera, "%.9g")
    if data.distance is not None:
        np.savetxt(folder / DISTANCE, [data.distance], "%.9g")
    if data.truth is not None:
        write_exr(folder / "Normal_gt.exr", {"": data.image(data.truth.astype(np.float32))})
    from PIL import Image

    Image.fromarray(data.mask.astype(np.uint8) * 255).save(folder / "mask.png")
