"""Figures like those that people photograph: a seated person with folds, glazed in three colours, matte in two, or of
one metallic paint or two.

    python tests/benchmarks/seated_figures.py glazed matte --seeds 1 2 --size 170

Near LEDs of which only the directions are known, exposures 1 % off and of six lights up to 30 %, the noise of photons
and of a sensor, 16 bits: as real sets are, and as DiLiGenT's are. The shape is a sum of ellipsoids and capsules with
waves on it, of other sizes and places for each seed, with deep folds and a step of depth. Rows say how the starts and
the result are, which kind of material was chosen, and how long it took.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
from skimage.measure import marching_cubes
# isort: on

from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import least_squares, simulation
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.vectors import unit

KINDS = {
    "glazed": "glaze:0.03,0.04,0.18|glaze:0.75,0.72,0.68|glaze:0.7,0.4,0.3",
    "matte": "diffuse:0.5,0.4,0.3|diffuse:0.25,0.2,0.16",
    "metal": "silver-metallic-paint",
    "metals": "gold-metallic-paint|alum-bronze",
}

#: Width of the grid from which meshes are made; lights; their distance, and that of the camera, in widths of the image.
GRID, LIGHTS, LEDS_AT, CAMERA_AT = 150, 96, 7.0, 11.0


# ---------------------- Shape ----------------------


def _joined(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The smooth union of two distance fields."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b * (1 - h) + a * h - width * h * (1 - h)


def _ellipsoid(p: np.ndarray, centre: tuple, radii: tuple) -> np.ndarray:
    return (np.linalg.norm((p - np.array(centre)) / np.array(radii), axis=-1) - 1) * min(radii)


def _capsule(p: np.ndarray, first: tuple, last: tuple, radius: float) -> np.ndarray:
    a, along = np.array(first), np.subtract(last, first)
    t = np.clip((p - a) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - a - t[..., None] * along, axis=-1) - radius


def write_figure(path: Path, seed: int) -> None:
    """A mesh, as OBJ."""
    rng = np.random.default_rng(seed)
    j = lambda size=0.05: rng.uniform(-size, size)
    axes = [np.linspace(-1, 1, GRID)] * 2 + [np.linspace(-0.7, 0.9, int(0.8 * GRID))]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    d = _ellipsoid(p, (j(), -0.15 + j(), 0), (0.38 + j(), 0.5 + j(), 0.33))  # body
    d = _joined(d, _ellipsoid(p, (j(), 0.55 + j(), 0.05 + j()), (0.2, 0.24, 0.21)), 0.05)  # head
    for side in (-1, 1):
        arm = (side * 0.3, 0.15, 0.05), (side * (0.32 + j()), -0.22 + j(), 0.37 + j()), 0.11
        leg = (side * 0.2, -0.5, 0.1), (side * (0.47 + j()), -0.6 + j(), 0.45 + j()), 0.17
        d = _joined(_joined(d, _capsule(p, *arm), 0.05), _capsule(p, *leg), 0.08)
    d = _joined(d, _ellipsoid(p, (0, -0.75, 0.1), (0.75, 0.14, 0.5)), 0.05)  # what it sits on
    d = np.minimum(d, _ellipsoid(p, (j(0.1), -0.22 + j(), 0.58), (0.22, 0.14, 0.05)))  # what it holds
    d = _joined(d, _ellipsoid(p, (j(0.02), 0.52, 0.27), (0.05, 0.06, 0.07)), 0.03)  # nose
    (x, y, z), (a, b, c) = np.moveaxis(p, -1, 0), rng.uniform(0, 2 * np.pi, 3)
    cloth = np.clip((0.35 - y) / 0.2, 0, 1)
    waves = 0.022 * np.sin(17 * (x + 0.25 * np.sin(3 * y + a)) + 5 * z + b) + 0.012 * np.sin(11 * y + 7 * x + c)
    vertices, faces, _, _ = marching_cubes(d + cloth * waves, 0)
    vertices = [np.interp(vertices[:, i], np.arange(len(axis)), axis) for i, axis in enumerate(axes)]
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}\n" for x, y, z in zip(*vertices, strict=True)]
    lines += [f"f {a} {b} {c}\n" for a, b, c in faces[:, ::-1] + 1]
    path.write_text("".join(lines), encoding="utf-8")


# ---------------------- Set ----------------------


def make(kind: str, seed: int, size: int, spp: int) -> Dataset:
    """As it would be read: directions of the lights only, an orthographic camera."""
    with tempfile.TemporaryDirectory() as folder:
        write_figure(Path(folder) / "figure.obj", seed)
        scene = simulation.Options(
            shape=str(Path(folder) / "figure.obj"),
            bsdf=KINDS[kind],
            size=size,
            lights=LIGHTS,
            spread=47,
            led_distance=LEDS_AT,
            focal=CAMERA_AT,
            max_depth=4,
            spp=spp,
            seed=seed,
            smooth=1.0,
        )
        data, _ = simulation.simulate(scene, progress=False)
    rng = np.random.default_rng([seed, 9])
    offsets = np.array([led.position for led in data.lights]) - [0, 0, -CAMERA_AT * size]
    off = np.exp(0.01 * rng.standard_normal(LIGHTS))
    off[rng.choice(LIGHTS, 6, replace=False)] *= rng.uniform(1.1, 1.3, 6)
    values = data.values * (off / (offsets**2).sum(1))[:, None]
    values /= np.quantile(values, 0.999)
    values += rng.standard_normal(values.shape) * np.sqrt(np.maximum(values, 0) / 20000 + 2e-4**2)
    values = np.round(np.clip(values, 0, 4) / 4 * 65535) / 65535 * 4
    return dataclasses.replace(
        data,
        values=values.astype(np.float32),
        lights=unit(offsets),
        intensities=np.ones((LIGHTS, 3)),
        camera=None,
        distance=None,
    )


def row(kind: str, seed: int, size: int, spp: int) -> str:
    data = make(kind, seed, size, spp)
    starts = [least_squares.normals(data.luminance, data.lights, method) for method in least_squares.METHODS]
    errors = " | ".join(f"{angles(normals, data.truth).mean():.2f}" for normals in starts)
    began, busy = time.perf_counter(), time.process_time()
    found = ps.reconstruct(data, progress=False)
    took, busy = time.perf_counter() - began, time.process_time() - busy
    chosen = ("several" if found.kind.several else "one") + (", under a coat" if found.kind.coat else "")
    chosen = "the start" if found.verdict == "start" else chosen
    pixels = len(data.values)
    return f"| {kind}, seed {seed} | {pixels} | {errors} | **{found.error:.2f}** | {chosen} | {took:.0f} | {busy:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--size", type=int, default=170, help="width and height of the images")
    parser.add_argument("--spp", type=int, default=48, help="samples per pixel of the images")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    columns = ("pixels", *least_squares.METHODS, "result", "chosen", "s", "s of processors")
    print(f"| | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}")
    for kind in args.kinds:
        for seed in args.seeds:
            print(row(kind, seed, args.size, args.spp), flush=True)


if __name__ == "__main__":
    main()
