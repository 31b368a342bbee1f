"""Lamps that are close to what they light: windows in their reveals, strips in their housings.

Of a point on a lamp that is held, the light that arrives at the distance r changes as 1 / r, if one of both surfaces
moves. Where they touch, that has no finite variance, as with interreflections. So the light of such lamps is divided as
scattered light is (`Vicinity`): close to the lamp, the direction is held in which its light arrives, and what is seen
past the outline of the lamp counts. Of all other lamps, points are held at all distances, so that their own outlines
are no boundaries.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .emitter_table import EmitterTable
from .geometry.meshes import is_smooth
from .parametrisation import Vicinity

#: Rays that leave each lamp, by which it is known how close it is to what it lights.
RAYS = 1024

#: A lamp is close if so large a part of its rays meets something within a distance of `CLOSE`, relative to its size.
PART, CLOSE = 0.01, 0.05

#: Radius around a point within which the directions are held to a close lamp, relative to the size of the lamp.
RADIUS = 1.0


class CloseLamps:
    """The lamps of a scene whose light is held in its direction near them, each with its own radius.

    Their size is the root of their area. They are known by how many of their rays soon meet something; lamps that come
    close later are none of them, which costs noise, but no bias.
    """

    DRJIT_STRUCT = dict.fromkeys(("radii",))  # for `dr.freeze`

    @staticmethod
    def of(scene: mi.Scene) -> CloseLamps | None:
        """None where there are none. On the host, so not in frozen functions."""
        radii = {}
        for shape in scene.shapes():
            if shape.is_emitter() and divisible(shape):
                size = float(np.ravel(dr.detach(shape.surface_area()))[0]) ** 0.5
                if is_close(scene, shape.emitter(), CLOSE * size):
                    radii[shape.emitter()] = RADIUS * size
        return CloseLamps(radii) if radii else None

    def __init__(self, radii: dict[mi.Emitter, float]):
        #: The lamps.
        self.shapes = [e.get_shape() for e in radii]
        self.radii = EmitterTable(radii)

    def vicinity(self, emitter: mi.EmitterPtr) -> Vicinity:
        """That in which directions to an emitter are held; of those that are not close, nothing."""
        return Vicinity(self.radii.of(emitter))


def divisible(lamp: mi.Shape) -> bool:
    """May the light of a lamp be held in its direction? So it may if all of the lamp shines alike, up to its
    silhouette."""
    emitter = lamp.emitter()
    if emitter.class_name() != "AreaLight" or emitter.flags() & mi.EmitterFlags.SpatiallyVarying:
        return False
    return not (lamp.is_mesh() and is_smooth(lamp))


def is_close(scene: mi.Scene, lamp: mi.Emitter, distance: float) -> bool:
    """Do many rays of a lamp soon meet something?"""
    with dr.suspend_grad():
        sampler = mi.load_dict({"type": "independent", "sample_count": 1})
        sampler.seed(0, RAYS)
        ray, _ = lamp.sample_ray(0.0, 0.5, sampler.next_2d(), sampler.next_2d())
        met = scene.ray_intersect_preliminary(ray)
        return bool(dr.mean(dr.select(met.t < distance, mi.Float(1), 0))[0] > PART)
