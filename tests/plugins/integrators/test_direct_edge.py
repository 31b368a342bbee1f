"""`direct_edge`: agreement with `path`, consistency of its modes and terms, refusals."""

import cases
import drjit as dr
import frozen
import mitsuba as mi
import numpy as np
import pytest
from random_scenes import ball

import rimlight.scenes
from rimlight.checks import Motion, derivative_image, mean_and_error, z_scores
from rimlight.exr import read_exr


def integrator(**options):
    return mi.load_dict({"type": "direct_edge"} | options)


def jacobian_times(scene, motion, spp=16, seed=3, **options):
    return np.array(derivative_image(scene, integrator(**options), motion, spp=spp, seed=seed), np.float64)


def gradient(scene, motion, weights, spp=16, seed=3, **options):
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

#: Scenes whose light `direct_edge` and `path` hardly find: tests of `bdpt` have them.
BIDIRECTIONAL = "door_ajar", "glossy_caustic", "lampshade"


@pytest.mark.parametrize("name", [n for n in rimlight.scenes.names() if n not in BIDIRECTIONAL])
def test_image_agrees_with_the_stored_reference(name, root):
    """z-test against `path` at depth 2: tests/references/images/*.exr, made by make_images.py."""
    layers, _ = read_exr(root / "tests" / "references" / "images" / f"{name}.exr")
    scene = mi.load_file(str(rimlight.scenes.path(name)), res=cases.RES)
    images = np.array([mi.render(scene, integrator=integrator(), spp=64, seed=i) for i in range(32)], np.float64)
    z = z_scores(*mean_and_error(images), layers[""], layers["standard_error"])
    assert np.isfinite(z).all()
    assert np.abs(z).max() < 5
    assert np.mean(z**2) < 1.2


@pytest.mark.parametrize("hide", [False, True])
def test_image_equals_path_with_hidden_emitters(hide):
    scene = cases.room(lambda: cases.camera((0, 2, -6), (0, 1.5, 0), film=cases.film(pixel_format="rgba")))()
    path = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": hide})
    ours = np.array(mi.render(scene, integrator=integrator(hide_emitters=hide), spp=1024))
    theirs = np.array(mi.render(scene, integrator=path, spp=1024, seed=1))
    assert np.abs(ours[..., 3] - theirs[..., 3]).max() < 0.1
    assert np.abs(ours - theirs).mean() < 0.02 * theirs.mean()


def test_boundary_samples_do_not_touch_the_image():
    scene = cases.cube()()
    with_boundary = mi.render(scene, integrator=integrator(), spp=4)
    without = mi.render(scene, integrator=integrator(sppp=0, sppi=0), spp=4)
    assert (np.array(with_boundary) == np.array(without)).all()


# ---------------------- Consistency ----------------------


@pytest.mark.parametrize(
    "name", ["two_triangles_green", "cube_depth", "room_light", "thin_lens_camera", "gaussian_filter", "crop_window"]
)
def test_forward_and_backward_agree(name):
    case = cases.case(name)
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    J = jacobian_times(scene, motion)
    weights = np.random.default_rng(0).normal(size=J.shape).astype(np.float32)
    assert gradient(scene, motion, weights) == pytest.approx((weights * J).sum(), rel=1e-3)


def test_mi_render_differentiates_both_ways():
    case = cases.case("room_camera")
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    image = mi.render(scene, motion.params, integrator=integrator(), spp=16, seed=0)
    dr.backward(dr.sum(image, axis=None))
    motion.apply(0.0)
    seed_grad = mi.sample_tea_32(0, 1)[0]
    expected = np.array(derivative_image(scene, integrator(), motion, spp=16, seed=seed_grad), np.float64).sum()
    assert dr.grad(theta)[0] == pytest.approx(expected, rel=1e-3)


def test_terms_add_up():
    case = cases.case("room_cube")
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    terms = [{"sppp": 0, "sppi": 0}, {"sppc": 0, "sppi": 0}, {"sppc": 0, "sppp": 0}]
    parts = [jacobian_times(scene, motion, **options) for options in terms]
    assert all(np.abs(p).sum() > 0 for p in parts)
    total = jacobian_times(scene, motion)
    assert np.abs(sum(parts) - total).max() < 1e-4 * np.abs(total).max()


