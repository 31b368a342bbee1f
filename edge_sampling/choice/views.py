"""From where edges are looked at, and which directions matter there."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.parametrisation import Vicinity


@dataclass
class Lobe:
    """Weight of directions near to an axis: peak · (1 + (tan θ / width)²)^(-3/2). Integrated along a line, this has a
    closed form."""

    axis: mi.Vector3f
    peak: mi.Float
    width: mi.Float


@dataclass
class Cone:
    """Directions that matter: those within an angle α < 90° of an axis; or all of them, where its cosine is -1.

    axis : mi.Vector3f, unit length.
    cos, sin : mi.Float, of α.
    """

    axis: mi.Vector3f
    cos: mi.Float
    sin: mi.Float

    @property
    def everything(self) -> mi.Bool:
        return self.cos < 0


@dataclass
class View:
    """From where the edges are looked at, and what is wanted of them: a sum of weights of directions.

    p : mi.Vector3f, relative to the centre of the tree; for a viewer at infinity, the direction towards it.
    n : mi.Vector3f, unit normal: directions below its plane are of no use. Zero where all are.
    wide : mi.Float, weight of all directions above the plane, by their cosine.
    lobes : around which there is more.
    cone : outside of which there is nothing; None: all directions count.
    far : mi.Bool, is the viewer at infinity? None: nowhere. Not with lobes or cones.
    vicinity : in which creases count, too, and the less the farther they are; None: nowhere.
    """

    p: mi.Vector3f
    n: mi.Vector3f
    wide: mi.Float
    lobes: list[Lobe]
    cone: Cone | None = None
    far: mi.Bool | None = None
    vicinity: Vicinity | None = None

    @property
    def w(self) -> mi.Float | float:
        """Homogeneous coordinate that goes with p: 1, or 0 at infinity. A point x is seen in the direction w x - p."""
        return 1.0 if self.far is None else dr.select(self.far, mi.Float(0), 1)
