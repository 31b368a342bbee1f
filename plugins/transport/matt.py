"""In which directions a derivative follows paths from matt surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Part of the directions that are uniform over the hemisphere; the others are in proportion to the cosine.
UNIFORM = 0.25


@dataclass(frozen=True)
class MattDirections:
    """Directions for the light that a matt surface reflects, and for its derivative as the surface turns.

    As a normal n turns by ṅ, the light from a direction ω changes by (ṅ·ω) L: that does not vanish with the cosine n·ω,
    as the density of a diffuse BSDF does, so that the second moment of samples of the BSDF, ∫ (ṅ·ω)² / (n·ω) dω, has a
    logarithm without end. A part of uniform directions bounds the ratio of both.

    normal : mi.Vector3f, (N,), towards the side from which it is looked at; attached. active : mi.Bool, is it matt?
    """

    normal: mi.Vector3f
    active: mi.Bool

    @staticmethod
    def above(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> MattDirections:
        """Those above surfaces that reflect diffusely and do nothing else."""
        other = mi.BSDFFlags.Delta | mi.BSDFFlags.Glossy | mi.BSDFFlags.Transmission | mi.BSDFFlags.Null
        cosine = dr.detach(si.wi.z)
        with dr.resume_grad():
            normal = dr.mulsign(mi.Vector3f(si.sh_frame.n), cosine)
        return MattDirections(normal, active & ((bsdf.flags() & other) == 0) & (cosine != 0))

    def sample(self, side: mi.Float, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """A direction, world space, and its density. side, u : uniform random numbers."""
        warp = mi.warp
        above = dr.select(side < UNIFORM, warp.square_to_uniform_hemisphere(u), warp.square_to_cosine_hemisphere(u))
        direction = mi.Frame3f(self.normal).to_world(above)
        return direction, self.pdf(direction)

    def pdf(self, direction: mi.Vector3f) -> mi.Float:
        """The density with which `sample` draws a direction."""
        cosine = dr.dot(direction, self.normal)
        return dr.select(cosine > 0, dr.inv_pi * dr.lerp(cosine, mi.Float(0.5), UNIFORM), 0)
