"""The types of settings of a fit, which Python does not look at."""

from __future__ import annotations

import dataclasses
import numbers
import operator
import reprlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from rimlight.edge_sampling.refusals import InputError


def _is(kind: type) -> Callable[[Any], Any]:
    def same(value: Any) -> Any:
        if not isinstance(value, kind):
            raise TypeError
        return value

    return same


def _real(value: Any) -> float:
    return float(_is(numbers.Real)(value))


def _several(of_one: Callable[[Any], Any]) -> Callable[[Any], tuple]:
    """Of one thing, of several in any order that Python knows, or of an array."""
    return lambda values: tuple(map(of_one, [values] if isinstance(values, str) else np.ravel(values).tolist()))


#: Annotation of a field -> what it must be, for people; and what makes that of a value, or raises TypeError or
#: ValueError.
SIMPLE: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "bool": ("true or false", _is(bool)),
    "int": ("a whole number", operator.index),
    "float": ("a number", _real),
    "Rate": ("a number > 0, or a function of the step", lambda value: value if callable(value) else _real(value)),
    "str": ("a text", _is(str)),
    "tuple[int, ...]": ("whole numbers", _several(operator.index)),
    "tuple[float, ...]": ("numbers", _several(_real)),
    "tuple[str, ...]": ("texts", _several(_is(str))),
}


def conform(settings: Any) -> None:
    """Make the simple fields of a dataclass what their annotations say: numbers of NumPy become those of Python, arrays
    become tuples.

    Raises
    ------
    InputError : a value is of another type.
    """
    for field in dataclasses.fields(settings):
        value, kind = getattr(settings, field.name), str(field.type).removesuffix(" | None")
        if kind not in SIMPLE or (value is None and kind != field.type):
            continue
        told, made = SIMPLE[kind]
        try:
            object.__setattr__(settings, field.name, made(value))
        except (TypeError, ValueError):
            raise InputError(f"fit: {_name(settings, field.name)} must be {told}, got {_short(value)}") from None


def one_of(settings: Any, name: str, allowed: Iterable[str]) -> None:
    """InputError : a field is none of these."""
    value = getattr(settings, name)
    if value not in allowed:
        raise InputError(f"fit: {_name(settings, name)} must be one of {', '.join(allowed)}, got {_short(value)}")


def of_kind(name: str, value: Any, kind: type) -> None:
    """InputError : a value, or one of several, is not of this type."""
    for one in value if isinstance(value, tuple) else (value,):
        if not isinstance(one, kind):
            wanted = "a dictionary" if kind is dict else f"of the type {kind.__name__}"
            raise InputError(f"fit: {name} must be {wanted}, got {_short(one)}")


def functions(name: str, given: Any) -> list[Callable[..., Any]]:
    """One function, or several. InputError : one is none."""
    found = [given] if callable(given) or not isinstance(given, Iterable) else list(given)
    if wrong := [thing for thing in found if not callable(thing)]:
        raise InputError(f"fit: {name} must be functions, got {_short(wrong[0])}")
    return found


def _name(settings: Any, field: str) -> str:
    kind = type(settings).__name__.lower()
    return field if kind == "problem" else f"{kind}.{field}"


def _short(value: Any) -> str:
    return " ".join(reprlib.repr(value).split())
