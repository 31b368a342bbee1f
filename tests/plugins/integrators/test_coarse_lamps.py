"""Coarse lamps with interpolated normals: what is lit jumps where it comes to lie behind the plane of a face."""

from __future__ import annotations

import cases
import mitsuba as mi
import numpy as np
import pytest
from frozen import assert_frozen_is_unfrozen
from random_scenes import ball

import rimlight
from rimlight.checks import Agreement, Motion, compare, derivative_image

#: The largest noise of a derivative, relative to its L1 norm.
NOISE = 0.04


def sheet() -> mi.Mesh:
    """A roof of four faces, open below: with the normals of a round one, its light goes on behind their planes."""
    angles = np.linspace(-1.4, 1.4, 3)
    rim = np.stack([np.sin(angles), np.cos(angles), 0 * angles], 1)
    points = np.concatenate([np.add(rim, [0, 0, z]) for z in (-0.5, 0.5)])
    faces = [[0, 4, 1], [0, 3, 4], [1, 5, 2], [1, 4, 5]]
    mesh = cases.mesh("light", 0.3 * points + [0.2, -0.2, 0.1], faces, True, **LAMP())
    params = mi.traverse(mesh)
    params["vertex_normals"] = np.float32(np.concatenate([rim, rim])).ravel()
    params.update()
    return mesh


LAMP = lambda: {"bsdf": cases.diffuse(0), "emitter": cases.light(9, 9, 9)}


def lamp_above_floor(kind: str) -> mi.Scene:
    points, _, _, faces = ball(4)
    turn = np.array(mi.ScalarTransform4f().rotate([0, 0, 1], 20).matrix)[:3, :3]
    points, flipped = 0.5 * points @ turn.T + [0.2, 1.2, 0.1], kind == "flipped"
    faces = faces[:, ::-1] if flipped else faces
    lamp = sheet() if kind == "sheet" else cases.mesh("light", points, faces, True, flip_normals=flipped, **LAMP())
    film = cases.film("gaussian" if kind == "gaussian" else "box", width=16, height=16, pixel_format="luminance")
    sensor = cases.camera((0, 2, -5), (0, -0.5, 0), fov=24, film=film)
    floor = cases.horizontal((0, -0.5, 0), 3, "floor", bsdf=cases.diffuse(0.5))
    return cases.scene(sensor=sensor, light=lamp, floor=floor)


def agreement(kind: str, motion: dict, integrator: str = "direct_edge") -> Agreement:
    scene = lamp_above_floor(kind)
    moves = Motion(scene, **motion)
    path = mi.load_dict({"type": "path", "max_depth": 2})
    name = f"coarse_lamp_{kind}_{moves.key.partition('.')[0]}"
    options = {"step": 4e-3, "runs": 16, "spp": 4096, "integrator": path}
    reference = cases.stored_differences(name, [str(moves)], scene, moves, **options)
    edge = mi.load_dict({"type": integrator, "max_depth": 2} if integrator == "prb_edge" else {"type": integrator})
    images = [derivative_image(scene, edge, moves, spp=1024, seed=i) for i in range(12)]
    found = compare(np.array(images, np.float64), reference)
    print(found)
    return found


SLIDES = {"key": "light.vertex_positions", "direction": [1, 0, 0.4]}
FLOOR_TURNS = {"key": "floor.vertex_positions", "rotate": [1, 0, 0.3]}
CAMERA = {"key": "sensor.to_world", "direction": [1, 0, 0]}


@pytest.mark.parametrize("kind", ["ball", "flipped", "gaussian"])
def test_lamps_slide(kind):
    assert not agreement(kind, SLIDES).faults(noise=NOISE)


@pytest.mark.parametrize("integrator", ["direct_edge", "prb_edge"])
@pytest.mark.parametrize("motion", [FLOOR_TURNS, CAMERA], ids=["floor", "camera"])
def test_others_move(motion, integrator):
    assert not agreement("ball", motion, integrator).faults(noise=NOISE)


def test_open_sheets_hide_nothing():
    assert not agreement("sheet", FLOOR_TURNS).faults(noise=NOISE)


@pytest.mark.parametrize("key", ["light.vertex_positions", "sensor.to_world"])
def test_frozen_is_unfrozen(key):
    assert_frozen_is_unfrozen(lamp_above_floor("ball"), mi.load_dict({"type": "direct_edge"}), key)


def test_planes_of_coarse_lamps_are_planned():
    scene, integrator = lamp_above_floor("ball"), mi.load_dict({"type": "direct_edge"})
    plan = rimlight.plan(scene, ["floor.vertex_positions"], integrator=integrator)
    assert "planes of 48 faces of lamps" in str(plan)
    assert not any("coarse" in limit for limit in plan.limits)
