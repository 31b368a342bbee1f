"""Shape and reflectance from photometric stereo (Bangaru 2019, algorithm 1), with the inner problems solved directly.

In turns: the BSDF, the normals and albedos, and the exposures of the images, given what surfaces hide and what they
reflect on each other; then depth from normals, and from it the shadows and interreflections, by path tracing. Each
alternation makes the interreflections of a better surface, and so on (Nayar et al. 1991), from coarse images to fine.
"""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from rimlight import ggx
from rimlight.edge_sampling.refusals import InputError

from . import least_squares, nearness, plausibility, start, taking_back, uncertainty
from .alternation import Alternations, Course, State, View
from .dataset import Dataset
from .direct import Guess
from .evidence import Judge, Kind, left_out
from .progress import Checkpoint, Progress
from .refinement import Descent, descend
from .rendering import Domain, Rendering

#: Alternations from the normals of a glossy surface; of each kind of material, from the best state of the simplest, for
#: with the normals of the start, anything may look like a coat. And at the largest size, of the same kind with a coat,
#: or without: small pixels show it better.
SETTLED, RECONSIDERED = 3, 2

#: Longest path, as of the plugin `rig`.
LONGEST = 16


@dataclass(frozen=True, kw_only=True)
class Options:
    """How shape and reflectance are reconstructed.

    Raises
    ------
    ValueError : an option is out of its range.
    """

    start: Literal["least squares", "trimmed", "reweighted"] = "trimmed"
    """Method that finds the normals at the start."""
    reflectance: bool = True
    """Fit the BSDF. Otherwise, the surface is taken to be Lambertian, and only its colour is fitted."""
    coat: bool | None = None
    """Diffuse light comes from under a smooth coat, as in plastics. Default: what predicts better."""
    materials: Literal["one", "several"] | None = None
    """one: one material, with a factor for each pixel. several: several materials under one glaze, with a diffuse
    colour for each pixel and highlights that all pixels share. Default: what predicts better."""
    albedo: bool = True
    """Fit a factor of the BSDF for each pixel. Otherwise, the material has no texture."""
    exposures: bool = True
    """Estimate the exposure of each image."""
    dark: float = 0.2
    """Fraction of the values of each pixel that is left out: the darkest ones."""
    shadows: bool = True
    """Leave out values in shadows that the surface itself casts."""
    max_depth: int = 3
    """Longest path: 2 is direct light, 3 adds one interreflection."""
    spp: int = 8
    """Samples per pixel of interreflections, at least: small images have more."""
    smoothing: float = 1.5
    """Smoothing of interreflections, whose noise the normals would inherit: standard deviation in pixels, at `spp`
    samples. With more samples it is less."""
    resolutions: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Sizes of the images, relative to the data."""
    iterations: tuple[int, ...] = (10, 6, 4)
    """Largest number of alternations at each of the resolutions."""
    tolerance: float = 0.02
    """Alternations end when normals turn by less than this on average, in degrees."""
    descent: Descent = dataclasses.field(default_factory=Descent)
    """Steps along derivatives of path-traced images, after the last alternation."""
    bilateral: float | None = None
    """Sharpness of discontinuities of depth; see `integrate`."""
    brightness: float = 0.6
    """Albedo of the brightest colour of a median pixel; of metal it is less, so that lobes explain its highlights. It
    sets the unknown scale of the images, on which the interreflections depend. 0: the scale is known, and values are
    radiances under lights of irradiance 1 (times intensity)."""
    near_lights: bool = True
    """Estimate how far away the lights are, where no file says it, there is no camera, and no descent."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self):
        if len(self.resolutions) != len(self.iterations) or not self.resolutions:
            raise InputError(
                f'ps: "resolutions" and "iterations" must be as many, got {self.resolutions}, {self.iterations}'
            )
        if self.start not in least_squares.METHODS:
            raise InputError(f'ps: "start" must be one of {", ".join(least_squares.METHODS)}, got {self.start}')
        if min(self.iterations) < 1:
            raise InputError(f'ps: "iterations" must be at least 1 each, got {self.iterations}')
        if not all(0 < r <= 1 and 1 / r == round(1 / r) for r in self.resolutions):
            raise InputError(f'ps: "resolutions" must be 1 or 1 over a whole number, got {self.resolutions}')
        ranges = {
            "dark": (0 <= self.dark < 1, "in [0, 1)"),
            "max_depth": (2 <= self.max_depth <= LONGEST, f"from 2 to {LONGEST}"),
            "spp": (self.spp >= 1, "at least 1"),
            "smoothing": (0 <= self.smoothing < np.inf, "at least 0"),
            "tolerance": (0 <= self.tolerance < np.inf, "at least 0"),
            "bilateral": (self.bilateral is None or 0 < self.bilateral < np.inf, "positive; 2 is usual"),
            "brightness": (0 <= self.brightness < np.inf, "at least 0; 0.6 is usual"),
            "seed": (self.seed >= 0, "at least 0"),
        }
        for name, (holds, wanted) in ranges.items():
            if not holds:
                raise InputError(f'ps: "{name}" must be {wanted}, got {getattr(self, name)}')

    def kinds(self) -> tuple[Kind, ...]:
        """Of material, that are tried."""
        if not self.reflectance:
            return (Kind(),)
        several = (False, True) if self.materials is None and self.albedo else (self.materials == "several",)
        coat = (False, True) if self.coat is None else (self.coat,)
        return tuple(Kind(s, c) for s in several for c in coat)

    def others(self) -> tuple[int, int]:
        """Alternations that compare kinds of material: at the smallest size, and at the largest."""
        kinds = self.kinds()
        again = len(self.resolutions) > 1 and len({kind.coat for kind in kinds}) > 1
        glossy = SETTLED if self.reflectance else 0
        return glossy + (SETTLED * len(kinds) if len(kinds) > 1 else 0), RECONSIDERED if again else 0


