"""The derivative of many images with respect to a depth map:  python tests/benchmarks/bm_depth_map.py [--quick]

A relief of one depth for each pixel under distant lights, seen by an orthographic sensor, as in photometric stereo. One
backward pass of `rig` gives the derivative of a weighted sum of all images with respect to all depths, cast shadows
included; some of them are compared with finite differences.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from _bench import Benchmark, Settings, cases, code, duration, figure, main, percent, save, say, table, timed

RES, LIGHTS, SPP = 128, 96, 4
PIXELS = 20  # that are compared
STEP = 2e-3  # of the finite differences; a pixel is 1.6e-2 wide
KEY = "relief.vertex_positions"
STEPS_PER_MEAN = 60  # backward passes of 64 samples per pixel behind the derivatives that are compared


def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A hill, a pit and waves."""
    hill = 0.25 * np.exp(-((x - 0.2) ** 2 + (y + 0.1) ** 2) / 0.05)
    pit = -0.2 * np.exp(-((x + 0.4) ** 2 + (y - 0.3) ** 2) / 0.03)
    return hill + pit + 0.15 * np.sin(4 * x + 1) * np.cos(3 * y)


def directions(count: int) -> np.ndarray:
    """Towards the lights, up to 65 degrees off the axis of the sensor: (count, 3)."""
    k = np.arange(count)
    r, φ = np.sqrt((k + 0.5) / count) * np.sin(np.radians(65)), k * np.pi * (3 - np.sqrt(5))
    return np.stack([r * np.cos(φ), r * np.sin(φ), np.sqrt(1 - r * r)], -1)


class Relief:
    """The scene, and a weighted sum of its images. The weights differ between the images, and are positive, so that
    their derivatives do not cancel."""

    def __init__(self, res: int, lights: int):
        y, x = np.meshgrid(np.linspace(-1, 1, res), np.linspace(-1, 1, res), indexing="ij")
        self.places = np.stack([x, y, heights(x, y)], -1).reshape(-1, 3)
        i = np.arange(res * res).reshape(res, res)
        a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
        faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
        self.scene = cases.scene(
            sensor={
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": cases.film(width=res, height=res),
                "sampler": {"type": "multijitter"},
            },
            relief=cases.mesh("relief", self.places, faces, False, bsdf=cases.diffuse(0.6)),
            lights={
                "type": "distant_lights",
                "directions": ", ".join(" ".join(f"{v:.6f}" for v in d) for d in directions(lights)),
                "irradiance": 1.0,
            },
        )
        self.params = mi.traverse(self.scene)
        self.integrator = mi.load_dict({"type": "rig", "max_depth": 2})
        rng = np.random.default_rng(0)
        waves = [1 + 0.7 * np.sin(3 * rng.normal() * x + 3 * rng.normal() * y + rng.normal()) for _ in range(lights)]
        self.weights = np.repeat(np.stack(waves, -1), 3, axis=2).astype(np.float32)
        self.inner = i[8:-8, 8:-8].ravel()

    def loss_and_gradient(self, seed: int, spp: int, integrator: Any = None) -> np.ndarray:
        """Derivative with respect to each depth, by one render and one backward pass: (res²,)."""
        places = mi.Float(self.places.ravel().astype(np.float32)) * dr.opaque(mi.Float, 1)
        dr.enable_grad(places)
        self.params[KEY] = places
        self.params.update()
        image = mi.render(self.scene, self.params, integrator=integrator or self.integrator, spp=spp, seed=seed)
        dr.backward(dr.sum(image * mi.TensorXf(self.weights), axis=None))
        return np.array(dr.grad(places)).reshape(-1, 3)[:, 2]

    def loss(self, places: np.ndarray, seed: int, spp: int) -> float:
        self.params[KEY] = mi.Float(places.ravel().astype(np.float32))
        self.params.update()
        image = mi.render(self.scene, integrator=self.integrator, spp=spp, seed=seed)
        return float(np.sum(np.array(image, np.float64) * self.weights))

    def difference(self, vertex: int, seed: int, spp: int) -> float:
        """By equal random numbers on both sides."""
        sides = []
        for sign in (1, -1):
            places = self.places.copy()
            places[vertex, 2] += sign * STEP
            sides.append(self.loss(places, seed, spp))
        return (sides[0] - sides[1]) / (2 * STEP)


