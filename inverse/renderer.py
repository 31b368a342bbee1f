"""Loss and gradient of one view of a problem, as a pure function of NumPy arrays: what processes and machines share.

The picture is rendered, compared with the target on the host, and the derivative of the loss with respect to its pixels
weighs a second, independent render, backward. Both are recorded once and replayed (`dr.freeze`) where that is possible.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight import no_collection
from rimlight.loading import InputError, load_integrator, use_variant

from . import losses, sources, targets
from .free_parameters import from_flat, to_numpy
from .problem import Problem

#: Sensors whose renders Dr.Jit cannot replay with Mitsuba 3.9.
NOT_REPLAYED = ("ThinLensCamera", "OrthographicCamera")

#: Integrators of Mitsuba that can be replayed; ours say so themselves.
REPLAYED = ("prb", "prb_basic", "path", "direct")

#: Samples of one launch, where a picture may be the mean of several.
MAX_SAMPLES = 2**22


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
    """

    target: int
    width: int | None
    spp: int
    seed: int
    stage: int = 0


@dataclass(frozen=True)
class Gradient:
    """loss : at a render. gradients : key -> as `to_numpy` has the value. image : (H, W, C), what was rendered.
    scores : the metrics of the loss, label -> number."""

    loss: float
    gradients: dict[str, np.ndarray]
    image: np.ndarray
    scores: dict[str, float] = field(default_factory=dict)


