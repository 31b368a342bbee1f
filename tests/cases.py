"""Scenes and motions on which derivatives are compared with finite differences. `references/make.py` makes the
references."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from as_written import AS_WRITTEN
from beams import BEAMS
from building import (
    CUBE_FACES,
    RES,
    camera,
    constant,
    cube_vertices,
    diffuse,
    film,
    horizontal,
    light,
    mesh,
    quad,
    scene,
)
from coarse import COARSE
from cuts import CURVES, CUTS
from fine_textures import FINE
from grids import GRIDS, LONGER
from hidden_lights import HIDDEN
from instances import INSTANCES
from joints import JOINTS
from leaves import LEAVES, SEEN_THROUGH
from mirrors import MIRRORS, ball_of_index, lamp_in_bulb
from polished import POLISHED
from random_scenes import ball
from rooms import BOARD_ALONG, BOX_ALONG, ROOMS, box_behind_glass, hidden_shadow
from sliding_textures import SLIDING, unsampled_lamp
from tidy import TIDY
from touching_lamps import TOUCHING
from wires import WIRES

from rimlight.checks import FiniteDifferences, Motion, derivative_image, finite_differences

REFERENCES = Path(__file__).parent / "references"
NOISE = REFERENCES / "noise.json"
SHARED = Path(__file__).parents[2] / "shared" / "data"  # beside the project; not everybody has it
REDNER = SHARED / "scenes" / "redner.json"


@dataclass(frozen=True)
class Case:
    """A derivative image with its reference.

    scene : makes the scene.
    motion : arguments of `Motion`.
    step : of the finite differences, in units of θ: a few hundredths of a pixel.
    spp, seeds : of the derivative. Where `spp` is 0, `integrator` has the samples of each term: many of the noisy ones.
    runs : of the finite differences.
    integrator : which one is tested, as a dictionary.
    reference_spp : samples per pixel of each image of the finite differences; a square number.
    needs : a file outside of the project without which there is no scene.
    reference_scene : makes another scene that has the same derivative, where images of Mitsuba's `path` are right.
    reference_images : which integrator makes the images of the finite differences.
    """

    name: str
    scene: Callable[[], mi.Scene]
    motion: dict[str, Any]
    step: float
    spp: int = 32
    seeds: int = 16
    runs: int = 12
    integrator: dict[str, Any] = field(default_factory=lambda: {"type": "direct_edge"})
    reference_spp: int = 16384
    needs: Path | None = None
    reference_scene: Callable[[], mi.Scene] | None = None
    reference_images: str = "path"

    @property
    def max_depth(self) -> int:
        """Of the paths, as Mitsuba counts."""
        return 2 if self.integrator["type"] == "direct_edge" else self.integrator["max_depth"]

    @property
    def reference(self) -> Path:
        return REFERENCES / f"{self.name}.exr"

    def derivatives(self, least: int = 0) -> np.ndarray:
        """One image for each seed, with at least so many samples per pixel: (seeds, H, W, C)."""
        scene = self.scene()
        motion = Motion(scene, **self.motion)
        integrator = mi.load_dict(self.integrator)
        spp = max(least, self.spp)
        images = [derivative_image(scene, integrator, motion, spp=spp, seed=i) for i in range(self.seeds)]
        return np.array(images, np.float64)

    def image(self) -> np.ndarray:
        """What is differentiated: (H, W, C)."""
        return np.array(mi.render(self.scene(), integrator=mi.load_dict(self.integrator), spp=256))


def stored_differences(
    name: str, of: Sequence[str], scene: mi.Scene, motion: Any, runs: int, **options: Any
) -> FiniteDifferences:
    """Finite differences that are made once, by `RENEW_REFERENCES=1 python -m pytest ...`, and then read.

    of : what they are of, in words that must not have changed since. runs, options : of `finite_differences`.
    """
    file = REFERENCES / f"{name}.exr"
    of = json.dumps([*of, sorted(" ".join(str(o).split()) for o in options.items())])
    if os.environ.get("RENEW_REFERENCES"):
        finite_differences(scene, motion, runs=runs, **options).write(file, {"of": of})
    found = FiniteDifferences.read(file)
    assert found.settings["of"] == of, f"{file.name} is of something else: make it anew, with RENEW_REFERENCES=1"
    return found


@contextmanager
def messages() -> Iterator[list[str]]:
    """What is written to Mitsuba's log meanwhile."""
    found = []

    class Collect(mi.Appender):
        def append(self, level, text):
            found.append(text)

        def log_progress(self, *args):
            pass

    appender, logger = Collect(), mi.logger()
    logger.add_appender(appender)
    try:
        yield found
    finally:
        logger.remove_appender(appender)


# ---------------------- Building blocks ----------------------


def bdpt_edge(max_depth: int) -> dict[str, Any]:
    return {"type": "bdpt_edge", "max_depth": max_depth}


def prb_edge(max_depth: int, **samples: int) -> dict:
    return {"type": "prb_edge", "max_depth": max_depth, **samples}


def upto(max_depth: int) -> dict:
    return {"type": "direct_edge"} if max_depth == 2 else prb_edge(max_depth)


def smooth_cube() -> dict:
    """Mitsuba's own cube: 24 vertices, with normals and texture coordinates."""
    return {"type": "cube", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0.3], 30), "bsdf": diffuse(0.5)}


# ---------------------- Scenes ----------------------


def two_triangles() -> mi.Scene:
    """Figure 7a of Li et al. 2018: `vertices_target` of redner's test."""
    return scene(
        sensor=camera((0, 0, -5)),
        green=mesh("green", [[-1.7, 1, 0], [1, 1, 0], [-0.5, -1, 0]], [[0, 1, 2]], bsdf=diffuse(0.35, 0.75, 0.35)),
        red=mesh("red", [[-1, 1.5, 1], [0.2, 1.5, 1], [0.2, -1.5, 1]], [[0, 1, 2]], bsdf=diffuse(0.75, 0.35, 0.35)),
        light=mesh(
            "light",
            [[-1, -1, -7], [1, -1, -7], [-1, 1, -7], [1, 1, -7]],
            [[0, 1, 2], [1, 3, 2]],
            bsdf=diffuse(0.0),
            emitter=light(20, 20, 20),
        ),
    )


def cube(
    sensor: Callable[[], dict] = camera, shape: Callable[[], Any] = smooth_cube, **more: Callable[[], Any]
) -> Callable[[], mi.Scene]:
    return lambda: scene(sensor=sensor(), cube=shape(), environment=constant(), **{k: v() for k, v in more.items()})


def welded_cube():
    return mesh("cube", cube_vertices(), CUBE_FACES, bsdf=diffuse(0.5))