def time_of_step(settings: Settings, _: Path) -> dict[str, Any]:
    relief = Relief(RES, LIGHTS)
    seconds = [
        timed(lambda seed=seed: relief.loss_and_gradient(seed, SPP))[1] for seed in range(3 if settings.quick else 9)
    ]
    return {"first": seconds[0], "median": float(np.median(seconds[1:])), "all": seconds}


def against_differences(settings: Settings, _: Path) -> dict[str, Any]:
    relief = Relief(RES, LIGHTS)
    steps, spp, seeds, pixels = (3, 16, 2, 2) if settings.quick else (STEPS_PER_MEAN, 64, 4, PIXELS)
    found = []
    for seed in range(steps):
        found.append(relief.loss_and_gradient(1000 + seed, spp))
        say(f"derivative {seed + 1} of {steps}")
    mean, error = np.mean(found, 0), np.std(found, 0, ddof=1) / np.sqrt(steps)
    without = relief.loss_and_gradient(0, 64, mi.load_dict({"type": "rig", "max_depth": 2, "sppi": 0}))
    rows = []
    for vertex in np.random.default_rng(1).choice(relief.inner, pixels, replace=False):
        d = [relief.difference(vertex, 7 + seed, spp) for seed in range(seeds)]
        row = {
            "pixel": [int(vertex % RES), int(vertex // RES)],
            "derivative": float(mean[vertex]),
            "error": float(error[vertex]),
            "difference": float(np.mean(d)),
            "its_error": float(np.std(d, ddof=1) / np.sqrt(seeds)),
            "without_shadows": float(without[vertex]),
        }
        say(str(row))
        rows.append(row)
    return {"rows": rows}


def report(found: dict[str, Any]) -> list[str]:
    lines = [f"A relief of {RES} × {RES} depths under {LIGHTS} distant lights, `max_depth` 2."]
    if "time" in found:
        t = found["time"]
        lines += [
            f"Images and derivative of their weighted sum with respect to all depths, {SPP} samples per pixel: "
            f"{duration(t['median'])} (first call {duration(t['first'])}).",
        ]
    if "differences" in found:
        rows = found["differences"]["rows"]
        d, e, f, g, w = (
            np.array([r[k] for r in rows])
            for k in ("derivative", "error", "difference", "its_error", "without_shadows")
        )
        z, noise = (d - f) / np.hypot(e, g), np.sqrt(2 / np.pi) * np.hypot(e, g).sum() / np.abs(f).sum()
        relative = lambda a: np.abs(a - f).sum() / np.abs(f).sum()
        lines += [
            f"{len(rows)} depths at random against finite differences: relative L1 {percent(relative(d))}, of which "
            f"noise {percent(noise)}; largest |z| {np.abs(z).max():.1f}. Without the boundaries of cast shadows "
            f"(`sppi` 0): {percent(relative(w))}.",
            *table(
                {
                    "pixel": lambda r: ", ".join(map(str, r["pixel"])),
                    code("rig"): lambda r: f"{r['derivative']:.2f} ± {r['error']:.2f}",
                    "finite differences": lambda r: f"{r['difference']:.2f} ± {r['its_error']:.2f}",
                    "without shadows": lambda r: f"{r['without_shadows']:.2f}",
                },
                rows,
            ),
        ]
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    if "differences" not in found:
        return
    rows = found["differences"]["rows"]
    made, (axes,) = figure(1)
    x, y = ([r[k] for r in rows] for k in ("difference", "derivative"))
    axes.errorbar(x, y, xerr=[2 * r["its_error"] for r in rows], yerr=[2 * r["error"] for r in rows], fmt="o", ms=3)
    axes.plot(x, [r["without_shadows"] for r in rows], "x", label="without cast shadows")
    axes.axline((0, 0), slope=1, color="grey", linewidth=0.8)
    axes.set(xlabel="finite differences", ylabel="derivative")
    axes.legend(fontsize=8)
    save(made, folder / "depth_map.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="depth_map",
            cases={"time": time_of_step, "differences": against_differences},
            report=report,
            plot=plot,
        )
    )
