"""Where gradients are evaluated: here, in other processes, or on other machines. All call one pure function, and add up
what it returns in the order of the tasks, so that the result does not depend on who did the work."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from rimlight.edge_sampling.refusals import InputError, Refusal

from . import problem as problems
from .problem import Problem
from .renderer import Gradient, Renderer, Task

log = logging.getLogger(__name__)

#: How often a task is tried whose worker died.
TRIES = 4


def evaluate(problem: str, values: Mapping[str, np.ndarray], task: Task) -> Gradient:
    """Loss and gradient of a task: the pure function.

    problem : as TOML, with absolute paths. The renderer of the last one stays in memory.
    """
    return _renderer(problem).gradient(values, task)


@lru_cache(maxsize=1)
def _renderer(problem: str) -> Renderer:
    return Renderer(problems.from_text(problem))


def _use_threads(count: int) -> None:
    dr.set_thread_count(count)  # a function of Dr.Jit cannot be sent to a process itself


def _text(problem: Problem) -> str:
    text = problems.text(problems.relative_to(problem, Path.cwd()))
    problems.check_is_text(text)
    return text


class Processes:
    """Processes on this machine, started anew (not forked), each with its share of the threads.

    A process that dies is replaced, and its tasks are done again.
    """

    def __init__(self, problem: Problem, count: int):
        if count < 1:
            raise InputError(f"fit: the number of workers must be >= 1, got {count}")
        self.problem, self.count = _text(problem), count
        self.pool = self._start()

    def _start(self) -> ProcessPoolExecutor:
        threads = max((os.cpu_count() or 1) // self.count, 1)
        return ProcessPoolExecutor(
            self.count, multiprocessing.get_context("spawn"), initializer=_use_threads, initargs=(threads,)
        )

    def __call__(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> list[Gradient]:
        done: dict[int, Gradient] = {}
        for attempt in range(TRIES):
            waiting: dict[int, Future] = {}
            try:
                for i, task in enumerate(tasks):
                    if i not in done:
                        waiting[i] = self.pool.submit(evaluate, self.problem, dict(values), task)
                for i, future in waiting.items():
                    done[i] = future.result()
                return [done[i] for i in range(len(tasks))]
            except BrokenProcessPool:
                log.warning("a worker died (%d of %d tries); its tasks are done again", attempt + 1, TRIES)
                self.close()
                self.pool = self._start()
        raise Refusal(f"fit: workers died {TRIES} times in a row; is there enough memory for {self.count} of them?")

    def close(self) -> None:
        self.pool.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class Cluster:
    """Workers of a Dask cluster, which see the files of the problem under the same paths.

    address : of its scheduler, such as "tcp://10.0.0.1:8786"; "local" starts one here.

    Dask gives the tasks of a worker that is lost to another one.
    """

    def __init__(self, problem: Problem, address: str):
        try:
            from dask.distributed import Client
        except ImportError:
            raise InputError("fit: a cluster needs the package distributed: pip install 'rimlight[cluster]'") from None
        self.problem = _text(problem)
        try:
            if address == "local":
                self.client = Client(threads_per_worker=1, dashboard_address=None)
            else:
                self.client = Client(address, timeout=20)
        except (OSError, ValueError) as error:
            raise InputError(f'fit: no cluster at "{address}": {error}') from None

    def __call__(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> list[Gradient]:
        # As one datum with a name of its own: Dask would name those of a dictionary by its keys, in each step alike.
        (shared,) = self.client.scatter([dict(values)], broadcast=True, hash=False)
        waiting = [self.client.submit(evaluate, self.problem, shared, t, pure=False, retries=TRIES) for t in tasks]
        return self.client.gather(waiting)

    def close(self) -> None:
        self.client.close()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
