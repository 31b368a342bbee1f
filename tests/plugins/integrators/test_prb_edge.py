"""`prb_edge`: agreement with `path` and with `direct_edge`, consistency of its modes and terms, refusals."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion, derivative_image, mean_and_error, z_scores
from rimlight.terms.sampling import over_film

DEPTH = 4


def integrator(**options) -> mi.Integrator:
    return mi.load_dict({"type": "prb_edge", "max_depth": DEPTH, **options})


def small(**options) -> dict:
    return cases.film(width=16, height=16, **options)


def room(rough: bool = False) -> mi.Scene:
    """rough : the floor is."""
    bsdf = {"bsdf": lambda: {"type": "twosided", "bsdf": cases.conductor(0.2)}} if rough else {}
    return cases.room(lambda: cases.camera(film=small()), **bsdf)()


def glass_box() -> mi.Scene:
    """A cube of rough glass and a metal one in a Cornell box, which is seen from outside, past its light."""
    box = mi.cornell_box()
    place = lambda x, z: mi.ScalarTransform4f().translate([x, -0.6, z]).rotate([0, 1, 0.3], 30).scale(0.3)
    box["sensor"] = cases.camera((0, 0, -3.9), (0, 0.15, 0), film=small(pixel_format="rgba"), fov=45)
    box["sensor"]["to_world"] = mi.ScalarTransform4f().look_at([0, 0.3, 3.9], [0, 0.2, 0], [0, 1, 0])
    box["small-box"] = {"type": "cube", "to_world": place(0.4, 0.3), "bsdf": {"type": "roughdielectric"}}
    box["large-box"] = {"type": "cube", "to_world": place(-0.4, -0.2), "bsdf": {"type": "dielectric"}}
    return mi.load_dict(box)


def jacobian_times(scene, motion, spp=16, seed=3, it=None, **options) -> np.ndarray:
    it = it or integrator(**options)
    return np.array(derivative_image(scene, it, motion, spp=spp, seed=seed), np.float64)


def gradient(scene, motion, weights, spp=16, seed=3, **options) -> float:
    """dθ of Σ weights · image, through backward mode."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    value = motion.params[motion.key]
    integrator(**options).render_backward(scene, motion.params, mi.TensorXf(weights), seed=seed, spp=spp)
    dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    motion.apply(0.0)
    return dr.grad(theta)[0]


# ---------------------- Primal ----------------------


PATHS = [
    {"max_depth": 0},
    {"max_depth": 1},
    {"max_depth": 2},
    {"max_depth": 3},
    {"max_depth": 6},
    {"max_depth": -1},
    {"max_depth": -1, "rr_depth": 1},
    {"max_depth": 6, "rr_depth": 2},
    {"max_depth": 6, "hide_emitters": True},
    {"max_depth": 1, "hide_emitters": True},
]


@pytest.fixture(scope="module")
def box(variant) -> mi.Scene:
    return glass_box()


@pytest.mark.parametrize("options", PATHS, ids=lambda o: " ".join(f"{k} {v}" for k, v in o.items()))
def test_image_equals_that_of_path(box, options):
    images = [
        np.array([mi.render(box, integrator=it, spp=64, seed=100 * k + i) for i in range(16)], np.float64)
        for k, it in enumerate((integrator(**options), mi.load_dict({"type": "path", **options})))
    ]
    assert np.isfinite(images).all()
    if not images[1].any():
        assert not images[0].any()
        return
    z = z_scores(*mean_and_error(images[0]), *mean_and_error(images[1]))
    totals = [mean_and_error(i.mean((1, 2))) for i in images]
    assert np.abs(z).max() < 6
    assert np.mean(z**2) < 1.2
    error = np.sqrt(totals[0][1] ** 2 + totals[1][1] ** 2)
    assert (np.abs(totals[0][0] - totals[1][0]) <= 4 * error + 1e-6).all()


