"""Lines along which the normals of normal maps and bump maps turn away from the viewer.

There, nested BSDFs go dark, or Mitsuba mirrors the normal (`flip_invalid_normals`): either way, the image jumps, though
the surface itself, and its interpolated normals, still face the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .meshes import is_map, objects_below


@dataclass(frozen=True)
class MappedHorizon:
    """Where the normals of one map turn away.

    bsdf : the map. texture : of its normals, or heights.
    two_sided : do both sides of the surface have the same map?
    """

    shape: Any
    bsdf: mi.BSDF
    texture: Any
    two_sided: bool
    #: Largest value of the function.
    size: float = 1.0

    @property
    def turns(self) -> bool:
        """Do the normals, or the heights, carry a gradient?"""
        return any(dr.grad_enabled(value) for _, value in mi.traverse(self.texture).items())

    def at(self, si: mi.SurfaceInteraction3f) -> mi.Vector2f:
        """A number that is positive where the normal faces the viewer, and 0.5: as `Lattice.at`, whole at the line."""
        wi = mi.Vector3f(si.wi)
        if self.two_sided:
            wi.z = dr.abs(wi.z)
        n = self._from_heights(si) if _has_heights(self.bsdf) else 2 * mi.Vector3f(self.texture.eval_3(si)) - 1
        return whole_at_zero(dr.dot(wi, n))

    def _from_heights(self, si: mi.SurfaceInteraction3f) -> mi.Vector3f:
        """As Mitsuba's `bumpmap` makes it: in the frame of shading."""
        n = mi.Vector3f(si.sh_frame.n)
        slope = mi.traverse(self.bsdf)["scale"] * mi.Vector2f(self.texture.eval_1_grad(si))
        along_u = si.dp_du + n * (slope.x - dr.dot(n, si.dp_du))
        along_v = si.dp_dv + n * (slope.y - dr.dot(n, si.dp_dv))
        bumped = dr.cross(along_u, along_v)
        return si.to_local(bumped * dr.sign(dr.detach(dr.dot(si.n, bumped))))


def whole_at_zero(x: mi.Float) -> mi.Vector2f:
    """A number with the sign of x between -1 and 1, and 0.5: where x is 0, and only there, one of them is whole."""
    return mi.Vector2f(x / (1 + dr.abs(x)), 0.5)


def mapped_horizons(shape: Any) -> list[MappedHorizon]:
    """Of all maps of a shape."""
    below = objects_below(shape)
    both = [name for name, o in below.items() if o.class_name() == "TwoSidedBRDF"]
    found = []
    for name, o in below.items():
        if not (isinstance(o, mi.BSDF) and is_map(o)):
            continue
        texture = objects_below(o)["nested_texture" if _has_heights(o) else "normalmap"]
        found.append(MappedHorizon(shape, o, texture, any(name.startswith(f"{b}.") for b in both)))
    return found


def _has_heights(bsdf: mi.BSDF) -> bool:
    return bsdf.class_name() == "BumpMap"
