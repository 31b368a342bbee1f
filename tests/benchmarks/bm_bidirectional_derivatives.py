"""Derivatives of `bdpt_edge` and of `prb_edge`, at equal time of processors:

python tests/benchmarks/bm_bidirectional_derivatives.py [--quick] [--only ...]
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
from _bench import Benchmark, Settings, duration, main, say, table

from rimlight import scenes
from rimlight.checks import Motion, derivative_image

RES, SPP, DEPTH, RUNS = 32, 64, 8, 16
X, UP = [1, 0, 0], [0, 1, 0]

#: What changes in each scene.
MOTIONS = {
    "lampshade": {
        "reflectance of a wall": {"key": "right.bsdf.reflectance.value", "direction": [1]},
        "table": {"key": "table.vertex_positions", "direction": X},
    },
    "door_ajar": {
        "reflectance of a wall": {"key": "right.bsdf.reflectance.value", "direction": [1]},
        "lamp": {"key": "lamp.to_world", "direction": X},
        "box": {"key": "box.vertex_positions", "direction": X},
        "door": {"key": "door.vertex_positions", "rotate": UP, "pivot": [-0.7, 0, 2.05]},
        "camera": {"key": "camera.to_world", "direction": X},
    },
    "glossy_caustic": {
        "roughness of the ring": {"key": "ring.bsdf.brdf_0.alpha.value", "direction": [1]},
        "lamp": {"key": "lamp.to_world", "direction": X},
        "ball": {"key": "ball.to_world", "direction": X},
        "ring": {"key": "ring.to_world", "direction": X},
        "camera": {"key": "camera.to_world", "direction": X},
    },
}
KINDS = ("prb_edge", "bdpt_edge")


def measure(name: str, what: str, settings: Settings, folder: Path) -> dict[str, Any]:
    scene = mi.load_file(str(scenes.path(name)), res=RES)
    motion = Motion(scene, **MOTIONS[name][what])
    row: dict[str, Any] = {"scene": name, "what": what}
    images = {}
    runs = 3 if settings.quick else RUNS
    for kind in KINDS:
        for term, options in (("all", {}), ("interior", {"sppp": 0, "sppi": 0})):
            it = mi.load_dict({"type": kind, "max_depth": DEPTH, **options})
            render = lambda seed, it=it: np.array(derivative_image(scene, it, motion, spp=SPP, seed=seed), np.float64)
            render(0)  # compiles
            began = time.process_time()
            images[kind, term] = np.array([render(1 + i) for i in range(runs)])
            row[f"{kind} {term} seconds"] = (time.process_time() - began) / runs
    for term in ("all", "interior"):
        best = images["bdpt_edge", term]
        mse = float(best.var(0, ddof=1).mean())
        row[f"bdpt_edge {term}"] = mse
        # Samples that find light are rare: their absence in all runs is an error, too, that their spread does not show.
        other = images["prb_edge", term]
        off = float(np.square(other - best.mean(0)).mean()) - mse / runs
        row[f"prb_edge {term}"] = max(off, float(other.var(0, ddof=1).mean()))
    say(str(row))
    return row


def gain(row: dict[str, Any], term: str) -> float:
    cost = [row[f"{kind} {term}"] * row[f"{kind} {term} seconds"] for kind in KINDS]
    return cost[0] / cost[1] if cost[1] > 0 else float("nan")


def report(found: dict[str, Any]) -> list[str]:
    lines = [
        f"{RES} × {RES} pixels, {SPP} samples per pixel, `max_depth` {DEPTH}, {RUNS} derivatives each, times of "
        "processors. **gain**: MSE · time of `prb_edge` over that of `bdpt_edge`, for all terms, and for the interior "
        "alone. The MSE of `prb_edge` is against the mean of `bdpt_edge`, or its variance, if that is more."
    ]
    columns = {
        "scene": lambda r: f"`{r['scene']}`",
        "what changes": lambda r: r["what"],
        "`prb_edge`": lambda r: duration(r["prb_edge all seconds"]),
        "`bdpt_edge`": lambda r: duration(r["bdpt_edge all seconds"]),
        "MSE `prb_edge`": lambda r: f"{r['prb_edge all']:.3g}",
        "MSE `bdpt_edge`": lambda r: f"{r['bdpt_edge all']:.3g}",
        "gain": lambda r: f"**{gain(r, 'all'):.3g}**",
        "gain, interior": lambda r: f"{gain(r, 'interior'):.3g}",
    }
    return [*lines, *table(columns, list(found.values()))]


if __name__ == "__main__":
    main(
        Benchmark(
            name="bidirectional_derivatives",
            cases={f"{s}: {what}": partial(measure, s, what) for s, every in MOTIONS.items() for what in every},
            report=report,
        )
    )
