"""The fits of Li et al. 2018, section 5, and six of our own, one after the other: `rimlight reproduce`.

Each is a scene and a TOML file in `rimlight.scenes`. Results that are there already are not made again, so that an
interrupted run goes on where it was.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import matplotlib.lines
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rimlight import scenes
from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import replacing
from rimlight.loading import one_line
from rimlight.scenes import room, traffic_sign

from . import classifier, free_parameters, report
from . import problem as problems
from .fitting import fit
from .problem import Problem
from .result import Result, finite
from .workers import Workers

log = logging.getLogger(__name__)

#: Experiments, each with its title.
EXPERIMENTS = {
    "fig1": "177 parameters of a room, seen by a fisheye camera",
    "fig6a": "Vertices of two triangles, one partly hidden",
    "fig6b": "Corners of a blocker, from its shadow alone",
    "fig6c": "Camera and materials of a glossy table",
    "fig6d": "Corners of a blocker, in a glossy floor",
    "fig6e": "A square behind the camera, in an almost perfect mirror",
    "fig6f": "Camera in a room with soft shadows and interreflections",
    "fig10": "A stop sign that a network takes for a traffic light, by 2208 parameters",
    "pot_in_mirror": "Pose of a teapot that only a mirror shows",
    "ball_of_glass": "Place and index of refraction of a ball of glass",
    "box_in_sand": "Pose of a box that is sunk into sand",
    "lampshade": "Place of a lamp inside of its shade, from the room that it lights",
    "caustic": "Pose of a bent sheet of metal, from the light that it throws on a table",
    "caustic_shape": "Shape of a bent sheet of metal, from the light that it throws on a table",
}

FIGURES = {"fig6": tuple(name for name in EXPERIMENTS if name.startswith("fig6")), "all": tuple(EXPERIMENTS)}
FIGURES["jumps"] = "pot_in_mirror", "ball_of_glass", "box_in_sand"

#: A fit of figure 6, or of our own, holds if all parameters are left with at most this part of their error at the
#: start, or if the error of its picture is at most so many times its noise.
LEFT, NOISE = 0.01, 1.5

#: That of figure 1 holds if this part of the error of the camera is left, and the median error of the materials and
#: lights is at most this part of their values.
CAMERA, VALUES = 0.005, 0.05

PEER = "prb_projective"

#: What raises a ValueError if the packages are missing that an experiment needs besides those of Rimlight.
NEEDS = {"fig10": lambda: classifier.network(), "caustic_shape": lambda: free_parameters.check_smoothing()}


@dataclass(frozen=True)
class Outcome:
    """One fit of an experiment.

    left : largest error of a parameter over that at the start; pose : of rigid bodies alone. values : median over
        objects of the largest relative error of their materials and lights. picture, noise : root mean square errors
        of the first view, at the result and at the truth. status : see `Result`; "cannot: …" if the integrator raised.
    times, losses : of each step. rise, fall : probabilities, at the result, of the classes that a classifier shall see
        and not see, the least and the greatest; then there is no truth, and what is measured by it is 0.
    """

    name: str
    seed: int
    method: str
    left: float
    pose: float
    values: float
    picture: float
    noise: float
    seconds: float
    status: str
    times: list[float]
    losses: list[float]
    rise: float = 0.0
    fall: float = 0.0

    @property
    def holds(self) -> bool:
        if self.name == "fig10":  # in the end what shall rise is more probable than what shall fall
            return self.rise > self.fall
        if self.name == "fig1":
            return self.pose <= CAMERA and self.values <= VALUES
        return self.left <= LEFT or self.picture <= NOISE * self.noise


def problem_of(name: str, folder: Path | None = None) -> Problem:
    """The fit of an experiment. folder : for scenes that a program makes."""
    if name == "fig1":
        return problems.read(room.write(folder or Path("room")))
    if name == "fig10":
        return problems.read(traffic_sign.write(folder or Path("traffic_sign")))
    return problems.read(scenes.path("two_triangles").parent / "fits" / f"{name}.toml")


def reproduce(
    figure: str,
    out: Path,
    *,
    seeds: Sequence[int] = range(5),
    peer: bool = False,
    progress: bool = True,
    workers: Workers | None = None,
) -> list[Outcome]:
    """Run the experiments of a figure, with a report for each fit, and a summary in `out`.

    figure : one of `EXPERIMENTS` or of `FIGURES`; "all" is without those whose packages are missing.
    peer : fit with Mitsuba's `prb_projective`, too, for as long as our fit took.
    workers : fit there, each fit on one of them. They see `out` under the same path.

    Raises
    ------
    ValueError : there is no such figure, or packages that it needs are missing. OSError : the folder cannot be written
        to.
    """
    names = FIGURES.get(figure, (figure,))
    if not set(names) <= set(EXPERIMENTS):
        raise InputError(f'there is no experiment "{figure}", choose one of {", ".join([*EXPERIMENTS, *FIGURES])}')
    for name in [name for name in NEEDS if name in names]:
        try:
            NEEDS[name]()
        except ValueError as error:
            if len(names) == 1:
                raise
            log.warning("%s is left out; %s", name, error)
            names = [other for other in names if other != name]
    out.mkdir(parents=True, exist_ok=True)
    jobs = [(name, seed) for name in names for seed in seeds]
    if workers is not None:
        items = [(i / len(jobs), job) for i, job in enumerate(jobs)]
        blocks = workers.run(_fits, peer, out.resolve(), items)
        outcomes = [outcome for _, of_block in blocks for outcome in of_block]
        write_summary(out, outcomes)
        return outcomes
    outcomes = []
    for job in jobs:
        outcomes += _outcomes(peer, out, *job, progress)
        write_summary(out, outcomes)
    return outcomes


def _fits(peer: bool, out: Path, jobs: Sequence[tuple[str, int]]) -> list[Outcome]:
    return [outcome for job in jobs for outcome in _outcomes(peer, out, *job)]


def _outcomes(peer: bool, out: Path, name: str, seed: int, progress: bool = False) -> list[Outcome]:
    """Our fit of one seed, and that of the peer."""
    ours = _outcome(name, seed, "ours", out, None, progress)
    return [ours, _outcome(name, seed, PEER, out, ours.seconds, progress)] if peer else [ours]


def _outcome(name: str, seed: int, method: str, out: Path, seconds: float | None, progress: bool) -> Outcome:
    folder = out / name / f"{method}_{seed}"
    file = folder / "outcome.json"
    if file.exists():
        said = json.loads(file.read_text("utf-8"))
        return Outcome(**{name: float("nan") if value is None else value for name, value in said.items()})
    problem = dataclasses.replace(problem_of(name, out / name), seed=seed)
    if method == PEER:
        depth = problem.integrator.get("max_depth", 2 if problem.integrator["type"] == "direct_edge" else -1)
        problem = dataclasses.replace(problem, integrator={"type": PEER, "max_depth": depth}, seconds=seconds)
    found = None
    try:
        found = fit(problem, out=folder, resume=(folder / "checkpoint.npz").exists(), progress=progress)
    except RuntimeError as error:
        if method != PEER:
            raise
        outcome = _cannot(name, seed, error)
    else:
        if found.status == "interrupted":
            raise KeyboardInterrupt
        report.write(folder, found, title=f"{EXPERIMENTS[name]} ({name}, {method}, seed {seed})")
        outcome = _judge(name, seed, method, found)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(finite(dataclasses.asdict(outcome)), allow_nan=False), "utf-8")
    del found
    gc.collect()
    dr.flush_malloc_cache()
    return outcome


def _cannot(name: str, seed: int, error: Exception) -> Outcome:
    """The integrator of others raised: it cannot differentiate this."""
    log.warning("%s: %s cannot do this fit", name, PEER)
    reason = one_line(error.__cause__ or error)
    unknown = float("nan")
    return Outcome(name, seed, PEER, 1.0, 1.0, unknown, unknown, unknown, 0.0, f"cannot: {reason}", [], [])


def _judge(name: str, seed: int, method: str, found: Result) -> Outcome:
    left = {label: float(e[-1] / e[0]) for label, e in found.errors.items() if e[0] > 0}
    relative: dict[str, float] = {}  # the largest of each object
    for label, e in found.errors.items():
        if label.endswith("relative error"):
            thing = label.partition(".")[0]
            relative[thing] = max(relative.get(thing, 0.0), float(e[-1]))
    last = {label: after for label, (_, after) in found.measures[0].items()}
    probability = lambda classes: [last[f"probability of {label}"] for label in classes]
    loss = found.problem.loss
    return Outcome(
        name,
        seed,
        method,
        max(left.values(), default=0.0),
        max((x for label, x in left.items() if "relative error" not in label), default=0.0),
        float(np.median(list(relative.values()))) if relative else 0.0,
        last["root mean square error"],
        found.floors[0] if found.floors else 0.0,
        found.seconds,
        found.status,
        found.times.tolist(),
        found.losses.tolist(),
        min(probability(loss.rise), default=0.0),
        max(probability(loss.fall), default=0.0),
    )


# ------------------------------------------------------------------ summary


def write_summary(out: Path, outcomes: Sequence[Outcome]) -> None:
    """`summary.json`, `summary.md`, and `convergence.png`: losses over time."""
    with replacing(out / "summary.json") as temporary:
        temporary.write_text(json.dumps(finite(list(map(dataclasses.asdict, outcomes))), allow_nan=False), "utf-8")
    with replacing(out / "summary.md") as temporary:
        temporary.write_text("\n".join(table(outcomes)) + "\n", "utf-8")
    write_convergence(out / "convergence.png", outcomes)


def table(outcomes: Sequence[Outcome]) -> list[str]:
    """One row for each experiment and method, medians over the seeds: Markdown."""
    lines = [
        "| experiment | method | error left | of each seed | picture / noise | of each seed | pose left | values off "
        "| rises : falls | seconds | holds |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, method in dict.fromkeys((o.name, o.method) for o in outcomes):
        mine = [o for o in outcomes if (o.name, o.method) == (name, method)]
        left, ratio = [o.left for o in mine], [o.picture / max(o.noise, 1e-12) for o in mine]
        holds = sum(o.holds for o in mine)
        if all(o.status.startswith("cannot") for o in mine):
            compared = ["cannot", *["–"] * 6]
        elif name == "fig10":  # without a truth
            compared = ["–"] * 6 + [", ".join(f"{o.rise:.3g} : {o.fall:.2g}" for o in mine)]
        else:
            compared = [
                f"{np.median(left):.2%}",
                ", ".join(f"{x:.2%}" for x in left),
                f"{np.median(ratio):.2f}",
                ", ".join(f"{x:.2f}" for x in ratio),
                f"{np.median([o.pose for o in mine]):.2%}",
                f"{np.median([o.values for o in mine]):.2%}",
                "–",
            ]
        if name == "fig1":  # some of its values begin next to the truth, by chance
            compared[:2] = "–", "–"
        seconds = f"{np.median([o.seconds for o in mine]):.0f}"
        lines.append(f"| {' | '.join([name, method, *compared, seconds, f'{holds} of {len(mine)}'])} |")
    return lines


def write_convergence(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Loss over time, one plot for each experiment, one curve for each fit: PNG."""
    names = list(dict.fromkeys(o.name for o in outcomes))
    columns = min(len(names), 3)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 3 * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, name in zip(figure.subplots(rows, columns, squeeze=False).ravel(), names, strict=False):
        for o in (o for o in outcomes if o.name == name and o.times):
            colour = "C0" if o.method == "ours" else "C1"
            draw = axes.loglog if min(o.losses) > 0 else axes.semilogx
            # A fit of few steps would be no line.
            draw(o.times, _smooth(o.losses), colour, linewidth=1, alpha=0.7, marker="." if len(o.times) < 10 else "")
        if any(o.name == name and not o.times for o in outcomes):
            axes.text(0.97, 0.93, f"{PEER} raises", color="C1", ha="right", va="top", transform=axes.transAxes)
        axes.set(title=name, xlabel="seconds", ylabel="loss")
        axes.grid(alpha=0.3)
    methods = dict.fromkeys(o.method for o in outcomes)
    lines = [matplotlib.lines.Line2D([], [], color="C0" if m == "ours" else "C1", label=m) for m in methods]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _smooth(losses: Sequence[float]) -> np.ndarray:
    """Mean of up to ten losses up to each."""
    total = np.cumsum([0.0, *losses])
    end = np.arange(1, len(losses) + 1)
    begin = np.maximum(end - 10, 0)
    return (total[end] - total[begin]) / (end - begin)
