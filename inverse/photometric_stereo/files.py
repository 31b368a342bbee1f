"""The files of a folder for photometric stereo, one at a time: text, pictures, and the truth if it is known."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from rimlight.edge_sampling.refusals import InputError
from rimlight.inverse.targets import read_picture, srgb_to_linear

from .integration import check_camera
from .vectors import directions_of

log = logging.getLogger(__name__)

DIRECTIONS, INTENSITIES, NAMES, LEDS, CAMERA, DISTANCE, LIGHT_DISTANCE = (
    "light_directions.txt",
    "light_intensities.txt",
    "filenames.txt",
    "leds.csv",
    "K.txt",
    "distance.txt",
    "light_distance.txt",
)

#: Directions whose lengths differ by a larger factor may be more than directions.
UNEVEN = 1.1

#: What the names of pictures end with: of those that are decoded from sRGB, of whole numbers that are taken to be
#: linear, and of all that are read.
JPEG, LINEAR = (".jpg", ".jpeg"), (".png", ".tif", ".tiff")
KINDS = (".exr", *LINEAR, *JPEG)


# ---------------------- Text ----------------------


def read_text(path: Path) -> str:
    """Raises ValueError if it is not text in UTF-8, OSError if there is none."""
    if not path.is_file():
        raise FileNotFoundError(f'ps: there is no file "{path}"')
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"ps: {path.name} is not text in UTF-8; save it as such") from None


def read_numbers(path: Path, columns: int) -> np.ndarray:
    """A text file of numbers, with spaces, commas or semicolons between them: (lines, columns).

    Raises
    ------
    ValueError : a line has other words, or not as many numbers; there are none. OSError : there is no file.
    """
    rows = []
    for k, line in enumerate(read_text(path).splitlines(), 1):
        words = re.split(r"[\s,;]+", line.partition("#")[0].strip(" \t,;"))
        if words == [""]:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            got = line.strip() if len(line) < 60 else line.strip()[:57] + "..."
            commas = "." not in line and re.search(r"\d,\d", line) is not None
            raise InputError(
                f'ps: {path.name}, line {k}: expected {columns} finite number{"s" * (columns > 1)}, got "{got}"'
                + "; take a header away, or begin it with #" * (not row)
                + "; write decimals with a point" * (commas and len(row) > columns)
            )
        rows.append(row)
    if not rows:
        raise InputError(f"ps: {path.name} is empty")
    return np.array(rows)


def read_names(folder: Path) -> list[str]:
    """Of the images of a folder: those that `filenames.txt` lists, else all pictures but masks, truths and hidden
    files, by name, where numbers count as such: 2 comes before 10.

    Raises
    ------
    ValueError : one is listed twice. OSError : there is no such folder.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f'ps: there is no folder "{folder}"')
    if (folder / NAMES).is_file():
        names = [line.strip() for line in read_text(folder / NAMES).splitlines() if line.strip()]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise InputError(f'ps: {NAMES} lists "{twice[0]}" twice')
        return names
    other = lambda p: p.stem.lower().endswith("mask") or p.stem.lower() in ("normal_gt", "depth_gt")
    hidden = lambda p: p.name.startswith(".")  # such as ._1.png, which macOS writes beside 1.png
    pictures = (p for p in folder.iterdir() if p.suffix.lower() in KINDS and p.is_file())
    names = [p.name for p in pictures if not (other(p) or hidden(p))]
    return sorted(names, key=lambda name: [int(w) if w.isdecimal() else w for w in re.split(r"(\d+)", name)])


def read_camera(folder: Path) -> np.ndarray | None:
    """Intrinsic matrix, (3, 3), if the folder has one. Raises what `dataset.read` does."""
    if not (folder / CAMERA).is_file():
        return None
    camera = read_numbers(folder / CAMERA, 3)
    check_camera(f"ps: {CAMERA}", camera)
    return camera


# ---------------------- Pictures ----------------------


def read_mask(path: Path) -> np.ndarray:
    """(H, W), bool: what is brighter than half of the brightest; or of a picture of which parts are transparent, what
    is less so than half. Raises what `dataset.read` does."""
    picture = _numbers_of_picture(path)
    channels, tells = picture.shape[2], picture[..., -1]
    if channels not in (2, 4) or (tells == tells.max()).all():  # nothing is transparent
        tells = picture[..., : 3 if channels > 2 else 1].max(2)
    return tells > tells.max() / 2


