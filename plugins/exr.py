"""OpenEXR files with named layers and metadata, and files that are either complete or not there."""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rimlight.edge_sampling.refusals import InputError

CHANNELS = {1: "Y", 3: "RGB", 4: "RGBA"}

#: Attributes that the format itself defines.
RESERVED = frozenset(
    {"channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name", "pixelAspectRatio"}
    | {"screenWindowCenter", "screenWindowWidth", "tiles", "type", "version", "view"}
)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary file beside `path`, which takes its place at the end of the block, or is removed if the block fails.

    Raises
    ------
    OSError : the folder does not exist or cannot be written to, the disk is full, or `path` is a folder. The text names
        `path`.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        temporary.touch()
    except OSError as error:
        raise type(error)(f"cannot write {path}: {error.strerror}") from None
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def remove_left_over(path: Path) -> None:
    """Remove temporary files beside `path` of programs that were killed while they wrote it."""
    for temporary in path.parent.glob(f".{glob.escape(path.stem)}.*{glob.escape(path.suffix)}"):
        temporary.unlink(missing_ok=True)


def write_exr(
    path: str | Path, layers: Mapping[str, np.ndarray], metadata: Mapping[str, str | float | int] | None = None
) -> None:
    """Write layers of equal size to one OpenEXR file (32-bit floats, lossless ZIP compression).

    Parameters
    ----------
    path : written under a temporary name first, so that there never is half a file.
    layers : name -> (H, W, 1 | 3 | 4), channels Y, R G B or R G B A, converted to float32. The layer "" is the main
        image; the channels of the others are called ``name.R`` etc.
    metadata : attributes of the header, stored as text.

    Raises
    ------
    ValueError : there is no layer, one has another shape, or a name is one that the format needs for itself.
    OSError : the file cannot be written. The text names it.
    """
    import OpenEXR

    channels = {}
    sizes = {}
    for name, layer in layers.items():
        pixels = np.asarray(layer, np.float32)
        if pixels.ndim != 3 or pixels.shape[2] not in CHANNELS or 0 in pixels.shape:
            raise InputError(f'{path}: layer "{name}" must be of shape (H, W, 1 | 3 | 4), got {pixels.shape}')
        sizes[name] = pixels.shape[:2]
        for i, letter in enumerate(CHANNELS[pixels.shape[2]]):
            channel = f"{name}.{letter}" if name else letter
            channels[channel] = OpenEXR.Channel(channel, np.ascontiguousarray(pixels[:, :, i]))
    if not channels:
        raise InputError(f"{path}: there is no layer to write")
    if len(set(sizes.values())) > 1:
        raise InputError(f"{path}: the layers differ in size: {sizes}")
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in (metadata or {}).items():
        if key in RESERVED or not key:
            raise InputError(f'{path}: "{key}" cannot be the name of an attribute: the format needs it for itself')
        header[key] = str(value)

    with replacing(path) as temporary:
        try:
            with OpenEXR.File(header, channels) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            raise OSError(f"cannot write {path}: {error}") from None


def write_layers(
    path: str | Path, image: np.ndarray, names: Sequence[str], metadata: Mapping[str, str | float | int] | None = None
) -> None:
    """Write an image of many layers, as the integrator `rig` renders it, to one OpenEXR file.

    Parameters
    ----------
    image : (H, W, C K), the channels of one layer after those of another; C is 1 or 3.
    names : of the K layers. Their channels are called ``name.R`` etc., or ``name.Y``.
    metadata : as for `write_exr`. The order of the layers is stored in the attribute ``layers``.

    Raises
    ------
    ValueError : two layers have the same name, one has none, or the image does not divide into so many.
    OSError : as for `write_exr`.
    """
    image = np.asarray(image, np.float32)
    if len(set(names)) < len(names) or not all(names):
        raise InputError(f"{path}: the layers need names that differ, got {list(names)}")
    channels = image.shape[2] // max(len(names), 1) if image.ndim == 3 else 0
    if channels not in (1, 3) or channels * len(names) != image.shape[2]:
        raise InputError(f"{path}: an image of shape {image.shape} does not consist of {len(names)} layers")
    layers = {name: image[:, :, i * channels : (i + 1) * channels] for i, name in enumerate(names)}
    write_exr(path, layers, {"layers": json.dumps(list(names)), **(metadata or {})})


def read_layers(path: str | Path) -> tuple[np.ndarray, list[str]]:
    """Read what `write_layers` wrote.

    Returns
    -------
    image : (H, W, C K), float32.
    names : of the K layers.

    Raises
    ------
    ValueError : `write_layers` did not write this file.
    OSError : as for `read_exr`.
    """
    layers, metadata = read_exr(path)
    if "layers" not in metadata:
        raise InputError(f"{path}: the order of the layers is not stored in it")
    names = json.loads(metadata["layers"])
    return np.concatenate([layers[name] for name in names], axis=2), names


def read_exr(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read a file of one part, as `write_exr` makes them.

    Returns
    -------
    layers : name -> (H, W, C), float32, channels in the order R, G, B, A, or Y, or alphabetically for other names.
    metadata : the attributes of the header that are text.

    Raises
    ------
    OSError : the file cannot be read, or is no OpenEXR file. The text names it.
    """
    import OpenEXR

    path = Path(path)
    try:
        path.open("rb").close()
    except OSError as error:
        raise type(error)(f"cannot read {path}: {error.strerror}") from None
    if not OpenEXR.isOpenExrFile(str(path)):
        raise OSError(f"cannot read {path}: no OpenEXR file")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            pixels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
            header = dict(file.header())  # the original is emptied when the file is closed
    except (RuntimeError, ValueError) as error:  # a damaged file is "without parts"
        raise OSError(f"cannot read {path}: {error}") from None

    letters: dict[str, list[str]] = {}
    for channel in pixels:
        name, _, letter = channel.rpartition(".")
        letters.setdefault(name, []).append(letter)
    layers = {
        name: np.stack(
            [pixels[f"{name}.{letter}" if name else letter] for letter in sorted(found, key=_channel_order)], axis=2
        )
        for name, found in letters.items()
    }
    return layers, {key: value for key, value in header.items() if isinstance(value, str) and key not in RESERVED}


def _channel_order(letter: str) -> tuple[int, str]:
    return "RGBA".find(letter) % 5, letter
