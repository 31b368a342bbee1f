"""What one image tells of a BSDF, of a convex and of a concave object:  python tests/benchmarks/bm_single_image.py

Bangaru 2019, section 6.1.4, has it that light that is reflected twice comes from more pairs of directions. A ball and a
bowl of the same curvature, known shape and light, one image with 1 % of noise: how much of the BSDF do they tell?

With the derivatives J of the pixels with respect to the weights of the dictionary, over the noise, and an uncertainty
of the weights of 0.1 before, the covariance of the weights after is (JᵀJ + 1/0.1²)⁻¹. From it: how many numbers are
known (Σ λ / (λ + 1/0.1²) over the eigenvalues λ of JᵀJ), and what is left of the error of the BSDF, over all pairs of
directions, weighted by cosines. J has been rendered twice, so that its noise does not look like information.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
from _bench import Benchmark, Settings, main, say, table

from rimlight import ggx
from rimlight.inverse.photometric_stereo.dataset import Dataset
from rimlight.inverse.photometric_stereo.direct import Guess
from rimlight.inverse.photometric_stereo.rendering import Rendering
from rimlight.inverse.photometric_stereo.vectors import unit

SIZE, CURVATURE, LIGHT = 32, 0.87, (0.25, 0.15, 1.0)
UNCERTAINTY, NOISE, FLOOR = 0.1, 0.01, 0.002
STEP = 0.1

#: Peaks of the BSDF beyond this quantile of its values do not count more than it.
PEAKS = 99.9


def derivatives(concave: bool, weights: np.ndarray, spp: int, seed: int) -> np.ndarray:
    """Of the green values of the pixels with respect to the weights, over their noise: (P, B)."""
    centre, radius = (SIZE - 1) / 2, SIZE / 2 / CURVATURE
    y, x = np.mgrid[:SIZE, :SIZE] - centre
    mask = x * x + y * y < (SIZE / 2 - 1) ** 2
    lights = np.tile(unit(np.array(LIGHT)), (3, 1))  # a data set has three, here all the same
    data = Dataset(np.ones((mask.sum(), 3, 3), np.float32), mask, lights, np.ones((3, 3)))
    rendering = Rendering(data, ggx.read_dictionary()[0], max_depth=6)
    rows, columns = np.nonzero(rendering.domain.wide)
    dx, dy, sign = columns - 1 - centre, -(rows - 1 - centre), -1 if concave else 1
    height = np.sqrt(np.maximum(radius**2 - dx**2 - dy**2, 0.05 * radius**2))
    normals = unit(np.stack([sign * dx, sign * dy, height], 1))[rendering.domain.inner]

    def image(weights: np.ndarray) -> np.ndarray:
        rendering.update(Guess(normals, np.ones(len(normals)), np.ones(3), weights), sign * height)
        return rendering.image(spp=spp, seed=seed)[:, 0, 1].astype(np.float64)

    values = image(weights)
    J = np.stack([(image(weights + STEP * lobe[:, None]) - values) / STEP for lobe in np.eye(len(weights))], 1)
    return J / (NOISE * values + FLOOR * np.median(values))[:, None]


def measure(concave: bool, material: str, settings: Settings, _: Path) -> dict[str, Any]:
    lobes, materials = ggx.read_dictionary()
    spp = 128 if settings.quick else 2048
    one, other = (derivatives(concave, materials[material], spp, seed) for seed in (0, 1))
    known, axes = np.linalg.eigh((one.T @ other + other.T @ one) / 2)
    known = np.maximum(known, 0)
    covariance = (axes / (known + 1 / UNCERTAINTY**2)) @ axes.T
    rng = np.random.default_rng(0)
    f = np.array(ggx.lobes(lobes, *(mi.Vector3f(cosine_distributed(20_000, rng)) for _ in range(2))), np.float64)
    f = np.minimum(f, np.percentile(f, PEAKS))
    left = np.einsum("bm,bc,cm->", f, covariance, f) / (UNCERTAINTY**2 * (f**2).sum())
    row = {"numbers": float((known / (known + 1 / UNCERTAINTY**2)).sum()), "left": float(np.sqrt(left))}
    say(str(row))
    return row


def cosine_distributed(count: int, rng: np.random.Generator) -> np.ndarray:
    """Directions, (3, N)."""
    r2, phi = rng.random(count), 2 * np.pi * rng.random(count)
    return np.stack([np.sqrt(r2) * np.cos(phi), np.sqrt(r2) * np.sin(phi), np.sqrt(1 - r2)])


def report(found: dict[str, Any]) -> list[str]:
    columns = {
        "<object": lambda r: r["name"],
        "numbers known": lambda r: f"{r['numbers']:.1f}",
        "error of the BSDF, left": lambda r: f"{r['left']:.1%}",
    }
    return table(columns, [{"name": name, **case} for name, case in found.items()])


if __name__ == "__main__":
    cases = {
        f"{shape}, {material}": partial(measure, shape == "bowl", material)
        for material in ("gray-plastic", "white-paint")
        for shape in ("ball", "bowl")
    }
    main(Benchmark(name="single_image", cases=cases, report=report))
