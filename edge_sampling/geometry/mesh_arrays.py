"""The arrays of a mesh, flat and one entry for each vertex, whichever interface Mitsuba has. The only module that knows
how Mitsuba stores a mesh.

Mitsuba 3.9 keeps flat arrays. Mitsuba 3.10 keeps tensors, `positions` of shape (P, 3) and `normals` of shape (N, 3),
with P <= N <= V for V vertices: vertices that differ in their texture coordinates only share a position. The maps
`position_index` and `normal_index` lead from a vertex to its position and normal; an empty map is the identity.
(Release notes of Mitsuba 3.10.)

All arrays are attached where those of the mesh are.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def _is_flat(mesh: Any) -> bool:
    """Has the mesh the interface of Mitsuba 3.9?"""
    return hasattr(mesh, "vertex_positions_buffer")


def positions_of(mesh: Any) -> mi.Float:
    """Positions of the vertices: (3 V,), world space, scene units."""
    if _is_flat(mesh):
        return mesh.vertex_positions_buffer()
    return _of_vertices(mesh.positions(), mesh.position_index())


def normals_of(mesh: Any) -> mi.Float:
    """Normals of the vertices: (3 V,), world space. They need not have the length 1."""
    if _is_flat(mesh):
        return mesh.vertex_normals_buffer()
    return _of_vertices(mesh.normals(), mesh.normal_index())


def texcoords_of(mesh: Any) -> mi.Float:
    """Texture coordinates of the vertices: (2 V,)."""
    return mesh.vertex_texcoords_buffer() if _is_flat(mesh) else mesh.texcoords().array


def faces_of(mesh: Any) -> mi.UInt32:
    """Vertices of the triangles: (3 F,)."""
    return mesh.faces_buffer() if _is_flat(mesh) else mi.UInt32(mesh.faces().array)


def attribute_of(mesh: Any, name: str) -> mi.Float:
    """An attribute of the vertices or faces: (K V,) or (K F,)."""
    return mesh.attribute_buffer(name) if _is_flat(mesh) else mesh.attribute(name).array


def has_normals(mesh: Any) -> bool:
    """Does the mesh store normals of its vertices?"""
    return mesh.has_vertex_normals() if _is_flat(mesh) else mesh.has_normals()


def has_texcoords(mesh: Any) -> bool:
    """Does the mesh store texture coordinates?"""
    return mesh.has_vertex_texcoords() if _is_flat(mesh) else mesh.has_texcoords()


def is_flipped(mesh: Any) -> bool:
    """Do normals point against the side that the order of the vertices makes the front? Never in Mitsuba 3.10, which
    turns the faces round."""
    return mesh.has_flipped_normals() if _is_flat(mesh) else False


def is_moving(mesh: Any) -> bool:
    """Do the positions carry a gradient?"""
    return dr.grad_enabled(mesh.vertex_positions_buffer() if _is_flat(mesh) else mesh.positions())


def is_positions_key(key: str) -> bool:
    """Does a parameter of a scene hold the positions of a mesh? ``vertex_positions``, (3 V,), or since Mitsuba 3.10
    ``positions``, (P, 3)."""
    return key.rpartition(".")[2] in ("vertex_positions", "positions")


def attribute_names(mesh: Any, of: str = "vertex_") -> list[str]:
    """Names of the attributes of the vertices, or ``face_`` of the faces."""
    known = ("vertex_positions", "vertex_normals", "vertex_texcoords")
    return [name for name in mi.traverse(mesh).properties if name.startswith(of) and name not in known]


def _of_vertices(values: mi.TensorXf, index: mi.UInt32) -> mi.Float:
    """(3 V,) of the rows (P, 3) that `index` names."""
    if dr.width(index) == 0:
        return values.array
    return dr.ravel(dr.gather(mi.Point3f, values.array, index))