@dataclass
class Result:
    """start : its normals, (P, 3). depth : (Q,), of the pixels of `domain`. weights : (B, 3), with `scale` the BSDF of
    the images. kind : of its material. verdict : "start", if that predicts what was left out as well as anything, and
    so was kept; "judged", if something else predicts better; "not judged", with too few lights to leave any out, and
    the start was kept. left_out : how far predictions of "start" and "result" are off, in the mean value of each pixel.
    halves : of both, the mean angle between normals of one half of the lights and of the other, degrees. curl : of
    both, that between normals and those of the depth that is integrated from them. taken_back : mean share of
    the start in the normals.
    strength : by which factor interreflections were multiplied, for shadows to be as they are in the images; NaN if
    there are too few of these, and so they were left as they are.
    away : distance of the lights from the middle of the object, pixels of the full size, if the shading told it;
    infinity if it did not. uncertainty : standard errors of the normals before descent, (P,), degrees, see
    `uncertainty.of_normals`; None before the end, and if the start is returned.
    doubts : what is probably wrong with the data, in sentences. history : for each alternation, the size of the images,
    seconds since the start, the root mean square residual over the median value, and where the truth is known the mean
    angular error, degrees."""

    data: Dataset
    lobes: ggx.Lobes
    guess: Guess
    depth: np.ndarray
    domain: object
    start: np.ndarray
    scale: float
    kind: Kind
    verdict: str = "not judged"
    left_out: dict[str, float] = field(default_factory=dict)
    halves: dict[str, float] = field(default_factory=dict)
    curl: dict[str, float] = field(default_factory=dict)
    taken_back: float = 0.0
    strength: float = np.nan
    away: float = np.inf
    uncertainty: np.ndarray | None = None
    doubts: tuple[str, ...] = ()
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def normal_map(self) -> np.ndarray:
        """(H, W, 3), 0 outside the mask."""
        return self.data.image(self.guess.normals)

    @property
    def depth_map(self) -> np.ndarray:
        """(H, W), NaN outside the mask."""
        return self.data.image(self.depth[self.domain.inner], np.nan)

    @property
    def error(self) -> float | None:
        """Mean angular error, degrees, of the pixels whose true normals are known."""
        return None if self.data.truth is None else float(np.nanmean(self.data.off(self.guess.normals)))


