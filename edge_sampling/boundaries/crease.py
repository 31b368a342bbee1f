"""In which directions both sides of a crease look for light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.meshes import objects_below

from .lune import Lune

#: The rays beside a crease meet surfaces at about equal distances: they differ by less than this, relative to one.
AS_FAR = 1e-3

#: Cosine of the largest angle between their normals (18 degrees). Beyond it, directions of their own are better.
ALIKE = 0.95


def is_matt(bsdf: mi.BSDF) -> bool:
    """Is it `diffuse`, on one side or on both? It reflects light from the side of its shading normal alone, and from no
    direction much more than from others."""
    bsdfs = [b for b in objects_below(bsdf).values() if isinstance(b, mi.BSDF)]
    return {b.class_name() for b in bsdfs} <= {"SmoothDiffuse", "TwoSidedBRDF"}


@dataclass(frozen=True)
class Crease:
    """The directions from which both sides of a crease are lit, where it is a matt surface that is bent a little.

    Two points just beside a crease receive the same light L, and reflect ∫ (n₁·ω)⁺ L dω and ∫ (n₂·ω)⁺ L dω. If each
    sampled directions of its own, the difference would be noise: most edges of a flat-shaded mesh hardly jump. So both
    look in the same direction, which is uniform over the hemisphere of n₁ or of n₂, by chance: the noise falls with the
    angle between them.

    normals : mi.Vector3f, (N,) each, that shade both sides, towards the viewer.
    active : mi.Bool, is this such a crease? Otherwise, directions are sampled as everywhere.
    """

    normals: tuple[mi.Vector3f, mi.Vector3f]
    active: mi.Bool

    @staticmethod
    def between(rays: list[mi.Ray3f], met: list[mi.PreliminaryIntersection3f], active: mi.Bool) -> Crease:
        """The one between what two rays meet close by on both sides of an edge."""
        normals = []
        for ray, pi in zip(rays, met, strict=True):
            n = pi.compute_surface_interaction(ray, mi.RayFlags.ShadingFrame, active).sh_frame.n
            normals.append(dr.mulsign(n, -dr.dot(n, ray.d)))
        near = (met[0].shape == met[1].shape) & (dr.abs(met[0].t - met[1].t) < AS_FAR * met[0].t)
        return Crease(tuple(normals), active & near & (dr.dot(*normals) > ALIKE))

    def where(self, active: mi.Bool) -> Crease:
        """The same, active at most there."""
        return replace(self, active=self.active & active)

    def sample(self, side: mi.Float, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """A direction, and its density. side, u : uniform random numbers."""
        n = dr.select(side < 0.5, *self.normals)
        direction = mi.Frame3f(n).to_world(mi.warp.square_to_uniform_hemisphere(u))
        return direction, self.pdf(direction)

    def pdf(self, direction: mi.Vector3f) -> mi.Float:
        """The density with which `sample` draws a direction."""
        lit = sum(dr.select(dr.dot(n, direction) > 0, mi.Float(1), 0) for n in self.normals)
        return 0.25 * dr.inv_pi * lit


@dataclass(frozen=True)
class LuneOrCrease:
    """Directions from a lune where that is active, and elsewhere those of a crease."""

    lune: Lune
    crease: Crease

    @property
    def active(self) -> mi.Bool:
        return self.lune.active | self.crease.active

    def where(self, active: mi.Bool) -> LuneOrCrease:
        return LuneOrCrease(self.lune.where(active), self.crease.where(active))

    def sample(self, side: mi.Float, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        pairs = zip(self.lune.sample(side, u), self.crease.sample(side, u), strict=True)
        return tuple(dr.select(self.lune.active, a, b) for a, b in pairs)

    def pdf(self, direction: mi.Vector3f) -> mi.Float:
        return dr.select(self.lune.active, self.lune.pdf(direction), self.crease.pdf(direction))


#: In which directions light is looked for: where `active`, one for both sides by `sample`, whose density is `pdf`.
Directions = Lune | Crease | LuneOrCrease
