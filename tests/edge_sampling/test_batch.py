"""Mitsuba's `batch` sensors: the children's parts of the film, and their rays."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import rimlight
from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling import Batch, Projection, film_parts

SENSORS = {
    "whole": cases.batch,
    "crop": cases.batch_crop,
    "fisheye": cases.batch_with_fisheye,
    "thinlens": lambda: cases.batch(right=cases.lens_over_blocker),
}


def samples(count: int = 1000) -> tuple[mi.Point2f, mi.Point2f]:
    """Positions on the film and on the lens."""
    rng = mi.PCG32(size=count)
    return tuple(mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(2))


@pytest.mark.parametrize("make", SENSORS.values(), ids=SENSORS.keys())
def test_rays_are_those_of_mitsuba(make):
    sensor = mi.load_dict(make())
    position, aperture = samples()
    ours, weight = Batch(sensor).sample_ray_differential(0.0, 0.5, position, aperture)
    expected, expected_weight = sensor.sample_ray_differential(0.0, 0.5, position, aperture)
    for name in ("o", "d", "o_x", "d_x", "o_y", "d_y", "maxt"):
        np.testing.assert_array_equal(np.array(getattr(ours, name)), np.array(getattr(expected, name)))
    np.testing.assert_array_equal(np.array(weight), np.array(expected_weight))


@pytest.mark.parametrize("make", SENSORS.values(), ids=SENSORS.keys())
def test_points_are_projected_to_where_their_rays_start(make):
    sensor = mi.load_dict(make())
    film = sensor.film()
    position, aperture = samples()
    ray, _ = sensor.sample_ray(0.0, 0.5, position, aperture)
    point = ray(3.0)
    expected = np.array(position) * np.array(film.crop_size())[:, None] + np.array(film.crop_offset())[:, None]
    parts = film_parts(sensor)
    got = [np.array(part.to_film(Projection(part.sensor).film(point, aperture).position())) for part in parts]
    right = np.array(position)[0] > 0.5
    np.testing.assert_allclose(np.where(right, got[1], got[0]), expected, atol=2e-3)
    assert sum(part.area * np.prod(part.sensor.film().size()) for part in parts) == pytest.approx(
        np.prod(film.crop_size())
    )


def test_other_sensors_have_one_part():
    sensor = mi.load_dict(cases.camera())
    (part,) = film_parts(sensor)
    assert part.sensor is sensor and part.area == 1
    assert np.array(part.to_film(mi.Point2f(3, 4))).ravel().tolist() == [3, 4]


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("direct_edge", "cube.vertex_positions"),
        ("direct_edge", "sensor.left.to_world"),
        ("prb_edge", "sensor.right.to_world"),
    ],
)
def test_forward_and_backward_agree(kind, key):
    scene = cases.room(cases.batch_with_fisheye)()
    integrator, motion = mi.load_dict({"type": kind}), Motion(scene, key, direction=[1, 0.3, 0.2])
    J = np.array(derivative_image(scene, integrator, motion, spp=16, seed=3), np.float64)
    weights = np.random.default_rng(0).normal(size=J.shape).astype(np.float32)
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    integrator.render_backward(scene, motion.params, mi.TensorXf(weights), seed=3, spp=16)
    dr.enqueue(dr.ADMode.Backward, motion.params[key])
    dr.traverse(dr.ADMode.Backward)
    assert dr.grad(theta)[0] == pytest.approx((weights * J).sum(), rel=2e-3, abs=1e-3 * np.abs(J).sum())


def test_a_camera_moves_its_own_view_only():
    scene = cases.cube(cases.batch)()
    motion = Motion(scene, "sensor.right.to_world", direction=[1, 0.3, 0.2])
    J = np.array(derivative_image(scene, mi.load_dict({"type": "direct_edge"}), motion, spp=16))
    assert (J[:, : cases.RES] == 0).all() and (J[:, cases.RES :] != 0).any()


def test_plan_counts_all_parts():
    """As many as for one camera each."""
    keys = ["cube.vertex_positions"]
    one, two = (rimlight.plan(cases.cube(make)(), keys, spp=4) for make in (cases.camera, cases.batch))
    assert two.term("film boundary").samples == 2 * one.term("film boundary").samples


@pytest.mark.parametrize("who", ["batch", "child"])
def test_borders_are_refused(who):
    sensor = cases.batch()
    film = (sensor if who == "batch" else sensor["left"])["film"]
    film |= {"sample_border": True, "rfilter": {"type": "gaussian"}}
    with pytest.raises(RuntimeError, match=r'batch sensor ".*" samples the border .* set "sample_border" to false'):
        film_parts(mi.load_dict(sensor))
    film["rfilter"] = {"type": "box"}  # a border without width
    assert len(film_parts(mi.load_dict(sensor))) == 2
