"""The meshes in shape groups, as each instance of the group shows them: with edges in the world of their own.

Mitsuba traces the same triangles for all instances; only the edges are there once for each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .grids import has_changing_values, slide_on_grid
from .meshes import (
    Geometry,
    attribute_of,
    faces_of,
    has_normals,
    has_texcoords,
    is_flipped,
    named_shape_groups,
    normals_of,
    number_of,
    positions_of,
    shape_groups,
    tells_shapes_in_groups,
    texcoords_of,
)
from .tubes import TUBE, slide_on_tube

#: An instance is flat if its smallest stretch is below this, relative to its largest.
FLAT = 1e-5


class MeshOfInstance:
    """One mesh of a shape group, where one instance puts it. What `geometry/meshes.py` asks of a mesh, it answers.

    It moves with the instance. A gradient of the mesh itself is refused elsewhere.

    instance : the shape. inner : the mesh.
    """

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`: a frozen function places the vertices by itself

    def __init__(self, instance: Any, inner: Any):
        self.instance, self.inner = instance, inner
        self._placed: dict[str, tuple[list[mi.Float], mi.Float]] = {}

    def _place(self, name: str, values: mi.Float, kind: type) -> mi.Float:
        """Vectors of the mesh in the world: (3 V,). The same array as before, if nothing has changed."""
        matrix = matrix_of(self.instance)
        place = lambda: dr.ravel(mi.AffineTransform4f(matrix) @ dr.unravel(kind, values))
        if dr.flag(dr.JitFlag.FreezingScope):
            return place()
        now = dr.detach(mi.traverse(self.instance)["to_world"].matrix)
        made_of = [values, *(mi.Float(now[i, j]) for i in range(3) for j in range(4))]
        held, placed = self._placed.get(name, ([], None))
        if [a.index for a in held] != [a.index for a in made_of]:
            with dr.suspend_grad():
                placed = place()
                dr.eval(placed)
            self._placed[name] = made_of, placed
        return dr.replace_grad(placed, place()) if dr.grad_enabled(matrix) else placed

    # ---------------------- What Mitsuba's meshes answer ----------------------

    def vertex_positions_buffer(self) -> mi.Float:
        return self._place("positions", dr.detach(positions_of(self.inner)), mi.Point3f)

    def vertex_normals_buffer(self) -> mi.Float:
        return self._place("normals", dr.detach(normals_of(self.inner)), mi.Normal3f)

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
        """As in the group: a reflection turns the faces round, but their normals stay outside."""
        return is_flipped(self.inner)

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


#: Of the instances that move, by their addresses: copies of `to_world`, 12 numbers each, row by row. One dictionary for
#: each derivative that is being found.
_copies: list[dict[int, mi.Float]] = []


@contextmanager
def copied_places(scene: mi.Scene, mode: dr.ADMode) -> Iterator[None]:
    """Let all that follows the instances depend on copies of their `to_world`, but Mitsuba's own calls.

    In forward mode, Dr.Jit 1.5 refuses to go through a virtual function call that depends on a variable from which
    something else has been computed outside of the call, and is still to be visited. In backward mode, copies collect
    the gradients of all terms, one after the other, and pass them on in the end.
    """
    places, cuts = {}, []
    with dr.resume_grad():
        for shape in scene.shapes():
            if shape.class_name() == "Instance" and dr.grad_enabled(m := mi.traverse(shape)["to_world"].matrix):
                numbers = place = dr.concat([mi.Float(m[i, j]) for i in range(3) for j in range(4)])
                if mode == dr.ADMode.Backward:
                    numbers = dr.detach(place)
                    dr.enable_grad(numbers)
                    cuts.append((place, numbers))
                places[int(shape.ptr)] = numbers
    _copies.append(places)
    try:
        yield
    finally:
        _copies.pop()
    with dr.resume_grad():
        for place, numbers in cuts:
            dr.set_grad(place, dr.grad(numbers))
            dr.enqueue(dr.ADMode.Backward, place)
        if cuts:
            dr.traverse(dr.ADMode.Backward)


def matrix_of(instance: mi.Shape, active: mi.Bool | bool = True) -> mi.Matrix4f:
    """From an instance to the world; attached, unless gradients are suspended. active : for whom, (N,)."""
    numbers = _copies[-1].get(int(instance.ptr)) if _copies else None
    if numbers is None:
        return mi.traverse(instance)["to_world"].matrix
    # Each sample reads for itself: in a loop, Dr.Jit cannot add up the gradients of samples.
    row = lambda i: [dr.gather(mi.Float, numbers, mi.UInt32(4 * i + j), active) for j in range(4)]
    return mi.Matrix4f(*row(0), *row(1), *row(2), 0, 0, 0, 1)


def is_flat(instance: mi.Shape) -> bool:
    """Has the transformation of an instance no inverse, up to rounding?"""
    matrix = np.array(dr.detach(matrix_of(instance)), float).reshape(4, 4)
    stretches = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    return bool(stretches[2] <= FLAT * stretches[0])


def surface_met(
    scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, flags: mi.RayFlags, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """What a ray meets, attached to the motion of instances, too.

    Mitsuba 3.9 knows how the points of an instance move, but not how its normals and texture coordinates change. And of
    an instance that moves, it does not know either what the motion of the ray does to them. For grids whose values
    change, see `slide_on_grid`, and for tubes `slide_on_tube`.
    """
    si = pi.compute_surface_interaction(ray, flags, active)
    for shape in scene.shapes():
        if shape.class_name() == "SDFGrid" and not flags & mi.RayFlags.FollowShape and has_changing_values(shape):
            slide_on_grid(si, ray, pi, flags, active & si.is_valid() & (pi.shape == mi.ShapePtr(shape)))
        if shape.class_name() == TUBE and not flags & mi.RayFlags.FollowShape:
            slide_on_tube(shape, si, ray, pi, active & si.is_valid() & (pi.shape == mi.ShapePtr(shape)))
        if shape.class_name() == "Instance" and _moves(shape) and dr.grad_enabled(matrix_of(shape), ray.o, ray.d):
            on_shape = active & si.is_valid() & (pi.instance == mi.ShapePtr(shape))
            _attach(si, mi.AffineTransform4f(matrix_of(shape, on_shape)), ray, pi, flags, on_shape)
    return si


def _moves(instance: mi.Shape) -> bool:
    """Does `to_world` carry a gradient, wherever gradients may be suspended?"""
    with dr.resume_grad():
        return dr.grad_enabled(matrix_of(instance))


def _attach(si, to_world: mi.AffineTransform4f, ray, pi, flags, active) -> None:
    """Attach what is met on an instance to its motion, and to that of the ray."""
    with dr.suspend_grad():
        inside = mi.PreliminaryIntersection3f(pi)
        inside.shape, inside.instance = si.shape, dr.zeros(mi.ShapePtr, dr.width(active))
        corners = []
        for u, v in ((0, 0), (1, 0), (0, 1)):
            inside.prim_uv = mi.Point2f(u, v)
            corners.append(inside.compute_surface_interaction(ray, mi.RayFlags.All, active))
        along = dr.detach(to_world).inverse() @ si.dp_du, dr.detach(to_world).inverse() @ si.dp_dv
    p, a, b = (to_world @ c.p for c in corners)
    a, b = a - p, b - p
    n = dr.cross(a, b)
    n *= dr.rsqrt(dr.squared_norm(n)) * dr.sign(dr.dot(dr.detach(n), dr.detach(si.n)))
    u, v = pi.prim_uv
    attached = {"n": n}
    if not flags & mi.RayFlags.FollowShape:
        # Where the ray meets the plane of the triangle, and its parts of the area there.
        attached["t"] = t = dr.dot(n, p - ray.o) / dr.dot(n, ray.d)
        there, area = ray(t) - p, dr.cross(a, b)
        u, v = (dr.dot(area, dr.cross(*pair)) / dr.squared_norm(area) for pair in ((there, b), (a, there)))
    mix = lambda x, y, z: (1 - u - v) * x + u * y + v * z
    attached["p"], attached["uv"] = p + u * a + v * b, mix(*(c.uv for c in corners))
    attached["dp_du"], attached["dp_dv"] = (to_world @ mi.Vector3f(w) for w in along)
    shading = dr.normalize(to_world @ mi.Normal3f(mix(*(c.sh_frame.n for c in corners))))
    s = attached["dp_du"] - shading * dr.dot(shading, attached["dp_du"])
    known = dr.squared_norm(s) > 0
    s = dr.select(known, dr.normalize(dr.select(known, s, mi.Vector3f(1, 0, 0))), dr.detach(si.sh_frame.s))
    axes = {"s": s, "t": dr.cross(shading, s), "n": shading}
    for target, values in ((si, attached), (si.sh_frame, axes)):
        for name, value in values.items():
            now = dr.detach(getattr(target, name))
            setattr(target, name, dr.select(active, dr.replace_grad(now, type(now)(value)), getattr(target, name)))
    si.wi = dr.select(active, si.to_local(-ray.d), si.wi)


def _meshes_of(scene: mi.Scene, instances: list[Any]) -> list[MeshOfInstance]:
    """The meshes of the instances. Reads from the device."""
    if not instances:
        return []
    shown, found = (_named if tells_shapes_in_groups() else _first_met)(scene, instances), []
    for instance, shapes in zip(instances, shown, strict=True):
        if all(s.is_mesh() and s.class_name() != "EllipsoidsMesh" for s in shapes):
            found += [MeshOfInstance(instance, mesh) for mesh in shapes]
    return found


def _first_met(scene: mi.Scene, instances: list[Any]) -> list[list[Any]]:
    """The shapes of the instances. Mitsuba does not tell of an instance which group it shows. But where an intersection
    names the instance and the number 0 alone, its surface is of the group's first shape."""
    groups = {number_of(shapes[0]): shapes for shapes in shape_groups(scene) if shapes}
    with dr.suspend_grad():
        met = dr.zeros(mi.PreliminaryIntersection3f, len(instances))
        met.t, met.valid = mi.Float(1), mi.Bool(True)
        numbers = [number_of(i) for i in instances]
        met.instance = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(numbers))
        ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))
        first = met.compute_surface_interaction(ray, mi.RayFlags.FollowShape).shape
        firsts = dr.reinterpret_array(mi.UInt32, first).numpy().tolist()
    return [groups.get(number, []) for number in firsts]


def _named(scene: mi.Scene, instances: list[Any]) -> list[list[Any]]:
    """The shapes of the instances; none where groups have the same name, so that the instance counts as a shape of
    unknown outlines. Where Mitsuba tells the shape in a group itself, `_first_met` cannot ask for it, and only the
    description of an instance names its group."""
    groups = named_shape_groups(scene)
    names = [name for name, _ in groups]
    shapes = {name: inside for name, inside in groups if names.count(name) == 1}
    shown = (re.search(r'ShapeGroup\[\s*name = "(.*)"', str(i)) for i in instances)
    return [shapes.get(match[1], []) if match else [] for match in shown]
