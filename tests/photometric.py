"""What several tests of photometric stereo share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from rimlight import ggx
from rimlight.inverse.photometric_stereo import dataset
from rimlight.inverse.photometric_stereo.dataset import Dataset

UP = np.array([0.0, 0, 1])

#: A dictionary of one lobe, the Lambertian one.
LAMBERT = ggx.Lobes((np.nan,), (np.nan,))


def glossy(lobes: ggx.Lobes) -> np.ndarray:
    """Weights, (B, 3): plastic, coloured."""
    alpha = np.array(lobes.alpha)
    weights = np.zeros((len(lobes), 3))
    weights[np.isnan(lobes.eta)] = (0.5, 0.35, 0.2)
    weights[np.nanargmin(np.abs(alpha - 0.25))] = 0.4
    return weights


def disc(N: int, centre: tuple[float, float], radius: float) -> np.ndarray:
    v, u = np.mgrid[:N, :N]
    return (u - centre[0]) ** 2 + (v - centre[1]) ** 2 < radius**2


def write_jpeg(folder: Path, data: Dataset, quality: int, *, clipped: float = 0.0) -> Path:
    """A folder of JPEG files of this quality. clipped : part of the values that are above white."""
    dataset.write(folder, data)
    np.savetxt(folder / dataset.INTENSITIES, np.ones((len(data.lights), 3)))
    names, white = [], np.quantile(data.values, 1 - clipped)
    for k in range(len(data.lights)):
        linear = np.clip(data.image(data.values[:, k]) / white, 0, 1)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        names.append(f"{k + 1:03d}.jpg")
        Image.fromarray(np.round(255 * encoded).astype(np.uint8)).save(folder / names[-1], quality=quality)
    (folder / dataset.NAMES).write_text("\n".join(names), "utf-8")
    return folder