def split_cube():
    """Every triangle with vertices of its own."""
    v = cube_vertices()[np.array(CUBE_FACES)].reshape(-1, 3)
    return mesh("cube", v, np.arange(len(v)).reshape(-1, 3), bsdf=diffuse(0.5))


def coloured_cube(sensor: Callable[[], dict] = camera, **more: Any) -> mi.Scene:
    """Six emitting faces of different colours, which share their vertices' places, but not their vertices."""
    v, colours = cube_vertices(), [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1)]
    faces = {}
    for i, colour in enumerate(colours):
        corners = sorted({c for t in CUBE_FACES[2 * i : 2 * i + 2] for c in t})
        local = [[corners.index(c) for c in t] for t in CUBE_FACES[2 * i : 2 * i + 2]]
        faces[f"face{i}"] = mesh(f"face{i}", v[corners], local, bsdf=diffuse(0.0), emitter=light(*colour))
    return scene(sensor=sensor(), **faces, **more)


def texture() -> dict:
    """A smooth (bilinear) coloured bitmap of 8 × 8 texels."""
    texels = np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32)
    return {
        "type": "diffuse",
        "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "bilinear"},
    }


def textured_cube() -> dict:
    return {**smooth_cube(), "bsdf": texture()}


def room(
    sensor: Callable[[], dict] = camera,
    bsdf: Callable[[], dict] = lambda: diffuse(0.5, two_sided=True),
    **more: Callable[[], Any],
) -> Callable[[], mi.Scene]:
    """A cube of half-side 0.6 above a floor, under an area light and a dim environment."""

    def build() -> mi.Scene:
        T = mi.ScalarTransform4f
        return scene(
            sensor=sensor(),
            floor={
                "type": "rectangle",
                "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3),
                "bsdf": bsdf(),
            },
            cube=mesh("cube", 0.6 * cube_vertices() + [0.2, 0.3, 0], CUBE_FACES, bsdf=diffuse(0.7, 0.4, 0.3)),
            light={
                "type": "rectangle",
                "to_world": T().translate([-1, 4, -1]).rotate([1, 0, 0], 90).scale(0.7),
                "emitter": light(12, 11, 10),
            },
            environment=constant(0.2),
            **{k: v() for k, v in more.items()},
        )

    return build


def torus(name: str = "torus", **props: dict) -> mi.Mesh:
    """A closed mesh with interpolated normals, 48 × 24 quads."""
    u, v = np.meshgrid(np.arange(48) * 2 * np.pi / 48, np.arange(24) * 2 * np.pi / 24, indexing="ij")
    ring = 1 + 0.45 * np.cos(v)
    p = np.stack([ring * np.cos(u), 0.45 * np.sin(v), ring * np.sin(u)], -1).reshape(-1, 3)
    i = np.arange(48 * 24).reshape(48, 24)
    a, b, c, d = i, np.roll(i, -1, 0), np.roll(i, -1, 1), np.roll(i, (-1, -1), (0, 1))
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    return mesh(name, p, faces, normals=True, **props)


def smooth_torus(sensor: Callable[[], dict] = camera) -> Callable[[], mi.Scene]:
    return lambda: scene(sensor=sensor(), torus=torus(bsdf=diffuse(0.5)), environment=constant())


def torus_in_the_sun() -> mi.Scene:
    """Its shadow on itself begins at edges, although its normals are smooth."""
    return scene(sensor=camera(), torus=torus(bsdf=diffuse(0.5)), lamp=sun())


def near_plane(sensor: Callable[..., dict] = camera) -> Callable[[], mi.Scene]:
    """A long floor that passes under the camera and ends behind it."""
    quad = [[-1.2, 0, -9], [1.5, 0, -9], [-1.2, 0, 6], [1.5, 0, 6]]
    return lambda: scene(
        sensor=sensor((0, 1, -5), (0, 0.4, 0)),
        floor=mesh("floor", quad, [[0, 2, 1], [1, 2, 3]], bsdf=diffuse(0.5)),
        environment=constant(),
    )


def near_shape(kind: str, sensor: str = "perspective") -> Callable[[], mi.Scene]:
    """The near clipping plane, two units before the camera, cuts through a sphere, a disk or a cylinder."""
    shapes = {
        "sphere": {"center": [0.3, 0, -3], "radius": 0.5},
        "disk": {"center": [0.1, 0.13, -3]},
        "cylinder": {"p0": [-2, -0.3, -2.8], "p1": [2, 0.5, -2.8], "radius": 0.5},
        "tilted_cylinder": {"p0": [-0.3, -0.2, -3.6], "p1": [0.4, 0.3, -2.4], "radius": 0.4},
    }

    def build() -> mi.Scene:
        props = {**shapes[kind], "bsdf": diffuse(0.8, 0.5, 0.3, two_sided=True)}
        if kind == "disk":
            to_world = mi.ScalarTransform4f().translate(props.pop("center")).rotate([1, 0, 0], 60)
            props["to_world"] = to_world
        at = camera((0, 0, -5), (0, 0, 0), sensor, near_clip=2.0)
        return scene(sensor=at, thing={"type": kind.rpartition("_")[2], **props}, surroundings=surroundings())

    return build


def surroundings() -> dict:
    """What is far away, all around: a smooth picture."""
    picture = np.random.default_rng(3).uniform(0.1, 1.2, (6, 12, 3))
    return {"type": "envmap", "bitmap": mi.Bitmap(picture.astype(np.float32))}


def before_surroundings(sensor: Callable[[], dict]) -> Callable[[], mi.Scene]:
    """A cube, and what is seen past it."""
    return lambda: scene(sensor=sensor(), cube=textured_cube(), surroundings=surroundings())


def glowing_torus() -> mi.Scene:
    """A lamp with interpolated normals, seen directly; it lights itself and a floor."""
    return scene(
        sensor=camera(),
        torus=torus(bsdf=diffuse(0.5), emitter=light(3, 2, 1)),
        floor=horizontal((0, -1.2, 0), 3, "floor", bsdf=diffuse(0.5)),
    )


def coarse_lamp() -> mi.Scene:
    """A ball of 224 triangles with interpolated normals, above the frame, lights a floor past a cube."""
    points, _, _, faces = ball(8)
    lamp = mesh("light", 0.8 * points + [0.3, 3, 0.2], faces, bsdf=diffuse(0), emitter=light(9, 8, 7), normals=True)
    cube = mesh("cube", 0.3 * cube_vertices() + [0.1, 0.3, 0], CUBE_FACES, bsdf=diffuse(0.5))
    floor = horizontal((0, -0.5, 0), 2, "floor", bsdf={"type": "roughconductor", "alpha": 0.4})
    return scene(sensor=camera(), light=lamp, cube=cube, floor=floor)


