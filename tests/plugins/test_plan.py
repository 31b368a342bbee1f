"""Plans and checks leave scenes as they were."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from random_scenes import ball

import rimlight
from rimlight.checks import Motion, derivative_image, finite_differences

KEYS = [
    "sensor.to_world",
    "sensor.x_fov",
    "ball.vertex_positions",
    "ball.vertex_normals",
    "ball.bsdf.reflectance.value",
    "floor.bsdf.reflectance.data",
    "light.intensity.value",
    "light.position",
]

#: Of which a direction has three numbers.
MOVED = ("sensor.to_world", "ball.vertex_positions", "light.position")


def scene_of_all_kinds() -> mi.Scene:
    points, _, _, faces = ball(6)
    texels = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32))
    texture = {"type": "bitmap", "bitmap": texels, "raw": True}
    thing = cases.mesh("ball", 0.5 * points, faces, True, bsdf=cases.diffuse(0.5))
    params = mi.traverse(thing)
    params["vertex_normals"] = np.float32(points @ np.diag([1.0, 0.8, 0.9])).ravel()  # as a file may have them
    params.update()
    floor = cases.horizontal((0, -0.5, 0), 2, "floor", bsdf={"type": "diffuse", "reflectance": texture})
    light = {"type": "point", "position": [1, 3, -1], "intensity": {"type": "rgb", "value": [5.0, 4.0, 3.0]}}
    return cases.scene(sensor=cases.camera(), ball=thing, floor=floor, light=light)


def numbers(scene: mi.Scene) -> dict[str, np.ndarray]:
    known = mi.traverse(scene)
    plain = lambda v: v.matrix if hasattr(v, "matrix") else v
    return {key: np.array(dr.detach(plain(value)), float) for key, value in known if key in KEYS}


def with_gradients(scene: mi.Scene) -> list[str]:
    return [key for key, value in mi.traverse(scene) if dr.is_diff_v(value) and dr.grad_enabled(value)]


@pytest.mark.parametrize("key", KEYS)
def test_nothing_carries_a_gradient_or_another_value_afterwards(key):
    scene, integrator = scene_of_all_kinds(), mi.load_dict({"type": "direct_edge"})
    before = numbers(scene)
    assert key in before
    rimlight.plan(scene, [key], integrator=integrator)
    assert not with_gradients(scene)
    for name, value in numbers(scene).items():
        np.testing.assert_array_equal(value, before[name], name)


@pytest.mark.parametrize("key", KEYS)
def test_checks_leave_the_scene_as_it_was(key):
    scene, integrator = scene_of_all_kinds(), mi.load_dict({"type": "direct_edge"})
    before, motion = numbers(scene), Motion(scene, key, direction=[0.1, 0.2, 0.3] if key in MOVED else [0.1])
    derivative_image(scene, integrator, motion, spp=1)
    finite_differences(scene, motion, step=1e-2, runs=2, spp=1)
    assert not with_gradients(scene)
    for name, value in numbers(scene).items():
        np.testing.assert_array_equal(value, before[name], name)


def test_another_derivative_can_follow():
    scene, integrator = scene_of_all_kinds(), mi.load_dict({"type": "direct_edge"})
    motion = Motion(scene, "light.position", direction=[1, 0, 0])
    first = np.array(derivative_image(scene, integrator, motion, spp=4))
    rimlight.plan(scene, ["sensor.x_fov", "ball.bsdf.reflectance.value"], integrator=integrator)
    np.testing.assert_allclose(np.array(derivative_image(scene, integrator, motion, spp=4)), first, atol=1e-5)


def test_what_carries_a_gradient_keeps_it():
    scene, key = scene_of_all_kinds(), "ball.bsdf.reflectance.value"
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    rimlight.plan(scene, [key, "sensor.x_fov"], integrator=mi.load_dict({"type": "direct_edge"}))
    assert with_gradients(scene) == [key]
    image = mi.render(scene, params, integrator=mi.load_dict({"type": "direct_edge"}), spp=4)
    dr.backward(dr.sum(image, axis=None))
    assert dr.all(dr.grad(params[key]) > 0)
