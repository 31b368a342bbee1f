"""The ranges of settings of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rimlight.edge_sampling.refusals import InputError

from . import losses

if TYPE_CHECKING:
    from .problem import Problem


def check(problem: Problem) -> None:
    """Refuse what cannot be meant.

    Raises
    ------
    InputError : a number is out of range, or something is missing. The text names it as the TOML file does.
    """
    if not problem.free:
        raise InputError("fit: nothing is free, add a table [[free]]")
    if not problem.target or not problem.stage:
        raise InputError("fit: a fit needs at least one target and one stage")
    if problem.views_per_step is not None and problem.views_per_step > len(problem.target):
        raise InputError(
            f"fit: views_per_step is {problem.views_per_step}, but there are only {len(problem.target)} targets"
        )
    at_least = {"parts": 1, "views_per_step": 1, "seed": 0, "threads": 1, "max_bad": 1, "patience": 1, "seconds": 0}
    _at_least("", problem, at_least)
    _positive("", problem, ("clip", "max_memory"))
    for name in ("momentum", "smooth_scale"):
        if not 0 <= getattr(problem, name) < 1:
            raise InputError(f"fit: {name} must be in [0, 1), got {getattr(problem, name)}")
    if "type" not in problem.integrator:
        raise InputError('fit: integrator needs a "type"')
    _at_least("loss.", problem.loss, {"pyramid": 0, "exclude_above": 0})
    _at_least("starts.", problem.starts, {"count": 1, "move": 0, "turn": 0, "value": 0})
    if problem.starts.count > 1 and not (problem.starts.move or problem.starts.turn or problem.starts.value):
        raise InputError(
            "fit: several starts need starts.move, starts.turn or starts.value, else they are all the same"
        )
    for i, stage in enumerate(problem.stage):
        _at_least(f"stage.{i}.", stage, {"iterations": 1, "resolution": 1, "spp": 1})
        _positive(f"stage.{i}.", stage, ("decay",) if callable(stage.rate) else ("rate", "decay"))
    for i, target in enumerate(problem.target):
        _at_least(f"target.{i}.", target, {"sensor": 0, "spp": 1})
    pictures = ((f"target.{i}.{n}", getattr(t, n)) for i, t in enumerate(problem.target) for n in ("file", "mask"))
    losses.check(problem.loss, problem.norms, [name for name, picture in pictures if picture is not None])
    for i, free in enumerate(problem.free):
        where = f"free.{i}."
        if not free.key:
            raise InputError(f"fit: {where}key is empty")
        _positive(where, free, ("rate", "turn_rate"))
        _at_least(where, free, {"smoothing": 0})
        for name in ("move", "turn"):
            axes = getattr(free, name)
            if set(axes) - set("xyz") or len(set(axes)) < len(axes):
                raise InputError(f'fit: {where}{name} must consist of the letters x, y, z, got "{axes}"')
        low, high = (
            default if bound is None else bound
            for bound, default in ((free.lower, float("-inf")), (free.upper, float("inf")))
        )
        if not low < high:  # nor if one is not a number
            raise InputError(f"fit: {where}lower must be below upper, got {low} and {high}")


def _at_least(where: str, of: Any, minima: Mapping[str, float]) -> None:
    for name, minimum in minima.items():
        value = getattr(of, name)
        if value is not None and not value >= minimum:
            raise InputError(f"fit: {where}{name} must be >= {minimum}, got {value}")


def _positive(where: str, of: Any, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(of, name)
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"fit: {where}{name} must be > 0, got {value}")
