"""`Projection` inverts `Sensor.sample_ray`, for every sensor and film."""

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


def test_follows_every_parameter_of_the_camera():
    sensor = mi.load_dict(cases.camera(kind="thinlens", aperture_radius=0.3, focus_distance=4.0))
    for key in ("x_fov", "to_world", "aperture_radius", "focus_distance"):
        params = mi.traverse(sensor)
        assert not Projection(sensor).attached
        dr.enable_grad(params[key])
        params.update()
        projection = Projection(sensor)
        assert projection.attached
        u = projection.film(mi.Point3f(0.1, 0.2, 0.3), mi.Point2f(0.2, 0.9)).position()
        assert dr.grad_enabled(u)
        dr.disable_grad(params[key])
        params.update()


def test_unknown_sensor_is_refused():
    sensor = mi.load_dict(
        {"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}}
    )
    with pytest.raises(RuntimeError, match="use one of perspective, thinlens, orthographic"):
        Projection(sensor)
