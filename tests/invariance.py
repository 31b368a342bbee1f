"""Scenes and comparisons for what must not change a derivative: where the scene is, how large, how its meshes are cut.

Nothing here needs a reference. The scenes have a fixed structure, of which only the numbers vary, so that they share
their kernels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
from random_scenes import ball
from scipy.spatial.transform import Rotation

from rimlight.checks import Agreement, FiniteDifferences, Motion, compare, derivative_image

RES = 16

Vector = tuple[float, float, float]

#: Where the lamp without size is.
BULB = (-1.3, 2.5, -1.2)


@dataclass(frozen=True)
class Numbers:
    """What varies from scene to scene, in units of 1.

    turn, shift : of the cube, a rotation vector in radians, and where it hovers.
    ball, lamp, eye : where they are, added to their usual place.
    first, second : velocities.
    axis, pivot : of what turns.
    """

    turn: Vector
    shift: Vector
    ball: Vector
    lamp: Vector
    eye: Vector
    first: Vector
    second: Vector
    axis: Vector
    pivot: Vector


@dataclass(frozen=True)
class Place:
    """Where a scene is: a point p of it at `scale` · `turn` · p + `shift`."""

    scale: float = 1.0
    turn: Vector = (0, 0, 0)
    shift: Vector = (0, 0, 0)

    @property
    def rotation(self) -> np.ndarray:
        return Rotation.from_rotvec(self.turn).as_matrix()

    def points(self, p: Any) -> np.ndarray:
        return self.scale * np.asarray(p, float) @ self.rotation.T + self.shift

    def direction(self, d: Any) -> np.ndarray:
        """A velocity, which grows with the scene, so that the image changes as fast."""
        return self.scale * self.rotation @ np.asarray(d, float)

    def axis(self, a: Any) -> np.ndarray:
        return self.rotation @ np.asarray(a, float)

    @property
    def rigid(self) -> np.ndarray:
        """4 × 4, without the scale."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.shift
        return matrix


@dataclass(frozen=True)
class Triangles:
    """A flat-shaded mesh: vertices (V, 3), and faces (F, 3)."""

    p: np.ndarray
    faces: np.ndarray

    def split(self) -> Triangles:
        """Every triangle with vertices of its own."""
        return Triangles(self.p[self.faces].reshape(-1, 3), np.arange(self.faces.size).reshape(-1, 3))

    def subdivided(self) -> Triangles:
        """Every triangle in four."""
        points, index = [*map(tuple, self.p)], {}

        def middle(i: int, j: int) -> int:
            key = (min(i, j), max(i, j))
            if key not in index:
                index[key] = len(points)
                points.append(tuple((self.p[i] + self.p[j]) / 2))
            return index[key]

        faces = []
        for a, b, c in self.faces:
            d, e, f = middle(a, b), middle(b, c), middle(c, a)
            faces += [[a, d, f], [d, b, e], [f, e, c], [d, e, f]]
        return Triangles(np.array(points), np.array(faces))


def square(half: float, centre: Any, down: bool = False) -> Triangles:
    corners = np.array([[-half, 0, -half], [-half, 0, half], [half, 0, -half], [half, 0, half]]) + centre
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    return Triangles(corners, faces[:, ::-1] if down else faces)


