"""Perfect mirrors, glass, textures that jump, and maps whose normals turn away: what `cases.py` has of jumps that are
found by bisection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, horizontal, light, mesh, quad, scene
from random_scenes import ball, grid, tetrahedron
from scipy.interpolate import PchipInterpolator


def cube(centre=(0.1, 0.7, 0.1), size: float = 0.4, **props: Any) -> mi.Mesh:
    rotated = cube_vertices() @ np.array(mi.ScalarTransform4f().rotate([0.3, 1, 0.2], 35).matrix)[:3, :3].T
    return mesh("cube", size * rotated + centre, CUBE_FACES, **{"bsdf": diffuse(0.8, 0.5, 0.3), **props})


def lamp() -> mi.Mesh:
    return horizontal((0.6, 3, -0.8), 0.6, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(8, 8, 7))


def over_mirror() -> mi.Scene:
    """A cube over a mirror, a little larger than what the camera sees of it, under a sky."""
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "mirror", bsdf={"type": "conductor"})
    at = camera((0.6, 1.9, -3.4), (0.1, 0.2, 0))
    return scene(sensor=at, cube=cube(), mirror=floor, sky=constant(0.4), lamp=lamp())


def two_mirrors() -> mi.Scene:
    """A cube between two mirrors, which show each other."""
    mirror = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.9, 0.95, 0.9]}}
    back = quad((-2.5, -0.5, 1.2), (0, 2.5, 0), (5, 0, 0.3), "back", bsdf=mirror)
    front = quad((-2.5, -0.5, -1.2), (5, 0, 0), (0, 2.5, 0), "front", bsdf=mirror)
    at = camera((1.9, 1.0, -0.9), (0.2, 0.5, 0.6))
    lit = cube(bsdf=diffuse(0.0), emitter=light(2, 1, 0.5))
    return scene(sensor=at, cube=lit, back=back, front=front, sky=constant(0.4))


def pane() -> mi.Scene:
    """A plate of glass before a cube, which is seen in it, and through it."""
    glass = {"type": "dielectric", "int_ior": 1.5}
    plate = mesh("pane", 0.5 * cube_vertices() * [2.2, 2, 0.3] + [0.2, 0.6, -0.9], CUBE_FACES, bsdf=glass)
    floor = horizontal((0, -0.2, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    at = camera((1.2, 1.3, -3.4), (0.1, 0.5, 0))
    return scene(sensor=at, cube=cube(), pane=plate, floor=floor, sky=constant(0.5))


def mirror_throws() -> mi.Scene:
    """A floor that gets light of a lamp by way of a mirror, and a black cube between both: only the floor is seen."""
    wall = quad((-1.2, -0.1, 1), (0, 2, 0), (2.4, 0, 0), "mirror", bsdf={"type": "conductor"})
    shine = quad((-1, 0.2, -2.2), (2, 0, 0), (0, 1.4, 0), "lamp", bsdf=diffuse(0.0), emitter=light(6, 5, 4))
    floor = horizontal((0, -0.2, 0), 2, "floor", bsdf=diffuse(0.6, two_sided=True))
    at = camera((0.15, 2.4, 0.2), (0, 0, 0.1), fov=30)
    return scene(sensor=at, floor=floor, cube=cube((0.2, 0.9, -0.9), 0.35, bsdf=diffuse(0.0)), mirror=wall, lamp=shine)


def glass_throws() -> mi.Scene:
    """A floor below a ball of glass, behind which is a black cube: only the floor is seen."""
    ball = {"type": "sphere", "center": [0, 0.4, 0.2], "radius": 0.45, "bsdf": {"type": "dielectric"}}
    floor = horizontal((0, -0.2, 0), 2, "floor", bsdf=diffuse(0.6, two_sided=True))
    at = camera((0.15, 1.1, -1.9), (0, -0.3, -0.55), fov=25)
    dark = cube((0.2, 0.6, 1.0), 0.4, bsdf=diffuse(0.0))
    return scene(sensor=at, floor=floor, cube=dark, ball=ball, sky=constant(0.5))


def lamp_in_bulb() -> mi.Scene:
    """A lamp in a ball of glass, over a floor: only the floor is seen."""
    lamp = {"type": "sphere", "center": [0.08, -0.05, 0.06], "radius": 0.1, "emitter": light(9, 9, 9)}
    bulb = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric"}}
    floor = horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.5))
    return scene(sensor=camera((0, 1, -3), (0, -1.2, -0.5), fov=22), floor=floor, lamp=lamp, bulb=bulb)


def glass_tetrahedron() -> mi.Scene:
    """A tetrahedron of glass under a sky, whose faces meet at less than a right angle."""
    vertices, _, _, faces = tetrahedron()
    turned = 0.7 * vertices @ np.array(mi.ScalarTransform4f().rotate([0.3, 1, 0.2], 20).matrix)[:3, :3].T
    shape = mesh("tetrahedron", turned + np.array([0, 0.4, 0]), faces, bsdf={"type": "dielectric"})
    return scene(sensor=camera((0.4, 1.4, -3.2), (0, 0.4, 0), fov=35), tetrahedron=shape, sky=constant(0.5))


def bar(centre=(0.1, 0.4, 0.8)) -> mi.Mesh:
    vertices = cube_vertices() * [0.12, 0.8, 0.12] + centre
    return mesh("bar", vertices, CUBE_FACES, bsdf=diffuse(0.0), emitter=light(3, 2.5, 2))


def window_in_floor() -> mi.Scene:
    """A pane that stands in a floor, and leans."""
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "floor", bsdf=diffuse(0.7, two_sided=True))
    wall = quad((-0.8, -0.6, 0.1), (0, 1.3, 0.25), (1.6, 0, 0.2), "pane", bsdf={"type": "thindielectric"})
    return scene(sensor=camera((0.6, 1.2, -3.4), (0, 0, 0)), floor=floor, pane=wall, sky=constant(0.6))


def wall_in_water() -> mi.Scene:
    """An upright wall in water that mirrors it: what is seen of it through the surface, and its image, coincide."""
    water = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "water", bsdf={"type": "thindielectric"})
    wall = quad((-0.8, -0.6, 0.1), (0, 1.2, 0), (1.6, 0, 0.2), "wall", bsdf=diffuse(0.7, two_sided=True))
    return scene(sensor=camera((0.6, 1.2, -3.4), (0, 0, 0)), water=water, wall=wall, sky=constant(0.6))


def window_in_mirror() -> mi.Scene:
    """Such a pane before a mirror, which shows the line in which it cuts the floor at a grazing angle."""
    floor = quad((-2.5, 0, -2.5), (0, 0, 5), (5, 0, 0), "floor", bsdf=diffuse(0.0), emitter=light(0.3, 0.2, 0.1))
    wall = quad((-0.8, -0.6, 0.1), (0, 1.3, 0.25), (1.6, 0, 0.2), "pane", bsdf={"type": "thindielectric"})
    mirror = quad((-3, -1, 1.6), (0, 3, 0.1), (6, 0, 0), "mirror", bsdf={"type": "conductor"})
    at = camera((0.6, 1.6, -3.4), (0, 0.5, 1))
    return scene(sensor=at, floor=floor, mirror=mirror, pane=wall, sky=constant(0.6))


def glass_in_floor() -> mi.Scene:
    """A block of glass that stands in a floor that shines."""
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "floor", bsdf=diffuse(0.0), emitter=light(0.3, 0.2, 0.1))
    block = cube((0, 0.15, 0.1), 0.6, bsdf={"type": "dielectric"})
    return scene(sensor=camera((0.6, 1.2, -3.4), (0, 0, 0)), floor=floor, block=block, sky=constant(0.6))


def glass_ball_in_floor() -> mi.Scene:
    """And a ball: the line in which it cuts the floor is seen from inside, too."""
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "floor", bsdf=diffuse(0.0), emitter=light(0.3, 0.2, 0.1))
    block = {"type": "sphere", "center": [0, 0.15, 0.1], "radius": 0.5, "bsdf": {"type": "dielectric"}}
    return scene(sensor=camera((0.6, 1.2, -3.4), (0, 0, 0)), floor=floor, ball=block, sky=constant(0.6))


def before_bar(shape: dict) -> mi.Scene:
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar(), sky=constant(0.2))


def glass_ball(bsdf: dict | None = None) -> mi.Scene:
    """A ball of glass before a bar that shines."""
    bsdf = bsdf or {"type": "dielectric"}
    return before_bar({"type": "sphere", "center": [0, 0.4, -0.4], "radius": 0.6, "bsdf": bsdf})


#: Half of a cross-section of a wine glass, from the middle of its foot to the bottom of the bowl: radius and height.
STEM = ((0, 0), (0.34, 0), (0.36, 0.015), (0.34, 0.03), (0.1, 0.06), (0.035, 0.14), (0.03, 0.3), (0.035, 0.42))
BOWL = ((0.12, 0.5), (0.27, 0.62), (0.34, 0.78), (0.33, 0.95), (0.29, 1.1), (0.277, 1.11), (0.265, 1.1))
INSIDE = ((0.305, 0.95), (0.315, 0.78), (0.245, 0.635), (0.1, 0.535), (0, 0.52))


def wine_glass() -> mi.Scene:
    """One of 8,000 smooth triangles, before a bar that shines, on a floor that does."""
    outline = np.array([*STEM, *BOWL, *INSIDE])
    along = np.cumsum([0, *np.linalg.norm(np.diff(outline, axis=0), axis=1)])
    curve = PchipInterpolator(along / along[-1], outline)

    def point(φ, v):
        (r, y), (dr, dy) = curve(v).T, curve(v, 1).T
        turned = lambda radius, height: np.stack([radius * np.cos(φ), height, radius * np.sin(φ)], 1)
        return turned(r, y), turned(dy, -dr)

    vertices, _, _, faces = grid(point, 64, 64)
    glass = mesh("ball", vertices + np.array([0, -0.15, -0.3]), faces, normals=True, bsdf={"type": "dielectric"})
    floor = horizontal((0, -0.16, 0), 2, "floor", bsdf=diffuse(0.0), emitter=light(0.5, 0.4, 0.3))
    at = camera((0.4, 0.9, -3.2), (0, 0.4, 0), fov=28)
    return scene(sensor=at, ball=glass, bar=bar((0.15, 0.65, 0.9)), floor=floor, sky=constant(0.3))


def ball_of_index() -> mi.Scene:
    """The same, of glass whose index changes."""
    return glass_ball({"type": "glass", "eta": 1.4})


def mirrored_ball() -> mi.Scene:
    """A mirrored ball beside a bar that shines."""
    shape = {"type": "sphere", "center": [0, 0.4, 0.3], "radius": 0.6, "bsdf": {"type": "conductor"}}
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar((0.5, 0.4, -0.9)), cube=cube((-0.9, 0.5, -0.6), 0.3), sky=constant(0.5))


def smooth_mirror(textured: bool = False, flipped: bool = False) -> mi.Scene:
    """A smooth-shaded mirror of few triangles.

    textured, flipped : with texture coordinates, and with its normals turned round? The image is the same.
    """
    vertices, _, uv, faces = ball(10)
    bsdf = {"type": "twosided", "nested": {"type": "conductor"}} if flipped else {"type": "conductor"}
    props = {"bsdf": bsdf, **({"flip_normals": True} if flipped else {})}
    uv = uv * [3, -2] if textured else None
    shape = mesh("ball", 0.6 * vertices + [0, 0.4, 0.3], faces, normals=True, uv=uv, **props)
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar((0.5, 0.4, -0.9)), sky=constant(0.5))


def mirrored_cut(thing: dict | None = None) -> mi.Scene:
    """A cube, or another thing, that stands in a floor, before a mirror that shows its back."""
    wall = quad((-2, -1, 1.1), (0, 3, 0), (4, 0, 0.4), "mirror", bsdf={"type": "conductor"})
    floor = horizontal((0, 0.25, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
    at = camera((0.6, 1.9, -3.4), (0.1, 0.6, 0.6))
    things = {"cube": cube((0.1, 0.4, 0))} if thing is None else {"ball": thing}
    return scene(sensor=at, **things, floor=floor, mirror=wall, sky=constant(0.5))


def mirrored_cut_sphere() -> mi.Scene:
    """A sphere that stands in a floor, before such a mirror."""
    return mirrored_cut({"type": "sphere", "center": [0.1, 0.45, 0], "radius": 0.5, "bsdf": diffuse(0.8, 0.5, 0.3)})


# ---------------------- Hard shadows that mirrors and glass show ----------------------


def point_light() -> dict:
    return {"type": "point", "position": [1.5, 3, -1], "intensity": {"type": "rgb", "value": 20.0}}


def shadow_in_wall(thing: dict | None = None, **lights: Any) -> mi.Scene:
    """A cube, or another thing, over a floor, and a wall that mirrors the shadow. The camera sees the wall alone."""
    floor = horizontal((0, 0, 0), 3, "floor", bsdf=diffuse(0.6, two_sided=True))
    wall = quad((-1.6, -0.4, 2.2), (0, 3.2, 0), (3.2, 0, 0), "mirror", bsdf={"type": "conductor"})
    at = camera((0.2, 2.2, -0.5), (0, 0.9, 2.2), fov=60)
    things = {"cube": cube((0.1, 0.8, 0))} if thing is None else {"ball": thing}
    return scene(sensor=at, **things, floor=floor, mirror=wall, **(lights or {"point": point_light()}))


def shadows_of_ball() -> mi.Scene:
    """A sphere, in the light of a point and in that of the sun."""
    ball = {"type": "sphere", "center": [0.1, 0.8, 0], "radius": 0.4, "bsdf": diffuse(0.5)}
    sun = {"type": "directional", "direction": [-0.5, -1, 0.4], "irradiance": {"type": "rgb", "value": 2.0}}
    return shadow_in_wall(ball, point=point_light(), sun=sun)


def corners_behind_pane() -> mi.Scene:
    """Five boards with one edge, which throw shadows on each other, behind a pane. So close to their edge, rays that
    leave one of them start beyond the next."""
    angle = 0.3 + 2 * np.pi / 5 * np.arange(5)
    corners = np.concatenate([[[0, 0, -1], [0, 0, 1]], np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)])
    turned = corners @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].T
    faces = [[0, 1, 2 + k] for k in range(5)]
    star = mesh("ball", turned, faces, bsdf=diffuse(0.7, two_sided=True))
    pane = quad((-3, -3, 2), (6, 0, 0), (0, 6, 0), "pane", bsdf={"type": "thindielectric"})
    lamp = {"type": "point", "position": [3, 1.3, 1], "intensity": {"type": "rgb", "value": 30.0}}
    return scene(sensor=camera((0.37, 0.23, 4), (0.03, 0, 0)), ball=star, pane=pane, lamp=lamp)


# ---------------------- Textures that jump ----------------------


def checkers(colour0=0.15, colour1=(0.8, 0.6, 0.3), scale=(3, 2), turned: float = 20) -> dict:
    to_uv = mi.ScalarTransform3f().rotate(turned).scale(list(scale))
    colours = {"color0": {"type": "rgb", "value": [colour0] * 3}, "color1": {"type": "rgb", "value": list(colour1)}}
    return {"type": "checkerboard", "to_uv": to_uv, **colours}


def texels(channels: int, seed: int = 0, size=(5, 4), lowest: float = 0.1) -> dict:
    data = np.random.default_rng(seed).uniform(lowest, 0.9, (*size, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


def patterned(kind: str, name: str = "board", at=(0, 0.1, 0), turned=(0.2, 1, 0.1), **bsdf: Any) -> dict:
    place = mi.ScalarTransform4f().translate(list(at)).rotate(list(turned), 35).scale(0.9)
    return {"type": kind, "id": name, "to_world": place, "bsdf": bsdf}


def board(**bsdf: Any) -> mi.Scene:
    """A plate with a pattern before a floor with another one."""
    floor = {"type": "rectangle", "id": "floor", "bsdf": {"type": "diffuse", "reflectance": checkers(scale=(5, 4))}}
    floor["to_world"] = mi.ScalarTransform4f().translate([0, -0.9, 0]).rotate([1, 0, 0], -90).scale(2)
    plate = patterned("rectangle", at=(0.03, 0.1, 0), **bsdf)
    return scene(sensor=camera((0.6, 1.4, -3.4), (0, 0, 0)), board=plate, floor=floor, sky=constant(0.6), lamp=lamp())


def checkerboard() -> mi.Scene:
    return board(type="twosided", nested={"type": "diffuse", "reflectance": checkers()})


def close_up() -> mi.Scene:
    """A large floor, of which the camera sees few squares: few texture coordinates differ within a pixel."""
    floor = {"type": "rectangle", "id": "floor", "bsdf": {"type": "diffuse", "reflectance": checkers(scale=(5, 5))}}
    floor["to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    return scene(sensor=camera((3.6, 0.8, -4.0), (3.2, 0, -3.2)), floor=floor, sky=constant(0.6))


def nearest() -> mi.Scene:
    return board(type="twosided", nested={"type": "diffuse", "reflectance": texels(3)})


def leaf() -> mi.Scene:
    opacity = texels(1, seed=2, lowest=-0.6)
    opacity["bitmap"] = mi.Bitmap((np.array(opacity["bitmap"]) > 0.2).astype(np.float32))
    leaf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.7, 0.1]}}}
    return board(type="mask", opacity=opacity, nested=leaf)


def veil() -> mi.Scene:
    """A plate that lets through more light here than there, and a mirror behind it, which shows it."""
    opacity = {"type": "checkerboard", "color0": 0.3, "color1": 0.9, "to_uv": mi.ScalarTransform3f().scale([3, 2])}
    veil = {"type": "mask", "opacity": opacity, "nested": diffuse(0.2, 0.7, 0.1, two_sided=True)}
    wall = quad((-2, -1, 1.1), (0, 3, 0), (4, 0, 0.4), "mirror", bsdf={"type": "conductor"})
    plate = patterned("rectangle", at=(0.03, 0.1, 0), **veil)
    return scene(sensor=camera((0.6, 1.4, -3.4), (0, 0, 0)), board=plate, mirror=wall, sky=constant(0.6), lamp=lamp())


def bumps() -> mi.Scene:
    heights = texels(1, seed=4, size=(6, 6))
    heights["filter_type"] = "bilinear"
    return board(type="twosided", nested={"type": "bumpmap", "texture": heights, "scale": 0.3, "bsdf": diffuse(0.6)})


def checkered_ball() -> mi.Scene:
    """A smooth ball with a checkerboard, and what a mirror shows of it."""
    thing = {"type": "sphere", "id": "ball", "center": [0.1, 0.7, 0.1], "radius": 0.5}
    thing["bsdf"] = {"type": "diffuse", "reflectance": checkers(scale=(4, 3))}
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "mirror", bsdf={"type": "conductor"})
    at = camera((0.6, 1.9, -3.4), (0.1, 0.2, 0))
    return scene(sensor=at, ball=thing, mirror=floor, sky=constant(0.4), lamp=lamp())


def checkered(kind: str, mesh_: bool = True) -> mi.Scene:
    """A ball under a sky, with a checkerboard of which lines lie along edges of its mesh, and one on its seam.

    kind : mirror, lacquer, or milk glass.
    """
    pattern = {**checkers(scale=(4, 4), turned=0), "color1": {"type": "rgb", "value": [0.9, 0.8, 0.7]}}
    bsdf = {
        "mirror": {"type": "conductor", "specular_reflectance": pattern},
        "lacquer": {"type": "plastic", "diffuse_reflectance": pattern},
        "milk": {"type": "principled", "base_color": pattern, "spec_trans": 0.5, "roughness": 0.4},
    }[kind]
    if mesh_:
        vertices, _, uv, faces = ball(10)
        shape: Any = mesh("ball", 0.6 * vertices + [0, 0.4, 0.3], faces, normals=True, uv=uv, bsdf=bsdf)
    else:
        shape = {"type": "sphere", "id": "ball", "center": [0, 0.4, 0.3], "radius": 0.6, "bsdf": bsdf}
    return scene(sensor=camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35), ball=shape, sky=constant(0.5))


def checkered_facets() -> mi.Scene:
    """A flat-shaded ball with such lines, close over a floor that it lights."""
    vertices, _, uv, faces = ball(8)
    bsdf = {"type": "diffuse", "reflectance": checkers(colour0=0.05, colour1=(0.9, 0.8, 0.7), scale=(4, 4), turned=0)}
    shape = mesh("ball", 0.5 * vertices + [0, 0.4, 0.3], faces, uv=uv, bsdf=bsdf)
    floor = horizontal((0, -0.15, 0), 2, "floor", bsdf=diffuse(0.8))
    return scene(sensor=camera((0.4, 1.2, -3.2), (0, 0.2, 0), fov=35), ball=shape, floor=floor, sky=constant(0.5))


def pictured_globe() -> mi.Scene:
    """A globe whose picture does not go on around it: its seam is seen."""
    picture = np.linspace(0.1, 1, 8, dtype=np.float32)[None, :, None] * np.float32([[[1, 0.8, 0.5]]])
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.repeat(picture, 4, 0)), "raw": True, "wrap_mode": "clamp"}
    place = mi.ScalarTransform4f().translate([0, 0.4, 0.3]).rotate([0, 1, 0], 100).scale(0.6)
    globe = {"type": "sphere", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": picture}}
    return scene(sensor=camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35), ball=globe, sky=constant(0.5))


def rippled_ball() -> mi.Scene:
    """A mirrored ball with a gentle map of heights, beside a bar that shines."""
    heights = np.random.default_rng(5).uniform(0, 1, (8, 12, 1)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(heights), "raw": True, "accel": False}
    bsdf = {"type": "bumpmap", "texture": texture, "scale": 0.02, "nested": {"type": "conductor"}}
    shape = {"type": "sphere", "center": [0, 0.4, 0.3], "radius": 0.6, "bsdf": bsdf}
    at = camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35)
    return scene(sensor=at, ball=shape, bar=bar((0.5, 0.4, -0.9)), sky=constant(0.5))


# ---------------------- Maps whose normals turn away ----------------------


def mapped(kind: str, seed: int = 1, **texture: Any) -> dict:
    """Normals that lean by up to 30 degrees, or as steep heights. A GPU would interpolate them in steps."""
    rng = np.random.default_rng(seed)
    data = rng.uniform(0, 0.45, (6, 6, 1))
    if kind == "normalmap":
        data = np.concatenate([rng.uniform(-0.4, 0.4, (5, 7, 2)), np.ones((5, 7, 1))], 2)
        data = 0.5 + 0.5 * data / np.linalg.norm(data, axis=2, keepdims=True)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(data.astype(np.float32)), "raw": True, "accel": False, **texture}
    return {"type": kind, "normalmap": texture, "nested": diffuse(0.8, 0.5, 0.3)}


def in_the_light_of_a_point(shape: Any) -> mi.Scene:
    point = {"type": "point", "position": [1, 3, -3], "intensity": {"type": "rgb", "value": 10.0}}
    return scene(sensor=camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35), ball=shape, point=point)


def mapped_ball() -> mi.Scene:
    vertices, _, uv, faces = ball(20)
    bsdf = mapped("normalmap", wrap_mode="clamp")
    return in_the_light_of_a_point(mesh("ball", 0.7 * vertices + [0, 0.4, 0.3], faces, normals=True, uv=uv, bsdf=bsdf))


def aligned_ball() -> mi.Scene:
    """A smooth-shaded ball, whose texture jumps along edges of its mesh."""
    vertices, _, uv, faces = ball(20)
    bsdf = {"type": "diffuse", "reflectance": texels(3, size=(5, 8))}
    turned = 0.7 * vertices @ np.array(mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 37).matrix)[:3, :3].T
    shape = mesh("ball", turned + np.array([0, 0.4, 0.3]), faces, normals=True, uv=uv, bsdf=bsdf)
    return scene(sensor=camera((0.4, 0.8, -3.2), (0, 0.4, 0), fov=35), ball=shape, sky=constant(0.5), lamp=lamp())


def mirrored_lamp() -> mi.Scene:
    """A smooth-shaded ball that shines over a mirror. Close to its outline, its normals turn away, and it is dark."""
    vertices, _, _, faces = ball(60)
    shape = mesh(
        "ball", 0.4 * vertices + [0, 0.6, 0.2], faces, normals=True, bsdf=diffuse(0.0), emitter=light(2, 1.5, 1)
    )
    floor = quad((-1.5, 0, -1.5), (0, 0, 3), (3, 0, 0), "mirror", bsdf={"type": "conductor"})
    return scene(sensor=camera((0.6, 1.9, -3.4), (0.1, 0.2, 0)), ball=shape, mirror=floor, sky=constant(0.2))


def bumpy_ball() -> mi.Scene:
    bsdf = {**mapped("bumpmap"), "scale": 1.0}
    ball = {"type": "sphere", "id": "ball", "center": [0, 0.4, 0.3], "radius": 0.7, "bsdf": bsdf}
    return in_the_light_of_a_point(ball)


def rippled(kind: str, nested: dict, height: float = 0.0) -> mi.Scene:
    """A plate with a gentle map of normals or heights: a mirror below a cube, or the surface of water above it."""
    bsdf = {**mapped(kind), "nested": nested}
    data = np.array(mi.Bitmap(bsdf["normalmap"]["bitmap"]))
    data[..., : 2 if kind == "normalmap" else 1] = 0.5 + 0.15 * (data[..., : 2 if kind == "normalmap" else 1] - 0.5)
    bsdf["normalmap"]["bitmap"] = mi.Bitmap(data)
    place = mi.ScalarTransform4f().translate([0.1, height, 0]).rotate([1, 0, 0], -90).scale(1.5)
    plate = {"type": "rectangle", "id": "mirror", "to_world": place, "bsdf": bsdf}
    floor = horizontal((0.1, -0.3, 0), 3, "floor", bsdf=diffuse(0.0), emitter=light(0.3, 0.4, 0.5))
    at = camera((0.6, 2.4, -3.4), (0.1, 0.2, 0))
    lit = cube(bsdf=diffuse(0.0), emitter=light(2, 1, 0.5))
    return scene(sensor=at, cube=lit, mirror=plate, floor=floor, sky=constant(0.4))


def rippled_mirror() -> mi.Scene:
    return rippled("bumpmap", {"type": "conductor"})


def rippled_water() -> mi.Scene:
    return rippled("normalmap", {"type": "dielectric", "int_ior": 1.33}, height=1.25)


SLIDE = {"key": "cube.vertex_positions", "direction": [1, 0.3, 0.4]}
TURN = {"key": "cube.vertex_positions", "rotate": [0.3, 1, 0.2]}
MIRROR = {"key": "mirror.vertex_positions", "rotate": [0.6, 0.2, 1]}
TETRAHEDRON = {"key": "tetrahedron.vertex_positions", "direction": [1, 0.3, 0.4]}
CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0.4]}
BALL = {"key": "ball.to_world", "direction": [1, 0.3, 0.4]}
MESH = {"key": "ball.vertex_positions", "direction": [1, 0.3, 0.4]}
BOARD = {"key": "board.to_world", "rotate": [0.3, 1, 0.2]}
MAP = {"key": "ball.bsdf.normalmap.data", "direction": [1]}
LEAF = {"key": "board.to_world", "direction": [1, 0.3, 0.4]}

#: Of each case: scene, motion, step, max_depth.
MIRRORS: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "mirror_cube": (over_mirror, SLIDE, 2e-3, 3),
    "mirror_turns": (over_mirror, MIRROR, 2e-3, 3),
    "mirror_camera": (over_mirror, CAMERA, 2e-3, 2),
    "two_mirrors": (two_mirrors, TURN, 3e-3, 4),
    "mirrored_cut": (mirrored_cut, SLIDE, 3e-3, 3),
    "mirrored_cut_sphere": (mirrored_cut_sphere, {"key": "ball.to_world", "direction": [1, 0.4, 0.3]}, 3e-3, 3),
    "window_in_floor": (window_in_floor, CAMERA, 2e-3, 2),
    "wall_in_water": (wall_in_water, CAMERA, 2e-3, 3),
    "window_in_mirror": (window_in_mirror, CAMERA, 2e-3, 4),
    "glass_in_floor": (glass_in_floor, CAMERA, 2e-3, 4),
    "glass_ball_in_floor": (glass_ball_in_floor, CAMERA, 2e-3, 4),
    "pane": (pane, SLIDE, 2e-3, 5),
    "mirror_throws": (mirror_throws, SLIDE, 4e-3, 3),
    "mirror_throws_camera": (mirror_throws, CAMERA, 4e-3, 3),
    "glass_throws": (glass_throws, SLIDE, 4e-3, 4),
    "glass_tetrahedron": (glass_tetrahedron, TETRAHEDRON, 2e-3, 2),
    "glass_ball": (glass_ball, BALL, 1e-3, 6),
    "glass_ball_camera": (glass_ball, CAMERA, 1e-3, 6),
    "wine_glass": (wine_glass, MESH, 1e-3, 8),
    "mirrored_ball": (mirrored_ball, BALL, 2e-3, 3),
    "smooth_mirror": (smooth_mirror, MESH, 2e-3, 3),
    "shadow_in_mirror": (shadow_in_wall, SLIDE, 4e-3, 3),
    "shadow_in_mirror_turns": (shadow_in_wall, MIRROR, 2e-3, 3),
    "shadow_in_mirror_light": (shadow_in_wall, {"key": "point.position", "direction": [1, 0.3, 0.2]}, 4e-3, 3),
    "shadows_of_ball": (shadows_of_ball, CAMERA, 4e-3, 3),
    "corners_behind_pane": (corners_behind_pane, {**MESH, "direction": [1, 0.3, 0]}, 4e-3, 3),
    "checkerboard": (checkerboard, BOARD, 2e-3, 2),
    "checkerboard_camera": (checkerboard, CAMERA, 2e-3, 3),
    "checkerboard_close": (close_up, CAMERA, 1e-3, 2),
    "nearest_texels": (nearest, BOARD, 2e-3, 2),
    "leaf": (leaf, LEAF, 2e-3, 3),
    "veil_and_mirror": (veil, LEAF, 2e-3, 4),
    "bumps": (bumps, BOARD, 2e-3, 2),
    "checkered_ball": (checkered_ball, BALL, 2e-3, 3),
    "checkered_mirror": (lambda: checkered("mirror"), MESH, 2e-3, 2),
    "checkered_milk": (lambda: checkered("milk"), MESH, 2e-3, 2),
    "checkered_facets": (checkered_facets, MESH, 2e-3, 3),
    "pictured_globe": (pictured_globe, BALL, 2e-3, 2),
    "rippled_ball": (rippled_ball, BALL, 1e-3, 2),
    "mapped_ball": (mapped_ball, MESH, 2e-3, 2),
    "mapped_ball_camera": (mapped_ball, CAMERA, 2e-3, 2),
    "mapped_ball_map": (mapped_ball, MAP, 2e-3, 2),
    "bumpy_ball": (bumpy_ball, BALL, 2e-3, 2),
    "aligned_ball": (aligned_ball, MESH, 2e-3, 2),
    "mirrored_lamp": (mirrored_lamp, CAMERA, 2e-3, 2),
    "rippled_mirror": (rippled_mirror, SLIDE, 2e-3, 3),
    "rippled_mirror_turns": (rippled_mirror, {"key": "mirror.to_world", "rotate": [0.6, 0.2, 1]}, 2e-3, 3),
    "rippled_water": (rippled_water, SLIDE, 2e-3, 3),
}
