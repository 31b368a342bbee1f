"""Pictures as targets: read, checked, linear, of the size that a stage asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from skimage.transform import resize

from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import read_exr
from rimlight.loading import one_line

from .problem import Target
from .sources import numbers

#: A target whose mean is so many times that of the scene, or so many times less, is in other units.
OTHER_UNITS = 1e3

#: What a few pixels hold of the sum of squares, if the others do not matter.
NEARLY_ALL = 0.999

#: Which part of the pixels are a few; at least one.
FEW = 1e-3

#: Pictures of whole numbers, larger than so, are hardly of radiance.
BYTES = 100

#: What values below 0 may hold of the sum of absolute values: filters with negative lobes make some.
SLIGHTLY_NEGATIVE = 0.01


def read(target: Target, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Read the picture of a target.

    size : height and width of the film.

    Returns
    -------
    image : (H, W, 3 | 1), float32, linear radiance.
    weight : (H, W), float32, in [0, 1], by mask and alpha channel.

    Raises
    ------
    ValueError : a pixel that counts is not finite; or the picture has another size and `resize` is off, contradicts
        its `colour`, or has no alpha channel though `alpha` is on.
    OSError : a file cannot be read.
    """
    who = f'fit: target "{_name(target.file)}"'
    if not isinstance(target.file, Path) and (kind := numbers(target.file).dtype).kind == "i":
        raise InputError(
            f"{who} is of type {kind}; whole numbers that are sRGB are uint8 or uint16, radiance is float32"
        )
    image, encoded = read_picture(target.file)
    colour = ("srgb" if encoded else "linear") if target.colour == "auto" else target.colour
    largest = np.max(image, where=np.isfinite(image), initial=0)
    if colour == "srgb" and not encoded and largest > 1:
        raise InputError(f'{who} has values up to {largest:.3g}: it cannot be sRGB, set its colour to "linear"')
    if colour == "linear" and Path(_name(target.file)).suffix.lower() in (".jpg", ".jpeg"):
        raise InputError(f'{who}: JPEG files are never linear, set its colour to "srgb"')
    weight = np.ones(image.shape[:2], np.float32)
    if image.shape[2] in (2, 4):
        if target.alpha:
            weight = np.clip(np.nan_to_num(image[:, :, -1]), 0, 1)
        image = image[:, :, :-1]
    elif target.alpha:
        raise InputError(f"{who} has no alpha channel")
    if target.mask is not None:
        mask, _ = read_picture(target.mask)
        if mask.shape[:2] != image.shape[:2]:
            if not target.resize:
                raise InputError(
                    f'fit: mask "{_name(target.mask)}" has {mask.shape[1]} x {mask.shape[0]} pixels, '
                    f"the picture {image.shape[1]} x {image.shape[0]}"
                )
            mask = resample(mask, image.shape[:2])
        if not np.isfinite(mask[:, :, 0]).all():
            raise InputError(f'fit: mask "{_name(target.mask)}" has pixels that are not finite')
        weight = weight * np.clip(mask[:, :, 0], 0, 1)
    bad = (weight > 0) & ~np.isfinite(image).all(axis=2)
    if bad.any():
        raise InputError(f"{who} has {bad.sum()} pixels that are not finite; repair it, or exclude them by a mask")
    image = np.where(weight[..., None] > 0, image, np.float32(0))
    if colour == "srgb":
        image = srgb_to_linear(image)
    if image.shape[:2] != size:
        if not target.resize:
            raise InputError(
                f"{who} has {image.shape[1]} x {image.shape[0]} pixels, the film {size[1]} x {size[0]}; "
                "set resize to resample it"
            )
        image, weight = smaller(image, weight, size)
    if not weight.any():
        raise InputError(f"{who}: no pixel counts, mask and alpha are 0 everywhere")
    return image.astype(np.float32), weight.astype(np.float32)


def _name(source: Any) -> str:
    return source.name if isinstance(source, Path) else "in memory"


def read_picture(source: Any) -> tuple[np.ndarray, bool]:
    """Numbers of a picture: (H, W, C), float32, and whether it is of a format that encodes them, in [0, 1].

    source : path of a file, array or tensor.
    """
    if not isinstance(source, Path):
        return _decoded(numbers(source), "in memory")
    path = source
    if not path.is_file():
        raise FileNotFoundError(f'fit: there is no file "{path}"')
    if path.suffix.lower() == ".exr":
        layers, _ = read_exr(path)
        if "" not in layers and len(layers) > 1:
            raise InputError(
                f'fit: "{path.name}" has the layers {", ".join(layers)}, and which of them is the picture is unknown: '
                "give it no name (channels R, G, B), or a file of its own"
            )
        return layers.get("", next(iter(layers.values()))), False
    from skimage import io

    try:
        # scikit-image reads colours of 16 bits as 8.
        image = np.asarray(mi.Bitmap(str(path)) if path.suffix.lower() == ".png" else io.imread(path))
    except (OSError, ValueError, SyntaxError, RuntimeError) as error:
        remedy = "; save it without compression" * ("imagecodecs" in str(error))
        raise OSError(f'fit: cannot read "{path}": {one_line(error)}{remedy}') from None
    if not np.issubdtype(image.dtype, np.unsignedinteger) and not np.issubdtype(image.dtype, np.floating):
        raise InputError(f'fit: "{path.name}" is no picture of 8 or 16 bits a channel, or of floating point numbers')
    if path.suffix.lower() in (".jpg", ".jpeg") and image.ndim == 3 and image.shape[2] == 4:
        raise InputError(f'fit: "{path.name}" is printed in four colours (CMYK); convert it to RGB')
    return _decoded(image, path.name)


