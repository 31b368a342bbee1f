"""Lines at which the light of a spot or a projector jumps on what it falls on: the border of its beam, and where its
texture jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .mapped_horizons import whole_at_zero

#: What throws beams.
BEAMS = ("SpotLight", "Projector")

#: Their parameters on which it depends whether a beam ends with a jump.
BORDER = ("beam_width", "cutoff_angle", "irradiance.data")

#: How many times as much as the coordinates of textures of surfaces those of what lights throw are rounded.
ROUNDING = 4.0


@dataclass(frozen=True)
class BeamBorder:
    """The border of the beam of a light."""

    emitter: mi.Emitter
    size: float = ROUNDING

    def at(self, si: mi.SurfaceInteraction3f) -> mi.Vector2f:
        """A number that is positive in the beam, and 0.5: as `Lattice.at`, whole at the line."""
        p = _in_frame(self.emitter, si)
        if self.emitter.class_name() == "SpotLight":
            cutoff = dr.deg2rad(mi.traverse(self.emitter)["cutoff_angle"])
            return whole_at_zero(p.z / dr.norm(p) - dr.cos(cutoff))
        uv = on_texture(self.emitter, si)
        return whole_at_zero(dr.select(p.z > 0, dr.minimum(dr.min(uv), dr.min(1 - uv)), -1))


def on_texture(emitter: mi.Emitter, si: mi.SurfaceInteraction3f) -> mi.Point2f:
    """Coordinates in the texture of a light that fall on a point; those in the beam are from 0 to 1. As Mitsuba's
    `projector` and `spot` have them; attached, if light or point are."""
    if emitter.class_name() == "Projector":
        return emitter.sample_direction(si, mi.Point2f(0))[0].uv
    p = _in_frame(emitter, si)
    size = 2 * p.z * dr.tan(dr.deg2rad(mi.traverse(emitter)["cutoff_angle"]))
    return mi.Point2f(0.5 + p.x / size, 0.5 + p.y / size)


def off_texture(emitter: mi.Emitter, uv: mi.Point2f) -> mi.Point2f:
    """The inverse of `on_texture`: the point, in the frame of the light at the distance 1 along z, on which a place of
    its texture falls. Attached to the angle of a spot."""
    if emitter.class_name() == "SpotLight":
        size = 2 * dr.tan(dr.deg2rad(mi.traverse(emitter)["cutoff_angle"]))
        return mi.Point2f((uv.x - 0.5) * size, (uv.y - 0.5) * size)
    # The texture is seen in perspective: of points at this distance, the coordinates are affine.
    with dr.suspend_grad():
        to_world, si = mi.traverse(emitter)["to_world"], dr.zeros(mi.SurfaceInteraction3f)
        places = []
        for p in ((0, 0, 1), (1, 0, 1), (0, 1, 1)):
            si.p = to_world @ mi.Point3f(*p)
            places.append(on_texture(emitter, si))
        centre, x, y = places[0], places[1] - places[0], places[2] - places[0]
        inverse = dr.rcp(mi.Matrix2f(x.x, y.x, x.y, y.y))
        return mi.Point2f(inverse @ mi.Vector2f(uv - centre))


def _in_frame(emitter: mi.Emitter, si: mi.SurfaceInteraction3f) -> mi.Point3f:
    """A point in the frame of a light, which shines along +z."""
    return mi.traverse(emitter)["to_world"].inverse() @ si.p


def has_hard_beam(emitter: mi.Emitter) -> bool:
    """Does what a `spot` or a `projector` throws end with a jump, as it is now? (`Sources` asks again.)"""
    if emitter.class_name() not in BEAMS:
        return False
    params = mi.traverse(emitter)
    if emitter.class_name() == "SpotLight":
        return bool(dr.any(params["beam_width"] >= params["cutoff_angle"]))
    if "irradiance.data" not in params:
        return True
    image = np.array(dr.detach(params["irradiance.data"]))
    return bool(max(np.abs(side).max() for side in (image[0], image[-1], image[:, 0], image[:, -1])) > 0)


def border_values(emitter: mi.Emitter) -> list[Any]:
    """What the answer of `has_hard_beam` depends on: arrays, detached."""
    params = mi.traverse(emitter)
    return [dr.detach(params[key]).array for key in BORDER if key in params]
