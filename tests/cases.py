"""Scenes and motions on which derivatives are compared with finite differences. `references/make.py` makes the
references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

REFERENCES = Path(__file__).parent / "references"
RES = 32


@dataclass(frozen=True)
class Case:
    """A derivative image with its reference.

    scene : makes the scene.
    motion : arguments of `Motion`.
    step : of the finite differences, in units of θ: a few hundredths of a pixel.
    tolerance : of the relative L1 error.
    spp, seeds : of the derivative.
    runs : of the finite differences.
    largest_z : above 4 only where the method is known to be biased, and documented to be.
    integrator : properties of `direct_edge`.
    """

    name: str
    scene: Callable[[], mi.Scene]
    motion: dict[str, Any]
    step: float
    tolerance: float = 0.015
    spp: int = 256
    seeds: int = 16
    runs: int = 12
    largest_z: float = 4
    integrator: dict[str, Any] = field(default_factory=dict)

    @property
    def reference(self) -> Path:
        return REFERENCES / f"{self.name}.exr"


# ---------------------- Building blocks ----------------------


def film(rfilter: str = "box", **options: Any) -> dict:
    return {
        "type": "hdrfilm",
        "width": RES,
        "height": RES,
        "rfilter": {"type": rfilter},
        "pixel_format": "rgb",
        **options,
    }


def camera(origin=(1.5, 2, -5), target=(0, 0, 0), kind="perspective", film=None, **options: Any) -> dict:
    T = mi.ScalarTransform4f
    to_world = T().look_at(list(origin), list(target), [0, 1, 0])
    if kind == "orthographic":
        to_world = to_world @ T().scale([2, 2, 1])
    else:
        options = {"fov": 45, **options}
    return {"type": kind, "to_world": to_world, "film": film or globals()["film"](), **options}


def diffuse(*value: float, two_sided: bool = False) -> dict:
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value) if len(value) == 3 else value[0]}}
    return {"type": "twosided", "bsdf": bsdf} if two_sided else bsdf


def light(*radiance: float) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}


def mesh(name: str, vertices, faces, normals: bool = False, **props: dict) -> mi.Mesh:
    """A mesh from lists; flat-shaded unless `normals`."""
    p = mi.Properties()
    for key, value in props.items():
        p[key] = mi.load_dict(value)
    m = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=normals, props=p)
    params = mi.traverse(m)
    params["vertex_positions"] = np.float32(vertices).ravel()
    params["faces"] = np.uint32(faces).ravel()
    params.update()
    m.set_id(name)
    return m


CUBE_FACES = [
    [0, 2, 1],
    [1, 2, 3],
    [4, 5, 6],
    [5, 7, 6],
    [0, 1, 4],
    [1, 5, 4],
    [2, 6, 3],
    [3, 6, 7],
    [0, 4, 2],
    [2, 4, 6],
    [1, 3, 5],
    [3, 7, 5],
]


def cube_vertices() -> np.ndarray:
    """Eight corners of a turned cube of half-side 1."""
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    turn = mi.ScalarTransform4f().rotate([0, 1, 0.3], 30)
    return np.array([list(turn @ mi.ScalarPoint3f(*c)) for c in corners])


def scene(**objects: Any) -> mi.Scene:
    return mi.load_dict({"type": "scene", **objects})


def constant(radiance: float = 1.0) -> dict:
    return {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}


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
    sensor: Callable[[], dict] = camera, bsdf: Callable[[], dict] = lambda: diffuse(0.5, two_sided=True)
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


def near_plane() -> mi.Scene:
    """A long floor that passes under the camera and ends behind it."""
    quad = [[-1.2, 0, -9], [1.5, 0, -9], [-1.2, 0, 6], [1.5, 0, 6]]
    return scene(
        sensor=camera((0, 1, -5), (0, 0.4, 0)),
        floor=mesh("floor", quad, [[0, 2, 1], [1, 2, 3]], bsdf=diffuse(0.5)),
        environment=constant(),
    )


DEPTH = {"key": "cube.vertex_positions", "direction": [0, 0, 1]}
SIDE = {"key": "cube.vertex_positions", "direction": [1, 0.3, 0]}
CAMERA_X = {"key": "sensor.to_world", "direction": [1, 0, 0]}
CAMERA_UP = {"key": "sensor.to_world", "direction": [0, 1, 0]}
UP = {"key": "torus.vertex_positions", "direction": [0, 1, 0]}
CAMERA_Z = {"key": "sensor.to_world", "direction": [0, 0, 1]}
CAMERA_TURN = {"key": "sensor.to_world", "rotate": [0, 1, 0.2]}
FIELD_OF_VIEW = {"key": "sensor.x_fov", "direction": [1]}
PRINCIPAL_POINT_X = {"key": "sensor.principal_point_offset_x", "direction": [1]}
PRINCIPAL_POINT_Y = {"key": "sensor.principal_point_offset_y", "direction": [1]}
FLOOR_TURN = {"key": "floor.to_world", "rotate": [1, 0, 0]}
FOCUS = {"key": "sensor.focus_distance", "direction": [1]}
CROP = {"width": 64, "height": 48, "crop_width": RES, "crop_height": RES, "crop_offset_x": 20, "crop_offset_y": 4}


def vertex(name: str, index: int) -> dict:
    """One vertex moves to the left."""
    return {"key": f"{name}.vertex_positions", "direction": [-1, 0, 0], "vertices": [index]}


def filtered(rfilter: str) -> Callable[[], mi.Scene]:
    return cube(lambda: camera(film=film(rfilter)))


def orthographic() -> dict:
    return camera(kind="orthographic")


def thin_lens() -> dict:
    return camera(kind="thinlens", aperture_radius=0.3, focus_distance=4.0)


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


CASES = [
    Case("two_triangles_green", two_triangles, vertex("green", 1), 4e-3, tolerance=0.01, spp=1024, runs=48),
    Case("two_triangles_red", two_triangles, vertex("red", 1), 4e-3, tolerance=0.01, spp=1024, runs=48),
    Case("cube_depth", cube(), DEPTH, 1e-2),
    Case("cube_turn", cube(), {"key": "cube.vertex_positions", "rotate": [0.2, 1, 0]}, 6e-3, tolerance=0.03, spp=1024),
    Case("cube_welded", cube(shape=welded_cube), DEPTH, 1e-2),
    Case("cube_split", cube(shape=split_cube), DEPTH, 1e-2),
    Case("coloured_cube_camera", coloured_cube, CAMERA_X, 6e-3),
    Case("camera_translation", cube(), CAMERA_Z, 1e-2),
    Case("camera_rotation", cube(), CAMERA_TURN, 1e-3),
    Case("field_of_view", cube(), FIELD_OF_VIEW, 0.1),
    Case("principal_point", cube(), PRINCIPAL_POINT_X, 1e-3),
    Case("textured_cube_side", cube(shape=textured_cube), SIDE, 6e-3, spp=1024),
    Case("textured_cube_camera_translation", cube(shape=textured_cube), CAMERA_X, 6e-3, spp=1024),
    Case("textured_cube_camera_rotation", cube(shape=textured_cube), CAMERA_TURN, 1e-3, spp=1024),
    Case("textured_cube_field_of_view", cube(shape=textured_cube), FIELD_OF_VIEW, 0.1, spp=1024),
    Case("textured_cube_principal_point", cube(shape=textured_cube), PRINCIPAL_POINT_Y, 1e-3, spp=1024),
    Case("orthographic_cube", cube(orthographic), SIDE, 5e-3),
    Case("orthographic_camera", cube(orthographic, textured_cube), CAMERA_X, 5e-3, spp=1024),
    Case("thin_lens_cube", cube(thin_lens), SIDE, 1e-2, tolerance=0.02, spp=1024),
    Case("thin_lens_camera", cube(thin_lens), CAMERA_Z, 2e-2, tolerance=0.02, spp=1024),
    Case("thin_lens_focus", cube(thin_lens), FOCUS, 4e-2, tolerance=0.04),
    Case("gaussian_filter", filtered("gaussian"), SIDE, 6e-3),
    Case("tent_filter", filtered("tent"), SIDE, 6e-3),
    Case("mitchell_filter", filtered("mitchell"), SIDE, 6e-3),
    Case("sample_border", cube(close_up_with_border), SIDE, 4e-3, tolerance=0.02, spp=1024, runs=36),
    Case("crop_window", crop(), SIDE, 4e-3),
    Case("crop_window_camera", crop("gaussian"), PRINCIPAL_POINT_X, 1e-3),
    Case("leaving_the_frame", cube(close_up), SIDE, 4e-3, spp=1024, runs=36),
    Case("near_plane", near_plane, {"key": "floor.vertex_positions", "direction": [0.3, 1, 0]}, 2e-3),
    Case("near_plane_camera", near_plane, {"key": "sensor.to_world", "direction": [0.3, 1, 0.2]}, 2e-3),
    Case("near_plane_cut", cube(cut_open), SIDE, 4e-3),
    Case("near_plane_cut_camera", cube(cut_open), {"key": "sensor.to_world", "rotate": [0.3, 1, 0.3]}, 8e-4),
    Case("smooth_torus", smooth_torus(), UP, 6e-3, tolerance=0.04, spp=1024, largest_z=7),
    Case("smooth_torus_camera", smooth_torus(), CAMERA_UP, 6e-3, tolerance=0.04, spp=1024, largest_z=7),
    Case("room_cube", room(), SIDE, 6e-3, tolerance=0.06, spp=1024),
    Case("room_camera", room(), CAMERA_X, 6e-3, tolerance=0.06, spp=1024),
    Case("room_light", room(), {"key": "light.to_world", "direction": [1, -0.5, 0]}, 1e-2, tolerance=0.06, spp=1024),
    Case("room_floor_turns", room(), FLOOR_TURN, 6e-3, tolerance=0.06, spp=1024, runs=48),
]


def case(name: str) -> Case:
    return next(c for c in CASES if c.name == name)