def _decoded(image: np.ndarray, name: str) -> tuple[np.ndarray, bool]:
    """Whole numbers, of a picture of 8 or 16 bits, as parts of the largest one; others as they are."""
    if image.ndim == 2:
        image = image[:, :, None]
    if image.ndim != 3 or image.shape[2] > 4:
        raise InputError(f'fit: "{name}" is no picture of 1 to 4 channels, its shape is {image.shape}, not (H, W, C)')
    if not np.issubdtype(image.dtype, np.unsignedinteger):
        return image.astype(np.float32), False
    return (image / np.iinfo(image.dtype).max).astype(np.float32), True


def srgb_to_linear(image: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    import colour

    return np.asarray(colour.cctf_decoding(image, function="sRGB"), np.float32)


def doubts(image: np.ndarray, target: np.ndarray, weight: np.ndarray, whole: float = 0) -> list[str]:
    """Why it may make no sense to compare a render with a target: sentences without their subject, the target.

    image : (H, W, C), the scene at the start, linear radiance. target : (H, W, C or 1). weight : (H, W).
    whole : of the target at its own size, what `whole_numbers` says.
    """
    found = []
    if whole > BYTES:
        found.append(f"is made of whole numbers, up to {whole:.0f}: if they are sRGB, give them as uint8 or uint16")
    weight = weight[..., None].astype(np.float64)
    size = np.abs(target.astype(np.float64)) * weight
    shown, wanted = (float(np.mean(np.abs(a) * weight)) for a in (image.astype(np.float64), target))
    if not shown / OTHER_UNITS <= wanted <= shown * OTHER_UNITS and wanted > 0:
        found.append(
            f"has a mean of {wanted / weight.mean():.3g}, the scene shows {shown / weight.mean():.3g} at the start: "
            "if it is in other units, scale it"
        )
    squares = np.sort(np.square(size).sum(2), axis=None)[::-1]
    few = max(int(FEW * squares.size), 1)
    if squares.size > few and squares[:few].sum() > NEARLY_ALL * squares.sum() > 0 and squares[few] > 0:
        found.append(
            f"has {few} of {squares.size} pixels, up to {size.max():.3g}, that outweigh all others in a sum of "
            "squares: leave them out by loss.exclude_above or by a mask"
        )
    negative = np.where(target < 0, size, 0).sum()
    if negative > SLIGHTLY_NEGATIVE * size.sum():
        found.append(f"has {(target < 0).sum()} values below 0, down to {target.min():.3g}: no radiance is negative")
    if target.shape[2] == 1 < image.shape[2]:
        found.append(
            f"is grey, the film has {image.shape[2]} channels: each is compared with the same numbers, which draws all "
            'colours to grey; for a scene without colours, give the film the pixel_format "luminance"'
        )
    return found


def whole_numbers(image: np.ndarray) -> float:
    """The largest number of a picture if all are whole, else 0."""
    return float(image.max()) if np.array_equal(image, np.rint(image)) else 0.0


def smaller(image: np.ndarray, weight: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A target for a film of another size: (H, W, C) and (H, W). A pixel counts if all of it does: what a render shows
    in the rest of it, nothing can leave out."""
    if image.shape[:2] == size:
        return image, weight
    whole = resample((weight > 0).astype(np.float32), size) > 1 - 1e-4
    return resample(image, size), resample(weight, size) * whole


def resample(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture of another size, (H, W, ...): means over the new pixels, as a box filter makes them; between pixels of
    a picture that is too small, linear."""
    if image.shape[:2] == size:
        return image
    # Pillow's box filter takes pixels whole or not at all: 0.24 off, at 512 → 200 pixels of white noise in [0, 1]
    if any(new > old for new, old in zip(size, image.shape, strict=False)):
        return resize(image, size, order=1, preserve_range=True).astype(np.float32)
    down, across = (_shares(old, new) for old, new in zip(image.shape, size, strict=False))
    return np.einsum("ih,hw...,jw->ij...", down, image, across, optimize=True).astype(np.float32)


def _shares(old: int, new: int) -> np.ndarray:
    """Of each new pixel, what part lies in each old one, in one dimension: (new, old), rows add up to 1."""
    borders, i = np.linspace(0, old, new + 1)[:, None], np.arange(old)
    overlap = np.minimum(borders[1:], i + 1) - np.maximum(borders[:-1], i)
    return np.maximum(overlap, 0) * (new / old)
