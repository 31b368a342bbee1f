"""Outlines of spheres, disks, cylinders and tubes: exact curves, not those of triangles.

The rim of a disk, and the two of a cylinder, are fixed on their shape, like an open edge. The contour of a sphere, and
the two lines along which a cylinder turns away, slide over the shape as the viewer moves. This does not matter: the
motion of a contour across the line of sight is that of the *material* points that lie on it.

Where rims coincide, as where a disk closes a cylinder, one of them stands for all. It has two faces, like an edge
between triangles, and moves as both do on average.

Those of tubes are in `tubes.py`.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from .curve_point import CurvePoint
from .cylinder_rounding import blur
from .tubes import Tubes

if TYPE_CHECKING:
    from .meshes import Geometry


class CurveKind(IntEnum):
    """CONTOUR : of a sphere. RIM : of a disk. BOTTOM, TOP : rims of a cylinder, at z = 0 and 1 of its own frame. LEFT,
    RIGHT : its contour lines. SEAM_… : where texture coordinates jump from 1 to 0, which is no outline. OF_TUBE : see
    `Tubes`."""

    CONTOUR = 0
    RIM = 1
    BOTTOM = 2
    TOP = 3
    LEFT = 4
    RIGHT = 5
    SEAM_OF_SPHERE = 6
    SEAM_OF_DISK = 7
    SEAM_OF_CYLINDER = 8
    OF_TUBE = 9


#: Curves of the shapes with known outlines, by Mitsuba's names of their classes.
CURVES = {
    "Sphere": (CurveKind.CONTOUR,),
    "Disk": (CurveKind.RIM,),
    "Cylinder": (CurveKind.BOTTOM, CurveKind.TOP, CurveKind.LEFT, CurveKind.RIGHT),
}

#: Those that are fixed on their shapes, and may coincide with others (`rims.py`).
RIMS = (CurveKind.RIM, CurveKind.BOTTOM, CurveKind.TOP)

#: Lines on these shapes at which their texture coordinates jump: in the half-plane y = 0, x > 0 of their own frame.
SEAMS = {
    "Sphere": CurveKind.SEAM_OF_SPHERE,
    "Disk": CurveKind.SEAM_OF_DISK,
    "Cylinder": CurveKind.SEAM_OF_CYLINDER,
}

#: Numbers that tell the frame of a shape, and its inverse; and the first of the latter.
NUMBERS, INVERSE = 24, 12

#: Every curve is cut into so many pieces of equal parameter.
PIECES = 16


class Curves:
    """The outlines of analytic shapes, and then of tubes.

    Parameters
    ----------
    shapes : of the classes in `CURVES`.
    joints : rims that coincide, see `Geometry.joints`, by the numbers of `shapes`.
    tubes : of the class `TUBE`.
    seams : are the seams of the texture coordinates of `shapes` among them?
    """

    _OTHER = ("any_joined", "_joined", "_other_kind", "_other_shape")
    _PARTS = ("count", "shapes", "tubes", "_seams", "_first_tube", "_kind", "_shape")
    DRJIT_STRUCT = dict.fromkeys((*_PARTS, *_OTHER))  # for `dr.freeze`

    def __init__(
        self, shapes: tuple[mi.Shape, ...], joints: tuple = (), tubes: tuple[mi.Shape, ...] = (), *, seams: bool = False
    ):
        self.shapes, self._seams = shapes, seams
        #: After the frames of the other shapes come their control points.
        self.tubes = Tubes(tubes, NUMBERS * len(shapes) // 4) if tubes else None
        curves = [(kind, i) for i, s in enumerate(shapes) for kind in CURVES[s.class_name()]]
        curves += [(SEAMS[s.class_name()], i) for i, s in enumerate(shapes)] if seams else []
        second = {joint[0]: joint[1] for joint in joints}
        left_out = {rim for joint in joints for rim in joint[1:]}
        curves = [c for c in curves if c not in left_out]
        #: Number of curves that are of no tubes.
        self._first_tube = len(curves)
        curves += [(CurveKind.OF_TUBE, 0)] * (self.tubes.count if tubes else 0)
        others = [second.get(c, c) for c in curves]
        #: Number of curves.
        self.count = len(curves)
        #: Do rims coincide?
        self.any_joined = bool(second)
        # Not in NumPy's memory, for frozen functions.
        index = lambda rims, k: mi.UInt32([int(c[k]) for c in rims]) * dr.opaque(mi.UInt32, 1)
        self._kind, self._shape = (index(curves, k) for k in (0, 1))
        self._other_kind, self._other_shape = (index(others, k) for k in (0, 1))
        self._joined = (self._kind != self._other_kind) | (self._shape != self._other_shape)

    @staticmethod
    def of(geometry: Geometry, moving: np.ndarray, *, seams: bool = False) -> Curves | None:
        """Those of shapes that move, and of others with which these have a rim in common; None if there are none.

        moving : (S,), bool, of `geometry.analytic`, and then of `geometry.tubes`.
        """
        joints = [joint for joint in geometry.joints if any(moving[i] for _, i in joint)]
        count = len(geometry.analytic)
        tubes = tuple(t for t, m in zip(geometry.tubes, moving[count:], strict=True) if m)
        chosen = sorted({*np.flatnonzero(moving[:count]).tolist(), *(i for joint in joints for _, i in joint)})
        number = {i: k for k, i in enumerate(chosen)}
        renumbered = tuple(tuple((kind, number[i]) for kind, i in joint) for joint in joints)
        if not chosen and not tubes:
            return None
        return Curves(tuple(geometry.analytic[i] for i in chosen), renumbered, tubes, seams=seams)

    def __len__(self) -> int:
        """Number of pieces."""
        return self.count * PIECES

    def frames(self) -> mi.Float:
        """`to_world` of all shapes, attached, and its inverse, detached: 24 numbers each, row by row; and the control
        points of all tubes, attached."""
        rows = []
        for shape in self.shapes:
            to_world = mi.traverse(shape)["to_world"]
            for m in (to_world.matrix, dr.detach(to_world).inverse().matrix):
                rows += [mi.Float(m[i, j]) for i in range(3) for j in range(4)]
        if self.tubes is not None:
            rows.append(self.tubes.control_points())
        return dr.concat(rows)

    def centre(self, frames: mi.Float, curve: mi.UInt32) -> tuple[mi.Point3f, mi.Float]:
        """Centre and radius of a ball around the shape of a curve, or around the segment of a tube. Detached."""
        if self.tubes is None:
            return self._ball(frames, curve)
        on_tube, of_tube, of_shape = self._numbers(curve)
        ball = self.tubes.ball(frames, of_tube)
        return dr.select(on_tube, ball, self._ball(frames, of_shape)) if self.shapes else ball

    def _numbers(self, curve: mi.UInt32) -> tuple[mi.Bool, mi.UInt32, mi.UInt32]:
        """Is it a curve of a tube? Its number among these, and among all others; 0 where it is none."""
        on_tube = curve >= self._first_tube
        return on_tube, dr.select(on_tube, curve - self._first_tube, 0), dr.select(on_tube, 0, curve)

    def _ball(self, frames: mi.Float, curve: mi.UInt32) -> tuple[mi.Point3f, mi.Float]:
        x, y, z, o = self._columns(dr.detach(frames), curve, 0)
        is_cylinder = dr.gather(mi.UInt32, self._kind, curve) >= int(CurveKind.BOTTOM)
        middle = mi.Point3f(o + dr.select(is_cylinder, 0.5 * z, 0))
        return middle, dr.sqrt(dr.squared_norm(x) + dr.squared_norm(y) + dr.squared_norm(z))

    def point(
        self,
        frames: mi.Float,
        piece: mi.UInt32,
        t: mi.Float,
        eye: mi.Point3f,
        far: mi.Bool | bool = False,
        *,
        is_light: bool = False,
    ) -> CurvePoint:
        """The point t in [0, 1) of a piece, as seen from `eye`, world space; or at infinity, in the direction `eye`.

        is_light : do rays go towards the eye, and not from it?
        """
        curve, v = piece // PIECES, (piece % PIECES + t) / PIECES
        if self.tubes is None:
            return self._on_shape(frames, curve, v, eye, far)
        on_tube, of_tube, of_shape = self._numbers(curve)
        point = self.tubes.point(frames, of_tube, v, eye, far, is_light)
        point.tangent /= PIECES
        return dr.select(on_tube, point, self._on_shape(frames, of_shape, v, eye, far)) if self.shapes else point

    def _on_shape(
        self, frames: mi.Float, curve: mi.UInt32, v: mi.Float, eye: mi.Point3f, far: mi.Bool | bool
    ) -> CurvePoint:
        """The point v in [0, 1) of a curve that is of no tube."""
        kind = dr.gather(mi.UInt32, self._kind, curve)
        with dr.suspend_grad():
            x, y, z, o = self._columns(frames, curve, INVERSE)
            e = mi.Vector3f(dr.detach(eye))
            e = x * e.x + y * e.y + z * e.z + dr.select(far, mi.Vector3f(0), o)

            sin, cos = dr.sincos(dr.two_pi * v)
            circle = mi.Vector3f(cos, sin, dr.select(kind == int(CurveKind.TOP), mi.Float(1), 0))
            local, tangent = circle, mi.Vector3f(-sin, cos, 0) * dr.two_pi
            rim = kind == int(CurveKind.RIM)
            inwards = dr.select(rim, -circle, mi.Vector3f(0, 0, 1 - 2 * circle.z))
            valid = mi.Bool(True)

            contour = kind == int(CurveKind.CONTOUR)
            d2 = dr.squared_norm(e)
            s, u = mi.coordinate_system(dr.normalize(e))
            radius = dr.select(far, 1, dr.safe_sqrt(1 - dr.rcp(d2)))
            on_sphere = dr.select(far, mi.Vector3f(0), e / d2) + radius * (s * cos + u * sin)
            local = dr.select(contour, on_sphere, local)
            tangent = dr.select(contour, (u * cos - s * sin) * (radius * dr.two_pi), tangent)
            inwards = dr.select(contour, -local, inwards)
            valid &= ~contour | far | (d2 > 1)

            side = (kind == int(CurveKind.LEFT)) | (kind == int(CurveKind.RIGHT))
            r2 = dr.square(e.x) + dr.square(e.y)
            turn = dr.select(far, 0.5 * dr.pi, dr.safe_acos(dr.rsqrt(r2)))
            sin, cos = dr.sincos(dr.atan2(e.y, e.x) + dr.select(kind == int(CurveKind.LEFT), turn, -turn))
            local = dr.select(side, mi.Vector3f(cos, sin, v), local)
            tangent = dr.select(side, mi.Vector3f(0, 0, 1), tangent)
            inwards = dr.select(side, mi.Vector3f(-cos, -sin, 0), inwards)
            valid &= ~side | ((r2 > 0) & far) | (r2 > 1)
            if self._seams:
                seam, on_seam, along = _seam(kind, v)
                local, tangent = dr.select(seam, on_seam, local), dr.select(seam, along, tangent)
        x, y, z, o = self._columns(frames, curve, 0)
        p = mi.Point3f(x * local.x + y * local.y + z * local.z + o)
        with dr.suspend_grad():
            x, y, z = dr.detach(x), dr.detach(y), dr.detach(z)
            to_world = lambda w: x * w.x + y * w.y + z * w.z
            tangent, inwards = to_world(tangent) / PIECES, to_world(inwards)
        if not self.any_joined:
            return CurvePoint(p, tangent, inwards, inwards, contour | side, valid, mi.Float(0))
        joined, q, other = self._of_second(frames, curve, dr.detach(p))
        p, other = dr.select(joined, 0.5 * (p + q), p), dr.select(joined, other, inwards)
        return CurvePoint(p, tangent, inwards, other, contour | side, valid, mi.Float(0))

    def _of_second(self, frames: mi.Float, curve: mi.UInt32, p: mi.Point3f) -> tuple[mi.Bool, mi.Point3f, mi.Vector3f]:
        """Do rims coincide at points p? Where these are as the second shape moves, and the direction towards that."""
        kind = dr.gather(mi.UInt32, self._other_kind, curve)
        with dr.suspend_grad():
            x, y, z, o = self._columns(frames, curve, INVERSE, self._other_shape)
            local = x * p.x + y * p.y + z * p.z + o
        x, y, z, o = self._columns(frames, curve, 0, self._other_shape)
        q = mi.Point3f(x * local.x + y * local.y + z * local.z + o)
        with dr.suspend_grad():
            upwards = dr.select(kind == int(CurveKind.TOP), -z, z)
            other = dr.detach(dr.select(kind == int(CurveKind.RIM), o - p, upwards))
        return self.joined(curve * PIECES), q, other

    def joined(self, piece: mi.UInt32) -> mi.Bool:
        """Is the piece on rims that coincide?"""
        return dr.gather(mi.Bool, self._joined, piece // PIECES)

    def misses(self, frames: mi.Float, piece: mi.UInt32, ray: mi.Ray3f) -> mi.Bool:
        """Is the piece on a rim of a cylinder, beyond whose contour the ray goes?"""
        if not self.shapes:
            return mi.Bool(False)
        curve = piece // PIECES
        kind = dr.gather(mi.UInt32, self._kind, curve)
        x, y, z, o = self._columns(frames, curve, INVERSE)
        to_local = lambda v: x * v.x + y * v.y + z * v.z
        d, p = to_local(ray.d), to_local(ray.o) + o
        rim = (kind == int(CurveKind.BOTTOM)) | (kind == int(CurveKind.TOP))
        return rim & (dr.square(p.x * d.y - p.y * d.x) > dr.square(d.x) + dr.square(d.y))

    def blur(self, frames: mi.Float, piece: mi.UInt32, start: mi.Point3f) -> mi.Float:
        """How far beside the curves of a cylinder rays that start at a point may find them: scene units. Detached."""
        if not self.shapes:
            return mi.Float(0)
        on_tube, curve = mi.Bool(False), piece // PIECES
        if self.tubes is not None:
            on_tube, _, curve = self._numbers(curve)
        kind = dr.gather(mi.UInt32, self._kind, curve)
        frames, start = dr.detach(frames), dr.detach(start)
        x, y, z, o = self._columns(frames, curve, INVERSE)
        local = x * start.x + y * start.y + z * start.z + o
        x, y, *_ = self._columns(frames, curve, 0)
        r2 = dr.maximum(dr.squared_norm(x), dr.squared_norm(y))
        of_cylinder = ~on_tube & (kind >= int(CurveKind.BOTTOM)) & (kind <= int(CurveKind.RIGHT))
        return dr.select(of_cylinder, blur(dr.sqrt(r2), r2 * (dr.square(local.x) + dr.square(local.y))), 0)

    def _columns(
        self, frames: mi.Float, curve: mi.UInt32, start: int, shapes: mi.UInt32 | None = None
    ) -> list[mi.Vector3f]:
        """Images of the axes, and of the origin. shapes : of all curves, unless it is the first one of each."""
        return self.columns(frames, dr.gather(mi.UInt32, self._shape if shapes is None else shapes, curve), start)

    @staticmethod
    def columns(frames: mi.Float, shape: mi.UInt32, start: int = 0) -> list[mi.Vector3f]:
        """Images of the axes, and of the origin, of the shapes with these numbers; by `to_world`, or, from `INVERSE`
        on, by its inverse."""
        first = shape * NUMBERS + start
        return [mi.Vector3f(*(dr.gather(mi.Float, frames, first + 4 * i + j) for i in range(3))) for j in range(4)]


def _seam(kind: mi.UInt32, v: mi.Float) -> tuple[mi.Bool, mi.Vector3f, mi.Vector3f]:
    """Is it a seam? Its point at v in [0, 1), and the tangent there, both in the frame of the shape."""
    sphere, disk, cylinder = (kind == int(SEAMS[name]) for name in ("Sphere", "Disk", "Cylinder"))
    sin, cos = dr.sincos(dr.pi * v)
    point = dr.select(sphere, mi.Vector3f(sin, 0, cos), dr.select(disk, mi.Vector3f(v, 0, 0), mi.Vector3f(1, 0, v)))
    along = dr.select(disk, mi.Vector3f(1, 0, 0), mi.Vector3f(0, 0, 1))
    along = dr.select(sphere, dr.pi * mi.Vector3f(cos, 0, -sin), along)
    return sphere | disk | cylinder, point, along
