"""`aov_edge`: depth, positions, normals, texture coordinates and masks, and their derivatives."""

from __future__ import annotations

import cases
import channels
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, camera, cube_vertices, diffuse, film, mesh, scene
from frozen import assert_frozen_is_unfrozen, first_cause

from rimlight import plan
from rimlight.checks import FiniteDifferences, Motion, compare, derivative_image

#: Largest relative L1 error of one channel; of those of `channels.REST`, which are noisier, the second.
RELATIVE, OF_THE_REST = 0.01, 0.02

#: Largest |z| of 4 × 4 pixels.
Z = 4

ALL = f"{channels.GEOMETRY}, {channels.REST}, pi:prim_index, si:shape_index"
IMAGE = {"type": "direct_edge"}


def aov_edge(aovs: str, **options) -> mi.Integrator:
    return mi.load_dict({"type": "aov_edge", "aovs": aovs, **options})


def lit(sensor=camera) -> mi.Scene:
    return channels.before_wall(cases.textured_cube, sensor, sky=cases.constant())()


def rendered(scene, integrator, **options) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, **{"spp": 16, "seed": 3, **options}))


# ---------------------- Derivatives ----------------------


@pytest.mark.parametrize("case", channels.CASES, ids=lambda c: c.name)
def test_agrees_with_finite_differences(case):
    derivatives, reference = case.derivatives(), case.reference()
    faults = []
    for name, part in case.integrator().layout(derivatives.shape[3]).items():
        of_channel = FiniteDifferences(
            reference.mean[..., part], reference.standard_error[..., part], reference.step_error[..., part], {}
        )
        agreement = compare(derivatives[..., part], of_channel)
        print(f"{case.name} {name}: {agreement}")
        found = agreement.faults()
        if agreement.relative > (OF_THE_REST if f"{name}:" in channels.REST else RELATIVE):
            found.append(f"its relative L1 error is {agreement.relative:.4f}")
        if agreement.square > Z:
            found.append(f"|z| of 4 × 4 pixels reaches {agreement.square:.1f}")
        faults += [f"{name}: {fault}" for fault in found]
    assert not faults


MOTIONS = {
    "shape": channels.TURN,
    "camera": cases.CAMERA_TURN,
    "field of view": cases.FIELD_OF_VIEW,
}


@pytest.mark.parametrize(
    ("motion", "rfilter", "image"),
    [("shape", "gaussian", IMAGE), ("camera", "box", None), ("field of view", "tent", None)],
)
def test_backward_is_the_transpose_of_forward(motion, rfilter, image):
    """⟨w, J v⟩ = ⟨Jᵀ w, v⟩, for each channel by itself."""
    scene = lit(lambda: camera(film=film(rfilter)))
    motion = Motion(scene, **MOTIONS[motion])
    integrator = aov_edge(f"{channels.GEOMETRY}, {channels.REST}, m:mask:thing", **({"image": image} if image else {}))
    forward = np.array(derivative_image(scene, integrator, motion, spp=4, seed=3), np.float64)
    weight = np.random.default_rng(0).normal(size=forward.shape)
    for name, part in integrator.layout(forward.shape[2]).items():
        of_channel = np.zeros(forward.shape, np.float32)
        of_channel[..., part] = weight[..., part]
        theta = mi.Float(0)
        dr.enable_grad(theta)
        motion.apply(theta)
        integrator.render_backward(scene, motion.params, mi.TensorXf(of_channel), spp=4, seed=3)
        dr.enqueue(dr.ADMode.Backward, motion.params[motion.key])
        dr.traverse(dr.ADMode.Backward)
        expected, size = (of_channel * forward).sum(), np.abs(of_channel * forward).sum()
        assert size > 0
        assert abs(dr.grad(theta)[0] - expected) < 1e-4 * size, name
    motion.apply(0.0)


@pytest.mark.parametrize("key", ["thing.vertex_positions", "sensor.to_world"])
@pytest.mark.parametrize("image", [{}, {"image": IMAGE}], ids=["dark", "lit"])
def test_frozen_is_unfrozen(key, image):
    """Without an image, the scene needs no light."""
    scene = channels.before_wall(cases.textured_cube, size=1.5, **({"sky": cases.constant()} if image else {}))()
    integrator = aov_edge("dd:depth, nn:sh_normal, gn:geo_normal, uv:uv, m:mask:thing, a:alpha", **image)
    assert_frozen_is_unfrozen(scene, integrator, key)