def lamps_that_reflect() -> mi.Scene:
    """A ball and a cube that emit and reflect, above a floor."""
    ball = {"type": "sphere", "radius": 0.5, "center": [-0.9, 0.2, 0], "bsdf": diffuse(0.6), "emitter": light(1, 2, 3)}
    cube = mesh("cube", 0.4 * cube_vertices() + [0.9, 0, 0], CUBE_FACES, bsdf=diffuse(0.5), emitter=light(2, 1, 1))
    return scene(sensor=camera(), thing=ball, cube=cube, floor=horizontal((0, -1.2, 0), 3, "floor", bsdf=diffuse(0.5)))


def shadow_blocker(
    sensor: Callable[..., dict] = camera, half_side: float = 0.1, shift=(0, 0, 0)
) -> Callable[[], mi.Scene]:
    """Figure 7b and c of Li et al. 2018: a square above the frame, between a floor and an area light that is always
    equally strong.

    half_side : of the light.
    shift : of everything.
    """

    def build() -> mi.Scene:
        at = list(shift)
        radiance = 1000 * (0.1 / half_side) ** 2
        return scene(
            sensor=sensor(np.add(at, [0, 2, -5]), at),
            floor=horizontal(at, 2, "floor", bsdf=diffuse(0.5)),
            blocker=horizontal(np.add(at, [0, 3, 0]), 0.5, "blocker", bsdf=diffuse(0.5)),
            light=horizontal(
                np.add(at, [0, 5, 0]),
                half_side,
                "light",
                down=True,
                bsdf=diffuse(0.0),
                emitter=light(radiance, radiance, radiance),
            ),
        )

    return build


def lens_over_blocker(origin, target) -> dict:
    return camera(origin, target, "thinlens", aperture_radius=0.15, focus_distance=4.5)


def parallel_over_blocker(origin, target) -> dict:
    """To the side, lest the floor end where the frame does."""
    return camera(np.add(origin, [0.3, 0, 0]), np.add(target, [0.3, 0, 0]), "orthographic")


def fisheye_over_blocker(origin, target) -> dict:
    """Closer, with the shadow between centre and rim, and without the light in view."""
    return fisheye(np.add(target, [0.5, 1.2, -1.5]), np.add(target, [1, 1, 1]), fov=130)


def conductor(alpha: float) -> dict:
    return {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}


def glossy_receiver(alpha: float) -> Callable[[], mi.Scene]:
    """redner's test of glossy shadows: the frame is filled by a glossy floor. It mirrors a wide light, and in front of
    it a blocker, which is not in the frame itself. One of its sides is slanted here, lest its reflection end exactly
    between two pixels."""

    def build() -> mi.Scene:
        blocker = [[0, 1, 0.5], [0.2, 3, 0.5], [0.8, 1, 0.5], [0.8, 3, 0.5]]
        return scene(
            sensor=camera((0, 2, -4), (0, -2, 0)),
            floor=horizontal((0, 0, 0), 4, "floor", bsdf=conductor(alpha)),
            blocker=mesh("blocker", blocker, [[0, 1, 2], [1, 3, 2]], bsdf=diffuse(0.5)),
            light=quad([-2, 0, 4], [0, 12, 0], [4, 0, 0], "light", bsdf=diffuse(0.0), emitter=light(0.5, 0.5, 0.5)),
        )

    return build


def near_light() -> mi.Scene:
    """Figure 9 of Li et al. 2018: a floor under a small light close to it, which is bright in its middle."""
    return scene(
        sensor=camera((0, 2.5, -2.5)),
        floor=horizontal((0.03, 0, 0.02), 0.7, "floor", bsdf=diffuse(0.5)),
        light=horizontal((0.1, 0.35, 0.15), 0.05, "light", down=True, bsdf=diffuse(0.0), emitter=light(30, 28, 26)),
    )


COLOURS = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}


def coloured_sphere(seam: bool, columns: int = 40, rings: int = 24) -> mi.Mesh:
    """A ball of smooth colours and interpolated normals. One column of its quads is cut in two coplanar halves.

    seam : the cut is a seam of texture coordinates, with vertices of its own on either side. Shape, colours and normals
        stay the same, since the faces on the two sides mirror each other.
    """
    longitude = np.arange(columns) * 2 * np.pi / columns
    ring = np.stack([np.cos(longitude), np.sin(longitude)], -1)
    cut = (ring[:1] + ring[-1:]) / 2
    ring = np.concatenate([ring, cut, cut])
    latitude = np.arange(1, rings) * np.pi / rings
    height = np.broadcast_to(np.cos(latitude), (len(ring), rings - 1))
    around = np.stack([ring[:, :1] * np.sin(latitude), height, ring[:, 1:] * np.sin(latitude)], -1)
    p = np.concatenate([[[0, 1, 0], [0, -1, 0]], around.reshape(-1, 3)])
    u = (np.append(np.arange(columns + 1), -0.5) + 0.5) / columns
    u[columns] = 1
    uv = np.stack(np.broadcast_arrays(u[:, None], latitude / np.pi), -1).reshape(-1, 2)
    uv = np.concatenate([[[0.5, 0], [0.5, 1]], uv])
    index = 2 + np.arange((columns + 2) * (rings - 1)).reshape(columns + 2, rings - 1)
    if not seam:
        p, uv, index[-1] = p[: 1 - rings], None, index[-2]
    faces = []
    for i in range(columns + 1):
        left, right = index[[i, i + 1] if i < columns else [-1, 0]]
        a, b, c, d = left[:-1], right[:-1], left[1:], right[1:]
        halves = ([a, b, c], [b, d, c]) if i < columns else ([a, b, d], [a, d, c])
        faces += [[[0, right[0], left[0]], [left[-1], right[-1], 1]], *(np.stack(h, -1) for h in halves)]
    colours = 0.5 + 0.4 * np.sin(4 * p + [0, 1, 2])
    return mesh("sphere", 0.6 * p + [0.1, 1.9, 0.5], np.concatenate(faces), True, uv, colours, bsdf=COLOURS)


def mirrored_sphere(seam: bool) -> Callable[[], mi.Scene]:
    """The frame is filled by a rough mirror, which shows a sphere that is lit from the camera's side."""
    return lambda: scene(
        sensor=camera((0, 2, -4), (0, -2, 0)),
        floor=horizontal((0, 0, 0), 4, "floor", bsdf=conductor(0.05)),
        sphere=coloured_sphere(seam),
        light={
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at([-2, 4, -4], [0.1, 1.9, 0.5], [0, 1, 0]).scale(0.5),
            "bsdf": diffuse(0.0),
            "emitter": light(60, 55, 50),
        },
    )


