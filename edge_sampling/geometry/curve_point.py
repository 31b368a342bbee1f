"""A point of an outline that is no edge of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class CurvePoint:
    """A point of a curve, as it is seen from somewhere.

    p : mi.Point3f, world space; attached to the motion of its shape.
    tangent : mi.Vector3f, dp/dt along the piece. Detached.
    inwards : mi.Vector3f, from p towards the shape. Detached.
    other : mi.Vector3f, from p towards the second shape, where rims coincide; elsewhere as `inwards`. Detached.
    slides : mi.Bool, is it on a contour, which slides over its shape?
    valid : mi.Bool, is there one? A viewer inside of a sphere sees no contour.
    slack : mi.Float, how far from p Mitsuba may take the outline to be: scene units; 0 but for tubes.
    """

    p: mi.Point3f
    tangent: mi.Vector3f
    inwards: mi.Vector3f
    other: mi.Vector3f
    slides: mi.Bool
    valid: mi.Bool
    slack: mi.Float
