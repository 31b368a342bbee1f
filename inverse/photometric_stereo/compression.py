"""How far are values off because their pictures are JPEG files?

JPEG transforms blocks of 8 x 8 pixels by cosines, and rounds the 64 coefficients of each block to multiples of steps,
which a table in the file states. A coefficient that is not rounded to 0 is off by at most half of its step, evenly
distributed. Of those that are rounded to 0 only the part is known. Coefficients of photographs follow Laplace's
distribution (Lam and Goodman 2000), whose width that part tells, and so how far they are off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import fft

from rimlight.inverse.targets import srgb_to_linear

from . import files
from .vectors import every

#: Pictures that are looked at, at most.
PICTURES = 12

#: Of red, green and blue, in what JPEG takes for the brightness of a pixel.
LUMA = np.array([0.299, 0.587, 0.114])

#: Width of a block.
BLOCK = 8

#: Frequencies, and the sum of their steps in the table of quality 50 (ITU-T T.81, table K.1). Higher ones have steps
#: that strong compression would make larger than a byte.
LOW, STEPS_OF_50 = 3, 118

#: Width of the distribution of means of blocks, over half of their step: hardly any is rounded to 0.
EVEN = 1e3

#: Standard deviations over the median value that are worth a warning.
FAR = 0.1


@dataclass(frozen=True)
class Compression:
    """quality : from 1 to 100, as most programs count it; NaN if no picture is JPEG. deviation : by which values are
    off, over the median value, both linear; a standard deviation."""

    quality: float = np.nan
    deviation: float = 0.0

    def __str__(self) -> str:
        return f"quality about {self.quality:.0f}, changes values by about {100 * self.deviation:.2g} % of the median"

    def said(self) -> list[str]:
        """Warnings, in sentences."""
        if not self.deviation > FAR:
            return []
        return [
            f"The pictures are JPEG of quality {self.quality:.0f} or so, which changes their values by about "
            f"{100 * self.deviation:.0f} % of the median one: normals will be wrong, and the result may be worse than "
            "its start. Save pictures as JPEG of quality 95 or more, or better as linear PNG of 16 bits; and expose "
            "more if they are dark."
        ]


def judged(folder: Path, names: Sequence[str], mask: np.ndarray) -> Compression:
    """Of the JPEG files among these pictures. mask : (H, W), bool: blocks of which it takes at least half count."""
    names = [name for name in names if name.lower().endswith(files.JPEG)]
    inside = blocks(mask).mean((1, 2)) >= 0.5
    if not names or not inside.any():
        return Compression()
    luma, steps = [], []
    for name in every(names, PICTURES):
        with Image.open(folder / name) as picture:
            of_picture = np.reshape(picture.quantization[0], (BLOCK, BLOCK)).astype(float)
            luma.append(blocks(np.asarray(picture.convert("RGB")) @ LUMA)[inside])
        steps.append(np.broadcast_to(of_picture, luma[-1].shape))
    luma, steps = np.concatenate(luma), np.concatenate(steps)
    off = deviation(luma, steps) / 255
    encoded = np.clip(luma / 255, 0, 1)
    linear = lambda e: srgb_to_linear(np.clip(e, 0, 1))
    changed = (linear(encoded + off) - linear(encoded - off)) / 2
    scale = 100 * steps[:, :LOW, :LOW].sum((1, 2)).max() / STEPS_OF_50
    quality = (200 - scale) / 2 if scale < 100 else 5000 / scale
    return Compression(float(quality), float(changed.mean() / max(np.median(linear(encoded)), 1e-6)))


def blocks(picture: np.ndarray) -> np.ndarray:
    """(H, W) in blocks, (B, 8, 8), row by row; what is left at the right and below is left out."""
    H, W = (n // BLOCK for n in picture.shape)
    whole = picture[: H * BLOCK, : W * BLOCK]
    return whole.reshape(H, BLOCK, W, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)


def deviation(luma: np.ndarray, steps: np.ndarray) -> float:
    """Standard deviation of the rounding of blocks, (B, 8, 8), in their unit, from 0 to 255. steps : (B, 8, 8)."""
    coefficients = fft.dctn(luma - 128, axes=(1, 2), norm="ortho")
    part = (np.abs(coefficients) > steps / 2).mean(0)  # of each coefficient, that is not rounded to 0
    part = np.clip(part, 0.5 / len(luma), 1 - 0.5 / len(luma))
    half = steps.mean(0) / 2
    # Widths do not grow with frequency: where all are rounded to 0, those of lower frequencies tell more
    width = half / -np.log(part)
    width[0, 0] = EVEN * half[0, 0]
    width = np.minimum.accumulate(np.minimum.accumulate(width, 0), 1)
    part = np.exp(-half / width)
    to_zero = 2 * width**2 - part * (half**2 + 2 * half * width + 2 * width**2)
    return float(np.sqrt((part * half**2 / 3 + to_zero).mean()))