def cornell_box() -> mi.Scene:
    """Mitsuba's own, with the boxes a hundredth higher, so that the large one does not stick in the floor. The meshes
    share a BSDF, but must not be merged."""
    box = mi.cornell_box()
    for name in ("small-box", "large-box"):
        up = mi.ScalarTransform4f().translate([0, 0.01, 0])
        box[name] = {**box[name], "to_world": up @ box[name]["to_world"]}
    return mi.load_dict({**box, "sensor": {**box["sensor"], "film": film()}}, optimize=False)


def bunny_box() -> mi.Scene:
    """redner's test of global illumination: a bunny in a box. Only where the shared data are."""
    box = json.loads(REDNER.read_text())["scenes"]["bunny_box"]
    view = box["camera"]
    shapes = {}
    for shape in box["shapes"]:
        name, emitter = shape["name"], shape.get("emission_radiance")
        props = {"bsdf": diffuse(*box["materials"][shape["material"]]["reflectance"])}
        if emitter:
            props["emitter"] = light(*emitter)
        if "ply_target" in shape:
            shapes[name] = {"type": "ply", "filename": str(REDNER.parent / shape["ply_target"]), **props}
        else:
            shapes[name] = mesh(name, shape["vertices"], shape["indices"], **props)
    return scene(sensor=camera(view["origin"], view["target"], fov=view["fov_deg"]), **shapes)


def out_of_frame() -> mi.Scene:
    """A floor that is lit only by a cube beside the frame, and the cube by a light below it, level with the floor."""
    return scene(
        sensor=camera((0, 2, -5), (0, 0, 0), fov=28),
        floor=horizontal((0, 0, 0), 1.1, "floor", bsdf=diffuse(0.7)),
        cube=mesh("cube", 0.55 * cube_vertices() + [2.4, 1.5, 0], CUBE_FACES, bsdf=diffuse(0.7, 0.6, 0.5)),
        light=horizontal((2.4, 0.1, 0.1), 0.4, "light", bsdf=diffuse(0.0), emitter=light(30, 30, 30)),
    )


def open_air() -> mi.Scene:
    """A small cube above a floor, under the sky alone."""
    return scene(
        sensor=camera(),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4)),
        cube=mesh("cube", 0.4 * cube_vertices() + [0.23, -0.23, 0], CUBE_FACES, bsdf=diffuse(0.4, 0.5, 0.7)),
        environment=constant(),
    )


def sky_blocker() -> mi.Scene:
    """A square above the frame, over a floor under the sky alone: all of the derivative comes from edges that points of
    the floor see."""
    return scene(
        sensor=camera((0, 2, -5), (0, 0, 0)),
        floor=horizontal((0, 0, 0), 4, "floor", bsdf=diffuse(0.6, 0.5, 0.4)),
        blocker=horizontal((0.3, 2.2, -0.2), 1.5, "blocker", down=True, bsdf=diffuse(0)),
        environment=constant(),
    )


def hard_shadow(lamp: Callable[[], dict], sensor: Callable[[], dict] = camera) -> Callable[[], mi.Scene]:
    """A cube and its shadow on a floor, in the light of a lamp without size."""
    return lambda: scene(
        sensor=sensor(),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4)),
        cube=mesh("cube", 0.4 * cube_vertices() + [0.23, 0.1, 0], CUBE_FACES, bsdf=diffuse(0.4, 0.5, 0.7)),
        lamp=lamp(),
    )


def spot() -> dict:
    to_world = mi.ScalarTransform4f().look_at([-1, 4, -1], [0.2, 0, 0.1], [0, 0, 1])
    return {"type": "spot", "to_world": to_world, "intensity": 20.0, "cutoff_angle": 25.0}


def sun() -> dict:
    return {"type": "directional", "direction": [0.5, -1, 0.3], "irradiance": 2.0}


def sphere_over(*lamps: Callable[[], dict]) -> Callable[[], mi.Scene]:
    return lambda: over_floor({"type": "sphere", "radius": 0.55, "center": [0.23, 0.1, 0]}, lamps)


def disk_over(*lamps: Callable[[], dict]) -> Callable[[], mi.Scene]:
    def build() -> mi.Scene:
        to_world = mi.ScalarTransform4f().translate([0.23, 0.1, 0]).rotate([1, 0, 0], 60).scale([0.7, 0.5, 1])
        return over_floor({"type": "disk", "to_world": to_world, "bsdf": diffuse(0.5, two_sided=True)}, lamps)

    return build


def cylinder_over(*lamps: Callable[[], dict]) -> Callable[[], mi.Scene]:
    thing = {"type": "cylinder", "p0": [0, -0.3, 0.2], "p1": [0.5, 0.5, -0.2], "radius": 0.3}
    return lambda: over_floor({**thing, "bsdf": diffuse(0.5, two_sided=True)}, lamps)


def thin_cylinder() -> mi.Scene:
    """Of a hundredth of its distance: in single precision, rays just inside of its outline miss it."""
    thing = {"type": "cylinder", "p0": [-1.2, -0.8, 0.3], "p1": [0.8, 0.9, -0.2], "radius": 0.04, "id": "thing"}
    return scene(sensor=camera(), thing={**thing, "bsdf": diffuse(0.8)}, lamp=sun(), sky=constant(0.1))


def thin_post(sensor: Callable[[], dict] = camera) -> mi.Scene:
    """A thin cylinder that stands in the floor."""
    thing = {"type": "cylinder", "p0": [0.2, -0.8, 0], "p1": [0.2, 0.5, 0], "radius": 0.04, "id": "thing"}
    floor = horizontal((0, -0.3, 0), 2, "floor", bsdf=diffuse(0.0), emitter=light(1, 1, 1))
    return scene(sensor=sensor(), thing={**thing, "bsdf": diffuse(0.0)}, floor=floor)


def over_floor(thing: dict, lamps: tuple[Callable[[], dict], ...]) -> mi.Scene:
    """A shape above a floor, lit by the lamps."""
    return scene(
        sensor=camera(),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4)),
        thing={**thing, "id": "thing"},
        **{f"lamp{i or ''}": lamp() for i, lamp in enumerate(lamps)},
    )


def projector() -> dict:
    """It throws a smooth image with a black border."""
    x = np.linspace(-1, 1, 16)
    window = np.cos(0.5 * np.pi * x)
    window[[0, -1]] = 0
    image = (window[:, None] * window)[..., None] * (1 + 0.5 * np.sin(5 * x[:, None, None] + np.arange(3)))
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.float32(image)), "raw": True}
    return {"type": "projector", "to_world": spot()["to_world"], "irradiance": bitmap, "fov": 40.0, "scale": 10.0}


def led() -> dict:
    return {"type": "led", "position": [-1, 4, -1], "axis": [0.3, -1, 0.2], "intensity": 20.0, "mu": 2.0}


