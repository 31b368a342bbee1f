"""Outlines of `bsplinecurve`: exact curves, not those of triangles.

The surface of such a tube is p(u, φ) = c(u) + r(u) e(φ): circles around a cubic spline c, across its tangent c′. With
α = |c′|² − r c″·e, its normal is N = α e − r′ c′. Seen from o, the outline runs where N·(o − p) = 0, that is,

    α (e·(o − c) − r) = r′ c′·(o − c),

which has two solutions φ for each u. Tubes are open at both ends: their rims are outlines, too, where the wall faces
the viewer. Nothing sees a wall from behind, since Mitsuba's rays go through it. So
what counts of a rim is whether its wall faces the end of the line of sight from which rays are traced.
"""

from __future__ import annotations

from enum import IntEnum

import drjit as dr
import mitsuba as mi
import numpy as np

from .curve_point import CurvePoint

#: Mitsuba's name of the class of such shapes.
TUBE = "BSplineCurve"


class TubeCurve(IntEnum):
    """LEFT, RIGHT : contour lines of a segment. START, END : rims of a tube."""

    LEFT = 0
    RIGHT = 1
    START = 2
    END = 3


#: Steps of Newton's method, which begins at the outline of a tube without curvature.
STEPS = 6

#: Most that one of them may turn: radians.
TURN = 0.5

#: How far from its solution it may end: sine of the angle between N and the plane that is seen edge-on.
SOLVED = 1e-4

#: Cosine from which on a start of Newton's method would be at a point where the derivative is 0.
FLAT = 0.999

#: Lines along a tube on which other shapes are sought, and parts of them for each segment.
LINES = 8

#: How far from its outline Mitsuba may take a tube to be, relative to the radius.
SLACK = 1e-4

#: The same on GPUs, where OptiX meets tubes by a method of its own.
SLACK_ON_GPUS = 1e-3


