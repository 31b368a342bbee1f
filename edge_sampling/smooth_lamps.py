"""Lamps with interpolated normals: what Mitsuba's `path` makes of their light.

A light sample on a mesh counts with the cosine to the *interpolated* normal, |nₛ · ω| / r², and has the density
p = r² / (A |nₛ · ω|). A sample of the BSDF finds the same light with the true cosine |n · ω|. With the weights of
multiple importance sampling, w of light samples and 1 − w, what `path` renders of the light from a direction is thus

    Lₑ · (w |nₛ · ω| / |n · ω| + 1 − w).

So the derivatives of the weights do not cancel. And the light does not jump where interpolated normals turn away:
there, |nₛ · ω| is 0 and w is 1.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .geometry.meshes import has_interpolated_normals


class SmoothLamps:
    """The lamps of a scene that are meshes with interpolated normals. (Not those with a textured radiance: their light
    samples know true normals only.)"""

    DRJIT_STRUCT = dict.fromkeys(("_shapes",))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        self._shapes = [mi.ShapePtr(s) for s in self.shapes(scene)]

    @staticmethod
    def shapes(scene: mi.Scene) -> list[mi.Shape]:
        """The lamps."""
        plain = [e for e in scene.emitters() if not e.flags() & mi.EmitterFlags.SpatiallyVarying]
        shapes = [e.get_shape() for e in plain if e.get_shape() is not None]
        return [s for s in shapes if s.is_mesh() and has_interpolated_normals(s)]

    def __len__(self) -> int:
        return len(self._shapes)

    def are(self, shape: mi.ShapePtr) -> mi.Bool:
        """Is a shape one of them?"""
        found = mi.Bool(False)
        for lamp in self._shapes:
            found |= shape == lamp
        return found

    def cosine(self, y: mi.SurfaceInteraction3f, ω: mi.Vector3f, weight: mi.Float) -> mi.Float:
        """What stands for |n · ω| of a point on a lamp of any kind, if its light is not divided between boundaries.

        weight : w, of light samples.
        """
        true = dr.abs_dot(y.n, ω)
        return dr.select(self.are(y.shape), dr.lerp(true, dr.abs_dot(y.sh_frame.n, ω), weight), true)
