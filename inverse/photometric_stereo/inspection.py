"""What a data set is like, before hours are spent on it: from all of its images, one at a time, and a sample of its
pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from tqdm import tqdm

from rimlight import ggx
from rimlight.edge_sampling.refusals import InputError
from rimlight.inverse.page import shrunk

from . import compression, cost, dataset, encoding, evidence, files, least_squares, plausibility, start
from .compression import Compression
from .dataset import Dataset
from .plausibility import Plausibility
from .reconstruction import Options
from .vectors import LUMINANCE, every

#: Pixels that are kept of all images; and the largest width and height of small pictures.
SAMPLED, SMALL = 5000, 96

#: Values are taken for shadows that are darker than this part of what a diffuse surface would show; or than this one of
#: what it would show if it faced the light.
DARK, FACING = 0.25, 0.05

#: An image is worth a warning if a part of it so large is saturated or black.
SATURATED, BLACK = 0.02, 0.9

#: Largest over smallest singular value of the directions of the lights, from which on normals are uncertain; widest
#: angle, degrees, around the camera's axis without a light; and by which factor an exposure may be off.
NARROW, EMPTY, OFF = 12.0, 150.0, 1.1


@dataclass(frozen=True)
class Inspection:
    """What was found of K images of W x H pixels.

    sample : some pixels of all images. pixels : of the mask; parts : pieces that it consists of.
    bits : for each channel, in words. saturated, black, shadowed : part of each image's pixels of the mask, (K,); the
    last is an estimate. exposures : (K,), estimated. directions : (K, 3), of the lights, from the object.
    small : the images, shrunk, linear. mean : of all images, (H, W, 3), linear, with the mask beside it.
    compression : how far JPEG has changed values.
    misfits : of a diffuse surface to the images, as they are, and decoded from sRGB; None where this says nothing.
    of_files : doubts about the files, in sentences.
    plausibility : are the data what their files say?
    """

    folder: Path
    sample: Dataset
    mask: np.ndarray
    pixels: int
    parts: int
    bits: str
    saturated: np.ndarray
    black: np.ndarray
    shadowed: np.ndarray
    exposures: np.ndarray
    directions: np.ndarray
    small: list[np.ndarray]
    mean: np.ndarray
    compression: Compression
    misfits: tuple[float, float] | None
    of_files: tuple[str, ...]
    plausibility: Plausibility
    options: Options

    @property
    def images(self) -> int:
        return len(self.sample.names)

    @property
    def spread(self) -> np.ndarray:
        """Singular values of the directions, the largest first, over that of directions that are spread evenly."""
        return np.linalg.svd(self.directions, compute_uv=False) / np.sqrt(self.images / 3)

    @property
    def rank(self) -> int:
        return int((self.spread > least_squares.PLANE * self.spread[0]).sum())

    @property
    def angles(self) -> np.ndarray:
        """Between the lights and the direction to the camera, degrees."""
        return np.degrees(np.arccos(np.clip(self.directions[:, 2], -1, 1)))

    @property
    def gap(self) -> float:
        """Widest angle around the camera's axis in which there is no light, degrees."""
        around = np.sort(np.degrees(np.arctan2(self.directions[:, 1], self.directions[:, 0])))
        return float(np.diff(around, append=around[0] + 360).max())

    @property
    def memory(self) -> float:
        """Bytes."""
        return cost.memory(self.pixels, self.images, self.options, near=self.sample.near)

    @property
    def seconds(self) -> float:
        return cost.seconds(self.pixels, self.images, self.options)


