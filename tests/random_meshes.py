"""Meshes as they come: torn, turned round, cut through themselves, of blades and of soup:

    python tests/random_scenes.py --special meshes --seeds 952000 952020

Faces are missing or look the other way, some have no area, some vertices belong to none; several faces share one edge;
the two sides of a sheet are closer to each other than rays like it. Materials have one side or two.
"""

from __future__ import annotations

import numpy as np
from random_scenes import Generator, ball, quad


class MeshGenerator(Generator):
    """Things that are meshes of the worst kind. None of them is a lamp."""

    def make_thing(self, i: int) -> None:
        name = f"thing{i}"
        centre = [[-0.9, 0.5, 0], [0.9, 0.7, -0.3], [0, 1.6, 0.4]][i] + self.rng.uniform(-0.1, 0.1, 3)
        linear = self.rotation() * self.uniform(0.35, 0.55)
        kind = self.pick("soup", "soup", "torn", "torn", "shell", "blades", "sheet", "star")
        points, normals, faces = getattr(self, kind)()
        smooth = kind == "torn" and self.chance(0.4)
        material, bsdf = self.bsdf(False, False)
        bsdf = self.two_sided(bsdf) if self.chance(0.7) else bsdf
        shape = points, normals, np.zeros((len(points), 2)), faces
        self.objects[name] = self.mesh(name, shape, linear, centre, bsdf, None, smooth, False)
        self.labels.append(f"{'smooth-' * smooth}{kind}:{material}:{bsdf['type']}/{len(faces)}")
        self.movable["thing"] += [(f"{name}.vertex_positions", how, centre) for how in ("vertices",) * 3 + ("bend",)]

    def soup(self):
        """Triangles anywhere, which cut each other."""
        n, size = self.pick(5, 20, 80, 300), self.pick(0.1, 0.3)
        centre = self.rng.normal(size=(n, 1, 3))
        centre *= 0.8 * self.rng.random((n, 1, 1)) ** (1 / 3) / np.linalg.norm(centre, axis=2, keepdims=True)
        points = (centre + size * self.rng.normal(size=(n, 3, 3))).reshape(-1, 3)
        return flat(points, np.arange(3 * n).reshape(-1, 3))

    def torn(self):
        """A ball with holes, of which some faces look inwards, some have no area, and some vertices have no face."""
        points, normals, _, faces = ball(self.pick(4, 8, 12))
        faces = faces[self.rng.random(len(faces)) < 0.75]
        turned = self.rng.random(len(faces)) < self.pick(0, 0.3)
        faces = np.where(turned[:, None], faces[:, ::-1], faces)
        line = self.rng.integers(0, len(points), (3, 1)) + np.array([0, 0, 1])
        faces = self.rng.permutation(np.concatenate([faces, line % len(points)]))
        faces = np.array([np.roll(f, self.rng.integers(3)) for f in faces])
        lost = self.rng.normal(size=(4, 3))
        return np.concatenate([points, lost]), np.concatenate([normals, np.tile([0, 0, 1.0], (4, 1))]), faces

    def shell(self):
        """Two balls, one just inside of the other, with the same holes."""
        points, normals, _, faces = ball(8)
        faces = faces[self.rng.random(len(faces)) < 0.7]
        inner = points * (1 - self.pick(1e-3, 1e-2, 0.1))
        both = np.concatenate([faces, faces[:, ::-1] + len(points)])
        return np.concatenate([points, inner]), np.concatenate([normals, -normals]), both

    def blades(self):
        """Narrow strips that bend."""
        points, faces = [], []
        for blade in range(self.pick(5, 30)):
            start, along = 0.3 * self.rng.normal(size=3), self.rng.normal(size=3)
            across = np.cross(along, self.rng.normal(size=3))
            across *= self.pick(0.01, 0.05) / np.linalg.norm(across)
            for j in range(6):
                middle = start + 0.06 * j * along + 0.02 * self.rng.normal(size=3)
                points += [middle - across, middle + across]
            for k in range(12 * blade, 12 * blade + 10, 2):
                faces += [[k, k + 1, k + 2], [k + 1, k + 3, k + 2]]
        return flat(np.array(points), np.array(faces))

    def sheet(self):
        """Front and back of a square, close to each other."""
        points, normals, _, faces = quad()
        back = points - [0, 0, self.pick(1e-4, 1e-3, 1e-2)]
        both = np.concatenate([faces, faces[:, ::-1] + 4])
        return np.concatenate([points, back]), np.concatenate([normals, -normals]), both

    def star(self):
        """Several triangles with one common edge."""
        angle = 0.3 + 2 * np.pi * np.arange(n := self.pick(3, 5, 9)) / n
        around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
        return flat(np.concatenate([[[0, 0, -1], [0, 0, 1]], around]), np.array([[0, 1, 2 + k] for k in range(n)]))


def flat(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return points, np.tile([0, 0, 1.0], (len(points), 1)), faces
