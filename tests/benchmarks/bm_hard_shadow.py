"""Derivatives of hard shadows:  python tests/benchmarks/bm_hard_shadow.py [--quick] [--out FOLDER]

`direct_edge` and Mitsuba's `direct_projective`, which leaves these shadows out: error over time; and `direct_edge` with
many lights.
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
    "spot_cube": "A cube and its shadow on a floor, under a spot; the cube moves.",
    "sun_cube": "The same under the sun. (If the sun turns, the peer finds nothing to differentiate, and raises.)",
    "lit_room_camera": "A closed room with a point light; the camera moves.",
}
LIGHTS = (1, 3, 10, 30, 96)
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


def many_lights(settings: Settings, _: Path) -> dict[str, Any]:
    """Time and noise at a fixed number of samples per pixel, for distant lights around the zenith, equally strong in
    sum."""
    found = []
    for count in settings.pick(LIGHTS, quick=2):
        around = 2 * np.pi * np.arange(count) * (np.sqrt(5) - 1) / 2
        tilt = 0.9 * np.sqrt((np.arange(count) + 0.5) / count)
        directions = np.stack([np.sin(tilt) * np.cos(around), np.cos(tilt), np.sin(tilt) * np.sin(around)], 1)
        lamp = {
            "type": "distant_lights",
            "directions": ", ".join(" ".join(f"{x:.6f}" for x in d) for d in directions),
            "irradiance": 2 / count,
        }
        problem = Problem(
            f"{count} lights", cases.hard_shadow(lambda lamp=lamp: lamp)(), cases.SIDE, {OURS: METHODS[OURS]}
        )
        problem.truth, _error = problem.mean_of(OURS, 1024, range(1000, 1004))
        (row,) = problem.rows(SWEEP_SPP, (OURS,), replace(settings, calls=(8, 1), seconds=2))
        found.append({"lights": count, "row": row})
    return {"sweep": found}


def report(found: dict[str, Any]) -> list[str]:
    equal = [e for name in NOTES if name in found for e in found[name]["equal_time"]]
    lines = [f"32 × 32 pixels, at the time that the peer needs for {EQUAL_TIME_SPP} samples per pixel:"]
    lines += equal_time_table(equal)
    if "many_lights" in found:
        lines += [
            f"Many distant lights, {SWEEP_SPP} samples per pixel in all. The truth is a mean of many renders of "
            f"`{OURS}` itself.",
            *table(
                {
                    "lights": lambda s: s["lights"],
                    "time": lambda s: duration(s["row"]["seconds"]),
                    "rel. L1": lambda s: percent(s["row"]["relative_l1"]),
                },
                found["many_lights"]["sweep"],
            ),
        ]
    lines += outliers_text(found[name] for name in NOTES if name in found)
    for name in NOTES:
        if name in found:
            lines += case_text(name, found[name], NOTES[name])
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    plot_errors({name: found[name] for name in NOTES if name in found}, folder / "hard_shadow.png")
    if "many_lights" not in found:
        return
    sweep = found["many_lights"]["sweep"]
    made, (time, error) = figure(2)
    x = [s["lights"] for s in sweep]
    time.loglog(x, [s["row"]["seconds"] for s in sweep], marker="o")
    error.loglog(x, [s["row"]["relative_l1"] for s in sweep], marker="o")
    time.set(xlabel="distant lights", ylabel="time of a derivative image (s)")
    error.set(xlabel="distant lights", ylabel="relative L1 error")
    made.suptitle(f"`{OURS}`, 32 × 32 pixels, {SWEEP_SPP} samples per pixel", fontsize=9)
    save(made, folder / "hard_shadow_lights.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="hard_shadow",
            cases={**{n: partial(against_reference, n) for n in NOTES}, "many_lights": many_lights},
            report=report,
            plot=plot,
        )
    )