def test_boundary_samples_do_not_touch_the_image():
    scene = room()
    with_boundary = mi.render(scene, integrator=integrator(), spp=4)
    without = mi.render(scene, integrator=integrator(sppp=0, sppi=0), spp=4)
    assert (np.array(with_boundary) == np.array(without)).all()


# ---------------------- Consistency ----------------------


SIDE = {"key": "cube.vertex_positions", "direction": [1, 0.3, 0.2]}
MOTIONS = {
    "vertices": SIDE,
    "camera": {"key": "sensor.to_world", "rotate": [0.2, 1, 0.1]},
    "reflectance": {"key": "cube.bsdf.reflectance.value", "direction": [1, 0.5, 0.2]},
    "roughness": {"key": "floor.bsdf.brdf_0.alpha.value", "direction": [1]},
    "radiance": {"key": "light.emitter.radiance.value", "direction": [1, 0.5, 0.2]},
}


def test_depth_2_equals_direct_illumination():
    """In derivative, too: with other samples, to within the noise."""
    scene = room()
    motion = Motion(scene, **SIDE)
    direct, shallow = (
        mean_and_error(np.array([jacobian_times(scene, motion, spp=64, seed=first + i, it=it) for i in range(16)]))
        for first, it in ((0, mi.load_dict({"type": "direct_edge"})), (100, integrator(max_depth=2)))
    )
    z = z_scores(*direct, *shallow)
    assert np.abs(direct[0]).sum() > 0
    assert np.abs(z).max() < 5
    assert np.mean(z**2) < 1.2


@pytest.mark.parametrize(
    ("name", "rough"),
    [
        ("vertices", False),
        ("vertices", True),
        ("camera", True),
        ("reflectance", False),
        ("roughness", True),
        ("radiance", False),
    ],
)
def test_forward_and_backward_agree(name, rough):
    scene = room(rough)
    motion = Motion(scene, **MOTIONS[name])
    J = jacobian_times(scene, motion)
    weights = np.random.default_rng(0).normal(size=J.shape).astype(np.float32)
    assert np.abs(J).sum() > 0
    assert gradient(scene, motion, weights) == pytest.approx((weights * J).sum(), abs=1e-4 * np.abs(weights * J).sum())


def test_indirect_material_has_a_derivative():
    """Of a cube that the camera does not see, but the floor below it does."""
    scene = cases.room(lambda: cases.camera((2, 1, 0), (2, -1, 0.1), film=small()))()
    motion = Motion(scene, **MOTIONS["reflectance"])
    J = np.mean([jacobian_times(scene, motion, spp=64, seed=i) for i in range(4)], 0)
    images = []
    for theta in (0.05, -0.05):
        motion.apply(theta)
        images.append(np.array(mi.render(scene, integrator=integrator(), spp=256), np.float64))
    motion.apply(0.0)
    assert np.abs(J).sum() > 0
    assert J.sum() == pytest.approx((images[0] - images[1]).sum() / 0.1, rel=0.05)


@pytest.mark.parametrize(("name", "rough"), [("vertices", False), ("camera", True)])
def test_terms_add_up(name, rough):
    scene = room(rough)
    motion = Motion(scene, **MOTIONS[name])
    terms = [{"sppp": 0, "sppi": 0}, {"sppc": 0, "sppi": 0}, {"sppc": 0, "sppp": 0}]
    parts = [jacobian_times(scene, motion, **options) for options in terms]
    assert all(np.abs(p).sum() > 0 for p in parts)
    total = jacobian_times(scene, motion)
    assert np.abs(sum(parts) - total).max() < 1e-4 * np.abs(total).max()