class Renderer:
    """The scenes and targets of a problem, loaded.

    params : of all scenes, key -> value; where several scenes have a key, that of the first.
    losses : of each stage.
    scenes : the loaded ones, by `sources.key`.

    Raises
    ------
    InputError, OSError : scene, integrator or target cannot be loaded, or do not fit together. The text is one line.
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
        # One for each: ours remember the edges of the last scene.
        integrators = {key: load_integrator(kind, **options) for key in self.scenes}
        self.views = [View(self, i, self.scenes[k], integrators[k]) for i, k in enumerate(map(sources.key, used))]
        self.params = {}
        for scene in self.scenes.values():
            self.params = dict(mi.traverse(scene).items()) | self.params

    def image(self, values: Mapping[str, np.ndarray], task: Task) -> np.ndarray:
        """A picture: (H, W, C), float32, linear."""
        view = self.views[task.target]
        view.set(values, task.width)
        return view.render(task.seed, task.spp)

    def gradient(self, values: Mapping[str, np.ndarray], task: Task) -> Gradient:
        """The loss, and its derivative with respect to the values.

        values : key -> array as `to_numpy` makes it; what is not in the scene of this view is ignored.
        """
        view = self.views[task.target]
        leaves = view.set(values, task.width)
        image = view.render(task.seed, task.spp)
        loss, by_pixel, scores = view.compared(image, task.stage)
        return Gradient(loss, self._collected(view, leaves, by_pixel, derived_seed(task.seed), task.spp), image, scores)

    def gradient_of(self, values: Mapping[str, np.ndarray], by_pixel: np.ndarray, task: Task) -> dict[str, np.ndarray]:
        """The derivative of anything of which that with respect to each number of the picture is known.

        by_pixel : (H, W, C), this one. task : its seed is that of the derivative image.
        """
        view = self.views[task.target]
        return self._collected(view, view.set(values, task.width), by_pixel, task.seed, task.spp)

    @staticmethod
    def _collected(
        view: View, leaves: Mapping[str, mi.Float], by_pixel: np.ndarray, seed: int, spp: int
    ) -> dict[str, np.ndarray]:
        view.backward(by_pixel, seed, spp)
        found = {key: dr.grad(leaf) for key, leaf in leaves.items()}
        dr.eval(found)
        return {key: np.array(gradient, np.float32) for key, gradient in found.items()}

    def derivative(self, values: Mapping[str, np.ndarray], change: Mapping[str, np.ndarray], task: Task) -> np.ndarray:
        """Derivative of a picture as the values change, forward: (H, W, C), float32.

        change : key -> array as in `values`.
        """
        view = self.views[task.target]
        leaves = view.set(values, task.width)
        return view.forward({key: (leaf, change[key]) for key, leaf in leaves.items()}, task.seed, task.spp)


class View:
    """One target, and the sensor that takes the same picture."""

    def __init__(self, renderer: Renderer, number: int, scene: mi.Scene, integrator: mi.Integrator):
        self.renderer, self.number, self.scene, self.integrator = renderer, number, scene, integrator
        self.target = renderer.problem.target[number]
        self.params = mi.traverse(scene)
        self.initial = dict(self.params.items())
        if self.target.sensor >= len(scene.sensors()):
            raise InputError(
                f"fit: target.{number}.sensor: the scene has {len(scene.sensors())} sensors, there is no number "
                f"{self.target.sensor}"
            )
        self.sensor = scene.sensors()[self.target.sensor]
        self.film = mi.traverse(self.sensor)
        #: The last channel of the film, which is not compared.
        self.alpha = mi.has_flag(self.sensor.film().flags(), mi.FilmFlags.Alpha)
        #: Is it radiance that is compared, or another channel?
        self.shows_light = self._check_channel()
        self._channels = 0  # of the picture that was last rendered
        film = self.sensor.film()
        self.size = tuple(int(n) for n in reversed(film.crop_size()))
        if tuple(film.crop_size()) != tuple(film.size()) and any(s.resolution for s in renderer.problem.stage):
            raise InputError(
                f"fit: target.{number}: the film is cropped, so that its resolution cannot change; leave out "
                "resolution in the stages, or the crop in the scene"
            )
        self.arranged: set[str] = set()
        self.functions: dict[Any, tuple[Callable, Callable]] = {}
        self.kinds = {}
        self._picture: tuple[np.ndarray, np.ndarray] | None = None

    def _check_channel(self) -> bool:
        """Does the channel that is compared hold radiance?

        Raises
        ------
        InputError : the integrator has no such channel, or several of which none is named.
        """
        channel, integrator = self.renderer.problem.loss.channel, self.integrator
        if not hasattr(integrator, "layout"):
            if channel is None:
                return True
            raise InputError(
                f'fit: loss.channel is "{channel}", but the integrator renders light alone; use aov_edge, such as '
                f'integrator = {{ type = "aov_edge", aovs = "{channel}:depth" }}'
            )
        known = [*integrator.nested, *(c.name for c in integrator.channels)]
        if channel not in known:
            got = "is missing" if channel is None else f'cannot be "{channel}"'
            raise InputError(f"fit: loss.channel {got}: the integrator has {', '.join(known)}")
        return channel in integrator.nested

    # ---------------------- Target ----------------------

    def picture(self) -> tuple[np.ndarray, np.ndarray]:
        """Target and weights at full size. Without a file, it is rendered now, from the scene as it is."""
        if self._picture is None:
            loss = self.renderer.problem.loss
            if self.target.file is None:
                self._resize(None)
                image = self._truth()
                weight = np.ones(image.shape[:2], np.float32)
            else:
                plain = not self.shows_light and self.target.colour == "auto"
                target = replace(self.target, colour="linear") if plain else self.target
                if callable(target.file):
                    target = replace(target, file=target.file(self))
                image, weight = targets.read(target, self.size)
            self._picture = image, losses.pixels_that_count(loss, image, weight)
        return self._picture

    def _truth(self) -> np.ndarray:
        """Rendered in passes, summed in double precision."""
        total, spp = 0.0, self.target.spp
        per_pass = max(min(spp, MAX_SAMPLES // (self.size[0] * self.size[1]), 256), 1)
        passes = -(-spp // per_pass)
        for i in range(passes):
            with no_collection():  # the integrator may be one of Mitsuba's
                total += np.array(self._image(seed=derived_seed(self.number, i), spp=per_pass), np.float64)
        return self._colours(total / passes)

    def target_at(self, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        image, weight = targets.smaller(*self.picture(), size)
        if not weight.any():
            raise InputError(
                f"fit: target.{self.number}: no pixel counts at {size[1]} x {size[0]}, each holds something that mask, "
                "alpha or exclude_above leave out; use a larger resolution"
            )
        return image, weight

    def compared(self, image: np.ndarray, stage: int) -> tuple[float, np.ndarray, dict[str, float]]:
        """Loss of a picture, in a stage, its derivative with respect to each number of it, and metrics."""
        target, weight = self.target_at(image.shape[:2])
        if target.shape[2] not in (1, image.shape[2]):
            raise InputError(
                f"fit: target.{self.number}: the picture has {target.shape[2]} channels, the film {image.shape[2]}"
            )
        return self.renderer.losses[stage](image, target, weight)

    def check(self, stage: int) -> None:
        """Say at once what is wrong with the target, or with the loss of a stage.

        Raises
        ------
        InputError, OSError : it is.
        """
        size = self.size_at(self.renderer.problem.stage[stage].resolution)
        target, weight = self.target_at(size)
        loss = self.renderer.losses[stage]
        who = f'fit: target.{self.number}: the loss "{losses.label(loss)}"'
        try:
            found = loss(target, target, weight)
        except InputError as error:
            raise InputError(f"fit: target.{self.number}: {error}") from None
        try:
            value, gradient, metrics = found
            value, shape, metrics = float(value), np.shape(gradient), dict(metrics)
        except (TypeError, ValueError):
            raise InputError(f"{who} must return a number, its gradient, and a dictionary of metrics") from None
        if shape != target.shape:
            raise InputError(f"{who} has a gradient of shape {shape} for a picture of shape {target.shape}")

    # ---------------------- Scene ----------------------

    def set(self, values: Mapping[str, np.ndarray], width: int | None) -> dict[str, mi.Float]:
        """Set scene parameters and the size of the film. Returns what collects the gradients: key -> flat."""
        for view in self.renderer.views:
            view.picture()  # while the scenes still are as their files have them
        self._resize(width)
        here = {key for key in values if key in self.params}
        if not here <= self.arranged:
            # Our integrators arrange the edges when they first see them, and their random samples depend on that: let
            # it be the same for all who compute, whenever they begin.
            self._assign({key: to_numpy(self.initial[key]) for key in here})
            self._find_boundaries()
            self.arranged |= here
        return self._assign(values)

    def _assign(self, values: Mapping[str, np.ndarray]) -> dict[str, mi.Float]:
        leaves = {}
        for key, value in values.items():
            if key not in self.params:
                continue
            if key not in self.kinds:
                old = self.params[key]
                self.kinds[key] = type(old), old.shape if dr.is_tensor_v(old) else None
            # Multiplied, so that it lies in Dr.Jit's own memory: of NumPy's, a replay would see the first numbers only.
            leaf = mi.Float(value.astype(np.float32).ravel()) * dr.opaque(mi.Float, 1)
            dr.eval(leaf)
            dr.enable_grad(leaf)
            self.params[key] = from_flat(leaf, *self.kinds[key])
            leaves[key] = leaf
        self.params.update()
        return leaves

    def count(self, key: str) -> int:
        """How many numbers a parameter has."""
        return to_numpy(self.initial[key]).size

    def size_at(self, width: int | None) -> tuple[int, int]:
        """Height and width of the film."""
        return self.size if width is None else (max(round(self.size[0] * width / self.size[1]), 1), width)

    def _resize(self, width: int | None) -> None:
        size = self.size_at(width)
        if size != tuple(reversed(self.sensor.film().crop_size())):
            self.film["film.size"] = mi.ScalarVector2u(size[1], size[0])
            self.film.update()

    # ---------------------- Rendering ----------------------

    def render(self, seed: int, spp: int) -> np.ndarray:
        image, _ = self._functions(spp)
        with no_collection():
            return self._colours(np.array(image(self.scene, self.integrator, dr.opaque(mi.UInt32, seed))))

    def _colours(self, image: np.ndarray) -> np.ndarray:
        """What is compared, of a picture: (H, W, 1 | 3). Texture coordinates have a third channel of zeros."""
        self._channels = image.shape[2]
        part = image[..., self._part()].astype(np.float32)
        return np.pad(part, ((0, 0), (0, 0), (0, 1))) if part.shape[2] == 2 else part

    def _part(self) -> slice:
        """Where it is among the channels of a picture."""
        channel = self.renderer.problem.loss.channel
        part = slice(0, self._channels) if channel is None else self.integrator.layout(self._channels)[channel]
        return slice(part.start, part.stop - 1) if self.alpha and self.shows_light else part

    def backward(self, by_pixel: np.ndarray, seed: int, spp: int) -> None:
        _, derivative = self._functions(spp)
        part = self._part()
        whole = np.zeros((*by_pixel.shape[:2], self._channels), np.float32)
        whole[..., part] = by_pixel[..., : part.stop - part.start]
        weight = mi.TensorXf(whole) * dr.opaque(mi.Float, 1)
        dr.eval(weight)
        with no_collection():
            derivative(self.scene, self.integrator, weight, dr.opaque(mi.UInt32, seed))

    def forward(self, change: Mapping[str, tuple[mi.Float, np.ndarray]], seed: int, spp: int) -> np.ndarray:
        """Derivative image. change : key -> what `set` returned, and its derivative."""
        with no_collection():
            image = mi.render(
                self.scene, self.params, sensor=self.sensor, integrator=self.integrator, spp=spp, seed=seed
            )
            for leaf, derivative in change.values():
                dr.set_grad(leaf, mi.Float(derivative.astype(np.float32).ravel()))
            dr.enqueue(dr.ADMode.Forward, *(leaf for leaf, _ in change.values()))
            dr.traverse(dr.ADMode.Forward)
            return self._colours(np.array(dr.grad(image)))

    def _image(self, seed: Any, spp: int) -> mi.TensorXf:
        with dr.suspend_grad():
            return self.integrator.render(self.scene, sensor=self.sensor, seed=seed, spp=spp)

    def _functions(self, spp: int) -> tuple[Callable, Callable]:
        """Image and derivative. Recorded apart for each size of the film, which Dr.Jit does not look at."""
        key = spp, tuple(self.sensor.film().crop_size())
        if key not in self.functions:
            sensor = self.sensor

            def image(scene, integrator, seed):
                with dr.suspend_grad():
                    return integrator.render(scene, sensor=sensor, seed=seed, spp=spp)

            def derivative(scene, integrator, weight, seed):
                integrator.render_backward(scene, mi.traverse(scene), weight, sensor=sensor, seed=seed, spp=spp)

            if self._replays():
                known = lambda *_: self._find_boundaries()
                self.functions[key] = dr.freeze(image), dr.freeze(derivative, state_fn=known)
            else:
                self.functions[key] = image, derivative
        return self.functions[key]

    def _find_boundaries(self) -> Any:
        find = getattr(self.integrator, "find_boundaries", None)
        return None if find is None else find(self.scene, self.sensor)

    def _replays(self) -> bool:
        problem = self.renderer.problem
        possible = hasattr(self.integrator, "find_boundaries") or problem.integrator["type"] in REPLAYED
        return problem.freeze and possible and self.sensor.class_name() not in NOT_REPLAYED


def derived_seed(*numbers: int) -> int:
    """A seed for random numbers that are independent of those of other numbers."""
    # With their count: NumPy takes (7,) and (7, 0) for the same.
    return int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1)[0])
