"""What scripts do around derivatives: several images in one loss, and a sensor for each step."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

KEY = "cube.vertex_positions"

KINDS = {
    "direct_edge": {"type": "direct_edge"},
    "rig": {"type": "rig"},
    "bdpt_edge": {"type": "bdpt_edge", "max_depth": 2},
    "aov_edge": {"type": "aov_edge", "aovs": "depth:depth"},
}


def scene_with_cube():
    lamp = {"type": "point", "position": [1, 4, -2], "intensity": 20.0}
    return cases.scene(sensor=cases.camera(), cube=cases.welded_cube(), lamp=lamp)


def sums_of_images(scene, integrator, offsets, sensors=(0,), seed: int = 1) -> tuple[float, list[str]]:
    """The derivative of the sum of images along x: one image for each place of the cube and sensor, all in one loss."""
    params = mi.traverse(scene)
    initial = dr.unravel(mi.Point3f, mi.Float(dr.detach(params[KEY])))
    theta, total = dr.opaque(mi.Float, 0), mi.Float(0)
    dr.enable_grad(theta)
    with cases.messages() as messages:
        for i, offset in enumerate(offsets):
            params[KEY] = dr.ravel(initial + mi.Vector3f(offset + theta, 0, 0))
            params.update()
            for k, sensor in enumerate(sensors):
                number = seed + 100 * i + k
                image = mi.render(scene, params, sensor=sensor, integrator=integrator, spp=16, seed=number)
                total += dr.sum(image, axis=None).array
        dr.backward(total)
    params[KEY] = dr.ravel(initial)
    params.update()
    return float(dr.grad(theta)[0]), [m for m in messages if "the scene has changed since the image" in m]


@pytest.mark.parametrize("kind", KINDS)
def test_a_pose_that_is_set_before_the_derivative_is_warned_about(kind):
    """Mitsuba asks for the derivative of an image when the loss is differentiated, of the scene as it is by then."""
    scene, integrator = scene_with_cube(), mi.load_dict(KINDS[kind])
    _, said = sums_of_images(scene, integrator, (0.0,))
    assert not said
    found, said = sums_of_images(scene, integrator, (0.0, 0.3))
    assert len(said) == 1
    assert "Differentiate each image before you change the scene" in said[0]
    each = [sums_of_images(scene, integrator, (offset,), seed=1 + 100 * i)[0] for i, offset in enumerate((0.0, 0.3))]
    assert abs(found - sum(each)) > 0.05 * abs(sum(each))  # as the warning says


def test_sensors_in_one_loss():
    scene, integrator = scene_with_cube(), mi.load_dict(KINDS["direct_edge"])
    sensors = [mi.load_dict(cases.camera(origin)) for origin in ((1.5, 2, -5), (-3, 2, -4))]
    together, said = sums_of_images(scene, integrator, (0.0,), sensors)
    one_by_one = sum(sums_of_images(scene, integrator, (0.0,), [s], 1 + k)[0] for k, s in enumerate(sensors))
    assert not said
    assert together == pytest.approx(one_by_one, rel=1e-4)


def test_sensors_of_single_steps_are_not_kept():
    """Each holds its film: a megabyte, or more."""
    scene, integrator = scene_with_cube(), mi.load_dict(KINDS["direct_edge"])
    params = mi.traverse(scene)
    dr.enable_grad(params[KEY])
    held = []
    for i in range(24):
        sensor = mi.load_dict(cases.camera((5 * np.sin(i), 2, -5 * np.cos(i)), film=cases.film(width=8, height=8)))
        dr.backward(dr.sum(mi.render(scene, params, sensor=sensor, integrator=integrator, spp=1, seed=i), axis=None))
        held.append(len(integrator.search._beyond))
    assert max(held) == held[-1] == held[-3] < len(held)
