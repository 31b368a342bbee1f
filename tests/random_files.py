"""Scenes as they come from files, loaded as Mitsuba does by default:

    python tests/random_scenes.py --special files --seeds 956000 956020

Two or three materials are shared by the floor and the things. Meshes are read from PLY files, some of them
with the vertex normals that Mitsuba computes for files without any. Mitsuba makes one mesh of all those that share a
material; where one of them moves, a part of that mesh does.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from random_scenes import Generator, RandomScene, ball, tetrahedron, torus


class FileGenerator(Generator):
    """Scenes whose meshes are files, and share their materials."""

    def make(self) -> RandomScene:
        self.materials: list[tuple[str, bool, bool]] = []
        # Mitsuba joins meshes only where all or none of them have normals.
        self.normals = self.pick("none", "none", "all", "as they come")
        self.most = self.pick(1, 2, 2, 3)
        #: Largest distance of a vertex from the centre of a thing; that of a cube, as long as it has no file.
        self.reach: dict[str, float] = defaultdict(lambda: 0.7)
        with tempfile.TemporaryDirectory() as folder:
            self.folder = Path(folder)
            return super().make()

    def bsdf(self, uv: bool = False, closed: bool = False) -> tuple[str, dict]:
        """One of those that there are, or a new one; on both sides, so that each suits all shapes."""
        suitable = [
            name for name, needs_uv, needs_inside in self.materials if uv >= needs_uv and closed >= needs_inside
        ]
        if suitable and (self.chance(0.75) or len(self.materials) >= self.most):
            name = self.pick(*suitable)
            return name, {"type": "ref", "id": name}
        kind, made = super().bsdf(uv, closed)
        name = f"{kind}{len(self.materials)}"
        inside = kind == "roughdielectric"
        self.objects[name] = made if inside else super().two_sided(made)
        self.materials.append((name, kind in ("texture", "normalmap"), inside))
        return name, {"type": "ref", "id": name}

    @staticmethod
    def two_sided(bsdf: dict) -> dict:
        return bsdf  # it is already

    def mesh(self, name, shape, linear, centre, bsdf=None, emitter=None, smooth=False, uv=True) -> dict:
        path = self.folder / f"{name}.ply"
        self.reach[name] = 1.01 * float(np.linalg.norm(shape[0] @ np.asarray(linear).T, axis=1).max())
        smooth &= self.normals != "none" or bool(emitter)
        super().mesh(name, shape, linear, centre, smooth=smooth, uv=True).write_ply(str(path))
        fine = len(shape[3]) > 30 or name == "floor"
        computed = not emitter and not smooth and fine and self.normals == "all"
        self.labels += ["computed normals"] * computed
        made = {"type": "ply", "filename": str(path), "face_normals": not smooth and not computed}
        made |= {"bsdf": bsdf} if bsdf else {}
        return made | ({"emitter": emitter} if emitter else {})

    def make_floor(self) -> None:
        """And a thing that never moves, in the background."""
        super().make_floor()
        shape, q = self.pick(ball(8), torus(8), tetrahedron()), self.rotation() * 0.6
        self.objects["aside"] = self.mesh("aside", shape, q, [self.pick(-2, 2), 0.6, -1.9], self.bsdf(True)[1])

    def make_motion(self, scene: mi.Scene, cameras: bool):
        params = mi.traverse(scene)
        positions = {key: np.array(value).reshape(-1, 3) for key, value in params if key.endswith("vertex_positions")}
        #: Of the meshes of which a thing has become a part: whether each vertex is the thing's.
        self.parts: dict[tuple, np.ndarray] = {}
        things = []
        for key, how, centre in self.movable["thing"]:
            if key not in params:
                reach = self.reach[key.split(".")[0]] * self.scale
                near = {k: np.linalg.norm(p - self.place(centre), axis=1) < reach for k, p in positions.items()}
                key = max(near, key=lambda k: near[k].sum())
                self.parts[(key, *centre)], how = near[key], f"part {how}"
            things.append((key, how, centre))
        self.movable["thing"] = things
        self.labels.append(f"{len(scene.shapes())} of {self.files()} shapes")
        return super().make_motion(scene, cameras)

    def files(self) -> int:
        return sum(
            isinstance(o, dict) and bool({"bsdf", "filename", "emitter"} & set(o)) for o in self.objects.values()
        )

    def mover(self, params, key: str, how: str, centre) -> Callable[[mi.Float], None]:
        whole = super().mover(params, key, how.removeprefix("part "), centre)
        if not how.startswith("part"):
            return whole
        still = type(params[key])(params[key])
        part = mi.Bool(np.repeat(self.parts[(key, *centre)], 3))

        def change(θ: mi.Float) -> None:
            whole(θ)
            params[key] = dr.select(part, params[key], still)

        return change
