"""Alternations at one size of the images, for one kind of material: what `reconstruction.reconstruct` is made of."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import numpy as np
from scipy import ndimage

from rimlight import ggx

from . import calibration, in_shadow
from .dataset import LUMINANCE, Dataset, angles
from .direct import DirectModel, Guess, Lighting
from .evidence import FAR, Judge, Kind, mean_angle
from .rendering import Rendering

#: Paths of each image of interreflections, at least: small images have more samples per pixel than `spp`, and are
#: smoothed less, at equal noise. Smoothing takes away what a fold reflects of the one beside it.
PATHS = 2**18

#: Exposures that seem to be off by less (logarithm) are taken as stated: shapes and BSDFs explain so much as well.
STATED = 0.02

#: Fits of the BSDF and of normals in turns, in each alternation: rendering takes longer.
INNER = 3

#: Steps of pixels that begin again from the normals of the surface.
AGAIN = 6

#: A pixel under a glaze of several materials is taken to have none if it then has less than this part of its loss, mean
#: over pixels with a Gaussian of this standard deviation. Set with the random sets 1056, 5098, 5100 and 7069.
MATTE, BESIDE = 0.9, 1.0

#: By which part the product of `left_out` and `halves` must be less for another kind of material: one that may be more
#: also makes up a little for what has nothing to do with it, such as lights that are not at infinity. Set with the bear
#: of DiLiGenT at a quarter of its size, where a coat takes away 14 %, a glaze with a coat 18 %, and normals get worse;
#: of a figure with folds under a glaze, the coat takes away 38 %.
GAIN = 0.25

#: By how many degrees the normals of a result may be farther from those of a surface than the normals of the start:
#: details that the start lacks are less smooth. Set with the random sets of the seeds 1000 to 1023.
CURLED = 1.0

#: Smaller deviations of predictions are those of rounding, and may be 0.
NOTHING = 1e-9

#: Alternations end after so many that predict what was left out worse than the best one did.
PATIENCE = 3


@dataclass
class State:
    """guess, and depth, (Q,), with the kind of its material. left_out : how far the values that were left out are off
    what is predicted, in the mean value of each pixel; NaN if there are too few lights.
    strength : of its interreflections, as of `View`. start : is it the start?"""

    guess: Guess
    depth: np.ndarray
    kind: Kind
    left_out: float = np.nan
    halves: float = np.nan
    curl: float = np.nan
    strength: float = np.nan
    start: bool = False

    def better_than(self, other: State | None) -> bool:
        """Are predictions and halves together better? Where nothing can be left out, what is newer is."""
        return other is None or not self.part_of(other) >= 1

    def beats(self, start: State) -> bool:
        """Does it predict better than the start, do its normals depend less on which lights tell them, and are they
        about as much those of a surface? Where nothing can be left out, nothing does; nor where both halves of the
        lights tell such different normals that most angles are as large as any that count."""
        worse = not self.left_out < start.left_out or self.halves >= start.halves or self.curl > start.curl + CURLED
        return not (worse or self.halves > FAR / 2)

    def needed_beside(self, simpler: State) -> bool:
        """Does it predict better than what is simpler, and are predictions and halves together better by `GAIN`?"""
        return self.left_out < simpler.left_out and self.part_of(simpler) < 1 - GAIN

    def part_of(self, other: State) -> float:
        """The product of `left_out` and `halves` over that of the other one; of `left_out` alone if halves are not
        known."""
        known = np.isfinite([self.halves, other.halves]).all() and other.halves > 0
        return self.left_out / max(other.left_out, NOTHING) * (self.halves / other.halves if known else 1)


@dataclass
class Course:
    """How far alternations are, at one size and with one kind of material: all that they need to go on.

    state : the newest one. most : alternations after which they end. best : of the states that were judged; None before
    the first one was. number : of alternations that were made. worse : how many in a row were worse than the best.
    indirect : interreflections of the newest state, (P, K, 3), or None.
    """

    state: State
    most: int
    best: State | None = None
    number: int = 0
    worse: int = 0
    indirect: np.ndarray | None = None

    @property
    def over(self) -> bool:
        return self.best is not None and (self.number >= self.most or self.worse == PATIENCE)

    def judged(self) -> None:
        """The newest state has been judged."""
        self.worse = 0 if self.state.better_than(self.best) else self.worse + 1
        if not self.worse:
            self.best = copy.deepcopy(self.state)


@dataclass
class View:
    """What a state shows: points, (P, 3), and normals, (P, 3), of its depth; which lights its surface does not hide,
    (P, K); and what it reflects on itself, (P, K, 3), or None. strength : the factor by which this was multiplied, so
    that it is what the images show in shadow; NaN where they do not tell."""

    points: np.ndarray
    normals: np.ndarray
    seen: np.ndarray
    indirect: np.ndarray | None
    strength: float = np.nan


@dataclass
class Alternations:
    """Of one kind of material.

    options : `reconstruction.Options`. counts : (P, K), how much values count.
    """

    data: Dataset
    lobes: ggx.Lobes
    kind: Kind
    judge: Judge
    options: object
    rng: np.random.Generator
    rendering: Rendering = field(init=False)

    def __post_init__(self):
        eta = self.kind.base_eta(self.lobes)
        several = self.kind.several
        self.rendering = Rendering(
            self.data, self.lobes, max_depth=self.options.max_depth, several=several, base_eta=eta
        )
        self.lighting = Lighting(self.data)

    @property
    def domain(self):
        return self.rendering.domain

    def integrate(self, guess: Guess) -> np.ndarray:
        return self.domain.integrate(guess.normals, self.options.bilateral)

    def view(self, guess: Guess, depth: np.ndarray) -> View:
        """Path trace a state."""
        seed = int(self.rng.integers(2**31)) if self.options.max_depth > 2 else 0
        view = shown(self.rendering, self.lighting, guess, depth, self.options, seed)
        if view.indirect is not None:
            view.strength = in_shadow.strength(self.data, view.indirect, ~view.seen & self.domain.lit[:, None])
            if np.isfinite(view.strength):
                view.indirect *= np.float32(view.strength)
        return view

    def seen_again(self, course: Course) -> View:
        """The view of the newest state, of which the interreflections are known."""
        self.rendering.update(course.state.guess, course.state.depth)
        return _seen(self.rendering, self.lighting, course.state.depth, course.indirect, self.options)

    def score(self, state: State, view: View) -> None:
        state.strength = view.strength
        if self.judge.able:
            of_view = view.points, view.seen, view.indirect
            state.left_out = float(self.judge.errors(state.guess, self.kind, *of_view).mean())
            state.halves = _mean(mean_angle(self.judge.apart(state.guess, *of_view)))
            state.curl = self._curl(state)

    def _curl(self, state: State) -> float:
        """At steps of depth, where nothing is integrable, angles count up to a limit."""
        off = angles(state.guess.normals, self.domain.normals(state.depth))
        return float(np.minimum(off, FAR)[self.domain.lit].mean())

    def run(self, course: Course, record: Callable[[float], None], view: View | None = None) -> State:
        """Go on with alternations to their end, and return the best state.

        record : is called with the residual of each new state, when that has been judged. view : of the newest state,
        if it is known.
        """
        state = course.state
        if course.best is None:
            state.guess, state.kind = self.kind.of(state.guess, self.lobes), self.kind
            view = view or self.view(state.guess, state.depth)
            if not (state.start or state.left_out == np.inf):
                self.score(state, view)
            course.judged()
        while not course.over:
            view = view or self.seen_again(course)
            before = course.state.guess.normals
            state = State(copy.deepcopy(course.state.guess), course.state.depth, self.kind)
            residual = self.fit(state.guess, view)
            state.depth = self.integrate(state.guess)
            course.state, course.number = state, course.number + 1
            if angles(before, state.guess.normals).mean() < self.options.tolerance:
                course.most = course.number
            view = self.view(state.guess, state.depth)
            course.indirect = view.indirect
            self.score(state, view)
            course.judged()
            record(residual)
        return course.best

    def fit(self, guess: Guess, view: View) -> float:
        """One alternation, in place: BSDF, normals, exposures. Returns the relative residual."""
        counts = self.judge.counts * view.seen
        model = DirectModel(self.data, self.lobes, points=view.points, counts=counts, indirect=view.indirect)
        for _ in range(INNER):
            model.fit_bsdf(guess, self.rng, coat=self.kind.coat)
            model.fit_normals(guess, steps=2, free_albedo=self.options.albedo)
        self._begin_again(guess, model, view.normals)
        if guess.base is not None:
            self._glaze(guess, model)
        if self.options.albedo and guess.base is None:
            guess.albedo /= np.median(guess.albedo)
        pixels = self.rng.choice(model.P, min(2000, model.P), replace=False)
        predicted, w = model.predicted(guess, pixels), counts[pixels]
        residual = (w[..., None] * (predicted - self.data.values[pixels]) ** 2).sum() / max(w.sum(), 1e-9) / 3
        if self.options.exposures:
            guess.exposures *= calibration.exposures(
                self.data.luminance[pixels], predicted @ LUMINANCE, w, model.mean_directions()
            )
            guess.exposures[np.abs(np.log(guess.exposures)) < STATED] = 1
        return float(np.sqrt(residual) / model.scale)

    def _begin_again(self, guess: Guess, model: DirectModel, normals: np.ndarray) -> None:
        """From other normals, in place: pixels keep what they come to if it leaves less of their values. For those of
        a glossy pixel have several minima, and a surface is there to tell which one is near."""
        other = copy.deepcopy(guess)
        other.normals = normals
        model.fit_normals(other, steps=AGAIN, free_albedo=self.options.albedo)
        _take(guess, other, model.losses(other) < model.losses(guess))

    def _glaze(self, guess: Guess, model: DirectModel) -> None:
        """Which pixels have one, in place: some of the materials may be matte. Neighbours decide together, for where no
        light is mirrored, both explain a pixel as well."""
        glazed, other = guess.albedo > 0.5, copy.deepcopy(guess)
        other.albedo = np.where(glazed, 0.0, 1.0)
        model.fit_normals(other, steps=AGAIN)
        losses = np.stack([model.losses(guess), model.losses(other)])
        losses = np.where(glazed, losses, losses[::-1])
        with_glaze, without = (ndimage.gaussian_filter(self.data.image(x), BESIDE)[self.data.mask] for x in losses)
        _take(guess, other, (without < MATTE * with_glaze) == glazed)

    def judged_start(
        self, guess: Guess, lights: tuple[np.ndarray, np.ndarray], kinds: tuple[Kind, ...]
    ) -> tuple[State, View | None]:
        """The start, with its normals held, as its best material of these kinds predicts what was left out, with
        interreflections or without, which a matte surface of other normals may also explain; and its view, if anything
        was left out. lights : as of `Judge.errors`."""
        depth = self.integrate(guess)
        state, view = State(guess, depth, Kind(), start=True), None
        if self.judge.able:
            view = self.view(self.kind.of(guess, self.lobes), depth)
            of_view = view.points, view.seen, view.indirect
            state.strength = view.strength
            state.left_out = min(
                float(self.judge.errors(guess, kind, *of_view[:2], indirect, lights=lights).mean())
                for kind in kinds
                for indirect in ([None] if view.indirect is None else [None, view.indirect])
            )
            state.halves = _mean(mean_angle(self.judge.apart(guess, *of_view, lights=lights)))
            state.curl = self._curl(state)
        return state, view


def shown(
    rendering: Rendering, lighting: Lighting, guess: Guess, depth: np.ndarray, options: object, seed: int
) -> View:
    """What a guess with its depth shows, by path tracing."""
    dr.flush_malloc_cache()  # of the fit before
    rendering.update(guess, depth)
    indirect = None
    if options.max_depth > 2:
        mask = rendering.data.mask
        spp = max(options.spp, round(PATHS / mask.size))
        indirect = rendering.indirect(spp=spp, seed=seed)
        _smooth(indirect, mask, options.smoothing * np.sqrt(options.spp / spp))
    return _seen(rendering, lighting, depth, indirect, options)


def _seen(
    rendering: Rendering, lighting: Lighting, depth: np.ndarray, indirect: np.ndarray | None, options: object
) -> View:
    seen = rendering.visible(lighting) if options.shadows else np.ones((lighting.P, lighting.K), bool)
    return View(rendering.domain.points(depth), rendering.domain.normals(depth), seen, indirect)


def _take(guess: Guess, other: Guess, pixels: np.ndarray) -> None:
    """What some pixels, (P,), bool, have of their own, from another guess, in place."""
    for name in ("normals", "albedo") + (() if guess.base is None else ("base",)):
        getattr(guess, name)[pixels] = getattr(other, name)[pixels]


def _mean(angles: np.ndarray) -> float:
    """Of those that are known; NaN if none is."""
    known = angles[np.isfinite(angles)]
    return float(known.mean()) if known.size else np.nan


def _smooth(pixels: np.ndarray, mask: np.ndarray, width: float) -> None:
    """Gaussian means over the pixels of the mask, of each image of (P, K, 3), in place."""
    if not width:
        return
    share = ndimage.gaussian_filter(mask.astype(np.float32), width)[mask]
    image = np.zeros((*mask.shape, 3), np.float32)
    for k in range(pixels.shape[1]):
        image[mask] = pixels[:, k]
        pixels[:, k] = ndimage.gaussian_filter(image, (width, width, 0))[mask] / share[:, None]