def inspect(folder: Path, options: Options | None = None) -> Inspection:
    """Look at a data set. options : of the reconstruction whose memory and time are estimated.

    Raises
    ------
    ValueError, OSError : as `dataset.read`.
    """
    folder, options = Path(folder), options or Options()
    setup = dataset.read_setup(folder)
    mask, names = setup.mask, setup.names
    pixels = int(mask.sum())
    chosen = every(np.flatnonzero(mask), SAMPLED)
    few = np.zeros_like(mask)
    few.flat[chosen] = True
    raw = np.empty((len(chosen), len(names), 3), np.float32)
    largest, bright, black = (np.zeros(len(names)) for _ in range(3))
    mean, small = np.zeros((*mask.shape, 3), np.float32), []
    step = plausibility.block(pixels)
    coarse, mean_of_blocks = dataset.blocks(mask, step)
    blocks = np.empty((coarse.sum(), len(names), 3), np.float32)
    for k, name in enumerate(tqdm(names, desc="images", disable=None, leave=False)):
        picture = files.read_pixels(folder / name, np.ones_like(mask)).reshape(*mask.shape, 3)
        inside, raw[:, k] = picture[mask], picture.reshape(-1, 3)[chosen]
        if not np.isfinite(inside).all():
            raise InputError(f'ps: "{name}" has values that are not finite; take these pixels out of the mask')
        if coarse.any():
            blocks[:, k] = mean_of_blocks(inside) / setup.intensities[k]
        largest[k] = inside.max(initial=0)
        bright[k] = (inside >= (1 - 1e-4) * largest[k]).any(1).mean() if pixels else 0
        black[k] = (inside <= 0).all(1).mean() if pixels else 0
        picture = np.nan_to_num(picture / setup.intensities[k].astype(np.float32))
        mean += picture / len(names)
        small.append(shrunk(picture, SMALL, SMALL))
    sample = setup.dataset(raw / setup.intensities.astype(np.float32), few)
    shadowed, exposures, directions = _estimates(sample, options)
    return Inspection(
        folder=folder,
        sample=sample,
        mask=mask,
        pixels=pixels,
        parts=int(ndimage.label(mask, np.ones((3, 3)))[1]),
        bits=_bits([folder / name for name in names], raw),
        saturated=np.where(largest >= (1 - 1e-4) * largest.max(), bright, 0),
        black=black,
        shadowed=shadowed,
        exposures=exposures,
        directions=directions,
        small=small,
        mean=mean,
        compression=compression.judged(folder, names, mask),
        misfits=_misfits(raw, setup),
        of_files=tuple(files.doubts(folder, names)),
        plausibility=_plausibility(blocks, coarse, replace(setup, camera=dataset.coarser(setup.camera, step))),
        options=options,
    )


def warnings(found: Inspection) -> list[str]:
    """What is wrong, or may be, with what to do about it, in sentences; the worst first."""
    said = []
    if found.angles.min() >= 90:
        said.append(f"The set will be refused, for {least_squares.BEHIND}.")
    if found.rank < 3:
        said.append(
            "The lights are all in one direction or in a plane: normals cannot be told, and the set will be refused. "
            f"Check {files.DIRECTIONS}."
        )
    elif found.spread[0] > NARROW * found.spread[2]:
        said.append(
            f"The lights are close together or nearly in a plane (the ratio of the singular values of their directions "
            f"is {found.spread[0] / found.spread[2]:.0f}): normals will be noisy. Spread them by 40 degrees or more."
        )
    elif found.gap > EMPTY:
        said.append(
            f"There is no light in {found.gap:.0f} degrees around the camera's axis: sides that face there stay in "
            "shadow, and their normals are uncertain."
        )
    if found.memory > (there := cost.available_memory()):
        said.append(
            f"A reconstruction would take {found.memory / 2**30:.1f} GiB of memory, of which {there / 2**30:.1f} GiB "
            "are available, and will be refused: use --reduce 2, with --full-size if need be, or fewer --images."
        )
    said += [*found.of_files, *found.compression.said(), *found.plausibility.said()]
    if found.plausibility.order.known and found.misfits is not None and found.misfits[1] < found.misfits[0]:
        said.append(
            "The pictures look like exports for the screen (sRGB), and PNG and TIFF are taken to be linear: decoded, "
            f"they fit a diffuse surface better ({100 * found.misfits[1]:.1f} % off instead of "
            f"{100 * found.misfits[0]:.1f} %). Export them linear with 16 bits, or as JPEG, which is decoded."
        )
    said += _of_images(found)
    if found.images < evidence.FEWEST:
        said.append(
            f"With fewer than {evidence.FEWEST} images, none can be left out to judge a result by: the start will be "
            "kept, normals of a diffuse surface. Take more images."
        )
    if found.parts > 1:
        said.append(
            f"The mask has {found.parts} pieces. Their depths relative to each other stay unknown; small ones may be "
            "dirt in mask.png."
        )
    return said


