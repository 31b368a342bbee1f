"""The derivative of many images with respect to a depth map:  python tests/benchmarks/bm_depth_map.py [--quick]

A relief of one depth for each pixel under distant lights, seen by an orthographic sensor, as in photometric stereo. One
backward pass of `rig` gives the derivative of a weighted sum of all images with respect to all depths, cast shadows
included; some of them are compared with finite differences.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
from _bench import Benchmark, Settings, cases, duration, figure, main, percent, save, say, table, timed

RES, LIGHTS, SPP = 128, 96, 4
PIXELS = 20  # that are compared; half of them where shadows matter most
STEP = 5e-4  # of the finite differences; a pixel is 1.6e-2 wide
KEY = "relief.vertex_positions"
SHADOW_PASSES = 24  # of 64 samples per pixel, for the boundaries of cast shadows


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

    def gradient(self, seed: int, spp: int, **options: Any) -> np.ndarray:
        """Derivative with respect to each depth, by one backward pass: (res²,). options : of the integrator."""
        places = self._attach()
        integrator = mi.load_dict({"type": "rig", "max_depth": 2, **options})
        integrator.render_backward(self.scene, self.params, mi.TensorXf(self.weights), seed=seed, spp=spp)
        return np.array(dr.grad(places)).reshape(-1, 3)[:, 2]

    def step(self, seed: int) -> np.ndarray:
        """The same as in an optimisation, with the images."""
        places = self._attach()
        image = mi.render(self.scene, self.params, integrator=self.integrator, spp=SPP, seed=seed)
        dr.backward(dr.sum(image * mi.TensorXf(self.weights), axis=None))
        return np.array(dr.grad(places)).reshape(-1, 3)[:, 2]

    def _attach(self) -> mi.Float:
        places = mi.Float(self.places.ravel().astype(np.float32)) * dr.opaque(mi.Float, 1)
        dr.enable_grad(places)
        self.params[KEY] = places
        self.params.update()
        return places

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
    seconds = [timed(lambda seed=seed: relief.step(seed))[1] for seed in range(3 if settings.quick else 9)]
    return {"first": seconds[0], "median": float(np.median(seconds[1:])), "all": seconds}


def against_differences(settings: Settings, _: Path) -> dict[str, Any]:
    """The samples of the interior derivative are those of the differences, so that their noise cancels; cast shadows
    are sampled on their own."""
    relief = Relief(RES, LIGHTS)
    passes, spp, seeds, pixels = (2, 16, 2, 4) if settings.quick else (SHADOW_PASSES, 64, 3, PIXELS)
    shadows = []
    for seed in range(passes):
        shadows.append(relief.gradient(1000 + seed, spp, sppc=0))
        say(f"shadows, pass {seed + 1} of {passes}")
    shadow, its_error = np.mean(shadows, 0), np.std(shadows, 0, ddof=1) / np.sqrt(passes)
    interior = [relief.gradient(seed, spp, sppp=0, sppi=0) for seed in range(seeds)]
    rng = np.random.default_rng(1)
    strength = np.abs(shadow[relief.inner])
    casting = relief.inner[strength > np.quantile(strength, 0.97)]
    chosen = [rng.choice(which, pixels // 2, replace=False) for which in (relief.inner, casting)]
    rows = []
    for vertex in np.concatenate(chosen):
        d = np.array([relief.difference(vertex, seed, spp) for seed in range(seeds)])
        rest = d - [g[vertex] for g in interior]  # what cast shadows must explain
        row = {
            "pixel": [int(vertex % RES), int(vertex // RES)],
            "interior": float(np.mean([g[vertex] for g in interior])),
            "shadow": float(shadow[vertex]),
            "shadow_error": float(its_error[vertex]),
            "difference": float(d.mean()),
            "rest": float(rest.mean()),
            "rest_error": float(rest.std(ddof=1) / np.sqrt(seeds)),
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
        keys = ("interior", "shadow", "shadow_error", "difference", "rest_error")
        interior, shadow, e, f, g = (np.array([r[k] for r in rows]) for k in keys)
        relative = lambda d: np.abs(d).sum() / np.abs(f).sum()
        lines += [
            f"{len(rows)} depths against finite differences, half of them at random, half where shadows matter most: "
            f"relative L1 {percent(relative(interior + shadow - f))}, of which noise "
            f"{percent(np.sqrt(2 / np.pi) * relative(np.hypot(e, g)))}. Without the boundaries of cast shadows "
            f"(`sppi` 0): {percent(relative(interior - f))}. Errors of the differences are those of three seeds.",
            *table(
                {
                    "pixel": lambda r: ", ".join(map(str, r["pixel"])),
                    "interior": lambda r: f"{r['interior']:.1f}",
                    "cast shadows": lambda r: f"{r['shadow']:.1f} ± {r['shadow_error']:.1f}",
                    "sum": lambda r: f"{r['interior'] + r['shadow']:.1f}",
                    "finite differences": lambda r: f"{r['difference']:.1f} ± {r['rest_error']:.1f}",
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
    x, errors = [r["difference"] for r in rows], [2 * np.hypot(r["rest_error"], r["shadow_error"]) for r in rows]
    axes.errorbar(x, [r["interior"] + r["shadow"] for r in rows], errors, fmt="o", ms=3, label="derivative")
    axes.plot(x, [r["interior"] for r in rows], "x", label="without cast shadows")
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
