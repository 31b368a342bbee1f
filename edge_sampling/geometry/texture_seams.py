"""Where textures do not go on around a shape: the line at which its texture coordinates begin and end."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: Shapes whose texture coordinates begin and end at a line, and which of both does: the azimuth.
SEAM_OF = {"Sphere": 0, "Cylinder": 0, "Disk": 1}

#: Points of such a line at which textures are compared.
PLACES_OF_SEAM = 64


def texture_value(texture: Any, at: mi.Point2f | mi.Point3f) -> mi.Spectrum:
    """Of a texture, at texture coordinates, or in space."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(at))
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(550)
    setattr(si, "uv" if isinstance(at, mi.Point2f) else "p", at)
    return texture.eval(si)


def jumps_at_seam(texture: mi.Texture, shape: str) -> bool:
    """Does a texture differ between both sides of the line at which the texture coordinates of a kind of shape begin
    and end? Bitmaps do that do not repeat, and all that are scaled. shape : class name."""
    if shape not in SEAM_OF:
        return False
    along = np.random.default_rng(0).uniform(0, 1, PLACES_OF_SEAM).astype(np.float32)
    sides = [np.full_like(along, x) for x in (0, np.nextafter(np.float32(1), np.float32(0)))]
    with dr.suspend_grad():
        a, b = (np.array(texture_value(texture, mi.Point2f(*np.roll([s, along], SEAM_OF[shape], 0)))) for s in sides)
    return bool(np.abs(a - b).max() > 1e-3 * np.abs([a, b]).max())
