"""Losses and gradients of views of a problem, as pure functions of NumPy arrays: what processes and machines share.

A picture is rendered, compared with the target on the host, and the derivative of the loss with respect to its pixels
weighs a second, independent render, backward. Both are recorded once and replayed (`dr.freeze`) where that is possible.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.loading import InputError, load_integrator, use_variant

from . import losses, sources
from .free_parameters import to_numpy
from .loaded_scene import LoadedScene
from .problem import Problem
from .view import View, derived_seed

#: Held by whoever renders: two threads that record kernels at once abort Dr.Jit 1.5.
_rendering = threading.RLock()
_last = threading.get_ident()


@contextmanager
def alone(variant: str) -> Iterator[None]:
    """Within it, no other thread renders or differentiates for a fit. variant : of Mitsuba, which each thread sets."""
    global _last
    with _rendering:
        if mi.variant() != variant:
            use_variant(variant)
        if _last != threading.get_ident():
            # What this thread records may depend on what another one did since its last turn.
            dr.detail.new_scope(dr.backend_v(mi.Float))
            _last = threading.get_ident()
        yield


@dataclass(frozen=True)
class Task:
    """One picture to compare, and its gradient.

    target : number of the target. width : of the film, pixels; None: as the scene has it. spp : samples per pixel.
    seed : of the image; that of the derivative differs from it. stage : number of the one whose loss it is.
    doubt : say what makes no sense about the target. show : return the picture. shares : by what
    the samples of each part of the derivative are multiplied, see `Problem.balance`.
    """

    target: int
    width: int | None
    spp: int
    seed: int
    stage: int = 0
    doubt: bool = False
    show: bool = False
    shares: tuple[tuple[str, float], ...] = ()

    @property
    def key(self) -> tuple[int, int]:
        """Of the results of this task in a step."""
        return self.target, self.seed


@dataclass(frozen=True)
class Gradient:
    """What tasks found.

    gradients : key -> sum over the tasks, as `to_numpy` has the value. losses, scores : of each task, by its `key`:
    the loss at a render, and its metrics, label -> number. doubts : number of a target -> what may make no sense about
    it. image : (H, W, C), of the task that shows it.
    """

    gradients: dict[str, np.ndarray]
    losses: dict[tuple[int, int], float] = field(default_factory=dict)
    scores: dict[tuple[int, int], dict[str, float]] = field(default_factory=dict)
    doubts: dict[int, str] = field(default_factory=dict)
    image: np.ndarray | None = None

    @property
    def loss(self) -> float:
        """Of all tasks."""
        return sum(self.losses.values())

    @staticmethod
    def sum(parts: Iterable[Gradient]) -> Gradient:
        """Of several, in double precision: rounded to single, it does not depend on their order, but for very few
        numbers and one unit of their last place."""
        parts = list(parts)
        keys = dict.fromkeys(key for part in parts for key in part.gradients)
        add = lambda key: sum(p.gradients[key].astype(np.float64) for p in parts if key in p.gradients)
        join = lambda name: {key: value for part in parts for key, value in getattr(part, name).items()}
        image = next((part.image for part in parts if part.image is not None), None)
        return Gradient({key: add(key) for key in keys}, join("losses"), join("scores"), join("doubts"), image)

    def single(self) -> Gradient:
        """In single precision."""
        return replace(self, gradients={key: array.astype(np.float32) for key, array in self.gradients.items()})


class Renderer:
    """The scenes of a problem, loaded, and its views, whose targets are read when they are first needed.

    params : of all scenes, key -> value; where several scenes have a key, that of the first.
    losses : of each stage.
    scenes : the loaded ones, by `sources.key`.

    Raises
    ------
    InputError, OSError : scene or integrator cannot be loaded, or do not fit together. The text is one line.
    """

    def __init__(self, problem: Problem):
        use_variant(problem.variant)
        self.problem = problem
        self.losses = [losses.function(problem.loss, norm) for norm in problem.norms]
        options = dict(problem.integrator)
        kind = options.pop("type")
        used = [problem.scene if target.scene is None else target.scene for target in problem.target]
        gc.collect()  # as long as a scene that nobody needs exists, its materials are in all kernels that are compiled
        # Every load of a scene costs memory that never comes back.
        self.scenes = {key: sources.scene(s, problem.define) for key, s in {sources.key(s): s for s in used}.items()}
        loaded = {key: LoadedScene(scene, load_integrator(kind, **options)) for key, scene in self.scenes.items()}
        if problem.balance and not all(getattr(s.integrator, "BALANCES", False) for s in loaded.values()):
            raise InputError(f"fit: balance: {kind} does not divide its samples; use direct_edge or prb_edge")
        self.views = [View(problem, i, loaded[k], self.losses) for i, k in enumerate(map(sources.key, used))]
        self.params: dict[str, Any] = {}
        for scene in loaded.values():
            self._check_alike(scene.params)
            self.params = dict(scene.params.items()) | self.params

    def _check_alike(self, params: mi.SceneParameters) -> None:
        """InputError : a free parameter is of another type or size in a scene than in those before."""
        for key in (key for free in self.problem.free for key in free.key if key in params and key in self.params):
            here, before = params[key], self.params[key]
            if type(here) is not type(before) or np.shape(to_numpy(here)) != np.shape(to_numpy(before)):
                said = " and ".join(f"{type(x).__name__} {np.shape(to_numpy(x))}" for x in (before, here))
                raise InputError(f'fit: "{key}" is not alike in all scenes, but {said}')

    # ---------------------- What executors call ----------------------

    def gradient(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> Gradient:
        """The losses of tasks, and their derivatives with respect to the values, all added up.

        values : key -> array as `to_numpy` makes it; what is not in the scene of a view is ignored.

        Returns
        -------
        The sums are in double precision.
        """
        # With one thread, the same bit by bit whoever computes it: each picture has a sum of its own.
        alike = [[task] for task in tasks] if self.problem.threads == 1 else [tasks]
        return Gradient.sum(part for some in alike for part in self._gradient(values, some))

    def _gradient(self, values: Mapping[str, np.ndarray], tasks: Sequence[Task]) -> Iterator[Gradient]:
        leaves = self._set(values, tasks)
        # From the scene's parameters to the leaves, derivatives flow once, for all views together.
        with dr.isolate_grad():
            for task in tasks:
                view = self.views[task.target]
                view.resize(task.width)
                image = view.render(task.seed, task.spp)
                loss, by_pixel, scores = view.compared(image, task.stage)
                view.backward(by_pixel, derived_seed(task.seed), task.spp, task.shares)
                doubts = {task.target: text} if task.doubt and (text := view.doubts(image)) else {}
                yield Gradient({}, {task.key: loss}, {task.key: scores}, doubts, image if task.show else None)
        for of_scene in leaves:
            yield Gradient(_collected(of_scene))

    def image(self, values: Mapping[str, np.ndarray], task: Task) -> np.ndarray:
        """A picture: (H, W, C), float32, linear."""
        self._set(values, [task])
        view = self.views[task.target]
        view.resize(task.width)
        return view.render(task.seed, task.spp)

    def derivative(self, values: Mapping[str, np.ndarray], change: Mapping[str, np.ndarray], task: Task) -> np.ndarray:
        """Derivative of a picture as the values change, forward: (H, W, C), float32.

        change : key -> array as in `values`.
        """
        (leaves,) = self._set(values, [task])
        view = self.views[task.target]
        view.resize(task.width)
        return view.forward({key: (leaf, change[key]) for key, leaf in leaves.items()}, task.seed, task.spp)

    def balance(
        self, values: Mapping[str, np.ndarray], change: Mapping[str, np.ndarray], task: Task
    ) -> tuple[tuple[str, float], ...]:
        """`Task.shares` that leave the least error in a given time, where the values change like this."""
        (leaves,) = self._set(values, [task])
        view = self.views[task.target]
        view.resize(task.width)
        return view.balance({key: (leaf, change[key]) for key, leaf in leaves.items()}, task.seed)

    def check(self, stages: Iterable[int], target: int) -> None:
        """Say at once what is wrong with a target, or with the losses of stages. Raises InputError, OSError: it is."""
        for stage in stages:
            self.views[target].check(stage)

    # ---------------------- For layers of other programs ----------------------

    def gradient_of(
        self, values: Mapping[str, np.ndarray], by_pixel: np.ndarray, task: Task, wanted: Collection[str]
    ) -> dict[str, np.ndarray]:
        """The derivative of anything of which that with respect to each number of the picture is known.

        by_pixel : (H, W, C), this one. task : its seed is that of the derivative image. wanted : keys of the values
        with respect to which it is asked for.
        """
        (leaves,) = self._set(values, [task], wanted)
        view = self.views[task.target]
        view.resize(task.width)
        view.backward(by_pixel, task.seed, task.spp)
        return _collected(leaves)

    def _set(
        self, values: Mapping[str, np.ndarray], tasks: Sequence[Task], wanted: Collection[str] | None = None
    ) -> list[dict[str, mi.Float]]:
        """Set the parameters of all scenes of tasks. Returns what collects the gradients of each: key -> flat."""
        views = {task.target: self.views[task.target] for task in tasks}
        for view in views.values():
            view.picture()  # while the scene still is as its file has it, if possible
        for task in tasks:
            self.views[task.target].arrange(values, task.width)
        scenes = {id(view.loaded): view.loaded for view in views.values()}
        return [scene.set(values, wanted) for scene in scenes.values()]


def _collected(leaves: Mapping[str, mi.Float]) -> dict[str, np.ndarray]:
    found = {key: dr.grad(leaf) for key, leaf in leaves.items()}
    dr.eval(found)
    return {key: np.array(gradient, np.float32) for key, gradient in found.items()}