def read_pixels(path: Path, mask: np.ndarray) -> np.ndarray:
    """Of a picture, the pixels of a mask: (P, 3), linear. Raises what `dataset.read` does."""
    if path.suffix.lower() not in KINDS:
        raise InputError(
            f'ps: "{path.name}" is of a format that is not read; make it EXR, PNG or TIFF (16 bits, linear), or JPEG'
        )
    picture = _numbers_of_picture(path)
    if path.suffix.lower() in JPEG:
        _check_upright(path)
    if picture.shape[:2] != mask.shape:
        (h, w), (H, W) = picture.shape[:2], mask.shape
        raise InputError(f'ps: "{path.name}" has {w} x {h} pixels, the mask {W} x {H}')
    pixels = picture[mask]
    if pixels.shape[1] in (2, 4):
        pixels = pixels[:, :-1]
    if pixels.shape[1] not in (1, 3):
        raise InputError(f'ps: "{path.name}" has {pixels.shape[1]} channels, expected grey or colours')
    if path.suffix.lower() in JPEG:
        pixels = srgb_to_linear(pixels)
    return np.broadcast_to(pixels, (len(pixels), 3))


def _check_upright(path: Path) -> None:
    """Raises ValueError if other programs show a JPEG file otherwise than its pixels are stored: its mask may be of
    either."""
    with Image.open(path) as picture:
        turned = picture.getexif().get(ExifTags.Base.Orientation, 1)
    if turned != 1:
        raise InputError(
            f'ps: "{path.name}" says (EXIF, orientation {turned}) that it must be turned to be shown; turn the pixels '
            "of all pictures, or take this entry out of them, so that they are as mask.png and as the lights are meant"
        )


def doubts(folder: Path, names: Sequence[str]) -> list[str]:
    """What the files of a folder and its pictures say of possible faults, in sentences. Raises what `dataset.read`
    does."""
    said = []
    counts = Counter(kind(folder / name) for name in names)
    if len(counts) > 1:
        listed = " and ".join(f"{count} {of_kind}" for of_kind, count in counts.items())
        said.append(
            f"The pictures are of several kinds: {listed}. Only JPEG is decoded from sRGB, and PNG and TIFF of whole "
            "numbers are divided by the largest one, EXR is not: export all pictures in the same way."
        )
    if not any((folder / name).is_file() for name in (LEDS, INTENSITIES)):
        lengths = np.linalg.norm(read_numbers(folder / DIRECTIONS, 3), axis=1)
        if lengths.max() > UNEVEN * lengths.min():
            said.append(
                f"The directions in {DIRECTIONS} have lengths from {lengths.min():.3g} to {lengths.max():.3g}, which "
                f"do not count. If they are intensities, write these to {INTENSITIES}; if the lines are positions, "
                "they must be relative to the object."
            )
    return said


def kind(path: Path) -> str:
    """Of a picture, in words, from its name and its header."""
    suffix = path.suffix.lower()
    if suffix != ".png":
        return "EXR" if suffix == ".exr" else "JPEG" if suffix in JPEG else "TIFF"
    with path.open("rb") as file:
        return f"PNG of {file.read(25)[24]} bits"


def _numbers_of_picture(path: Path) -> np.ndarray:
    """(H, W, C), float32."""
    try:
        return read_picture(path)[0]
    except (OSError, ValueError) as error:
        raise type(error)(re.sub("^fit: ", "ps: ", str(error))) from None


def read_truth(folder: Path, mask: np.ndarray) -> np.ndarray | None:
    """Normals of the pixels of a mask, (P, 3), if the folder has them; (0, 0, 0) of those pixels of which the file has
    no numbers. Raises what `dataset.read` does."""
    if (path := folder / "Normal_gt.exr").is_file():
        normals = _numbers_of_picture(path)
    elif (path := folder / "Normal_gt.mat").is_file():
        from scipy.io import loadmat

        try:
            arrays = [a for name, a in loadmat(path).items() if not name.startswith("_")]
        except (ValueError, TypeError, NotImplementedError) as error:
            raise InputError(f"ps: cannot read {path.name}: {error}") from None
        normals = next((a for a in arrays if np.ndim(a) == 3 and a.shape[2] == 3), None)
    else:
        return None
    if normals is None or normals.shape != (*mask.shape, 3):
        raise InputError(f"ps: {path.name} holds no normals of the size of the mask")
    found = directions_of(normals[mask].astype(np.float64))
    if missing := int((~found.any(1)).sum()):
        log.warning(
            "ps: %s has no normals of %d pixels of the mask; errors are those of the others", path.name, missing
        )
    return found if found.any() else None