def distant(angular_radius: float = 0) -> Callable[[], dict]:
    """Three distant lights."""
    directions = "-0.5 1 -0.3, 0.5 1 0.1, 0.1 0.8 -0.9"
    lights = {"type": "distant_lights", "directions": directions, "irradiance": "1 0.9 0.8, 0.4 0.5 0.6, 0.3 0.3 0.3"}
    return lambda: {**lights, "angular_radius": angular_radius}


def ceiling_light() -> dict:
    """Of half-side 0.3."""
    return horizontal((-0.5, 3, -0.5), 0.3, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(40, 38, 36))


def sphere_light() -> mi.Scene:
    """A cube and its shadow on a floor, in the light of a ball."""
    return scene(
        sensor=camera(),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4)),
        cube=mesh("cube", 0.4 * cube_vertices() + [0.23, 0.1, 0], CUBE_FACES, bsdf=diffuse(0.4, 0.5, 0.7)),
        lamp={"type": "sphere", "center": [-0.5, 2.5, -0.5], "radius": 0.3, "emitter": light(30, 28, 26)},
    )


def lit_room() -> mi.Scene:
    """A closed room with a point light and a cube."""
    walls = {}
    for k, name in enumerate(["left", "right", "floor", "ceiling", "back", "front"]):
        axis, sign = k // 2, 1 - 2 * (k % 2)
        o, u, v = np.zeros(3), np.zeros(3), np.zeros(3)
        o[axis], u[(axis + 1) % 3], v[(axis + 2) % 3] = -sign, 2, 2
        o[(axis + 1) % 3] = o[(axis + 2) % 3] = -1
        u, v = (u, v) if sign > 0 else (v, u)
        walls[name] = quad(
            o * [1.5, 1, 2], u * [1.5, 1, 2], v * [1.5, 1, 2], name, bsdf=diffuse(0.6, 0.5 - 0.05 * k, 0.4)
        )
    return scene(
        sensor=camera((0.4, 0.3, -1.8), (0, -0.2, 0.5), fov=60),
        cube=mesh("cube", 0.2 * cube_vertices() + [0.2, -0.3, 0.7], CUBE_FACES, bsdf=diffuse(0.4, 0.5, 0.7)),
        lamp={"type": "point", "position": [-0.4, 0.6, 0.2], "intensity": 2.0},
        **walls,
    )


DEPTH = {"key": "cube.vertex_positions", "direction": [0, 0, 1]}
INDEX = {"key": "ball.bsdf.eta", "direction": [1]}
SIDE = {"key": "cube.vertex_positions", "direction": [1, 0.3, 0]}
TURN = {"key": "cube.vertex_positions", "rotate": [0.2, 1, 0]}
DIRECTIONS = {"key": "lamp.directions", "direction": [0.3, 0, 1, 1, 0, 0, 0, 0.5, 0.5]}
TORUS_TURN = {"key": "torus.vertex_positions", "rotate": [0.2, 1, 0.4]}
THING_SIDE = {"key": "thing.to_world", "direction": [1, 0.3, 0]}
THING_TURN = {"key": "thing.to_world", "rotate": [0.2, 1, 0.4]}
LAMP_SIDE = {"key": "lamp.to_world", "direction": [1, 0.3, 0.2]}
LAMP_TURN = {"key": "lamp.to_world", "rotate": [0.3, 0.2, 1]}
CAMERA_X = {"key": "sensor.to_world", "direction": [1, 0, 0]}
CAMERA_UP = {"key": "sensor.to_world", "direction": [0, 1, 0]}
UP = {"key": "torus.vertex_positions", "direction": [0, 1, 0]}
CAMERA_Z = {"key": "sensor.to_world", "direction": [0, 0, 1]}
ALONG = {"key": "sensor.to_world", "direction": [0.3, 1, 0.2]}
LEFT_CAMERA = {**ALONG, "key": "sensor.left.to_world"}
CAMERA_TURN = {"key": "sensor.to_world", "rotate": [0, 1, 0.2]}
FIELD_OF_VIEW = {"key": "sensor.x_fov", "direction": [1]}
FISHEYE_FIELD_OF_VIEW = {"key": "sensor.fov", "direction": [1]}
PRINCIPAL_POINT_X = {"key": "sensor.principal_point_offset_x", "direction": [1]}
PRINCIPAL_POINT_Y = {"key": "sensor.principal_point_offset_y", "direction": [1]}
FLOOR_TURN = {"key": "floor.to_world", "rotate": [1, 0, 0]}
FOCUS = {"key": "sensor.focus_distance", "direction": [1]}
CROP = {"width": 64, "height": 48, "crop_width": RES, "crop_height": RES, "crop_offset_x": 20, "crop_offset_y": 4}


BLOCKER_UP = {"key": "blocker.vertex_positions", "direction": [0, 1, 0]}
LIGHT_SIDE = {"key": "light.vertex_positions", "direction": [1, 0.3, 0.2]}
FLOOR_SIDE = {"key": "floor.vertex_positions", "direction": [1, 0, 0]}
FLOOR_UP = {"key": "floor.vertex_positions", "direction": [0.2, 1, 0]}
SPHERE_SIDE = {"key": "sphere.vertex_positions", "direction": [1, 0.3, 0]}
BUNNY_SIDE = {"key": "bunny.vertex_positions", "direction": [1, 0, 0]}
BOX_SIDE = {"key": "small-box.vertex_positions", "direction": [1, 0, 0.4]}
ORBIT = {"key": "sensor.to_world", "rotate": [0, 1, 0], "pivot": [0, 0, 0]}
BLOCKER_SIDE = {"key": "blocker.vertex_positions", "direction": [1, 0, 0]}
INTO_THE_SCREEN = {"key": "sensor.to_world", "direction": [0, -0.371391, 0.928477]}


def vertex(name: str, index: int) -> dict:
    """One vertex moves to the left."""
    return {"key": f"{name}.vertex_positions", "direction": [-1, 0, 0], "vertices": [index]}


def filtered(rfilter: str) -> Callable[[], mi.Scene]:
    return cube(lambda: camera(film=film(rfilter)))


def orthographic() -> dict:
    return camera(kind="orthographic")


def thin_lens() -> dict:
    return camera(kind="thinlens", aperture_radius=0.3, focus_distance=4.0)


def fisheye(origin=(2.2, 0.4, 0.6), target=(0.6, -0.5, 5), **options: Any) -> dict:
    """At `cube`, across the rim of its image circle: it is beside it, partly behind."""
    return camera(origin, target, kind="fisheye", **{"fov": 180, **options})


def fisheye_crop() -> dict:
    return fisheye(fov_axis="diagonal", film={**film("gaussian"), **CROP, "crop_offset_x": 32})


