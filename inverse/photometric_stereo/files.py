"""The files of a folder for photometric stereo, one at a time: text, pictures, and the truth if it is known."""

from __future__ import annotations

import difflib
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

MASK, DIRECTIONS, INTENSITIES, NAMES, LEDS, CAMERA, DISTANCE, LIGHT_DISTANCE = (
    "mask.png",
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

#: With what files of these kinds begin, whatever their names are.
BEGINNINGS = {
    b"\x89PNG": ("PNG", (".png",)),
    b"\xff\xd8\xff": ("JPEG", JPEG),
    b"v/1\x01": ("EXR", (".exr",)),
    b"II*\0": ("TIFF", (".tif", ".tiff")),
    b"MM\0*": ("TIFF", (".tif", ".tiff")),
}

#: What has to be in a file, said where it is missing or odd.
CONTENT = {
    MASK: "it is a picture that is white where the object is, and black elsewhere",
    DIRECTIONS: 'it has x y z towards its light for each image, a line each; "rimlight ps calibrate" finds them from '
    "pictures of a ball",
    INTENSITIES: "it has r g b of its light for each image, a line each, or one number for all three",
}


def check_there(path: Path) -> None:
    """Raises FileNotFoundError if there is no such file, with the names of files that may be meant, and with what it
    has to be."""
    if path.is_file():
        return
    said = f"; {CONTENT[path.name]}" if path.name in CONTENT else ""
    if path.parent.is_dir():
        names = {p.name.lower(): p.name for p in path.parent.iterdir() if p.is_file()}
        same = [name for low, name in names.items() if Path(low).stem == path.stem.lower()]
        close = same or [names[low] for low in difflib.get_close_matches(path.name.lower(), names, 3, 0.8)]
        digits = lambda name: re.findall(r"\d+", name)  # 004.png is not meant where 005.png is missing
        close = [name for name in close if digits(name) == digits(path.name)]
        said += f'; is it "{close[0]}"?' if close else ""
    raise FileNotFoundError(f'ps: there is no file "{path}"{said}')


# ---------------------- Text ----------------------


def read_text(path: Path) -> str:
    """Raises ValueError if it is not text in UTF-8, OSError if there is none."""
    check_there(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"ps: {path.name} is not text in UTF-8; save it as such") from None


def read_numbers(path: Path, columns: int, *, or_one: bool = False) -> np.ndarray:
    """A text file of numbers, with spaces, commas or semicolons between them: (lines, columns).

    or_one : lines may have one number, which stands for all columns.

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
        row = row * columns if or_one and len(row) == 1 else row
        if len(row) != columns or not np.isfinite(row).all():
            got = line.strip() if len(line) < 60 else line.strip()[:57] + "..."
            commas = "." not in line and re.search(r"\d,\d", line) is not None
            raise InputError(
                f'ps: {path.name}, line {k}: expected {columns} finite number{"s" * (columns > 1)}, got "{got}"'
                + "; take a header away, or begin it with #" * (not row)
                + (f"; {CONTENT[path.name]}" if row and path.name in CONTENT else "")
                + "; write decimals with a point" * (commas and len(row) > columns)
            )
        rows.append(row)
    if not rows:
        raise InputError(f"ps: {path.name} is empty")
    return np.array(rows)


def read_names(folder: Path) -> list[str]:
    """Of the images of a folder: those that `filenames.txt` lists, else all pictures but masks, truths and hidden
    files, by name, where numbers count as such: 2 comes before 10. The list may have quotation marks, comments, lines
    that begin with #, and the backslashes of Windows.

    Raises
    ------
    ValueError : one is listed twice; there are none. OSError : there is no such folder.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f'ps: there is no folder "{folder}"')
    if (folder / NAMES).is_file():
        lines = (line.strip().strip("\"'") for line in read_text(folder / NAMES).splitlines())
        there = lambda name: (folder / name).is_file()
        names = [line for line in lines if line and (there(line) or not line.startswith("#"))]
        names = [name if there(name) else Path(name.replace("\\", "/")).as_posix() for name in names]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise InputError(f'ps: {NAMES} lists "{twice[0]}" twice')
        return names
    other = lambda p: p.stem.lower().endswith("mask") or p.stem.lower() in ("normal_gt", "depth_gt")
    hidden = lambda p: p.name.startswith(".")  # such as ._1.png, which macOS writes beside 1.png
    pictures = (p for p in folder.iterdir() if p.suffix.lower() in KINDS and p.is_file())
    names = [p.name for p in pictures if not (other(p) or hidden(p))]
    if not names:
        raise InputError(f'ps: there are no pictures in "{folder}"{_elsewhere(folder)}')
    return sorted(names, key=lambda name: [int(w) if w.isdecimal() else w for w in re.split(r"(\d+)", name)])


def _elsewhere(folder: Path) -> str:
    """Where pictures may be instead, and what to do then."""
    below = [p for p in sorted(folder.glob("*/*")) if p.suffix.lower() in KINDS]
    if below:
        name = below[0].relative_to(folder).as_posix()
        return f'; move those of "{below[0].parent.name}" there, or list them in {NAMES}, as {name}'
    others = sorted({p.suffix for p in folder.iterdir() if p.is_file()} - {"", ".txt", ".csv", ".mat", *KINDS})
    return f"; make EXR, PNG or TIFF (16 bits, linear), or JPEG of the files {', '.join(others)}" if others else ""


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
    check_there(path)
    _check_kind(path)
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


def _check_kind(path: Path) -> None:
    """Raises ValueError if a picture is not of the kind that its name says, on which depends how it is decoded."""
    with path.open("rb") as file:
        first = file.read(4)
    for beginning, (name, suffixes) in BEGINNINGS.items():
        if first.startswith(beginning) and path.suffix.lower() not in suffixes:
            raise InputError(
                f'ps: "{path.name}" is a {name} file, whatever its name says; rename it so that it ends with '
                f"{suffixes[0]}, for that says how its values are decoded"
            )


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
    if not (folder / LEDS).is_file():
        said += _behind(folder)
    if not any((folder / name).is_file() for name in (LEDS, INTENSITIES)):
        lengths = np.linalg.norm(read_numbers(folder / DIRECTIONS, 3), axis=1)
        if lengths.max() > UNEVEN * lengths.min():
            said.append(
                f"The directions in {DIRECTIONS} have lengths from {lengths.min():.3g} to {lengths.max():.3g}, which "
                f"do not count. If they are intensities, write these to {INTENSITIES}; if the lines are positions, "
                "they must be relative to the object."
            )
    return said


def _behind(folder: Path) -> list[str]:
    """Lights behind the object, where they shine on its border only, beside others in front of it."""
    lines = np.flatnonzero(read_numbers(folder / DIRECTIONS, 3)[:, 2] <= 0) + 1
    if not lines.size:
        return []
    listed = ", ".join(map(str, lines[:10])) + ", ..." * (lines.size > 10)
    return [
        f"The lights of line {listed} of {DIRECTIONS} have a z of 0 or less, and so are behind the object, as the "
        "camera sees it. If they were in front of it, correct the signs."
    ]


def kind(path: Path) -> str:
    """Of a picture, in words, from its name and its header."""
    suffix = path.suffix.lower()
    if suffix != ".png":
        return "EXR" if suffix == ".exr" else "JPEG" if suffix in JPEG else "TIFF"
    with path.open("rb") as file:
        return f"PNG of {file.read(25)[24]} bits"


def _numbers_of_picture(path: Path) -> np.ndarray:
    """(H, W, C), float32."""
    check_there(path)
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
