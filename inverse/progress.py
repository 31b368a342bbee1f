"""Where a fit is, and what it has seen; and how that becomes a checkpoint and comes back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rimlight.loading import InputError

from . import checkpoint
from . import problem as problems
from .problem import Problem, Stage

#: Part of the time of a fit that its checkpoints may take.
SHARE = 0.05


@dataclass(frozen=True)
class Segment:
    """A stage, for one of several starts. number : of the stage."""

    number: int
    stage: Stage
    start: int | None = None


@dataclass(frozen=True)
class Step:
    """What a step of a fit saw before it changed the parameters.

    number : of all steps, from 0. stage, iteration : number of the stage, and of the step in it.
    loss : at a noisy render, with the regularisers. metrics : of the loss, label -> number.
    errors : label -> distance from the truth, where that is known.
    rate : the factor of all rates. skipped : was the step left out, since a number was not finite?
    """

    number: int
    stage: int
    iteration: int
    loss: float
    metrics: dict[str, float]
    errors: dict[str, float]
    rate: float
    skipped: bool


@dataclass
class Progress:
    """Where a fit is, and what it has seen.

    segment, iteration : place in the plan. step : of all.
    losses, segments, times : of each step; the last in seconds, at its end.
    errors : label -> distance from the truth before each step, if the truth is known.
    scores : label -> metric of the loss at the render of each step, the mean of the tasks; NaN where a step had none.
    frames : (step, latents) for an animation, of this process; they are not in a checkpoint.
    skipped : steps that were left out, since a number was not finite; bad : of them, without another one since.
    touched : names of parameters whose gradient was ever not zero.
    doubts : sentences about what may make no sense, seen at the first step.
    best_loss, best_error, best : smallest mean of the loss over `WINDOW` steps of the present segment, its standard
        error, and the latents then.
    fell : last iteration of the segment at which the loss had fallen.
    found : of starts that have been tried: mean loss at their end, and latents.
    shares : by what the samples of each part of the derivative are multiplied, see `Problem.balance`; empty: by 1.
    balanced : the segment in which that was measured.
    seconds : in the loop, of all runs.
    """

    segment: int = 0
    iteration: int = 0
    step: int = 0
    losses: list[float] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    errors: dict[str, list[float]] = field(default_factory=dict)
    scores: dict[str, list[float]] = field(default_factory=dict)
    frames: list[tuple[int, dict[str, np.ndarray]]] = field(default_factory=list)
    skipped: int = 0
    bad: int = 0
    touched: set[str] = field(default_factory=set)
    doubts: list[str] = field(default_factory=list)
    best_loss: float = math.inf
    best_error: float = 0.0
    best: dict[str, np.ndarray] = field(default_factory=dict)
    fell: int = 0
    found: list[tuple[float, dict[str, np.ndarray]]] = field(default_factory=list)
    shares: dict[str, float] = field(default_factory=dict)
    balanced: int = -1
    seconds: float = 0.0

    def note_scores(self, scores: Mapping[str, float]) -> None:
        """Of the step whose loss was noted last."""
        for label in {**self.scores, **scores}:
            known = self.scores.setdefault(label, [math.nan] * (len(self.losses) - 1))
            known.append(scores.get(label, math.nan))


#: Fields that are lists of numbers, and fields that are label -> list of numbers: arrays in a checkpoint.
LISTS, TABLES = ("losses", "segments", "times"), ("errors", "scores")

#: Fields that JSON can say.
PLAIN = ("segment", "iteration", "step", "skipped", "bad", "fell", "seconds", "doubts", "shares", "balanced")

#: Fields that may be infinite, which JSON cannot say.
SCALARS = ("best_loss", "best_error")


def save(path: Path, now: Progress, optimiser: Mapping[str, np.ndarray], belongs: Mapping[str, Any]) -> None:
    """Write a checkpoint. belongs : facts of the fit that it is of. OSError : it cannot be written."""
    arrays = {f"optimiser/{name}": a for name, a in optimiser.items()}
    arrays |= {f"best/{name}": a for name, a in now.best.items()}
    arrays |= {f"found/{i}/{name}": a for i, (_, of_one) in enumerate(now.found) for name, a in of_one.items()}
    arrays |= {"found": np.array([loss for loss, _ in now.found])}
    arrays |= {name: np.array(getattr(now, name)) for name in (*LISTS, *SCALARS)}
    facts = {name: getattr(now, name) for name in PLAIN}
    facts |= {"touched": sorted(now.touched), **belongs}
    for name in TABLES:  # labels may hold any letters: they are numbered
        facts[name] = list(getattr(now, name))
        arrays |= {f"{name}/{i}": np.array(numbers) for i, numbers in enumerate(getattr(now, name).values())}
    checkpoint.save(path, arrays, facts)


def load(path: Path) -> tuple[Progress, dict[str, np.ndarray], dict[str, Any]]:
    """Progress, state of the optimiser, and facts of a checkpoint.

    Raises
    ------
    ValueError : it is damaged, or none of ours. OSError : it cannot be read.
    """
    arrays, facts = checkpoint.load(path)
    part = lambda prefix: {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
    fields: dict[str, Any] = {name: facts[name] for name in PLAIN}
    fields |= {name: arrays[name].tolist() for name in (*LISTS, *SCALARS)}
    fields |= {name: {label: arrays[f"{name}/{i}"].tolist() for i, label in enumerate(facts[name])} for name in TABLES}
    found = [(loss, part(f"found/{i}/")) for i, loss in enumerate(arrays["found"].tolist())]
    fields |= {"touched": set(facts["touched"]), "found": found, "best": part("best/")}
    return Progress(**fields), part("optimiser/"), facts


def belongs(problem: Problem, fingerprints: Mapping[str, str]) -> dict[str, Any]:
    """Facts of a fit that its checkpoints bear: the problem, without where its files are and how long it may take; and
    what its files hold."""
    places = ("file", "scene", "mask")
    tables = problems.tables(problem)
    target = [{k: v for k, v in of_one.items() if k not in places} for of_one in tables.get("target", [])]
    kept = {k: v for k, v in tables.items() if k not in ("scene", "seconds")}
    return {"problem": kept | {"target": target}, "contents": dict(fingerprints)}


def check_same(file: Path | str, facts: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of another fit.

    facts : those that the checkpoint bears. now : `belongs` of the fit that should go on.

    Raises
    ------
    InputError : it is of another problem, or a scene or picture has changed. The text names what differs.
    """
    differ = lambda key: ", ".join(
        sorted(k for k in {**facts[key], **now[key]} if facts[key].get(k) != now[key].get(k))
    )
    if what := differ("problem"):
        raise InputError(f'fit: "{file}" belongs to a fit with another {what}; undo that, or start anew')
    if what := differ("contents"):
        raise InputError(f'fit: {what} changed since "{file}" was written; put the old content back, or start anew')
