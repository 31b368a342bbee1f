"""`Projection` inverts `Sensor.sample_ray`, for every sensor and film, and finds what is visible of an edge."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.edge_sampling import Projection

CROP = {"width": 64, "height": 48, "crop_width": 20, "crop_height": 16, "crop_offset_x": 7, "crop_offset_y": 11}
SENSORS = {
    "perspective": {},
    "perspective, principal point": {"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.2},
    "perspective, y axis": {"fov_axis": "y"},
    "thinlens": {"kind": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.0},
    "orthographic": {"kind": "orthographic"},
    "fisheye": {"kind": "fisheye", "fov": 180},
    "fisheye, diagonal": {"kind": "fisheye", "fov": 355, "fov_axis": "diagonal"},
}


@pytest.mark.parametrize("film", [{}, CROP], ids=["whole", "crop"])
@pytest.mark.parametrize("options", SENSORS.values(), ids=SENSORS.keys())
def test_inverts_sample_ray(options, film):
    sensor = mi.load_dict(cases.camera(film={**cases.film(), **film}, **options))
    rng = mi.PCG32(size=1000)
    random = lambda: mi.Point2f(rng.next_float32(), rng.next_float32())
    sample, aperture = random(), random()
    ray, _ = sensor.sample_ray(0.0, 0.5, sample, aperture)
    point = ray(1 + 5 * rng.next_float32())
    u = Projection(sensor).film(point, aperture).position()
    expected = sample * mi.ScalarVector2f(sensor.film().crop_size()) + mi.ScalarVector2f(sensor.film().crop_offset())
    assert np.abs(np.array(u - expected)).max() < 2e-3


@pytest.mark.parametrize("film", [{}, CROP], ids=["whole", "crop"])
@pytest.mark.parametrize("options", [*SENSORS.values(), {"kind": "orthographic", "near_clip": 0.5}])
def test_distance_and_density_of_rays(options, film):
    """Of points that the sensor's rays meet: how far they are along the ray, and how large a square around them is."""
    sensor = mi.load_dict(cases.camera(film={**cases.film(), **film}, **options))
    rng = mi.PCG32(size=1000)
    sample = 0.05 + 0.9 * mi.Point2f(rng.next_float32(), rng.next_float32())
    lens = mi.Point2f(rng.next_float32(), rng.next_float32())
    ray, weight = sensor.sample_ray(0.0, 0.5, sample, lens)
    t = 1 + 5 * rng.next_float32()
    p, projection = ray(t), Projection(sensor)
    sees = np.array(weight.x + dr.zeros(mi.Float, 1000)) > 0
    np.testing.assert_allclose(np.array(projection.distance(p, -ray.d))[sees], np.array(t)[sees], rtol=2e-3)
    far = projection.distance(ray(2 * projection.far if np.isfinite(projection.far) else t), -ray.d)
    assert (np.array(far)[sees] < 0).all() or not np.isfinite(projection.far)
    h, frame = 1e-2 * t, mi.Frame3f(ray.d)
    at = lambda offset: projection.film(mi.Point3f(p + offset), lens).position()
    x, y = ((at(h * s) - at(-h * s)) / (2 * h) for s in (frame.s, frame.t))
    area = dr.abs(x.x * y.y - x.y * y.x)
    on_axis = np.array(dr.norm(x)) > 50 * np.array(dr.norm(y))  # behind a fisheye, differences are no derivatives
    good = sees & ~on_axis & (np.array(area) < 1e5)
    assert good.sum() > 400
    found = np.array(projection.pixels_per_area(p, -ray.d) + dr.zeros(mi.Float, 1000))
    np.testing.assert_allclose(found[good], np.array(area)[good], rtol=2e-2)


LENS = {"kind": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.0}
PARAMETERS = [(LENS, key) for key in ("x_fov", "to_world", "aperture_radius", "focus_distance")]
PARAMETERS += [({"kind": "fisheye"}, key) for key in ("fov", "to_world")]


@pytest.mark.parametrize(("options", "key"), PARAMETERS)
def test_follows_every_parameter_of_the_camera(options, key):
    sensor = mi.load_dict(cases.camera(**options))
    params = mi.traverse(sensor)
    assert not Projection(sensor).attached
    dr.enable_grad(params[key])
    params.update()
    projection = Projection(sensor)
    assert projection.attached
    u = projection.film(mi.Point3f(0.1, 0.2, 0.3), mi.Point2f(0.2, 0.9)).position()
    assert dr.grad_enabled(u)


# ---------------------- Edges ----------------------

COUNT, POINTS = 2000, 64
EDGES = {
    **SENSORS,
    "fisheye, all around": {"kind": "fisheye", "fov": 360},
    "fisheye, wide": {"kind": "fisheye", "fov": 230},
    "fisheye, narrow": {"kind": "fisheye", "fov": 30},
}


def edges() -> tuple[mi.Point3f, mi.Point3f]:
    """Of all lengths, on all sides of the camera, and close to it."""
    rng = np.random.default_rng(0)
    centre = rng.normal(size=(3, COUNT)) * rng.uniform(0.3, 6, COUNT) + [[1.5], [2], [-5]]
    half = rng.normal(size=(3, COUNT)) * 10 ** rng.uniform(-3, 1, COUNT)
    return mi.Point3f(centre - half), mi.Point3f(centre + half)


