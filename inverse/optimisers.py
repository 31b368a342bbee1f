"""Optimisers: Mitsuba's, and pairs of functions `init` and `update`. Between the steps, all are plain arrays."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.loading import InputError

from . import free_parameters
from .free_parameters import Parameter, is_transform
from .problem import Problem

#: Gradients whose lengths clipping remembers.
REMEMBERED = 50


class Optimiser:
    """Latent numbers of free parameters, and how they change. Its whole state is `state()`.

    `Problem.optimiser` says by which rule: "adam" or "sgd"; an optimiser of Mitsuba or a function that makes one, such
    as `functools.partial(mi.ad.RMSProp, alpha=0.9)`, which is called with the learning rate 1; or an object with the
    methods `init(latents) -> state` and `update(gradients, state, latents) -> changes, state`, as those of Optax. In
    the latter, latents, gradients and changes are name -> array, and a state consists of tuples, lists, dictionaries,
    numbers and arrays. Whatever the rule, its step for the learning rate 1 is multiplied by `Free.rate` and by the
    factor of the stage.
    """

    def __init__(self, parameters: Sequence[Parameter], problem: Problem):
        self.parameters, self.clip = parameters, problem.clip
        #: Latent name -> its parameter.
        self.owner = {name: p for p in parameters for name in p.start}
        self.rates = {name: rate for p in parameters for name, rate in p.rates().items()}
        masks = {name: p.mask(name) for name, p in self.owner.items()}
        self.masks = {name: _own(mask) for name, mask in masks.items() if mask is not None}
        self.lengths: dict[str, list[float]] = {name: [] for name in self.rates}
        self.rule = _rule(problem, self.owner)
        self._latents: dict[str, np.ndarray] | None = None

    def values(self) -> dict[str, Any]:
        """Scene parameters, by key, attached to the latents."""
        found = free_parameters.values(self.parameters, {name: self.rule[name] for name in self.owner})
        dr.eval(found)
        return found

    def latents(self) -> dict[str, np.ndarray]:
        if self._latents is None:
            self._latents = {name: np.array(self.rule[name], np.float32) for name in self.owner}
        return self._latents

    def step(
        self, values: Mapping[str, Any], gradients: Mapping[str, np.ndarray], factor: float, penalty: Any = None
    ) -> bool:
        """Take a step. False, and no step, if a number would not be `Parameter.sound` after it.

        values : what `values` returned. gradients : of the loss, with respect to them, by key, flat. factor : of the
            rates. penalty : what is added to the loss, one number, attached to the values.
        """
        pairs = [(value, gradients[key]) for key, value in values.items()]
        whole = sum((inner_product(value, gradient) for value, gradient in pairs), mi.Float(0))
        dr.backward(whole if penalty is None else whole + penalty)
        found = {name: dr.grad(self.rule[name]) for name in self.owner}
        found = {name: g * self.masks[name] if name in self.masks else g for name, g in found.items()}
        dr.eval(found)
        if self.clip is not None:
            found = {name: self._clipped(name, np.array(gradient), self.clip) for name, gradient in found.items()}
        before = self.latents()
        self.rule.step(found, {name: rate * factor for name, rate in self.rates.items()})
        self._latents = None
        if not all(self.owner[name].sound(latent) for name, latent in self.latents().items()):
            self.restart(before)
            return False
        for name, latent in self.latents().items():
            legal = self.owner[name].legal(name, latent)
            if not np.array_equal(legal, latent):
                self.rule.put(name, legal)
                self.latents()[name] = legal
        return True

    def _clipped(self, name: str, gradient: np.ndarray, clip: float) -> mi.Float:
        length, known = float(np.linalg.norm(gradient)), self.lengths[name]
        longest = clip * float(np.median(known)) if known else length
        known.append(length)
        del known[:-REMEMBERED]
        return mi.Float(gradient * (min(1, longest / length) if length > 0 else 1))

    # ---------------------- State ----------------------

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on: name -> array."""
        lengths = {f"{name}/lengths": np.array(lengths) for name, lengths in self.lengths.items()}
        return lengths | {f"{name}/latent": latent for name, latent in self.latents().items()} | self.rule.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """The inverse of `state`."""
        for name in self.owner:
            self.rule.put(name, state[f"{name}/latent"])
            self.lengths[name] = state[f"{name}/lengths"].tolist()
        self.rule.restore(state)
        self._latents = None

    def restart(self, latents: Mapping[str, np.ndarray]) -> None:
        """Forget all gradients, and go on elsewhere."""
        for name in self.owner:
            self.rule.put(name, latents[name])
            self.lengths[name] = []
        self.rule.reset()
        self._latents = None


# ------------------------------------------------------------------ rules


