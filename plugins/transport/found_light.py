"""What becomes of the light that subpaths find: an image adds it up, a derivative keeps one path of each sample."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class LightEnd:
    """Where a path ends at a light. (A Dr.Jit structure: not frozen.)

    place : the point of the light, world space; of a light at infinity, the direction to it.
    emitter : mi.EmitterPtr.
    """

    place: mi.Point3f
    emitter: mi.EmitterPtr


@dataclass
class Way:
    """A path that was found, as it was made. (A Dr.Jit structure: not frozen.)

    scatters : mi.UInt32, how many vertices of the camera subpath scatter its light.
    sampled : mi.Bool, does it end at a point that was sampled on a light?
    connected : mi.Bool, does it go on with the light subpath? Otherwise it ends at `end`.
    """

    scatters: mi.UInt32
    sampled: mi.Bool
    connected: mi.Bool
    end: LightEnd


@dataclass
class Total:
    """All of the light. (A Dr.Jit structure: not frozen.)"""

    L: mi.Spectrum

    def add(self, L: mi.Spectrum, way: Way, sampler: mi.Sampler, active: mi.Bool) -> Total:
        return Total(self.L + dr.select(active, L, 0))


@dataclass
class OnePath:
    """One of the paths that a sample finds, kept in proportion to its light (a reservoir of one). (A Dr.Jit structure:
    not frozen.)

    L : its light. total : that of all paths so far, of the strongest colour of each. way : how it was made.
    """

    L: mi.Spectrum
    total: mi.Float
    way: Way

    def add(self, L: mi.Spectrum, way: Way, sampler: mi.Sampler, active: mi.Bool) -> OnePath:
        w = dr.select(active, dr.max(L), 0)
        total = self.total + w
        taken = sampler.next_1d(active) * total < w
        return OnePath(dr.select(taken, L, self.L), total, dr.select(taken, way, self.way))

    @property
    def standing_for_all(self) -> mi.Spectrum:
        """Its light, over the probability with which it was kept."""
        return self.L * dr.select(self.total > 0, self.total / dr.max(self.L), 0)


@dataclass
class Seen:
    """A vertex of a light subpath, as the sensor sees it. (A Dr.Jit structure: not frozen.)

    u : film position, pixels. lens : random numbers for a point of the lens. number : along the subpath.
    """

    u: mi.Point2f
    lens: mi.Point2f
    number: mi.UInt32
