"""Mitsuba's optimisers, as plain arrays between the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import free_parameters
from .free_parameters import Parameter, is_transform
from .problem import Problem

#: Gradients whose lengths clipping remembers.
REMEMBERED = 50


class Optimiser:
    """Latent numbers of free parameters, and how they change. Its whole state is `state()`."""

    def __init__(self, parameters: Sequence[Parameter], problem: Problem):
        self.parameters, self.clip = parameters, problem.clip
        #: Latent name -> its parameter.
        self.owner = {name: p for p in parameters for name in p.start}
        self.rates = {name: rate for p in parameters for name, rate in p.rates().items()}
        masks = {name: p.mask(name) for name, p in self.owner.items()}
        self.masks = {name: _own(mask) for name, mask in masks.items() if mask is not None}
        self.lengths: dict[str, list[float]] = {name: [] for name in self.rates}
        # Large steps want one rate for all numbers of a mesh.
        made = {uniform: _make(problem, uniform) for uniform in (False, True)}
        self.inner = {name: made[bool(p.free.smoothing)] for name, p in self.owner.items()}
        self.used = list({id(inner): inner for inner in self.inner.values()}.values())
        for name, p in self.owner.items():
            self.inner[name][name] = _own(p.start[name])
        self._latents: dict[str, np.ndarray] | None = None

    def values(self) -> dict[str, Any]:
        """Scene parameters, by key, attached to the latents."""
        found = free_parameters.values(self.parameters, {name: inner[name] for name, inner in self.inner.items()})
        dr.eval(found)
        return found

    def latents(self) -> dict[str, np.ndarray]:
        if self._latents is None:
            self._latents = {name: np.array(inner[name], np.float32) for name, inner in self.inner.items()}
        return self._latents

    def step(self, values: Mapping[str, Any], gradients: Mapping[str, np.ndarray], factor: float) -> None:
        """Take a step.

        values : what `values` returned. gradients : of the loss, with respect to them, by key, flat. factor : of the
            rates.
        """
        pairs = [(value, gradients[key]) for key, value in values.items()]
        dr.backward(sum((inner_product(value, gradient) for value, gradient in pairs), mi.Float(0)))
        found = {name: dr.grad(inner[name]) for name, inner in self.inner.items()}
        found = {name: g * self.masks[name] if name in self.masks else g for name, g in found.items()}
        dr.eval(found)
        for name, gradient in found.items():
            inner = self.inner[name]
            dr.set_grad(
                inner[name], gradient if self.clip is None else self._clipped(name, np.array(gradient), self.clip)
            )
            inner.set_learning_rate({name: self.rates[name] * factor})
        for inner in self.used:
            inner.step()
        self._latents = None
        for name, latent in self.latents().items():
            legal = self.owner[name].legal(name, latent)
            if not np.array_equal(legal, latent):
                self.inner[name][name] = _own(legal)
                self.latents()[name] = legal

    def _clipped(self, name: str, gradient: np.ndarray, clip: float) -> mi.Float:
        length, known = float(np.linalg.norm(gradient)), self.lengths[name]
        longest = clip * float(np.median(known)) if known else length
        known.append(length)
        del known[:-REMEMBERED]
        return mi.Float(gradient * (min(1, longest / length) if length > 0 else 1))

    # ---------------------- State ----------------------

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on: name -> array."""
        found = {}
        for name, inner in self.inner.items():
            value, _, _, extra = inner.state[name]
            for i, array in enumerate(_leaves(value, extra)):
                found[f"{name}/{i}"] = np.array(array)
            found[f"{name}/lengths"] = np.array(self.lengths[name])
        return found

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """The inverse of `state`."""
        for name, inner in self.inner.items():
            inner[name] = _own(state[f"{name}/0"])
            value, promoted, rate, extra = inner.state[name]
            saved = iter(range(1, 100))
            restored = [None if x is None else _like(x, state[f"{name}/{next(saved)}"]) for x in _as_tuple(extra)]
            extra = tuple(restored) if isinstance(extra, tuple) else restored[0]
            inner.state[name] = value, promoted, rate, extra
            self.lengths[name] = state[f"{name}/lengths"].tolist()
        self._latents = None

    def restart(self, latents: Mapping[str, np.ndarray]) -> None:
        """Forget all gradients, and go on elsewhere."""
        for name, inner in self.inner.items():
            inner[name] = _own(latents[name])
            inner.reset(name)
            self.lengths[name] = []
        self._latents = None


def _make(problem: Problem, uniform: bool) -> mi.ad.Optimizer:
    if problem.optimiser == "adam":
        return mi.ad.Adam(1.0, beta_1=problem.momentum, beta_2=problem.smooth_scale, uniform=uniform)
    return mi.ad.SGD(1.0, momentum=problem.momentum)


def inner_product(value: Any, numbers: np.ndarray) -> mi.Float:
    """Of a scene parameter, attached, and numbers in the order of `to_numpy`, flat."""
    numbers = _own(numbers)  # in memory: as literals, they would be compiled anew in every step
    if is_transform(value):
        entries = (value.matrix[i, j] * dr.gather(mi.Float, numbers, 4 * i + j) for i in range(4) for j in range(4))
        return sum(entries, mi.Float(0))
    return dr.sum((value.array if dr.is_tensor_v(value) else dr.ravel(value)) * numbers)


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
