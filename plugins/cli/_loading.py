"""From the command line to scenes, integrators and motions. A user's mistakes end in an `InputError` of one line."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling import Geometry, Motion, meshes

INTEGRATORS = ("direct_edge", "prb_edge", "direct_projective", "prb_projective", "direct", "path", "prb", "prb_basic")

#: What Mitsuba says, and what it does not say.
HINTS = {
    r"field of view must be in the range": "is the width or the height of the film 0?",
    r"Storing new normals in a Mesh|incompatible sizes! \(sizes: 0": "the mesh has no vertices or no faces",
}


class InputError(Exception):
    """Something that the user can mend. The text is one line that names it."""


@contextmanager
def expected(*types: type[Exception], who: str = "", pattern: str = "") -> Iterator[None]:
    """Turn exceptions of these types, with a text that matches `pattern`, into `InputError`. All others are bugs."""
    try:
        yield
    except types as error:
        if not re.search(pattern, str(error)):
            raise
        raise InputError(f"{who}: {one_line(error)}" if who else one_line(error)) from error


def one_line(error: Exception) -> str:
    """The telling part of an error text of Mitsuba, on one line."""
    text = str(error).strip()
    head, traceback, tail = text.partition("Traceback (most recent call last):")
    if traceback:  # a plugin in Python failed: its last line says why
        text = head + re.sub(r"^\w+(Error|Exception): ", "", tail.strip().splitlines()[-1])
    text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", text).split())
    for pattern, hint in HINTS.items():
        if re.search(pattern, text):
            text += f" ({hint})"
    return text


# ------------------------------------------------------------------ scenes


def use_variant(name: str) -> None:
    """Set the variant of Mitsuba. InputError: it does not exist here, cannot differentiate, or has no device."""
    if name not in mi.variants():
        raise InputError(f'--variant: unknown variant "{name}", choose one of {", ".join(mi.variants())}')
    if "_ad_" not in name:
        raise InputError(f'--variant: "{name}" cannot differentiate, choose one with "_ad_" in its name')
    backend = getattr(dr.JitBackend, {"llvm": "LLVM", "cuda": "CUDA", "metal": "Metal"}[name.split("_")[0]])
    if not dr.has_backend(backend):
        raise InputError(f'--variant: "{name}" cannot be used on this machine, see `rimlight sys-info`')
    mi.set_variant(name)


def load_scene(path: Path, definitions: Sequence[str] = ()) -> Any:
    """Load and check a scene. definitions : ``key=value``, parameters of the scene file."""
    values = {}
    for definition in definitions:
        key, equals, value = definition.partition("=")
        if not (key and equals):
            raise InputError(f'-D: "{definition}" is not of the form key=value')
        values[key] = value
    if not path.is_file():
        raise InputError(f'scene "{path}" does not exist' if not path.exists() else f'scene "{path}" is not a file')
    with expected(RuntimeError, who=f'scene "{path}"'):
        scene = mi.load_file(str(path), **values)
    if not isinstance(scene, mi.Scene):
        raise InputError(f'"{path}" holds no scene, but a {type(scene).__name__}')
    check_scene(scene, path)
    return scene


def check_scene(scene: Any, path: Path) -> None:
    """Refuse what would end in a crash or in a picture of nothing. InputError: names the sensor or shape at fault."""
    who = f'scene "{path}"'
    if not scene.sensors():
        raise InputError(f"{who} has no sensor")
    for sensor in scene.sensors():
        width, height = sensor.film().crop_size()
        if width == 0 or height == 0:
            raise InputError(f'{who}: the film of sensor "{sensor.id()}" has the size {width} x {height}')
    for mesh in Geometry.of(scene).meshes:
        if mesh.vertex_count() == 0 or mesh.face_count() == 0:
            raise InputError(
                f'{who}: shape "{mesh.id()}" is empty ({mesh.vertex_count()} vertices, {mesh.face_count()} faces)'
            )
        if bad := int((~np.isfinite(meshes.vertices(mesh))).any(axis=1).sum()):
            raise InputError(f'{who}: shape "{mesh.id()}" has {bad} vertices that are not finite')


def load_integrator(name: str, **options: Any) -> Any:
    """Load an integrator by the name of its plugin."""
    try:
        integrator = mi.load_dict({"type": name, **options})
    except RuntimeError as error:
        if "not found" not in str(error):
            raise InputError(f"--integrator: {one_line(error)}") from error
        integrator = None
    if not isinstance(integrator, mi.Integrator):
        close = difflib.get_close_matches(name, INTEGRATORS, n=1) or [f"one of {', '.join(INTEGRATORS)}"]
        raise InputError(f'--integrator: unknown integrator "{name}", did you mean {close[0]}?')
    return integrator


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


def at_least(minimum: int | float, **options: int | float) -> None:
    """Check options of the command line, written as keyword arguments."""
    for name, value in options.items():
        if not value >= minimum:
            raise InputError(f"--{name.replace('_', '-')} must be >= {minimum}, got {value}")


# ------------------------------------------------------------------ output


def check_output(path: Path, *, folder: bool) -> None:
    """Find out before the work begins whether a folder or file can be written. Creates nothing."""
    if path.exists() and path.is_dir() != folder:
        raise InputError(f'--out: "{path}" is {"not a folder" if folder else "a folder"}')
    existing = path.absolute() if folder else path.absolute().parent
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f'--out: cannot write "{path}": "{existing}" is not a folder')
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f'--out: cannot write "{path}": no permission in "{existing}"')


def make_folder(path: Path) -> Path:
    with expected(OSError, who="--out"):
        path.mkdir(parents=True, exist_ok=True)
    return path
