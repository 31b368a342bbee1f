"""Where the near clipping plane of a sensor cuts through spheres, disks and cylinders: in circles, lines and ellipses.

They are found as those of triangles are (`geometry/cut_curves.py`). Nothing lies before them, so they are seen wherever
they are in the frame. Their points move so that they stay on both, on the shape and on the plane.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.common_line import stay_on
from rimlight.edge_sampling.geometry.curves import Curves
from rimlight.edge_sampling.geometry.cut_curves import BOUNDS, arc, conic, interval
from rimlight.edge_sampling.geometry.cut_surfaces import KINDS, TURN, Kind, Surface
from rimlight.edge_sampling.projection.sensors import Projection

#: Where an arc of a curve may begin: at one of the two ends of a cylinder, or anywhere.
SLOTS = 0, 1, BOUNDS


class NearCuts:
    """The cuts through the shapes of some curves."""

    DRJIT_STRUCT = dict.fromkeys(("_curves", "_kind"))  # for `dr.freeze`

    def __init__(self, curves: Curves):
        self._curves = curves
        kinds = [int(KINDS[s.class_name()]) for s in curves.shapes]
        self._kind = mi.UInt32(kinds) * dr.opaque(mi.UInt32, 1)  # not in NumPy's memory, for frozen functions

    def __len__(self) -> int:
        """Number of pieces."""
        return dr.width(self._kind) * len(SLOTS) * TURN

    def _shape(self, frames: mi.Float, piece: mi.UInt32) -> Surface:
        number = piece // (len(SLOTS) * TURN)
        x, y, z, o = (mi.Vector3d(v) for v in self._curves.columns(frames, number))
        return Surface(dr.gather(mi.UInt32, self._kind, number), o, x, y, z)

    def point(
        self, frames: mi.Float, piece: mi.UInt32, t: mi.Float, projection: Projection
    ) -> tuple[mi.Point3f, mi.Vector3f, mi.Bool]:
        """The point t in [0, 1) of a piece, world space; attached. Its derivative by t; and is there one?"""
        row = lambda m: [mi.Float64(m[2, k]) for k in range(4)]
        with dr.suspend_grad():
            shape = self._shape(dr.detach(frames), piece)
            a, b, c, w = row(dr.detach(projection.to_local).matrix)
            plane = mi.Vector3d(a, b, c)
            n = mi.Vector3d(*(dr.dot(plane, v) for v in (shape.x, shape.y, shape.z)))
            size = dr.norm(n)
            d = (projection.near - w - dr.dot(plane, shape.o)) / size
            m, u, v, exists = conic(shape, n / size, d)
            cylinder, disk = shape.is_a(Kind.CYLINDER), shape.is_a(Kind.DISK)
            on_cylinder = lambda x, otherwise=0: dr.select(cylinder, x, otherwise)
            ends = ((1, 0), (-1, 1))
            at = [(on_cylinder(s * u.z), on_cylinder(s * v.z), on_cylinder(s * m.z + w, 1)) for s, w in ends]
            slot = dr.select(piece // TURN % len(SLOTS) == 2, BOUNDS, piece // TURN % len(SLOTS))
            start, span, there = arc(at, slot)
            line_start, line_span = interval(at, dr.safe_sqrt(1 - dr.squared_norm(m)))
            start, span = dr.select(disk, line_start, start), dr.select(disk, line_span, span) / TURN
            valid = exists & dr.select(disk, (slot == 0) & (span > 0), there) & dr.isfinite(span)
            valid &= projection.near > 0  # a fisheye camera has no such plane
            φ = start + span * (mi.Float64(piece % TURN) + mi.Float64(t))
            sin, cos = dr.sincos(φ)
            p = shape.world(m + u * dr.select(disk, φ, cos) + v * dr.select(disk, 0, sin))
            along = u * dr.select(disk, 1, -sin) + v * dr.select(disk, 0, cos)
            tangent = mi.Vector3f(span * (shape.x * along.x + shape.y * along.y + shape.z * along.z))
            p = mi.Point3f(dr.select(valid, p, 0))
        height, normal = self._shape(frames, piece).distance(mi.Vector3d(p))
        depth = (projection.to_local @ p).z - projection.near
        length = dr.norm(plane)
        normals = mi.Vector3f(dr.detach(normal)), mi.Vector3f(plane / length)
        heights = mi.Float(height - dr.detach(height)), (depth - dr.detach(depth)) / mi.Float(length)
        return stay_on(p, normals, heights, valid), tangent, valid
