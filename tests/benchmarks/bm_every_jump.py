"""Derivatives of all that makes an image jump besides the outlines of meshes:
python tests/benchmarks/bm_every_jump.py [--quick] [--out FOLDER]

One scene for each kind of jump, by `direct_edge` or `prb_edge`, and by Mitsuba's projective integrators.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from _bench import (
    Benchmark,
    Problem,
    Settings,
    case_text,
    cases,
    code,
    duration,
    main,
    percent,
    plot_errors,
    table,
)

#: What jumps in each case; of those in `PLOTTED`, there is a picture.
NOTES = {
    "sunk_cube_slides": "The line in which a cube and a floor cut through each other.",
    "smooth_torus_sun": "Where the shadow of a smooth-shaded torus on itself begins.",
    "mirror_cube": "A cube in a planar mirror.",
    "two_mirrors": "A cube between two mirrors that face each other.",
    "pane": "A cube behind a pane of glass.",
    "glass_ball": "A bar behind a ball of glass, which moves.",
    "glass_index": "The same; the index of refraction changes.",
    "mirrored_ball": "What a mirrored ball shows, which moves.",
    "checkerboard": "The lines of a checkerboard, which turns.",
    "chair_slides": "One of twenty instances of a chair, which slides.",
    "leaf": "The border of an opacity mask.",
    "beam_on_floor": "The border of a projector's picture, on a floor that moves.",
    "hidden_picture": "The same where it lights a wall by way of a floor; the projector moves.",
}
PLOTTED = ("sunk_cube_slides", "two_mirrors", "glass_ball", "beam_on_floor")

#: Samples per pixel: ours, and the peer's, whose time hardly depends on it.
COUNTS, PEER_COUNT = (4, 16, 64), 16


def methods_of(name: str) -> tuple[str, str, dict[str, dict]]:
    """Ours, the peer, and both as dictionaries."""
    case = cases.case(name)
    ours = case.integrator["type"]
    peer = {"direct_edge": "direct_projective", "prb_edge": "prb_projective"}[ours]
    depth = {} if ours == "direct_edge" else {"max_depth": case.max_depth}
    return ours, peer, {ours: {"type": ours, **depth}, peer: {"type": peer, **depth}}


def measure(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    ours, peer, methods = methods_of(name)
    problem = Problem.of_case(name, methods)
    rows = [row for spp in settings.pick(COUNTS, 2) for row in problem.rows(spp, (ours,), settings)]
    raises = None
    try:
        rows += problem.rows(PEER_COUNT, (peer,), settings)
    except RuntimeError as error:
        raises = str(error.__cause__ or error).strip().splitlines()[-1]
    return {"rows": rows, "reference": problem.facts(), "raises": raises}


def report(found: dict[str, Any]) -> list[str]:
    shown = []
    for name, case in found.items():
        ours, peer, _ = methods_of(name)
        at = {(r["method"], r["spp"]): r for r in case["rows"]}
        most = max(spp for method, spp in at if method == ours)
        of_peer = at.get((peer, PEER_COUNT))
        shown.append({"name": name, "ours": at[ours, most], "peer": of_peer, "who": peer, **case["reference"]})
    of_peer = lambda s, text, key: text(s["peer"][key]) if s["peer"] else "raises"
    lines = [
        f"32 × 32 pixels, {COUNTS[-1]} samples per pixel of ours, {PEER_COUNT} of the peers'. Errors of single "
        "derivatives, and of the mean of all calls, which is noisy where calls are few:",
        *table(
            {
                "<scene": lambda s: s["name"],
                "<what jumps": lambda s: NOTES[s["name"]],
                "<ours": lambda s: code(s["ours"]["method"]),
                "time": lambda s: duration(s["ours"]["seconds"]),
                "rel. L1": lambda s: percent(s["ours"]["relative_l1"]),
                "of the mean": lambda s: percent(s["ours"]["relative_l1_of_mean"]),
                "<peer": lambda s: code(s["who"]),
                "time ": lambda s: of_peer(s, duration, "seconds"),
                "rel. L1 ": lambda s: of_peer(s, percent, "relative_l1"),
                "of the mean ": lambda s: of_peer(s, percent, "relative_l1_of_mean"),
                "noise of the reference": lambda s: percent(s["noise"]),
            },
            shown,
        ),
    ]
    for name, case in found.items():
        lines += case_text(name, case, NOTES[name])
        if case["raises"]:
            lines.append(f"{code(methods_of(name)[1])} raises: {case['raises']}")
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    plot_errors({name: found[name] for name in PLOTTED if name in found}, folder / "every_jump.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="every_jump",
            cases={name: partial(measure, name) for name in NOTES},
            report=report,
            plot=plot,
            settings=Settings(calls=(16, 1), seconds=2.0),
        )
    )
