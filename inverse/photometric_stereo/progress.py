"""How far a reconstruction is, and its checkpoints: killed at any time, it goes on from the last one."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import remove_left_over
from rimlight.inverse import checkpoint

from .alternation import Course, State
from .dataset import Dataset
from .direct import Guess
from .evidence import Kind

log = logging.getLogger(__name__)

#: A checkpoint is written when this many times as long has passed as the last one took.
SELDOM = 20

#: Of a checkpoint: fields of a `Progress` that are states, of a `Course` that are numbers, and of a `Guess` that are
#: arrays.
STATES, NUMBERS = ("start", "settled", "best", "distant", "distant_start"), ("most", "number", "worse")
ARRAYS = ("normals", "albedo", "exposures", "weights", "base")


@dataclass
class Progress:
    """Where a reconstruction is; all of it is in a checkpoint, but for random numbers.

    level : number of the size of the images. kind : of the material with which its alternations begin.
    trial : which alternations of this size: 0 with that kind, then, of the first size, from normals of a glossy
        surface, then those of other kinds of material.
    start : of this size, judged. settled : result of trial 0, or of the glossy one if that is better.
    best : of the trials that ended. course : of this trial.
    away : distance of the lights, pixels of the full size, infinity if they are distant; None until it is known.
    distant, distant_start : while near lights are tried, the best state and the start with distant ones.
    back : share of the start in the normals at the end.
    history, seconds : as of `Result`.
    """

    kind: Kind
    level: int = 0
    trial: int = 0
    start: State | None = None
    settled: State | None = None
    best: State | None = None
    course: Course | None = None
    away: float | None = None
    distant: State | None = None
    distant_start: State | None = None
    back: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0

    def end_trial(self, found: State, *, settles: bool = False) -> None:
        """settles : others begin from it, if its predictions and halves together are better."""
        self.best = self._chosen(found)
        if self.settled is None or (settles and found.better_than(self.settled)):
            self.settled = found
        self.trial, self.course = self.trial + 1, None

    def next_level(self, kind: Kind) -> None:
        self.kind, self.level, self.trial = kind, self.level + 1, 0
        self.start = self.settled = self.best = None

    def try_near(self, away: float) -> None:
        """The best state and the start of the first size are those with distant lights; now with near ones."""
        self.away, self.distant, self.distant_start, self.best = away, self.best_so_far(), self.start, None

    def end_near(self, found: State) -> None:
        """Of the best state with near lights and that with distant ones, the better one counts."""
        self.best, self.course = found, None
        if not (found.better_than(self.distant) and found.beats(self.start)):
            self.away, self.best, self.start = np.inf, self.distant, self.distant_start
        self.distant = self.distant_start = None

    def best_so_far(self) -> State:
        """Of this size: of the trials that ended, the states of this one, and the start."""
        best = self.best if self.course is None else self._chosen(self.course.best)
        return best if best.beats(self.start) else self.start

    def _chosen(self, found: State) -> State:
        """The better of the best of the trials and a state of the present one. Another kind of material must be clearly
        better than one that was fitted. The start was judged with the best of all kinds: beside it, what is more costs
        nothing."""
        best = self.best
        if best is None:
            return found
        if best.start and not found.start:
            better = found.beats(best)
        else:
            better = found.better_than(best) if found.kind == best.kind else found.needed_beside(best)
        return found if better else best


class Checkpoint:
    """A file from which a reconstruction can go on, of one data set and these options."""

    def __init__(self, path: Path, data: Dataset, options: Any):
        self.path, self.failed, self.due = path, False, 0.0
        given = {"variant": mi.variant(), **dataclasses.asdict(options)}
        self.belongs = {"data": fingerprints(data), "options": json.loads(json.dumps(given))}

    def save_if_due(self, now: Progress, rng: np.random.Generator) -> None:
        if time.monotonic() >= self.due:
            self.save(now, rng)

    def save(self, now: Progress, rng: np.random.Generator) -> None:
        """Write it. A disk that is full is said once; the last checkpoint stays."""
        began = time.monotonic()
        states = {name: getattr(now, name) for name in STATES}
        arrays, facts = {}, {"level": now.level, "trial": now.trial, "kind": dataclasses.astuple(now.kind)}
        facts["away"] = now.away
        if (course := now.course) is not None:
            states |= {"newest": course.state, "best of course": course.best}
            facts["course"] = {name: getattr(course, name) for name in NUMBERS}
            arrays |= {} if course.indirect is None else {"indirect": course.indirect}
        facts["states"] = {}
        for name, state in states.items():
            if state is not None:
                facts["states"][name] = _facts_of(state)
                arrays |= {f"{name}/{key}": array for key, array in _arrays_of(state).items()}
        facts |= {"history": now.history, "seconds": now.seconds, "random": rng.bit_generator.state, **self.belongs}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.save(self.path, arrays, facts)
        except OSError as error:
            if not self.failed:
                log.warning("%s; the reconstruction goes on, its last checkpoint stays", error)
            self.failed = True
        ended = time.monotonic()
        self.due = ended + SELDOM * (ended - began)

    def load(self, rng: np.random.Generator) -> Progress:
        """Where a reconstruction was; random numbers go on there, too.

        Raises
        ------
        ValueError : it is damaged, or belongs to other data or options. OSError : there is none.
        """
        remove_left_over(self.path)
        arrays, facts = checkpoint.load(self.path, "ps")
        self._check(facts)
        rng.bit_generator.state = facts["random"]
        states = {name: _state(name, said, arrays) for name, said in facts["states"].items()}
        course = None
        if "course" in facts:
            newest, best = states.pop("newest"), states.pop("best of course")
            course = Course(newest, best=best, indirect=arrays.get("indirect"), **facts["course"])
        same = {name: facts[name] for name in ("level", "trial", "away", "history", "seconds")}
        return Progress(kind=Kind(*facts["kind"]), **states, course=course, **same)

    def _check(self, facts: dict[str, Any]) -> None:
        """Raises ValueError if a checkpoint belongs to something else, and says what differs."""
        differ = lambda a, b: ", ".join(sorted(key for key in {*a, *b} if a.get(key) != b.get(key)))
        if what := differ(facts["data"], self.belongs["data"]):
            raise InputError(
                f'ps: the data set has changed since "{self.path}" was written ({what}); put the old one back, or '
                "reconstruct the new one into another folder"
            )
        if what := differ(facts["options"], self.belongs["options"]):
            raise InputError(
                f'ps: "{self.path}" was written with other options ({what}); give the same ones as before, or name '
                "another folder"
            )


def fingerprints(data: Dataset) -> dict[str, str]:
    """Of the parts of a data set: equal only if they are."""
    lights = np.array([dataclasses.astuple(led) for led in data.lights], object) if data.near else data.lights
    parts = {
        "number of images": np.array(data.values.shape[1]),
        "images": data.values,
        "mask": data.mask,
        "lights": np.array(str(lights.tolist())),
        "intensities": data.intensities,
        "camera": data.camera,
        "distance": data.distance,
        "truth": data.truth,
    }
    digest = lambda array: hashlib.blake2b(np.ascontiguousarray(array), digest_size=16).hexdigest()
    return {name: digest(part) for name, part in parts.items() if part is not None}


def _facts_of(state: State) -> dict[str, Any]:
    facts = {name: getattr(state, name) for name in ("left_out", "halves", "curl", "strength", "start")}
    return {**facts, "kind": dataclasses.astuple(state.kind), "base_eta": float(state.guess.base_eta)}


def _arrays_of(state: State) -> dict[str, np.ndarray]:
    arrays = {name: getattr(state.guess, name) for name in ARRAYS}
    return {"depth": state.depth, **{name: array for name, array in arrays.items() if array is not None}}


def _state(name: str, said: dict[str, Any], arrays: dict[str, np.ndarray]) -> State:
    of_one = {key: arrays.get(f"{name}/{key}") for key in ARRAYS}
    said = dict(said)
    guess, kind = Guess(**of_one, base_eta=said.pop("base_eta")), Kind(*said.pop("kind"))
    return State(guess, arrays[f"{name}/depth"], kind, **said)
