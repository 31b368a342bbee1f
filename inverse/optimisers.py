"""Mitsuba's optimisers, one for each free parameter, as plain arrays between the steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .free_parameters import Parameter, is_transform
from .problem import Problem

#: Gradients whose lengths clipping remembers.
REMEMBERED = 50


class Optimiser:
    """Latent numbers of one parameter, and how they change. Its whole state is `state()`."""

    def __init__(self, parameter: Parameter, problem: Problem):
        self.parameter = parameter
        self.clip = problem.clip
        rates = parameter.rates()
        if problem.optimiser == "adam":
            uniform = bool(parameter.free.smoothing)  # as large steps want it
            self.inner = mi.ad.Adam(1.0, beta_1=problem.momentum, beta_2=problem.smooth_scale, uniform=uniform)
        else:
            self.inner = mi.ad.SGD(1.0, momentum=problem.momentum)
        self.rates = rates
        self.lengths: dict[str, list[float]] = {name: [] for name in rates}
        for name, start in parameter.start.items():
            self.inner[name] = _own(start)

    def values(self) -> dict[str, Any]:
        """Scene parameters, attached to the latents."""
        return self.parameter.values(self.inner)

    def latents(self) -> dict[str, np.ndarray]:
        return {name: np.array(self.inner[name], np.float32) for name in self.rates}

    def step(self, values: Mapping[str, Any], gradients: Mapping[str, np.ndarray], factor: float) -> None:
        """Take a step.

        values : what `values()` returned. gradients : of the loss, with respect to them, flat. factor : of the rates.
        """
        products = [inner_product(value, gradients[key]) for key, value in values.items() if key in gradients]
        dr.backward(sum(products, mi.Float(0)))
        for name, rate in self.rates.items():
            gradient = np.array(dr.grad(self.inner[name]), np.float32)
            mask = self.parameter.mask(name)
            gradient = gradient if mask is None else gradient * mask
            dr.set_grad(self.inner[name], mi.Float(gradient * self._shortening(name, gradient)))
            self.inner.set_learning_rate({name: rate * factor})
        self.inner.step()
        for name, latent in self.latents().items():
            legal = self.parameter.legal(name, latent)
            if not np.array_equal(legal, latent):
                self.inner[name] = _own(legal)

    def _shortening(self, name: str, gradient: np.ndarray) -> float:
        if self.clip is None:
            return 1
        length, known = float(np.linalg.norm(gradient)), self.lengths[name]
        longest = self.clip * float(np.median(known)) if known else length
        known.append(length)
        del known[:-REMEMBERED]
        return min(1, longest / length) if length > 0 else 1

    # ---------------------- State ----------------------

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on: name -> array."""
        found = {}
        for name in self.rates:
            value, _, _, extra = self.inner.state[name]
            for i, array in enumerate(_leaves(value, extra)):
                found[f"{name}/{i}"] = np.array(array)
            found[f"{name}/lengths"] = np.array(self.lengths[name])
        return found

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """The inverse of `state`."""
        for name in self.rates:
            self.inner[name] = _own(state[f"{name}/0"])
            value, promoted, rate, extra = self.inner.state[name]
            saved = iter(range(1, 100))
            restored = [None if x is None else _like(x, state[f"{name}/{next(saved)}"]) for x in _as_tuple(extra)]
            extra = tuple(restored) if isinstance(extra, tuple) else restored[0]
            self.inner.state[name] = value, promoted, rate, extra
            self.lengths[name] = state[f"{name}/lengths"].tolist()

    def restart(self, latents: Mapping[str, np.ndarray]) -> None:
        """Forget all gradients, and go on elsewhere."""
        for name in self.rates:
            self.inner[name] = _own(latents[name])
            self.inner.reset(name)
            self.lengths[name] = []


def inner_product(value: Any, numbers: np.ndarray) -> mi.Float:
    """Of a scene parameter, attached, and numbers in the order of `to_numpy`, flat."""
    if is_transform(value):
        return sum((value.matrix[i, j] * float(numbers[4 * i + j]) for i in range(4) for j in range(4)), mi.Float(0))
    flat = value.array if dr.is_tensor_v(value) else dr.ravel(value)
    return dr.sum(flat * mi.Float(numbers))


def _own(array: np.ndarray) -> mi.Float:
    """A copy in Dr.Jit's own memory."""
    value = mi.Float(np.asarray(array, np.float32).ravel()) * dr.opaque(mi.Float, 1)
    dr.eval(value)
    return value


def _as_tuple(extra: Any) -> tuple:
    return extra if isinstance(extra, tuple) else (extra,)


def _leaves(value: Any, extra: Any) -> list[Any]:
    return [dr.detach(value), *(x for x in _as_tuple(extra) if x is not None)]


def _like(old: Any, array: np.ndarray) -> Any:
    return _own(array) if dr.is_float_v(old) else type(old)(array)
