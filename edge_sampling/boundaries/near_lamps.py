"""Shadows near `CloseLamps`, whose light is held in its direction there: how they move, and which way finds them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.projection.sensors import Projection


def share_at_first(
    lamps: DividedLight | None,
    lamp: mi.EmitterPtr,
    near: mi.Float,
    whole: mi.Float,
    otherwise: mi.Float | float,
) -> mi.Float | float:
    """Part of the shadows on what the sensor sees that is found from the lamps: the power heuristic (Veach 1997), since
    both ways choose too few of the edges that are close to where they start.

    near, whole : distances of the edge and of the lamp from what is seen. otherwise : the part where lamps are not
    close.
    """
    if lamps is None:
        return otherwise
    beyond2, near2 = dr.square(dr.maximum(whole - near, 0)), dr.square(near)
    part = beyond2 / (beyond2 + near2)
    return dr.select((whole < lamps.near(lamp).radius) & dr.isfinite(part), part, otherwise)


def moved_with(held: mi.Point3f, y: mi.Point3f, slid: mi.Float) -> mi.Vector3f:
    """Zero, with the gradient of what is added to the motion of the point y of a lamp: where its direction is held, it
    goes where the point goes that it lights.

    held : that point. slid : part of the light that is held in its direction.
    """
    return slid * ((held - dr.detach(held)) - (y - dr.detach(y)))


def still_on_film(
    projection: Projection, m: mi.Point3f, n: mi.Vector3f, aperture_sample: mi.Point2f | None, active: mi.Bool
) -> mi.Point3f:
    """What stays where it is on the film: a point of the plane through the material point m with the normal n. Where it
    is not active, m."""
    frame, at = mi.Frame3f(dr.select(active, n, mi.Vector3f(0, 0, 1))), dr.detach(m)
    on_film = lambda v: dr.detach(projection.tangent(at, mi.Point3f(at + v), mi.Float(0), aperture_sample))
    s, t = on_film(frame.s), on_film(frame.t)
    area = s.x * t.y - s.y * t.x
    active = active & (area != 0) & dr.isfinite(area)
    s, t = (dr.select(active, v / area, 0) for v in (s, t))
    u = projection.film(m, aperture_sample).position()
    u -= dr.detach(u)
    return m - frame.s * (u.x * t.y - u.y * t.x) - frame.t * (s.x * u.y - s.y * u.x)
