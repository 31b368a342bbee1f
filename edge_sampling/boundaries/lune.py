"""What the planes of two faces of a smooth-shaded mesh hide from the points beside their edge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi


def spreads(bsdf: mi.BSDF | mi.BSDFPtr, besides: int = int(mi.BSDFFlags.Null)) -> mi.Bool | bool:
    """Does it reflect light from all directions, and let none through, unless as if nothing was there? Only then may
    light be sampled in a lune.

    besides : perfect lobes of which the jumps are found in other ways.
    """
    others = (mi.BSDFFlags.Delta | mi.BSDFFlags.Transmission) & ~besides
    return (bsdf.flags() & others) == 0


@dataclass(frozen=True)
class Lune:
    """The directions between the planes of two faces that share an edge: light from there reaches one of them alone.

    Two points just beside the edge, on both sides, reflect the same light from all other directions, if the same
    normal shades them. On fine meshes, a direction that is sampled from the BSDF is hardly ever in the lune.

    axis : mi.Vector3f, (N,), direction of the edge, unit length.
    towards : mi.Vector3f, direction in the plane of one face across the edge, unit length.
    normal : mi.Vector3f, of this plane; completes `axis` and `towards` to a frame in which that of the other plane is
        found by a turn about the axis.
    angle : mi.Float, of this turn, radians, in (-pi, pi).
    active : mi.Bool, is what jumps at the edge only this? Otherwise, directions are sampled as everywhere.
    """

    axis: mi.Vector3f
    towards: mi.Vector3f
    normal: mi.Vector3f
    angle: mi.Float
    active: mi.Bool

    @staticmethod
    def between(axis: mi.Vector3f, normals: tuple[mi.Vector3f, mi.Vector3f], active: mi.Bool) -> Lune:
        """The one between two planes through an axis, with normals that need not have unit length."""
        axis = dr.normalize(axis)
        first, second = (dr.normalize(n) for n in normals)
        towards = dr.cross(first, axis)
        return Lune(axis, towards, first, dr.atan2(-dr.dot(second, towards), dr.dot(second, first)), active)

    def where(self, active: mi.Bool) -> Lune:
        """The same, active at most there."""
        return replace(self, active=self.active & active)

    def sample(self, side: mi.Float, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """A direction, uniform by solid angle, and its density. side, u : uniform random numbers."""
        s, c = dr.sincos(self.angle * u.x)
        along = 2 * u.y - 1
        across = dr.mulsign(dr.safe_sqrt(1 - dr.square(along)), side - 0.5)
        direction = along * self.axis + across * (c * self.towards + s * self.normal)
        return direction, self._density

    def pdf(self, direction: mi.Vector3f) -> mi.Float:
        """The density with which `sample` draws a direction."""
        s, c = dr.sincos(self.angle)
        first = dr.dot(direction, self.normal)
        second = c * first - s * dr.dot(direction, self.towards)
        return dr.select((first > 0) != (second > 0), self._density, 0)

    @property
    def _density(self) -> mi.Float:
        return dr.rcp(4 * dr.abs(self.angle))