@pytest.fixture
def one_thread():
    """Sums then have one order only: with several, atomic additions leave the last bits to chance."""
    with frozen.one_thread():
        yield


@pytest.mark.parametrize("key", ["face0.vertex_positions", "sensor.to_world"])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_object_behind_the_camera_changes_nothing_at_all(key, rfilter, one_thread):
    """The faces of the cube emit and reflect nothing, so that nothing behind the camera matters to them."""
    images = []
    for extra in (
        {},
        {
            "a_behind": cases.mesh(
                "a_behind", [[0, 3, -9], [1, 3, -9], [0, 4, -9.5]], [[0, 1, 2]], bsdf=cases.diffuse(0.5)
            )
        },
    ):
        scene = cases.coloured_cube(lambda: cases.camera(film=cases.film(rfilter)), **extra)
        images.append(jacobian_times(scene, Motion(scene, key, direction=[1, 0, 0]), sppi=0))
    assert np.abs(images[0]).sum() > 0
    assert (images[0] == images[1]).all()


def test_split_vertices_change_nothing():
    images = []
    for shape in (cases.welded_cube, cases.split_cube):
        scene = cases.cube(shape=shape)()
        images.append(jacobian_times(scene, Motion(scene, **cases.DEPTH), spp=64))
    assert np.abs(images[0] - images[1]).sum() < 1e-4 * np.abs(images[0]).sum()


def test_gradient_reaches_both_copies_of_a_split_vertex():
    scene = cases.cube(shape=cases.split_cube)()
    params = mi.traverse(scene)
    key = "cube.vertex_positions"
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=integrator(), spp=64), axis=None))
    position = np.array(params[key]).reshape(-1, 3)
    g = np.array(dr.grad(params[key])).reshape(-1, 3)
    _, place = np.unique(position.round(5), axis=0, return_inverse=True)
    touched = np.abs(g).max(1) > 0
    assert np.isfinite(g).all()
    assert max(np.count_nonzero(touched[place.ravel() == i]) for i in range(8)) > 1


HARD = {
    "in the plane of the eye": [[0, 1, -5], [1, 0, -5], [0, 0, -5]],
    "behind the camera": [[0, 1, -7], [1, 0, -7], [0, 0, -7]],
    "vertex at the eye": [[0, 0, -5], [1, 0, 0], [0, 1, 0]],
    "edge on the line of sight": [[0, 0, -4], [0, 0, 0], [0, 1, 0]],
    "no area": [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
    "larger than the frame": [[-9, -9, 0], [9, -9, 0], [0, 9, 0]],
}


@pytest.mark.parametrize("key", ["triangle.vertex_positions", "sensor.to_world"])
@pytest.mark.parametrize("vertices", HARD.values(), ids=HARD.keys())
def test_hard_geometry_gives_finite_gradients(key, vertices):
    triangle = cases.mesh("triangle", vertices, [[0, 1, 2]], bsdf=cases.diffuse(0.5))
    scene = cases.scene(sensor=cases.camera((0, 0, -5)), triangle=triangle, environment=cases.constant())
    motion = Motion(scene, key, direction=[1, 0, 0])
    assert np.isfinite(jacobian_times(scene, motion)).all()
    assert np.isfinite(gradient(scene, motion, np.ones((cases.RES, cases.RES, 3), np.float32)))


def test_without_interior_samples_the_filter_still_normalises():
    scene = cases.cube(lambda: cases.camera(film=cases.film("gaussian")))()
    motion = Motion(scene, **cases.SIDE)
    whole = np.mean([jacobian_times(scene, motion, spp=64, seed=i, sppi=0) for i in range(8)], 0)
    boundary = np.mean([jacobian_times(scene, motion, spp=64, seed=i, sppc=0, sppi=0) for i in range(8)], 0)
    # Under a constant environment, and translated, a convex cube of one colour has no interior derivative.
    assert np.abs(whole - boundary).sum() < 0.03 * np.abs(whole).sum()


@pytest.mark.parametrize("other_variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_agree_with_rgb(other_variant):
    rgb = average_derivative()
    mi.set_variant(other_variant)
    try:
        other = average_derivative()
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert np.abs(other - rgb).sum() < 0.05 * np.abs(rgb).sum()


def average_derivative() -> np.ndarray:
    """Summed over channels; grey scene, so that mono and spectral rendering mean the same."""
    scene = cases.cube(lambda: cases.camera(film=cases.film(pixel_format="luminance")))()
    motion = Motion(scene, **cases.DEPTH)
    return np.mean([jacobian_times(scene, motion, spp=64, seed=i, sppi=0) for i in range(8)], 0)


def test_alpha_has_a_derivative():
    scene = cases.scene(sensor=cases.camera(film=cases.film(pixel_format="rgba")), cube=cases.welded_cube())
    motion = Motion(scene, **cases.SIDE)
    images = [mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=4096)]
    J = np.mean([jacobian_times(scene, motion, spp=256, seed=i) for i in range(4)], 0)[..., 3]
    for theta in (0.02, -0.02):
        motion.apply(theta)
        images.append(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=4096))
    expected = (np.array(images[1]) - np.array(images[2]))[..., 3] / 0.04
    assert np.abs(J - expected).sum() < 0.1 * np.abs(expected).sum()


