"""Pictures as targets: read, checked, linear, of the size that a stage asks for."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from skimage.transform import resize

from rimlight.exr import read_exr
from rimlight.loading import one_line

from .problem import Target


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
    assert target.file is not None
    image, encoded = read_picture(target.file)
    colour = ("srgb" if encoded else "linear") if target.colour == "auto" else target.colour
    who = f'fit: target "{target.file.name}"'
    largest = np.max(image, where=np.isfinite(image), initial=0)
    if colour == "srgb" and not encoded and largest > 1:
        raise ValueError(f'{who} has values up to {largest:.3g}: it cannot be sRGB, set its colour to "linear"')
    if colour == "linear" and target.file.suffix.lower() in (".jpg", ".jpeg"):
        raise ValueError(f'{who}: JPEG files are never linear, set its colour to "srgb"')
    weight = np.ones(image.shape[:2], np.float32)
    if image.shape[2] in (2, 4):
        if target.alpha:
            weight = np.clip(np.nan_to_num(image[:, :, -1]), 0, 1)
        image = image[:, :, :-1]
    elif target.alpha:
        raise ValueError(f"{who} has no alpha channel")
    if target.mask is not None:
        mask, _ = read_picture(target.mask)
        if mask.shape[:2] != image.shape[:2]:
            if not target.resize:
                raise ValueError(
                    f'fit: mask "{target.mask.name}" has {mask.shape[1]} x {mask.shape[0]} pixels, '
                    f"the picture {image.shape[1]} x {image.shape[0]}"
                )
            mask = resample(mask, image.shape[:2])
        weight = weight * np.clip(mask[:, :, 0], 0, 1)
    bad = (weight > 0) & ~np.isfinite(image).all(axis=2)
    if bad.any():
        raise ValueError(f"{who} has {bad.sum()} pixels that are not finite; repair it, or exclude them by a mask")
    image = np.where(weight[..., None] > 0, image, np.float32(0))
    if colour == "srgb":
        image = srgb_to_linear(image)
    if image.shape[:2] != size:
        if not target.resize:
            raise ValueError(
                f"{who} has {image.shape[1]} x {image.shape[0]} pixels, the film {size[1]} x {size[0]}; "
                "set resize to resample it"
            )
        image, weight = smaller(image, weight, size)
    if not weight.any():
        raise ValueError(f"{who}: no pixel counts, mask and alpha are 0 everywhere")
    return image.astype(np.float32), weight.astype(np.float32)


def read_picture(path: Path) -> tuple[np.ndarray, bool]:
    """Numbers of a picture: (H, W, C), float32, and whether it is of a format that encodes them, in [0, 1]."""
    if not path.is_file():
        raise FileNotFoundError(f'fit: there is no file "{path}"')
    if path.suffix.lower() == ".exr":
        layers, _ = read_exr(path)
        return layers.get("", next(iter(layers.values()))), False
    from skimage import io

    try:
        # scikit-image reads colours of 16 bits as 8.
        image = np.asarray(mi.Bitmap(str(path)) if path.suffix.lower() == ".png" else io.imread(path))
    except (OSError, ValueError, SyntaxError, RuntimeError) as error:
        raise OSError(f'fit: cannot read "{path}": {one_line(error)}') from None
    if image.ndim == 2:
        image = image[:, :, None]
    if image.ndim != 3 or not np.issubdtype(image.dtype, np.unsignedinteger):
        raise ValueError(f'fit: "{path.name}" is no picture of 8 or 16 bits a channel')
    return (image / np.iinfo(image.dtype).max).astype(np.float32), True


def srgb_to_linear(image: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    import colour

    return np.asarray(colour.cctf_decoding(image, function="sRGB"), np.float32)


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
    if any(new > old for new, old in zip(size, image.shape, strict=False)):
        return resize(image, size, order=1, preserve_range=True).astype(np.float32)
    down, across = (_shares(old, new) for old, new in zip(image.shape, size, strict=False))
    return np.einsum("ih,hw...,jw->ij...", down, image, across, optimize=True).astype(np.float32)


def _shares(old: int, new: int) -> np.ndarray:
    """Of each new pixel, what part lies in each old one, in one dimension: (new, old), rows add up to 1."""
    borders, i = np.linspace(0, old, new + 1)[:, None], np.arange(old)
    overlap = np.minimum(borders[1:], i + 1) - np.maximum(borders[:-1], i)
    return np.maximum(overlap, 0) * (new / old)
