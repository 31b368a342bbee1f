"""The loop of a fit: render, compare, step; stage after stage; and what is left when it ends, however it ends."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from rimlight.loading import one_line

from . import checkpoint, classifier, free_parameters, losses
from . import problem as problems
from .free_parameters import to_numpy
from .optimisers import Optimiser
from .problem import Problem, Stage
from .renderer import MAX_SAMPLES, Gradient, Renderer, Task, derived_seed

log = logging.getLogger(__name__)

#: Steps over which the loss is averaged before it is compared.
WINDOW = 10

#: Standard errors by which the best loss must be better than the last one for the fit to go back to it.
SURE = 4.0

#: A stage goes on while its loss falls by this fraction within `patience` steps.
FALL = 1e-3

#: Seconds between checkpoints.
INTERVAL = 5.0

#: Pictures of an animation.
FRAMES = 48

#: Samples per pixel of the pictures of a result.
FINAL_SPP = 256

#: At most, of the derivative image of a result.
DERIVATIVE_SPP = 64

#: Evaluates tasks, in their order.
Executor = Callable[[Mapping[str, np.ndarray], Sequence[Task]], list[Gradient]]


@dataclass(frozen=True)
class Segment:
    """A stage, for one of several starts."""

    stage: Stage
    start: int | None = None


@dataclass
class Progress:
    """Where a fit is, and what it has seen; all of it is in a checkpoint.

    segment, iteration : place in the plan. step : of all.
    losses, segments, times : of each step; the last in seconds, at its end.
    errors : label -> one number before each step, and one at the end, if the truth is known.
    scores : label -> probability at the render of each step, the mean of the tasks, with the norm "classifier".
    frames : (step, latents) for an animation.
    skipped : gradients that were not finite; bad : of them, without a finite one since.
    touched : names of parameters whose gradient was ever not zero.
    best_loss, best_error, best : smallest mean of the loss over `WINDOW` steps of the present segment, its standard
        error, and the latents then.
    fell : last iteration of the segment at which the loss had fallen.
    found : of starts that have been tried: mean loss at their end, and latents.
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
    best_loss: float = float("inf")
    best_error: float = 0.0
    best: dict[str, np.ndarray] = field(default_factory=dict)
    fell: int = 0
    found: list[tuple[float, dict[str, np.ndarray]]] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class ViewOfFit:
    """Pictures of one target: (H, W, C), float32, linear; weight : (H, W)."""

    start: np.ndarray
    result: np.ndarray
    target: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Fit:
    """What a fit found.

    status : "finished", "interrupted", "out of time", or why it gave up.
    values : key -> result, as `mi.traverse(scene)` has it: flat, a matrix (4, 4), or a tensor.
    latents, start : of each free parameter: name -> array; the result, and where it began.
    losses, segments, times : (steps,), loss at a noisy render before each step, the number of its segment, and seconds
        in the loop at its end.
    errors : label -> (steps + 1,), distance from the truth, where that is known.
    scores : label -> (steps,), probability of a class at a noisy render before each step, with the norm "classifier".
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


def fit(
    problem: Problem,
    *,
    out: Path | str | None = None,
    resume: bool = False,
    executor: Executor | None = None,
    tensorboard: bool = False,
    progress: bool = True,
) -> Fit:
    """Fit the free parameters of a problem to its targets.

    Parameters
    ----------
    problem : what to fit. Paths in it are relative to the working directory.
    out : folder for checkpoints and the problem. The result itself is written by `rimlight.inverse.write`.
    resume : go on from the checkpoint in `out`. With one thread (`Problem.threads`) the result is bit by bit that of
        a fit that was not interrupted, if each is the only one of its process; with several, sums of gradients differ
        in their last bits, in any two runs alike.
    executor : evaluates gradients elsewhere. Default: here, one after the other.
    tensorboard : write loss and errors into `out` for TensorBoard. Needs the package tensorboardX.
    progress : show a bar on standard error.

    Raises
    ------
    ValueError, OSError : the problem cannot be posed, or the checkpoint is not one of it. The text is one line.

    Ctrl-C ends the fit after the present step, with a result; pressed twice, at once.
    """
    return Run(problem, out=out, resume=resume, executor=executor, tensorboard=tensorboard).finish(progress)


class Run:
    """A fit under way."""

    def __init__(
        self,
        problem: Problem,
        *,
        out: Path | str | None = None,
        resume: bool = False,
        executor: Executor | None = None,
        tensorboard: bool = False,
    ):
        self.problem = problem
        self.file = None if out is None else Path(out) / "checkpoint.npz"
        if problem.threads is not None:
            dr.set_thread_count(problem.threads)
        self.renderer = Renderer(problem)
        for view in self.renderer.views:
            for width in {stage.resolution for stage in problem.stage}:
                view.target_at(view.size_at(width))  # what is wrong with a picture is said at once
        self.parameters = free_parameters.find(problem.free, self.renderer.params)
        compares = problem.loss.norm != "classifier"
        self.truth_is_known = compares and all(target.file is None for target in problem.target)
        self.optimiser = Optimiser(self.parameters, problem)
        self.executor: Executor = executor or (lambda values, tasks: [self.renderer.gradient(values, t) for t in tasks])
        self.start = self._latents()
        starts = problem.starts.count
        explored = [Segment(problem.stage[0], k) for k in range(starts)] if starts > 1 else [Segment(problem.stage[0])]
        self.plan = [*explored, *map(Segment, problem.stage[1:])]
        self.total = sum(segment.stage.iterations for segment in self.plan)
        self.progress = Progress()
        self._board = None
        if tensorboard:
            if self.file is None:
                raise ValueError("fit: to write a log for TensorBoard, name a folder")
            self._board = _board(self.file.parent)
        self._stop = False
        self._disk_failed = False
        if resume:
            self._restore()
        else:
            self._begin()
            if self.file is not None:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                problems.write(self.file.parent / "problem.toml", problem)
                self._save()

    # ---------------------- The loop ----------------------

    def finish(self, progress: bool = True) -> Fit:
        """Run to the end, and render the result."""
        now = self.progress
        status = "finished"
        saved = began = time.monotonic()
        before = now.seconds
        with (
            self._listening(),
            tqdm(total=self.total, initial=now.step, desc="fit", disable=None if progress else True) as bar,
        ):
            while now.segment < len(self.plan):
                self.step()
                now.seconds = before + time.monotonic() - began
                now.times.append(now.seconds)
                bar.update()
                bar.set_postfix(self._shown(), refresh=False)
                if now.bad >= self.problem.max_bad:
                    status = f"gave up: {now.bad} gradients in a row were not finite"
                elif self._stop:
                    status = "interrupted"
                elif self.problem.seconds is not None and now.seconds > self.problem.seconds:
                    status = "out of time"
                if status != "finished":
                    break
                if time.monotonic() - saved > INTERVAL:
                    self._save()
                    saved = time.monotonic()
        self._save()
        if self._board is not None:
            self._board.close()
        return self._result(status)

    def step(self) -> None:
        """One step of the plan."""
        now, segment = self.progress, self.plan[self.progress.segment]
        stage = segment.stage
        attached = self.optimiser.values()
        values = {key: to_numpy(value) for key, value in attached.items()}
        tasks = [
            Task(i, stage.resolution, stage.spp, derived_seed(self.problem.seed, now.step, i, part))
            for i in range(len(self.problem.target))
            for part in range(self.problem.parts)
        ]
        found = self.executor(values, tasks)
        loss = float(np.mean([f.loss for f in found]))
        gradients: dict[str, Any] = {
            key: sum((f.gradients[key] for f in found if key in f.gradients), np.float32(0)) / len(found)
            for key in values
        }
        self._note(loss, {label: float(np.mean([f.scores[label] for f in found])) for label in found[0].scores})
        if np.isfinite(loss) and all(np.isfinite(g).all() for g in gradients.values()):
            now.bad = 0
            done = now.iteration / max(stage.iterations - 1, 1)
            for parameter in self.parameters:
                if any(np.any(gradients[key]) for key in parameter.keys):
                    now.touched.add(parameter.name)
            self.optimiser.step(attached, gradients, stage.rate * stage.decay**done)
        else:
            now.skipped += 1
            now.bad += 1
        if self._board is not None:
            self._board.add_scalar("loss", loss, now.step)
            for label, numbers in (now.errors | now.scores).items():
                self._board.add_scalar(label, numbers[-1], now.step)
        now.step += 1
        now.iteration += 1
        if now.step == WINDOW:
            for name in self.silent():
                log.warning('"%s" has no influence on the pictures: its gradient is 0', name)
        if now.iteration >= stage.iterations or self._stalls():
            self._next_segment()

    def silent(self) -> list[str]:
        """Names of parameters whose gradient was always 0."""
        return [p.name for p in self.parameters if p.name not in self.progress.touched]

    def _note(self, loss: float, scores: Mapping[str, float]) -> None:
        """Keep what is known before a step."""
        now = self.progress
        latents = self._latents()
        self._note_errors(latents)
        every = -(-self.total // FRAMES)
        if now.step % every == 0:
            now.frames.append((now.step, latents))
        now.losses.append(loss)
        for label, score in scores.items():
            now.scores.setdefault(label, []).append(score)
        now.segments.append(now.segment)
        if now.iteration + 1 >= WINDOW:
            mean, error = self._recent()
            if now.best_loss - mean > FALL * abs(mean):
                now.fell = now.iteration
            if mean < now.best_loss:
                now.best_loss, now.best_error, now.best = mean, error, latents

    def _note_errors(self, latents: dict[str, np.ndarray]) -> None:
        if self.truth_is_known:
            for parameter in self.parameters:
                for label, error in parameter.errors(latents).items():
                    self.progress.errors.setdefault(label, []).append(error)

    def _stalls(self) -> bool:
        now = self.progress
        return self.problem.patience is not None and now.iteration - now.fell > self.problem.patience + WINDOW

    def _next_segment(self) -> None:
        now, segment = self.progress, self.plan[self.progress.segment]
        last = now.segment == len(self.plan) - 1
        if segment.start is not None:
            loss = self._recent()[0] if np.isfinite(now.losses[-1]) else float("inf")
            now.found.append((loss, self._latents()))
            if last:
                self._restart_at_best_start()
        elif last:
            self._restore_best()
        now.segment += 1
        now.iteration = 0
        if not last:
            self._begin()

    def _begin(self) -> None:
        """Enter a segment."""
        now, segment = self.progress, self.plan[self.progress.segment]
        now.best_loss, now.best, now.fell = float("inf"), {}, 0
        if segment.start is not None:
            self.optimiser.restart(self._start(segment.start))
        elif now.found:
            self._restart_at_best_start()
            now.found = []

    def _restore_best(self) -> None:
        """Go back to the best state of the segment, if the noise of the loss does not explain that it was better."""
        now = self.progress
        if now.best:
            mean, error = self._recent()
            if not mean <= now.best_loss + SURE * np.hypot(error, now.best_error):
                self.optimiser.restart(now.best)

    def _recent(self) -> tuple[float, float]:
        """Mean of the last losses of the segment that are finite, and its standard error."""
        now = self.progress
        recent = [x for x, k in zip(now.losses[-WINDOW:], now.segments[-WINDOW:], strict=True) if k == now.segment]
        recent = [x for x in recent if np.isfinite(x)]
        if not recent:
            return float("inf"), 0.0
        return float(np.mean(recent)), float(np.std(recent) / np.sqrt(max(len(recent) - 1, 1)))

    def _restart_at_best_start(self) -> None:
        self.optimiser.restart(min(self.progress.found, key=lambda entry: entry[0])[1])

    def _start(self, number: int) -> dict[str, np.ndarray]:
        if number == 0:
            return self.start
        rng = np.random.default_rng((self.problem.seed, number))
        spread = self.problem.starts
        scattered = [p.scatter(rng, spread.move, spread.turn, spread.value) for p in self.parameters]
        return {name: latent for of_one in scattered for name, latent in of_one.items()}

    def _latents(self) -> dict[str, np.ndarray]:
        return dict(self.optimiser.latents())

    def _shown(self) -> dict[str, str]:
        now = self.progress
        shown = {"loss": f"{now.losses[-1]:.2e}"}
        for label, numbers in list((now.errors | now.scores).items())[:2]:
            shown[label.split(" (")[0]] = f"{numbers[-1]:.2e}"
        return shown

    # ---------------------- Interruption ----------------------

    @contextmanager
    def _listening(self) -> Iterator[None]:
        """Within it, Ctrl-C ends the loop after the present step; pressed again, at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(number: int, frame: Any) -> None:
            self._stop = True
            signal.signal(signal.SIGINT, previous)

        previous = signal.signal(signal.SIGINT, stop)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, previous)

    def _save(self) -> None:
        """Write a checkpoint. A disk that is full is said once; the fit goes on, and the last checkpoint stays."""
        if self.file is None:
            return
        now = self.progress
        arrays = {f"optimiser/{name}": a for name, a in self.optimiser.state().items()}
        arrays |= {f"best/{name}": a for name, a in now.best.items()}
        arrays |= {f"frame/{i}/{name}": a for i, (_, of_one) in enumerate(now.frames) for name, a in of_one.items()}
        arrays |= {f"found/{i}/{name}": a for i, (_, of_one) in enumerate(now.found) for name, a in of_one.items()}
        facts = {
            f.name: getattr(now, f.name)
            for f in dataclasses.fields(now)
            if f.name not in ("best", "frames", "found", "touched")
        }
        facts |= {
            "problem": problems.text(self.problem),
            "touched": sorted(now.touched),
            "frames": [step for step, _ in now.frames],
            "found": [loss for loss, _ in now.found],
        }
        try:
            checkpoint.save(self.file, arrays, facts)
        except OSError as error:
            if not self._disk_failed:
                log.warning("%s; the fit goes on, its last checkpoint stays", error)
            self._disk_failed = True

    def _restore(self) -> None:
        if self.file is None:
            raise ValueError("fit: to resume, name the folder that holds the checkpoint")
        arrays, facts = checkpoint.load(self.file)
        before, now = (problems.parse(text) for text in (facts.pop("problem"), problems.text(self.problem)))
        differ = sorted(key for key in {**before, **now} if before.get(key) != now.get(key) and key != "seconds")
        if differ:
            raise ValueError(
                f'fit: "{self.file}" belongs to a fit with another {", ".join(differ)}; undo that, or start anew'
            )
        facts.pop("version")
        part = lambda prefix: {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
        frames = [(step, part(f"frame/{i}/")) for i, step in enumerate(facts.pop("frames"))]
        found = [(loss, part(f"found/{i}/")) for i, loss in enumerate(facts.pop("found"))]
        touched = set(facts.pop("touched"))
        self.progress = Progress(**facts, frames=frames, found=found, touched=touched, best=part("best/"))
        self.optimiser.restore(part("optimiser/"))

    # ---------------------- Result ----------------------

    def _result(self, status: str) -> Fit:
        now = self.progress
        if status != "finished":
            self._restore_best()
            if now.found and min(loss for loss, _ in now.found) < self._recent()[0]:
                self._restart_at_best_start()
        latents = self._latents()
        self._note_errors(latents)
        values = self._values(latents)
        # A square, as stratified samplers want it.
        spp = lambda view: max(math.isqrt(min(FINAL_SPP, MAX_SAMPLES // (view.size[0] * view.size[1]))), 1) ** 2
        views, measures, floors = [], [], []
        for i, view in enumerate(self.renderer.views):
            task = Task(i, None, spp(view), derived_seed(self.problem.seed, 2**31, i))
            before, after = (self.renderer.image(v, task) for v in (self._values(self.start), values))
            target, weight = view.picture()
            views.append(ViewOfFit(before, after, target, weight))
            compared = [losses.measures(image, target, weight, view.shows_light) for image in (before, after)]
            if self.problem.loss.norm == "classifier":
                said = [classifier.probabilities(self.problem.loss, image) for image in (before, after)]
                compared = [
                    {f"probability of {label}": p for label, p in of_one.items()} | rest
                    for of_one, rest in zip(said, compared, strict=True)
                ]
            measures.append({label: (compared[0][label], compared[1][label]) for label in compared[0]})
            if self.truth_is_known:
                again = self.renderer.image(self._values(self._truth()), task)
                floors.append(losses.root_mean_square(again - target, weight))
        small = Task(0, min(self.renderer.views[0].size[1], 256), 36, derived_seed(self.problem.seed, 2**31 + 1))
        steps = [*now.frames, (now.step, latents)]
        frames = [(step, self.renderer.image(self._values(at), small)) for step, at in steps]
        on = Task(0, None, min(spp(self.renderer.views[0]), DERIVATIVE_SPP), derived_seed(self.problem.seed, 2**31 + 2))
        derivative = None
        try:
            derivative = self.renderer.derivative(values, self._way(latents), on)
        except RuntimeError as error:  # of an integrator that cannot; what was found is not lost by that
            log.warning("there is no derivative image: %s", one_line(error))
        self.renderer.image(values, Task(0, None, 1, 0))  # leave the scene at the result
        return Fit(
            problem=self.problem,
            status=status,
            values=values,
            latents=latents,
            start=self.start,
            losses=np.array(now.losses),
            segments=np.array(now.segments),
            times=np.array(now.times),
            errors={label: np.array(errors) for label, errors in now.errors.items()},
            silent=self.silent() if now.step else [],
            skipped=now.skipped,
            seconds=now.seconds,
            views=views,
            measures=measures,
            floors=floors,
            derivative=derivative,
            frames=frames,
            scores={label: np.array(scores) for label, scores in now.scores.items()},
        )

    def _way(self, latents: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Derivatives of the scene parameters at the result, on the straight way from the start through it."""
        held = {name: mi.Float(latent) for name, latent in latents.items()}
        for name, latent in held.items():
            dr.enable_grad(latent)
            dr.set_grad(latent, mi.Float(latents[name] - self.start[name]))
        found = free_parameters.values(self.parameters, held)
        dr.forward_to(found)
        return {key: to_numpy(dr.grad(value)) for key, value in found.items()}

    def _truth(self) -> dict[str, np.ndarray]:
        return {name: latent for p in self.parameters for name, latent in p.truth.items()}

    def _values(self, latents: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        held = {name: mi.Float(latent) for name, latent in latents.items()}
        return {key: to_numpy(value) for key, value in free_parameters.values(self.parameters, held).items()}


def _board(folder: Path) -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise ValueError(
            "fit: a log for TensorBoard needs the package tensorboardX: pip install tensorboardX"
        ) from None
    return SummaryWriter(str(folder))


def summary(fit: Fit) -> str:
    """A fit in JSON: settings apart, everything but pictures and long arrays."""
    return json.dumps(
        {
            "status": fit.status,
            "steps": len(fit.losses),
            "seconds": round(fit.seconds, 3),
            "skipped": fit.skipped,
            "no influence": fit.silent,
            "errors": {label: [float(e[0]), float(e[-1])] for label, e in fit.errors.items()},
            "scores": {label: [float(p[0]), float(p[-1])] for label, p in fit.scores.items()},
            "pictures": fit.measures,
            "noise of the pictures": fit.floors,
            "values": {key: value.ravel().tolist() for key, value in fit.values.items() if value.size <= 64},
        },
        indent=2,
    )
