"""What the steps of a fit render: all views, or a few that are drawn at random."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from .problem import Problem
from .progress import Segment
from .renderer import Task
from .view import derived_seed


def views(problem: Problem, step: int) -> list[int]:
    """Numbers of the targets that a step compares: one of each of `Problem.views_per_step` groups of neighbours.

    In one step, all targets are equally probable. Two neighbouring groups may share a target, and both draw it.
    """
    every, count = len(problem.target), problem.views_per_step
    if count is None:
        return list(range(every))
    rng = np.random.default_rng(derived_seed(problem.seed, step))
    return [int((k + rng.random()) * every / count) for k in range(count)]


def steps_for_all(problem: Problem) -> int:
    """After how many steps as many targets were drawn as there are."""
    return math.ceil(len(problem.target) / (problem.views_per_step or len(problem.target)))


def tasks(
    problem: Problem,
    step: int,
    segment: Segment,
    *,
    doubt: Collection[int],
    show: bool,
    shares: Mapping[str, float],
) -> list[Task]:
    """The renders of a step.

    doubt : targets of which shall be said what makes no sense about them. show : shall the first view be shown?
    shares : see `Progress`.
    """
    return [
        Task(
            target=view,
            width=segment.stage.resolution,
            spp=segment.stage.spp,
            seed=derived_seed(problem.seed, step, place, part),
            stage=segment.number,
            doubt=part == 0 and view in doubt,
            show=part == 0 and view == 0 and show,
            shares=tuple(shares.items()),
        )
        for place, view in enumerate(views(problem, step))
        for part in range(problem.parts)
    ]