def test_terms_add_up():
    scene = channels.smooth_ball()()
    motion = Motion(scene, **channels.SIDE)
    of = lambda **counts: np.array(
        derivative_image(scene, aov_edge("dd:depth, m:mask:sphere", **counts), motion, spp=16, seed=1)
    )
    whole, interior, boundary = of(), of(sppp=0), of(sppc=0)
    np.testing.assert_allclose(interior + boundary, whole, atol=1e-4 * np.abs(whole).max())
    assert not interior[..., 1].any() and np.abs(interior[..., 0]).sum() > 0
    assert np.abs(boundary).sum((0, 1)).min() > 0


def test_labels_have_no_derivative_and_say_so():
    scene = channels.before_wall(cases.textured_cube)()
    with cases.messages() as log:
        derivative = derivative_image(
            scene, aov_edge("pi:prim_index, si:shape_index, dd:depth"), Motion(scene, **channels.TURN), spp=4
        )
    assert not np.array(derivative)[..., :2].any() and np.array(derivative)[..., 2].any()
    assert sum('"pi:prim_index", "si:shape_index" is taken to be 0' in text for text in log) == 1


def test_jumps_of_the_albedo_are_warned_about():
    checkers = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    scene = channels.before_wall(lambda: {**cases.smooth_cube(), "bsdf": checkers})()
    for aovs, warned in (("al:albedo", True), ("dd:depth", False)):
        with cases.messages() as log:
            derivative_image(scene, aov_edge(aovs), Motion(scene, **channels.TURN), spp=1)
        assert any("lacks the jumps of the textures" in text for text in log) == warned


# ---------------------- Images ----------------------

SENSORS = {
    "perspective": camera,
    "gaussian": channels.gaussian,
    "alpha": lambda: camera(film=film(pixel_format="rgba")),
    "luminance": lambda: camera(film=film(pixel_format="luminance")),
    "orthographic": cases.orthographic,
    "thin lens": cases.thin_lens,
    "fisheye": cases.fisheye,
    "batch": cases.batch,
}


@pytest.mark.parametrize("sensor", SENSORS)
def test_renders_what_aov_renders(sensor):
    scene = cases.cube(SENSORS[sensor], cases.textured_cube)()
    theirs, ours = (mi.load_dict({"type": kind, "aovs": ALL, "image": IMAGE}) for kind in ("aov", "aov_edge"))
    assert ours.aov_names() == theirs.aov_names()
    expected, found = rendered(scene, theirs), rendered(scene, ours)
    assert found.shape == expected.shape
    finite = np.isfinite(expected)  # Mitsuba's footprints are not where nothing is seen
    assert np.isfinite(found).all() and finite[..., : ours.layout(found.shape[2])["dx"].start].all()
    np.testing.assert_allclose(found[finite], expected[finite], rtol=1e-5, atol=1e-5)


FILMS = {
    **SENSORS,
    "crop window": lambda: camera(film={**film("gaussian"), **cases.CROP}),
    "border": cases.close_up_with_border,
}


