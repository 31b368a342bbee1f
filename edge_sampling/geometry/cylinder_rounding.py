"""How precisely rays meet cylinders.

Mitsuba finds where a ray meets a cylinder from a difference of squares, in single precision. For a ray that starts at
the distance d from the axis of a cylinder of the radius r, the distance between ray and axis has an error of ε d² / r:
much more than ε d where the cylinder is thin.
"""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi

#: The error in units in the last place of d² / r; and the largest part of the radius that is reckoned with.
UNITS, FARTHEST = 2, 0.25

Number = TypeVar("Number")


def blur(radius: Number, distance2: Number) -> Number:
    """How far beside its outline a ray may find a cylinder: scene units.

    distance2 : square of the distance from the axis at which the ray starts.
    """
    return dr.minimum(UNITS * dr.epsilon(mi.Float) * distance2 / radius, FARTHEST * radius)
