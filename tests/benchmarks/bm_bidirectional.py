"""Images of `bdpt` and of `path`, at equal time:  python tests/benchmarks/bm_bidirectional.py [--quick] [--only ...]

Scenes of `rimlight.scenes`: those in which light is hard to find from the camera, and others that lie in the open. The
pictures show what each way to make a path adds to an image.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
from _bench import Benchmark, Settings, duration, figure, main, save, say, table, timed

from rimlight import scenes

RES, SPP = 128, 64
WAYS, EXPOSURE = "glossy_caustic", 4.0
HARD = ("lampshade", "door_ajar", "glossy_caustic")
PAIR_EXPOSURE = {"lampshade": 4.0, "door_ajar": 8.0, "glossy_caustic": 2.0}
OPEN = ("lit_room", "objects", "shadow_blocker")


def measure(name: str, settings: Settings, folder: Path) -> dict[str, Any]:
    scene = mi.load_file(str(scenes.path(name)), res=RES)
    depth = scene.integrator().depths.max_depth
    methods = {kind: mi.load_dict({"type": kind, "max_depth": depth}) for kind in ("path", "bdpt")}
    images: dict[str, list[np.ndarray]] = {kind: [] for kind in methods}
    times: dict[str, list[float]] = {kind: [] for kind in methods}
    for seed in range(settings.pick(range(13), quick=4)[-1] + 1):
        for kind, integrator in methods.items():
            image, seconds = timed(
                lambda it=integrator, kind=kind, seed=seed: mi.render(
                    scene, integrator=it, spp=SPP, seed=2 * seed + (kind == "bdpt")
                )
            )
            if seed:  # the first compiles
                images[kind].append(np.array(image, np.float64))
                times[kind].append(seconds)
    # Both are unbiased: the mean of all is a common reference for relative errors.
    mean = np.mean([i for kind in methods for i in images[kind]], 0)
    scale = np.square(mean) + 0.01 * np.square(mean.mean())
    row: dict[str, Any] = {"scene": name, "depth": depth}
    for kind in methods:
        variance = np.var(images[kind], axis=0, ddof=1)
        row[kind] = {
            "seconds": float(np.median(times[kind])),
            "variance": float(variance.mean()),
            "relative": float((variance / scale).mean()),
            "mean": float(np.mean(images[kind])),
            "error": float(np.std([i.mean() for i in images[kind]], ddof=1) / np.sqrt(len(images[kind]))),
        }
    say(str(row))
    if name in HARD:
        draw_pair(scene, name, depth, folder)
    if name == WAYS:
        draw_ways(scene, depth, folder, settings)
    return row


def draw_pair(scene: mi.Scene, name: str, depth: int, folder: Path) -> None:
    """Images of both at about equal time."""
    made, row = figure(2, 2.6, 2.9)
    for axes, kind, spp in zip(row, ("path", "bdpt"), (2 * SPP, SPP), strict=True):
        image = np.array(mi.render(scene, integrator=mi.load_dict({"type": kind, "max_depth": depth}), spp=spp))
        axes.imshow(np.clip(image * PAIR_EXPOSURE[name], 0, 1) ** (1 / 2.2))
        axes.set_title(f"{kind}, {spp} samples per pixel", fontsize=8)
        axes.axis("off")
    save(made, folder / f"bidirectional_{name}.png")


def draw_ways(scene: mi.Scene, depth: int, folder: Path, settings: Settings) -> None:
    """The table of Veach 1997, figure 10.2: rows by length, columns by vertices from the light."""
    it = mi.load_dict({"type": "bdpt", "max_depth": depth, "light_paths": 1.0})
    longest = min(depth, 5)
    made, axes = figure(1)
    made.clear()
    made.set_size_inches(1.6 * (longest + 1), 1.75 * (longest - 1))
    grid = made.subplots(longest - 1, longest + 1, squeeze=False)
    for row, k in zip(grid, range(2, longest + 1), strict=True):
        for s, axes in enumerate(row):
            axes.axis("off")
            if s > k:
                continue
            it.ways = (s, k + 1 - s)
            image = np.array(mi.render(scene, integrator=it, spp=16 if settings.quick else 512, seed=s))
            shown = np.clip(image * EXPOSURE * 2 ** (k - 2), 0, 1) ** (1 / 2.2)
            axes.imshow(shown)
            axes.set_title(f"s = {s}, t = {k + 1 - s}", fontsize=8)
    save(made, folder / "bidirectional_ways.png")


def gain(row: dict[str, Any], of: str) -> float:
    cost = {kind: row[kind]["seconds"] * row[kind][of] for kind in ("path", "bdpt")}
    return cost["path"] / cost["bdpt"]


def report(found: dict[str, Any]) -> list[str]:
    lines = [
        f"{RES} × {RES} pixels, {SPP} samples per pixel, the `max_depth` of the scene, the median of 12 images each, "
        "in turn. **gain**: MSE · time of `path` over that of `bdpt`; **relative**: the same of relative squared "
        "errors, in which dark pixels count as much as bright ones. Both are unbiased: MSE is the variance between "
        "images."
    ]
    columns = {
        "scene": lambda r: f"`{r['scene']}`",
        "depth": lambda r: r["depth"],
        "`path`": lambda r: duration(r["path"]["seconds"]),
        "`bdpt`": lambda r: duration(r["bdpt"]["seconds"]),
        "MSE `path`": lambda r: f"{r['path']['variance']:.3g}",
        "MSE `bdpt`": lambda r: f"{r['bdpt']['variance']:.3g}",
        "gain": lambda r: f"**{gain(r, 'variance'):.3g}**",
        "relative": lambda r: f"{gain(r, 'relative'):.3g}",
    }
    for title, names in (("Light that is hard to find:", HARD), ("In the open:", OPEN)):
        rows = [found[name] for name in names if name in found]
        lines += [title, *table(columns, rows)] if rows else []
    return lines


if __name__ == "__main__":
    main(
        Benchmark(
            name="bidirectional",
            cases={name: partial(measure, name) for name in (*HARD, *OPEN)},
            report=report,
        )
    )
