"""Scenes as people build them: upright, in line with each other and with the axes, one on top of the other:

    python tests/random_scenes.py --special tidy --seeds 958000 958020

Faces lie in one plane with others, edges on edges and on lines of textures, lights shine along faces, and what a mirror
or a sheet of glass shows of a thing lies where the thing does. Random scenes have none of that. What moves slides
along all that it touches, and nothing turns that light or the camera sees edge-on: there, an image has no derivative.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from random_patterns import PatternGenerator
from random_rooms import box
from random_scenes import Generator, ball, grid, quad

#: Height of the floor, and half of its width.
FLOOR, HALF = -0.4, 3.0

#: Directions of suns that shine along faces.
ALONG = ((0, -1, 0), (1, -1, 0), (-1, -2, 0), (0, -1, -1), (0, -2, 1), (0, -1, -2))

#: Half of the widths of things.
HALVES = (0.25, 0.375, 0.5)

GLASS = ("dielectric", "glass", "roughdielectric")

#: Radii of cups at the foot and at the rim.
RADII = ((0.6, 1.0), (0.4, 1.0), (1.0, 0.7))


def cup(foot: float, rim: float) -> tuple[np.ndarray, ...]:
    """Walls that lean, of height 2, open below and above."""

    def point(φ, v):
        r, across = foot + (rim - foot) * v, np.stack([np.cos(φ), np.sin(φ)], 1)
        normal = np.concatenate([2 * across, np.full((len(φ), 1), foot - rim)], 1)
        return np.column_stack([r[:, None] * across, 2 * v - 1]), normal / np.linalg.norm(normal, axis=1)[:, None]

    return grid(point, 16, 2)


class TidyGenerator(PatternGenerator):
    """Two or three things on a floor, in a row or in a stack, and perhaps a wall of mirror, glass or plaster."""

    def __init__(self, seed: int, *args, **options):
        super().__init__(seed, *args, **options)
        #: Apart from `rng`: what came later does not change the rest of a scene.
        self.later = np.random.default_rng([seed, 15])

    def bsdf(self, uv: bool = False, closed: bool = False) -> tuple[str, dict]:
        which = self.pick("plain", "plain", "mirror", "pattern")
        if which == "mirror" and closed:
            return self.mirror()
        return super().bsdf(uv, closed) if which == "pattern" and uv else Generator.bsdf(self, False, closed)

    def make_sensor(self) -> None:
        super().make_sensor()
        sensor = self.objects["sensor"]
        #: Is the camera in front of all, on the axis?
        self.on_axis = sensor["type"] == "perspective" and self.chance(0.4)
        if self.on_axis:
            sensor["to_world"] = self.look([0, self.pick(0.85, 1.35), 4.6], [0, self.pick(0.35, 0.85), 0])
            self.labels[-1] += "/along"
        #: Is it a front view, or a plan, in which faces are seen edge-on?
        self.upright = sensor["type"] == "orthographic" and self.chance(0.7)
        if self.upright:
            origin, up = self.pick(([0.1, 0.5, 4.6], (0, 1, 0)), ([0.1, 4.6, 0.2], (0, 0, -1)))
            target = origin * np.array([1, up[1], up[2] != 0])
            size = 1.7 * self.scale
            sensor["to_world"] = self.look(origin, target, up) @ mi.ScalarTransform4f().scale([size, size, 1])
            self.movable["camera"] = [("sensor.to_world", "along", np.zeros(3))]
            self.labels[-1] += "/front" if up[1] else "/plan"

    def make_floor(self) -> None:
        kind, bsdf = self.bsdf(uv=True)
        #: Must things stand still, since they hide what lies on one side of a line? Do two touch along the first axis?
        self.still, self.in_row = kind.startswith("patterned"), False
        #: Does a light shine along faces?
        self.along = False
        if self.chance(0.3):
            kind, lines = "aligned", mi.ScalarTransform3f().scale([self.pick(6, 12, 24), self.pick(6, 12, 24)])
            board = {"type": "checkerboard", "color0": 0.1, "color1": self.colour(), "to_uv": lines}
            bsdf = {"type": self.pick("diffuse", "roughplastic")}
            bsdf["reflectance" if bsdf["type"] == "diffuse" else "diffuse_reflectance"] = board
            self.still = True
        if bsdf["type"] == "diffuse":
            bsdf = self.two_sided(bsdf)
        flat = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) * HALF
        self.objects["floor"] = self.mesh("floor", quad(), flat, [0, FLOOR, 0], bsdf)
        self.labels.append(f"floor:{kind}")
        if self.chance(0.6):
            self.make_wall()

    def make_wall(self) -> None:
        where = self.pick("behind", "beside", "before", "across")
        kind, bsdf = self.mirror() if self.chance(0.7) else self.bsdf(uv=True)
        if where == "before":
            kind, bsdf = "thindielectric", {"type": "thindielectric"}
        bsdf = bsdf if bsdf["type"] in ("thindielectric", "mask", "dielectric", "glass") else self.two_sided(bsdf)
        below = self.pick(0, 0, 0.5)  # does it stand on the floor, or go through it?
        width, height = self.pick(1.0, 1.5, 2.0), self.pick(0.5, 0.75, 1.0)
        x, z = {"behind": (0, -1.5), "beside": (-1.75, 0), "before": (0, 1.5), "across": (0, 0)}[where]
        turned = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) if where in ("beside", "across") else np.eye(3)
        linear = turned @ np.diag([width, height, 1])
        self.objects["wall"] = self.mesh("wall", quad(), linear, [x, FLOOR + height - below, z], bsdf)
        self.labels.append(f"{where}:{kind}{'/cut' if below else ''}")
        if where == "across" and self.on_axis:
            self.movable["camera"] = [("sensor.to_world", "across", np.zeros(3))]  # does not leave the wall's plane
        if kind in ("conductor", "thindielectric") and not self.still:
            self.movable["thing"].append(("wall.vertex_positions", "along" if turned[0, 0] else "across", np.zeros(3)))

    def make_thing(self, i: int) -> None:
        half = HALVES[self.rng.integers(3)] if i == 0 else self.pick(*(h for h in HALVES if h != self.first))
        place = "floor" if i == 0 else self.pick("floor", "stack") if i == 2 else self.pick("floor", "row", "sunk")
        if i == 0:
            self.first = half
            base, x, z = FLOOR, -0.75, self.pick(0, 0.25, -0.25)
            self.at = x, z
        else:
            base = FLOOR + 2 * self.first if place == "stack" else FLOOR - half if place == "sunk" else FLOOR
            x, z = {"floor": ((0.75, 0.25), (0.5, 1.0))[i - 1], "sunk": (0.75, -0.25)}.get(place, self.at)
            x += self.first + half if place == "row" else 0
        self.in_row |= place == "row"
        kind = self.pick("box", "box", "cube", "sphere", "cylinder", "ball", "smooth")
        if place == "stack" and i and self.round_first:
            kind = "sphere"  # touches the first in a point, at most
        material, bsdf = self.bsdf(kind in ("box", "ball", "smooth"), kind != "cylinder")
        if self.later.random() < {"cylinder": 0.6, "cube": 0.6}.get(kind, 0) and bsdf["type"] not in GLASS:
            kind = "cup"
        if kind in ("cylinder", "cup") and bsdf["type"] not in ("roughdielectric", "thindielectric", "mask"):
            bsdf = self.two_sided(bsdf)
        if material in (*GLASS, "trans"):
            base += 0.01  # else, what is seen in a face that lies on another one is a matter of rounding
        name, centre = f"thing{i}", np.array([x, base + half, z])
        if i == 0:
            self.round_first = kind in ("sphere", "ball", "smooth", "cylinder", "cup")
        key, how = f"{name}.vertex_positions", "slides"
        if kind == "box":
            made = self.mesh(name, box([-1, -1, -1], [1, 1, 1]), np.eye(3) * half, centre, bsdf)
        elif kind in ("ball", "smooth", "cup"):
            upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) * half
            smooth, shape = kind == "smooth", None
            if kind == "cup":
                smooth, shape = bool(self.later.random() < 0.5), cup(*RADII[self.later.integers(len(RADII))])
            made = self.mesh(name, shape or ball(self.pick(8, 12)), upright, centre, bsdf, smooth=smooth)
        else:
            linear = {"cube": np.eye(3), "sphere": np.eye(3)}.get(kind, np.array([[1, 0, 0], [0, 0, 2], [0, -1, 0]]))
            centre = centre - [0, half, 0] if kind == "cylinder" else centre
            made = {"type": kind, "to_world": self.frame(linear * half, centre), "bsdf": bsdf}
            key = f"{name}.to_world"
        self.objects[name] = made
        self.labels.append(f"{kind}:{material}@{place}")
        if not self.still:
            self.movable["thing"] += [(key, how, centre)] * 3

    def make_light(self, i: int, before: list[str]) -> str:
        kind = super().make_light(i, before)
        if kind == "sun" and self.chance(0.6):
            self.objects[f"light{i}"]["direction"] = list(map(float, self.pick(*ALONG)))
            self.movable["light"] = [m for m in self.movable["light"] if not m[0].startswith(f"light{i}.")]
            self.along, self.labels[-1] = True, "sun/along"
        return kind

    def make_motion(self, scene: mi.Scene, cameras: bool) -> tuple[mi.SceneParameters, Callable[[mi.Float], None]]:
        # Mitsuba may have made one shape of several.
        known = mi.traverse(scene)
        self.movable["thing"] = [m for m in self.movable["thing"] if m[0] in known]
        if not self.movable["thing"]:
            self.movable["thing"] = [m for m in self.movable["camera"] if m[1] in ("pose", "along", "across")]
        return super().make_motion(scene, cameras)

    def mover(self, params, key: str, how: str, centre) -> Callable[[mi.Float], None]:
        if how not in ("slides", "along", "across"):
            return super().mover(params, key, how, centre)
        initial = type(params[key])(params[key])
        way, turn = self.direction() * [1, 0, 1], self.uniform(-20, 20)
        if how != "slides" or self.in_row:
            way, turn = np.array([1.0, 0, 0] if how == "along" else [0, 0, 1.0]), 0.0
        if self.along or self.upright or "wall" in self.objects:
            turn = 0.0
        about, way = (mi.Vector3f(*map(float, v)) for v in (self.place(centre), way * self.scale))

        def change(θ: mi.Float) -> None:
            T = mi.Transform4f
            moved = T().translate(way * θ) @ T().translate(about)
            moved = moved @ T().rotate(mi.Vector3f(0, 1, 0), θ * turn) @ T().translate(-about)
            if key.endswith("vertex_positions"):
                params[key] = dr.ravel(moved @ dr.unravel(mi.Point3f, initial))
            else:
                params[key] = moved @ initial

        return change
