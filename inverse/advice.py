"""Which integrator suits derivatives with respect to some parameters: measured, not guessed from the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from rimlight.edge_sampling.refusals import Refusal

from . import free_parameters
from .free_parameters import Parameter, to_numpy
from .problem import Free, Problem, Stage, Target
from .renderer import Renderer, Task
from .view import derived_seed

#: Gradients of a pilot: of so many pictures of random numbers, so many of each.
PATTERNS, RUNS = 4, 16

#: Size of the film of a pilot, pixels, along its width; and samples of each.
WIDTH, SAMPLES = 16, 16

#: Squares along the width and the height of the film, in each of which a picture of random numbers has one number. The
#: differences of a fit are as coarse. With numbers of each pixel, the derivative would cancel in the sum over them.
SQUARES = 4

#: How often means that differ by noise alone may be taken for different.
CHANCE = 1e-4

#: Standard errors that are left for noise.
SURE = 2.0

#: Draws of the runs, by which the noise of a measured noise is estimated (bootstrap, Efron 1979).
DRAWS = 200


@dataclass(frozen=True)
class Pilot:
    """Gradients by one integrator.

    gradients : of each parameter, (PATTERNS, RUNS, n): with respect to its latent numbers, those of a rigid body as
        displacements of its outermost point. seconds : of the kernels, for one gradient: the least of
        all, since others may have waited for other work.
    """

    integrator: str
    gradients: tuple[np.ndarray, ...]
    seconds: float

    def effort(self, runs: Any = slice(None)) -> float:
        """Variance of a gradient, times the time that it takes: the geometric mean over the parameters, so that their
        units do not matter. runs : some of them."""
        variances = [g[:, runs].var(1, ddof=1).mean(0).sum() for g in self.gradients]
        return float(np.exp(np.mean(np.log(variances)))) * self.seconds

    def error(self) -> float:
        """Standard error of the logarithm of `effort`."""
        random = np.random.default_rng(0)
        draws = [self.effort(random.integers(RUNS, size=RUNS)) for _ in range(DRAWS)]
        return float(np.std(np.log(draws)))


@dataclass(frozen=True)
class Row:
    """What a pilot says of an integrator.

    effort : variance times time, relative to the integrator that is advised. low, high : where noise leaves it.
    lacks : why it is not advised, whatever its noise; or nothing.
    """

    integrator: str
    seconds: float
    effort: float
    low: float
    high: float
    lacks: str = ""

    def __str__(self) -> str:
        if not self.seconds:
            return f"  {self.integrator:<12} {self.lacks}"
        numbers = f"variance x time {self.effort:6.3g} ({self.low:.3g} to {self.high:.3g})"
        lacks = f"; {self.lacks}" if self.lacks else ""
        return f"  {self.integrator:<12} {numbers}, {1e3 * self.seconds:.3g} ms{lacks}"


@dataclass(frozen=True)
class Advice:
    """Which integrator suits derivatives with respect to `keys`. `print` it.

    rows : of each integrator that was tried; the first is advised. sure : does its lead exceed noise?
    """

    keys: tuple[str, ...]
    rows: tuple[Row, ...]
    sure: bool

    @property
    def integrator(self) -> str:
        """Plugin for derivatives."""
        return self.rows[0].integrator

    def __str__(self) -> str:
        best, *others = self.rows
        fit = [row for row in others if not row.lacks]
        if not fit:
            why = "the others do not suit"
        elif self.sure:
            why = f"which needs {fit[0].effort:.2g} times less time than {fit[0].integrator} for the same noise"
        else:
            why = f"but the difference from {fit[0].integrator} is within the noise of this measurement"
        head = f"derivatives with respect to {', '.join(self.keys)}: {best.integrator}, {why}"
        return "\n".join([head, *map(str, self.rows)])


def advice(
    scene: mi.Scene, keys: Sequence[str], *, sensor: int = 0, max_depth: int = 6, direct: bool = False, seed: int = 0
) -> Advice:
    """Which of `prb_edge` and `bdpt_edge` suits derivatives with respect to these parameters.

    It differentiates random pictures, by each integrator, on a small film, again and again, and compares the variance
    of the gradients times the time of their kernels. Most of its own time is compilation. Vertex positions and
    transformations move as rigid bodies.

    An integrator that finds some light hardly ever has little variance in a pilot, but also another mean. So one whose
    gradients differ from those of another by more than their noise explains, and are shorter, is not advised. What is
    so rare for all of them that none found it remains unknown.

    Parameters
    ----------
    keys : of parameters, as `rimlight params` lists them.
    max_depth : of paths, in segments; -1 stands for no limit, which `bdpt_edge` does not have.
    direct : try `direct_edge`, too, where little light is reflected more than once.

    Raises
    ------
    ValueError : a key is unknown, or cannot be differentiated.
    RuntimeError : no integrator has this derivative, or it is 0 for all.
    """
    kinds: list[dict[str, Any]] = [{"type": kind, "max_depth": max_depth} for kind in ("prb_edge", "bdpt_edge")]
    pilots: list[Pilot] = []
    refused: list[Row] = []
    for kind in ([{"type": "direct_edge"}] if direct else []) + kinds:
        try:
            pilots.append(_pilot(scene, keys, kind, sensor, seed))
        except RuntimeError as error:
            refused.append(_without_numbers(kind["type"], f"cannot: {error}"))
    if not pilots:
        raise Refusal("; ".join(row.lacks for row in refused))
    return compared(tuple(keys), pilots, refused)


def compared(keys: tuple[str, ...], pilots: Sequence[Pilot], refused: Sequence[Row] = ()) -> Advice:
    """What pilots say. refused : rows of integrators that have none.

    Raises
    ------
    RuntimeError : the gradients of all are 0, or not finite.
    """
    seen = [j for j in range(len(pilots[0].gradients)) if any(p.gradients[j].any() for p in pilots)]
    if not seen or not all(np.isfinite(g).all() for p in pilots for g in p.gradients):
        raise Refusal(f"{', '.join(keys)}: the derivatives to be measured are {'not finite' if seen else 'zero'}")
    pilots = [Pilot(p.integrator, tuple(p.gradients[j] for j in seen), p.seconds) for p in pilots]
    lacks = {p.integrator: _lacks(p, pilots) for p in pilots}
    # Of one without any light, the variance is 0.
    tried = [(p, p.effort(), p.error()) for p in pilots if all(g.any() for g in p.gradients)]
    best, least, error = min(tried, key=lambda of: (bool(lacks[of[0].integrator]), of[1]))
    rows, sure = [], True
    for pilot, effort, own in tried:
        ratio, spread = effort / least, np.exp(SURE * np.hypot(own, error))
        low, high = (ratio / spread, ratio * spread) if pilot is not best else (1.0, 1.0)
        rows.append(Row(pilot.integrator, pilot.seconds, ratio, low, high, lacks[pilot.integrator]))
        sure &= pilot is best or bool(lacks[pilot.integrator]) or low > 1
    rows.sort(key=lambda row: (row.integrator != best.integrator, bool(row.lacks), row.effort))
    seeing = {row.integrator for row in rows}
    blind = [_without_numbers(kind, why or "its derivative is 0") for kind, why in lacks.items() if kind not in seeing]
    return Advice(keys, (*rows, *blind, *refused), sure)


def _without_numbers(integrator: str, why: str) -> Row:
    return Row(integrator, 0.0, np.inf, np.inf, np.inf, why)


def _lacks(pilot: Pilot, pilots: Sequence[Pilot]) -> str:
    """What an integrator has missed, in words; or nothing."""
    # As if one number, of one picture, made all of the noise: which may be so.
    limit = stats.f.isf(CHANCE, 1, RUNS - 1)
    for other in pilots:
        for a, b in zip(pilot.gradients, other.gradients, strict=True):
            means, variances = [g.mean(1) for g in (a, b)], [g.var(1, ddof=1) / RUNS for g in (a, b)]
            noise = (variances[0] + variances[1]).sum()
            lengths = [float((m**2 - v).sum()) for m, v in zip(means, variances, strict=True)]
            ratio = ((means[0] - means[1]) ** 2).sum() / noise if noise else 0
            if ratio > limit and lengths[0] < lengths[1]:
                far = f"its mean differs from that of {other.integrator} by {np.sqrt(ratio):.1f} times their noise"
                return f"{far}, so it misses light"
    return ""


def _pilot(scene: mi.Scene, keys: Sequence[str], kind: dict[str, Any], sensor: int, seed: int) -> Pilot:
    """Measure an integrator. kind : its dictionary."""
    free = tuple(Free(key=(key,), kind="pose") for key in keys)
    black = np.zeros((*reversed(scene.sensors()[sensor].film().crop_size()), 1), np.float32)
    problem = Problem(
        scene=scene, integrator=kind, free=free, target=(Target(file=black, sensor=sensor),), stage=(Stage(),)
    )
    renderer = Renderer(problem)
    (view,) = renderer.views
    parameters = free_parameters.find(free, renderer.params)
    values = {key: to_numpy(renderer.params[key]) for parameter in parameters for key in parameter.keys}
    cropped = tuple(view.sensor.film().crop_size()) != tuple(view.sensor.film().size())
    task = Task(0, None if cropped else min(WIDTH, view.size[1]), SAMPLES, 0)
    try:
        shape = renderer.image(values, task).shape
        patterns = [random_picture(shape, np.random.default_rng((seed, i))) for i in range(PATTERNS)]
        found, seconds = [], []
        for run in range(-2, PATTERNS * RUNS):  # the first two compile
            task = Task(0, task.width, SAMPLES, derived_seed(seed, run + 2))
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                gradients = renderer.gradient_of(values, patterns[run % PATTERNS], task, values)
                seconds.append(sum(kernel["execution_time"] for kernel in dr.kernel_history()) / 1e3)
            found.append([of_latents(parameter, gradients) for parameter in parameters])
    finally:
        view.resize(None)
        view.loaded.reset()
    by_pattern = lambda g: np.array(g).reshape(RUNS, PATTERNS, -1).swapaxes(0, 1)
    return Pilot(kind["type"], tuple(map(by_pattern, zip(*found[2:], strict=True))), min(seconds[2:]))


def random_picture(shape: tuple[int, ...], random: np.random.Generator) -> np.ndarray:
    """(H, W, C), float32: squares with a normally distributed number each."""
    rows, columns = (np.arange(n) * SQUARES // n for n in shape[:2])
    picture = random.standard_normal((SQUARES, SQUARES))[rows][:, columns, None]
    return np.broadcast_to(picture, shape).astype(np.float32)


def of_latents(parameter: Parameter, gradients: dict[str, np.ndarray]) -> np.ndarray:
    """Gradient with respect to the latent numbers of a parameter, each times its rate: flat, double precision.

    gradients : with respect to scene parameters, by key, flat.
    """
    latents = {name: mi.Float(start) for name, start in parameter.start.items()}
    dr.enable_grad(*latents.values())
    flat = {key: _flat(value) for key, value in parameter.values(latents).items()}
    for key, value in flat.items():
        # A copy: of memory that Dr.Jit has lent to NumPy, another thread lets go, which may wait for this one forever.
        dr.set_grad(value, mi.Float(gradients[key].astype(np.float32).ravel()))
    dr.enqueue(dr.ADMode.Backward, *flat.values())
    dr.traverse(dr.ADMode.Backward)
    rates = parameter.rates()
    return np.concatenate([rates[name] * np.array(dr.grad(latent), np.float64) for name, latent in latents.items()])


def _flat(value: Any) -> mi.Float:
    """The numbers of a scene parameter, attached, in the order of `to_numpy`."""
    if free_parameters.is_transform(value):
        return dr.concat([mi.Float(value.matrix[i, j]) for i in range(4) for j in range(4)])
    return value.array if dr.is_tensor_v(value) else dr.ravel(value)
