"""Ordinary scenes that nobody chose: made from a seed, and their derivatives compared with finite differences.

    python tests/random_scenes.py --seeds 0 1000 --processes 2        # some seconds a scene
    python tests/random_scenes.py --only 17 --thorough

A scene has a floor and one to three things that hover apart from it and from each other, of random shapes and
materials, some of them lamps; one or two lights; a sensor with its film; and one to three parameters that change
together with one number θ. All of it may be scaled, and shifted away from the origin. What the documentation calls
missing is left out; and unless asked for, so are what has been there for less long: meshes that cut each other, perfect
mirrors and glass, textures that jump.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
# isort: on

#: Half of the difference between the two values of θ. Images move by a few hundredths of a pixel.
STEP = 2e-3

#: Samples per pixel of one image of the finite differences, as a rule, and of one derivative.
REFERENCE_SPP, SPP = 1024, 256

#: Images that such an image is the mean of: Mitsuba adds up samples in single precision, and sums of many equal ones
#: are off by the same in all runs. About so much, relative to the image.
PASSES = 4
ROUNDING = 2**-24 / 8 / PASSES

#: How many of each are made: at first, and when that does not suffice to tell right from wrong.
STAGES = ((10, 6), (24, 24), (80, 96))

#: The derivative is right if its projection on the reference is 1 within this, and `ERRORS` standard errors.
TOLERANCE, ERRORS = 0.015, 4.0

#: Sums over squares of so many pixels must agree within `TOLERANCE` of what the reference has there, and so many
#: standard errors. (There are 16 of them, and their errors come from few runs.)
SQUARE, LARGEST = 5, 5.5

#: What scenes may have besides, and what that is.
SPECIAL = {
    "cut": "things stand in the floor, and in each other; none of them is a lamp",
    "jumps": "all that things have are perfect mirrors, smooth glass, and textures that jump",
    "instances": "there are two or three instances of meshes besides, which mostly are what moves",
    "beams": "spots and projectors light them, whose beams end with a jump, most often in indirect light",
    "parameters": "their materials have all kinds of values, and any parameters change (`random_parameters.py`)",
    "mirrors": "perfect mirrors and glass show what points, spots and suns light (`random_mirrors.py`)",
    "patterns": "mirrors, glass and what shines have textures and maps (`random_patterns.py`)",
    "tidy": "all is upright and in line, things stand on each other, walls are mirrors or panes (`random_tidy.py`)",
    "meshes": "things are torn, turned round, cut through themselves, or one of many faces (`random_meshes.py`)",
    "polished": "most surfaces are polished: their highlights are narrow",
    "textures": "nearly everything has textures, most of them fine (`random_textures.py`)",
    "files": "meshes are files that share materials, loaded as Mitsuba does by default (`random_files.py`)",
    "rooms": "they are rooms, in which things touch the floor, walls and each other (`random_rooms.py`)",
}
#: Those whose mirrors show what lights without size light, if paths are long enough.
SHOWN = ("mirrors", "patterns", "tidy")

MIRRORS = ("conductor", "plastic", "thindielectric", "dielectric")

#: Kinds of lights; those without size are in the middle.
LIGHTS = ("area", "ball", "disklight", "meshball", "point", "spot", "sun", "sky", "environment")
HARD = LIGHTS[4:7]

#: A projection whose standard error is above this tells nothing: more samples are taken.
TELLING = 0.03

#: A gradient of backward mode is the derivative of forward mode, weighted, within this of its sum of absolute values.
BACKWARD = 1e-3


# ---------------------- Shapes ----------------------


def quad() -> tuple[np.ndarray, ...]:
    p = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]], float)
    return p, np.tile([0, 0, 1], (4, 1)), (p[:, :2] + 1) / 2, np.array([[0, 1, 2], [1, 3, 2]])


def grid(point: Callable, n: int, m: int) -> tuple[np.ndarray, ...]:
    """n × m quads over (u, v) in the unit square, as exporters write them: seams with vertices of their own."""
    v, u = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, m + 1), np.linspace(0, 1, n + 1), indexing="ij"))
    p, normal = point(2 * np.pi * u, v)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m)))
    a = j * (n + 1) + i
    faces = np.concatenate([np.stack([a, a + n + 1, a + 1], 1), np.stack([a + 1, a + n + 1, a + n + 2], 1)])
    corners = p[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[area > 1e-9]
    outwards = np.einsum(
        "ij,ij->i",
        np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]]),
        normal[faces].mean(1),
    )
    faces = np.where(outwards[:, None] > 0, faces, faces[:, ::-1])
    return p, normal, np.stack([u, v], 1), faces


def ball(n: int, part: float = 1.0) -> tuple[np.ndarray, ...]:
    """part : 1 for all of a ball of radius 1, 0.5 for the upper half, which is open."""

    def point(φ, v):
        θ = np.pi * part * v
        p = np.stack([np.sin(θ) * np.cos(φ), np.sin(θ) * np.sin(φ), np.cos(θ)], 1)
        return p, p

    return grid(point, 2 * n, n)


def torus(n: int) -> tuple[np.ndarray, ...]:
    def point(φ, v):
        ψ = 2 * np.pi * v
        normal = np.stack([np.cos(ψ) * np.cos(φ), np.cos(ψ) * np.sin(φ), np.sin(ψ)], 1)
        ring = np.stack([np.cos(φ), np.sin(φ), 0 * φ], 1)
        return 0.7 * ring + 0.28 * normal, normal

    return grid(point, 2 * n, n)


def tetrahedron() -> tuple[np.ndarray, ...]:
    p = np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) * 0.7
    return p, p, p[:, :2], np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


# ---------------------- Scenes ----------------------


@dataclass
class RandomScene:
    """scene, params : of Mitsuba.
    move : puts all that changes where θ says.
    integrator : what is tested, as a dictionary; `max_depth` of its paths.
    label : what is in the scene.
    reference_spp : samples per pixel of one image of the finite differences.
    """

    scene: mi.Scene
    params: mi.SceneParameters
    move: Callable[[mi.Float], None]
    integrator: dict[str, Any]
    max_depth: int
    label: str
    reference_spp: int = REFERENCE_SPP


class Generator:
    """Makes one scene. The same seed makes the same one, but for the sampler of its sensor.

    home : at the origin, and one scene unit large, whatever size and place the seed says? The image is the same.
    special : one of `SPECIAL`, or "".
    """

    def __init__(self, seed: int, sampler: str, home: bool = False, special: str = ""):
        self.rng = np.random.default_rng([seed, 14])
        self.sampler, self.home, self.special = sampler, home, special
        self.objects: dict[str, Any] = {"type": "scene"}
        self.labels: list[str] = []
        self.lights: list[np.ndarray] = []
        #: What may change: name of the parameter, and how.
        self.movable: dict[str, list[tuple[str, str, np.ndarray]]] = {
            "thing": [],
            "light": [],
            "camera": [],
            "look": [],
        }

    def pick(self, *options):
        return options[self.rng.integers(len(options))]

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def direction(self) -> np.ndarray:
        v = self.rng.normal(size=3)
        return v / np.linalg.norm(v)

    def rotation(self) -> np.ndarray:
        q = np.linalg.qr(self.rng.normal(size=(3, 3)))[0]
        return q * np.sign(np.linalg.det(q))

    def make(self) -> RandomScene:
        # Where all of it is: a number of the scene is this many scene units, and its origin is here.
        self.scale = self.pick(1.0, 1.0, 1.0, 1.0, 1e-3, 1e-2, 30.0, 1e4)
        self.origin = self.direction() * self.scale * self.pick(0, 0, 0, 3, 20)
        self.labels.append(f"x{self.scale:g}" + (f"@{np.linalg.norm(self.origin):g}" if self.origin.any() else ""))
        if self.home:
            self.scale, self.origin = 1.0, np.zeros(3)
        # What moves must not show instances, whose outlines were unknown: no sky, no gloss, no interreflections.
        self.instances = self.chance(0.06) and self.special not in ("jumps", "beams", "instances", *SHOWN)
        # In half of the scenes in which mirrors are followed, all else only glows: then little hides what they show.
        followed = self.special == "jumps" and self.chance(0.5)
        self.glows = followed and self.chance(0.5)
        direct = self.chance(0.6) or self.instances
        direct = {"jumps": not followed, "textures": True, "beams": False, "mirrors": False}.get(self.special, direct)
        self.depth = depth = 2 if direct else self.longest()
        integrator = {"type": "direct_edge"} if direct else {"type": "prb_edge", "max_depth": depth, "rr_depth": 100}
        self.labels.insert(0, "direct_edge" if direct else f"prb_edge/{depth}")

        self.make_sensor()
        self.make_floor()
        for i in range(self.rng.integers(1, 4)):
            self.make_thing(i)
        if self.instances:
            self.make_instances()
        elif self.special == "instances":
            self.make_moving_instances()
        kinds: list[str] = []
        for i in range(self.rng.integers(1, 3)):
            kinds.append(self.make_light(i, kinds))
        if self.special in ("jumps", "patterns", "tidy") and not {"sky", "environment"} & set(kinds):
            # Without one, `path` drops light that comes through a mask or a thin glass; and mirrors show little.
            self.objects["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.2}}
        scene = mi.load_dict(self.objects)
        params, move = self.make_motion(scene, cameras=not self.instances)
        return RandomScene(scene, params, move, integrator, depth, " ".join(self.labels))

    def longest(self) -> int:
        """`max_depth` of paths with interreflections."""
        return int(self.rng.integers(2, 6))

    # ---------------------- Placing ----------------------

    def place(self, p) -> np.ndarray:
        return np.asarray(p, float) * self.scale + self.origin

    def frame(self, linear: np.ndarray, centre) -> mi.ScalarTransform4f:
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = np.asarray(linear) * self.scale, self.place(centre)
        return mi.ScalarTransform4f(m)

    def look(self, origin, target, up=(0, 1, 0)) -> mi.ScalarTransform4f:
        return mi.ScalarTransform4f().look_at(list(self.place(origin)), list(self.place(target)), list(map(float, up)))

    # ---------------------- Materials ----------------------

    def colour(self, low=0.2, high=0.9) -> dict:
        return {"type": "rgb", "value": [self.uniform(low, high) for _ in range(3)]}

    def bitmap(self, height: int, width: int, low=0.1, high=0.9) -> dict:
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(self.rng.uniform(low, high, (height, width, 3)).astype(np.float32)),
            "raw": not mi.is_spectral,  # Mitsuba refuses raw colours there
            "filter_type": "bilinear",
            "wrap_mode": self.pick("clamp", "mirror"),
        }

    def bsdf(self, uv: bool = False, closed: bool = False) -> tuple[str, dict]:
        kinds = ["diffuse", "diffuse", "twosided", "roughplastic", "roughconductor", "principled", "blend"]
        kinds += ["roughdielectric"] * closed + ["texture", "texture", "normalmap"] * uv
        if self.special == "jumps":
            kinds = [*MIRRORS[:3], *MIRRORS[3:] * closed]
            kinds += ["black"] * 3 if self.glows else ["checkers", "texels", "bumps", "leaf"] * uv
        if self.special == "polished":
            kinds = ["diffuse", "roughplastic", "roughplastic", "roughconductor", "blend"]
        kind = "diffuse" if self.instances else self.pick(*kinds)
        colour, alpha = self.colour(), self.uniform(0.1, 0.4) * (0.2 if self.special == "polished" else 1)
        bsdf = {
            "diffuse": lambda: {"type": "diffuse", "reflectance": colour},
            "twosided": lambda: {"type": "twosided", "inner": {"type": "diffuse", "reflectance": colour}},
            "roughplastic": lambda: {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": colour},
            "roughconductor": lambda: {"type": "roughconductor", "alpha": alpha},
            "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.2 + alpha, "int_ior": 1.3},
            "principled": lambda: {
                "type": "principled",
                "base_color": colour,
                "roughness": self.uniform(0.3, 0.8),
                "specular": 0.5,
                "metallic": self.uniform(0, 1),
            },
            "blend": lambda: {
                "type": "blendbsdf",
                "weight": self.uniform(0.2, 0.8),
                "first": {"type": "diffuse", "reflectance": colour},
                "second": {"type": "roughconductor", "alpha": alpha},
            },
            "texture": lambda: {"type": "diffuse", "reflectance": self.bitmap(5, 7)},
            "black": lambda: {"type": "diffuse", "reflectance": 0.0},
            "conductor": lambda: {"type": "conductor", "specular_reflectance": colour},
            "plastic": lambda: {"type": "plastic", "diffuse_reflectance": 0.0 if self.glows else colour},
            "thindielectric": lambda: {"type": "thindielectric"},
            "dielectric": lambda: {"type": "dielectric", "int_ior": self.uniform(1.1, 1.6)},
            "checkers": lambda: {"type": "diffuse", "reflectance": self.checkers()},
            "texels": lambda: {"type": "diffuse", "reflectance": {**self.bitmap(5, 7), "filter_type": "nearest"}},
            "bumps": lambda: {
                "type": "bumpmap",
                "texture": self.bitmap(5, 7),
                "scale": 0.1 * self.scale,  # a height
                "bsdf": {"type": "diffuse", "reflectance": colour},
            },
            "leaf": lambda: {
                "type": "mask",
                "opacity": self.checkers(),
                "inner": {"type": "twosided", "inner": {"type": "diffuse", "reflectance": colour}},
            },
            "normalmap": lambda: {
                "type": "normalmap",
                "normalmap": self.normal_map(),
                "bsdf": {"type": "diffuse", "reflectance": colour},
            },
        }[kind]()
        return kind, bsdf

    def checkers(self) -> dict:
        place = mi.ScalarTransform3f().rotate(self.uniform(0, 360)).scale([self.uniform(1, 4), self.uniform(1, 4)])
        return {"type": "checkerboard", "color0": self.uniform(0, 0.3), "color1": self.colour(), "to_uv": place}

    def normal_map(self) -> dict:
        n = np.concatenate([self.rng.uniform(-0.2, 0.2, (5, 7, 2)), np.ones((5, 7, 1))], 2)
        n = n / np.linalg.norm(n, axis=2, keepdims=True) * 0.5 + 0.5
        return {"type": "bitmap", "bitmap": mi.Bitmap(n.astype(np.float32)), "raw": True, "wrap_mode": "clamp"}

    @staticmethod
    def two_sided(bsdf: dict) -> dict:
        both = ("twosided", "principled", "principledthin")
        return bsdf if bsdf["type"] in both else {"type": "twosided", "inner": bsdf}

    def emitter(self, low: float, high: float, uv: bool = False) -> dict:
        return {"type": "area", "radiance": {"type": "rgb", "value": [self.uniform(low, high) for _ in range(3)]}}

    # ---------------------- Objects ----------------------

    def mesh(self, name: str, shape, linear, centre, bsdf=None, emitter=None, smooth=False, uv=True) -> mi.Mesh:
        p, normals, coordinates, faces = shape
        props = mi.Properties()
        for key, value in (("bsdf", bsdf), ("emitter", emitter)):
            if value is not None:
                props[key] = mi.load_dict(value)
        m = mi.Mesh(name, len(p), len(faces), has_vertex_normals=smooth, has_vertex_texcoords=uv, props=props)
        values = mi.traverse(m)
        values["vertex_positions"] = np.float32(self.place(p @ np.asarray(linear).T + centre)).ravel()
        values["faces"] = np.uint32(faces).ravel()
        if smooth:
            n = normals @ np.linalg.inv(linear)
            values["vertex_normals"] = np.float32(n / np.linalg.norm(n, axis=1, keepdims=True)).ravel()
        if uv:
            values["vertex_texcoords"] = np.float32(coordinates).ravel()
        values.update()
        m.set_id(name)
        return m

    def make_sensor(self) -> None:
        kind = self.pick("perspective", "perspective", "perspective", "thinlens", "orthographic", "fisheye", "batch")
        rfilter = self.pick("box", "box", "gaussian", "tent", "mitchell")
        res = 20
        film = {
            "type": "hdrfilm",
            "width": res,
            "height": res,
            "rfilter": {"type": rfilter},
            "pixel_format": "rgb",
            "component_format": "float32",
            "sample_border": self.chance(0.6) and kind != "batch",
        }
        self.labels.append(f"{kind}/{rfilter}")
        if self.chance(0.15) and kind not in ("batch", "fisheye"):
            film.update(crop_offset_x=4, crop_offset_y=2, crop_width=12, crop_height=15)
            self.labels[-1] += "/crop"
        origin = np.array([self.uniform(-1.5, 1.5), self.uniform(1.2, 3), 4.6])
        target = [self.uniform(-0.2, 0.2), 0.5, 0]
        to_world = self.look(origin, target)
        sensor: dict[str, Any] = {
            "type": kind,
            "to_world": to_world,
            "film": film,
            "sampler": {"type": self.sampler},
            "near_clip": 0.01 * self.scale,
            "far_clip": 1000 * self.scale,
        }
        if kind in ("perspective", "thinlens"):
            sensor["fov"] = self.uniform(32, 48)
            if kind == "perspective" and self.chance(0.3):
                sensor["principal_point_offset_x"] = self.uniform(-0.1, 0.1)
        if kind == "thinlens":
            sensor.update(aperture_radius=0.08 * self.scale, focus_distance=5.0 * self.scale)
        if kind == "orthographic":
            s = 1.7 * self.scale
            sensor["to_world"] = to_world @ mi.ScalarTransform4f().scale([s, s, 1])
        if kind == "fisheye":
            sensor["fov"] = self.uniform(50, 160)
            del sensor["near_clip"], sensor["far_clip"]
        name = "sensor"
        if kind == "batch":
            one = {**sensor, "type": "perspective", "fov": 45.0}
            other = {**one, "to_world": self.look(np.add(origin, [-1.0, 0.2, 0.1]), target), "film": dict(film)}
            wide = {**film, "width": 2 * res}
            sensor = {"type": "batch", "one": one, "two": other, "film": wide, "sampler": one["sampler"]}
            name = "sensor.one"
        self.objects["sensor"] = sensor
        moves = self.movable["camera"]
        moves += [(f"{name}.to_world", "pose", origin)] * 3
        if kind in ("perspective", "thinlens"):
            moves += [("sensor.x_fov", "number", np.array([4.0]))]
        if kind == "perspective":
            moves += [(f"sensor.principal_point_offset_{a}", "number", np.array([0.1])) for a in "xy"]
        if kind == "thinlens":
            moves += [("sensor.aperture_radius", "number", np.array([0.1 * self.scale]))]
            moves += [("sensor.focus_distance", "number", np.array([1.0 * self.scale]))]
        if kind == "fisheye":
            moves += [("sensor.fov", "number", np.array([10.0]))]

    def make_floor(self) -> None:
        p, n, uv, faces = quad()
        kind, bsdf = self.bsdf(uv=True)
        flat = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) * 3.0  # its normal upwards
        self.objects["floor"] = self.mesh("floor", (p, n, uv, faces), flat, [0, -0.4, 0], bsdf)
        self.labels.append(f"floor:{kind}")
        if kind in ("diffuse", "texture"):
            key = "data" if kind == "texture" else "value"
            self.movable["look"].append((f"floor.bsdf.reflectance.{key}", "colour", np.zeros(3)))

    def make_thing(self, i: int) -> None:
        kinds = ("cube", "smoothcube", "ball", "ball", "fine", "sphere", "cylinder", "disk", "torus", "tetra", "quad")
        kind = self.pick(*kinds, "half", "needle")
        name = f"thing{i}"
        centre = [[-0.9, 0.5, 0], [0.9, 0.7, -0.3], [0, 1.6, 0.4]][i] + self.rng.uniform(-0.1, 0.1, 3)
        size, q = self.uniform(0.35, 0.55), self.rotation()
        if self.special == "cut":
            centre = centre * [0.4, 0, 1] + [0, 0.5 * size - 0.4, 0]
        closed = kind not in ("quad", "half", "disk", "cylinder", "needle")
        uv = kind not in ("sphere", "cylinder", "disk", "tetra") and self.chance(0.6)
        material, bsdf = self.bsdf(uv, closed and kind != "torus")
        if not closed:
            bsdf = self.two_sided(bsdf) if bsdf["type"] not in ("roughdielectric", "thindielectric", "mask") else bsdf
        lamp = (self.chance(0.15) and self.special not in ("cut", *SHOWN)) or material == "black"
        has_uv = uv or kind in ("cube", "smoothcube", "sphere", "cylinder", "disk")
        emitter = self.emitter(0.5, 3, has_uv) if lamp else None
        smooth = kind in ("fine", "torus") or (kind in ("ball", "half", "needle") and self.chance(0.6))
        smooth &= not lamp or kind == "fine"  # what coarse lamps light is off by some per cent, with a warning
        label = f"{'smooth-' if smooth and kind != 'fine' else ''}{kind}:{material}{':lamp' if lamp else ''}"
        extra = {"bsdf": bsdf, **({"emitter": emitter} if lamp else {})}
        key, how = f"{name}.vertex_positions", "vertices"
        if kind in ("cube", "smoothcube"):
            made: Any = {
                "type": "cube",
                "face_normals": kind == "cube",
                "to_world": self.frame(q * size * 0.7, centre),
                **extra,
            }
        elif kind in ("sphere", "cylinder", "disk"):
            linear = q * size if kind != "cylinder" else q @ np.diag([0.6, 0.6, 1]) * size
            made = {"type": kind, "to_world": self.frame(linear, centre), **extra}
            key, how = f"{name}.to_world", "frame"
        else:
            n = {"ball": self.pick(4, 8, 12, 24), "fine": 70, "half": self.pick(6, 12), "torus": self.pick(8, 12, 20)}
            shape, linear = {
                "ball": lambda: (ball(n["ball"]), q * size),
                "fine": lambda: (ball(n["fine"]), q * size),
                "half": lambda: (ball(n["half"], 0.5), q * size),
                "torus": lambda: (torus(n["torus"]), q * size * 1.1),
                "tetra": lambda: (tetrahedron(), q * size),
                "quad": lambda: (quad(), q * size),
                "needle": lambda: (ball(6), q @ np.diag([1.2, 0.03, 0.03]) * size),
            }[kind]()
            label += f"/{len(shape[3])}"
            made = self.mesh(name, shape, linear, centre, bsdf, emitter, smooth, uv)
        self.objects[name] = made
        self.labels.append(label)
        self.movable["thing"] += [(key, how, centre)] * 3
        if how == "vertices":
            self.movable["thing"].append((key, "bend", centre))
        if lamp:
            self.movable["look"].append((f"{name}.emitter.radiance.value", "colour", np.zeros(3)))

    def make_instances(self) -> None:
        """Two small copies of a mesh, aside, where they throw no shadow on anything that moves."""
        self.objects["group"] = {
            "type": "shapegroup",
            "shape": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": self.colour()}},
        }
        for i, x in enumerate((-2.3, 2.3)):
            self.objects[f"copy{i}"] = {
                "type": "instance",
                "to_world": self.frame(self.rotation() * 0.12, [x, -0.1, -1.5]),
                "shapegroup": {"type": "ref", "id": "group"},
            }
        self.labels.append("instances")

    def make_moving_instances(self) -> None:
        """Two or three, of one or two meshes each, some of them stretched or reflected."""
        group: dict[str, Any] = {"type": "shapegroup"}
        world, (self.scale, self.origin) = (self.scale, self.origin), (1.0, np.zeros(3))
        for i in range(self.pick(1, 1, 2)):
            kind, flat = self.pick("coarse ball", "ball", "torus", "tetra"), self.chance(0.5)
            shape = {"coarse ball": ball(3), "ball": ball(12), "torus": torus(8), "tetra": tetrahedron()}[kind]
            material = "normalmap"
            while material == "normalmap":  # of what moves, refused
                material, bsdf = self.bsdf(uv=kind != "tetra")
            smooth = not flat and kind != "tetra"
            group[f"part{i}"] = self.mesh(
                f"part{i}", shape, self.rotation() * 0.35, [0.3 * i, 0, 0], bsdf, smooth=smooth, uv=kind != "tetra"
            )
            self.labels.append(f"{'smooth-' * smooth}{kind}:{material}")
        self.scale, self.origin = world
        self.objects["group"] = group
        for i, centre in enumerate([[-1.9, 0.5, -0.7], [1.9, 0.6, -0.8], [0.1, 0.4, -1.4]][: self.pick(2, 3)]):
            stretch = np.diag([self.pick(1, 1, -1), self.uniform(0.7, 1.3), 1])
            self.objects[f"copy{i}"] = {
                "type": "instance",
                "to_world": self.frame(self.rotation() @ stretch, centre),
                "shapegroup": {"type": "ref", "id": "group"},
            }
            self.movable["thing"] += [(f"copy{i}.to_world", "frame", np.array(centre))] * 9
        self.labels.append(f"{i + 1} instances")

    def make_light(self, i: int, before: list[str]) -> str:
        name = f"light{i}"
        of_special = {"beams": ("spot", "projector"), **dict.fromkeys(("textures", "mirrors"), HARD)}
        of_special |= dict.fromkeys(("patterns", "tidy"), LIGHTS if self.depth == 2 else HARD)
        kind = self.pick(*of_special.get(self.special, LIGHTS))
        if kind in ("sky", "environment") and ({"sky", "environment"} & set(before) or self.instances):
            kind = "area"
        centre = np.array([self.uniform(-2, 2), self.uniform(3.2, 4.5), self.uniform(-2, 2)])
        for other in self.lights:
            if np.linalg.norm(centre - other) < 1.3:  # so that lights do not cut each other
                centre = other + 1.3 * np.array([-1 if other[0] > 0 else 1, 0, 0])
        self.lights.append(centre)
        power, grey = self.uniform(0.5, 1.5), lambda v: {"type": "rgb", "value": v}
        area = lambda v: {"type": "area", "radiance": grey(v)}
        down = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        moves = self.movable["light"]
        if kind == "area":
            made: Any = self.mesh(name, quad(), down @ np.diag([0.4] * 3), centre, None, area(20 * power), uv=False)
            moves += [(f"{name}.vertex_positions", "vertices", centre)] * 2
        elif kind == "meshball":
            n = self.pick(4, 8, 16)
            linear = self.rotation() * 0.4
            made = self.mesh(
                name, ball(n), linear, centre, None, area(15 * power), self.chance(0.5) and n > 4, uv=False
            )
            moves += [(f"{name}.vertex_positions", "vertices", centre)] * 2
        elif kind in ("ball", "disklight"):
            shape, linear = ("sphere", np.eye(3)) if kind == "ball" else ("disk", down)
            made = {"type": shape, "to_world": self.frame(linear * 0.4, centre), "emitter": area(15 * power)}
            moves += [(f"{name}.to_world", "frame", centre)] * 2
        elif kind == "point":
            made = {
                "type": "point",
                "position": list(self.place(centre)),
                "intensity": grey(15 * power * self.scale**2),
            }
            moves += [(f"{name}.position", "position", centre)]
        elif kind == "spot":
            made = {
                "type": "spot",
                "to_world": self.look(centre, [0, 0.4, 0], [0, 0, 1]),
                "intensity": grey(25 * power * self.scale**2),
                "cutoff_angle": 40,
                "beam_width": 25,
            }
            if self.special == "beams":
                made["cutoff_angle"] = self.uniform(10, 30)
                made["beam_width"] = made["cutoff_angle"] + 1
                if self.chance(0.5):
                    made["texture"] = {**self.bitmap(4, 5), "filter_type": self.pick("nearest", "bilinear")}
            moves += [(f"{name}.to_world", "pose", centre)]
        elif kind == "projector":
            picture = {**self.bitmap(4, 5), "filter_type": self.pick("nearest", "bilinear")}
            made = {
                "type": "projector",
                "to_world": self.look(centre, [0, 0.4, 0], [0, 0, 1]),
                "irradiance": self.pick(picture, {"type": "rgb", "value": [1, 0.7, 0.4]}),
                "fov": self.uniform(20, 50),
                "scale": 4 * power * self.scale**2,
            }
            moves += [(f"{name}.to_world", "pose", centre)]
        elif kind == "sun":
            made = {"type": "directional", "direction": [*(-centre / 2)], "irradiance": grey(2 * power)}
            moves += [(f"{name}.to_world", "turn", centre)]
        elif kind == "sky":
            made = {"type": "constant", "radiance": grey(0.6 * power)}
        else:
            made = {"type": "envmap", "bitmap": mi.Bitmap(self.rng.uniform(0, 1.2, (6, 12, 3)).astype(np.float32))}
            moves += [(f"{name}.to_world", "turn", centre)]
        self.objects[name] = made
        self.labels.append(kind)
        if kind == "area":
            self.movable["look"].append((f"{name}.emitter.radiance.value", "colour", np.zeros(3)))
        return kind

    # ---------------------- Motion ----------------------

    def make_motion(self, scene: mi.Scene, cameras: bool) -> tuple[mi.SceneParameters, Callable[[mi.Float], None]]:
        params = mi.traverse(scene)
        chosen: dict[str, tuple[str, np.ndarray]] = {}
        for _ in range(self.pick(1, 1, 1, 2, 3)):
            who = self.pick("thing", "thing", "thing", "camera", "camera", "light", "light", "look")
            if who == "camera" and not cameras:
                who = "thing"
            options = self.movable[who] or self.movable["thing"]
            key, how, centre = options[self.rng.integers(len(options))]
            if key in params:
                chosen.setdefault(key, (how, centre))
        if not chosen:
            key, how, centre = self.movable["thing"][0]
            chosen[key] = (how, centre)
        self.labels.append("moves " + "+".join(f"{key}({how})" for key, (how, _) in chosen.items()))
        params.keep(list(chosen))
        moves = [self.mover(params, key, how, centre) for key, (how, centre) in chosen.items()]

        def move(θ: mi.Float) -> None:
            for change in moves:
                change(θ)
            params.update()

        return params, move

    def mover(self, params, key: str, how: str, centre) -> Callable[[mi.Float], None]:
        initial = type(params[key])(params[key])
        axis, way, turn = self.direction(), self.direction(), self.uniform(-20, 20)
        speed, centre = float(centre[0]), self.place(centre)
        vector = lambda v: mi.Vector3f(*map(float, v))

        def rigid(θ):
            T = mi.Transform4f
            moved = T() if how == "turn" else T().translate(vector(way * self.scale) * θ)
            about = (0, 0, 0) if how == "turn" else centre
            return (
                moved
                @ T().translate(vector(about))
                @ T().rotate(vector(axis), θ * turn)
                @ T().translate(-vector(about))
            )

        def change(θ):
            if how == "vertices":
                params[key] = dr.ravel(rigid(θ) @ dr.unravel(mi.Point3f, initial))
            elif how == "bend":
                p = dr.unravel(mi.Point3f, initial)
                s = dr.dot((p - mi.Point3f(*map(float, centre))) / self.scale, vector(axis))
                params[key] = dr.ravel(p + vector(way * self.scale) * (θ * dr.sin(3 * s + 1)))
            elif how == "number":
                params[key] = initial + θ * speed
            elif how == "colour":
                params[key] = (
                    initial * (1 + 10 * θ)
                    if not dr.is_tensor_v(initial)
                    else type(initial)(initial.array * (1 + 10 * θ), initial.shape)
                )
            else:  # a transformation, or the position of a light
                params[key] = rigid(θ) @ initial

        return change


def make(seed: int, sampler: str = "independent", home: bool = False, special: str = "") -> RandomScene:
    # Which are built on this file
    if special == "rooms":
        from random_rooms import RoomGenerator as Kind
    elif special == "parameters":
        from random_parameters import ParameterGenerator as Kind
    elif special == "mirrors":
        from random_mirrors import MirrorGenerator as Kind
    elif special == "patterns":
        from random_patterns import PatternGenerator as Kind
    elif special == "tidy":
        from random_tidy import TidyGenerator as Kind
    elif special == "meshes":
        from random_meshes import MeshGenerator as Kind
    elif special == "files":
        from random_files import FileGenerator as Kind
    elif special == "textures":
        from random_textures import TextureGenerator as Kind
    else:
        Kind = Generator
    return Kind(seed, sampler, home, special).make()


# ---------------------- Comparison ----------------------


@dataclass
class Comparison:
    """A derivative against its reference.

    scale, error : projection ⟨g, ref⟩ / ⟨ref, ref⟩ over the pixels where the reference is not noise, and its standard
        error.
    relative, noise : Σ|g − ref| / Σ|ref|, and what of it noise explains.
    largest : difference of the sums over a square of pixels, in standard errors, beyond what is tolerated; the largest.
    size : Σ|ref|.
    backward : difference of a gradient of backward mode from the derivative of forward mode, weighted by random
        numbers; relative to the sum of absolute values of the latter.
    finite : is every number of the derivative?
    """

    seed: int
    label: str
    scale: float = math.nan
    error: float = math.nan
    relative: float = math.nan
    noise: float = math.nan
    largest: float = math.nan
    size: float = 0.0
    backward: float = 0.0
    finite: bool = True
    seconds: float = 0.0
    stage: int = 0
    raised: str = ""

    @property
    def agrees(self) -> bool:
        if self.raised or not self.finite or not self.backward <= BACKWARD:
            return False
        if self.size == 0:
            return self.relative == 0  # nothing is seen to change
        # Not all of a difference need lie along the reference: what noise does not explain must be small as well.
        whole = abs(self.scale - 1) <= TOLERANCE + ERRORS * self.error and self.relative <= 0.04 + 1.3 * self.noise
        return whole and self.largest <= LARGEST

    @property
    def refused(self) -> bool:
        """Does Rimlight say that it has no derivative of this scene?"""
        return self.raised.startswith("Refusal")

    def __str__(self) -> str:
        verdict = (
            "REF"
            if self.refused
            else "ERR"
            if self.raised
            else "ok "
            if self.agrees
            else "BAD"
            if self.finite
            else "NAN"
        )
        numbers = f"scale {self.scale:.3f}+-{self.error:.3f} L1 {self.relative:.3f} noise {self.noise:.3f}"
        numbers += f" z {self.largest:4.1f} |ref| {self.size:9.3g} back {self.backward:.0e} {self.seconds:5.1f} s  "
        return f"{self.seed:6d} {verdict} {self.stage} " + (self.raised if self.raised else numbers) + " " + self.label


def statistics(
    reference: np.ndarray, derivative: np.ndarray, row: Comparison, rounding: np.ndarray | float = 0.0
) -> None:
    """Fill in a row from runs of both: (R, H, W, C).

    rounding : (H, W, C), an error of the reference that is the same in all runs.
    """
    ref, g = reference.mean(0), derivative.mean(0)
    rounding = np.broadcast_to(rounding, ref.shape)
    ref_error = reference.std(0, ddof=1) / math.sqrt(len(reference))
    g_error = derivative.std(0, ddof=1) / math.sqrt(len(derivative))
    row.finite, row.size = bool(np.isfinite(derivative).all()), float(np.abs(ref).sum())
    row.relative = row.noise = 0.0
    # Each half of the reference weighs the pixels of the other: weights with the noise of what they weigh, and pixels
    # chosen by it, would make the reference seem larger than it is.
    products = []
    for mine, others in ((reference[::2], reference[1::2]), (reference[1::2], reference[::2])):
        mean, error = mine.mean(0), mine.std(0, ddof=1) / math.sqrt(len(mine))
        weight = np.where(np.abs(mean) > 3 * error, mean, 0)
        products.append([*((runs * weight).sum((1, 2, 3)) for runs in (derivative, others)), weight])
    ours, theirs = (sum(float(p[k].mean()) for p in products) for k in (0, 1))
    if theirs <= 0:  # too little is seen to change
        row.size, row.relative = 0.0, float(np.abs(g).sum() > 4 * (g_error + ref_error).sum())
        return
    row.scale = ours / theirs
    variance = (products[0][0] + products[1][0]).var(ddof=1) / len(derivative)
    variance += row.scale**2 * sum(p[1].var(ddof=1) / len(p[1]) for p in products)
    shared = sum(float((np.abs(p[2]) * rounding).sum()) for p in products)
    row.error = math.sqrt(float(variance) + shared**2) / theirs
    row.relative = float(np.abs(g - ref).sum()) / row.size
    row.noise = math.sqrt(2 / math.pi) * float(np.sqrt(g_error**2 + ref_error**2 + rounding**2).sum()) / row.size
    squares, totals = _squares(reference), _squares(np.abs(ref)[None])[0]
    difference = _squares(derivative)
    error = np.sqrt(squares.var(0, ddof=1) / len(squares) + difference.var(0, ddof=1) / len(difference))
    error = np.hypot(error, _squares(rounding[None])[0])
    beyond = np.abs(difference.mean(0) - squares.mean(0)) - TOLERANCE * totals
    row.largest = float((beyond / (error + 1e-4 * totals.max())).max())


def _squares(images: np.ndarray) -> np.ndarray:
    """Sums over squares of pixels, and over the channels: (R, H', W')."""
    sums = images.sum(3)
    for axis in (1, 2):
        sums = np.add.reduceat(sums, np.arange(0, sums.shape[axis], SQUARE), axis=axis)
    return sums


def compare(
    seed: int, stages: tuple[tuple[int, int], ...] = STAGES, special: str = "", integrator: str = ""
) -> Comparison:
    """Compare a scene's derivative with finite differences, with more samples until the answer is clear.

    integrator : tested instead of the scene's own, with paths as long.

    Scenes that do not agree in the end are compared once more, over a tenth of the step: a lamp that comes into the
    frame within a step, say, is no part of the derivative.
    """
    row = _compare(seed, stages, STEP, special, integrator)
    if row.agrees or row.raised or not row.finite or len(stages) < len(STAGES):
        return row
    again = _compare(seed, stages[-1:], STEP / 10, special, integrator)
    again.seconds += row.seconds
    return again if again.agrees and again.error < 0.1 else row


def _compare(
    seed: int, stages: tuple[tuple[int, int], ...], step: float, special: str, integrator_type: str
) -> Comparison:
    start, row = time.time(), Comparison(seed, "")
    try:
        # Finite differences at the origin, where rays start close to surfaces, and single precision tells most.
        still, moving = make(seed, "multijitter", home=True, special=special), make(seed, special=special)
        row.label = still.label
        path = mi.load_dict({"type": "path", "max_depth": still.max_depth, "rr_depth": 1000})
        if integrator_type:
            moving.integrator = {"type": integrator_type, "max_depth": moving.max_depth}
        integrator = mi.load_dict(moving.integrator)
        reference, derivative = [], []
        for row.stage, (references, derivatives) in enumerate(stages):
            while len(reference) < references:
                images = []
                for θ in (step, -step):
                    still.move(mi.Float(θ))
                    seeds = range(PASSES * len(reference), PASSES * (len(reference) + 1))
                    passes = (
                        mi.render(still.scene, integrator=path, spp=still.reference_spp // PASSES, seed=s)
                        for s in seeds
                    )
                    images.append(sum(np.array(image, np.float64) for image in passes) / PASSES)
                reference.append((images[0] - images[1]) / (2 * step))
            while len(derivative) < derivatives:
                θ = dr.opaque(mi.Float, 0)  # Dr.Jit 1.5 gives a literal zero the width of what it is multiplied with
                dr.enable_grad(θ)
                moving.move(θ)
                dr.forward(θ, dr.ADFlag.ClearEdges)
                seed = 1000 + len(derivative)
                image = integrator.render_forward(moving.scene, moving.params, seed=seed, spp=SPP)
                derivative.append(np.array(image, np.float64))
                if len(derivative) == 1:
                    row.backward = _backward(moving, integrator, seed, derivative[0])
            rounding = ROUNDING * still.reference_spp * np.abs(images[0]) / (math.sqrt(2) * step)
            statistics(np.array(reference), np.array(derivative), row, rounding)
            if not row.finite or (row.agrees and (row.stage or not row.error > TELLING)):
                break
    except Exception as error:
        row.raised = f"{type(error).__name__}: {str(error).strip().splitlines()[-1][:160]}"
    row.seconds = time.time() - start
    return row


def _backward(moving: RandomScene, integrator: mi.Integrator, seed: int, forward: np.ndarray) -> float:
    """How much does the gradient of backward mode differ from forward mode, with the same random numbers?"""
    weight = np.random.default_rng(seed).uniform(0.5, 1, forward.shape)
    θ = dr.opaque(mi.Float, 0)
    dr.enable_grad(θ)
    moving.move(θ)
    integrator.render_backward(moving.scene, moving.params, mi.TensorXf(weight.astype(np.float32)), seed=seed, spp=SPP)
    size = float(np.abs(weight * forward).sum())
    return abs(float(dr.grad(θ)[0]) - float((weight * forward).sum())) / size if size else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 40), help="first seed, and the one after the last")
    parser.add_argument("--only", type=int, nargs="*", help="these seeds")
    parser.add_argument("--quick", action="store_true", help="the first stage only")
    parser.add_argument("--thorough", action="store_true", help="the last stage at once")
    parser.add_argument(
        "--special", choices=SPECIAL, default="", help="; ".join(f"{k}: {v}" for k, v in SPECIAL.items())
    )
    parser.add_argument("--integrator", default="", help="tested instead of each scene's own: bdpt_edge, say")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba: llvm_ad_spectral, say")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, help="rows as JSON, one a line; seeds that it has are not repeated")
    args = parser.parse_args()
    mi.set_variant(args.variant)
    mi.set_log_level(mi.LogLevel.Error)
    seeds = list(args.only or range(*args.seeds))
    if args.out and args.out.exists():
        known = {json.loads(line)["seed"] for line in args.out.read_text().splitlines()}
        seeds = [s for s in seeds if s not in known]
    if args.processes > 1:
        flags = (("--quick", args.quick), ("--thorough", args.thorough))
        options = [o for o, given in flags if given]
        options += ["--special", args.special] if args.special else []
        options += ["--integrator", args.integrator] if args.integrator else []
        options += ["--variant", args.variant]
        options += ["--out", str(args.out)] if args.out else []
        parts = [seeds[k :: args.processes] for k in range(args.processes)]
        command = [sys.executable, __file__, *options, "--only"]
        running = [subprocess.Popen([*command, *map(str, part)]) for part in parts if part]
        sys.exit(max(p.wait() for p in running))
    stages = STAGES[:1] if args.quick else STAGES[-1:] if args.thorough else STAGES
    bad, refused = [], []
    for seed in seeds:
        row = compare(seed, stages, args.special, args.integrator)
        print(row, flush=True)
        bad += [] if row.agrees or row.refused else [seed]
        refused += [seed] if row.refused else []
        if args.out:
            with args.out.open("a") as file:
                file.write(json.dumps({**asdict(row), "agrees": row.agrees}) + "\n")
        dr.flush_malloc_cache()
    agree = len(seeds) - len(bad) - len(refused)
    print(f"{agree} of {len(seeds) - len(refused)} random scenes agree; not: {bad}; refused: {refused}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
