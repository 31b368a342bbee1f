"""What a fit found: values, histories, and pictures of its end."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from rimlight.loading import one_line

from . import losses
from .balancing import way
from .problem import Problem
from .renderer import Renderer, Task
from .view import MAX_SAMPLES, View, derived_seed
from .workers import Lost

if TYPE_CHECKING:
    from .fitting import Fit

log = logging.getLogger(__name__)

#: Steps over which the loss is averaged before it is compared.
WINDOW = 10

#: Samples per pixel of the pictures of a result.
FINAL_SPP = 256

#: At most, of the derivative image of a result.
DERIVATIVE_SPP = 64

#: Width of the pictures of an animation, pixels, at most; and their samples per pixel.
SMALL, SMALL_SPP = 256, 36


@dataclass(frozen=True)
class ViewOfFit:
    """Pictures of one target: (H, W, C), float32, linear; weight : (H, W)."""

    start: np.ndarray
    result: np.ndarray
    target: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Result:
    """What a fit found.

    status : "finished", "interrupted", "out of time", or why it gave up.
    values : key -> result, as `mi.traverse(scene)` has it: flat, a matrix (4, 4), or a tensor.
    latents, start : of each free parameter: name -> array; the result, and where it began.
    losses, segments, times : (steps,), loss at a noisy render before each step, the number of its segment, and seconds
        in the loop at its end.
    errors : label -> (steps + 1,), distance from the truth, where that is known.
    scores : label -> (steps,), metric of the loss at a noisy render before each step; NaN where a step had none.
    loss : what it measures, for people.
    doubts : sentences about what may make no sense, such as a target in other units than the scene.
    silent : names of parameters whose gradient was always 0: the pictures do not depend on them.
    skipped : steps that were left out because their gradient was not finite.
    seconds : in the loop. views : pictures before and after. measures : of each view, label -> before and after.
    floors : root mean square error of each view at the truth, where it is known: the noise of the pictures.
    derivative : (H, W, C), of the first view at the result, as all free parameters go on the way that they came from
        the start, once: what of the picture depends on them, and how. None: the integrator cannot do that.
    frames : (step, picture of the first view) from start to end.
    """

    problem: Problem
    status: str
    values: dict[str, np.ndarray]
    latents: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    losses: np.ndarray
    segments: np.ndarray
    times: np.ndarray
    errors: dict[str, np.ndarray]
    silent: list[str]
    skipped: int
    seconds: float
    views: list[ViewOfFit]
    measures: list[dict[str, tuple[float, float]]]
    floors: list[float]
    derivative: np.ndarray | None
    frames: list[tuple[int, np.ndarray]]
    scores: dict[str, np.ndarray] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    loss: str = ""

    def _repr_html_(self) -> str:
        """For notebooks: how it went, and the pictures of the first view."""
        from . import report  # which knows results

        return report.brief(self)


def of(fit: Fit) -> Result:
    """The result of a fit as it is. If it did not finish, of its best state so far, to which it returns."""
    now, seed = fit.progress, fit.problem.seed
    if fit.status not in ("finished", "running"):
        fit.restore_best()
        if now.found and min(loss for loss, _ in now.found) < fit.recent()[0]:
            fit.restart_at_best_start()
    latents = fit.latents()
    states = {"start": fit.start, "result": latents} | ({"truth": _truth(fit)} if fit.truth_is_known else {})
    states = {name: fit.values(at) for name, at in states.items()}
    seeds = [derived_seed(seed, 2**31, i) for i in range(len(fit.renderer.views))]
    found = fit.executor.map(evaluate, states, [(i, seed) for i, seed in enumerate(seeds)])
    views, measures, floors = (list(of_views) for of_views in zip(*found, strict=True))
    first = fit.renderer.views[0]
    small = Task(0, min(first.size[1], SMALL), SMALL_SPP, derived_seed(seed, 2**31 + 1))
    shown = [(step, fit.values(at)) for step, at in [*now.frames, (now.step, latents)]]
    images = fit.executor.map(_image, small, [(0, values) for _, values in shown])
    on = Task(0, None, min(_spp(first), DERIVATIVE_SPP), derived_seed(seed, 2**31 + 2))
    derivative = None
    try:
        (derivative,) = fit.executor.map(_derivative, on, [(0, states["result"], way(fit, fit.start, latents))])
    except RuntimeError as error:  # of an integrator that cannot; what was found is not lost by that
        if isinstance(error, Lost):
            raise
        log.warning("there is no derivative image: %s", one_line(error))
    fit.renderer.image(states["result"], Task(0, None, 1, 0))  # leave the scene at the result
    return _result(
        fit,
        latents,
        values=states["result"],
        views=views,
        measures=measures,
        floors=[floor for floor in floors if floor is not None],
        derivative=derivative,
        frames=[(step, image) for (step, _), image in zip(shown, images, strict=True)],
    )


# ------------------------------------------------------------------ what executors call


def evaluate(
    renderer: Renderer, states: Mapping[str, Mapping[str, np.ndarray]], number: int, seed: int
) -> tuple[ViewOfFit, dict[str, tuple[float, float]], float | None]:
    """Pictures of a view, its measures before and after, and the noise of a picture at the truth, where it is known.

    states : "start" and "result", and "truth" where it is known: values of scene parameters.
    """
    view = renderer.views[number]
    task = Task(number, None, _spp(view), seed)
    target, weight = view.picture()
    pictures = {name: renderer.image(values, task) for name, values in states.items()}
    before, after = (_measures(view, pictures[name]) for name in ("start", "result"))
    floor = losses.root_mean_square(pictures["truth"] - target, weight) if "truth" in pictures else None
    shown = ViewOfFit(pictures["start"], pictures["result"], target, weight)
    return shown, {label: (before[label], after[label]) for label in before if label in after}, floor


def _image(renderer: Renderer, task: Task, number: int, values: Mapping[str, np.ndarray]) -> np.ndarray:
    return renderer.image(values, task)


def _derivative(
    renderer: Renderer, task: Task, number: int, values: Mapping[str, np.ndarray], way: Mapping[str, np.ndarray]
) -> np.ndarray:
    return renderer.derivative(values, way, task)


def so_far(fit: Fit) -> Result:
    """The result of a fit that goes on, without a render: with the noisy pictures of its first and last step."""
    view = fit.renderer.views[0]
    target, weight = view.target_at(fit.image.shape[:2])
    error = [losses.root_mean_square(image - target, weight) for image in (fit.before, fit.image)]
    latents = fit.latents()
    return _result(
        fit,
        latents,
        values=fit.values(latents),
        views=[ViewOfFit(fit.before, fit.image, target, weight)],
        measures=[{"root mean square error": (error[0], error[1])}],
        floors=[],
        derivative=None,
        frames=[],
    )


def _result(fit: Fit, latents: dict[str, np.ndarray], **pictures: Any) -> Result:
    now = fit.progress
    return Result(
        problem=fit.problem,
        status=fit.status,
        latents=latents,
        start=fit.start,
        losses=np.array(now.losses),
        segments=np.array(now.segments),
        times=np.array(now.times),
        errors={label: np.array([*now.errors.get(label, []), last]) for label, last in fit.errors(latents).items()},
        silent=fit.silent() if now.step else [],
        skipped=now.skipped,
        seconds=now.seconds,
        scores={label: np.array(scores) for label, scores in now.scores.items()},
        doubts=list(now.doubts),
        loss=", then ".join(dict.fromkeys(map(losses.label, fit.renderer.losses))),
        **pictures,
    )


def _spp(view: View) -> int:
    """Samples per pixel of a picture of a result: a square, as stratified samplers want it."""
    return max(math.isqrt(min(FINAL_SPP, MAX_SAMPLES // (view.size[0] * view.size[1]))), 1) ** 2


def _measures(view: View, image: np.ndarray) -> dict[str, float]:
    """How alike a picture and its target are, for people, after what the loss of the last stage says of it."""
    target, weight = view.picture()
    _, _, metrics = view.compared(image, -1)
    return metrics | losses.measures(image, target, weight, view.shows_light)


def _truth(fit: Fit) -> dict[str, np.ndarray]:
    return {name: latent for p in fit.parameters for name, latent in p.truth.items()}


def summary(result: Result) -> str:
    """A result in JSON: settings apart, everything but pictures and long arrays. What is not finite is null."""
    return json.dumps(
        finite(
            {
                "status": result.status,
                "steps": len(result.losses),
                "seconds": round(result.seconds, 3),
                "skipped": result.skipped,
                "no influence": result.silent,
                "doubts": result.doubts,
                "errors": {label: [float(e[0]), float(e[-1])] for label, e in result.errors.items()},
                "scores": {label: [float(p[0]), float(p[-1])] for label, p in result.scores.items()},
                "pictures": result.measures,
                "noise of the pictures": result.floors,
                "values": {key: value.ravel().tolist() for key, value in result.values.items() if value.size <= 64},
            }
        ),
        indent=2,
        allow_nan=False,
    )


def finite(value: Any) -> Any:
    """What JSON can say of it: None instead of numbers that are not finite."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
