"""From the command line to motions and files. A user's mistakes end in an `InputError` of one line."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.checks import Motion
from rimlight.loading import InputError, expected

# ------------------------------------------------------------------ parameters


def differentiable(scene: Any) -> Iterator[tuple[str, Any, str]]:
    """Key, value and flags of the parameters that can be differentiated: ∂ (yes), D (moves edges)."""
    params = mi.traverse(scene)
    for key, (_, _, node, flags) in params.properties.items():
        value = params[key]
        if not (dr.is_diff_v(value) and dr.is_float_v(value)) and not key.endswith("to_world"):
            continue
        # Mitsuba does not flag the parameters of its sensors, but differentiates them
        if isinstance(node, mi.Sensor):
            yield key, value, "∂, D"
        elif not flags & mi.ParamFlags.NonDifferentiable:
            yield key, value, "∂, D" if flags & mi.ParamFlags.Discontinuous else "∂"


def camera_key(scene: Any, sensor: int) -> str:
    """Key of the pose of a sensor."""
    params = mi.traverse(scene)
    for key, (_, _, node, _) in params.properties.items():
        if key.endswith("to_world") and node == scene.sensors()[sensor]:
            return key
    raise InputError(f"--camera: sensor {sensor} has no to_world")


def numbers(option: str, text: str | None, kind: type = float) -> list[Any] | None:
    """Numbers separated by commas; None stays None."""
    if text is None:
        return None
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        what = "whole numbers" if kind is int else "numbers"
        raise InputError(f'{option}: "{text}" is not a list of {what} separated by commas') from None


def load_motion(
    scene: Any,
    *,
    param: str | None,
    camera: str | None,
    direction: str | None,
    rotate: str | None,
    pivot: str | None,
    vertices: str | None,
    sensor: int,
) -> Motion:
    """The motion that the options describe."""
    if (param is None) == (camera is None):
        raise InputError("say what moves: either --param KEY or --camera translate|rotate")
    if (direction is None) == (rotate is None):
        raise InputError("say how it moves: either --direction X,Y,Z or --rotate X,Y,Z")
    if camera and (camera == "translate") == (direction is None):
        raise InputError(f"--camera {camera} needs {'--direction' if camera == 'translate' else '--rotate'}")
    if pivot is not None and rotate is None:
        raise InputError("--pivot goes with --rotate")
    key = param if param is not None else camera_key(scene, sensor)
    with expected(ValueError):
        return Motion(
            scene,
            key,
            direction=numbers("--direction", direction),
            rotate=numbers("--rotate", rotate),
            pivot=numbers("--pivot", pivot),
            vertices=numbers("--vertices", vertices, int),
        )


def one_cluster(workers: int, cluster: str | None) -> None:
    """InputError : both are asked for."""
    if cluster is not None and workers:
        raise InputError("--workers starts processes here, --cluster takes those of a cluster; give one of them")


def at_least(minimum: int | float, **options: int | float) -> None:
    """Check options of the command line, written as keyword arguments."""
    for name, value in options.items():
        if not value >= minimum:
            raise InputError(f"--{name.replace('_', '-')} must be >= {minimum}, got {value}")


# ------------------------------------------------------------------ output


def check_output(path: Path, *, folder: bool, option: str = "--out") -> None:
    """Find out before the work begins whether a folder or file can be written. Creates nothing."""
    if path.exists() and path.is_dir() != folder:
        raise InputError(f'{option}: "{path}" is {"not a folder" if folder else "a folder"}')
    existing = path.absolute() if folder else path.absolute().parent
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f'{option}: cannot write "{path}": "{existing}" is not a folder')
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f'{option}: cannot write "{path}": no permission in "{existing}"')


def make_folder(path: Path) -> Path:
    with expected(OSError, who="--out"):
        path.mkdir(parents=True, exist_ok=True)
    return path


def show_warnings() -> None:
    """Of Rimlight; what Dask says of its workers' lives and deaths is said again in a line of ours."""
    handler = logging.StreamHandler()
    handler.addFilter(lambda record: not record.name.startswith("distributed"))
    logging.basicConfig(level=logging.WARNING, format="rimlight: %(message)s", handlers=[handler])