@pytest.mark.parametrize("sensor", FILMS)
def test_masks_move_as_what_shines(sensor):
    """The mask of a shape is what `direct_edge` shows if only that shines; its derivative is tested for all sensors."""
    shining = {"bsdf": diffuse(0.0), "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}}
    thing = mesh("thing", cube_vertices(), CUBE_FACES, **shining)
    both = scene(sensor=FILMS[sensor](), thing=thing, wall={**channels.wall(3), "bsdf": diffuse(0.0)})
    motion = Motion(both, **channels.TURN)
    mask = np.array(derivative_image(both, aov_edge("m:mask:thing"), motion, spp=4))
    light = np.array(derivative_image(both, mi.load_dict({"type": "direct_edge", "sppi": 0}), motion, spp=4))
    assert np.abs(mask - light[..., :1]).sum() < 1e-3 * np.abs(mask).sum()


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants(variant):
    mi.set_variant(variant)
    try:
        scene = cases.cube()()
        images = [
            rendered(scene, mi.load_dict({"type": k, "aovs": "al:albedo, dd:depth"})) for k in ("aov", "aov_edge")
        ]
        np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5)
        motion = Motion(scene, "cube.vertex_positions", direction=[1, 0, 0])
        derivative = np.array(derivative_image(scene, aov_edge("al:albedo, dd:depth", image=IMAGE), motion, spp=4))
        assert np.isfinite(derivative).all() and np.abs(derivative).sum((0, 1)).min() > 0
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_masks_divide_what_is_seen():
    """Masks of all shapes add up to alpha, which is that of an image without an environment."""
    lamp = {"type": "point", "position": [0, 4, -5], "intensity": {"type": "rgb", "value": 9.0}}
    rgba = film("gaussian", pixel_format="rgba")
    pair = scene(sensor=camera(film=rgba), thing=cases.smooth_cube(), wall=channels.wall(1.5), lamp=lamp)
    integrator = aov_edge("a:alpha, t:mask:thing, w:mask:wall", image=IMAGE)
    image = rendered(pair, integrator)
    alpha, thing, wall = (integrator.channel(image, name)[..., 0] for name in ("a", "t", "w"))
    np.testing.assert_allclose(thing + wall, alpha, atol=1e-5)
    np.testing.assert_allclose(integrator.channel(image, "image")[..., 3], alpha, atol=1e-5)
    assert thing.max() > 0.99 and 0.01 < thing.mean() < wall.mean() + thing.mean() < 0.99


def test_a_mask_of_an_instance():
    T = mi.ScalarTransform4f
    group = {"type": "shapegroup", "inside": {"type": "sphere", "radius": 0.7}}
    twins = {
        name: {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": T().translate([x, 0, 0])}
        for name, x in (("left", -1), ("right", 1))
    }
    both = mi.load_dict({"type": "scene", "sensor": camera((0, 0, -5)), "group": group, **twins})
    image = rendered(both, aov_edge("l:mask:left, r:mask:right, a:alpha"))
    np.testing.assert_allclose(image[..., 0] + image[..., 1], image[..., 2], atol=1e-6)
    assert image[:, 16:, 0].any() != image[:, :16, 0].any() and image[..., 0].sum() > 10


def test_hidden_emitters_are_looked_through():
    lamp = {"type": "sphere", "center": [0.6, 0.8, -2], "radius": 0.3, "emitter": {"type": "area"}}
    aovs = "dd:depth, pp:position, m:mask:thing"
    without = channels.before_wall(cases.smooth_cube)()
    expected = rendered(without, aov_edge(aovs))
    both = scene(sensor=camera(), thing=cases.smooth_cube(), wall=channels.wall(12), lamp=lamp)
    np.testing.assert_allclose(rendered(both, aov_edge(aovs, hide_emitters=True)), expected, rtol=1e-3, atol=1e-3)
    assert np.abs(rendered(both, aov_edge(aovs)) - expected).max() > 0.5


def test_nested_images_are_those_of_the_integrators_alone():
    scene = lit()
    both = aov_edge("dd:depth", first=IMAGE, second={"type": "prb_edge", "max_depth": 3})
    image = rendered(scene, both)
    derivative = np.array(derivative_image(scene, both, Motion(scene, **channels.TURN), spp=16, seed=3))
    assert image.shape == derivative.shape == (32, 32, 7)
    for name, alone in (("first", IMAGE), ("second", {"type": "prb_edge", "max_depth": 3})):
        alone = mi.load_dict(alone)
        expected = (
            rendered(scene, alone),
            derivative_image(scene, alone, Motion(scene, **channels.TURN), spp=16, seed=3),
        )
        for found, wanted in zip((image, derivative), map(np.array, expected), strict=True):
            # Compiled together with others, the last bits of rays differ.
            assert np.abs(both.channel(found, name) - wanted).sum() < 1e-3 * np.abs(wanted).sum()
    np.testing.assert_allclose(both.channel(image, "dd"), rendered(scene, aov_edge("dd:depth")), rtol=1e-3)


def test_a_plan_has_the_terms_of_all():
    scene = channels.before_wall(cases.textured_cube)()
    found = plan(scene, ["thing.vertex_positions"], integrator=aov_edge("dd:depth", image=IMAGE), spp=4)
    assert found.term("interior of channels").samples == found.term("interior").samples == 4 * 32 * 32
    assert found.term("film boundary of channels").samples == found.term("film boundary").samples > 0


# ---------------------- What is refused ----------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, '"aovs" must list channels'),
        ({"aovs": 3}, '"aovs" must list channels'),
        ({"aovs": " "}, '"aovs" is empty'),
        ({"aovs": "depth"}, 'must consist of <name>:<type>, or <name>:mask:<id of a shape>, got "depth"'),
        ({"aovs": "m:mask"}, 'got "m:mask"'),
        ({"aovs": "d:depth:cube"}, 'got "d:depth:cube"'),
        ({"aovs": "d:deph"}, 'unknown type "deph", did you mean "depth"?'),
        ({"aovs": "d:depth, d:uv"}, "has a name twice"),
        ({"aovs": "d:depth", "d": {"type": "direct_edge"}}, 'the integrator and the channel "d" have one name'),
        ({"aovs": "d:depth", "sppc": -1}, '"sppc" must be a whole number >= 0, got -1'),
        ({"aovs": "d:depth", "spp": 4}, 'unknown property "spp"'),
    ],
)
def test_options_that_are_refused(options, says):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "aov_edge", **options})
    assert f"aov_edge: {says}" in str(error.value) or says in str(error.value)