@dataclass(frozen=True)
class Subject:
    """A scene to be differentiated.

    numbers : what varies.
    integrator : `direct_edge`, whose scene has a lamp without size as well, or `prb_edge`.
    place : where it is.
    split, subdivided : its cube; and floor and lamp as well, if subdivided.
    merged : floor and cube are one mesh, called "cube".
    glossy : the floor, so that what it mirrors of lamps has boundaries of its own.
    sky : an environment map, too. bulb : with `direct_edge`, a lamp without size.
    """

    numbers: Numbers
    integrator: str = "direct_edge"
    place: Place = Place()
    split: bool = False
    subdivided: bool = False
    merged: bool = False
    glossy: bool = False
    sky: bool = True
    bulb: bool = True

    def but(self, **changes: Any) -> Subject:
        return replace(self, **changes)

    def scene(self) -> mi.Scene:
        n, at = self.numbers, self.place
        parts = self._parts()
        look = mi.ScalarTransform4f().look_at([*np.add([0.6, 1.8, -3.6], n.eye)], [0, 0, 0], [0, 1, 0])
        pose = at.rigid @ np.diag([at.scale, at.scale, at.scale, 1]) @ np.array(look.matrix)
        pose[:3, :3] /= at.scale
        grey, brown = cases.diffuse(0.5), cases.diffuse(0.6, 0.5, 0.4)
        floor = {"type": "roughconductor", "alpha": 0.3} if self.glossy else grey
        points, _, _, faces = ball(5)
        globe = at.points(0.4 * points + np.add([0.8, 0.1, 0.3], n.ball))
        lights: dict[str, Any] = {}
        if self.integrator == "direct_edge" and self.bulb:
            power = {"type": "rgb", "value": [3 * at.scale**2] * 3}
            lights["bulb"] = {"type": "point", "position": [*at.points(BULB)], "intensity": power}
        if self.sky:
            turned = np.eye(4)
            turned[:3, :3] = at.rotation
            lights["sky"] = {**cases.surroundings(), "to_world": mi.ScalarTransform4f(turned), "scale": 0.3}
        film = cases.film(width=RES, height=RES, pixel_format="luminance")
        clip = {"near_clip": 0.05 * at.scale, "far_clip": 100 * at.scale}
        sensor = {"type": "perspective", "fov": 42, "film": film, "to_world": mi.ScalarTransform4f(pose), **clip}
        meshes = {
            name: cases.mesh(name, at.points(t.p), t.faces, bsdf=floor if name == "floor" else grey)
            for name, t in parts.items()
            if name != "lamp"
        }
        lamp = parts["lamp"]
        meshes["lamp"] = cases.mesh(
            "lamp", at.points(lamp.p), lamp.faces, bsdf=cases.diffuse(0.2), emitter=cases.light(8, 7, 6)
        )
        meshes["ball"] = cases.mesh("ball", globe, faces, normals=True, bsdf=brown)
        return cases.scene(sensor=sensor, **meshes, **lights)

    def _parts(self) -> dict[str, Triangles]:
        n = self.numbers
        corners = 0.35 * np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
        corners = Rotation.from_rotvec(n.turn).apply(corners) + np.add([-0.5, 0, 0], n.shift)
        parts = {
            "floor": square(2, [0, -0.9, 0]),
            "cube": Triangles(corners, np.array(cases.CUBE_FACES)),
            "lamp": square(0.4, np.add([0.5, 2.2, -0.3], n.lamp), down=True),
        }
        if self.split:
            parts["cube"] = parts["cube"].split()
        if self.subdivided:
            parts = {name: t.subdivided() for name, t in parts.items()}
        if self.merged:
            cube, floor = parts["cube"], parts.pop("floor")
            parts["cube"] = Triangles(
                np.concatenate([cube.p, floor.p]), np.concatenate([cube.faces, floor.faces + len(cube.p)])
            )
        return parts

    def flight(self, **velocities: Vector) -> list[dict[str, Any]]:
        """Arguments of `Motion`: these things fly along. What stands still may be among them, with velocity 0."""
        moves = []
        for name, velocity in velocities.items():
            key = "sensor.to_world" if name == "sensor" else f"{name}.vertex_positions"
            moves.append({"key": key, "direction": self.place.direction(velocity)})
            if name == "cube" and self.merged:
                moves[-1]["vertices"] = range(len(self._parts()["cube"].p) - 4)
        return moves

    def turning(self, axis: Vector, pivot: Vector, *names: str) -> list[dict[str, Any]]:
        """Arguments of `Motion`: these things turn together."""
        moves = []
        for name in names:
            turn = {"rotate": axis, "pivot": pivot}
            if name == "bulb":
                velocity = np.cross(axis, np.subtract(BULB, pivot)) / np.linalg.norm(axis)
                moves.append({"key": "bulb.position", "direction": velocity})
            else:
                moves.append({"key": f"{name}.{'to_world' if name == 'sensor' else 'vertex_positions'}", **turn})
        return moves

    def images(self, moves: Sequence[dict[str, Any]], seeds: Sequence[int], spp: int) -> np.ndarray:
        """Derivatives: (N, H, W, C)."""
        scene, integrator = self.scene(), self.make_integrator()
        together = Together.of(scene, moves)
        return np.array([derivative_image(scene, integrator, together, spp=spp, seed=s) for s in seeds], np.float64)

    def grown(self, names: Sequence[str], pivot: Vector, seed: int, spp: int) -> np.ndarray:
        """Derivative: (H, W, C)."""
        scene = self.scene()
        growth = Growth(scene, names, pivot)
        return np.array(derivative_image(scene, self.make_integrator(), growth, spp=spp, seed=seed), np.float64)

    def make_integrator(self) -> mi.Integrator:
        depth = {"max_depth": 3} if self.integrator == "prb_edge" else {}
        return mi.load_dict({"type": self.integrator, **depth})


class Growth:
    """Everything grows about a point by the factor 1 + θ, and so does the distance of the sensor: the image stays. In
    place of a `Motion`."""

    def __init__(self, scene: mi.Scene, names: Sequence[str], pivot: Vector):
        self.params = mi.traverse(scene)
        self.pivot = mi.Vector3f(*map(float, pivot))
        keys = [f"{name}.vertex_positions" for name in names]
        self.initial = {key: mi.Float(self.params[key]) for key in keys}
        self.pose = mi.AffineTransform4f(self.params["sensor.to_world"])

    def apply(self, theta: mi.Float | float) -> None:
        theta = mi.Float(theta)
        for key, value in self.initial.items():
            p = dr.unravel(mi.Point3f, value)
            self.params[key] = dr.ravel(p + theta * (p - self.pivot))
        eye = self.pose @ mi.Point3f(0)
        self.params["sensor.to_world"] = mi.Transform4f().translate(theta * (eye - self.pivot)) @ self.pose
        self.params.update()

    def restore(self) -> None:
        self.apply(0)


class Together:
    """Several motions with one θ, in place of a `Motion`."""

    unit = "unit"

    def __init__(self, motions: Sequence[Motion]):
        self.motions = motions
        self.params = motions[0].params

    @staticmethod
    def of(scene: mi.Scene, moves: Sequence[dict[str, Any]]) -> Together:
        """From arguments of `Motion`."""
        return Together([Motion(scene, **move) for move in moves])

    def apply(self, theta: mi.Float | float) -> None:
        for motion in self.motions:
            motion.apply(theta)

    def restore(self) -> None:
        for motion in self.motions:
            motion.restore()


def difference(a: np.ndarray, b: np.ndarray, tolerance: float = 0.0) -> Agreement:
    """Do two estimates agree, (N, H, W, C) each? Image i of both may share random numbers: what they share cancels.

    The mean of both is what the difference is compared with: to that, the noise of neither is closer.
    """
    mean = (a.mean(0) + b.mean(0)) / 2
    return compare(mean + a - b, FiniteDifferences(mean, 0 * mean, 0 * mean, {}), tolerance=tolerance)