class Tubes:
    """The outlines of tubes.

    Parameters
    ----------
    shapes : of the class `TUBE`.
    before : how many groups of four numbers come before their control points, in the array that is given.
    """

    DRJIT_STRUCT = dict.fromkeys(("count", "shapes", "_kind", "_first"))  # for `dr.freeze`

    def __init__(self, shapes: tuple[mi.Shape, ...], before: int = 0):
        self.shapes = shapes
        kinds, first, offset = [], [], before
        for shape in shapes:
            params = mi.traverse(shape)
            starts = np.array(params["segment_indices"], np.int64)
            parts = {
                TubeCurve.LEFT: starts,
                TubeCurve.RIGHT: starts,
                TubeCurve.START: starts[~np.isin(starts - 1, starts)],
                TubeCurve.END: starts[~np.isin(starts + 1, starts)],
            }
            for kind, segments in parts.items():
                kinds += [int(kind)] * len(segments)
                first += (segments + offset).tolist()
            offset += params["control_point_count"]
        #: Number of curves.
        self.count = len(kinds)
        # Not in NumPy's memory, for frozen functions.
        self._kind, self._first = (mi.UInt32(values) * dr.opaque(mi.UInt32, 1) for values in (kinds, first))

    def control_points(self) -> mi.Float:
        """Places and radii of the control points of all tubes: four numbers each; attached."""
        return dr.concat([mi.traverse(shape)["control_points"] for shape in self.shapes])

    def ball(self, control: mi.Float, curve: mi.UInt32) -> tuple[mi.Point3f, mi.Float]:
        """Centre and radius of a ball around the segment of a curve. Detached."""
        points = [dr.detach(p) for p in self._control(control, curve)]
        centres, radii = [mi.Point3f(p.x, p.y, p.z) for p in points], [p.w for p in points]
        middle = mi.Point3f(0.5 * (centres[1] + centres[2]))
        radius = mi.Float(0)
        for p, r in zip(centres, radii, strict=True):
            radius = dr.maximum(radius, dr.norm(p - middle) + r)
        return middle, radius

    def point(
        self, control: mi.Float, curve: mi.UInt32, v: mi.Float, eye: mi.Point3f, far: mi.Bool | bool, is_light: bool
    ) -> CurvePoint:
        """The point v in [0, 1) of a curve, as seen from `eye`, world space; or at infinity, in the direction `eye`.

        is_light : do rays go towards the eye? The walls of which they see the rims then face away from it.
        """
        points = self._control(control, curve)
        kind = dr.gather(mi.UInt32, self._kind, curve)
        with dr.suspend_grad():
            rim = kind >= int(TubeCurve.START)
            u = dr.select(rim, dr.select(kind == int(TubeCurve.END), mi.Float(1), 0), v)
            (c, r), (d, r1), (dd, r2), (ddd, _) = (_blend(points, w(u)) for w in (_at, _slope, _bend, _twist))
            d2 = dr.squared_norm(d)
            w = dr.select(far, mi.Vector3f(dr.detach(eye)), dr.detach(eye) - c)
            near = dr.select(far, mi.Float(0), 1)
            x, y = mi.coordinate_system(d * dr.rsqrt(d2))

            def around(φ):
                sin, cos = dr.sincos(φ)
                return x * cos + y * sin, y * cos - x * sin

            # ---------------------- The angle around the axis ----------------------

            least = dr.select(kind == int(TubeCurve.LEFT), mi.Float(1), -1)
            wx, wy = dr.dot(w, x), dr.dot(w, y)
            width, middle = dr.norm(mi.Vector2f(wx, wy)), dr.atan2(wy, wx)
            along = r1 * dr.dot(d, w)
            turn = dr.acos(dr.clip((near * r + along / d2) / width, -FLAT, FLAT))
            φ = dr.select(rim, dr.two_pi * v, middle + least * turn)
            for _ in range(STEPS):
                e, e1 = around(φ)
                α, above = d2 - r * dr.dot(dd, e), dr.dot(w, e) - near * r
                slope = α * dr.dot(w, e1) - r * dr.dot(dd, e1) * above
                φ -= dr.select(rim, 0, dr.clip((α * above - along) / slope, -TURN, TURN))
            e, e1 = around(φ)
            α = d2 - r * dr.dot(dd, e)
            N = α * e - r1 * d
            towards = w - near * r * e
            valid = (α > 0) & (r > 0) & (d2 > 0)
            across, facing = least * dr.dot(w, e1), dr.dot(N, towards)
            contour = (across < 0) & (dr.abs(facing) < SOLVED * dr.norm(N) * dr.norm(towards))
            valid &= dr.select(rim, facing < 0 if is_light else facing > 0, contour)

            # ---------------------- How the point goes on along the curve ----------------------

            e_u = d * (-dr.dot(e, dd) / d2)
            α_u = 2 * dr.dot(d, dd) - r1 * dr.dot(dd, e) - r * (dr.dot(ddd, e) + dr.dot(dd, e_u))
            N_u = α_u * e + α * e_u - r2 * d - r1 * dd
            N_φ = α * e1 - r * dr.dot(dd, e1) * e
            p_u, p_φ = d + r1 * e + r * e_u, r * e1
            turned_u, turned_φ = dr.dot(N_u, towards), dr.dot(N_φ, towards)
            turns = -turned_u / turned_φ
            # Where the wall bends towards the viewer, it hides its own outline.
            bends = turned_u * dr.dot(towards, d) / α + turned_φ * dr.dot(towards, e1) / r
            valid &= rim | (bends > 0)
            tangent = dr.select(rim, dr.two_pi * p_φ, p_u + p_φ * turns)
            inwards = dr.select(kind == int(TubeCurve.START), p_u, -p_u)
            inwards = dr.select(rim, inwards, -r * dr.normalize(N))
            place, slope = _at(u), _slope(u)
        # The circle stays across the tangent of the axis.
        c, r = _blend(points, place)
        tilt = dr.dot(e, _blend(points, slope)[0])
        p = mi.Point3f(c + r * (e - d * (tilt / d2)))
        slack = SLACK_ON_GPUS if mi.variant().startswith("cuda") else SLACK
        return CurvePoint(p, tangent, inwards, inwards, ~rim, valid, dr.detach(r) * slack)

    def _control(self, control: mi.Float, curve: mi.UInt32) -> list[mi.Vector4f]:
        """The four control points of the segment of a curve; attached."""
        first = dr.gather(mi.UInt32, self._first, curve)
        return [dr.gather(mi.Vector4f, control, first + k) for k in range(4)]


