"""Derivatives of what the camera sees directly:  python tests/benchmarks/bm_film_boundary.py [--quick] [--out FOLDER]

`direct_edge`, Mitsuba's projective integrators and finite differences, on two scenes of 32 × 32 pixels.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from _bench import (
    DIFFERENCES,
    EQUAL_TIME_SPP,
    Benchmark,
    Problem,
    Settings,
    case_text,
    equal_time_table,
    main,
    plot_errors,
)

PEERS = {
    "direct_projective": {"type": "direct_projective"},
    "prb_projective": {"type": "prb_projective", "max_depth": 2},
}
METHODS = {"direct_edge": {"type": "direct_edge"}, **PEERS}

NOTES = {
    "two_triangles_green": "One vertex of a triangle moves before another triangle, under an area light: besides the "
    "outlines, a soft shadow moves.",
    "cube_depth": "A cube moves away from the camera under a constant environment: the film boundary is the only one.",
}


def measure(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    problem = Problem.of_case(name, METHODS)
    counts = settings.pick((EQUAL_TIME_SPP, 1, 16, 64, 256), quick=2)
    rows = [row for spp in sorted(counts) for row in problem.rows(spp, (*METHODS, DIFFERENCES), settings)]
    equal_time = [problem.equal_time("direct_edge", peer, rows, settings) for peer in PEERS]
    return {"rows": rows, "equal_time": equal_time, "reference": problem.facts()}


def report(found: dict[str, Any]) -> list[str]:
    lines = [
        f"At {EQUAL_TIME_SPP} samples per pixel, and at the time that the peer needs for them:",
        *equal_time_table([e for case in found.values() for e in case["equal_time"]]),
    ]
    for name, case in found.items():
        lines += case_text(name, case, NOTES[name])
    return lines


if __name__ == "__main__":
    main(
        Benchmark(
            name="film_boundary",
            cases={name: partial(measure, name) for name in NOTES},
            report=report,
            plot=lambda found, folder: plot_errors(found, folder / "film_boundary.png"),
            settings=Settings(calls=(16, 4), seconds=3),
        )
    )
