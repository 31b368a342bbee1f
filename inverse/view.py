"""One target of a fit, and the sensor that takes the same picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight import no_collection
from rimlight.loading import InputError

from . import losses, targets
from .free_parameters import to_numpy
from .loaded_scene import LoadedScene
from .losses import LossFunction
from .problem import Problem

#: Sensors whose renders Dr.Jit cannot replay with Mitsuba 3.9.
NOT_REPLAYED = ("ThinLensCamera", "OrthographicCamera")

#: Integrators of Mitsuba that can be replayed; ours say so themselves.
REPLAYED = ("prb", "prb_basic", "path", "direct")

#: Samples of one launch, where a picture may be the mean of several.
MAX_SAMPLES = 2**22


class View:
    """One target, and the sensor that takes the same picture."""

    def __init__(self, problem: Problem, number: int, loaded: LoadedScene, of_stages: Sequence[LossFunction]):
        self.problem, self.number, self.loaded, self.losses = problem, number, loaded, of_stages
        scene = self.scene = loaded.scene
        self.integrator = loaded.integrator
        self.target = problem.target[number]
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
        if tuple(film.crop_size()) != tuple(film.size()) and any(s.resolution for s in problem.stage):
            raise InputError(
                f"fit: target.{number}: the film is cropped, so that its resolution cannot change; leave out "
                "resolution in the stages, or the crop in the scene"
            )
        self._memory: dict[Any, tuple[float, float]] = {}  # size of the film, shares -> what `_measured` says
        self.functions: dict[Any, tuple[Callable, Callable]] = {}
        self._smaller: tuple[tuple[np.ndarray, np.ndarray], tuple[int, int]] | None = None
        self._picture: tuple[np.ndarray, np.ndarray] | None = None

    def _check_channel(self) -> bool:
        """Does the channel that is compared hold radiance?

        Raises
        ------
        InputError : the integrator has no such channel, or several of which none is named.
        """
        channel, integrator = self.problem.loss.channel, self.integrator
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
        """Target and weights at full size. Without a file, it is rendered now, from the scene as it was loaded."""
        if self._picture is None:
            loss = self.problem.loss
            if self.target.file is None:
                self.loaded.reset()
                self.resize(None)
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
        """Target and weights at the size of a film. The last ones stay in memory."""
        if self._smaller is not None and self._smaller[1] == size:
            return self._smaller[0]
        image, weight = targets.smaller(*self.picture(), size)
        if not weight.any():
            raise InputError(
                f"fit: target.{self.number}: no pixel counts at {size[1]} x {size[0]}, each holds something that mask, "
                "alpha or exclude_above leave out; use a larger resolution"
            )
        image.flags.writeable = weight.flags.writeable = False  # a loss that changed them would change the fit
        self._smaller = (image, weight), size
        return image, weight

    def compared(self, image: np.ndarray, stage: int) -> tuple[float, np.ndarray, dict[str, float]]:
        """Loss of a picture, in a stage, its derivative with respect to each number of it, and metrics."""
        target, weight = self.target_at(image.shape[:2])
        if target.shape[2] not in (1, image.shape[2]):
            raise InputError(
                f"fit: target.{self.number}: the picture has {target.shape[2]} channels, the film {image.shape[2]}"
            )
        value, by_pixel, metrics = self.losses[stage](image, target, weight)
        # Integrators leave out what is not finite: a gradient of nothing else would look like that of no influence.
        return value if np.isfinite(by_pixel).all() else float("nan"), by_pixel, metrics

    def check(self, stage: int) -> None:
        """Say at once what is wrong with the target, or with the loss of a stage.

        Raises
        ------
        InputError, OSError : it is.
        """
        size = self.size_at(self.problem.stage[stage].resolution)
        target, weight = self.target_at(size)
        loss = self.losses[stage]
        who = f'fit: target.{self.number}: the loss "{losses.label(loss)}"'
        try:
            found = loss(target, target, weight)
        except InputError as error:
            raise InputError(f"fit: target.{self.number}: {error}") from None
        try:
            value, gradient, metrics = found
            value, shape = float(value), np.shape(gradient)
            metrics = {label: float(number) for label, number in metrics.items()}
        except (TypeError, ValueError, AttributeError):
            raise InputError(
                f"{who} must return a number, its gradient, and a dictionary of metrics, numbers by name"
            ) from None
        if shape != target.shape:
            raise InputError(f"{who} has a gradient of shape {shape} for a picture of shape {target.shape}")

    def doubts(self, image: np.ndarray) -> str:
        """What may make no sense about the target, seen beside a first render, for people; or nothing."""
        if not (self.problem.compares and self.shows_light):
            return ""
        whole = targets.whole_numbers(self.picture()[0])
        found = targets.doubts(image, *self.target_at(image.shape[:2]), whole)
        return f"Target {self.number} " + "; it ".join(found) + "." if found else ""

    # ---------------------- Film ----------------------

    def arrange(self, values: Mapping[str, np.ndarray], width: int | None) -> None:
        """Have the edges found before these parameters first change: see `LoadedScene.arrange`."""
        self.resize(width)
        self.loaded.arrange(self.number, values, self._find_boundaries)

    def count(self, key: str) -> int:
        """How many numbers a parameter has."""
        return to_numpy(self.loaded.params[key]).size

    def size_at(self, width: int | None) -> tuple[int, int]:
        """Height and width of the film."""
        return self.size if width is None else (max(round(self.size[0] * width / self.size[1]), 1), width)

    def resize(self, width: int | None) -> None:
        """Give the film a width, in pixels. None: as the scene has it."""
        size = self.size_at(width)
        if size != tuple(reversed(self.sensor.film().crop_size())):
            self.film["film.size"] = mi.ScalarVector2u(size[1], size[0])
            self.film.update()

    # ---------------------- Rendering ----------------------

    def render(self, seed: int, spp: int) -> np.ndarray:
        """A picture: (H, W, C)."""
        passes = self._passes(spp)
        image, _ = self._functions(spp // passes)
        with no_collection():
            parts = [np.array(image(self.scene, self.integrator, s)) for s in _seeds(seed, passes)]
        return self._colours(np.mean(parts, 0) if passes > 1 else parts[0])

    def _colours(self, image: np.ndarray) -> np.ndarray:
        """What is compared, of a picture: (H, W, 1 | 3). Texture coordinates have a third channel of zeros."""
        self._channels = image.shape[2]
        part = image[..., self._part()].astype(np.float32)
        return np.pad(part, ((0, 0), (0, 0), (0, 1))) if part.shape[2] == 2 else part

    def _part(self) -> slice:
        """Where it is among the channels of a picture."""
        channel = self.problem.loss.channel
        part = slice(0, self._channels) if channel is None else self.integrator.layout(self._channels)[channel]
        return slice(part.start, part.stop - 1) if self.alpha and self.shows_light else part

    def backward(self, by_pixel: np.ndarray, seed: int, spp: int, shares: tuple[tuple[str, float], ...] = ()) -> None:
        """Derivatives with respect to what carries a gradient. by_pixel : (H, W, C), of the loss. shares : of the
        samples, see `Task`."""
        self._divide(shares)
        passes = self._passes(spp, shares)
        _, derivative = self._functions(spp // passes, shares)
        part = self._part()
        whole = np.zeros((*by_pixel.shape[:2], self._channels), np.float32)
        whole[..., part] = by_pixel[..., : part.stop - part.start]
        weight = mi.TensorXf(whole / passes) * dr.opaque(mi.Float, 1)
        dr.eval(weight)
        with no_collection():
            for s in _seeds(seed, passes):
                derivative(self.scene, self.integrator, weight, s)

    def _passes(self, spp: int, shares: tuple[tuple[str, float], ...] = ()) -> int:
        """In how many launches samples are taken, so that they need no more memory than they may: a divisor of spp.

        Raises
        ------
        InputError : one sample per pixel needs more.
        """
        if self.problem.max_memory is None:
            return 1
        size = tuple(self.sensor.film().crop_size())
        if (size, shares) not in self._memory:
            self._memory[size, shares] = self._measured(shares)
        before, each = self._memory[size, shares]
        most = int((self.problem.max_memory - before) / each)
        if most < 1:
            raise InputError(
                f"fit: max_memory is {self.problem.max_memory:g} MB, but one sample per pixel of target "
                f"{self.number} at {size[0]} x {size[1]} needs {before + each:.3g} MB; use a smaller resolution"
            )
        return next(n for n in range(1, spp + 1) if spp % n == 0 and spp // n <= most)

    def _measured(self, shares: tuple[tuple[str, float], ...]) -> tuple[float, float]:
        """Memory that Dr.Jit uses before a launch, and more for each sample per pixel; MB."""
        image, derivative = self._functions(1, shares)
        backend, none = dr.backend_v(mi.Float), dr.opaque(mi.UInt32, 0)
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(backend)
        with no_collection():
            shape = np.shape(image(self.scene, self.integrator, none))
            weight = mi.TensorXf(np.zeros(shape, np.float32)) * dr.opaque(mi.Float, 1)
            derivative(self.scene, self.integrator, weight, none)
        return before / 1e6, (dr.detail.malloc_watermark(backend) - before) / 1e6

    def balance(self, change: Mapping[str, tuple[mi.Float, np.ndarray]], seed: int) -> tuple[tuple[str, float], ...]:
        """Shares of the samples, for least error in a given time: see `EdgeIntegrator.balance`.

        change : as of `forward`.

        Raises
        ------
        RuntimeError : nothing is seen to change.
        """
        self._forward(change, dr.ADFlag.ClearEdges)
        with no_collection():
            found = self.integrator.balance(self.scene, self.loaded.params, sensor=self.sensor, seed=seed)
        return tuple(found.shares.items())

    def _divide(self, shares: tuple[tuple[str, float], ...]) -> None:
        if hasattr(self.integrator, "shares"):
            self.integrator.shares = dict(shares)

    @staticmethod
    def _forward(change: Mapping[str, tuple[mi.Float, np.ndarray]], flags: dr.ADFlag = dr.ADFlag.Default) -> None:
        for leaf, derivative in change.values():
            dr.set_grad(leaf, mi.Float(derivative.astype(np.float32).ravel()))
        dr.enqueue(dr.ADMode.Forward, *(leaf for leaf, _ in change.values()))
        dr.traverse(dr.ADMode.Forward, flags)

    def forward(self, change: Mapping[str, tuple[mi.Float, np.ndarray]], seed: int, spp: int) -> np.ndarray:
        """Derivative image. change : key -> what `set` returned, and its derivative."""
        self._divide(())
        with no_collection():
            image = mi.render(
                self.scene, self.loaded.params, sensor=self.sensor, integrator=self.integrator, spp=spp, seed=seed
            )
            self._forward(change)
            return self._colours(np.array(dr.grad(image)))

    def _image(self, seed: Any, spp: int) -> mi.TensorXf:
        with dr.suspend_grad():
            return self.integrator.render(self.scene, sensor=self.sensor, seed=seed, spp=spp)

    def _functions(self, spp: int, shares: tuple[tuple[str, float], ...] = ()) -> tuple[Callable, Callable]:
        """Image and derivative. Recorded apart for each size of the film, which Dr.Jit does not look at, and for each
        division of the samples of the derivative."""
        key = spp, shares, tuple(self.sensor.film().crop_size())
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
        problem = self.problem
        possible = hasattr(self.integrator, "find_boundaries") or problem.integrator["type"] in REPLAYED
        return problem.freeze and possible and self.sensor.class_name() not in NOT_REPLAYED


def _seeds(seed: int, passes: int) -> list[mi.UInt32]:
    """Of several launches. One has the seed itself."""
    numbers = [derived_seed(seed, i) for i in range(passes)] if passes > 1 else [seed]
    return [dr.opaque(mi.UInt32, number) for number in numbers]


def derived_seed(*numbers: int) -> int:
    """A seed for random numbers that are independent of those of other numbers."""
    # With their count: NumPy takes (7,) and (7, 0) for the same.
    return int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1)[0])