# ---------------------- Refusals and warnings ----------------------


def moving(scene, key, **motion):
    return derivative_image(scene, integrator(), Motion(scene, key, **motion), spp=4)


def test_instances_of_other_shapes_than_meshes_must_stand_still():
    group = {"type": "shapegroup", "inner": cases.smooth_cube(), "other": {"type": "sphere"}}
    scene = cases.scene(
        sensor=cases.camera(),
        group=group,
        copy={"type": "instance", "id": "copy", "r": {"type": "ref", "id": "group"}},
        environment=cases.constant(),
    )
    with pytest.raises(RuntimeError, match=r'shape "copy" \(Instance\) moves'):
        moving(scene, "copy.to_world", direction=[1, 0, 0])
    with pytest.raises(RuntimeError, match='camera moves past "copy"'):
        moving(scene, "sensor.to_world", direction=[1, 0, 0])


def test_meshes_in_a_shape_group_must_stand_still():
    group = {"type": "shapegroup", "inner": cases.smooth_cube()}
    copy = {"type": "instance", "r": {"type": "ref", "id": "group"}}
    scene = cases.scene(sensor=cases.camera(), group=group, copy=copy, environment=cases.constant())
    with pytest.raises(RuntimeError, match=r'"inner" \(Cube\) moves'):
        moving(scene, "group.inner.vertex_positions", direction=[1, 0, 0])


def test_negative_sample_count_is_refused():
    with pytest.raises(RuntimeError, match='direct_edge: "sppi" must be a whole number >= 0, got -4'):
        integrator(sppi=-4)


def test_polarised_variants_are_refused():
    mi.set_variant("llvm_ad_spectral_polarized")
    try:
        with pytest.raises(RuntimeError, match="polarised variants are not supported"):
            integrator()
    finally:
        mi.set_variant("llvm_ad_rgb")


def warnings_of(scene, key, options, **motion) -> str:
    """Of the search for boundaries, which each derivative begins with."""
    θ, it = mi.Float(0), integrator(**options)
    dr.enable_grad(θ)
    Motion(scene, key, **motion).apply(θ)
    with cases.messages() as found:
        for _ in range(2):
            it.find_boundaries(scene)
    return "\n".join(m for m in found if "_edge: " in m or "rig: " in m)


def test_limits_are_warned_about_once():
    projector = lambda: {
        "type": "projector",
        "to_world": mi.ScalarTransform4f().look_at([0, 4, -3], [0, 0, 0], [0, 1, 0]),
        "irradiance": {"type": "checkerboard"},
    }
    mirror = lambda: cases.horizontal((0, -1.5, 0), 2, "mirror", bsdf={"type": "conductor"})
    scene, rig = cases.cube(lamp=projector, mirror=mirror)(), {"type": "rig", "max_depth": 3}
    text = warnings_of(scene, "cube.vertex_positions", rig, direction=[1, 0, 0])
    assert text.count("the derivative lacks the motion of what perfect mirrors and glass show") == 1
    without = warnings_of(scene, "cube.vertex_positions", {**rig, "sppi": 0}, direction=[1, 0, 0])
    assert "perfect mirrors" not in without
    for other in ({"type": "direct_edge"}, {**rig, "type": "prb_edge"}, {**rig, "type": "bdpt_edge"}):
        found = warnings_of(scene, "cube.vertex_positions", other, direction=[1, 0, 0])
        assert "outlines" not in found and "what perfect mirrors" not in found


