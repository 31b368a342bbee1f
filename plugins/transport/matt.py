"""In which directions a derivative follows paths from matt surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.meshes import has_interpolated_normals, is_map, objects_below, surfaces

#: Part of the directions that are uniform over the hemisphere; the others are in proportion to the cosine.
UNIFORM = 0.25

#: Where more shapes than these may turn, all are taken to do so.
FEW = 8

#: Mitsuba's shapes that are made of flat faces, though it stores normals with a `cube`.
FLAT = ("Rectangle", "Disk", "Cube")


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
    def above(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, turning: Sequence[Any], active: mi.Bool) -> MattDirections:
        """Those above surfaces that reflect diffusely and do nothing else, and may turn.

        turning : shapes that do.
        """
        if len(turning) <= FEW:
            turns = mi.Bool(False)
            for shape in turning:
                turns |= si.shape == mi.ShapePtr(shape)
            active = active & turns
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


def turning(scene: mi.Scene) -> list[Any]:
    """The shapes of a scene at whose points the cosine of a direction may change where it is 0.

    If a shape moves, these are all shapes: towards its points, directions turn. If none does, those whose normals
    change along the surface, over which points slide as the camera moves: all but flat faces without a map of normals.
    (On a flat face, the cosine towards a point that stands still changes in proportion to itself.)
    """
    shapes = surfaces(scene)
    with dr.resume_grad():
        if any(s.parameters_grad_enabled() for s in scene.shapes()):
            return shapes
    return [s for s in shapes if not _is_flat(s) or _has_map(s)]


def _is_flat(shape: Any) -> bool:
    if shape.class_name() in FLAT:
        return True
    return shape.is_mesh() and not has_interpolated_normals(shape)


def _has_map(shape: Any) -> bool:
    return any(isinstance(o, mi.BSDF) and is_map(o) for o in objects_below(shape).values())
