"""Scenes and integrators from files and names. A user's mistakes end in an `InputError` of one line."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling import Geometry
from rimlight.edge_sampling.geometry import meshes
from rimlight.edge_sampling.refusals import InputError

INTEGRATORS = ("direct_edge", "prb_edge", "direct_projective", "prb_projective", "direct", "path", "prb", "prb_basic")

#: What Mitsuba says, and what it does not say.
HINTS = {
    r"field of view must be in the range": "is the width or the height of the film 0?",
    r"Storing new normals in a Mesh|incompatible sizes! \(sizes: 0": "the mesh has no vertices or no faces",
}


@contextmanager
def expected(*types: type[Exception], who: str = "") -> Iterator[None]:
    """Turn exceptions of these types into `InputError`. All others are bugs, unless they are refusals already."""
    try:
        yield
    except types as error:
        raise InputError(f"{who}: {one_line(error)}" if who else one_line(error)) from error


def one_line(error: Exception) -> str:
    """The telling part of an error text of Mitsuba, on one line."""
    text = str(error).strip()
    head, traceback, tail = text.partition("Traceback (most recent call last):")
    if traceback:  # a plugin in Python failed: its last line says why
        text = head + re.sub(r"^(\w+Error|\w+Exception|Refusal): ", "", tail.strip().splitlines()[-1])
    text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", text).split())
    for pattern, hint in HINTS.items():
        if re.search(pattern, text):
            text += f" ({hint})"
    return text


# ------------------------------------------------------------------ scenes


def use_variant(name: str) -> None:
    """Set the variant of Mitsuba. InputError: it does not exist here, cannot differentiate, or has no device."""
    if name not in mi.variants():
        raise InputError(f'variant: unknown variant "{name}", choose one of {", ".join(mi.variants())}')
    if "_ad_" not in name:
        raise InputError(f'variant: "{name}" cannot differentiate, choose one with "_ad_" in its name')
    backend = getattr(dr.JitBackend, {"llvm": "LLVM", "cuda": "CUDA", "metal": "Metal"}[name.split("_")[0]])
    if not dr.has_backend(backend):
        raise InputError(f'variant: "{name}" cannot be used on this machine, see `rimlight sys-info`')
    mi.set_variant(name)


def load_scene(path: Path, definitions: Sequence[str] = ()) -> Any:
    """Load and check a scene, as its file has it.

    By itself, Mitsuba makes one mesh of all that have equal materials, and one material of equal ones: then a chair
    cannot move alone, and walls that start with the same colour keep the same colour. Here, nothing is merged; and
    what has no identifier gets one, see `name_objects`.

    definitions : ``key=value``, parameters of the scene file.
    """
    values = {}
    for definition in definitions:
        key, equals, value = definition.partition("=")
        if not (key and equals):
            raise InputError(f'-D: "{definition}" is not of the form key=value')
        values[key] = value
    if not path.is_file():
        raise InputError(f'scene "{path}" does not exist' if not path.exists() else f'scene "{path}" is not a file')
    with expected(RuntimeError, who=f'scene "{path}"'):
        scene = mi.load_file(str(path), optimize=False, **values)
    if not isinstance(scene, mi.Scene):
        raise InputError(f'"{path}" holds no scene, but a {type(scene).__name__}')
    name_objects(scene)
    check_scene(scene, path)
    return scene


def name_objects(scene: Any) -> None:
    """Name the shapes, lights and sensors of a scene that have no identifier: by their class, and a number if there are
    several, in the order of the file: ``PerspectiveCamera``, ``Rectangle``, ``Rectangle_1``.

    Mitsuba 3.9 lists the parameters of such objects by their address in memory, which is another one in each run.
    """
    objects = [*scene.sensors(), *scene.shapes(), *scene.emitters()]
    taken = {o.id() for o in objects}
    for o in objects:
        if not o.id():
            name = o.class_name()
            names = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(1)))
            o.set_id(next(n for n in names if n not in taken))
            taken.add(o.id())


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
    """Load an integrator by the name of its plugin, with its parameters."""
    try:
        integrator = mi.load_dict({"type": name, **options})
    except RuntimeError as error:
        if "not found" not in str(error):
            raise InputError(f"integrator: {one_line(error)}") from error
        integrator = None
    if not isinstance(integrator, mi.Integrator):
        close = difflib.get_close_matches(name, INTEGRATORS, n=1) or [f"one of {', '.join(INTEGRATORS)}"]
        raise InputError(f'integrator: unknown integrator "{name}", did you mean {close[0]}?')
    return integrator
