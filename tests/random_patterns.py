"""Patterns on mirrors, glass and polished surfaces, whose lines may lie along edges and seams:

    python tests/random_scenes.py --special patterns --seeds 957000 957020

All shapes have them: spheres and cylinders, and meshes without texture coordinates as well. Paths have two segments, or
three, and then all lights are points, spots and suns, as in `random_mirrors.py`.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from random_mirrors import MirrorGenerator


class PatternGenerator(MirrorGenerator):
    """Most things are mirrors, glass, or shine, with textures of few texels, or maps of normals or heights."""

    def pattern(self, low: float = 0.1, high: float = 0.9) -> dict:
        kind = self.pick("checkers", "checkers", "nearest", "bilinear")
        if kind != "checkers":
            bitmap = self.bitmap(self.pick(3, 4, 8), self.pick(4, 6, 8), low, high)
            wrap = self.pick("clamp", "mirror", "repeat")
            return {**bitmap, "filter_type": kind, "wrap_mode": wrap}
        if self.chance(0.4):
            return self.checkers()
        # Along the edges of the mesh
        place = mi.ScalarTransform3f().scale([self.pick(1, 2, 3), self.pick(1, 1.5, 2)])
        colours = {"color0": self.uniform(0, 0.3), "color1": self.colour()}
        return {"type": "checkerboard", **colours, "to_uv": place}

    def number(self) -> dict:
        made = self.pattern(0, 1)
        return made if made["type"] == "checkerboard" else {**made, "raw": True}

    def bsdf(self, uv: bool = False, closed: bool = False) -> tuple[str, dict]:
        if self.chance(0.2):
            return super().bsdf(uv, closed)
        alpha = self.uniform(0.03, 0.3)
        kinds = ["conductor", "plastic", "roughconductor", "roughplastic", "principled", "blend", "mask", "both"]
        kind = self.pick(*kinds, *(["dielectric", "roughdielectric", "trans"] if closed else []))
        through = lambda: {"specular_reflectance": self.colour(0.6), "specular_transmittance": self.pattern()}
        bsdf = {
            "conductor": lambda: {"type": "conductor", "specular_reflectance": self.pattern()},
            "plastic": lambda: {"type": "plastic", "diffuse_reflectance": self.pattern()},
            "roughconductor": lambda: {"type": kind, "alpha": alpha, "specular_reflectance": self.pattern()},
            "roughplastic": lambda: {"type": kind, "alpha": alpha, "diffuse_reflectance": self.pattern()},
            "principled": lambda: {"type": kind, "base_color": self.pattern(), "roughness": 0.2 + alpha},
            "blend": lambda: {
                "type": "blendbsdf",
                "weight": self.number(),
                "one": {"type": "conductor", "specular_reflectance": self.colour(0.6)},
                "two": {"type": self.pick("diffuse", "plastic", "roughplastic")},
            },
            "mask": lambda: {
                "type": "mask",
                "opacity": self.number(),
                "inner": {"type": "twosided", "inner": {"type": self.pick("conductor", "plastic", "roughplastic")}},
            },
            "both": lambda: {
                "type": "twosided",
                "front": {"type": "conductor", "specular_reflectance": self.pattern()},
                "back": {"type": "diffuse", "reflectance": self.pattern()},
            },
            "dielectric": lambda: {"type": kind, "int_ior": self.uniform(1.1, 1.6), **through()},
            "roughdielectric": lambda: {"type": kind, "int_ior": 1.3, "alpha": 0.2 + alpha, **through()},
            "trans": lambda: {
                "type": "principled",
                "base_color": self.pattern(),
                "roughness": 0.3 + alpha,
                "spec_trans": self.uniform(0.2, 0.8),
            },
        }[kind]()
        if self.chance(0.25) and kind not in ("trans", "principled", "blend", "mask", "both"):
            return f"mapped-{kind}", self.mapped(bsdf)
        return f"patterned-{kind}", bsdf

    def mapped(self, nested: dict) -> dict:
        if self.chance(0.5):
            return {"type": "normalmap", "normalmap": self.normal_map(), "nested": nested}
        heights = mi.Bitmap(self.rng.uniform(0, 1, (5, 7, 1)).astype(np.float32))
        map_ = {"type": "bitmap", "bitmap": heights, "raw": True, "wrap_mode": self.pick("clamp", "repeat")}
        return {"type": "bumpmap", "map": map_, "scale": 0.04 * self.scale, "nested": nested}