def slide_on_tube(shape: mi.Shape, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, pi, active: mi.Bool) -> None:
    """Attach the normal and the texture coordinates where a ray meets a tube, which may move, as the ray may.

    Mitsuba 3.9 knows how the point moves. But it lets that slide along the axis as if this had the same speed
    everywhere.
    """
    params = mi.traverse(shape)
    control, starts = params["control_points"], params["segment_indices"]
    if not dr.grad_enabled(control, ray.o, ray.d):
        return
    first = dr.gather(mi.UInt32, starts, pi.prim_index, active)
    points = [dr.gather(mi.Vector4f, control, first + k, active) for k in range(4)]
    u = dr.detach(pi.prim_uv.x)
    (c, _), (d, _), (dd, _) = (_blend(points, weights(u)) for weights in (_at, _slope, _bend))
    # The point stays in the plane across the axis, (p − c)·c′ = 0.
    aside = si.p - c
    slid = dr.dot(aside, d) / dr.detach(dr.squared_norm(d) - dr.dot(aside, dd))
    u = dr.replace_grad(u, dr.select(active, slid, 0))
    (c, r), (d, r1), (dd, _) = (_blend(points, weights(u)) for weights in (_at, _slope, _bend))
    aside = si.p - c
    n = dr.normalize((dr.squared_norm(d) - dr.dot(aside, dd)) * aside - (r * r1) * d)
    for frame in (si, si.sh_frame):
        frame.n = dr.select(active, dr.replace_grad(dr.detach(frame.n), mi.Normal3f(n)), frame.n)
    around = dr.two_pi * dr.cross(aside, d) * dr.rsqrt(dr.squared_norm(d))
    around = dr.mulsign(around, dr.detach(dr.dot(around, si.dp_du)))
    si.dp_du = dr.select(active, dr.replace_grad(dr.detach(si.dp_du), around), si.dp_du)
    si.initialize_sh_frame()
    si.wi = dr.select(active, si.to_local(-ray.d), si.wi)
    v = dr.replace_grad(dr.detach(si.uv.y), u / dr.width(starts))
    si.uv.y = dr.select(active, v, si.uv.y)


def lines_along(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Ends of short lines that run along the surface of a tube, from one end to the other: (N, 3) each, world space, on
    the host."""
    params = mi.traverse(shape)
    control = np.array(dr.detach(params["control_points"]), np.float64).reshape(-1, 4)
    first = np.array(params["segment_indices"], np.int64)
    u, φ = np.linspace(0, 1, LINES + 1)[:, None], 2 * np.pi * np.arange(LINES) / LINES
    at = lambda weights: np.stack(np.broadcast_arrays(*weights(u[:, 0])), -1) @ control[first[:, None] + np.arange(4)]
    q, d = at(_at), at(_slope)[..., :3]
    least = np.eye(3)[np.abs(d).argmin(-1)]
    x = np.cross(d, least)
    y = np.cross(d, x)
    x, y = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (x, y))
    e = np.cos(φ)[:, None] * x[..., None, :] + np.sin(φ)[:, None] * y[..., None, :]
    p = q[..., None, :3] + q[..., None, 3:] * e
    return p[:, :-1].reshape(-1, 3), p[:, 1:].reshape(-1, 3)


def steepest(shape: mi.Shape) -> float:
    """The most that the radius of a tube grows per length."""
    params = mi.traverse(shape)
    control = np.array(dr.detach(params["control_points"]), np.float64).reshape(-1, 4)
    step = np.diff(control, axis=0)
    segments = np.array(params["segment_indices"], np.int64)[:, None] + np.arange(3)
    return float(np.max(np.abs(step[segments, 3]) / np.linalg.norm(step[segments, :3], axis=-1)))


def _blend(points: list[mi.Vector4f], weights: tuple[mi.Float, ...]) -> tuple[mi.Vector3f, mi.Float]:
    """A place and a radius: the sum of control points times weights."""
    q = sum(w * p for w, p in zip(weights, points, strict=True))
    return mi.Vector3f(q.x, q.y, q.z), q.w


# Weights of the control points of a cubic B-spline, and their derivatives.


def _at(u: mi.Float) -> tuple[mi.Float, ...]:
    s = 1 - u
    return s * s * s / 6, (4 - 3 * u * u * (1 + s)) / 6, (4 - 3 * s * s * (1 + u)) / 6, u * u * u / 6


def _slope(u: mi.Float) -> tuple[mi.Float, ...]:
    s = 1 - u
    return -s * s / 2, u * (3 * u - 4) / 2, s * (4 - 3 * s) / 2, u * u / 2


def _bend(u: mi.Float) -> tuple[mi.Float, ...]:
    return 1 - u, 3 * u - 2, 1 - 3 * u, u


def _twist(u: mi.Float) -> tuple[float, ...]:
    return -1.0, 3.0, -3.0, 1.0
