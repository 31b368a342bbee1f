"""The sensor `fisheye`: its mapping, as a camera of Mitsuba's integrators, and its parameters."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion, derivative_image, mean_and_error, z_scores

PATH = {"type": "path", "max_depth": 3}
VARIANTS = ["llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_spectral_polarized"]


def sensor(width: int = 64, height: int = 32, film=None, **options) -> mi.Sensor:
    film = {**cases.film(), "width": width, "height": height, **(film or {})}
    return mi.load_dict({"type": "fisheye", "film": film, **options})


def room(**options) -> mi.Scene:
    """From inside a box with one open side, past the rim of the image circle."""
    box = mi.cornell_box()
    pose = mi.ScalarTransform4f().look_at([0.1, 0, 0.2], [0.3, -0.3, -1], [0, 1, 0])
    box["sensor"] = {"type": "fisheye", "to_world": pose, "film": cases.film(pixel_format="rgba"), **options}
    return mi.load_dict(box, optimize=False)


def image(scene: mi.Scene, integrator: dict, spp: int = 64, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=spp, seed=seed))


# ---------------------- The mapping ----------------------


@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "smaller", "larger"])
@pytest.mark.parametrize("fov", [40, 180, 360])
def test_angles_are_proportional_to_distances(axis, fov):
    radius = {"x": 32, "y": 16, "diagonal": np.hypot(32, 16), "smaller": 16, "larger": 32}[axis]
    offset = np.random.default_rng(0).uniform(-1, 1, (2, 200)) * [[32], [16]]  # pixels from the centre
    sample = mi.Point2f(offset[0] / 64 + 0.5, offset[1] / 32 + 0.5)
    ray, weight = sensor(fov_axis=axis, fov=fov).sample_ray(0.0, 0.5, sample, sample)
    r = np.hypot(*offset)
    θ = r / radius * np.radians(fov / 2)
    expected = [-offset[0] / r * np.sin(θ), -offset[1] / r * np.sin(θ), np.cos(θ)]
    np.testing.assert_allclose(np.array(ray.d), expected, atol=2e-6)
    np.testing.assert_array_equal(np.array(weight)[0], r <= radius)
    np.testing.assert_array_equal(np.array(ray.maxt) > 0, r <= radius)


def test_axes_are_those_of_a_perspective_camera():
    """Near the axis, the two are the same."""
    pose = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0.2, 1, 0])
    film = cases.film(width=30, height=20, crop_width=10, crop_height=8, crop_offset_x=12, crop_offset_y=3)
    make = lambda kind: mi.load_dict({"type": kind, "fov": 0.5, "to_world": pose, "film": film})
    rng = mi.PCG32(size=100)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    rays = [make(kind).sample_ray_differential(0.0, 0.5, sample, sample)[0] for kind in ("fisheye", "perspective")]
    for name in ("d", "d_x", "d_y"):
        np.testing.assert_allclose(*(np.array(getattr(ray, name)) for ray in rays), atol=1e-6)
    pixel = np.array(rays[0].d_x - rays[0].d)
    assert np.linalg.norm(pixel, axis=0) == pytest.approx(np.radians(0.5 / 30), rel=1e-2)


def test_points_are_seen_where_their_rays_start():
    """`sample_direction` inverts `sample_ray`."""
    camera = sensor(64, 48, dict(crop_width=20, crop_height=16, crop_offset_x=7, crop_offset_y=11), fov=200)
    rng = mi.PCG32(size=1000)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ray, weight = camera.sample_ray(0.0, 0.5, sample, sample)
    it = dr.zeros(mi.Interaction3f, 1000)
    it.p = ray(3.0)
    ds, importance = camera.sample_direction(it, sample)
    inside = np.array(weight)[0] > 0
    assert inside.any()
    np.testing.assert_allclose(np.array(ds.uv)[:, inside], (np.array(sample) * [[20], [16]])[:, inside], atol=1e-3)
    np.testing.assert_allclose(np.array(ds.d), -np.array(ray.d), atol=1e-6)
    assert ((np.array(importance)[0] > 0) == inside).all()


# ---------------------- Images ----------------------


def test_outside_of_the_circle_nothing_is_seen():
    pixels = image(room(), PATH)
    y, x = np.mgrid[:32, :32] - 15.5
    outside = np.hypot(x, y) > 16.8
    assert (pixels[outside] == 0).all()
    assert (pixels[np.hypot(x, y) < 15][:, 3] == 1).mean() > 0.9


INTEGRATORS = {
    "direct": {"type": "direct"},
    "prb": {"type": "prb", "max_depth": 3},
    "volpath": {"type": "volpath", "max_depth": 3},
    "aov": {"type": "aov", "aovs": "depth:depth", "image": PATH},
    "direct_edge": {"type": "direct_edge"},
    "prb_edge": {"type": "prb_edge", "max_depth": 3},
}


@pytest.mark.parametrize("name", INTEGRATORS)
def test_integrators_agree_with_path(name):
    scene = room(fov=220)
    expected = image(scene, {**PATH, "max_depth": 2 if "direct" in name else 3})
    got = image(scene, INTEGRATORS[name], seed=1)
    np.testing.assert_allclose(got[..., :3].mean((0, 1)), expected[..., :3].mean((0, 1)), rtol=0.03)


@pytest.mark.parametrize("crop", [{}, dict(crop_width=20, crop_height=24, crop_offset_x=10, crop_offset_y=6)])
def test_light_that_is_traced_from_the_lights(crop):
    """`ptracer` weighs by the solid angle of a pixel, row by row."""
    scene = room(fov=200, film=cases.film(**crop))
    expected, got = (
        [image(scene, {**PATH, "type": kind}, spp, seed=i)[..., :3].mean(-1, keepdims=True) for i in range(8)]
        for kind, spp in (("path", 64), ("ptracer", 256))
    )
    for axis in (1, 2):
        z = z_scores(
            *mean_and_error(np.mean(expected, axis, keepdims=True)), *mean_and_error(np.mean(got, axis, keepdims=True))
        )
        assert np.abs(z).max() < 5 and np.mean(z**2) < 2


@pytest.mark.parametrize("other_variant", VARIANTS)
def test_other_variants(other_variant):
    expected = image(room(), PATH)[..., :3].mean()
    mi.set_variant(other_variant)
    try:
        got = image(room(), PATH)[..., :3].mean()
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert got == pytest.approx(expected, rel=0.1)


# ---------------------- Parameters ----------------------


def test_parameters_are_differentiable():
    camera = sensor(fov=150)
    params = mi.traverse(camera)
    for key in ("to_world", "fov"):
        assert params.flags(key) == mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        dr.enable_grad(params[key])
        params.update()
        ray, _ = camera.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.6), mi.Point2f(0))
        assert dr.grad_enabled(ray.d)
        dr.disable_grad(params[key])
        params.update()


@pytest.mark.parametrize(
    ("key", "value"),
    [("sensor.fov", lambda i: 90.0 + i), ("sensor.to_world", lambda i: mi.Transform4f().translate([0, 0.1 * i, -3]))],
    ids=["fov", "to_world"],
)
def test_new_values_need_no_new_kernels(key, value):
    scene, integrator = cases.cube(cases.fisheye)(), mi.load_dict(PATH)
    params = mi.traverse(scene)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for i in range(3):
            params[key] = value(i)
            params.update()
            dr.kernel_history_clear()
            dr.eval(mi.render(scene, integrator=integrator, spp=1))
            dr.sync_thread()
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert kernels and all(k["cache_hit"] for k in kernels)


def test_bounding_box_is_the_centre():
    camera = sensor(to_world=mi.ScalarTransform4f().translate([1, 2, 3]))
    assert list(camera.bbox().min) == list(camera.bbox().max) == [1, 2, 3]


@pytest.mark.parametrize("fov", [0, -10, 361, float("nan")])
def test_impossible_fields_of_view(fov):
    with pytest.raises(RuntimeError, match='fisheye: "fov" must be above 0 and at most 360 degrees, got'):
        sensor(fov=float(fov))


def test_unknown_axis():
    with pytest.raises(RuntimeError, match=r'fisheye: "fov_axis" must be one of x, y, diagonal, .*, got "z"'):
        sensor(fov_axis="z")


def test_poses_must_not_scale():
    with pytest.raises(RuntimeError, match='fisheye: "to_world" must not scale'):
        sensor(to_world=mi.ScalarTransform4f().scale(2))


# ---------------------- Derivatives ----------------------


@pytest.mark.parametrize("other_variant", VARIANTS[:2])
def test_derivative_in_other_variants(other_variant):

    def total():
        """Of a grey scene, which means the same in all of them."""
        scene = cases.cube(lambda: cases.fisheye(film=cases.film(pixel_format="luminance")))()
        integrator, motion = mi.load_dict({"type": "direct_edge", "sppi": 0}), Motion(scene, **cases.ALONG)
        return np.mean([derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(8)], 0)

    expected = total()
    mi.set_variant(other_variant)
    try:
        got = total()
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert np.abs(got - expected).sum() < 0.05 * np.abs(expected).sum()