def fractions() -> mi.Float:
    """For all edges after each other, numbers in (0, 1)."""
    return (mi.Float(dr.arange(mi.UInt32, COUNT * POINTS) % POINTS) + 0.5) / POINTS


def repeated(value):
    return dr.gather(type(value), value, dr.arange(mi.UInt32, COUNT * POINTS) // POINTS)


@pytest.mark.parametrize("film", [{}, CROP], ids=["whole", "crop"])
@pytest.mark.parametrize("options", EDGES.values(), ids=EDGES.keys())
def test_what_the_sensor_sees_of_an_edge_is_sampled(options, film):
    """Each visible point lies within the part of its edge that `clip` finds."""
    sensor = mi.load_dict(cases.camera(film={**cases.film(), **film}, **options))
    projection = Projection(sensor)
    a, b = edges()
    part = projection.clip(a, b)
    (first, _), (last, _) = part.parameter(mi.Float(0)), part.parameter(mi.Float(1))
    first, last, length = repeated(first), repeated(last), repeated(part.length)
    t = fractions()
    point = projection.film(dr.lerp(repeated(a), repeated(b), t))
    u, fov = np.array(point.position()), options.get("fov", 360)
    lower, upper = np.array(projection.frame)
    visible = ((u > lower[:, None] + 1e-2) & (u < upper[:, None] - 1e-2)).all(0)
    visible &= (np.array(point.z) > projection.near * 1.01) & (np.array(point.z) < projection.far)
    if options.get("kind") == "fisheye":
        radius = sensor.circle_radius()
        visible &= np.hypot(*(u - np.array(sensor.film().size())[:, None] / 2)) < radius - 1e-2
        # Twice around, the way back would be there as well.
        assert fov == 360 or np.array(length).max() < 1.01 * 2 * radius * 360 / fov
    assert visible.sum() > 100
    assert (np.array(length) > 0)[visible].all()
    assert (np.array(t >= first - 1e-4) & np.array(t <= last + 1e-4))[visible].all()


@pytest.mark.parametrize("options", EDGES.values(), ids=EDGES.keys())
def test_tangents_and_parameters_are_derivatives(options):
    """Of the film position by t, and of t by the fraction of the visible part: against automatic differentiation."""
    projection = Projection(mi.load_dict(cases.camera(**options)))
    a, b = edges()
    part = projection.clip(a, b)
    good = part.length > 1e-2
    s = mi.Float(0.4)
    dr.enable_grad(s)
    t, dt = part.parameter(s)
    u = projection.film(dr.lerp(a, b, t), mi.Point2f(0.3, 0.8)).position()
    dr.forward(s, dr.ADFlag.ClearEdges)
    expected, got = np.array(dr.grad(t)), np.array(dr.detach(dt))
    good = np.array(good) & (np.abs(expected) > 1e-6)
    assert good.sum() > 20
    np.testing.assert_allclose(got[good], expected[good], rtol=2e-2)
    tangent = np.array(dr.detach(projection.tangent(a, b, dr.detach(t), mi.Point2f(0.3, 0.8)) * dt))
    difference = np.linalg.norm(tangent - np.array(dr.grad(u)), axis=0)
    assert (difference <= 2e-2 * np.linalg.norm(tangent, axis=0))[good].all()


LARGE = {"kind": "orthographic", "scale": [2e3, 3e3, 1]}


@pytest.mark.parametrize("options", [*EDGES.values(), LARGE], ids=[*EDGES.keys(), "orthographic, large"])
def test_how_many_pixels_a_length_covers(options):
    """The most of a direction across the line of sight: exactly in the middle of a film, about that elsewhere."""
    options = dict(options)
    scale = options.pop("scale", None)
    description = cases.camera(**options)
    if scale is not None:
        description["to_world"] = description["to_world"] @ mi.ScalarTransform4f().scale(scale)
    projection = Projection(mi.load_dict(description))
    a, _ = edges()
    p = mi.Point3f(a * (scale[0] if scale else 1))
    sight = projection.view() if projection.orthographic else dr.normalize(p - projection.eye())
    frame, most = mi.Frame3f(sight), mi.Float(0)
    for k in range(16):
        s, c = dr.sincos(np.pi * k / 16)
        q = mi.Point3f(p + frame.to_world(mi.Vector3f(c, s, 0)))
        most = dr.maximum(most, dr.norm(projection.tangent(p, q, mi.Float(0))))
    ratio = np.array(most / projection.pixels_per_unit(projection.film(p)))
    half, seen = cases.RES / 2, np.array(projection.film(p).z) > projection.near
    seen &= (np.abs(np.array(projection.film(p).position()) - half) < half).all(0)
    assert seen.sum() > 20
    assert (ratio[seen] > 0.95).all() and (ratio[seen] < 1.6).all(), (ratio[seen].min(), ratio[seen].max())


def test_unknown_sensor_is_refused():
    sensor = mi.load_dict(
        {"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}}
    )
    with pytest.raises(RuntimeError, match="use one of perspective, thinlens, orthographic"):
        Projection(sensor)
