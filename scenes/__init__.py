"""Scenes shipped with Rimlight: Mitsuba XML files with small meshes and textures, described in their README."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent

__all__ = ["names", "path"]


def names() -> list[str]:
    """Names of the scenes, sorted."""
    return sorted(file.stem for file in _FOLDER.glob("*.xml"))


def path(name: str) -> Path:
    """XML file of a scene, for `mitsuba.load_file`.

    Raises
    ------
    ValueError : there is no scene of that name. The text lists those that there are.
    """
    if name not in names():
        raise ValueError(f'there is no scene "{name}", choose one of {", ".join(names())}')
    return _FOLDER / f"{name}.xml"
