"""What a fit is made from, scenes and pictures, in files or in memory; and fingerprints of what they hold."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.loading import InputError, check_scene, expected, load_scene

from .free_parameters import is_transform
from .problem import Problem


def scene(source: Any, define: Mapping[str, str]) -> mi.Scene:
    """The scene of a file, of a dictionary, or the one that is given itself.

    define : values for parameters of a file.

    Raises
    ------
    InputError : it cannot be loaded, or is no scene. The text is one line.
    """
    if isinstance(source, Path):
        return load_scene(source, [f"{key}={value}" for key, value in define.items()])
    if define:
        raise InputError("fit: define is for scene files, this scene is in memory")
    who = Path("in memory")
    if isinstance(source, dict):
        with expected(RuntimeError, who=f'scene "{who}"'):
            source = mi.load_dict(source, optimize=False)  # what is equal at the start must not become one
    if not isinstance(source, mi.Scene):
        raise InputError(f"fit: a scene is a path, a dictionary or an mi.Scene, got {type(source).__name__}")
    check_scene(source, who)
    return source


def key(source: Any) -> Any:
    """Equal for the same scene."""
    return source if isinstance(source, Path) else id(source)


def numbers(source: Any) -> np.ndarray:
    """An array, or a tensor of any library, as an array of NumPy. ValueError: it is none."""
    if hasattr(source, "detach"):  # of PyTorch
        source = source.detach().cpu()
        source = source.float() if source.is_floating_point() else source  # NumPy knows no bfloat16
    array = np.asarray(source)
    if array.dtype.kind not in "fiub":
        what = f"an array of {array.dtype}" if array.ndim else type(source).__name__
        raise InputError(f"fit: a picture is a path, an array or a tensor, got {what}")
    return array


# ------------------------------------------------------------------ fingerprints


def fingerprints(problem: Problem, scenes: Mapping[Any, mi.Scene]) -> dict[str, str]:
    """Of the scenes and pictures of a problem, by what they hold and not by where they are: "scene", "target.0.file" …
    -> digest. Functions that make pictures have none.

    scenes : the loaded ones, by their `key`, as they were loaded.
    """
    of_scene = lambda source: (
        _of_scene_file(source, problem.define) if isinstance(source, Path) else _of_scene(scenes[key(source)])
    )
    found = {"scene": of_scene(problem.scene)} if key(problem.scene) in scenes else {}
    for i, target in enumerate(problem.target):
        if target.scene is not None:
            found[f"target.{i}.scene"] = of_scene(target.scene)
        for name in ("file", "mask"):
            source = getattr(target, name)
            if isinstance(source, Path):
                found[f"target.{i}.{name}"] = _of_file(source)
            elif source is not None and not callable(source):
                found[f"target.{i}.{name}"] = _of_array(source)
    return found


def _of_scene_file(path: Path, define: Mapping[str, str]) -> str:
    """Of all that it says, and of all files that it names."""
    digest = hashlib.blake2b(digest_size=16)
    for node in mi.parser.parse_file(mi.parser.ParserConfig(mi.variant()), str(path), **define).nodes:
        said = node.props
        digest.update(f"{node.type} {said.plugin_name()} {said.id()}".encode())
        for name in sorted(said.keys()):
            text = said.as_string(name)
            # Where a mesh or a picture lies does not matter, but what is in it.
            if said.type(name) == mi.Properties.Type.String and os.path.isfile(path.parent / said[name]):
                text = _of_file(path.parent / said[name])
            digest.update(f" {name} {text}".encode())
    return digest.hexdigest()


def _of_scene(scene: mi.Scene) -> str:
    """Of all of its parameters, by name: Mitsuba, which loads in parallel, has them in any order."""
    digest = hashlib.blake2b(digest_size=16)
    for name, value in sorted(mi.traverse(scene).items(), key=lambda item: item[0]):
        value = value.matrix if is_transform(value) else value
        digest.update(f"{name} {type(value).__name__} ".encode())
        digest.update(np.array(value).tobytes() if dr.is_array_v(value) else repr(value).encode())
    return digest.hexdigest()


def _of_file(path: Path) -> str:
    if not path.is_file():
        raise FileNotFoundError(f'fit: there is no file "{path}"')
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _of_array(source: Any) -> str:
    array = np.ascontiguousarray(numbers(source))
    return hashlib.blake2b(f"{array.shape} {array.dtype}".encode() + array.tobytes(), digest_size=16).hexdigest()
