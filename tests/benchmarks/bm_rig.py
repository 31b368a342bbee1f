"""Many lights, one image each:  python tests/benchmarks/bm_rig.py [--quick] [--only ...]

A bumpy ball above a floor under 1 to 96 distant lights. `rig` renders and differentiates them together; its peers, one
light after the other, in a scene of its own, as functions that are frozen, and as plain calls of `mi.render`.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
from _bench import (
    Benchmark,
    Settings,
    at_resolution,
    bumpy_ball,
    cases,
    code,
    duration,
    figure,
    main,
    percent,
    save,
    say,
    table,
    timed,
)

LIGHTS = (96, 24, 6, 1)
RES, SPP, DEPTH = 128, 4, 3
PEERS = 3  # lights whose single renders are measured
ALONE = {"image": {"type": "path"}, "step": {"type": "prb"}}
WHAT = {
    "image": "An image of each light. Peer: `path`.",
    "step": "A step of an optimisation, as far as rendering goes: images, a loss, its gradient with respect to normals "
    "and colour of the ball. Peer: Mitsuba's `prb`.",
}


def directions(count: int) -> np.ndarray:
    """Spread evenly over the upper half of a sphere, but for its lowest part: (count, 3)."""
    y = 0.2 + 0.75 * (np.arange(count) + 0.5) / count
    φ = np.arange(count) * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - y**2)
    return np.stack([r * np.cos(φ), y, r * np.sin(φ)], 1)


def emitters(d: np.ndarray) -> dict[str, dict]:
    return {f"light{i:02d}": {"type": "directional", "direction": (-v).tolist()} for i, v in enumerate(d)}


def table_of_lights(d: np.ndarray) -> dict[str, dict]:
    return {"lights": {"type": "distant_lights", "directions": mi.TensorXf(d.astype(np.float32))}}


def ball(lights: dict[str, dict]) -> mi.Scene:
    build = lambda: cases.scene(
        sensor=cases.camera((0, 3, -6), (0, 0.3, 0)),
        floor=cases.horizontal((0, -1, 0), 3, "floor", bsdf=cases.diffuse(0.5)),
        ball=bumpy_ball(41, "ball", True, bsdf=cases.diffuse(0.6, 0.5, 0.4)),
        **lights,
    )
    return at_resolution(build, RES)


def image(scene, integrator, seed):
    return mi.render(scene, integrator=integrator, spp=SPP, seed=seed)


def step(scene, integrator, seed):
    loss = dr.mean(dr.square(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=SPP, seed=seed) - 0.2))
    dr.backward(loss)
    return loss.array


class Runner:
    """Calls of an integrator in one scene."""

    def __init__(self, what: str, lights: dict[str, dict], integrator: dict[str, Any], freeze: bool):
        self.scene, self.integrator = ball(lights), mi.load_dict(integrator)
        self.function: Callable = {"image": image, "step": step}[what]
        if freeze:
            plain = self.function
            wrapped = lambda *arguments: plain(*arguments)
            known = getattr(self.integrator, "find_boundaries", lambda scene: None)
            self.function = dr.freeze(wrapped, state_fn=lambda scene, *_: known(scene))
        params = mi.traverse(self.scene)
        self.values = {
            k: params[k] * dr.opaque(mi.Float, 1) for k in ("ball.vertex_normals", "ball.bsdf.reflectance.value")
        }
        dr.eval(self.values)
        self.differentiates = what == "step"

    def __call__(self, seed: int) -> float:
        """Seconds, without the update of the scene."""
        params = mi.traverse(self.scene)
        gradients = []
        if self.differentiates:
            for key, value in self.values.items():
                params[key] = type(value)(value)
                dr.enable_grad(params[key])
            params.update()
            gradients = [params[key] for key in self.values]
        seed = dr.opaque(mi.UInt32, seed)
        dr.eval(gradients)

        def run():
            result = self.function(self.scene, self.integrator, seed)
            return result, [dr.grad(value) for value in gradients]

        return timed(run)[1]


def measure(what: str, make: Callable[[np.ndarray], dict], settings: Settings, _: Path) -> dict[str, Any]:
    rows = []
    calls = 3 if settings.quick else 15
    for count in settings.pick(LIGHTS, quick=1):
        d = directions(count)
        rig = {"type": "rig", "max_depth": DEPTH, "sppp": 0, "sppi": 0}
        alone = {**ALONE[what], "max_depth": DEPTH}
        chosen = np.linspace(0, count - 1, PEERS).round().astype(int)
        row: dict[str, Any] = {"lights": count}
        # In turn, so that all see the same machine.
        runners = {
            "rig_frozen": [Runner(what, make(d), rig, True)],
            "rig": [Runner(what, make(d), rig, False)],
            "alone_frozen": [Runner(what, emitters(d[i : i + 1]), alone, True) for i in chosen],
            "alone": [Runner(what, emitters(d[i : i + 1]), alone, False) for i in chosen],
        }
        times: dict[str, list[float]] = {key: [] for key in runners}
        for seed in range(calls + 3):
            for key, of in runners.items():
                times[key].append(float(np.mean([runner(seed) for runner in of])))
        for key, found in times.items():
            row[key] = float(np.median(found[3:])) * (count if key.startswith("alone") else 1)
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        runners["rig"][0](99)
        row["peak_bytes"] = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
        say(str(row))
        rows.append(row)
        del runners
        gc.collect()
        dr.flush_malloc_cache()
    return {"rows": rows}


def report(found: dict[str, Any]) -> list[str]:
    lines = [
        f"{RES} × {RES} pixels, {SPP} samples per pixel, `max_depth` {DEPTH}. **alone**: one light after "
        f"the other ({PEERS} are measured, and multiplied). **memory**: the most that Dr.Jit held in a call of `rig`."
    ]
    for name, case in found.items():
        what, lights = name.split("_", 1)
        kind = "one emitter `distant_lights`" if lights == "table" else "emitters `directional`"
        lines += [
            f"{WHAT[what]} Lights of `rig`: {kind}.",
            *table(
                {
                    "lights": lambda r: r["lights"],
                    code("rig"): lambda r: duration(r["rig"]),
                    "frozen": lambda r: duration(r["rig_frozen"]),
                    "alone": lambda r: duration(r["alone"]),
                    "alone, frozen": lambda r: duration(r["alone_frozen"]),
                    "plain / plain": lambda r: percent(r["rig"] / r["alone"]),
                    "frozen / frozen": lambda r: percent(r["rig_frozen"] / r["alone_frozen"]),
                    "memory": lambda r: f"{r['peak_bytes'] / 2**20:.0f} MiB",
                },
                case["rows"],
            ),
        ]
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    made, row = figure(2)
    for axes, what in zip(row, WHAT, strict=True):
        rows = found[f"{what}_emitters"]["rows"] if f"{what}_emitters" in found else []
        x = [r["lights"] for r in rows]
        for key, label, style in (
            ("rig", "rig", "C0-"),
            ("rig_frozen", "rig, frozen", "C0--"),
            ("alone", "alone", "C1-"),
            ("alone_frozen", "alone, frozen", "C1--"),
        ):
            axes.loglog(x, [r[key] for r in rows], style, marker="o", label=label)
        axes.set(xlabel="lights", ylabel="time (s)", title=what)
        axes.legend(fontsize=8)
    save(made, folder / "rig.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="rig",
            cases={
                "image_emitters": partial(measure, "image", emitters),
                "step_emitters": partial(measure, "step", emitters),
                "image_table": partial(measure, "image", table_of_lights),
                "step_table": partial(measure, "step", table_of_lights),
            },
            report=report,
            plot=plot,
        )
    )
