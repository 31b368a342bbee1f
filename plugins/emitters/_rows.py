"""Rows of numbers for plugins: from a string, a tensor or a file."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.refusals import InputError


def rows(props: mi.Properties, key: str, width: int) -> np.ndarray | None:
    """The property `key`, or the file that `key_file` names: (K, width), or None if there is neither.

    A property is a number or a colour (of which the row consists), a vector, a string with commas between the rows
    (``"0 0 1, 0 1 0"``), or in Python a tensor, (K, width). A file has a row a line, numbers with spaces or commas
    between them and comments after ``#``; ``.npy`` is NumPy's.

    Raises
    ------
    ValueError : both are given; not numbers; not finite; of another shape.
    FileNotFoundError
    """
    who, file = props.plugin_name(), f"{key}_file"
    if key in props and file in props:
        raise InputError(f'{who}: give either "{key}" or "{file}", not both')
    if file in props:
        return _check(
            read_rows(str(mi.file_resolver().resolve(props[file])), who), f'{who}: "{file}" {props[file]}', width
        )
    if key not in props:
        return None
    value, what = props[key], f'{who}: "{key}"'
    if isinstance(value, str):
        value = _parse(re.split(r"[,;\n]" if width > 1 else r"[,;\s]", value), what, "row")
    elif isinstance(value, int | float):
        value = np.full((1, width), value, np.float64)
    else:
        vectors = isinstance(value, mi.Vector3f | mi.Point3f | mi.Color3f)  # (3, K)
        try:
            value = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(
                f"{what} must be numbers: a vector, a colour, a string, or in Python "
                f"mi.TensorXf of shape (K, {width}); got {type(value).__name__}"
            ) from None
        value = value.T if vectors else value
        value = value.reshape(-1, width) if value.ndim == 1 and value.size % width == 0 else value
    return _check(value, what, width)


def tensor(value: np.ndarray) -> mi.TensorXf:
    """In Dr.Jit's own memory: `dr.freeze` does not go with NumPy's."""
    return mi.TensorXf(mi.Float(value.ravel().tolist()), shape=value.shape)


def read_rows(path: Path | str, who: str) -> np.ndarray:
    """Numbers of a text file, one row a line, or of a NumPy file ``.npy``."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{who}: there is no file {path}")
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False).astype(np.float64)
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    return _parse([re.sub(r"[,;]", " ", line.split("#")[0]) for line in lines], f"{who}: {path}", "line")


def _parse(texts: list[str], what: str, unit: str) -> np.ndarray:
    """Numbers separated by spaces, one row each; empty ones are skipped."""
    found: list[list[float]] = []
    for number, text in enumerate(texts, 1):
        try:
            row = [float(word) for word in text.split()]
        except ValueError:
            raise InputError(f'{what}, {unit} {number}: expected numbers, got "{text.strip()}"') from None
        if row and found and len(row) != len(found[0]):
            raise InputError(f"{what}, {unit} {number}: {len(row)} numbers, but {len(found[0])} in those before")
        if row:
            found.append(row)
    return np.array(found)


def _check(value: np.ndarray, what: str, width: int) -> np.ndarray:
    if value.ndim != 2 or value.shape[1] != width or len(value) == 0:
        shape = " × ".join(map(str, value.shape)) or "a single number"
        raise InputError(f"{what} must have {width} number(s) a row, and at least one row; got {shape}")
    bad = np.flatnonzero(~np.isfinite(value).all(1))
    if len(bad):
        raise InputError(f"{what}: row {bad[0] + 1} is not finite: {value[bad[0]].tolist()}")
    return value