class OfMitsuba:
    """Optimisers of Mitsuba: name of a latent -> the one that holds it."""

    def __init__(self, inner: Mapping[str, mi.ad.Optimizer], start: Mapping[str, np.ndarray]):
        self.inner = inner
        for name, latent in start.items():
            self.put(name, latent)

    def __getitem__(self, name: str) -> mi.Float:
        return self.inner[name][name]

    def put(self, name: str, latent: np.ndarray) -> None:
        self.inner[name][name] = _own(latent)

    def reset(self) -> None:
        for name, inner in self.inner.items():
            inner.reset(name)

    def step(self, gradients: Mapping[str, mi.Float], rates: Mapping[str, float]) -> None:
        for name, gradient in gradients.items():
            dr.set_grad(self[name], gradient)
            self.inner[name].set_learning_rate({name: rates[name]})
        for inner in {id(inner): inner for inner in self.inner.values()}.values():
            inner.step()

    def state(self) -> dict[str, np.ndarray]:
        return {
            f"{name}/{i}": np.array(leaf)
            for name, inner in self.inner.items()
            for i, leaf in enumerate(_leaves(inner.state[name][3]))
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        for name, inner in self.inner.items():
            value, promoted, rate, extra = inner.state[name]
            count = len(list(_leaves(extra)))
            inner.state[name] = (
                value,
                promoted,
                rate,
                _rebuilt(extra, iter([state[f"{name}/{i}"] for i in range(count)])),
            )


class OfPair:
    """An object with the methods `init` and `update`."""

    def __init__(self, pair: Any, start: Mapping[str, np.ndarray]):
        self.pair = pair
        self.held: dict[str, Any] = {}
        for name, latent in start.items():
            self.put(name, latent)
        self.reset()

    def __getitem__(self, name: str) -> mi.Float:
        return self.held[name]

    def put(self, name: str, latent: np.ndarray) -> None:
        self.held[name] = _own(latent)
        dr.enable_grad(self.held[name])

    def _numbers(self) -> dict[str, np.ndarray]:
        return {name: np.array(dr.detach(latent)) for name, latent in self.held.items()}

    def reset(self) -> None:
        self.tree = self.pair.init(self._numbers())

    def step(self, gradients: Mapping[str, mi.Float], rates: Mapping[str, float]) -> None:
        before = self._numbers()
        found = self.pair.update({name: np.array(g) for name, g in gradients.items()}, self.tree, before)
        try:
            changes, self.tree = found
            after = {name: x + rates[name] * np.asarray(changes[name], np.float32) for name, x in before.items()}
            if any(after[name].shape != x.shape for name, x in before.items()):
                raise ValueError
        except (TypeError, ValueError, KeyError):
            sizes = ", ".join(f"{name}: {x.size}" for name, x in before.items())
            raise InputError(
                f"fit: update of the optimiser must return changes of these numbers, {sizes}, and its state"
            ) from None
        for name, latent in after.items():
            self.put(name, latent)

    def state(self) -> dict[str, np.ndarray]:
        return {f"tree/{i}": np.array(leaf) for i, leaf in enumerate(_leaves(self.tree))}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.reset()
        self.tree = _rebuilt(self.tree, (state[f"tree/{i}"] for i in itertools.count()))


def _rule(problem: Problem, owner: Mapping[str, Parameter]) -> OfMitsuba | OfPair:
    """Raises InputError if `Problem.optimiser` is nothing of what `Optimiser` says."""
    start = {name: p.start[name] for name, p in owner.items()}
    rule = problem.optimiser
    if hasattr(rule, "init") and hasattr(rule, "update"):
        return OfPair(rule, start)
    if isinstance(rule, str):
        # Large steps want one rate for all numbers of a mesh.
        made = {uniform: _by_name(problem, uniform) for uniform in (False, True)}
        return OfMitsuba({name: made[bool(p.free.smoothing)] for name, p in owner.items()}, start)
    try:
        made = rule if isinstance(rule, mi.ad.Optimizer) or not callable(rule) else rule(1.0)
    except TypeError as error:
        raise InputError(f"fit: optimiser(1.0), for the learning rate 1, makes no optimiser: {error}") from None
    if not isinstance(made, mi.ad.Optimizer):
        raise InputError(
            'fit: optimiser must be "adam", "sgd", an optimiser of Mitsuba or a function that makes one, or have the '
            f"methods init and update, got {type(rule).__name__}"
        )
    if len(made):
        raise InputError("fit: the optimiser holds parameters already; give a new one, or a function that makes it")
    return OfMitsuba(dict.fromkeys(start, made), start)


def _by_name(problem: Problem, uniform: bool) -> mi.ad.Optimizer:
    makers: dict[str, Callable[[], mi.ad.Optimizer]] = {
        "adam": lambda: mi.ad.Adam(1.0, beta_1=problem.momentum, beta_2=problem.smooth_scale, uniform=uniform),
        "sgd": lambda: mi.ad.SGD(1.0, momentum=problem.momentum),
    }
    if problem.optimiser not in makers:
        raise InputError(f'fit: optimiser must be one of {", ".join(makers)}, got "{problem.optimiser}"')
    return makers[problem.optimiser]()


# ------------------------------------------------------------------ arrays


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


def _leaves(tree: Any) -> Iterator[Any]:
    """Numbers and arrays of nested dictionaries, tuples and lists, in a fixed order."""
    if isinstance(tree, Mapping):
        for key in sorted(tree):
            yield from _leaves(tree[key])
    elif isinstance(tree, tuple | list):
        for part in tree:
            yield from _leaves(part)
    elif tree is not None:
        yield tree


def _rebuilt(tree: Any, leaves: Iterator[np.ndarray]) -> Any:
    """A tree as this one, of other numbers."""
    if isinstance(tree, Mapping):
        numbers = ((key, _rebuilt(tree[key], leaves)) for key in sorted(tree))
        return type(tree)(numbers)  # type: ignore[call-arg]
    if isinstance(tree, tuple | list):
        parts = [_rebuilt(part, leaves) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)
    if tree is None:
        return None
    array = next(leaves)
    if dr.is_array_v(tree):
        return _own(array) if dr.is_float_v(tree) else type(tree)(array)
    return type(tree)(array.item()) if isinstance(tree, int | float) else array
