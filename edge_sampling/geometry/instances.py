"""The meshes in shape groups, as each instance of the group shows them: with edges in the world of their own.

Mitsuba traces the same triangles for all instances; only the edges are there once for each.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .meshes import (
    Geometry,
    attribute_of,
    faces_of,
    has_normals,
    has_texcoords,
    is_flipped,
    normals_of,
    number_of,
    positions_of,
    shape_groups,
    texcoords_of,
)


class MeshOfInstance:
    """One mesh of a shape group, where one instance puts it. What `geometry/meshes.py` asks of a mesh, it answers.

    It stands still: a gradient of the instance, or of the mesh, is refused elsewhere.

    instance : the shape. inner : the mesh.
    """

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`: a frozen function places the vertices by itself

    def __init__(self, instance: Any, inner: Any):
        self.instance, self.inner = instance, inner
        self._placed: dict[str, tuple[list[mi.Float], mi.Float]] = {}

    def _place(self, name: str, values: mi.Float, matrix: mi.Matrix4f, kind: type) -> mi.Float:
        """Vectors of the mesh in the world: (3 V,), detached. The same array as before, if nothing has changed."""
        with dr.suspend_grad():
            place = lambda: dr.ravel(mi.AffineTransform4f(matrix) @ dr.unravel(kind, values))
            if dr.flag(dr.JitFlag.FreezingScope):
                return place()
            made_of = [values, *(mi.Float(matrix[i, j]) for i in range(3) for j in range(4))]
            held, placed = self._placed.get(name, ([], None))
            if [a.index for a in held] != [a.index for a in made_of]:
                placed = place()
                dr.eval(placed)
                self._placed[name] = made_of, placed
            return placed

    @property
    def _matrix(self) -> mi.Matrix4f:
        return dr.detach(mi.traverse(self.instance)["to_world"].matrix)

    # ---------------------- What Mitsuba's meshes answer ----------------------

    def vertex_positions_buffer(self) -> mi.Float:
        return self._place("positions", dr.detach(positions_of(self.inner)), self._matrix, mi.Point3f)

    def vertex_normals_buffer(self) -> mi.Float:
        return self._place("normals", dr.detach(normals_of(self.inner)), self._matrix, mi.Normal3f)

    def faces_buffer(self) -> mi.UInt32:
        return faces_of(self.inner)

    def vertex_texcoords_buffer(self) -> mi.Float:
        return texcoords_of(self.inner)

    def attribute_buffer(self, name: str) -> mi.Float:
        return attribute_of(self.inner, name)

    def has_vertex_normals(self) -> bool:
        return has_normals(self.inner)

    def has_vertex_texcoords(self) -> bool:
        return has_texcoords(self.inner)

    def has_flipped_normals(self) -> bool:
        """A reflection turns the normals round, against the order of the vertices."""
        return is_flipped(self.inner) != bool((dr.det(mi.Matrix3f(self._matrix)) < 0)[0])

    def __getattr__(self, name: str) -> Any:
        if name in ("id", "bbox", "ptr"):
            return getattr(self.instance, name)
        if name in ("bsdf", "class_name", "has_face_normals", "vertex_count", "face_count", "is_mesh", "is_emitter"):
            return getattr(self.inner, name)
        raise AttributeError(name)


class Instances:
    """Finds the meshes of the instances in a scene, and keeps them, so that frozen functions need not look for them."""

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`

    def __init__(self) -> None:
        self._instances: list[Any] = []
        self._meshes: list[MeshOfInstance] = []

    def geometry(self, scene: mi.Scene) -> Geometry:
        """The shapes of a scene, with the meshes of those instances whose groups have nothing but meshes."""
        geometry = Geometry.of(scene)
        instances = [s for s in geometry.others if s.class_name() == "Instance"]
        same = len(instances) == len(self._instances)
        if not same or any(a is not b for a, b in zip(instances, self._instances, strict=True)):
            self._instances, self._meshes = instances, _meshes_of(scene, instances)
        if not self._meshes:
            return geometry
        known = {id(m.instance) for m in self._meshes}
        others = tuple(s for s in geometry.others if id(s) not in known)
        return replace(geometry, meshes=(*geometry.meshes, *self._meshes), others=others)


def _meshes_of(scene: mi.Scene, instances: list[Any]) -> list[MeshOfInstance]:
    """The meshes of the instances. Reads from the device: Mitsuba does not tell of an instance which group it shows,
    but what its first shape is."""
    if not instances:
        return []
    groups = {number_of(shapes[0]): shapes for shapes in shape_groups(scene) if shapes}
    with dr.suspend_grad():
        met = dr.zeros(mi.PreliminaryIntersection3f, len(instances))
        met.t, met.valid = mi.Float(1), mi.Bool(True)
        numbers = [number_of(i) for i in instances]
        met.instance = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(numbers))
        first = met.compute_surface_interaction(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))).shape
        firsts = dr.reinterpret_array(mi.UInt32, first).numpy().tolist()
    found = []
    for instance, number in zip(instances, firsts, strict=True):
        shapes = groups.get(number, [])
        if all(s.is_mesh() and s.class_name() != "EllipsoidsMesh" for s in shapes):
            found += [MeshOfInstance(instance, mesh) for mesh in shapes]
    return found
