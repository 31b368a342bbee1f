"""Scenes of others have textures: many texels in each pixel, on nearly everything, in any parameter of a material:

    python tests/random_scenes.py --special textures --seeds 955000 955020

The points of most such surfaces are held where the camera sees them (`edge_sampling/first_points.py`).
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from random_scenes import Generator, RandomScene

#: Samples per pixel of one image of the finite differences: they are spread evenly, and must see all texels.
REFERENCE_SPP = 2**12


class TextureGenerator(Generator):
    """Colours, roughness, normals and what lamps emit are bitmaps, of a few texels or of many. Lights have no size:
    finite differences have less noise."""

    def make(self) -> RandomScene:
        made = super().make()
        made.reference_spp = REFERENCE_SPP
        return made

    def texels(self) -> int:
        return self.pick(8, 64, 128, 256, 512)

    def picture(self, low: float = 0.1, high: float = 0.9) -> dict:
        height, width = self.texels(), self.texels()
        place = mi.ScalarTransform3f().rotate(self.uniform(0, 360)).scale([self.uniform(0.5, 2), self.uniform(0.5, 2)])
        bitmap = {**self.bitmap(height, width, low, high), "wrap_mode": self.pick("clamp", "mirror", "repeat")}
        return {**bitmap, "to_uv": place} if self.chance(0.3) else bitmap

    def number(self, low: float, high: float) -> dict:
        return {**self.picture(low, high), "raw": True}

    def bsdf(self, uv: bool = False, closed: bool = False) -> tuple[str, dict]:
        if self.chance(0.15):
            return super().bsdf(uv, closed)
        kinds = ["diffuse", "diffuse", "twosided", "roughplastic", "roughconductor", "principled", "blend", "normals"]
        kind = self.pick(*kinds)
        alpha, diffuse = self.uniform(0.1, 0.4), lambda: {"type": "diffuse", "reflectance": self.picture()}
        bsdf = {
            "diffuse": diffuse,
            "twosided": lambda: {"type": "twosided", "inner": diffuse()},
            "roughplastic": lambda: {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": self.picture()},
            "roughconductor": lambda: {
                "type": "roughconductor",
                "alpha": self.number(0.15, 0.5) if self.chance(0.5) else alpha,
                "specular_reflectance": self.picture(),
            },
            "principled": lambda: {
                "type": "principled",
                "base_color": self.picture(),
                "roughness": self.number(0.3, 0.8),
                "specular": 0.5,
            },
            "blend": lambda: {
                "type": "blendbsdf",
                "weight": self.number(0.0, 1.0),
                "first": {"type": "diffuse", "reflectance": self.colour()},
                "second": {"type": "roughconductor", "alpha": alpha},
            },
            "normals": lambda: {"type": "normalmap", "normalmap": self.normal_map(), "bsdf": diffuse()},
        }[kind]()
        return f"textured-{kind}", bsdf

    def normal_map(self) -> dict:
        n = self.texels()
        slopes = self.rng.uniform(-0.2, 0.2, (n, n, 2))
        normals = np.concatenate([slopes, np.ones((n, n, 1))], 2)
        normals = normals / np.linalg.norm(normals, axis=2, keepdims=True) * 0.5 + 0.5
        bitmap = mi.Bitmap(normals.astype(np.float32))
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}

    def emitter(self, low: float, high: float, uv: bool = False) -> dict:
        if not uv:  # of meshes without, Mitsuba cannot sample a picture
            return super().emitter(low, high, uv)
        return {"type": "area", "radiance": self.picture(low, high)}
