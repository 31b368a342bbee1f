"""Where interpolated normals turn away from the viewer: jumps inside of faces.

On a smooth-shaded mesh the normal that shades, n, is interpolated between the vertices. Just inside of a silhouette it
faces away from the viewer e, although the face does not: what a surface emits or reflects there is zero, or that of its
other side. So the radiance jumps where

    g(p) = n(p) · (e − p) = 0.

On a line in a triangle, this is a quadratic equation, since n and p are linear along it. So each line from a corner c
of the triangle to a point of the side opposite, from a to b, meets the curve where

    p(s, t) = c + t ((1 − s) (a − c) + s (b − c)),        s, t in [0, 1],   g(p(s, t)) = 0.

If g has different signs at the corners, c is the one that is alone with its sign, and nearly every line meets the curve
once. If not, seen from close by, the curve may still enter and leave through one side, to which c is opposite, or close
within the triangle. Then lines meet it twice, once, or not at all.

As vertices, normals and viewer move, t follows by one step of Newton's method, whose derivative is exact.

On the triangles that stand for the surface of a grid (`geometry/grids.py`), the same curve is about its outline. There,
t is held: a point of a smooth surface that is on its outline moves over the film as the outline does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.beside import rounding
from rimlight.edge_sampling.geometry.grids import is_grid
from rimlight.edge_sampling.geometry.meshes import Geometry, is_flipped, is_smooth

#: How far before and behind a point near the outline of a grid its surface is met, in voxels.
REACH = 12, 1.25

#: And just beside its outline: how far before.
BESIDE = 2.0

#: Cosine to the viewer of a normal just beside the horizon.
BESIDE_HORIZON = 1e-4


@dataclass
class Horizon:
    """On which side of such a curve the first vertex of a path is.

    side : mi.Float, (N,); +1: its normal faces the viewer; −1: it faces away; 0: it is as it is.
    p : mi.Point3f, (N,), a point of the curve, or of an edge that such a curve may be close to, world space: what hides
        it is none of its sides.
    on_curve : mi.Bool, (N,), is it one of the curve? Then the normal *just* faces the viewer, or faces away.
    reach : mi.Float, (N,), how far from p, across the surface, besides rounding, what it belongs to may be met.
    """

    side: mi.Float
    p: mi.Point3f
    on_curve: mi.Bool
    reach: mi.Float

    def where(self, active: mi.Bool) -> Horizon:
        """The same, on a side at most there."""
        return replace(self, side=dr.select(active, self.side, 0))


@dataclass
class HorizonPoint:
    """A point of a curve.

    p : mi.Point3f, world space; attached to vertices, normals and viewer.
    tangent : mi.Vector3f, dp/ds. Detached.
    facing : mi.Vector3f, towards where normals face the viewer. Detached.
    normal : mi.Vector3f, that is interpolated there. Detached.
    front : mi.Vector3f, normal of the face, unit length. Detached.
    area : mi.Float, of the surface, over an interval of what is sampled and one of the cosine to the viewer. Detached.
    forward : mi.Float; −1 where the curve runs back, as seen from the viewer, as seldom: there, the triangles of a grid
        hide it, and the surface lies on the other side of it than elsewhere.
    valid : mi.Bool, is there one?
    """

    p: mi.Point3f
    tangent: mi.Vector3f
    facing: mi.Vector3f
    normal: mi.Vector3f
    front: mi.Vector3f
    area: mi.Float
    forward: mi.Float
    valid: mi.Bool


class Horizons:
    """The curves in the faces of smooth-shaded meshes.

    Parameters
    ----------
    geometry : the shapes.
    moving : which of its meshes can move over the film.
    """

    DRJIT_STRUCT = dict.fromkeys(("count", "_corners", "sign", "_number", "_window", "any_grid"))  # for `dr.freeze`

    def __init__(self, geometry: Geometry, moving: np.ndarray):
        self.geometry = geometry
        has_curves = lambda mesh: is_grid(mesh) or is_smooth(mesh)
        smooth = [bool(m) and has_curves(mesh) for mesh, m in zip(geometry.meshes, moving, strict=False)]
        #: (F, 3), their vertices.
        self.faces = faces = geometry.faces(tuple(smooth))
        self._corners = [mi.UInt32(np.ascontiguousarray(faces[:, k])) for k in range(3)] if len(faces) else []
        meshes = [m for m, s in zip(geometry.meshes, smooth, strict=True) if s]
        signs = [
            np.full(m.vertex_count(), (-1 if is_flipped(m) else 1) if s else 0, np.float32)
            for m, s in zip(geometry.meshes, smooth, strict=True)
        ]
        signs.append(np.zeros(geometry.line_vertices, np.float32))
        numbers = [np.arange(m.face_count(), dtype=np.uint32) for m in meshes]
        #: (V,), of each vertex of the geometry: -1 if Mitsuba turns its normal round, 0 where it is not interpolated.
        self.sign = mi.Float(np.concatenate(signs)) * dr.opaque(mi.Float, 1) if meshes else None
        # (Not in NumPy's memory, for frozen functions.)
        self._number = mi.UInt32(np.concatenate(numbers)) + dr.opaque(mi.UInt32, 0) if meshes else None
        #: Number of faces.
        self.count = len(faces)
        #: Are there those of grids? Of each vertex, how far from the curve their outline may be, and the size of a
        #: voxel; 0 of others.
        self.any_grid = any(is_grid(m) for m in meshes)
        sizes = [(m.window, m.voxel) if is_grid(m) else (0, 0) for m in geometry.meshes]
        counts = [m.vertex_count() for m in geometry.meshes]
        of_vertices = lambda k: [np.broadcast_to(s[k], n) for s, n in zip(sizes, counts, strict=True)]
        number = lambda a: mi.Float(np.concatenate([*a, np.zeros(geometry.line_vertices)]).astype(np.float32))
        self._window = [number(of_vertices(k)) * dr.opaque(mi.Float, 1) for k in (0, 1)] if self.any_grid else None

    def __len__(self) -> int:
        return self.count

    def _face(self, positions: mi.Float, normals: mi.Float, face: mi.UInt32) -> tuple[list, list]:
        """Corners of faces, and the normals there, not normalised, as Mitsuba has them."""
        corners = [dr.gather(mi.UInt32, c, face) for c in self._corners]
        sign = dr.gather(mi.Float, self.sign, corners[0])
        p = [dr.gather(mi.Point3f, positions, c) for c in corners]
        return p, [sign * dr.gather(mi.Vector3f, normals, c) for c in corners]

    def chords(
        self, positions: mi.Float, normals: mi.Float, face: mi.UInt32, eye: mi.Point3f, far: bool, radius: mi.Float
    ) -> tuple[mi.Point3f, mi.Point3f, mi.Bool]:
        """About where the curve is: where it enters and leaves the face. The longest side, if it does not part the
        corners, or if there is none, but may be one as seen from another point of the lens. Detached.

        eye : world space; or, if `far`, the direction towards the viewer. radius : of the lens around it.

        Returns
        -------
        a, b : the end points. valid : mi.Bool, may there be a curve?
        """
        with dr.suspend_grad():
            p, n = self._face(positions, normals, face)
            near = mi.Bool(False)
            for q, normal in zip(p, n, strict=True):
                near |= dr.abs(_towards(q, normal, eye, far)) <= dr.norm(normal) * radius
            p, n, mixed, there = _arrange(p, n, eye, far)
            ends = []
            for s in (mi.Float(0), mi.Float(1)):
                D, N = dr.lerp(p[1] - p[0], p[2] - p[0], s), dr.lerp(n[1] - n[0], n[2] - n[0], s)
                first, second = _roots(p[0], n[0], D, N, eye, far)
                ends.append(p[0] + dr.clip(dr.select(_inside(first), first, second), 0, 1) * D)
            longest = dr.squared_norm(p[2] - p[0]) > dr.squared_norm(p[1] - p[0])
            sides = p[0], dr.select(longest, p[2], p[1])
            return *(dr.select(mixed, c, side) for c, side in zip(ends, sides, strict=True)), there | near

    def point(
        self, positions: mi.Float, normals: mi.Float, face: mi.UInt32, u: mi.Float, eye: mi.Point3f, far: bool
    ) -> HorizonPoint:
        """The point u in [0, 1) of the curve in a face. `positions`, `normals` and `eye` may be attached."""
        p, n = self._face(positions, normals, face)
        with dr.suspend_grad():
            front = dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
        p, n, _, valid = _arrange(p, n, dr.detach(eye), far)
        D, N = dr.lerp(p[1] - p[0], p[2] - p[0], u), dr.lerp(n[1] - n[0], n[2] - n[0], u)
        with dr.suspend_grad():
            first, second = _roots(p[0], n[0], D, N, eye, far)
            # If the line meets the curve twice, one of both, by what the choice of s has left of the random number.
            both = _inside(first) & _inside(second) & (first != second)
            lower = u * 4096 - dr.floor(u * 4096) < 0.5
            t = dr.select(dr.select(both, lower, _inside(first)), first, second)
            valid &= _inside(t)
            t = dr.select(valid, t, 0)
            normal, point = n[0] + t * N, p[0] + t * D
            view, moves = (mi.Vector3f(eye), 0) if far else (mi.Vector3f(eye - point), 1)
            g_t = dr.dot(N, view) - moves * dr.dot(normal, D)
            g_s = t * (dr.dot(n[2] - n[1], view) - moves * dr.dot(normal, p[2] - p[1]))
            tangent = t * mi.Vector3f(p[2] - p[1]) - (g_s / g_t) * mi.Vector3f(D)
            tangent *= dr.select(both, mi.Float(2), 1)
            length2 = dr.squared_norm(tangent)
            valid &= (g_t != 0) & dr.isfinite(length2) & (length2 > 0)
            facing = mi.Vector3f(D) * dr.sign(g_t)
            area = dr.norm(dr.cross(tangent, facing)) * dr.norm(normal) * dr.norm(view) / dr.abs(g_t)
            turns = [dr.dot(dr.cross(tangent, m), v) for m, v in ((normal, view), (front, facing))]
            forward = dr.sign(turns[0]) * dr.sign(turns[1])
        now = _towards(p[0] + t * D, n[0] + t * N, eye, far)
        follows = t - dr.select(valid, (now - dr.detach(now)) / dr.select(valid, dr.detach(g_t), 1), 0)
        if self.any_grid:
            follows = dr.select(self.is_of_grid(face), t, follows)
        detached = (dr.detach(v) for v in (tangent, facing, normal, front, area, forward))
        return HorizonPoint(mi.Point3f(p[0] + follows * D), *detached, valid)

    def is_of_grid(self, face: mi.UInt32) -> mi.Bool:
        """Which faces stand for the surface of a grid?"""
        return self.window(face)[1] > 0 if self.any_grid else mi.Bool(False)

    def meets_grid(
        self,
        face: mi.UInt32,
        p: mi.Point3f,
        n: mi.Vector3f,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        before: float = REACH[0],
    ) -> mi.Bool:
        """Does a ray that passes a point p of the outline of a grid, with the normal n, meet the surface there, or
        before it, at most so many voxels? What is farther behind p is hidden by what ends at the outline."""
        window, voxel = self.window(face)
        aside, behind = dr.abs_dot(dr.normalize(n), si.p - p), dr.dot(si.p - p, ray.d)
        near = (behind >= -before * voxel) & (behind <= REACH[1] * voxel)
        return si.is_valid() & near & (aside <= 2 * window + rounding(p, p))

    def window(self, face: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """How far from the curves in faces of grids their outline may be, and the size of a voxel: scene units; 0 for
        others."""
        if not self.any_grid:
            return mi.Float(0), mi.Float(0)
        corners = [dr.gather(mi.UInt32, c, face) for c in self._corners]
        largest = lambda of: dr.maximum(*(dr.gather(mi.Float, of, c) for c in corners[:2]))
        return tuple(dr.maximum(largest(of), dr.gather(mi.Float, of, corners[2])) for of in self._window)

    def weights(self, positions: mi.Float, normals: mi.Float) -> mi.Float:
        """About how much jumps at the curves of each face, for viewers anywhere: the more, the larger it is, and the
        farther the normals of its vertices are from its own. Detached."""
        p, n = self._face(positions, normals, dr.arange(mi.UInt32, self.count))
        front = dr.cross(p[1] - p[0], p[2] - p[0])
        area, off = dr.norm(front), mi.Float(0)
        for normal in n:
            sine = dr.norm(dr.cross(front, normal)) / (area * dr.norm(normal))
            off = dr.maximum(off, dr.select(dr.isfinite(sine), dr.square(sine), 0))
        return area * (off + dr.epsilon(mi.Float))

    def meets(self, face: mi.UInt32, p: mi.Point3f, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active) -> mi.Bool:
        """Do rays to points of curves meet the faces in which these are? pi : what they meet. Detached."""
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        there = dr.abs_dot(si.n, p - si.p) <= rounding(p, ray.o)
        return si.is_valid() & there & (si.prim_index == dr.gather(mi.UInt32, self._number, face))

    def sees_dark_side(
        self, face: mi.UInt32, p: mi.Point3f, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active
    ) -> mi.Bool:
        """Do rays that pass points of curves on their dark side see the faces in which these are, or at least a surface
        that is dark? Not so beside a silhouette that is closer than the rays look, which has this jump already; nor
        where something hides the face, be it the next one of the same mesh. pi : what the rays meet. Detached."""
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        there = dr.abs_dot(si.n, p - si.p) <= rounding(p, ray.o)
        its_face = there & (si.prim_index == dr.gather(mi.UInt32, self._number, face))
        return si.is_valid() & (its_face | (dr.dot(si.sh_frame.n, ray.d) > 0))


def _towards(p: mi.Point3f, n: mi.Vector3f, eye: mi.Point3f, far: bool) -> mi.Float:
    """g at a point with its normal."""
    return dr.dot(n, mi.Vector3f(eye) if far else mi.Vector3f(eye - p))


def _arrange(p: list, n: list, eye: mi.Point3f, far: bool) -> tuple[list, list, mi.Bool, mi.Bool]:
    """Corners and their normals, with the corner first from which the curve is looked for; does it part the corners;
    and is there one at all? The last two are detached."""
    p, n = list(p), list(n)
    with dr.suspend_grad():
        front = [_towards(q, normal, eye, far) > 0 for q, normal in zip(p, n, strict=True)]
        mixed = (front[0] != front[1]) | (front[0] != front[2])
        dips, closes = [mi.Bool(False)] * 3, mi.Bool(False)
        if not far:
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                roots = _roots(p[i], n[i], p[j] - p[i], n[j] - n[i], eye, far)
                dips[k] = ~mixed & _inside(roots[0]) & _inside(roots[1]) & (roots[0] != roots[1])
            closes = ~mixed & _changes_within(p, n, eye)
        is_first = [
            (front[1] != front[0]) & (front[1] != front[2]) | (dips[1] & ~dips[0]),
            (front[2] != front[0]) & (front[2] != front[1]) | (dips[2] & ~dips[1] & ~dips[0]),
        ]
    for k, taken in zip((1, 2), is_first, strict=True):
        for values in (p, n):
            values[0], values[k] = dr.select(taken, values[k], values[0]), dr.select(taken, values[0], values[k])
    return p, n, mixed, mixed | dips[0] | dips[1] | dips[2] | closes


def _changes_within(p: list, n: list, eye: mi.Point3f) -> mi.Bool:
    """Has g, of triangles at whose corners it has one sign, the other one at its extremum, and is that inside?"""
    D, N, view = [q - p[0] for q in p[1:]], [m - n[0] for m in n[1:]], eye - p[0]
    # g = g₀ + b·x − xᵀ A x, with barycentric coordinates x.
    b = [dr.dot(m, view) - dr.dot(n[0], d) for m, d in zip(N, D, strict=True)]
    first, last = dr.dot(N[0], D[0]), dr.dot(N[1], D[1])
    mixed = 0.5 * (dr.dot(N[0], D[1]) + dr.dot(N[1], D[0]))
    scale = 0.5 / (first * last - dr.square(mixed))
    x, y = scale * (b[0] * last - b[1] * mixed), scale * (b[1] * first - b[0] * mixed)
    g = dr.dot(n[0], view)
    return (x > 0) & (y > 0) & (x + y < 1) & (g * (g + 0.5 * (b[0] * x + b[1] * y)) < 0)


def _inside(t: mi.Float) -> mi.Bool:
    """Written so that NaN is not."""
    return (t >= 0) & (t <= 1)


def _roots(p, n, D, N, eye, far: bool) -> tuple[mi.Float, mi.Float]:
    """Where (n + t N) · (eye − p − t D) = 0; NaN where nowhere. Detached."""
    p, n, D, N, eye = (dr.detach(mi.Vector3f(v)) for v in (p, n, D, N, eye))
    if far:
        t = -dr.dot(n, eye) / dr.dot(N, eye)
        return t, t
    view = eye - p
    A, B, C = -dr.dot(N, D), dr.dot(N, view) - dr.dot(n, D), dr.dot(n, view)
    q = -0.5 * (B + dr.mulsign(dr.sqrt(B * B - 4 * A * C), B))
    return C / q, q / A


def turn_to_side(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, horizon: Horizon, active: mi.Bool | bool = True) -> None:
    """Turn interpolated normals that lie on the horizon of the viewer, but for rounding, to a side of it.

    Does nothing to what hides the point of the horizon, nor, beside edges, to normals that face the right side.
    """
    to_viewer = -ray.d
    cos = dr.dot(si.sh_frame.n, to_viewer)
    there = dr.abs_dot(si.n, horizon.p - si.p) <= rounding(horizon.p, ray.o) + horizon.reach
    turn = active & there & si.is_valid() & (horizon.side != 0) & (horizon.on_curve | (horizon.side * cos <= 0))
    _turn(si, to_viewer, horizon.side, turn)


def turn_to_viewer(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> None:
    """Turn interpolated normals that face away from the viewer, though their faces do not: as at the horizon."""
    to_viewer = -ray.d
    cos = dr.dot(si.sh_frame.n, to_viewer)
    side = dr.sign(dr.dot(si.n, to_viewer) * dr.dot(si.n, si.sh_frame.n))
    _turn(si, to_viewer, side, active & si.is_valid() & (side * cos <= 0))


def _turn(si: mi.SurfaceInteraction3f, to_viewer: mi.Vector3f, side: mi.Float, active: mi.Bool) -> None:
    """Turn interpolated normals just to a side of the horizon, see `Horizon`."""
    n = dr.normalize(si.sh_frame.n + (side * BESIDE_HORIZON - dr.dot(si.sh_frame.n, to_viewer)) * to_viewer)
    si.sh_frame.n = dr.select(active, n, si.sh_frame.n)
    si.initialize_sh_frame()
    si.wi = dr.select(active, si.to_local(to_viewer), si.wi)
