"""What meshes interpolate between their vertices, and that may change while these stay where they are."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .meshes import has_interpolated_normals, has_texcoords, normals_of, texcoords_of


def texture_slides(mesh: Any) -> bool:
    """Do the texture coordinates carry a gradient?"""
    return has_texcoords(mesh) and dr.grad_enabled(texcoords_of(mesh))


def normals_turn(mesh: Any) -> bool:
    """Do the interpolated normals carry a gradient?"""
    return isinstance(mesh, mi.Mesh) and has_interpolated_normals(mesh) and dr.grad_enabled(normals_of(mesh))
