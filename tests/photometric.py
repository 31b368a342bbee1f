"""What several tests of photometric stereo share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from rimlight import ggx
from rimlight.inverse.photometric_stereo import dataset
from rimlight.inverse.photometric_stereo.dataset import Dataset
from rimlight.inverse.photometric_stereo.direct import DirectModel, Guess
from rimlight.inverse.photometric_stereo.rendering import Rendering
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit
from rimlight.leds import Led

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


class Scene(NamedTuple):
    """A surface and all that a rendering of it needs. depth : of the Q pixels of the domain."""

    data: Dataset
    rendering: Rendering
    guess: Guess
    depth: np.ndarray

    def model(self, **options) -> DirectModel:
        return DirectModel(self.data, self.rendering.lobes, points=self.rendering.domain.points(self.depth), **options)


def made(data: Dataset, lobes: ggx.Lobes, weights: np.ndarray, surface: Callable, max_depth: int) -> Scene:
    """surface : of rows and columns of the domain and its camera: depth, and normals of any length."""
    rendering = Rendering(data, lobes, max_depth=max_depth)
    domain, (P, K, _) = rendering.domain, data.values.shape
    depth, normals = surface(*np.nonzero(domain.wide), domain.camera)
    guess = Guess(unit(normals)[domain.inner], np.ones(P), np.ones(K), np.array(weights, np.float64))
    rendering.update(guess, depth)
    return Scene(dataclasses.replace(data, truth=guess.normals), rendering, guess, depth)


def height_field(
    lobes: ggx.Lobes,
    weights: np.ndarray,
    lights: np.ndarray,
    height: Callable,
    *,
    N: int = 24,
    max_depth: int = 3,
    mask: np.ndarray | None = None,
) -> Scene:
    """An orthographic view, of a disc that fills 0.9 of its width N.

    height : of x and y, pixels, 0 in the middle of the image: z and its two derivatives.
    """
    mask = disc(N, ((N - 1) / 2, (N - 1) / 2), 0.45 * N) if mask is None else mask
    K = len(lights)
    data = Dataset(np.ones((int(mask.sum()), K, 3), np.float32), mask, lights, np.ones((K, 3)))

    def surface(row: np.ndarray, column: np.ndarray, camera: None) -> tuple[np.ndarray, np.ndarray]:
        z, along_x, along_y = np.broadcast_arrays(*height(column - (N + 1) / 2, (N + 1) / 2 - row))
        return z, np.stack([-along_x, -along_y, np.ones_like(z)], 1)

    return made(data, lobes, weights, surface, max_depth)


def ball(x: np.ndarray, y: np.ndarray, R: float, sign: int = 1) -> tuple[np.ndarray, ...]:
    """A cap of a ball, convex (1) or concave (-1)."""
    root = np.sqrt(np.maximum(R**2 - x**2 - y**2, 0.01 * R**2))
    return sign * root, -sign * x / root, -sign * y / root


def near_ball(lobes: ggx.Lobes, weights: np.ndarray, unit_of_length: float = 1.0, K: int = 6) -> Scene:
    """Before a camera with its principal point off the centre, under LEDs; the middle of the LEDs is the camera."""
    camera = np.array([[40.0, 0, 8.0], [0, 40, 13.0], [0, 0, 1]])
    centre, R = np.array([0.4, -0.25, -6.0]) * unit_of_length, 1.5 * unit_of_length

    def surface(row: np.ndarray, column: np.ndarray, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.stack([(column - camera[0, 2]) / 40, (camera[1, 2] - row) / 40, -np.ones(len(row))], 1)
        a, b, c = (rays**2).sum(1), rays @ centre, centre @ centre - R**2
        depth = (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        return depth, depth[:, None] * rays - centre

    leds = []
    for k, (x, y, z) in enumerate(spiral(K, 80).tolist()):
        position = np.array([2 * x, 2 * y, 0.5 - z]) * unit_of_length
        leds.append(Led(tuple(position), (0.1 - 0.1 * x, -0.15 * y, -1.0), 0.5 * (k % 4), (1.0, 1.0, 1.0)))
    mask = disc(24, (10.6, 14.7), 8)
    values = np.ones((int(mask.sum()), K, 3), np.float32)
    data = Dataset(values, mask, tuple(leds), np.ones((K, 3)), camera, distance=unit_of_length)
    found = made(data, lobes, weights, surface, 3)
    distance = float(np.exp(np.log(found.depth).mean()))
    return found._replace(data=dataclasses.replace(found.data, distance=distance))


def bowl(K: int = 6, spread: float = 50, albedo: float = 0.7, rim: float = 0.9, N: int = 24, **options) -> Scene:
    """Lambertian, a cap of a ball from within. rim : sine of its angle at the rim."""
    height = lambda x, y: ball(x, y, 0.45 * N / rim, -1)
    return height_field(LAMBERT, np.full((1, 3), albedo) * [1, 0.8, 0.5], spiral(K, spread), height, N=N, **options)


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
