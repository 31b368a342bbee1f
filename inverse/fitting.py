"""The loop of a fit: render, compare, step; stage after stage; and what is left when it ends, however it ends."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from rimlight.edge_sampling.refusals import Refusal
from rimlight.loading import InputError

from . import balancing, batches, free_parameters, judging, progress, sources
from . import problem as problems
from . import result as results
from .conforming import functions
from .executors import Executor, Here, executor_of
from .free_parameters import to_numpy
from .interruption import listening
from .optimisers import Optimiser
from .problem import Problem
from .progress import Progress, Segment, Step
from .regularisers import Regulariser, penalty_of
from .renderer import Renderer, alone
from .result import WINDOW, Result
from .tensorboard import TensorBoard
from .workers import Lost

log = logging.getLogger(__name__)

#: A stage goes on while its loss falls by this fraction within `patience` steps.
FALL = 1e-3

#: Seconds between checkpoints, at least.
INTERVAL = 5.0

#: Pictures of an animation.
FRAMES = 48


def fit(problem: Problem, *, progress: bool = True, **options: Any) -> Result:
    """Fit the free parameters of a problem to its targets: `Fit(problem, **options).run(progress)`."""
    return Fit(problem, **options).run(progress)


class Fit:
    """A fit: of a problem, or of the fields of one, such as `Fit(scene=…, target=…, free=…)`.

    Parameters
    ----------
    problem : what to fit. Paths in it are relative to the working directory.
    out : folder for checkpoints and the problem. The result itself is written by `rimlight.inverse.write`.
    resume : go on from the checkpoint in `out`. With one thread (`Problem.threads`) the result is bit by bit that of
        a fit that was not interrupted, if each is the only one of its process; with several, sums of gradients differ
        in their last bits, in any two runs alike.
    executor : renders elsewhere, such as a `Cluster`. Default: here.
    tensorboard : write loss and errors into `out` for TensorBoard. Needs the package tensorboardX.
    regularisers : functions of the fitted scene parameters that are added to the loss; see `regularisers`.
    on_step : functions that are called with the `Step` after each one. The method of the same name adds more of them.
        If one has a method `close`, `run` calls it at the end.

    Attributes
    ----------
    status : "running", and at the end "finished", "interrupted", "out of time", or why it stopped or gave up.
    shows : says whether a step shall keep the picture of the first view, for who watches.

    Raises
    ------
    InputError, OSError : the problem cannot be posed, or the checkpoint is not one of it. The text is one line.

    Notes
    -----
    Fits in several threads take turns, step by step: Dr.Jit records one of them at a time.
    """

    def __init__(
        self,
        problem: Problem | None = None,
        *,
        out: Path | str | None = None,
        resume: bool = False,
        executor: Executor | None = None,
        tensorboard: bool = False,
        regularisers: Regulariser | Sequence[Regulariser] = (),
        on_step: Callable[[Step], Any] | Sequence[Callable[[Step], Any]] = (),
        **fields: Any,
    ):
        if problem is not None and fields:
            raise InputError(f"fit: give a problem or its fields, not both: {', '.join(fields)}")
        self.problem = Problem(**fields) if problem is None else problem
        self.file = None if out is None else Path(out) / "checkpoint.npz"
        self.regularisers = functions("regularisers", regularisers)
        self._callbacks = functions("on_step", on_step)
        self.status = "running"
        if tensorboard and self.file is None:
            raise InputError("fit: to write a log for TensorBoard, name a folder")
        with alone(self.problem.variant):
            self._prepare(executor)
            if tensorboard and self.file is not None:
                self._callbacks.append(TensorBoard(self.file.parent))
            if resume:
                if self.file is None:
                    raise InputError("fit: to resume, name the folder that holds the checkpoint")
                self.load(self.file)
            else:
                self._begin()
        if not resume and self.file is not None:
            if self.file.exists():
                log.warning('"%s" of a former fit is replaced; resume=True would go on from it', self.file)
            self.file.parent.mkdir(parents=True, exist_ok=True)
            problems.write(self.file.parent / "problem.toml", self.problem)
            self.save(self.file)

    def _prepare(self, executor: Executor | None) -> None:
        problem = self.problem
        if problem.threads is not None:
            dr.set_thread_count(min(problem.threads, os.cpu_count() or 1))  # more would only wait for each other
        self.renderer = Renderer(problem)
        self.executor = executor_of(problem, executor, self.renderer)
        self.fingerprints = sources.fingerprints(problem, self.renderer.scenes)
        # Stages of one resolution and loss need one check.
        distinct = {(s.resolution, id(n)): i for i, (s, n) in enumerate(zip(problem.stage, problem.norms, strict=True))}
        self.executor.map(Renderer.check, list(distinct.values()), [(i,) for i in range(len(problem.target))])
        self.parameters = free_parameters.find(problem.free, self.renderer.params)
        self.truth_is_known = problem.compares and all(target.file is None for target in problem.target)
        self.optimiser = Optimiser(self.parameters, problem)
        self.start = self.latents()
        self._check_starts()
        stages, starts = list(enumerate(problem.stage)), problem.starts.count
        explored = [Segment(*stages[0], k) for k in range(starts)] if starts > 1 else [Segment(*stages[0])]
        self.plan = [*explored, *(Segment(*entry) for entry in stages[1:])]
        self.total = sum(segment.stage.iterations for segment in self.plan)
        self.progress = Progress()
        self.before: np.ndarray | None = None
        self.image: np.ndarray | None = None
        self._seen: set[int] = set()  # targets that have been compared
        self.shows: Callable[[], bool] = lambda: False
        self._began: float | None = None
        self._before = 0.0
        self._saved, self._cost = 0.0, 0.0  # when the last checkpoint was written, and how long that took, seconds

    # ---------------------- The loop ----------------------

    def run(self, progress: bool = True) -> Result:
        """Run to the end, and render the result. progress : show a bar on standard error.

        Ctrl-C ends the fit after the present step, with a result; pressed twice, at once.
        """
        with (
            listening(self._interrupt),
            tqdm(total=self.total, initial=self.progress.step, desc="fit", disable=None if progress else True) as bar,
        ):
            for _ in self:
                bar.update()
                bar.set_postfix(self._shown(), refresh=False)
        for callback in self._callbacks:
            if hasattr(callback, "close"):
                callback.close()
        return self.result()

    def __iter__(self) -> Iterator[Step]:
        """Take the steps that are left, one by one. A checkpoint is written now and then, and when the loop is left."""
        self._clock_starts()
        while self.status == "running" and self.progress.segment < len(self.plan):
            try:
                step = self.step()
            except Lost as error:
                self.stop(f"stopped: {error}")
                self.executor = Here(self.renderer)  # for the pictures of the result
                break
            self._settle()
            try:
                yield step
            except GeneratorExit:  # the loop was left by break; not in the middle of a step
                self._save()
                raise
        if self.status == "running":
            self.status = "finished"
        self._save()

    def step(self) -> Step:
        """Take one step of the plan, and tell the functions of `on_step`. Refusal : none is left."""
        if self.progress.segment >= len(self.plan):
            raise Refusal(f"fit: there is no step left of {self.progress.step}")
        self._clock_starts()
        with alone(self.problem.variant):
            step = self._step()
        now = self.progress
        now.seconds = self._seconds()
        now.times.append(now.seconds)
        for callback in self._callbacks:
            callback(step)
        return step

    def on_step(self, callback: Callable[[Step], Any]) -> Callable[[Step], Any]:
        """Have a function called with the `Step` after each one; it may `stop` the fit. May stand as a decorator."""
        self._callbacks.append(callback)
        return callback

    def stop(self, status: str = "stopped") -> None:
        """End the fit after the present step. It keeps the best state so far. status : why."""
        if self.status == "running":
            self.status = status

    def _seconds(self) -> float:
        """How long the fit has run, its former runs included."""
        return self._before + (0 if self._began is None else time.monotonic() - self._began)

    def _clock_starts(self) -> None:
        if self._began is None:
            self._began, self._before = time.monotonic(), self.progress.seconds
            self._saved = self._began

    def _settle(self) -> None:
        """After a step: is it the last one? Is it time for a checkpoint?"""
        now = self.progress
        if now.bad >= self.problem.max_bad:
            self.stop(f"gave up: {now.bad} steps in a row led to numbers that are not finite")
        elif self.problem.seconds is not None and now.seconds > self.problem.seconds:
            self.stop("out of time")
        if time.monotonic() - self._saved > max(INTERVAL, self._cost / progress.SHARE):
            self._save()

    def _step(self) -> Step:
        now, segment = self.progress, self.plan[self.progress.segment]
        stage = segment.stage
        attached = self.optimiser.values()
        values = {key: to_numpy(value) for key, value in attached.items()}
        new = set(batches.views(self.problem, now.step)) - self._seen
        tasks = batches.tasks(self.problem, now.step, segment, doubt=new, show=self.shows(), shares=now.shares)
        self._seen |= new
        found = self.executor.gradient(values, tasks)
        loss = float(np.mean([found.losses[task.key] for task in tasks]))
        gradients: dict[str, Any] = {key: found.gradients.get(key, np.float32(0)) / len(tasks) for key in values}
        penalty = penalty_of(self.regularisers, attached)
        if penalty is not None:
            loss += float(np.array(dr.detach(penalty)).item())
        scores = [found.scores[task.key] for task in tasks]
        labels = dict.fromkeys(label for of_task in scores for label in of_task)
        metrics = {label: float(np.mean([s[label] for s in scores if label in s])) for label in labels}
        for text in found.doubts.values():
            now.doubts.append(text)
            log.warning("%s", text)
        self._note(loss, metrics)
        if found.image is not None:
            self._show(found.image)
        errors = {label: known[-1] for label, known in now.errors.items()}
        rate = stage.factor(now.iteration)
        good = bool(np.isfinite(loss)) and all(np.isfinite(g).all() for g in gradients.values())
        if good:
            for parameter in self.parameters:
                if any(np.any(gradients[key]) for key in parameter.keys):
                    now.touched.add(parameter.name)
            before = self.latents()
            good = self.optimiser.step(attached, gradients, rate, penalty)
            if good and self.problem.balance and now.balanced != now.segment:
                balancing.divide(self, tasks[0], before)
        now.bad = 0 if good else now.bad + 1
        now.skipped += not good
        step = Step(now.step, segment.number, now.iteration, loss, metrics, errors, rate, not good)
        now.step += 1
        now.iteration += 1
        if now.step == WINDOW * batches.steps_for_all(self.problem):
            for name in self.silent():
                log.warning('"%s" has no influence on the pictures: its gradient is 0', name)
        if now.iteration >= stage.iterations or self._stalls():
            self._next_segment()
        return step

    def _show(self, image: np.ndarray) -> None:
        """Keep the first and the last picture of the first view that have the present size, for who watches."""
        self.before = image if self.before is None or self.before.shape != image.shape else self.before
        self.image = image

    def silent(self) -> list[str]:
        """Names of parameters whose gradient was always 0."""
        return [p.name for p in self.parameters if p.name not in self.progress.touched]

    def _note(self, loss: float, metrics: Mapping[str, float]) -> None:
        """Keep what is known before a step."""
        now = self.progress
        latents = self.latents()
        for label, error in self.errors(latents).items():
            now.errors.setdefault(label, []).append(error)
        every = -(-self.total // FRAMES)
        if now.step % every == 0:
            now.frames.append((now.step, latents))
        now.losses.append(loss)
        now.note_scores(metrics)
        now.segments.append(now.segment)
        if now.iteration + 1 >= WINDOW:
            mean, error = self.recent()
            if now.best_loss - mean > FALL * abs(mean):
                now.fell = now.iteration
            if mean < now.best_loss:
                now.best_loss, now.best_error, now.best = mean, error, latents

    def errors(self, latents: dict[str, np.ndarray]) -> dict[str, float]:
        """Distance from the truth, label -> number, where that is known."""
        parameters = self.parameters if self.truth_is_known else []
        return {label: error for p in parameters for label, error in p.errors(latents).items()}

    def _stalls(self) -> bool:
        now = self.progress
        return self.problem.patience is not None and now.iteration - now.fell > self.problem.patience + WINDOW

    def _next_segment(self) -> None:
        now, segment = self.progress, self.plan[self.progress.segment]
        last = now.segment == len(self.plan) - 1
        if segment.start is not None:
            loss = self.recent()[0] if np.isfinite(now.losses[-1]) else float("inf")
            now.found.append((loss, self.latents()))
            if last:
                self.restart_at_best_start()
        elif last:
            self.restore_best()
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
            self.restart_at_best_start()
            now.found = []

    def restore_best(self) -> None:
        """Go back to the best state of the segment, if noise does not explain that it was better: not that of the loss,
        nor that of the pictures, whose variance is a part of the loss."""
        now = self.progress
        if now.best and now.segment < len(self.plan):  # after the last step, it has been judged
            mean, error = self.recent()
            better = not mean <= now.best_loss + judging.SURE * np.hypot(error, now.best_error)
            if better and (not np.isfinite(now.losses[-1]) or judging.is_better(self, now.best)):
                self.optimiser.restart(now.best)

    def recent(self) -> tuple[float, float]:
        """Mean of the last losses of the segment that are finite, and its standard error."""
        now = self.progress
        recent = [x for x, k in zip(now.losses[-WINDOW:], now.segments[-WINDOW:], strict=True) if k == now.segment]
        recent = [x for x in recent if np.isfinite(x)]
        if not recent:
            return float("inf"), 0.0
        return float(np.mean(recent)), float(np.std(recent) / np.sqrt(max(len(recent) - 1, 1)))

    def restart_at_best_start(self) -> None:
        self.optimiser.restart(min(self.progress.found, key=lambda entry: entry[0])[1])

    def _start(self, number: int) -> dict[str, np.ndarray]:
        if number == 0:
            return self.start
        rng = np.random.default_rng((self.problem.seed, number))
        spread = self.problem.starts
        scattered = [p.scatter(rng, spread.move, spread.turn, spread.value) for p in self.parameters]
        return {name: latent for of_one in scattered for name, latent in of_one.items()}

    def _check_starts(self) -> None:
        """InputError : several starts are the same, since what is spread is not free."""
        second = self._start(1) if self.problem.starts.count > 1 else {}
        if second and all(np.array_equal(second[name], start) for name, start in self.start.items()):
            raise InputError(
                "fit: all starts are the same: starts.move and starts.turn spread rigid bodies, starts.value all else"
            )

    def latents(self) -> dict[str, np.ndarray]:
        """What the optimiser holds: name -> array."""
        return dict(self.optimiser.latents())

    def values(self, latents: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
        """Scene parameters, by key: flat, a matrix (4, 4), or a tensor. latents : default: the present ones."""
        held = {name: mi.Float(latent) for name, latent in (latents or self.latents()).items()}
        return {key: to_numpy(value) for key, value in free_parameters.values(self.parameters, held).items()}

    def result(self) -> Result:
        """What the fit found: the best state so far, or the last one if it is finished, with pictures."""
        with alone(self.problem.variant):
            try:
                return results.of(self)
            except Lost as error:
                log.warning("%s; the pictures of the result are rendered by this process", error)
                self.executor = Here(self.renderer)
                return results.of(self)

    def _shown(self) -> dict[str, str]:
        now = self.progress
        shown = {"loss": f"{now.losses[-1]:.2e}"}
        for label, numbers in list((now.errors | now.scores).items())[:2]:
            shown[label.split(" (")[0]] = f"{numbers[-1]:.2e}"
        return shown

    def _interrupt(self) -> None:
        self.stop("interrupted")
        log.warning("interrupted: the fit ends after this step, with a result; Ctrl-C ends it at once")

    # ---------------------- Checkpoints ----------------------

    def save(self, file: Path | str) -> None:
        """Write a checkpoint, from which `load` goes on. OSError : it cannot be written; the last one stays."""
        with alone(self.problem.variant):
            progress.save(Path(file), self.progress, self.optimiser.state(), self._belongs())

    def _belongs(self) -> dict[str, Any]:
        return progress.belongs(self.problem, self.fingerprints)

    def load(self, file: Path | str) -> None:
        """Go on from a checkpoint of the same fit. Its files may have moved, but must hold the same.

        Raises
        ------
        InputError : the checkpoint is of another fit, or of other scenes or pictures. ValueError : it is damaged.
        OSError : it cannot be read.
        """
        now, optimiser, facts = progress.load(Path(file))
        progress.check_same(file, facts, self._belongs())
        with alone(self.problem.variant):
            self.progress = now
            self.optimiser.restore(optimiser)
            self._seen = set(range(len(self.problem.target)))
        self.status, self._began = "running", None

    def _save(self) -> None:
        """Write the checkpoint of the folder. If it cannot be written, the fit stops, and the last one stays."""
        if self.file is None or self.status.startswith("stopped: cannot write"):
            return
        began = time.monotonic()
        try:
            self.save(self.file)
        except OSError as error:
            free = shutil.disk_usage(self.file.parent).free
            if self.status == "finished":
                log.warning("%s (%.3g MB are free there)", error, free / 1e6)
            else:
                self.status = f"stopped: {error} ({free / 1e6:.3g} MB are free there)"
        self._saved = time.monotonic()
        self._cost = self._saved - began
