"""Parameters that nobody chose, of materials and lights whose every number is random:

    python tests/random_scenes.py --special parameters --seeds 950000 950020

Each material is one of Mitsuba's or of ours, with random values, numbers or textures, in all of its slots. One to three
of whatever Mitsuba lists as a differentiable parameter of the scene change together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from random_scenes import Generator

#: Last words of the names of parameters that stay: of films and clipping, and such as belong to others that change.
STAYS = ("near_clip", "far_clip", "faces", "bbox", "film", "srf", "size", "shape")

METALS = ("Au", "Cu", "Al", "Cr", "W")


class ParameterGenerator(Generator):
    """Materials of all kinds, and parameters of all kinds."""

    def number(self, low: float, high: float, uv: bool) -> Any:
        """A number, or a texture of numbers."""
        if not uv or self.chance(0.6):
            return self.uniform(low, high)
        values = self.rng.uniform(low, high, (4, 6, 1)).astype(np.float32)
        return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "wrap_mode": self.pick("clamp", "mirror")}

    def paint(self, uv: bool) -> dict:
        if not uv or self.chance(0.5):
            return self.colour()
        placed = mi.ScalarTransform3f().rotate(self.uniform(0, 360)).scale([self.uniform(0.5, 2), self.uniform(0.5, 2)])
        return {**self.bitmap(5, 7), "to_uv": placed}

    def bsdf(self, uv: bool = False, closed: bool = False, deep: int = 0) -> tuple[str, dict]:
        kinds = ["diffuse", "roughplastic", "roughconductor", "metal", "principled", "principled", "pplastic", "phong"]
        kinds += ["roughdielectric", "transmitting"] * closed + ["normalmap", "bumpmap"] * uv
        kinds += ["thin"] * (not closed and deep == 0) + ["blend", "twosided", "blend"] * (deep < 2)
        kind = "diffuse" if self.instances else self.pick(*kinds)
        n = lambda low, high: self.number(low, high, uv)
        inner = lambda: self.bsdf(uv, False, deep + 1)[1]

        def one_sided() -> dict:
            while True:
                name, made = self.bsdf(uv, True, 2)
                if name not in ("roughdielectric", "transmitting", "twosided", "principled"):
                    return made

        bsdf = {
            "diffuse": lambda: {"type": "diffuse", "reflectance": self.paint(uv)},
            "roughplastic": lambda: {
                "type": "roughplastic",
                "alpha": self.uniform(0.1, 0.4),
                "diffuse_reflectance": self.paint(uv),
                "specular_reflectance": self.paint(uv),
                "nonlinear": self.chance(0.5),
                "int_ior": self.uniform(1.2, 1.9),
                "distribution": self.pick("beckmann", "ggx"),
            },
            "roughconductor": lambda: {
                "type": "roughconductor",
                "alpha_u": n(0.1, 0.4),
                "alpha_v": n(0.1, 0.4),
                "eta": n(0.2, 3),
                "k": n(1, 4),
                "specular_reflectance": self.paint(uv),
                "distribution": self.pick("beckmann", "ggx"),
            },
            "metal": lambda: {"type": "roughconductor", "alpha": n(0.1, 0.4), "material": self.pick(*METALS)},
            "principled": lambda: {
                "type": "principled",
                "base_color": self.paint(uv),
                "roughness": n(0.3, 0.8),
                "metallic": n(0.1, 0.9),
                "anisotropic": n(0.1, 0.9),
                "spec_tint": n(0.1, 0.9),
                "sheen": n(0.1, 0.9),
                "sheen_tint": n(0.1, 0.9),
                "clearcoat": n(0.1, 0.9),
                "clearcoat_gloss": n(0.1, 0.9),
                "flatness": n(0.1, 0.9),
                **self.pick({"specular": self.uniform(0.2, 0.8)}, {"eta": self.uniform(1.2, 1.9)}),
            },
            "transmitting": lambda: {
                "type": "principled",
                "base_color": self.paint(uv),
                "roughness": n(0.4, 0.8),
                "spec_trans": n(0.3, 0.9),
                "eta": self.uniform(1.2, 1.6),
            },
            "thin": lambda: {
                "type": "principledthin",
                "base_color": self.paint(uv),
                "roughness": n(0.4, 0.8),
                "anisotropic": n(0.1, 0.9),
                "spec_trans": n(0.1, 0.9),
                "eta": self.uniform(1.2, 1.8),
                "spec_tint": n(0.1, 0.9),
                "sheen": n(0.1, 0.9),
                "sheen_tint": n(0.1, 0.9),
                "flatness": n(0.1, 0.9),
                "diff_trans": n(0.3, 1.5),
            },
            "pplastic": lambda: {
                "type": "pplastic",
                "diffuse_reflectance": self.paint(uv),
                "specular_reflectance": self.paint(uv),
                "alpha": n(0.1, 0.4),
            },
            "phong": lambda: {"type": "blinn_phong", "diffuse_reflectance": self.paint(uv)},
            "roughdielectric": lambda: {
                "type": "roughdielectric",
                "alpha_u": n(0.25, 0.5),
                "alpha_v": n(0.25, 0.5),
                "int_ior": self.uniform(1.2, 1.6),
                "specular_transmittance": self.paint(uv),
            },
            "normalmap": lambda: {"type": "normalmap", "normalmap": self.normal_map(), "bsdf": one_sided()},
            "bumpmap": lambda: {
                "type": "bumpmap",
                "texture": self.bitmap(5, 7),
                "scale": 0.05 * self.scale,  # a height
                "bsdf": one_sided(),
            },
            "blend": lambda: {"type": "blendbsdf", "weight": n(0.2, 0.8), "first": inner(), "second": inner()},
            "twosided": lambda: {"type": "twosided", "front": one_sided(), "back": one_sided()},
        }[kind]()
        return kind, bsdf

    # ---------------------- Motion ----------------------

    def make_motion(self, scene: mi.Scene, cameras: bool) -> tuple[mi.SceneParameters, Callable[[mi.Float], None]]:
        params = mi.traverse(scene)  # what is looked at counts as changed: another one is used
        keys = [k for k, _ in params if self.may_change(params, k) and (cameras or not k.startswith("sensor"))]
        chosen = [str(k) for k in self.rng.choice(keys, min(len(keys), self.pick(1, 1, 2, 3)), replace=False)]
        self.labels.append("moves " + "+".join(chosen))
        params = mi.traverse(scene)
        params.keep(chosen)
        moves = [self.change(params, key) for key in chosen]

        def move(θ: mi.Float) -> None:
            for change in moves:
                change(θ)
            params.update()

        return params, move

    def may_change(self, params: mi.SceneParameters, key: str) -> bool:
        value = params[key]
        if any(word in STAYS for word in key.split(".")) or params.flags(key) & mi.ParamFlags.NonDifferentiable:
            return False
        if key.startswith("copy") or key.startswith("group"):
            return False  # what moves must not show instances
        if dr.is_array_v(value) and dr.width(value) == 0:
            return False  # normals that a mesh does not have, say
        return (dr.is_diff_v(value) and dr.is_float_v(dr.leaf_t(value))) or dr.is_matrix_v(value) or is_frame(value)

    def change(self, params: mi.SceneParameters, key: str) -> Callable[[mi.Float], None]:
        value = params[key]
        if key.endswith("vertex_positions"):
            return self.mover(params, key, self.pick("vertices", "bend"), np.zeros(3))
        if key.endswith("to_world"):
            return self.mover(params, key, self.pick("pose", "frame"), np.zeros(3))
        if key.endswith("to_uv"):
            initial, turn = type(value)(value), self.uniform(-100, 100)
            shift = [self.uniform(-5, 5), self.uniform(-5, 5)]
            T = type(value)

            def place(θ):
                params[key] = T().translate([θ * s for s in shift]) @ T().rotate(θ * turn) @ initial

            return place
        if key.endswith(".position"):
            return self.mover(params, key, "position", np.zeros(3))
        initial = type(value)(value)
        flat = initial.array if dr.is_tensor_v(initial) else dr.ravel(initial)
        ways = mi.Float(self.rng.uniform(-10, 10, len(flat)).astype(np.float32))

        def scale(θ):
            changed = flat * (1 + ways * θ)
            if dr.is_tensor_v(initial):
                params[key] = type(initial)(changed, initial.shape)
            elif dr.depth_v(initial) > 1:
                params[key] = dr.unravel(type(initial), changed)
            else:
                params[key] = changed

        return scale


def is_frame(value: Any) -> bool:
    return type(value).__name__.startswith(("Transform3f", "Transform4f", "AffineTransform", "ProjectiveTransform"))
