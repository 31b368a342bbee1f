"""Derivatives of soft shadows:  python tests/benchmarks/bm_soft_shadow.py [--quick] [--out FOLDER]

`direct_edge` and Mitsuba's `direct_projective`: error over time, at 256 × 256 pixels, and for lights of many sizes.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _bench import (
    EQUAL_TIME_SPP,
    Benchmark,
    Problem,
    Settings,
    at_resolution,
    case_text,
    cases,
    duration,
    equal_time_table,
    figure,
    main,
    outliers_text,
    percent,
    plot_errors,
    save,
    table,
)

OURS, PEER = "direct_edge", "direct_projective"
METHODS = {OURS: {"type": OURS}, PEER: {"type": PEER}}

NOTES = {
    "shadow_blocker": "A square outside of the frame, between a floor and a light of half-side 0.1, moves up.",
    "shadow_small_light": "The same with a light of half-side 0.003.",
    "two_triangles_green": "Outlines and a soft shadow.",
}
LARGE = 256
HALF_SIDES = (1.0, 0.1, 0.01, 0.003)
SWEEP_SPP = 16


def against_reference(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    problem = Problem.of_case(name, METHODS)
    rows = []
    for spp in settings.pick((4, 16, 64, 256, 1024)):
        # The peer's time hardly depends on it.
        rows += problem.rows(spp, (OURS, PEER) if spp in (4, 64, 1024) else (OURS,), settings)
    return {
        "rows": rows,
        "equal_time": [problem.equal_time(OURS, PEER, rows, settings)],
        "outliers": problem.outliers(OURS, settings),
        "reference": problem.facts(),
    }


def large(settings: Settings, _: Path) -> dict[str, Any]:
    """No finite differences here: the truth is the mean of many renders of our own."""
    scene = at_resolution(cases.shadow_blocker(), LARGE)
    problem = Problem("shadow_blocker", scene, cases.BLOCKER_UP, METHODS)
    seeds = range(1000, 1002 if settings.quick else 1008)
    problem.truth, error = problem.mean_of(OURS, 16 if settings.quick else 48, seeds)
    rows = problem.rows(EQUAL_TIME_SPP, (OURS, PEER), replace(settings, calls=(8, 1)))
    return {
        "rows": rows,
        "equal_time": [problem.equal_time(OURS, PEER, rows, settings)],
        "truth_error": np.sqrt(2 / np.pi) * error.sum() / np.abs(problem.truth).sum(),
    }


def light_size(settings: Settings, _: Path) -> dict[str, Any]:
    """Time and noise at a fixed number of samples per pixel."""
    sizes = []
    for half_side in settings.pick(HALF_SIDES, quick=2):
        scene = cases.shadow_blocker(half_side=half_side)()
        problem = Problem(f"half-side {half_side}", scene, cases.BLOCKER_UP, METHODS)
        problem.truth, _error = problem.mean_of(OURS, 1024, range(1000, 1004))
        rows = problem.rows(SWEEP_SPP, (OURS, PEER), replace(settings, calls=(8, 1), seconds=2))
        sizes.append({"half_side": half_side, **{r.method: r for r in rows}})
    return {"sizes": sizes}


def report(found: dict[str, Any]) -> list[str]:
    equal = [e for name in NOTES if name in found for e in found[name]["equal_time"]]
    lines = [f"32 × 32 pixels, at the time that the peer needs for {EQUAL_TIME_SPP} samples per pixel:"]
    lines += equal_time_table(equal)
    if "large" in found:
        case = found["large"]
        lines += [
            f"{LARGE} × {LARGE} pixels. The truth is a mean of many renders of `{OURS}` itself; its own noise is "
            f"{percent(case['truth_error'])}.",
            *equal_time_table(case["equal_time"]),
        ]
    if "light_size" in found:
        lines += [
            f"Lights of other sizes, equally strong, {SWEEP_SPP} samples per pixel. The truth is a mean of many "
            f"renders of `{OURS}` itself.",
            *table(
                {
                    "half-side": lambda s: s["half_side"],
                    f"`{OURS}`: time": lambda s: duration(s[OURS]["seconds"]),
                    f"`{OURS}`: rel. L1": lambda s: percent(s[OURS]["relative_l1"]),
                    f"`{PEER}`: time": lambda s: duration(s[PEER]["seconds"]),
                    f"`{PEER}`: rel. L1": lambda s: percent(s[PEER]["relative_l1"]),
                    "efficiency ratio": lambda s: f"{s[OURS]['efficiency'] / s[PEER]['efficiency']:.3g}",
                },
                found["light_size"]["sizes"],
            ),
        ]
    lines += outliers_text(found[name] for name in NOTES if name in found)
    for name in NOTES:
        if name in found:
            lines += case_text(name, found[name], NOTES[name])
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    plot_errors({name: found[name] for name in NOTES if name in found}, folder / "soft_shadow.png")
    if "light_size" not in found:
        return
    sizes = found["light_size"]["sizes"]
    made, (time, error) = figure(2)
    for method, marker in ((OURS, "o"), (PEER, "s")):
        x = [s["half_side"] for s in sizes]
        time.loglog(x, [s[method]["seconds"] for s in sizes], marker=marker, label=method)
        error.loglog(x, [s[method]["relative_l1"] for s in sizes], marker=marker, label=method)
    time.set(xlabel="half-side of the light", ylabel="time of a derivative image (s)")
    error.set(xlabel="half-side of the light", ylabel="relative L1 error")
    time.legend(fontsize=8)
    made.suptitle(f"Shadow of a blocker, 32 × 32 pixels, {SWEEP_SPP} samples per pixel", fontsize=9)
    save(made, folder / "soft_shadow_light_size.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="soft_shadow",
            cases={**{n: partial(against_reference, n) for n in NOTES}, "large": large, "light_size": light_size},
            report=report,
            plot=plot,
        )
    )
