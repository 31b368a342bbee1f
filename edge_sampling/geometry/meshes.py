"""Access to the geometry of a scene. The only module that knows how Mitsuba stores a mesh.

All else sees the arrays of a mesh flat, with one entry for each vertex. Mitsuba 3.9 keeps them so. Mitsuba 3.10 keeps
tensors, `positions` of shape (P, 3) and `normals` of shape (N, 3), with P <= N <= V for V vertices: vertices that
differ in their texture coordinates only share a position. The maps `position_index` and `normal_index` lead from a
vertex to its position and normal; an empty map is the identity (release notes of Mitsuba 3.10).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .curves import CURVES
from .tubes import TUBE

#: Interpolated normals are those of a face if the sine of the angle between them is at most so large.
BENT = 1e-3

#: A method of the meshes of Mitsuba 3.9, which those of 3.10 do not have.
OLD = "vertex_positions_buffer"

#: Parameters of meshes that are named like attributes.
NO_ATTRIBUTES = ("vertex_positions", "vertex_normals", "vertex_texcoords")


@dataclass(frozen=True)
class Geometry:
    """The shapes of a scene, sorted by what can be done with them.

    meshes : triangle meshes (also `rectangle`, `cube` and merged shapes), whose edges are known; and what stands for
        such: see `Instances` and `Grids`.
    analytic : spheres, disks, cylinders, whose outlines are known curves.
    tubes : b-spline curves, whose outlines are known curves, too.
    others : all else (linear curves, ...; instances and grids, until theirs are found). They occlude and receive light,
        but must not move.
    lines : in which shapes cut through each other (`CutCurves`, `Intersections`), whose vertices then come after those
        of the meshes.
    joints : rims of analytic shapes that coincide (`Rims`).
    textures : lines at which textures jump (`TextureEdges`), whose vertices come last; None: they are not asked for.
    """

    meshes: tuple[Any, ...]
    analytic: tuple[Any, ...] = ()
    tubes: tuple[Any, ...] = ()
    others: tuple[Any, ...] = ()
    lines: tuple[Any, ...] = ()
    joints: tuple[Any, ...] = ()
    textures: Any = None

    @staticmethod
    def of(scene: mi.Scene) -> Geometry:
        shapes = scene.shapes()
        meshes = tuple(s for s in shapes if s.is_mesh() and s.class_name() != "EllipsoidsMesh")
        analytic = tuple(s for s in shapes if s.class_name() in CURVES)
        tubes = tuple(s for s in shapes if s.class_name() == TUBE)
        known = {id(s) for s in (*meshes, *analytic, *tubes)}
        return Geometry(meshes, analytic, tubes, tuple(s for s in shapes if id(s) not in known))

    @property
    def known(self) -> tuple[Any, ...]:
        """All shapes whose outlines are known."""
        return (*self.meshes, *self.analytic, *self.tubes)

    @property
    def _all_lines(self) -> tuple[Any, ...]:
        return self.lines if self.textures is None else (*self.lines, self.textures)

    @property
    def line_vertices(self) -> int:
        """Number of the vertices of `lines` and `textures`."""
        return sum(lines.vertices for lines in self._all_lines)

    def any_line(self, wanted: np.ndarray) -> bool:
        """Can one of the shapes for which `wanted` (bool, laid out as `moving`) holds have lines?"""
        return any(bool(wanted[list(lines.shapes)].any()) for lines in self.lines)

    def faces(self, wanted: tuple[bool, ...]) -> np.ndarray:
        """Faces of the meshes that are `wanted`: (F, 3), indices into `positions`, on the host."""
        offsets = np.cumsum([0, *(m.vertex_count() for m in self.meshes)])
        chosen = [faces(m) + np.uint32(o) for m, o, w in zip(self.meshes, offsets, wanted, strict=False) if w]
        return np.concatenate(chosen) if chosen else np.zeros((0, 3), np.uint32)

    def moving(self) -> tuple[bool, ...]:
        """For each of the `known` shapes: does it move?"""
        meshes = tuple(is_moving(m) for m in self.meshes)
        analytic = tuple(dr.grad_enabled(mi.traverse(s)["to_world"]) for s in self.analytic)
        return meshes + analytic + tuple(dr.grad_enabled(mi.traverse(s)["control_points"]) for s in self.tubes)

    @property
    def first_of_textures(self) -> int:
        """Number of the first vertex of `textures`."""
        return sum(m.vertex_count() for m in self.meshes) + sum(lines.vertices for lines in self.lines)

    def positions(self) -> mi.Float:
        """Vertex positions of all meshes, one after the other: (3 V,), world space, scene units; attached."""
        of_meshes = [positions_of(m) for m in self.meshes]
        return _concat([*of_meshes, *(dr.ravel(p) for lines in self._all_lines for p in lines.points(of_meshes))])

    def host_positions(self) -> np.ndarray:
        """Vertex positions of all meshes: (V, 3), world space, on the host."""
        if self._all_lines:
            with dr.suspend_grad():
                return np.array(self.positions()).reshape(-1, 3)
        return np.concatenate([vertices(m) for m in self.meshes]) if self.meshes else np.zeros((0, 3), np.float32)

    def normals(self) -> mi.Float:
        """Vertex normals of all meshes, laid out as `positions`; zero where a mesh has none. Attached."""
        none = lambda count: dr.zeros(mi.Float, 3 * count)
        normals = [normals_of(m) if has_interpolated_normals(m) else none(m.vertex_count()) for m in self.meshes]
        return _concat([*normals, none(self.line_vertices)] if self._all_lines else normals)


# ---------------------- Arrays, in both interfaces; attached where those of the mesh are ----------------------


def positions_of(mesh: Any) -> mi.Float:
    """Positions of the vertices: (3 V,), world space, scene units."""
    if hasattr(mesh, OLD):
        return mesh.vertex_positions_buffer()
    return _of_vertices(mesh.positions(), mesh.position_index())


def normals_of(mesh: Any) -> mi.Float:
    """Normals of the vertices: (3 V,), world space. They need not have the length 1."""
    if hasattr(mesh, OLD):
        return mesh.vertex_normals_buffer()
    return _of_vertices(mesh.normals(), mesh.normal_index())


def texcoords_of(mesh: Any) -> mi.Float:
    """Texture coordinates of the vertices: (2 V,)."""
    return mesh.vertex_texcoords_buffer() if hasattr(mesh, OLD) else mesh.texcoords().array


def faces_of(mesh: Any) -> mi.UInt32:
    """Vertices of the triangles: (3 F,)."""
    return mesh.faces_buffer() if hasattr(mesh, OLD) else mi.UInt32(mesh.faces().array)


def attribute_of(mesh: Any, name: str) -> mi.Float:
    """An attribute of the vertices or faces: (K V,) or (K F,)."""
    return mesh.attribute_buffer(name) if hasattr(mesh, OLD) else mesh.attribute(name).array


def has_normals(mesh: Any) -> bool:
    """Does the mesh store normals of its vertices?"""
    return mesh.has_vertex_normals() if hasattr(mesh, OLD) else mesh.has_normals()


def has_texcoords(mesh: Any) -> bool:
    """Does the mesh store texture coordinates?"""
    return mesh.has_vertex_texcoords() if hasattr(mesh, OLD) else mesh.has_texcoords()


def is_flipped(mesh: Any) -> bool:
    """Do normals point against the side that the order of the vertices makes the front? Never in Mitsuba 3.10, which
    turns the faces round."""
    return mesh.has_flipped_normals() if hasattr(mesh, OLD) else False


def is_moving(mesh: Any) -> bool:
    """Do the positions carry a gradient?"""
    return dr.grad_enabled(mesh.vertex_positions_buffer() if hasattr(mesh, OLD) else mesh.positions())


def is_positions_key(key: str) -> bool:
    """Does a parameter of a scene hold the positions of a mesh? ``vertex_positions``, (3 V,), or since Mitsuba 3.10
    ``positions``, (P, 3)."""
    return key.rpartition(".")[2] in ("vertex_positions", "positions")


def positions_key(params: Any) -> str:
    """The name of the positions among the parameters of a mesh."""
    return next(key for key in params.keys() if is_positions_key(key))  # noqa: SIM118 (no dictionary)


def present_key(params: Any, key: str) -> str:
    """A key of `params`, or for the name of positions or normals in one interface that of the other."""
    body, dot, name = key.rpartition(".")
    short = name.removeprefix("vertex_")
    if key in params or short not in ("positions", "normals"):
        return key
    other = body + dot + (f"vertex_{name}" if short == name else short)
    return other if other in params else key


def points(value: Any) -> mi.Point3f:
    """A parameter of positions or normals, in either interface, as points: (P,), attached if it is."""
    return dr.unravel(mi.Point3f, value.array if dr.is_tensor_v(value) else value)


def as_parameter(rows: np.ndarray | mi.Float, like: Any) -> Any:
    """Positions or normals, (P, 3) or flat, as the type of the parameter `like` wants them; attached if they are.
    NumPy's are copied into Dr.Jit's memory."""
    if isinstance(rows, np.ndarray):
        rows = mi.Float(np.asarray(rows, np.float32).ravel())
        dr.make_opaque(rows)
    return type(like)(rows, (dr.width(rows) // 3, 3)) if dr.is_tensor_v(like) else rows


def faces_of_positions(params: Any, key: str) -> np.ndarray:
    """Triangles by the rows of the parameter `key` of positions, which vertices of Mitsuba 3.10 share: (F, 3), uint32,
    on the host."""
    sibling = lambda name: f"{key.rpartition('.')[0]}.{name}".lstrip(".")
    found = np.array(params[sibling("faces")], np.uint32).reshape(-1, 3)
    shared = sibling("position_index")
    return np.array(params[shared], np.uint32)[found] if shared in params and dr.width(params[shared]) else found


def make_mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    bsdf: mi.BSDF | None = None,
    attributes: dict[str, np.ndarray] | None = None,
) -> mi.Mesh:
    """A mesh with normals of its vertices.

    vertices : (V, 3), world space. faces : (F, 3). normals : (V, 3); None: as Mitsuba makes them. attributes : by name,
        such as ``vertex_color``: (V, K).
    """
    props = mi.Properties()
    if bsdf is not None:
        props["mesh_bsdf"] = bsdf
    faces = faces.astype(np.uint32)
    attributes = {k: np.asarray(v, np.float32).reshape(len(vertices), -1) for k, v in (attributes or {}).items()}
    if hasattr(mi.Mesh, OLD):
        mesh = mi.Mesh(name, len(vertices), len(faces), props, has_vertex_normals=True)
        for key, values in attributes.items():
            mesh.add_attribute(key, values.shape[1], values.ravel())
        params = mi.traverse(mesh)
        params["faces"] = mi.UInt32(faces.ravel())
        params["vertex_positions"] = as_parameter(vertices, mi.Float())
        params.update()
        if normals is not None:  # after the positions, an update of which makes normals anew
            params["vertex_normals"] = as_parameter(normals, mi.Float())
            params.update()
        return mesh
    props.set_id(name)
    mesh = mi.Mesh(props)
    tensor = lambda rows: as_parameter(rows, mi.TensorXf())
    mesh.from_fields(
        mi.TensorXu(faces), tensor(vertices), tensor(np.zeros_like(vertices) if normals is None else normals)
    )
    for key, values in attributes.items():
        mesh.add_attribute(key, mi.TensorXf(values))
    if normals is None:
        mesh.recompute_normals()
    return mesh


def attribute_names(mesh: Any, of: str = "vertex_") -> list[str]:
    """Names of the attributes of the vertices, or ``face_`` of the faces."""
    return [name for name in mi.traverse(inner(mesh)).properties if name.startswith(of) and name not in NO_ATTRIBUTES]


def _of_vertices(values: mi.TensorXf, index: mi.UInt32) -> mi.Float:
    """(3 V,) of the rows (P, 3) that `index` names."""
    if dr.width(index) == 0:
        return values.array
    return dr.ravel(dr.gather(mi.Point3f, values.array, index))


# ---------------------- What meshes are like ----------------------


def faces(mesh: Any) -> np.ndarray:
    """Vertex indices of the triangles of a mesh: (F, 3), uint32, on the host."""
    return np.array(faces_of(mesh)).reshape(-1, 3)


def vertices(mesh: Any) -> np.ndarray:
    """Vertex positions of a mesh: (V, 3), world space, on the host, detached."""
    return np.array(dr.detach(positions_of(mesh))).reshape(-1, 3)


def texture_coordinates(mesh: Any) -> np.ndarray:
    """Texture coordinates of a mesh: (V, 2), on the host, detached; or (V, 0)."""
    if not has_texcoords(mesh):
        return np.zeros((mesh.vertex_count(), 0), np.float32)
    return np.array(dr.detach(texcoords_of(mesh))).reshape(-1, 2)


def vertex_values(mesh: Any) -> np.ndarray:
    """What a mesh interpolates between its vertices besides normals, texture coordinates and attributes: (V, K), on the
    host, detached."""
    attributes = [np.array(values).reshape(mesh.vertex_count(), -1) for values in vertex_attributes(mesh).values()]
    return np.concatenate([texture_coordinates(mesh), *attributes], axis=1)


def vertex_attributes(mesh: Any) -> dict[str, mi.Float]:
    """Attributes of the vertices of a mesh, by name: each (K V,), detached."""
    return {name: dr.detach(attribute_of(mesh, name)) for name in attribute_names(mesh)}


def has_interpolated_normals(mesh: Any) -> bool:
    return has_normals(mesh) and not mesh.has_face_normals()


def is_smooth(mesh: Any) -> bool:
    """Do interpolated normals other than their own shade faces of the mesh, as it is now? (`Sources` asks again.)"""
    return has_interpolated_normals(mesh) and bool(dr.any(bent_faces(mesh))[0])


def bent_faces(mesh: Any) -> mi.Bool:
    """Which faces of a mesh with interpolated normals are shaded with others than their own: (F,), detached. Not those
    of `cube`, whose vertices are split."""
    p, n = dr.detach(positions_of(mesh)), dr.detach(normals_of(mesh))
    face = 3 * dr.arange(mi.UInt32, mesh.face_count())
    vertices = [dr.gather(mi.UInt32, faces_of(mesh), face + k) for k in range(3)]
    a, b, c = (dr.gather(mi.Point3f, p, v) for v in vertices)
    own = dr.cross(b - a, c - a)
    bent = mi.Bool(False)
    for v in vertices:
        # Normals need not have the length 1. Those that are not finite are bent; faces without area are not.
        normal = dr.gather(mi.Normal3f, n, v)
        bent |= ~(dr.norm(dr.cross(normal, own)) <= BENT * dr.norm(normal) * dr.norm(own))
    return bent


def bends_light(shape: Any) -> bool:
    """Does light go through a surface, refracted or scattered?"""
    return shape.bsdf() is not None and bool(shape.bsdf().flags() & mi.BSDFFlags.Transmission & ~mi.BSDFFlags.Null)


def lets_rays_through(shape: Any) -> bool:
    """Can rays go through a surface as if nothing was there? (Mitsuba's `hair` says so, but they never do.)"""
    bsdf = shape.bsdf()
    return bsdf is not None and bool(bsdf.flags() & mi.BSDFFlags.Null) and bsdf.class_name() != "Hair"


def has_normal_map(shape: Any) -> bool:
    """Is a shape shaded by other normals than its own, or those of its vertices?"""
    return any(isinstance(o, mi.BSDF) and is_map(o) for o in objects_below(inner(shape)).values())


def is_map(bsdf: mi.BSDF) -> bool:
    """Does it shade by normals of its own?"""
    return bsdf.class_name() in ("BumpMap", "NormalMap")


def has_place(texture: Any) -> bool:
    """Is it a texture that varies over texture coordinates?"""
    kinds = ("Bitmap", "Checkerboard")
    return isinstance(texture, mi.Texture) and texture.class_name().startswith(kinds) and texture.is_spatially_varying()


def _concat(buffers: list[mi.Float]) -> mi.Float:
    if not buffers:
        return dr.zeros(mi.Float, 3)
    return buffers[0] if len(buffers) == 1 else dr.concat(buffers)


def inner(shape: Any) -> Any:
    """A shape itself; of a mesh as an instance shows it (`MeshOfInstance`), the mesh in the shape group; of
    `SurfaceOfGrid`, the grid."""
    return getattr(shape, "inner", shape)


def number_of(shape: Any) -> int:
    """By which Dr.Jit tells a shape from others."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def pointer(shape: Any) -> mi.ShapePtr:
    """To a shape; to the instance that shows a mesh (`MeshOfInstance`), or the grid of a `SurfaceOfGrid`."""
    return mi.ShapePtr(getattr(shape, "instance", inner(shape)))


def is_met(met: mi.PreliminaryIntersection3f | mi.SurfaceInteraction3f, pointer: mi.ShapePtr) -> mi.Bool:
    """Is it this shape, or this instance, that a ray has met?"""
    return (met.shape == pointer) | (met.instance == pointer)


def surfaces(scene: mi.Scene) -> list[Any]:
    """All shapes that can be met: those of the scene, and in place of instances those in shape groups."""
    shapes = [s for s in scene.shapes() if s.class_name() != "Instance"]
    if len(shapes) == len(scene.shapes()):
        return shapes
    return [*shapes, *(s for group in shape_groups(scene) for s in group)]


def shape_groups(scene: mi.Scene) -> list[list[Any]]:
    """The shapes in each shape group of a scene."""
    return [shapes for _, shapes in named_shape_groups(scene)]


def named_shape_groups(scene: mi.Scene) -> list[tuple[str, list[Any]]]:
    """The identifier of each shape group of a scene, and the shapes in it."""
    groups = [o for o in objects_below(scene).values() if o.class_name() == "ShapeGroupPlugin"]
    inside = lambda g: [s for s in objects_below(g).values() if isinstance(s, mi.Shape) and s is not g]
    return [(g.id(), inside(g)) for g in groups]


def tells_shapes_in_groups() -> bool:
    """Does Mitsuba tell which shape of a group a ray meets, as on GPUs, or its number in the group only?"""
    return mi.variant().startswith(("cuda", "metal"))


def objects_below(root: mi.Object) -> dict[str, Any]:
    """All objects below `root`, and it, each once; by name, as `mi.traverse` makes names."""
    found = {"": root}
    seen = {id(root)}

    # A class is garbage that refers to itself, which only Python's collector frees: it must not hold the objects, since
    # Dr.Jit 1.5 may abort if those of a scene are freed while another one is traced.
    class Children(mi.TraversalCallback):
        def __init__(self, parent: str, found: dict[str, Any], seen: set[int]):
            super().__init__()
            self.parent, self.found, self.seen = parent, found, seen

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object) and id(value) not in self.seen:
                self.seen.add(id(value))
                key = f"{self.parent}.{value.id() if isinstance(value, mi.Shape) else name}".lstrip(".")
                while key in self.found:
                    key += "'"
                self.found[key] = value

        put_value = put_object = put

    queue = [""]
    for name in queue:  # grows as it goes
        before = len(found)
        found[name].traverse(Children(name, found, seen))
        queue += list(found)[before:]
    return found