def test_masks_of_unknown_shapes_are_refused():
    scene = channels.before_wall(cases.smooth_cube)()
    with pytest.raises(ValueError, match=r'asks for the shape "thng", .* did you mean "thing"'):
        aov_edge("m:mask:thng").render(scene, spp=1)
    merged = cases.scene(sensor=camera(), thing=cases.smooth_cube(), other={**channels.wall(3), "bsdf": diffuse(0.5)})
    with pytest.raises(ValueError, match="optimize=False"):
        aov_edge("m:mask:thing").render(merged, spp=1)


def test_special_films_are_refused():
    special = {"type": "specfilm", "width": 8, "height": 8, "band": {"type": "spectrum", "value": [(400, 1), (700, 1)]}}
    mi.set_variant("llvm_ad_spectral")
    try:
        with pytest.raises(RuntimeError, match="cannot hold channels, use a hdrfilm"):
            aov_edge("d:depth").render(cases.cube(lambda: camera(film=special))(), spp=1)
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_images_of_other_widths_are_refused():
    integrator = aov_edge("dd:depth, nn:sh_normal", image=IMAGE)
    assert integrator.layout(7) == {"image": slice(0, 3), "dd": slice(3, 4), "nn": slice(4, 7)}
    assert integrator.layout(8)["image"] == slice(0, 4)
    with pytest.raises(ValueError, match="an image with 2 channels is not one of this integrator"):
        integrator.layout(2)
    with pytest.raises(ValueError, match="an image with 5 channels is not one of this integrator"):
        aov_edge("dd:depth, nn:sh_normal").layout(5)
    with pytest.raises(ValueError, match='no channel "mm"; it has image, dd, nn'):
        integrator.channel(np.zeros((2, 2, 7)), "mm")


@pytest.mark.parametrize("inside", ["direct_edge", "prb_edge"])
def test_mitsubas_aov_around_ours_renders_but_raises_in_a_derivative(inside):
    scene = cases.cube()()
    integrator = mi.load_dict({"type": "aov", "aovs": "dd:depth", "image": {"type": inside}})
    motion = Motion(scene, "cube.vertex_positions", direction=[1, 0, 0])
    with pytest.raises(RuntimeError, match="Use aov_edge around it"):
        derivative_image(scene, integrator, motion, spp=1)
    params = mi.traverse(scene)
    dr.enable_grad(params["cube.vertex_positions"])
    params.update()
    image = mi.render(scene, params, integrator=integrator, spp=1)
    assert image.shape == (32, 32, 4)
    with pytest.raises(RuntimeError) as error:
        dr.backward(dr.mean(image, axis=None))
    assert "Use aov_edge around it" in first_cause(error.value)
