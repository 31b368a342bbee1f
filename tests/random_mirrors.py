"""Hard shadows, textures and outlines that perfect mirrors and glass show:

    python tests/random_scenes.py --special mirrors --seeds 953000 953020

All lights are points, spots and suns, and paths have three segments at most: so mirrors throw no light on other
surfaces, and nothing is missing.
"""

from __future__ import annotations

import numpy as np
from random_scenes import Generator, quad


class MirrorGenerator(Generator):
    """Half of the things are perfect mirrors or glass; and there is a mirrored wall behind, or a pane before them."""

    def longest(self) -> int:
        return 3

    def mirror(self) -> tuple[str, dict]:
        kind = self.pick("conductor", "conductor", "plastic", "thindielectric", "dielectric", "glass")
        made = {
            "conductor": lambda: {"type": "conductor", "specular_reflectance": self.colour(0.6)},
            "plastic": lambda: {"type": "plastic", "diffuse_reflectance": self.colour()},
            "thindielectric": lambda: {"type": "thindielectric"},
            "dielectric": lambda: {"type": "dielectric", "int_ior": self.uniform(1.1, 1.6)},
            "glass": lambda: {"type": "glass", "eta": self.uniform(1.1, 1.6)},
        }
        return kind, made[kind]()

    def bsdf(self, uv: bool = False, closed: bool = False) -> tuple[str, dict]:
        return self.mirror() if closed and self.chance(0.4) else super().bsdf(uv, closed)

    def make_floor(self) -> None:
        super().make_floor()
        kind, bsdf = self.mirror()
        linear = np.diag([self.uniform(0.8, 2), self.uniform(0.8, 2), 1])
        behind = self.chance(0.6)
        turned = self.rotation_of(self.uniform(-20, 20)) @ (linear * [[-1, 1, 1]] if behind else linear)
        centre = [self.uniform(-0.5, 0.5), 1.2, 2.2] if behind else [self.uniform(-0.3, 0.3), 0.8, -1.6]
        bsdf = self.two_sided(bsdf) if kind in ("conductor", "plastic") else bsdf
        self.objects["wall"] = self.mesh("wall", quad(), turned, centre, bsdf, uv=False)
        self.labels.append(f"{'behind' if behind else 'before'}:{kind}")
        self.movable["thing"].append(("wall.vertex_positions", "vertices", np.array(centre)))

    @staticmethod
    def rotation_of(degrees: float) -> np.ndarray:
        s, c = np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
