"""Spots and projectors whose light ends with a jump, or jumps inside of the beam, and a lamp whose picture jumps: what
`cases.py` has of these."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from building import CUBE_FACES, camera, cube_vertices, diffuse, horizontal, mesh, quad, scene


def at() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at([-1, 4, -1], [0, 0, 0], [0, 0, 1])


def hard_spot() -> dict:
    # Wider than the cutoff: where both are equal, the derivative with respect to one of them has two values.
    return {"type": "spot", "to_world": at(), "intensity": 60.0, "cutoff_angle": 14.0, "beam_width": 18.0}


def white() -> dict:
    """A projector without a picture."""
    colour = {"type": "rgb", "value": [1, 0.8, 0.5]}
    return {"type": "projector", "to_world": at(), "irradiance": colour, "fov": 25.0, "scale": 10.0}


def texels() -> dict:
    image = mi.Bitmap(np.random.default_rng(0).uniform(0, 1, (5, 4, 3)).astype(np.float32))
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "nearest"}


def picture() -> dict:
    """A projector of a picture that jumps, and whose border is not black."""
    return {"type": "projector", "to_world": at(), "irradiance": texels(), "fov": 30.0, "scale": 10.0}


def soft_spot_with_picture() -> dict:
    return {"type": "spot", "to_world": at(), "intensity": 60.0, "cutoff_angle": 20.0, "beam_width": 10.0} | {
        "texture": texels()
    }


def lamp_with_picture() -> dict:
    """A sheet that shines, which the camera sees."""
    to_world = mi.ScalarTransform4f().translate([-0.4, 0.5, 0.8]).rotate([0, 1, 0], 190).rotate([1, 0, 0], 20)
    emitter = {"type": "area", "radiance": texels()}
    return {"type": "rectangle", "to_world": to_world.scale(0.6), "bsdf": diffuse(0.0), "emitter": emitter}


def on_cube(lamp: Callable[[], dict]) -> Callable[[], mi.Scene]:
    """A cube on whose faces the beam ends, and the floor."""
    return lambda: scene(
        sensor=camera(),
        floor=horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4)),
        cube=mesh("cube", 0.4 * cube_vertices() + [0.23, 0.1, 0], CUBE_FACES, bsdf=diffuse(0.4, 0.5, 0.7)),
        lamp=lamp(),
    )


def hidden(lamp: Callable[[], dict]) -> Callable[[], mi.Scene]:
    """The camera sees a wall, which is lit by a floor below the frame and a low step in it; on these falls a beam. All
    of the derivative comes from light that is scattered twice."""

    def build() -> mi.Scene:
        return scene(
            sensor=camera((0, 1.2, -4), (0, 1.2, 2), fov=24),
            wall=quad((-2, 0, 1.2), (0, 3, 0), (4, 0, 0), "wall", bsdf=diffuse(0.7, 0.6, 0.5, two_sided=True)),
            floor=horizontal((0, 0, 0), 1.2, "floor", bsdf=diffuse(0.6, 0.7, 0.8)),
            step=mesh("step", 0.15 * cube_vertices() + [0.3, 0, 0.2], CUBE_FACES, bsdf=diffuse(0.7, 0.5, 0.4)),
            lamp=lamp(),
        )

    return build


def from_above(lamp: dict) -> dict:
    """A lamp above the floor of `hidden`."""
    return {**lamp, "to_world": mi.ScalarTransform4f().look_at([0.1, 2.5, -0.1], [0.1, 0, 0.1], [0, 0, 1])}


def in_mirror() -> mi.Scene:
    """A floor on which the beam ends, and a mirror that shows it."""
    mirror = quad((-2, -0.8, 1.3), (0, 2.5, 0), (4, 0, 0.4), "mirror", bsdf={"type": "conductor"})
    floor = horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.6, 0.5, 0.4))
    return scene(sensor=camera((0.3, 1.5, -4)), floor=floor, mirror=mirror, lamp=white())


def on_large_floor() -> mi.Scene:
    """A beam on a sheet of 2,000 units, on which places are rounded to 6e-5 units, as Mitsuba's tests have it."""
    at = mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])
    sheet = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(1000), "bsdf": diffuse(1.0)}
    lamp = {"type": "projector", "to_world": at, "irradiance": {"type": "rgb", "value": 1.0}, "fov": 165.0}
    return scene(sensor=camera((0, 0, 1), fov=170), sheet=sheet, lamp=lamp)


SLIDE = {"key": "cube.vertex_positions", "direction": [1, 0.3, 0.4]}
FLOOR = {"key": "floor.vertex_positions", "direction": [0, 1, 0]}
LAMP = {"key": "lamp.to_world", "rotate": [0.3, 0.2, 1]}
LAMP_ALONG = {"key": "lamp.to_world", "direction": [1, 0.3, 0.4]}
CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0.4]}
CUTOFF = {"key": "lamp.cutoff_angle", "direction": [1]}

#: Of each case: scene, motion, step, max_depth.
BEAMS: dict[str, tuple[Callable[[], mi.Scene], dict, float, int]] = {
    "beam_turns": (on_cube(hard_spot), LAMP, 1e-3, 2),
    "beam_widens": (on_cube(hard_spot), CUTOFF, 0.1, 2),
    "beam_on_cube": (on_cube(white), SLIDE, 2e-3, 2),
    "beam_on_floor": (on_cube(white), FLOOR, 2e-3, 2),
    "beam_camera": (on_cube(picture), CAMERA, 2e-3, 2),
    "picture_turns": (on_cube(picture), LAMP, 1e-3, 2),
    "picture_of_spot": (on_cube(soft_spot_with_picture), FLOOR, 2e-3, 2),
    "lamp_with_picture": (on_cube(lamp_with_picture), LAMP_ALONG, 3e-3, 2),
    "beam_on_large_floor": (on_large_floor, {"key": "sensor.to_world", "direction": [1, 0, 0]}, 3e-2, 2),
    "beam_in_mirror": (in_mirror, LAMP_ALONG, 2e-3, 3),
    "hidden_beam_turns": (hidden(lambda: from_above(hard_spot())), LAMP, 3e-2, 3),
    "hidden_beam_widens": (hidden(lambda: from_above(hard_spot())), CUTOFF, 2.0, 3),
    "hidden_picture": (hidden(lambda: from_above(picture())), LAMP_ALONG, 4e-2, 3),
    "picture_on_cube": (on_cube(picture), SLIDE, 2e-3, 4),
}
