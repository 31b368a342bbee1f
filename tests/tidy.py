"""Scenes as people build them: edges on edges, on lines of textures and in one plane with the light. Each of them was
found twice."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from building import camera, constant, diffuse, light, mesh, quad, scene
from random_rooms import box, joined
from random_scenes import ball


def block(name: str, low: tuple, high: tuple, *colour: float) -> mi.Mesh:
    points, _, _, faces = box(low, high)
    return mesh(name, points, faces, bsdf=diffuse(*colour))


def floor(bsdf: dict | None = None) -> mi.Mesh:
    corners, bsdf = [[-2, 0, -2], [2, 0, -2], [-2, 0, 2], [2, 0, 2]], bsdf or diffuse(0.5)
    uv = [[0, 0], [1, 0], [0, 1], [1, 1]]
    return mesh("floor", corners, [[0, 2, 1], [1, 2, 3]], uv=uv, bsdf={"type": "twosided", "inner": bsdf})


def sun(*direction: float) -> dict:
    return {"type": "directional", "direction": list(direction), "irradiance": {"type": "rgb", "value": 3.0}}


def seen(**objects: dict | mi.Object) -> mi.Scene:
    return scene(sensor=camera((0.9, 2.2, -3.4), (0.037, 0.213, 0.01), fov=40), **objects)


def box_on_lines() -> mi.Scene:
    """A box on a checkered floor, whose edges lie on the lines."""
    place = mi.ScalarTransform3f().scale([4, 4])
    board = {"type": "checkerboard", "color0": 0.1, "color1": 0.8, "to_uv": place}
    on = floor({"type": "diffuse", "reflectance": board})
    return seen(floor=on, box=block("box", (-0.5, 0, -0.5), (0.5, 1, 0.5), 0.6), sky=constant(0.3))


def dome() -> mi.Scene:
    """A smooth-shaded ball stands in a floor exactly to a ring of its edges. Some of these are silhouettes, of others
    both faces look at the camera."""
    points, _, _, faces = ball(8)
    points = np.round(0.5 * points[:, [1, 2, 0]], 6)  # the ring at the height 0
    thing = mesh("ball", points, faces, normals=True, bsdf=diffuse(0.2, 0.5, 0.8))
    bulb = {"type": "point", "position": [1.2, 2.5, -1.4], "intensity": 8.0}
    high = camera((0.3, 3.2, -1.3), (0.03, 0.13, 0.01), fov=24)
    return scene(sensor=high, floor=floor(), ball=thing, bulb=bulb, sky=constant(0.4))


def open_cup(at: tuple, turned: float = 0.0) -> mi.Mesh:
    """Its walls lean over what it stands on."""
    angles, sides = np.linspace(0, 2 * np.pi, 16, endpoint=False) + turned, np.arange(16)
    rings = [(r * np.cos(angles), np.full(16, y), r * np.sin(angles)) for r, y in ((0.15, 0.0), (0.35, 0.4))]
    after = (sides + 1) % 16
    faces = np.concatenate([np.stack(f, 1) for f in ((sides, sides + 16, after), (after, sides + 16, after + 16))])
    points = np.add(np.concatenate([np.stack(ring, 1) for ring in rings]), at)
    return mesh("cup", points, faces, bsdf=diffuse(0.7, 0.3, 0.3, two_sided=True))


def cup() -> mi.Scene:
    """An open cup on a floor, under a sky and a lamp that its walls hide in part from the floor at their foot."""
    bulb = {"type": "sphere", "center": [1, 2, -1], "radius": 0.3, "emitter": light(9, 9, 8)}
    view = camera((0.5, 1.4, -2.6), (0.2, 0.2, 0), fov=24)
    return scene(sensor=view, floor=floor(), cup=open_cup((0.2, 0, -0.2)), bulb=bulb, sky=constant(0.3))


def stair() -> mi.Scene:
    """Two boxes side by side, flush at the front, one of them higher; a sun shines along their sides."""
    one = block("one", (-0.5, 0, -0.5), (0, 0.5, 0.5), 0.7, 0.2, 0.2)
    two = block("two", (0, 0, -0.5), (0.5, 1, 0.5), 0.2, 0.2, 0.7)
    return seen(floor=floor(), one=one, two=two, sun=sun(0, -1, 1), sky=constant(0.1))


def shelf() -> mi.Scene:
    """A sheet that goes on from the upper edge of a box."""
    sheet = quad((0, 0.5, -0.5), (0, 0, 1), (1, 0, 0), "sheet", bsdf=diffuse(0.7, two_sided=True))
    one = block("one", (-0.5, 0, -0.5), (0, 0.5, 0.5), 0.7, 0.2, 0.2)
    return seen(floor=floor(), one=one, sheet=sheet, sun=sun(0, -1, 1), sky=constant(0.1))


def can_on_box() -> mi.Scene:
    """An open cylinder on a box that is as wide, in a sun that shines along the sides of both."""
    can = {"type": "cylinder", "p0": [0, 0.5, 0], "p1": [0, 1, 0], "radius": 0.4, "bsdf": diffuse(0.6, two_sided=True)}
    return seen(floor=floor(), box=block("box", (-0.4, 0, -0.4), (0.4, 0.5, 0.4), 0.5), can=can, sun=sun(0, -1, 1))


def carpet() -> mi.Scene:
    """A box on a carpet as thin as paper, whose border throws its shadow closely beside it."""
    place = mi.ScalarTransform4f().translate([0, 5e-4, 0]).rotate([1, 0, 0], -90).scale(0.8)
    on = {"type": "rectangle", "to_world": place, "bsdf": diffuse(0.8, two_sided=True)}
    return seen(floor=floor(), carpet=on, box=block("box", (-0.5, 5e-4, -0.5), (0.5, 0.6, 0.5), 0.3), sun=sun(0, -1, 1))


def tiled_floor(n: int) -> mi.Mesh:
    """A floor of n × n squares."""
    at = np.linspace(-2, 2, n + 1)
    corners = [[x, 0, z] for z in at for x in at]
    first = [j * (n + 1) + i for j in range(n) for i in range(n)]
    faces = [f for a in first for f in ([a, a + n + 1, a + 1], [a + 1, a + n + 1, a + n + 2])]
    return mesh("floor", corners, faces, bsdf=diffuse(0.5, two_sided=True))


def lamp() -> dict:
    return {"type": "point", "position": [1.2, 2.5, -1.4], "intensity": {"type": "rgb", "value": 8.0}}


def box_in_lines() -> mi.Scene:
    """A box that stands in a floor, exactly along the edges between its squares."""
    return seen(floor=tiled_floor(8), box=block("box", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 0.6), sun=sun(0, -1, 0))


def box_on_corners() -> mi.Scene:
    """A box that stands on a floor, with its corners on those of squares."""
    return seen(floor=tiled_floor(4), box=block("box", (-1, 0, -1), (0, 1, 0), 0.6), lamp=lamp())


def steps() -> mi.Scene:
    """Three boxes side by side, flush at the front, each higher than the last, in one mesh."""
    boxes = [box((x, 0, -0.5), (x + 0.4, y, 0.5)) for x, y in ((-0.6, 0.3), (-0.2, 0.6), (0.2, 0.9))]
    points, _, _, faces = joined(*boxes)
    return seen(floor=floor(), steps=mesh("steps", points, faces, bsdf=diffuse(0.5)), lamp=lamp())


def books() -> mi.Scene:
    """Books on a board and a board on the last of them, flush at their ends."""
    sizes = {
        "below": ((-1, 0, 0.5), (1, 0.1, 1)),
        "first": ((-1, 0.1, 0.5), (-0.9, 0.6, 1)),
        "second": ((-0.9, 0.1, 0.55), (-0.8, 0.5, 1)),
        "third": ((-0.8, 0.1, 0.5), (-0.6, 0.55, 1)),
        "last": ((0.9, 0.1, 0.5), (1, 0.6, 1)),
        "above": ((-1, 0.6, 0.5), (1, 0.7, 1)),
    }
    colours = dict(zip(sizes, (0.6, 0.6, 0.3, 0.7, 0.6, 0.6), strict=True))
    return seen(floor=floor(), sun=sun(0, -1, 0), **{k: block(k, *size, colours[k]) for k, size in sizes.items()})


def elevation(origin: tuple, target: tuple, up: tuple) -> dict:
    """An orthographic camera, which sees faces edge-on."""
    T = mi.ScalarTransform4f
    to_world = T().look_at(list(origin), list(target), list(up)) @ T().scale([1.31, 1.31, 1])
    return {**camera(kind="orthographic"), "to_world": to_world}


def tin(x: float, z: float, lid: bool) -> dict:
    """A cylinder that stands on the floor."""
    centre = [x, 0.6, z]
    wall = {"type": "cylinder", "p0": [x, 0, z], "p1": centre, "radius": 0.3, "bsdf": diffuse(0.6, two_sided=True)}
    place = mi.ScalarTransform4f().translate(centre).rotate([1, 0, 0], -90).scale(0.3)
    disk = {"type": "disk", "to_world": place, "bsdf": diffuse(0.3, two_sided=True)}
    return {"tin": wall, "lid": disk} if lid else {"tin": wall}


def bent_sheet(reverse: bool) -> mi.Mesh:
    """A roof with a wall below one of its sides."""
    corners = [[x, y, z] for x, y in ((-1.2, 0.8), (-0.8, 0.8), (-0.8, 0.1)) for z in (-0.5, 0.5)]
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    return mesh("sheet", corners, faces[:, ::-1] if reverse else faces, bsdf=diffuse(0.7, two_sided=True))


def front_view() -> mi.Scene:
    """Two boxes, one behind the other, and a can, seen along the floor and along their sides."""
    at = elevation((0.037, 0.613, -4), (0.037, 0.613, 0), (0, 1, 0))
    one = block("one", (-0.6, 0, -0.5), (-0.1, 0.8, 0.5), 0.7, 0.2, 0.2)
    two = block("two", (-0.1, 0, 0), (0.4, 0.8, 0.8), 0.2, 0.2, 0.7)
    light = {"sun": sun(0.3, -1, 0.5), "sky": constant(0.1)}
    return scene(sensor=at, floor=floor(), one=one, two=two, **tin(0.8, 0, True), **light)


def plan() -> mi.Scene:
    """Two boxes of different height, a wall without thickness, a bent sheet and an open can, seen from above."""
    at = elevation((0.037, 4, 0.013), (0.037, 0, 0.013), (0, 0, 1))
    one = block("one", (-0.5, 0, -0.43), (-0.1, 0.5, 0.41), 0.7, 0.2, 0.2)
    two = block("two", (-0.1, 0, -0.43), (0.3, 0.8, 0.41), 0.2, 0.2, 0.7)
    wall = quad((-0.5, 0, 0.93), (0.9, 0, 0), (0, 0.6, 0), "wall", bsdf=diffuse(0.6, two_sided=True))
    things = {"one": one, "two": two, "wall": wall, "sheet": bent_sheet(False), **tin(0.8, 0.1, False)}
    return scene(sensor=at, floor=floor(), **things, sun=sun(0.3, -1, 0.5), sky=constant(0.1))


def glass_plan() -> mi.Scene:
    """A box of thin glass in the air, seen from above: the outlines of its top and of its bottom are at one place."""
    at = elevation((0.037, 4, 0.013), (0.037, 0, 0.013), (0, 0, 1))
    to_world = mi.ScalarTransform4f().translate([0, 0.5, 0]).scale([0.5, 0.3, 0.4])
    glass = {"type": "cube", "to_world": to_world, "bsdf": {"type": "thindielectric"}}
    return scene(sensor=at, floor=floor(), box=glass, sun=sun(0.3, -1, 0.5), sky=constant(0.1))


def inside_out() -> mi.Scene:
    """A box and a bent sheet whose normals point inwards, in a sun that shines along their sides."""
    points, _, _, faces = box((-0.3, 0.2, -0.5), (0.5, 0.8, 0.5))
    shape = mesh("box", points, np.array(faces)[:, ::-1], bsdf=diffuse(0.6, two_sided=True))
    return seen(floor=floor(), box=shape, sheet=bent_sheet(True), sun=sun(0, -1, 0))


CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0.2]}

BOX = {"key": "box.vertex_positions", "direction": [1, 0, 0.4]}

#: Scene, motion, step.
TIDY: dict[str, tuple[Callable[[], mi.Scene], dict, float]] = {
    "box_on_lines": (box_on_lines, CAMERA, 2e-3),
    "dome": (dome, CAMERA, 2e-3),
    "cup": (cup, {"key": "cup.vertex_positions", "direction": [1, 0, 0]}, 2e-3),
    "stair": (stair, CAMERA, 2e-3),
    "shelf": (shelf, CAMERA, 2e-3),
    "can_on_box": (can_on_box, CAMERA, 2e-3),
    "carpet": (carpet, CAMERA, 2e-3),
    "box_in_lines": (box_in_lines, BOX, 2e-3),
    "box_on_corners": (box_on_corners, BOX, 2e-3),
    "steps": (steps, CAMERA, 2e-3),
    "books": (books, CAMERA, 2e-3),
    "front_view": (front_view, {**CAMERA, "direction": [1, 0.3, 0]}, 2e-3),
    "plan": (plan, {**CAMERA, "direction": [1, 0, 0.4]}, 2e-3),
    "glass_plan": (glass_plan, {**CAMERA, "direction": [1, 0, 0.4]}, 2e-3),
    "inside_out": (inside_out, CAMERA, 2e-3),
}