def reconstruct(
    data: Dataset,
    options: Options | None = None,
    *,
    progress: bool = True,
    after: Callable[[Result], None] | None = None,
    checkpoint: Path | str | None = None,
    resume: bool = False,
) -> Result:
    """Normals, depth and reflectance of a data set.

    Of all states, the one is returned that best predicts values that were left out. `Result.verdict` says if it is the
    start.

    after : called with the best result so far after each alternation, and with the newest after each step of descent.
    checkpoint : file from which the reconstruction can go on, in place of which a newer one is written after
        alternations. Writing takes at most a twentieth of the time.
    resume : go on from that file. With one thread of Dr.Jit, the result is bit by bit that of a reconstruction which
        was not interrupted; with several, sums differ in their last bits, in any two reconstructions alike. Descent
        begins anew.

    Raises
    ------
    ValueError : lights lie in a plane, all images are black, or the mask has hardly any pixels; the checkpoint is
        damaged, or belongs to other data or options. OSError : there is no checkpoint.
    """
    run = Reconstruction(data, options or Options(), after=after)
    if checkpoint is not None:
        run.keep(Path(checkpoint), resume=resume)
    elif resume:
        raise InputError("ps: to resume, name the checkpoint")
    return run.finish(progress)


class Reconstruction:
    """A reconstruction under way; `now` says how far it is."""

    def __init__(self, data: Dataset, options: Options, *, after: Callable[[Result], None] | None = None):
        if not mi.is_rgb or mi.is_polarized:
            raise InputError(f"ps: a variant of three colours is needed, such as llvm_ad_rgb, got {mi.variant()}")
        start.check(data)
        self.data, self.options, self.after = plausibility.checked(data, options.start), options, after
        self.lobes = ggx.read_dictionary()[0] if options.reflectance else ggx.Lobes((np.nan,), (np.nan,))
        self.kinds = options.kinds()
        self.rng = np.random.default_rng(options.seed)
        self.scale = start.scale(self.data.at(options.resolutions[0]), self.lobes, options)
        self.now = Progress(kind=self.kinds[0])
        self.file: Checkpoint | None = None
        self.work: Alternations | None = None
        self.uncertainty: np.ndarray | None = None

    def keep(self, path: Path, *, resume: bool) -> None:
        """Write checkpoints from now on. resume : go on from the one that is there."""
        self.file = Checkpoint(path, self.data, self.options)
        if resume:
            self.now = self.file.load(self.rng)
        else:
            self.file.save(self.now, self.rng)

    def finish(self, progress: bool = True) -> Result:
        options, now = self.options, self.now
        self.before, self.began = now.seconds, time.perf_counter()
        total = sum(options.iterations) + sum(options.others()) + options.descent.steps
        with tqdm(total=total, initial=len(now.history), desc="ps", disable=not progress) as self.bar:
            result: Result | None = None
            while now.level < len(options.resolutions):
                result = self._alternate(result)
                now.next_level(result.kind)
            if options.descent.steps:
                self._descend(result)
        return result

    # ---------------------- Alternations ----------------------

    def _alternate(self, coarse: Result | None) -> Result:
        """All alternations at one size of the images. coarse : what was found at the one before; None if it is the
        first, or some of this one are made already."""
        now, options = self.now, self.options
        size = options.resolutions[now.level]
        level = self.data.at(size)
        if self.scale != 1:
            level = dataclasses.replace(level, values=level.values * np.float32(self.scale))
        self.shown = level, Domain(level)
        if now.level and np.isfinite(now.away):
            level = nearness.around(level, now.away * size)
        counts = start.counts(self.data, level, size, options.dark)
        method = start.method(self.data, level, size, options)
        judge = Judge(level, self.lobes, left_out(level, options.seed), counts, options.seed, *method)
        # With too few lights to judge by, the start is kept, and one alternation tells how far it is off the images
        plan = [(now.kind, options.iterations[now.level] if judge.able else 1, False)]
        if now.level == 0 and judge.able and options.reflectance:
            plan += [(now.kind, SETTLED, True)]
            plan += [(kind, SETTLED, False) for kind in self.kinds if len(self.kinds) > 1]
        elif now.level == len(options.resolutions) - 1 and judge.able:
            same = (kind for kind in self.kinds if kind.several == now.kind.several and kind != now.kind)
            plan += [(kind, RECONSIDERED, False) for kind in same]
        for kind, most, glossy in plan[now.trial :]:
            view, self.work = None, None  # of Dr.Jit's scenes one at a time
            self.work = Alternations(level, self.lobes, kind, judge, options, self.rng)
            if now.start is None:
                view = self._begin(most, coarse)
            elif now.course is None and glossy:
                guess = start.glossy_guess(level, self.lobes, judge.counts, now.start.guess)
                now.course = Course(State(guess, self.work.integrate(guess), kind, left_out=np.inf), most)
            elif now.course is None:
                # Of another kind, never the best as it is: its judge fits the material, but its normals are not fitted
                unknown = np.nan if kind == now.settled.kind else np.inf
                now.course = Course(dataclasses.replace(copy.deepcopy(now.settled), left_out=unknown), most)
            now.end_trial(self.work.run(now.course, self._record, view), settles=glossy)
        if now.level == 0:
            self._try_near(level, judge)
        if now.level == len(options.resolutions) - 1:
            self._take_back()
        return self._result()

    def _try_near(self, level: Dataset, judge: Judge) -> None:
        """After the trials of the first size: go on from their best state with lights at the distance that the shading
        tells, if it tells any. level : with distant lights."""
        now, options = self.now, self.options
        size = options.resolutions[0]
        if now.away is None:
            now.away, best = np.inf, now.best_so_far()
            if options.near_lights and judge.able and not options.descent.steps:
                self._work_on(best)
                now.away = nearness.distance(self.work, best) / size
            if np.isfinite(now.away):
                now.try_near(now.away)
                self.bar.total += SETTLED
        if now.distant is None:
            return
        near, kind, self.work = nearness.around(level, now.away * size), now.distant.kind, None
        judge = dataclasses.replace(judge, data=near)
        self.work = Alternations(near, self.lobes, kind, judge, options, self.rng)
        if now.course is None:
            lights = start.flat(near).lighting()
            guess = start.guess(near, self.lobes, judge.counts, options, (judge.start, judge.usable))
            now.start, _ = self.work.judged_start(guess, lights, self.kinds)
            guess = copy.deepcopy(now.distant.guess)
            now.course = Course(State(guess, self.work.integrate(guess), kind, left_out=np.inf), SETTLED)
        now.end_near(self.work.run(now.course, self._record))
        if np.isinf(now.away):
            self.work = None
            self.work = Alternations(level, self.lobes, kind, dataclasses.replace(judge, data=level), options, self.rng)

    def _work_on(self, state: State) -> None:
        """With the kind of its material."""
        if self.work.kind != state.kind:
            work, self.work = self.work, None
            self.work = Alternations(work.data, self.lobes, state.kind, work.judge, self.options, self.rng)

    def _take_back(self) -> None:
        """To the start, what of the best state depends more on which lights tell it."""
        now, best = self.now, self.now.best_so_far()
        if best.start or not self.work.judge.able:
            return
        self._work_on(best)
        lights, view = start.flat(self.work.data).lighting(), self.work.view(best.guess, best.depth)
        now.best, now.back = taking_back.taken_back(self.work, best, now.start, lights, view)
        self.uncertainty = uncertainty.of_normals(self.work, now.best, view)

    def _begin(self, most: int, coarse: Result | None) -> View | None:
        """Judge the start of a size, and begin its alternations. Returns the view of their first state, if known."""
        now, options, work = self.now, self.options, self.work
        judge = work.judge
        guess = start.guess(work.data, self.lobes, judge.counts, options, (judge.start, judge.usable))
        now.start, view = work.judged_start(guess, start.flat(work.data).lighting(), self.kinds)
        if coarse is None:
            now.course = Course(copy.deepcopy(now.start), most)
            return None if work.kind.several else view  # of several, the guess is another one
        sides = [round(1 / options.resolutions[i]) for i in (now.level - 1, now.level)]
        guess = start.refined(coarse.guess, coarse.domain, work.data, before=sides[0], now=sides[1])
        # Never the best, for it was not fitted to these images, though what is fitted to it may predict well
        now.course = Course(State(guess, work.integrate(guess), work.kind, left_out=np.inf), most)
        return None

    def _record(self, residual: float) -> None:
        """After each alternation."""
        self._note(self.now.course.state.guess.normals, residual)
        if self.file is not None:
            self.file.save_if_due(self.now, self.rng)
        if self.after is not None:
            self.after(self._result())

    def _note(self, normals: np.ndarray, residual: float) -> None:
        now, level = self.now, self.work.data
        now.seconds = self.before + time.perf_counter() - self.began
        size = self.options.resolutions[min(now.level, len(self.options.resolutions) - 1)]
        entry = {"size": size, "seconds": now.seconds, "residual": residual}
        if level.truth is not None:
            entry["error"] = float(np.nanmean(level.off(normals)))
        now.history.append(entry)
        self.bar.set_postfix({k: f"{v:.3g}" for k, v in entry.items() if k != "seconds"})
        self.bar.update()

    def _result(self) -> Result:
        """The best of what has been judged so far, at the present size."""
        now, work = self.now, self.work
        best, (data, domain), away = now.best_so_far(), self.shown, now.away or np.inf
        size = self.options.resolutions[min(now.level, len(self.options.resolutions) - 1)]
        return Result(
            data,
            self.lobes,
            best.guess,
            best.depth if np.isinf(away) else nearness.as_orthographic(best.depth, away * size),
            domain,
            now.start.guess.normals,
            self.scale,
            best.kind,
            verdict="not judged" if not work.judge.able else "start" if best.start else "judged",
            left_out={"start": now.start.left_out, "result": best.left_out},
            halves={"start": now.start.halves, "result": best.halves},
            curl={"start": now.start.curl, "result": best.curl},
            taken_back=1.0 if best.start else now.back,
            strength=best.strength,
            away=away,
            uncertainty=self.uncertainty,
            doubts=self.data.doubts,
            history=now.history,
            seconds=now.seconds,
        )

    # ---------------------- Descent ----------------------

    def _descend(self, result: Result) -> None:
        """Steps along derivatives of path-traced images, from the best state, in place."""
        work, options, data, guess = self.work, self.options, result.data, result.guess
        if work.kind != result.kind or options.descent.lights:
            several, eta = result.kind.several, result.kind.base_eta(result.lobes)
            work.rendering = Rendering(
                data,
                result.lobes,
                max_depth=options.max_depth,
                lights=options.descent.lights,
                several=several,
                base_eta=eta,
            )
        if options.descent.depth_rate:
            counts = np.ones_like(work.judge.counts)
        else:
            work.rendering.update(guess, result.depth)
            counts = work.judge.counts * (work.rendering.visible(work.lighting) if options.shadows else 1)

        def note(depth: np.ndarray, residual: float) -> None:
            result.depth = depth
            self._note(guess.normals, residual)
            result.seconds = self.now.seconds
            if self.after is not None:
                self.after(result)

        result.depth = descend(
            work.rendering,
            data,
            guess,
            result.depth,
            counts,
            options.descent,
            self.rng,
            bilateral=options.bilateral,
            after=note,
        )