def all_around(origin, target) -> dict:
    """The whole sphere of directions."""
    return fisheye(origin, target, fov=360)


def batch(origin=(1.5, 2, -5), target=(0, 0, 0), right=camera, **options: Any) -> dict:
    """Two views side by side: from `origin`, and from somewhere to the left of it."""
    aside = np.add(origin, [-1.5, 0.3, 0.5])
    options = {"width": 2 * RES, **options}
    return {
        "type": "batch",
        "left": camera(origin, target),
        "right": right(aside, np.add(target, [-0.2, 0, 0])),
        "film": film(**options),
    }


def batch_with_fisheye() -> dict:
    """One of each kind."""
    return batch(right=lambda *pose: fisheye(*pose, fov=70))


def batch_crop() -> dict:
    """Each view is stretched to its half of the crop window."""
    return batch(**{**CROP, "height": RES, "crop_width": 40, "crop_height": 24}, rfilter="gaussian")


def close_up() -> dict:
    """The cube does not fit into the frame."""
    return camera((0.8, 1, -2.6))


def close_up_with_border() -> dict:
    return camera((0.8, 1, -2.6), film=film("gaussian", sample_border=True))


def cut_open() -> dict:
    """The near clipping plane cuts through the cube."""
    return camera(near_clip=5.2)


def crop(rfilter: str = "box") -> Callable[[], mi.Scene]:
    return cube(lambda: camera(film={**film(rfilter), **CROP}))


MIRRORED = prb_edge(3, sppc=256, sppp=32, sppi=32)

SLIDE_THING, SLIDE_CAMERA = ({"key": f"{k}.to_world", "direction": [0.6, 1, 0.3]} for k in ("thing", "sensor"))

