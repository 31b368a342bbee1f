"""The surface of an `sdfgrid`, divided into triangles, whose edges stand for its silhouettes.

Inside of a voxel, Mitsuba interpolates the values of the grid trilinearly. The surface f = 0 meets each edge of the
voxel where a linear function vanishes, and each of its faces in a hyperbola: there, the surface is bent. So the places
on edges of voxels are vertices, those on one face are joined by a line, and the lines of a voxel form loops. From the
middle of each, brought to f = 0, triangles go to its lines.

Vertices follow the values of the grid, and the shape: on the edge of a voxel, p = a + (b − a) f_a / (f_a − f_b); in the
middle, by one step of Newton's method, p − f(p) ∇f / |∇f|².
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .grid_triangles import Triangles, triangulate
from .meshes import Geometry

#: How far from where smooth normals have it the outline is sought: in voxels, times the angle by which the surface
#: turns there over one.
WINDOW = 0.5


def _uint(numbers: np.ndarray) -> mi.UInt32:
    """(Not in NumPy's memory, for frozen functions.)"""
    return mi.UInt32(np.ascontiguousarray(numbers, dtype=np.uint32)) + dr.opaque(mi.UInt32, 0)


class SurfaceOfGrid:
    """The triangles of an `sdfgrid`. What `geometry/meshes.py` asks of a mesh, it answers.

    Rays meet the shape itself: its triangles only tell where edges are.

    inner : the shape.
    """

    DRJIT_STRUCT = dict.fromkeys(("_ends", "_axis", "_corners", "_middle", "_faces"))  # for `dr.freeze`

    def __init__(self, inner: Any):
        self.inner = inner
        self._values: mi.Float | None = None
        self._triangles: Triangles | None = None
        self._placed: tuple[list[mi.Float], mi.Float] = ([], mi.Float(0))
        self._smooth: bool | None = None

    # ---------------------- The triangles, as the values are now ----------------------

    def _renew(self) -> Triangles:
        """Find the triangles, if the grid is no longer the same. Reads from the device: not in frozen functions."""
        if dr.flag(dr.JitFlag.FreezingScope):
            assert self._triangles is not None
            return self._triangles
        grid = mi.traverse(self.inner)["grid"]
        values = dr.detach(grid.array)
        if self._values is not None and values.index == self._values.index:
            return self._triangles
        self._values, self.size = values, grid.shape[0]
        found, before = triangulate(values.numpy().reshape(grid.shape[:3])), self._triangles
        same = before is not None and before.faces.shape == found.faces.shape and (before.faces == found.faces).all()
        same = same and before.ends.shape == found.ends.shape and (before.ends == found.ends).all()
        if not (same and (before.corners == found.corners).all()):
            self._triangles = found
            self._ends = [_uint(found.ends[:, k]) for k in (0, 1)]
            self._axis = _uint(found.axis)
            self._corners = [_uint(found.corners[:, k]) for k in range(8)]
            self._middle = [mi.Float(found.middle[:, k].astype(np.float32)) * dr.opaque(mi.Float, 1) for k in range(3)]
            self._faces = _uint(found.faces.ravel())
        return self._triangles

    @property
    def slack(self) -> np.ndarray:
        """How far about each vertex the triangles are from the surface: (V,), scene units, on the host."""
        matrix = np.array(dr.detach(mi.traverse(self.inner)["to_world"].matrix), float).reshape(4, 4)[:3, :3]
        return self._renew().slack * (np.linalg.svd(matrix, compute_uv=False)[0] / (self.size - 1))

    def lines(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The lines on faces of voxels: their vertices, (L, 2); the axis across the face; and how far from them, in the
        face, the surface is: scene units. On the host."""
        found = self._renew()
        return found.lines, found.across, found.sag * self.voxel

    @property
    def window(self) -> np.ndarray:
        """How far from where smooth normals have it the outline may be, about each vertex: (V,), scene units, on the
        host."""
        return WINDOW * self.voxel * self._renew().bend

    @property
    def voxel(self) -> float:
        """The longest side of a voxel: scene units."""
        return voxel_of(self.inner)

    @property
    def on_faces(self) -> int:
        """Vertices below this number lie on edges of voxels: lines between two of them, on faces of voxels."""
        return len(self._renew().ends)

    def _place(self, values: mi.Float, matrix: mi.Matrix4f) -> mi.Float:
        """The vertices, world space: (3 V,); attached to the values and to `to_world`."""
        n = self.size
        cell = lambda i: mi.Vector3f(mi.Float(i % n), mi.Float((i // n) % n), mi.Float(i // (n * n)))
        at = lambda i: dr.gather(mi.Float, values, i)
        first, second = (at(e) for e in self._ends)
        part, base = first / (first - second), cell(self._ends[0])
        along = [dr.select(self._axis == k, part, 0) for k in range(3)]
        on_edges = base + mi.Vector3f(*along)
        if dr.grad_enabled(values) and self._is_smooth():
            # Outlines follow the normal. (On the edge of a voxel that is nearly tangent to the surface, a place moves
            # fast.) Creases stay on the faces of voxels; but where normals are smooth, they do not count.
            with dr.suspend_grad():
                slope = self._slope(dr.detach(values))
            off = dr.lerp(first, second, dr.detach(part))
            on_edges = dr.replace_grad(dr.detach(on_edges), -(off / dr.squared_norm(slope)) * slope)
        corner = [at(c) for c in self._corners]
        with dr.suspend_grad():
            held = [dr.detach(c) for c in corner]
            u = self._onto_surface(held)
            gradient = _value(held, u)[1]
        value = _value(corner, u)[0]
        u = dr.replace_grad(u, -(value / dr.squared_norm(gradient)) * gradient)
        inside = cell(self._corners[0]) + u
        local = [dr.concat([x, y]) / (n - 1) for x, y in zip(on_edges, inside, strict=True)]
        return dr.ravel(mi.AffineTransform4f(matrix) @ mi.Point3f(*local))

    def _onto_surface(self, corner: list[mi.Float]) -> mi.Vector3f:
        """Where the vertices in the middle of loops are, in voxels with these values at their corners. Detached."""
        u = mi.Vector3f(*self._middle)
        for _ in range(2):
            value, gradient = _value(corner, u)
            u = u - gradient * (value / dr.squared_norm(gradient))
        return u

    def _slope(self, values: mi.Float) -> mi.Vector3f:
        """Mean gradient of the values, by voxels, in the voxels around each vertex that lies on an edge."""
        n, found = self.size, []
        first, second = self._ends
        at = lambda i: dr.gather(mi.Float, values, i)
        part = at(first) / (at(first) - at(second))
        for k in range(3):
            place = (first // n**k) % n
            up, down = (dr.select(inside, mi.UInt32(1), 0) for inside in (place < n - 1, place > 0))
            above, below = (dr.lerp(at(first + s), at(second + s), part) for s in (up * n**k, -down * n**k))
            found.append(dr.select(self._axis == k, at(second) - at(first), (above - below) / mi.Float(up + down)))
        return mi.Vector3f(*found)

    # ---------------------- What Mitsuba's meshes answer ----------------------

    def vertex_positions_buffer(self) -> mi.Float:
        self._renew()
        params = mi.traverse(self.inner)
        values, matrix = params["grid"].array, params["to_world"].matrix
        if dr.flag(dr.JitFlag.FreezingScope):
            return self._place(values, matrix)
        made_of = [dr.detach(values), *(mi.Float(dr.detach(matrix)[i, j]) for i in range(3) for j in range(4))]
        held, placed = self._placed
        if [a.index for a in held] != [a.index for a in made_of]:
            with dr.suspend_grad():
                placed = self._place(dr.detach(values), dr.detach(matrix))
                dr.eval(placed)
            self._placed = made_of, placed
        return dr.replace_grad(placed, self._place(values, matrix)) if dr.grad_enabled(values, matrix) else placed

    def vertex_normals_buffer(self) -> mi.Float:
        """None that differ from those of faces: where smooth normals turn away, they are turned to the viewer."""
        return dr.zeros(mi.Float, 3 * self.vertex_count())

    def gradients(self) -> mi.Float:
        """Along the normals of the surface, which are the same on all triangles about a vertex: (3 V,), world space.
        Detached. Of those at vertices on edges of voxels, which have several, the mean over these voxels."""
        with dr.suspend_grad():
            self._renew()
            params = mi.traverse(self.inner)
            values, to_world = dr.detach(params["grid"].array), dr.detach(params["to_world"])
            on_edges = self._slope(values)
            corner = [dr.gather(mi.Float, values, c) for c in self._corners]
            u = self._onto_surface(corner)
            inside = _value(corner, u)[1]
            n = [dr.concat([x, y]) for x, y in zip(on_edges, inside, strict=True)]
            return dr.ravel(dr.normalize(to_world @ mi.Normal3f(*n)))

    def faces_buffer(self) -> mi.UInt32:
        self._renew()
        return self._faces

    def vertex_count(self) -> int:
        found = self._renew()
        return len(found.ends) + len(found.corners)

    def face_count(self) -> int:
        return len(self._renew().faces)

    def has_vertex_normals(self) -> bool:
        return self._is_smooth()

    def has_face_normals(self) -> bool:
        return not self._is_smooth()

    def has_vertex_texcoords(self) -> bool:
        return False

    def has_flipped_normals(self) -> bool:
        return False

    def is_mesh(self) -> bool:
        return False

    def _is_smooth(self) -> bool:
        """Do other normals than those of the surface shade it? Mitsuba does not tell, but shows."""
        if self._smooth is None:
            with dr.suspend_grad():
                self._renew()
                pi = dr.zeros(mi.PreliminaryIntersection3f, len(self._triangles.corners))
                pi.t, pi.shape, pi.valid = mi.Float(1), mi.ShapePtr(self.inner), mi.Bool(True)
                params = mi.traverse(self.inner)
                place = self._place(dr.detach(params["grid"].array), dr.detach(params["to_world"].matrix))
                p = dr.gather(mi.Point3f, place, self.on_faces + dr.arange(mi.UInt32, dr.width(pi.t)))
                d = mi.Vector3f(0, 0, 1)
                si = pi.compute_surface_interaction(mi.Ray3f(p - d, d), mi.RayFlags.All)
                self._smooth = bool(dr.any(dr.norm(dr.cross(si.n, si.sh_frame.n)) > 1e-4)[0])
        return self._smooth

    def __getattr__(self, name: str) -> Any:
        if name in ("id", "bbox", "ptr", "bsdf", "class_name", "is_emitter"):
            return getattr(self.inner, name)
        raise AttributeError(name)


def _value(corner: list[mi.Float], u: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
    """Trilinear value and gradient at places u of voxels, by voxels."""
    c, (x, y, z) = corner, u
    low = [dr.lerp(c[k], c[k + 1], x) for k in (0, 2, 4, 6)]  # at (y, z) = 00, 10, 01, 11
    dx = [c[k + 1] - c[k] for k in (0, 2, 4, 6)]
    plane = lambda v: dr.lerp(dr.lerp(v[0], v[1], y), dr.lerp(v[2], v[3], y), z)
    bottom, top = dr.lerp(low[0], low[1], y), dr.lerp(low[2], low[3], y)
    dy = dr.lerp(low[1] - low[0], low[3] - low[2], z)
    return dr.lerp(bottom, top, z), mi.Vector3f(plane(dx), dy, top - bottom)


def is_grid(mesh: Any) -> bool:
    """Do its triangles stand for the surface of a grid, which rays meet in their place?"""
    return isinstance(mesh, SurfaceOfGrid)


def grids_of(geometry: Geometry) -> tuple[SurfaceOfGrid, ...]:
    return tuple(m for m in geometry.meshes if is_grid(m))


def normals(geometry: Geometry) -> mi.Float:
    """As `Geometry.normals`; of grids, those of their surfaces."""
    if not grids_of(geometry):
        return geometry.normals()
    start, parts, known = 0, [], geometry.normals()
    for m in geometry.meshes:
        count = 3 * m.vertex_count()
        own = m.gradients() if is_grid(m) else dr.gather(mi.Float, known, start + dr.arange(mi.UInt32, count))
        parts.append(own)
        start += count
    return dr.concat([*parts, dr.zeros(mi.Float, 3 * geometry.line_vertices)] if geometry.line_vertices else parts)


def slack_of(geometry: Geometry) -> np.ndarray:
    """How far about each vertex the surface that is rendered may be from the triangles: (V,), scene units, on the host;
    0 but for grids."""
    slack = [m.slack if is_grid(m) else np.zeros(m.vertex_count()) for m in geometry.meshes]
    return np.concatenate([*slack, np.zeros(geometry.line_vertices)])


def creases_of(geometry: Geometry, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of edges with these vertices, (E, 2): if they are lines on faces of voxels, how far from them, in the face, the
    surface is, scene units, and the axis across the face; else −1 and 0. On the host."""
    sag, across, start = np.full(len(ends), -1.0), np.zeros(len(ends), np.uint32), 0
    wanted = np.sort(ends.astype(np.int64), axis=1)
    for m in geometry.meshes:
        count = m.vertex_count()
        if is_grid(m):
            lines, axis, off = m.lines()
            key, of = (a[:, 0] * count + a[:, 1] for a in (lines, wanted - start))
            at = np.minimum(np.searchsorted(key, of), len(key) - 1)
            here = ((wanted >= start) & (wanted < start + count)).all(1) & (key[at] == of)
            sag[here], across[here] = off[at[here]], axis[at[here]]
        start += count
    return sag, across


class Grids:
    """Finds the grids of a scene, and keeps their triangles, so that frozen functions need not look for them."""

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`

    def __init__(self) -> None:
        self._surfaces: list[SurfaceOfGrid] = []

    def geometry(self, geometry: Geometry) -> Geometry:
        """The shapes, with the surfaces of grids among the meshes. (Of a grid that is no cube, Mitsuba 3.9 confuses
        the axes.)"""
        grids = [s for s in geometry.others if s.class_name() == "SDFGrid" and is_cubic(s)]
        if not grids:
            return geometry
        if [id(s) for s in grids] != [id(s.inner) for s in self._surfaces]:
            self._surfaces = [SurfaceOfGrid(s) for s in grids]
        known = {id(s) for s in grids}
        others = tuple(s for s in geometry.others if id(s) not in known)
        return replace(geometry, meshes=(*geometry.meshes, *self._surfaces), others=others)


def voxel_of(grid: mi.Shape) -> float:
    """The longest side of a voxel of an `sdfgrid`: scene units."""
    params = mi.traverse(grid)
    matrix = np.array(dr.detach(params["to_world"].matrix), float).reshape(4, 4)[:3, :3]
    return float(np.linalg.norm(matrix, axis=0).max() / (params["grid"].shape[0] - 1))


def is_cubic(shape: Any) -> bool:
    return len(set(mi.traverse(shape)["grid"].shape[:3])) == 1


# ---------------------- Where rays meet it ----------------------


def has_changing_values(shape: Any) -> bool:
    """Do the values of a grid carry a gradient?"""
    return dr.grad_enabled(mi.traverse(shape)["grid"].array)


def slide_on_grid(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, flags, active) -> None:
    """Attach where a ray meets the surface of a grid to its values.

    Mitsuba 3.9 takes the length of their gradient for 1 there. But it knows how a point moves along the normal of the
    surface. The ray meets the surface beside that point, as if another ray met the surface where that stood still.
    """
    moved = pi.compute_surface_interaction(dr.detach(ray), flags | mi.RayFlags.FollowShape, active)
    n = dr.detach(moved.n)
    t = dr.dot(n, moved.p - ray.o) / dr.dot(n, ray.d)
    p = ray(t)
    aside, still = p - moved.p, mi.Ray3f(dr.detach(ray))
    still.o = dr.replace_grad(still.o, dr.select(active, aside, 0))
    slid = pi.compute_surface_interaction(still, flags | mi.RayFlags.DetachShape, active)
    both = lambda a, b: dr.replace_grad(dr.detach(a), (a - dr.detach(a)) + b)
    si.t, si.p = (dr.select(active, dr.replace_grad(dr.detach(x), y), x) for x, y in ((si.t, t), (si.p, p)))
    si.n = dr.select(active, both(moved.n, slid.n), si.n)
    si.sh_frame.n = dr.select(active, both(moved.sh_frame.n, slid.sh_frame.n), si.sh_frame.n)
    si.initialize_sh_frame()
    si.wi = dr.select(active, si.to_local(-ray.d), si.wi)
