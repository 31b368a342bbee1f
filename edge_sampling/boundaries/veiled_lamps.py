"""Lamps that are seen through veils: where edges that hide them, and their outlines, are sought.

Through a veil, a lamp is seen as light that the veil scatters. It is much brighter than the rest, and appears small.
Where the veil moves, the lamp slides over it. So edges are sought in two ways: of the samples for scattered light, a
part seeks them in the directions of one lamp alone, and the others seek them in all other directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.emitter_boxes import EmitterBoxes
from rimlight.edge_sampling.choice.views import Cone
from rimlight.edge_sampling.geometry.meshes import inner, lets_rays_through, surfaces

#: Part of the samples for scattered light that are sought in the directions of a lamp.
AIMED = 0.5


@dataclass
class Aim:
    """In which directions the edges of a sample are sought.

    lamp : the directions of a lamp.
    taken : mi.Bool, is it those? Otherwise all others.
    part : mi.Float, of the samples that seek there.
    """

    lamp: Cone
    taken: mi.Bool
    part: mi.Float

    def cone(self, otherwise: Cone) -> Cone:
        return dr.select(self.taken, self.lamp, otherwise)

    def counts(self, ω: mi.Vector3f) -> mi.Bool:
        """Is a direction sought in this way?"""
        return self.lamp.everything | (self.taken == (dr.dot(ω, self.lamp.axis) >= self.lamp.cos))


class VeiledLamps:
    """The lamps of a scene, if veils move in it.

    lights : numbers of the emitters with a size, and `boxes` theirs. moving : the shapes that move; None: any may.
    """

    DRJIT_STRUCT = dict.fromkeys(("lamps", "boxes"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene, lights: Sequence[int], boxes: EmitterBoxes, moving: Sequence[mi.Shape] | None):
        veils = any(lets_rays_through(s) for s in (surfaces(scene) if moving is None else map(inner, moving)))
        lamps = [i for i in lights if scene.emitters()[i].flags() & mi.EmitterFlags.Surface]
        self.lamps = mi.UInt32(lamps) if lamps and veils else None
        self.boxes = boxes

    def aim(self, x: mi.Point3f, sampler: mi.Sampler) -> Aim:
        """Where to seek edges as seen from x."""
        if self.lamps is None:
            return Aim(Cone(mi.Vector3f(0, 0, 1), mi.Float(-1), mi.Float(0)), mi.Bool(False), mi.Float(1))
        count = dr.width(self.lamps)
        which = dr.minimum(mi.UInt32(sampler.next_1d() * count), count - 1)
        lamp = self.boxes.cone(dr.gather(mi.UInt32, self.lamps, which), x)
        taken = (sampler.next_1d() < AIMED) & ~lamp.everything
        return Aim(lamp, taken, dr.select(lamp.everything, 1, dr.select(taken, mi.Float(AIMED), 1 - AIMED)))