CASES = [
    Case("two_triangles_green", two_triangles, vertex("green", 1), 4e-3, runs=48),
    Case("two_triangles_red", two_triangles, vertex("red", 1), 4e-3, runs=48),
    Case("cube_depth", cube(), DEPTH, 1e-2),
    Case("cube_turn", cube(), TURN, 6e-3),
    Case("cube_welded", cube(shape=welded_cube), DEPTH, 1e-2),
    Case("cube_split", cube(shape=split_cube), DEPTH, 1e-2),
    Case("coloured_cube_camera", coloured_cube, CAMERA_X, 6e-3),
    Case("camera_translation", cube(), CAMERA_Z, 1e-2),
    Case("camera_rotation", cube(), CAMERA_TURN, 1e-3),
    Case("field_of_view", cube(), FIELD_OF_VIEW, 0.1),
    Case("principal_point", cube(), PRINCIPAL_POINT_X, 1e-3),
    Case("textured_cube_side", cube(shape=textured_cube), SIDE, 6e-3),
    Case("textured_cube_camera_translation", cube(shape=textured_cube), CAMERA_X, 6e-3),
    Case("textured_cube_camera_rotation", cube(shape=textured_cube), CAMERA_TURN, 1e-3),
    Case("textured_cube_field_of_view", cube(shape=textured_cube), FIELD_OF_VIEW, 0.1),
    Case("textured_cube_principal_point", cube(shape=textured_cube), PRINCIPAL_POINT_Y, 1e-3, spp=64),
    Case("orthographic_cube", cube(orthographic), SIDE, 5e-3),
    Case("orthographic_camera", cube(orthographic, textured_cube), CAMERA_X, 5e-3),
    Case("thin_lens_cube", cube(thin_lens), SIDE, 1e-2),
    Case("thin_lens_camera", cube(thin_lens), CAMERA_Z, 2e-2),
    Case("thin_lens_focus", cube(thin_lens), FOCUS, 4e-2),
    Case("fisheye_cube", cube(fisheye, textured_cube), SIDE, 6e-3),
    Case("fisheye_camera", cube(fisheye, textured_cube), ALONG, 6e-3),
    Case("fisheye_camera_rotation", cube(fisheye, textured_cube), CAMERA_TURN, 3e-3, spp=64),
    Case("fisheye_field_of_view", cube(fisheye, textured_cube), FISHEYE_FIELD_OF_VIEW, 0.3),
    Case("fisheye_crop_window", cube(fisheye_crop, textured_cube), ALONG, 4e-3),
    Case("fisheye_all_around", near_plane(all_around), ALONG, 8e-3, runs=24),
    Case("batch_cube", cube(batch_with_fisheye, textured_cube), SIDE, 6e-3),
    Case("batch_camera", cube(batch, textured_cube), LEFT_CAMERA, 6e-3),
    Case("batch_crop_window", cube(batch_crop, textured_cube), SIDE, 6e-3),
    Case("gaussian_filter", filtered("gaussian"), SIDE, 6e-3),
    Case("tent_filter", filtered("tent"), SIDE, 6e-3),
    Case("mitchell_filter", filtered("mitchell"), SIDE, 6e-3),
    Case("sample_border", cube(close_up_with_border), SIDE, 4e-3, runs=36),
    Case("crop_window", crop(), SIDE, 4e-3),
    Case("crop_window_camera", crop("gaussian"), PRINCIPAL_POINT_X, 1e-3),
    Case("leaving_the_frame", cube(close_up), SIDE, 4e-3, runs=36),
    Case("near_plane", near_plane(), {"key": "floor.vertex_positions", "direction": [0.3, 1, 0]}, 2e-3),
    Case("near_plane_camera", near_plane(), ALONG, 2e-3),
    Case("near_plane_cut", cube(cut_open), SIDE, 4e-3),
    Case("near_plane_cut_camera", cube(cut_open), {"key": "sensor.to_world", "rotate": [0.3, 1, 0.3]}, 8e-4),
    Case("near_plane_sphere", near_shape("sphere"), SLIDE_THING, 2e-3, reference_spp=4096),
    Case("near_plane_disk", near_shape("disk", "orthographic"), SLIDE_THING, 2e-3, reference_spp=4096),
    Case("near_plane_cylinder", near_shape("cylinder"), SLIDE_THING, 2e-3, reference_spp=4096),
    Case("near_plane_camera_cylinder", near_shape("tilted_cylinder"), SLIDE_CAMERA, 2e-3, reference_spp=4096),
    Case("smooth_torus", smooth_torus(), UP, 6e-3, spp=64),
    Case("smooth_torus_camera", smooth_torus(), CAMERA_UP, 6e-3, spp=64),
    Case("room_cube", room(), SIDE, 6e-3),
    Case("room_camera", room(), CAMERA_X, 6e-3),
    Case("room_light", room(), {"key": "light.to_world", "direction": [1, -0.5, 0]}, 1e-2),
    Case("room_floor_turns", room(), FLOOR_TURN, 6e-3, spp=64, runs=48),
    # Figure 7 of Li et al. 2018: within 1 % at 32,768 samples per pixel.
    Case("shadow_blocker", shadow_blocker(), BLOCKER_UP, 2.5e-2, runs=100),
    Case("shadow_camera", shadow_blocker(), INTO_THE_SCREEN, 3e-2, runs=64),
    # A nearly sharp shadow: the penumbra is 0.06 pixels wide.
    Case("shadow_small_light", shadow_blocker(half_side=3e-3), BLOCKER_UP, 1e-2, runs=24),
    # Far from the origin single precision is as coarse as 1e-4; the step is a power of two, which it represents.
    # Mitsuba's shadow rays start 0.18 above the floor there: image and derivative differ from those at the origin.
    # Where Mitsuba's rays start 0.2 units above surfaces.
    Case(
        "shadow_far_away",
        shadow_blocker(shift=(500, -800, 2000)),
        BLOCKER_UP,
        2**-5,
        runs=32,
        reference_scene=shadow_blocker(),
    ),
    Case("shadow_light", shadow_blocker(), LIGHT_SIDE, 2e-2, runs=24),
    Case("shadow_floor", shadow_blocker(), FLOOR_UP, 6e-3, runs=24),
    Case("shadow_thin_lens", shadow_blocker(lens_over_blocker), BLOCKER_UP, 3e-2, runs=40),
    Case("shadow_thin_lens_camera", shadow_blocker(lens_over_blocker), INTO_THE_SCREEN, 3e-2, runs=40),
    Case("shadow_orthographic", shadow_blocker(parallel_over_blocker), BLOCKER_UP, 3e-2, runs=24),
    Case("shadow_orthographic_camera", shadow_blocker(parallel_over_blocker), ALONG, 1e-2, runs=24),
    Case("shadow_fisheye", shadow_blocker(fisheye_over_blocker), BLOCKER_UP, 1e-2, runs=24),
    Case("shadow_fisheye_camera", shadow_blocker(fisheye_over_blocker), ALONG, 6e-3, runs=24),
    Case("shadow_batch", shadow_blocker(batch), BLOCKER_UP, 2.5e-2),
    Case("shadow_batch_camera", shadow_blocker(batch), LEFT_CAMERA, 1e-2),
    Case("glossy_receiver", glossy_receiver(0.01), BLOCKER_SIDE, 8e-3, spp=256, runs=40),
    Case(
        "mirror_receiver",
        glossy_receiver(5e-4),
        BLOCKER_SIDE,
        5e-3,
        spp=0,
        runs=24,
        integrator={"type": "direct_edge", "sppc": 32, "sppp": 32, "sppi": 1024},
    ),
    # Zero, but for the floor's outline.
    Case("near_light", near_light, FLOOR_SIDE, 4e-3, runs=24),
    # These two must agree with each other, too.
    Case("mirrored_sphere", mirrored_sphere(False), SPHERE_SIDE, 4e-2, spp=0, runs=64, integrator=MIRRORED),
    Case("mirrored_sphere_seam", mirrored_sphere(True), SPHERE_SIDE, 4e-2, spp=0, runs=64, integrator=MIRRORED),
    Case(
        "cornell_box",
        cornell_box,
        BOX_SIDE,
        1.5e-2,
        spp=0,
        runs=8,
        integrator=prb_edge(5, sppc=64, sppp=32, sppi=128),
    ),
    Case(
        "cornell_box_camera",
        cornell_box,
        ORBIT,
        8e-3,
        spp=64,
        runs=8,
        integrator=prb_edge(5),
    ),
    Case(
        "bunny_box",
        bunny_box,
        BUNNY_SIDE,
        1e-2,
        spp=0,
        runs=36,
        integrator=prb_edge(7, sppc=16, sppp=64, sppi=16),
        reference_spp=4096,
        needs=REDNER,
    ),
    # Hard shadows.
    Case("spot_cube", hard_shadow(spot), SIDE, 6e-3),
    Case("spot_cube_turn", hard_shadow(spot), TURN, 6e-3),
    Case("spot_light", hard_shadow(spot), LAMP_SIDE, 6e-3),
    Case("spot_light_turn", hard_shadow(spot), LAMP_TURN, 4e-3),
    Case("spot_camera", hard_shadow(spot), CAMERA_X, 6e-3),
    Case("sun_cube", hard_shadow(sun), SIDE, 6e-3),
    Case("sun_cube_turn", hard_shadow(sun), TURN, 6e-3),
    Case("sun_turns", hard_shadow(sun), LAMP_TURN, 4e-3),
    Case("sun_camera", hard_shadow(sun), CAMERA_X, 6e-3),
    Case("lit_room_cube", lit_room, SIDE, 3e-3),
    Case("lit_room_cube_turn", lit_room, TURN, 6e-3),
    Case("lit_room_light", lit_room, {"key": "lamp.position", "direction": [1, 0.3, 0.2]}, 3e-3),
    Case("lit_room_camera", lit_room, CAMERA_X, 3e-3),
    Case("projector_cube", hard_shadow(projector), SIDE, 6e-3),
    Case("projector_turns", hard_shadow(projector), LAMP_TURN, 6e-3),
    Case("led_cube", hard_shadow(led), SIDE, 6e-3),
    Case("led_moves", hard_shadow(led), {"key": "lamp.position", "direction": [1, 0.3, 0.2]}, 6e-3),
    Case("distant_cube", hard_shadow(distant()), SIDE, 6e-3),
    Case("distant_cube_turn", hard_shadow(distant()), TURN, 6e-3, runs=72),
    Case("distant_lights", hard_shadow(distant()), DIRECTIONS, 6e-3),
    Case("distant_camera", hard_shadow(distant()), CAMERA_X, 6e-3),
    Case("discs_cube", hard_shadow(distant(5)), SIDE, 6e-3, runs=24),
    Case("discs_lights", hard_shadow(distant(5)), DIRECTIONS, 1e-2),
    Case("discs_radius", hard_shadow(distant(5)), {"key": "lamp.angular_radius", "direction": [1]}, 0.2, spp=128),
    # Without the edges where its shadow on itself begins, |z| is above 50.
    Case("smooth_torus_sun", torus_in_the_sun, TORUS_TURN, 6e-3),
    # Spheres, disks and cylinders.
    Case("sphere_sun", sphere_over(sun), THING_SIDE, 6e-3),
    Case("sphere_soft", sphere_over(ceiling_light), THING_SIDE, 1e-2, spp=64, runs=24),
    Case("sphere_camera", sphere_over(sun), CAMERA_X, 6e-3),
    Case("sphere_sky", sphere_over(constant), THING_SIDE, 1e-2, spp=256, runs=96),
    Case("disk_sun_turn", disk_over(sun), THING_TURN, 6e-3),
    Case("disk_soft", disk_over(ceiling_light), THING_SIDE, 1e-2, runs=24),
    Case("cylinder_sun_turn", cylinder_over(sun), THING_TURN, 6e-3),
    Case("cylinder_soft", cylinder_over(ceiling_light), THING_SIDE, 1e-2, runs=24),
    Case("cylinder_camera", cylinder_over(ceiling_light), CAMERA_X, 6e-3, runs=24),
    Case("thin_post", thin_post, FLOOR_UP, 6e-3),
    Case("thin_post_orthographic", lambda: thin_post(orthographic), FLOOR_UP, 6e-3),
    Case("thin_cylinder", thin_cylinder, THING_SIDE, 6e-3, runs=24, spp=256),
    Case("sphere_light", sphere_light, LAMP_SIDE, 2e-2, spp=128, runs=24),
    # What random scenes found, in its simplest form.
    Case(
        "surroundings",
        before_surroundings(lambda: camera(film=film("gaussian"))),
        CAMERA_TURN,
        1e-3,
        reference_spp=4096,
    ),
    Case("surroundings_thin_lens", before_surroundings(thin_lens), CAMERA_TURN, 1e-3, reference_spp=4096),
    Case("surroundings_orthographic", before_surroundings(orthographic), CAMERA_TURN, 1e-3, reference_spp=4096),
    Case("surroundings_fisheye", before_surroundings(fisheye), CAMERA_TURN, 3e-3, reference_spp=4096),
    Case(
        "surroundings_turn",
        before_surroundings(camera),
        {"key": "surroundings.to_world", "rotate": [0.2, 1, 0]},
        4e-3,
        reference_spp=4096,
    ),
    Case("glowing_torus", glowing_torus, UP, 6e-3, runs=24, reference_spp=4096),
    Case("glowing_torus_camera", glowing_torus, CAMERA_UP, 6e-3, runs=24, reference_spp=4096),
    Case("coarse_lamp", coarse_lamp, LIGHT_SIDE, 1.2e-2, spp=64),
    Case("coarse_lamp_cube", coarse_lamp, SIDE, 1.2e-2, spp=64, runs=36),
    Case("reflecting_ball", lamps_that_reflect, THING_SIDE, 6e-3, runs=24, reference_spp=4096),
    Case("reflecting_cube", lamps_that_reflect, SIDE, 6e-3, runs=24, reference_spp=4096),
    Case("reflecting_camera", lamps_that_reflect, CAMERA_X, 6e-3, runs=24, reference_spp=4096),
    Case(
        "light_out_of_frame",
        shadow_blocker(lambda *a: camera(*a, film=film("tent"))),
        LIGHT_SIDE,
        2e-2,
        runs=24,
        reference_spp=4096,
    ),
    # Geometry that moves at indirect bounces: only there, and in the frame as well.
    Case(
        "out_of_frame",
        out_of_frame,
        SIDE,
        0.12,
        spp=0,
        runs=100,
        integrator=prb_edge(3, sppc=1024, sppp=32, sppi=64),
    ),
    Case("open_air", open_air, SIDE, 1e-2, spp=128, runs=96, integrator=prb_edge(3)),
    Case("sky_blocker", sky_blocker, BLOCKER_SIDE, 5e-2, spp=256, runs=48),
    *(Case(k, *of, spp=64, runs=12, integrator=prb_edge(4), reference_spp=4096) for k, of in ROOMS.items()),
    Case("hidden_shadow", hidden_shadow, BOARD_ALONG, 1e-2, spp=128, runs=24, integrator=prb_edge(3)),
    Case(
        "lamp_in_bulb",
        lamp_in_bulb,
        {"key": "lamp.to_world", "direction": [0, 1, 0]},
        1e-2,
        spp=128,
        runs=24,
        integrator=bdpt_edge(4),
        reference_images="bdpt",
        reference_spp=4096,
    ),
    Case("glass_index", ball_of_index, INDEX, 5e-3, integrator=prb_edge(6), reference_spp=1024),
    Case("box_behind_glass", box_behind_glass, BOX_ALONG, 1e-2, spp=256, runs=24, integrator=prb_edge(3)),
    *(
        Case(k, *of, spp=64, runs=24, integrator=upto(depth), reference_spp=4096)
        for k, (*of, depth) in (CUTS | MIRRORS | BEAMS).items()
    ),
    *(
        Case(k, *of, spp=64, runs=24, integrator=upto(depth), reference_spp=1024)
        for k, (*of, depth) in TOUCHING.items()
    ),
    *(
        Case(
            k,
            *of,
            spp=64,
            runs=16,
            integrator=upto(depth),
            reference_spp=1024,
            reference_scene=unsampled_lamp if k == "lamp_slides" else None,
        )
        for k, (*of, depth) in SLIDING.items()
    ),
    *(Case(k, *of, spp=256, runs=24, integrator=upto(depth), reference_spp=1024) for k, (*of, depth) in LEAVES.items()),
    *(Case(k, *of, spp=64, runs=16, integrator=upto(depth)) for k, (*of, depth) in SEEN_THROUGH.items()),
    *(Case(k, *of, spp=64, runs=8) for k, of in TIDY.items()),
    *(
        Case(k, *of, spp=256, runs=16, integrator=upto(depth), reference_spp=4096)
        for k, (*of, depth) in POLISHED.items()
    ),
    *(
        Case(k, *of, spp=64, runs=24, integrator=upto(depth), reference_spp=4096 if k.endswith("_slides") else 1024)
        for k, (*of, depth) in (INSTANCES | CURVES | JOINTS).items()
    ),
    *(Case(k, *of, spp=64, runs=12, integrator=kind, reference_spp=4096) for k, (*of, kind) in AS_WRITTEN.items()),
    *(
        Case(k, *of, spp=64, runs=8, integrator=upto(depth), reference_spp=4096 if k in LONGER else 1024)
        for k, (*of, depth) in GRIDS.items()
    ),
    *(Case(k, *of, spp=64, runs=16, integrator=upto(depth), reference_spp=1024) for k, (*of, depth) in WIRES.items()),
    *(Case(k, *of, spp=64, runs=6, integrator=upto(depth), reference_spp=4096) for k, (*of, depth) in FINE.items()),
    *(
        Case(k, *of, spp=256, integrator=bdpt_edge(8), reference_spp=2048, reference_images="bdpt")
        for k, of in HIDDEN.items()
    ),
    *(
        Case(
            k,
            *of,
            spp=64,
            runs=24,
            integrator={"type": kind, "max_depth": 3},
            reference_spp=4096,
            reference_images="bdpt",
        )
        for k, (*of, kind) in COARSE.items()
    ),
]


def case(name: str) -> Case:
    return next(c for c in CASES if c.name == name)