def table(found: Inspection) -> list[tuple[str, str]]:
    """What, and how much."""
    H, W = found.mask.shape
    span = lambda x: f"{_percent(x.min())} to {_percent(x.max())} % of an image, mean {_percent(x.mean())} %"
    intensities = found.sample.intensities @ LUMINANCE
    spread = found.spread
    pieces = "one piece" if found.parts == 1 else f"{found.parts} pieces"
    camera = "orthographic" if found.sample.camera is None else "perspective"
    where = "near, at known positions" if found.sample.near else "at infinity"
    rows = [
        ("images", f"{found.images} of {W} x {H} pixels, {found.bits}"),
        ("mask", f"{found.pixels} pixels, {100 * found.pixels / (W * H):.0f} % of the image, in {pieces}"),
        ("camera", camera),
        ("lights", f"{where}, {found.angles.min():.0f} to {found.angles.max():.0f} degrees off the camera's axis"),
        ("rank of the lights", f"{found.rank} of 3, singular values {', '.join(f'{s:.2f}' for s in spread)}"),
        ("stated intensities", f"{intensities.min():.3g} to {intensities.max():.3g}"),
        ("exposures, estimated", f"{found.exposures.min():.2f} to {found.exposures.max():.2f} of what is stated"),
        ("saturated", span(found.saturated)),
        ("black", span(found.black)),
        ("in shadow, estimated", span(found.shadowed)),
    ]
    if found.compression.quality > 0:
        rows.append(("compression", str(found.compression)))
    if found.misfits is not None:
        linear, decoded = (f"{100 * x:.1f} %" for x in found.misfits)
        rows.append(("off a diffuse surface", f"{linear} as linear, {decoded} decoded from sRGB"))
    return [
        *rows,
        *found.plausibility.rows(),
        ("memory, at most", f"{found.memory / 2**30:.1f} GiB"),
        ("time, roughly", f"{_duration(found.seconds / 2)} to {_duration(found.seconds * 2)}"),
    ]


# ---------------------- Parts ----------------------


def _estimates(sample: Dataset, options: Options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From a diffuse surface that fits the most of the values: part of each image in shadow, exposures, (K,), and the
    directions of lights, (K, 3)."""
    plane = start.flat(sample)
    directions, irradiance = plane.lighting()
    if not sample.values.max() > 0:
        raise InputError(dataset.ALL_BLACK)
    counts = np.ones(sample.values.shape[:2], np.float32)
    guess = start.guess(sample, ggx.Lobes((np.nan,), (np.nan,)), counts, options)
    values = sample.luminance / np.maximum(irradiance, 1e-30) / guess.exposures
    b = least_squares.trimmed(values.astype(np.float64), directions)
    dark = np.maximum(DARK * least_squares.predicted(b, directions), FACING * np.linalg.norm(b, axis=1, keepdims=True))
    return (values <= dark).mean(0), guess.exposures, plane.mean_directions()


def _plausibility(values: np.ndarray, mask: np.ndarray, setup: dataset.Setup) -> Plausibility:
    """Of means over blocks of pixels."""
    return plausibility.judged(setup.dataset(values, mask)) if mask.any() else Plausibility()


def _misfits(raw: np.ndarray, setup: dataset.Setup) -> tuple[float, float] | None:
    """Of PNG and TIFF, under lights at infinity."""
    if setup.near or not all(name.lower().endswith(files.LINEAR) for name in setup.names):
        return None
    return encoding.misfits(every(raw, encoding.JUDGED), setup.lights, setup.intensities)


def _of_images(found: Inspection) -> list[str]:
    """Warnings of single images."""
    said, names = [], found.sample.names
    listed = lambda which: ", ".join(names[k] for k in which[:5]) + (f" and {len(which) - 5} more" * (len(which) > 5))
    if len(which := np.flatnonzero(found.saturated > SATURATED)):
        said.append(
            f"More than {100 * SATURATED:.0f} % of {listed(which)} is saturated. Saturated values do not count; expose "
            "less if they are more than highlights."
        )
    if len(which := np.flatnonzero(found.black > BLACK)):
        said.append(
            f"More than {100 * BLACK:.0f} % of {listed(which)} is black: was the lamp on? If not, take its line out of "
            f"{files.NAMES} and of the files of the lights."
        )
    which = np.flatnonzero(np.abs(np.log(found.exposures)) > np.log(OFF))
    which = np.setdiff1d(which, [light.number for light in found.plausibility.wrong])
    if len(which) and found.plausibility.order.known:
        said.append(
            f"The exposure of {listed(which)} seems to be off what {files.INTENSITIES} says by more than "
            f"{100 * (OFF - 1):.0f} %. That is estimated and put right by default: do not give --no-exposures."
        )
    return said


def _bits(pictures: list[Path], raw: np.ndarray) -> str:
    """Of each channel, in words. The header of PNG tells them."""
    kinds = {files.kind(file) for file in pictures}
    if len(kinds) > 1:
        return "of several kinds"
    (kind,) = kinds
    if kind == "TIFF":
        return kind + ", 8 bits" * encoding.of_8_bits(raw)
    if kind.startswith("PNG"):
        of_8 = kind == "PNG of 16 bits" and encoding.of_8_bits(raw)
        return kind.replace(" of", ",") + " (only 8 are used)" * of_8
    return {"EXR": "EXR, floating point", "JPEG": "JPEG, 8 bits"}[kind]


def _percent(part: float) -> str:
    return "under 0.01" if 0 < part < 1e-4 else f"{100 * part:.2g}"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
