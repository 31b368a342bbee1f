"""Where a fit renders: here, in other processes, or on other machines. All call the same pure functions of a renderer,
so that the result does not depend on who did the work."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rimlight.edge_sampling.refusals import InputError

from . import problem as problems
from .packing import pack, unpack
from .problem import Problem
from .renderer import Gradient, Renderer, Task, alone
from .workers import Workers


class Executor(Protocol):
    """Renders for a fit."""

    def gradient(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> Gradient:
        """What `Renderer.gradient` says, in single precision."""
        ...

    def map(self, function: Callable[..., Any], shared: Any, calls: Sequence[tuple]) -> list[Any]:
        """Results of `function(renderer, shared, *call)` for each call. A call begins with the number of a target."""
        ...


class Here:
    """The renderer of this process."""

    def __init__(self, renderer: Renderer):
        self.renderer = renderer

    def gradient(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> Gradient:
        return self.renderer.gradient(values, tasks).single()

    def map(self, function: Callable[..., Any], shared: Any, calls: Sequence[tuple]) -> list[Any]:
        return [function(self.renderer, shared, *call) for call in calls]


def executor_of(problem: Problem, executor: Any, renderer: Renderer) -> Executor:
    """The one that is given, or that of this process. InputError : it is none, or of another problem."""
    if executor is None:
        return Here(renderer)
    if isinstance(executor, type) or not (hasattr(executor, "gradient") and hasattr(executor, "map")):
        raise InputError(f"fit: an executor has the methods gradient and map, such as a Cluster, got {executor!r}")
    if isinstance(executor, Cluster):
        executor.check(problem)
    return executor


def _text(problem: Problem) -> str:
    return problems.text(problems.relative_to(problem, Path.cwd()))


class Cluster:
    """Workers of a Dask cluster, which see the files of the problem under the same paths.

    Views belong to workers: neighbours to the same one. Each worker loads its targets only, and sets the parameters of
    a scene once in a step; sums of gradients travel, and no pictures.

    cluster : how many processes to start on this machine; or the address of a scheduler, such as
        "tcp://10.0.0.1:8786"; or a cluster of one of Dask's deployers, such as dask_jobqueue's SLURMCluster, or a
        client of one.

    Raises
    ------
    InputError : there is no such cluster, Dask is not installed, or a part of the problem is in memory only.
    """

    def __init__(self, problem: Problem, cluster: int | str | Any):
        self._problem = _text(problem)
        problems.check_is_text(self._problem)
        self.pieces = len(problem.target) * problem.parts
        self.parts = problem.parts
        self.workers = Workers(cluster, problem.threads)

    def check(self, problem: Problem) -> None:
        """InputError : the workers work for another problem, whose pictures they would compare."""
        if _text(problem) != self._problem:
            raise InputError("fit: this cluster was made for another problem: make a Cluster of the one that is fitted")

    def gradient(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> Gradient:
        seen: dict[int, int] = {}
        items = []  # neighbouring parts of neighbouring views are neighbours
        for task in tasks:
            part = seen[task.target] = seen.get(task.target, -1) + 1
            items.append((self._place(task.target, part % self.parts), task))
        ((_, found),) = self.workers.run(_gradient, self._problem, pack(values), items, _sum)
        return replace(found, gradients=unpack(found.gradients))

    def map(self, function: Callable[..., Any], shared: Any, calls: Sequence[tuple]) -> list[Any]:
        items = [(self._place(call[0]), call) for call in calls]
        blocks = self.workers.run(_map, self._problem, (function, shared), items)
        found = {i: result for numbers, results in blocks for i, result in zip(numbers, results, strict=True)}
        return [found[i] for i in range(len(calls))]

    def _place(self, target: int, part: int = 0) -> float:
        return (target * self.parts + part) / self.pieces

    def close(self) -> None:
        self.workers.close()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


# ------------------------------------------------------------------ on workers


@lru_cache(maxsize=2)
def _renderer(problem: str) -> Renderer:
    return Renderer(problems.from_text(problem))


def _map(problem: str, shared: tuple[Callable[..., Any], Any], calls: Sequence[tuple]) -> list[Any]:
    renderer, (function, of_all) = _renderer(problem), shared
    with alone(renderer.problem.variant):
        return [function(renderer, of_all, *call) for call in calls]


def _gradient(problem: str, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> Gradient:
    renderer = _renderer(problem)
    with alone(renderer.problem.variant):
        return _for_journey(renderer.gradient(unpack(values), tasks))


def _sum(parts: Sequence[Gradient], last: bool) -> Gradient:
    total = Gradient.sum(replace(part, gradients=unpack(part.gradients)) for part in parts)
    return _for_journey(total.single() if last else total)


def _for_journey(gradient: Gradient) -> Gradient:
    return replace(gradient, gradients=pack(gradient.gradients))