def test_normal_maps_are_warned_about_in_indirect_light_only():
    slopes = mi.Bitmap(np.full((4, 4, 3), [0.6, 0.5, 0.9], np.float32))
    slopes = {"type": "bitmap", "bitmap": slopes, "raw": True}
    bsdf = {"type": "normalmap", "normalmap": slopes, "bsdf": {"type": "diffuse"}}
    lamp = {"type": "point", "position": [0, 4, -4], "intensity": 5.0}
    scene = cases.scene(sensor=cases.camera(), thing={"type": "sphere", "bsdf": bsdf}, lamp=lamp)
    lacking = "turn away from what they light"
    assert lacking not in warnings_of(scene, "thing.to_world", {}, direction=[1, 0, 0])
    assert lacking in warnings_of(scene, "thing.to_world", {"type": "prb_edge", "max_depth": 3}, direction=[1, 0, 0])


@pytest.mark.parametrize(
    ("lamp", "hard"),
    [
        ({"type": "spot"}, False),
        ({"type": "spot", "cutoff_angle": 20.0, "beam_width": 20.0}, True),
        ({"type": "projector", "irradiance": {"type": "rgb", "value": 1.0}}, True),
    ],
)
def test_rig_warns_of_borders_of_beams(lamp, hard):
    scene, border = cases.cube(lamp=lambda: lamp)(), 'the border of the beams of "lamp"'
    for options, warned in (({}, False), ({"type": "prb_edge", "max_depth": 3}, False), ({"type": "rig"}, hard)):
        text = warnings_of(scene, "cube.vertex_positions", options, direction=[1, 0, 0])
        assert (border in text) == warned


def test_a_scene_that_does_not_move_is_a_mistake():
    scene = cases.cube()()
    with pytest.raises(RuntimeError, match="none of the parameters carries a gradient"):
        integrator().render_forward(scene, mi.traverse(scene), spp=1)


@pytest.mark.parametrize("integrator", [{"type": "direct_edge"}, {"type": "prb_edge", "max_depth": 3}])
def test_gradients_are_the_sum_of_those_of_the_terms(integrator):
    """Where several meshes carry gradients, and one of them has interpolated normals. (Dr.Jit 1.5 loses what the
    interior gives to the others if it is differentiated together with the film boundary.)"""
    points, _, _, faces = ball(5)
    scene = cases.scene(
        sensor=cases.camera((0.6, 1.8, -3.6), fov=42, film=cases.film(width=16, height=16)),
        floor=cases.horizontal((0, -0.9, 0), 2, "floor", bsdf=cases.diffuse(0.6)),
        cube=cases.mesh("cube", 0.35 * cases.cube_vertices() - [0.5, 0, 0], cases.CUBE_FACES, bsdf=cases.diffuse(0.5)),
        ball=cases.mesh("ball", 0.4 * points + [0.8, 0.1, 0.3], faces, normals=True, bsdf=cases.diffuse(0.6)),
        lamp=cases.horizontal(
            (0.5, 2.2, 0), 0.4, "lamp", down=True, bsdf=cases.diffuse(0), emitter=cases.light(8, 7, 6)
        ),
    )
    keys = [f"{name}.vertex_positions" for name in ("cube", "ball")]
    weights = np.random.default_rng(0).uniform(-1, 1, (16, 16, 3)).astype(np.float32)

    def gradients(*terms):
        params = mi.traverse(scene)
        for key in keys:
            params[key] = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(params[key])
        params.update()
        options = {term: 0 for term in ("sppc", "sppp", "sppi") if term not in terms}
        it = mi.load_dict({**integrator, **options})
        it.render_backward(scene, params, mi.TensorXf(weights), seed=1, spp=16)
        return [np.array(dr.grad(params[key]), np.float64) for key in keys]

    together = gradients("sppc", "sppp", "sppi")
    alone = [gradients(term) for term in ("sppc", "sppp", "sppi")]
    for found, *parts in zip(together, *alone, strict=True):
        assert np.abs(found - sum(parts)).sum() < 1e-4 * np.abs(found).sum()
