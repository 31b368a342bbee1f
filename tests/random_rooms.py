"""Rooms that nobody chose, in which things stand on the floor, lean on walls and lie on each other:

    python tests/random_scenes.py --special rooms --seeds 990000 990020

A room is a box, closed or with its front open, of one mesh or of six. In it stand two to four things, each of which
touches the floor with faces, an edge or a point: boxes, stacks of them, tables, balls, cylinders. Some are pushed
against a wall. What moves slides along all that it touches, so that no gap opens: there, an image has no derivative.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from random_scenes import Generator, RandomScene, ball, quad

#: Half of the room's width and depth, and its height.
HALF, HEIGHT = 2.0, 3.0

#: Corners of the six walls, seen from inside: corner, and two sides whose cross product points into the room.
WALLS = {
    "floor": ((-1, 0, -1), (0, 0, 2), (2, 0, 0)),
    "ceiling": ((-1, 1, -1), (2, 0, 0), (0, 0, 2)),
    "left": ((-1, 0, -1), (0, 1, 0), (0, 0, 2)),
    "right": ((1, 0, -1), (0, 0, 2), (0, 1, 0)),
    "back": ((-1, 0, -1), (2, 0, 0), (0, 1, 0)),
    "front": ((-1, 0, 1), (0, 1, 0), (2, 0, 0)),
}

#: Where things stand: x and z.
PLACES = ((-1.1, -0.9), (0.9, -1.0), (0.0, 0.1), (-1.1, 0.8))


def wall(name: str) -> tuple[np.ndarray, ...]:
    o, u, v = (np.array(a, float) * [HALF, HEIGHT, HALF] for a in WALLS[name])
    p = np.stack([o, o + u, o + v, o + u + v])
    normal = np.cross(u, v)
    coordinates = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    return p, np.tile(normal / np.linalg.norm(normal), (4, 1)), coordinates, np.array([[0, 1, 2], [1, 3, 2]])


def joined(*shapes: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """One mesh of several."""
    first = np.cumsum([0, *(len(s[0]) for s in shapes[:-1])])
    parts = [np.concatenate([s[k] for s in shapes]) for k in range(3)]
    return *parts, np.concatenate([s[3] + n for s, n in zip(shapes, first, strict=True)])


def box(low, high) -> tuple[np.ndarray, ...]:
    """Six squares that look outwards."""
    low, high = np.array(low, float), np.array(high, float)
    sides = []
    for name in WALLS:
        p, n, uv, faces = wall(name)
        p = p / [2 * HALF, HEIGHT, 2 * HALF] + [0.5, 0, 0.5]
        sides.append((low + p * (high - low), -n, uv, faces[:, ::-1]))
    return joined(*sides)


class RoomGenerator(Generator):
    """Makes one room. Its lengths are not scaled, and it lies at the origin, so that "home" is everywhere."""

    def make(self) -> RandomScene:
        self.scale, self.origin, self.instances, self.glows = 1.0, np.zeros(3), False, False
        self.depth = int(self.rng.integers(3, 6))
        self.labels.append(f"prb_edge/{self.depth}")
        self.open = self.chance(0.5)
        self.make_sensor()
        self.make_walls()
        for i in range(self.rng.integers(2, 5)):
            self.make_thing(i)
        self.make_lights()
        scene = mi.load_dict(self.objects)
        params, move = self.make_motion(scene, cameras=True)
        integrator = {"type": "prb_edge", "max_depth": self.depth, "rr_depth": 100}
        return RandomScene(scene, params, move, integrator, self.depth, " ".join(self.labels))

    def make_sensor(self) -> None:
        rfilter = self.pick("box", "box", "gaussian", "tent")
        film = {"type": "hdrfilm", "width": 20, "height": 20, "rfilter": {"type": rfilter}, "pixel_format": "rgb"}
        film |= {"component_format": "float32", "sample_border": self.chance(0.5)}
        z = self.uniform(4, 6) if self.open else self.uniform(1.5, 1.9)
        origin = np.array([self.uniform(-1.2, 1.2), self.uniform(0.8, 2.2), z])
        target = [self.uniform(-0.6, 0.6), self.uniform(0.3, 0.8), -0.8]
        fov = self.uniform(35, 45) if self.open else self.uniform(60, 80)
        kind = self.pick("perspective", "perspective", "perspective", "thinlens")
        sensor = {"type": kind, "to_world": self.look(origin, target), "film": film, "fov": fov}
        if kind == "thinlens":
            sensor |= {"aperture_radius": 0.05, "focus_distance": 4.0}
        self.objects["sensor"] = {**sensor, "sampler": {"type": self.sampler}, "near_clip": 0.01, "far_clip": 1000.0}
        self.labels.append(f"{'open' if self.open else 'closed'} {kind}/{rfilter}")
        self.movable["camera"] += [("sensor.to_world", "pose", origin)] * 3
        self.movable["camera"].append(("sensor.x_fov", "number", np.array([4.0])))

    def make_walls(self) -> None:
        names = [n for n in WALLS if not (self.open and n == "front")]
        if self.chance(0.4):
            shape = joined(*(wall(n) for n in names))
            kind, bsdf = self.bsdf()
            self.objects["room"] = self.mesh("room", shape, np.eye(3), [0, 0, 0], self.two_sided(bsdf))
            self.labels.append(f"room:{kind}")
            return
        for n in names:
            kind, bsdf = self.bsdf(uv=True)
            self.objects[n] = self.mesh(n, wall(n), np.eye(3), [0, 0, 0], self.two_sided(bsdf))
            self.labels.append(f"{n}:{kind}")
            if kind == "diffuse":
                self.movable["look"].append((f"{n}.bsdf.brdf_0.reflectance.value", "colour", np.zeros(3)))

    def make_thing(self, i: int) -> None:
        """All stand upright, turned about the vertical where no wall is in the way."""
        kind = self.pick("box", "box", "stack", "table", "ball", "ball", "sphere", "cylinder", "wedge")
        x, z = np.array(PLACES[i]) + self.rng.uniform(-0.15, 0.15, 2)
        half, tall = self.uniform(0.25, 0.45), self.uniform(0.4, 1.2)
        at_wall = self.chance(0.35) and kind in ("box", "stack", "table") and PLACES[i][1] < -0.5
        angle = 0.0 if at_wall else self.uniform(0, 90)
        z = half - HALF if at_wall else z
        turn = np.array(mi.ScalarTransform4f().rotate([0, 1, 0], angle).matrix)[:3, :3]
        material, bsdf = self.bsdf(uv=kind != "sphere")
        bsdf, name, centre = self.two_sided(bsdf), f"thing{i}", np.array([x, 0, z])
        b = lambda x0, y0, z0, x1, y1, z1: box([x0 * half, y0 * tall, z0 * half], [x1 * half, y1 * tall, z1 * half])
        key, how, smooth = f"{name}.vertex_positions", "slide along x" if at_wall else "slide", False
        if kind in ("sphere", "cylinder"):
            upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)
            linear = np.eye(3) * half if kind == "sphere" else upright @ np.diag([half, half, tall])
            centre[1] = half if kind == "sphere" else 0.0
            self.objects[name] = {"type": kind, "to_world": self.frame(linear, centre), "bsdf": bsdf}
            key = f"{name}.to_world"
        else:
            n = self.pick(6, 12, 24)
            shape = {
                "box": lambda: b(-1, 0, -1, 1, 1, 1),
                "stack": lambda: joined(b(-1, 0, -1, 1, 0.5, 1), b(-0.6, 0.5, -1, 0.7, 1, 0.5)),
                "table": lambda: joined(
                    b(-1, 0.8, -1, 1, 1, 1),
                    *(b(x, 0, z, x + 0.3, 0.8, z + 0.3) for x in (-0.9, 0.6) for z in (-0.9, 0.6)),
                ),
                "ball": lambda: ball(n),
                "wedge": lambda: b(-1, 0, -1, 1, 1, 1),
            }[kind]()
            if kind == "wedge":  # the upper face leans down to one edge on the floor
                p = shape[0].copy()
                p[(p[:, 0] > 0) & (p[:, 1] > 0), 1] = 0.0
                edges = p[shape[3]]
                area = np.linalg.norm(np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0]), axis=1)
                shape = (p, shape[1], shape[2], shape[3][area > 1e-9])
            smooth = kind == "ball" and self.chance(0.6)
            linear = turn
            if kind == "ball":
                linear, centre[1] = half * np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), half
            self.objects[name] = self.mesh(name, shape, linear, centre, bsdf, smooth=smooth, uv=kind != "wedge")
        self.labels.append(f"{'smooth-' * smooth}{kind}:{material}{'@wall' * at_wall}")
        self.movable["thing"] += [(key, how, centre)] * 3

    def make_lights(self) -> None:
        kinds = ["ceiling", "ceiling", "hanging", "bulb", "point"] + ["sky", "window"] * self.open
        for i, kind in enumerate(self.rng.permutation(kinds)[: self.pick(1, 1, 2)]):
            name, power = f"light{i}", self.uniform(0.6, 1.4)
            centre = np.array([self.uniform(-1, 1), HEIGHT, self.uniform(-1, 1)])
            down = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
            area = lambda v: {"type": "area", "radiance": {"type": "rgb", "value": [v, 0.9 * v, 0.8 * v]}}
            key, how = f"{name}.vertex_positions", "slide"
            if kind == "ceiling":  # just below it
                centre[1] -= 0.01
                lamp = self.mesh(name, quad(), 0.4 * down, centre, None, area(12 * power), uv=False)
            elif kind == "hanging":
                centre[1] = 2.2
                lamp, how = self.mesh(name, quad(), 0.35 * down, centre, None, area(14 * power), uv=False), "vertices"
            elif kind == "window":  # outside of the open front, behind the camera
                centre = np.array([self.uniform(-1, 1), 2.0, 7.0])
                lamp = self.mesh(name, quad(), np.diag([-1.5, 1.2, -1.0]), centre, None, area(20 * power), uv=False)
                how = "vertices"
            elif kind == "bulb":
                centre[1] = 2.0
                lamp = {"type": "sphere", "to_world": self.frame(0.15 * np.eye(3), centre), "emitter": area(30 * power)}
                key, how = f"{name}.to_world", "frame"
            elif kind == "point":
                centre[1] = 2.3
                lamp = {"type": "point", "position": list(centre), "intensity": {"type": "rgb", "value": 8 * power}}
                key, how = f"{name}.position", "position"
            else:
                lamp = {"type": "constant", "radiance": {"type": "rgb", "value": 0.7 * power}}
            self.objects[name] = lamp
            self.labels.append(str(kind))
            if kind != "sky":
                self.movable["light"].append((key, how, centre))

    def mover(self, params, key: str, how: str, centre) -> Callable[[mi.Float], None]:
        """ "slide" is along the floor, and about the vertical; "slide along x" is along the wall at the back."""
        if not how.startswith("slide"):
            return super().mover(params, key, how, centre)
        initial = type(params[key])(params[key])
        free = how == "slide"
        a = self.uniform(0, 2 * np.pi) if free else 0.0
        way, turn = mi.Vector3f(float(np.cos(a)), 0, float(np.sin(a))), self.uniform(-20, 20) * free
        centre = mi.Vector3f(*map(float, centre))

        def change(θ: mi.Float) -> None:
            T = mi.Transform4f
            moved = T().translate(way * θ + centre) @ T().rotate([0, 1, 0], θ * turn) @ T().translate(-centre)
            if key.endswith("vertex_positions"):
                params[key] = dr.ravel(moved @ dr.unravel(mi.Point3f, initial))
            else:
                params[key] = moved @ initial

        return change
