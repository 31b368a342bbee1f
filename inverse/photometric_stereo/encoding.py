"""Do pictures look as if they were encoded as sRGB, though they are taken to be linear?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rimlight.inverse.targets import srgb_to_linear

from . import least_squares
from .files import LINEAR
from .vectors import LUMINANCE

#: Pixels from which this is judged.
JUDGED = 2000

#: Said of pictures that look so.
ENCODED = (
    "The pictures have 8 bits, and look as if they were encoded as sRGB, but PNG and TIFF are taken to be linear; "
    "export them with 16 bits, linear, or as JPEG, which is decoded."
)


def looks_encoded(pictures: np.ndarray, names: Sequence[str], lights: np.ndarray, intensities: np.ndarray) -> bool:
    """Do PNG or TIFF of 8 bits fit a diffuse surface better if they are decoded from sRGB? pictures : (P, K, 3), as
    read, of some pixels."""
    if not len(pictures) or not all(name.lower().endswith(LINEAR) for name in names) or not of_8_bits(pictures):
        return False
    linear, decoded = misfits(pictures, lights, intensities)
    return decoded < linear


def of_8_bits(pictures: np.ndarray) -> bool:
    """Are numbers in [0, 1] multiples of 1/255?"""
    levels = pictures * 255
    return bool(pictures.max() <= 1 + 1e-5 and np.abs(levels - np.round(levels)).max() <= 1e-2)


def misfits(pictures: np.ndarray, lights: np.ndarray, intensities: np.ndarray) -> tuple[float, float]:
    """How far pictures, (P, K, 3) in [0, 1], are off those of a diffuse surface, over their size: as they are, and
    decoded from sRGB."""

    def misfit(values: np.ndarray) -> float:
        v = (values / intensities.astype(np.float32)) @ LUMINANCE
        off = np.abs(least_squares.predicted(least_squares.trimmed(v, lights), lights) - v)
        return float(np.median(off, axis=1).sum() / np.median(v, axis=1).sum())

    return misfit(pictures), misfit(srgb_to_linear(pictures))