def test_vertices_slide_with_what_moves():
    """Where a point looks for edges that stand still, since it moves though its surface does not."""
    scene = cases.cornell_box()
    motion, theta = Motion(scene, **cases.BOX_SIDE), mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    dr.forward(theta, dr.ADFlag.ClearEdges)
    with dr.suspend_grad():
        job = integrator().job(scene, 0, 1, 16, dr.ADMode.Forward)
        job.boundaries.refit()
        sampler, _ = over_film(job.sensor, 1, 16)
        ray = job.sample_rays(sampler)[0]
        point, _ = job.tracer.point(ray, job.tracer.walk(ray, sampler, [0]), dr.ADMode.Forward)
    box = next(s for s in scene.shapes() if s.id() == "small-box")
    later = np.array(point.active & (point.depth > 1) & (point.si.shape != mi.ShapePtr(box)))
    moves, slides = (np.array(dr.grad(point.si.p)) != 0).any(0), np.array(point.slides)
    motion.apply(0.0)
    assert moves[later].sum() > 100
    assert not (moves & ~slides)[later].any()
    # Of all that is close to the vertex before, which is 42 % here.
    assert (slides & ~moves)[later].mean() < 0.02


def test_gradients_add_to_what_is_there():
    scene = room()
    params = mi.traverse(scene)
    key, weights = SIDE["key"], mi.TensorXf(np.ones((16, 16, 3), np.float32))
    dr.enable_grad(params[key])
    params.update()
    gradients = []
    for _ in range(2):
        integrator().render_backward(scene, params, weights, seed=3, spp=16)
        gradients.append(np.array(dr.grad(params[key])))
    assert np.abs(gradients[0]).sum() > 0
    assert np.allclose(gradients[1], 2 * gradients[0], rtol=1e-3, atol=1e-4 * np.abs(gradients[0]).max())


# ---------------------- Refusals and warnings ----------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": -2}, '"max_depth" must be a whole number >= 0, or -1 for no limit, got -2'),
        ({"max_depth": 1.5}, '"max_depth" must be a whole number >= 0, or -1 for no limit, got 1.5'),
        ({"max_depth": True}, '"max_depth" must be a whole number >= 0, or -1 for no limit, got True'),
        ({"max_depth": "six"}, '"max_depth" must be a whole number >= 0, or -1 for no limit, got six'),
        ({"rr_depth": 0}, '"rr_depth" must be a whole number >= 1, got 0'),
        ({"rr_depth": 2.0}, '"rr_depth" must be a whole number >= 1, got 2.0'),
        ({"sppi": -4}, '"sppi" must be a whole number >= 0, got -4'),
    ],
)
def test_impossible_parameters_are_refused(options, message):
    props = mi.Properties("prb_edge")
    for key, value in options.items():
        props[key] = value
    with pytest.raises(ValueError, match=f"^prb_edge: {message}$"):
        type(integrator())(props)
    with pytest.raises(RuntimeError, match=f"prb_edge: {message}"):
        integrator(**options)


def test_unknown_parameters_are_refused():
    with pytest.raises(RuntimeError, match="max_dept"):
        mi.load_dict({"type": "prb_edge", "max_dept": 3})


# ---------------------- Other variants ----------------------


@pytest.fixture(scope="module")
def rgb(variant) -> np.ndarray:
    return grey_derivative()


@pytest.mark.parametrize("other_variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_agree_with_rgb(rgb, other_variant):
    """In a grey scene, and forward with backward in any: a room with a rough floor."""
    mi.set_variant(other_variant)
    try:
        other = grey_derivative()
        scene = room(rough=True)
        motion = Motion(scene, **SIDE)
        J = jacobian_times(scene, motion)
        backward = gradient(scene, motion, np.ones_like(J, np.float32))
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert np.abs(other - rgb).sum() < 0.05 * np.abs(rgb).sum()
    assert backward == pytest.approx(J.sum(), rel=1e-3)


def grey_derivative() -> np.ndarray:
    """Of luminance."""
    film = cases.film(width=16, height=16, pixel_format="luminance")
    scene = cases.shadow_blocker(lambda *view: cases.camera(*view, film=film))()
    motion = Motion(scene, **cases.BLOCKER_UP)
    return np.mean([jacobian_times(scene, motion, spp=64, seed=i) for i in range(8)], 0)
