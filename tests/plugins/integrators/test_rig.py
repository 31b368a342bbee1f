"""`rig`: layers equal to images of single lights, derivatives equal to theirs and to finite differences, refusals."""

from __future__ import annotations

import os
from collections.abc import Callable

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from frozen import STEPS, assert_frozen_is_unfrozen

from rimlight.checks import Motion, compare, derivative_image, mean_and_error, z_scores
from rimlight.exr import read_exr, read_layers, write_exr, write_layers


def rig(**options) -> mi.Integrator:
    return mi.load_dict({"type": "rig", **options})


def colour(*value: float) -> dict:
    return {"type": "rgb", "value": list(value)}


SUN = {"type": "directional", "direction": [0.5, -1, 0.3], "irradiance": colour(1, 0.6, 0.3)}
LAMP = {"type": "point", "position": [1.5, 3, -2], "intensity": colour(9, 8, 7)}


def panel() -> dict:
    to_world = mi.ScalarTransform4f().translate([-1, 4, -1]).rotate([1, 0, 0], 90).scale(0.7)
    return {"type": "rectangle", "to_world": to_world, "emitter": cases.light(12, 11, 10)}


def small_lights() -> dict[str, dict]:
    return {"sun": SUN, "lamp": LAMP}


def all_kinds() -> dict[str, dict]:
    return {"sun": SUN, "lamp": LAMP, "panel": panel(), "sky": cases.constant(0.3)}


def room(lights: dict[str, dict], rough: bool = False, film: dict | None = None) -> mi.Scene:
    """A cube with normals above a floor."""
    T = mi.ScalarTransform4f
    floor = {"type": "twosided", "bsdf": cases.conductor(0.3)} if rough else cases.diffuse(0.5, two_sided=True)
    return cases.scene(
        sensor=cases.camera(film=film or cases.film(width=16, height=16)),
        floor={
            "type": "rectangle",
            "to_world": T().translate([0, -2, 0]).rotate([1, 0, 0], -90).scale(4),
            "bsdf": floor,
        },
        cube=cases.smooth_cube(),
        **lights,
    )


def layer(image: np.ndarray, i: int) -> np.ndarray:
    return image[..., 3 * i : 3 * i + 3]


def runs(integrator, scene, seeds, spp=64) -> np.ndarray:
    return np.array([np.array(mi.render(scene, integrator=integrator, spp=spp, seed=s), np.float64) for s in seeds])


def derivatives(integrator, scene, motion, seeds, spp=64) -> np.ndarray:
    motion = Motion(scene, **motion)
    image = lambda seed: derivative_image(scene, integrator, motion, spp=spp, seed=seed)
    return np.array([np.array(image(seed), np.float64) for seed in seeds])


def gradient(integrator, scene, motion, weights, spp=16, seed=3) -> float:
    """dθ of Σ weights · layers, through backward mode."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    value = motion.params[motion.key]
    integrator.render_backward(scene, motion.params, mi.TensorXf(weights), seed=seed, spp=spp)
    dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    motion.apply(0.0)
    return dr.grad(theta)[0]


# ---------------------- Images ----------------------

FILMS: dict[str, Callable[[], dict]] = {
    **{
        name: (lambda name=name: cases.film(name, width=16, height=16))
        for name in ("box", "tent", "gaussian", "mitchell")
    },
    "crop": lambda: cases.film(
        "gaussian", width=20, height=16, crop_width=9, crop_height=7, crop_offset_x=5, crop_offset_y=4
    ),
    "border": lambda: cases.film("gaussian", width=12, height=10, sample_border=True),
}


@pytest.mark.parametrize("film", FILMS)
def test_layers_are_images_of_single_lights(film):
    """Of lights without size, with the random numbers of `direct_edge`; for every filter and part of the film."""
    image = np.array(mi.render(room(small_lights(), film=FILMS[film]()), integrator=rig(), spp=16, seed=1))
    for i, (name, light) in enumerate(small_lights().items()):
        scene = room({name: light}, film=FILMS[film]())
        expected = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct_edge"}), spp=16, seed=1))
        assert expected.max() > 0.05
        np.testing.assert_allclose(layer(image, i), expected, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"max_depth": 1},
        {"max_depth": 3},
        {"max_depth": 8, "rr_depth": 2},
        {"max_depth": 3, "hide_emitters": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("rough", [False, True])
def test_layers_agree_with_path(options, rough):
    lights = all_kinds()
    names = rig().light_names(room(lights))
    images = runs(rig(**options), room(lights, rough), range(16))
    path = mi.load_dict({"type": "path", **options})
    for name, light in lights.items():
        dark = {} if name == "panel" else {"panel": {k: v for k, v in panel().items() if k != "emitter"}}
        expected = runs(path, room({**dark, name: light}, rough), range(100, 116))
        i = names.index(name)
        assert expected.any() == layer(images, i).any()
        if not expected.any():
            continue
        z = z_scores(*mean_and_error(layer(images, i)), *mean_and_error(expected))
        assert np.abs(z).max() < 5, name
        assert np.mean(z**2) < 1.3, name


def test_subsets_of_lights_are_right_in_the_mean():
    lights = {f"light{i}": {**LAMP, "position": [1.5 - i, 3, -2 + 0.4 * i]} for i in range(7)}
    scene = room(lights)
    some = runs(rig(max_depth=3, lights_per_path=3), scene, range(32))
    everything = runs(rig(max_depth=3), scene, range(100, 108))
    z = z_scores(*mean_and_error(some), *mean_and_error(everything))
    assert np.abs(z).max() < 5
    assert np.mean(z**2) < 1.2
    assert (some.std(0) > 1.5 * everything.std(0)).mean() > 0.3  # it did leave lights out


@pytest.mark.parametrize("max_depth", [2, 3])
def test_an_emitter_of_several_lights_has_a_layer_for_each(max_depth):
    d = np.float32([[-0.5, 1, -0.3], [0.4, 0.8, -0.6], [0.1, 1, 0.2]])
    irradiance = np.float32([[1, 0.6, 0.3], [0.5, 1, 2], [2, 0.2, 0.1]])
    single = {
        f"light{i}": {"type": "directional", "direction": (-a).tolist(), "irradiance": colour(*map(float, b))}
        for i, (a, b) in enumerate(zip(d, irradiance, strict=True))
    }
    table = {"type": "distant_lights", "directions": mi.TensorXf(d), "irradiance": mi.TensorXf(irradiance)}
    scene = room({"lamp": LAMP, "table": table})
    assert rig().light_names(scene) == ["lamp", "table00", "table01", "table02"]
    image, expected = (
        np.array(mi.render(s, integrator=rig(max_depth=max_depth), spp=4, seed=2))
        for s in (scene, room({"lamp": LAMP, **single}))
    )
    assert expected[..., 3:].max() > 0.1
    np.testing.assert_allclose(image, expected, atol=1e-5)


def test_discs_have_layers_of_their_own():
    lights = {"type": "distant_lights", "directions": "-0.5 1 -0.3, 0.4 0.8 -0.6", "angular_radius": 5}
    scene = room({"discs": lights}, rough=True)
    images = runs(rig(max_depth=3, hide_emitters=True), scene, range(12))
    path = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    for i, direction in enumerate(lights["directions"].split(",")):
        expected = runs(path, room({"discs": {**lights, "directions": direction}}, rough=True), range(100, 112))
        z = z_scores(*mean_and_error(layer(images, i)), *mean_and_error(expected))
        assert expected.max() > 0.1
        assert np.abs(z).max() < 5
        assert np.mean(z**2) < 1.3


@pytest.mark.parametrize("lights", [small_lights, all_kinds])
def test_short_paths_are_left_out(lights):
    """What is left are the longer ones, with the same random numbers, also of emitters that rays hit."""
    scene = room(lights(), rough=True)
    image = lambda **options: np.array(rig(**options).render(scene, spp=16, seed=1))
    whole = image(max_depth=4)
    np.testing.assert_allclose(image(max_depth=4, min_depth=1), whole, atol=1e-6 * whole.max())
    for longest in (1, 2):
        rest = image(max_depth=4, min_depth=longest + 1)
        assert rest.max() > 0.01
        np.testing.assert_allclose(rest, whole - image(max_depth=longest), atol=1e-5 * whole.max())
    assert not image(max_depth=2, min_depth=3).any()
    with pytest.raises(RuntimeError, match=r'rig: derivatives are those of all light; leave out "min_depth" 3'):
        derivative_image(scene, rig(max_depth=4, min_depth=3), Motion(scene, **COLOUR), spp=1)


def test_monochrome():
    scene = room(small_lights())
    rgb = np.array(mi.render(scene, integrator=rig(), spp=64, seed=1))
    mi.set_variant("llvm_ad_mono")
    try:
        film = cases.film(width=16, height=16, pixel_format="luminance")
        scene = room(small_lights(), film=film)
        image = np.array(rig().render(scene, spp=64, seed=1))
        motion = Motion(scene, "cube.vertex_positions", direction=[1, 0.3, 0])
        J = np.array(derivative_image(scene, rig(max_depth=3), motion, spp=16, seed=3), np.float64)
        back = gradient(rig(max_depth=3), scene, motion, np.ones_like(J, np.float32))
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert image.shape == (16, 16, 2)
    luminance = rgb.reshape(16, 16, 2, 3) @ np.float32([0.212671, 0.715160, 0.072169])
    np.testing.assert_allclose(image, luminance, atol=1e-4 * luminance.max())  # all surfaces are grey
    assert np.abs(J).sum() > 0
    assert back == pytest.approx(J.sum(), rel=1e-3)


def test_memory_does_not_grow_with_the_product_of_paths_and_lights():
    """256 lights: less than half of one number for each pair of a path and a light."""
    directions = np.random.default_rng(0).normal(size=(256, 3)).astype(np.float32)
    lights = {"table": {"type": "distant_lights", "directions": mi.TensorXf(directions)}}
    scene = room(lights, film=cases.film(width=64, height=64))
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    image = mi.render(scene, integrator=rig(max_depth=3), spp=32)
    dr.eval(image)
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) < 0.5 * 64 * 64 * 32 * 256 * 4


# ---------------------- Derivatives ----------------------

SIDE = {"key": "cube.vertex_positions", "direction": [1, 0.3, 0]}
CAMERA = {"key": "sensor.to_world", "direction": [0, 1, 0]}
NORMALS = {"key": "cube.vertex_normals", "direction": [0.1]}
COLOUR = {"key": "cube.bsdf.reflectance.value", "direction": [1]}
PLACE = {"key": "lamp.position", "direction": [1, 0, 0.3]}
TURN = {"key": "sun.to_world", "rotate": [0, 0, 1]}
INTENSITY = {"key": "lamp.intensity.value", "direction": [1]}
PANEL = {"key": "panel.to_world", "direction": [1, 0, 0]}
RADIANCE = {"key": "panel.emitter.radiance.value", "direction": [1]}
SMALL = {"side": SIDE, "camera": CAMERA, "normals": NORMALS, "colour": COLOUR, "place": PLACE, "turn": TURN}

#: Lights, whether the floor is rough, and filters: each of them, not each with each other, since compiling takes 15 s.
LIT = [(small_lights, False, "gaussian"), (small_lights, True, "box"), (all_kinds, True, "gaussian")]
if "RIMLIGHT_FULL" in os.environ:
    LIT += [(small_lights, False, "box"), (small_lights, True, "gaussian"), (all_kinds, True, "box")]


@pytest.mark.parametrize(("lights", "rough", "film"), LIT)
def test_forward_and_backward_agree(lights, rough, film):
    scene, integrator = room(lights(), rough, FILMS[film]()), rig(max_depth=4, rr_depth=2)
    motions = [*SMALL.values(), INTENSITY] if lights is small_lights else [SIDE, CAMERA, COLOUR, PLACE, PANEL, RADIANCE]
    for motion in motions:
        motion = Motion(scene, **motion)
        J = np.array(derivative_image(scene, integrator, motion, spp=16, seed=3), np.float64)
        weights = np.random.default_rng(0).normal(size=J.shape).astype(np.float32)
        assert np.abs(J).sum() > 0
        expected, tolerance = (weights * J).sum(), 1e-4 * np.abs(weights * J).sum()
        assert gradient(integrator, scene, motion, weights) == pytest.approx(expected, abs=tolerance), str(motion)


def test_subset_of_lights_is_differentiated_alike():
    scene, integrator = room(all_kinds()), rig(max_depth=3, lights_per_path=2)
    for motion in (SIDE, COLOUR):
        motion = Motion(scene, **motion)
        J = np.array(derivative_image(scene, integrator, motion, spp=16, seed=3), np.float64)
        assert np.abs(J).sum() > 0
        back = gradient(integrator, scene, motion, np.ones_like(J, np.float32))
        assert back == pytest.approx(J.sum(), abs=1e-4 * np.abs(J).sum())


@pytest.mark.parametrize("motion", [SIDE, CAMERA, COLOUR, PANEL], ids=lambda m: m["key"])
def test_interior_of_one_light_is_that_of_direct_edge(motion):
    """With the same random numbers."""
    scene = room({"panel": panel()}, rough=True)
    interior = {"sppp": 0, "sppi": 0}
    of_rig, expected = (
        derivatives(mi.load_dict({"type": kind, **interior}), scene, motion, [5], spp=16)[0]
        for kind in ("rig", "direct_edge")
    )
    assert np.abs(expected).sum() > 0
    np.testing.assert_allclose(of_rig, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("lights", [small_lights, all_kinds])
@pytest.mark.parametrize("motion", [SIDE, CAMERA, COLOUR, NORMALS], ids=lambda m: m["key"])
def test_interior_agrees_with_prb_edge(lights, motion):
    """The sum of the layers, behind several vertices."""
    scene, interior = room(lights(), rough=True), {"max_depth": 4, "rr_depth": 3, "sppp": 0, "sppi": 0}
    layers = derivatives(rig(**interior), scene, motion, range(12))
    total = layers.reshape(*layers.shape[:-1], -1, 3).sum(-2)
    expected = derivatives(mi.load_dict({"type": "prb_edge", **interior}), scene, motion, range(100, 112))
    assert np.abs(expected.mean(0)).sum() > 0
    z = z_scores(*mean_and_error(total), *mean_and_error(expected))
    assert np.abs(z).max() < 5
    assert np.mean(z**2) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "step"),
    [(SIDE, 4e-3), (CAMERA, 4e-3), (NORMALS, 2e-2), (COLOUR, 2e-2), (PLACE, 1e-2), (TURN, 4e-3)],
    ids=lambda m: m["key"] if isinstance(m, dict) else str(m),
)
def test_finite_differences(motion, step):
    """Of each light's image, shadows and outlines included."""
    found = derivatives(rig(), room(small_lights()), motion, range(16), spp=32)
    for i, (name, light) in enumerate(small_lights().items()):
        scene = room({name: light})
        if motion["key"].startswith(tuple(small_lights())) and not motion["key"].startswith(name):
            assert not layer(found, i).any()
            continue
        file, motion_of_light = f"rig_{motion['key'].replace('.', '_')}_{name}", Motion(scene, **motion)
        reference = cases.stored_differences(
            file, [name, str(motion_of_light)], scene, motion_of_light, runs=8, step=step, spp=4096
        )
        agreement = compare(layer(found, i), reference)
        print(f"{name}: {agreement}")
        assert not agreement.zero and not agreement.faults(noise=0.1)


def test_terms_add_up():
    scene = room(small_lights())
    terms = [{"sppp": 0, "sppi": 0}, {"sppc": 0, "sppi": 0}, {"sppc": 0, "sppp": 0}, {}]
    *parts, total = (derivatives(rig(max_depth=3, **t), scene, SIDE, [3], spp=16)[0] for t in terms)
    assert all(np.abs(p).sum() > 0 for p in parts)
    assert np.abs(sum(parts) - total).max() < 1e-4 * np.abs(total).max()


def test_what_is_black_may_become_brighter():
    """A light without intensity and a colour of zero have derivatives."""
    lights = {"sun": SUN, "lamp": {**LAMP, "intensity": colour(0, 0, 0)}}
    scene = room(lights)
    J = derivatives(rig(), scene, INTENSITY, [0], spp=16)[0]
    assert J[..., 3:].max() > 0 and not J[..., :3].any()


# ---------------------- Frozen functions ----------------------


@pytest.mark.parametrize("options", [{"max_depth": 3}, {"max_depth": 3, "lights_per_path": 2}], ids=str)
@pytest.mark.parametrize("lights", [small_lights, all_kinds])
def test_frozen_images(lights, options):
    scene, integrator = room(lights()), rig(**options)
    render = lambda scene, integrator, seed: mi.render(scene, integrator=integrator, spp=4, seed=seed)
    frozen = dr.freeze(render)
    seeds = [dr.opaque(mi.UInt32, s) for s in range(STEPS)]
    expected, found = ([np.array(f(scene, integrator, s)) for s in seeds] for f in (render, frozen))
    assert np.abs(np.diff(expected, axis=0)).max() > 0
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert frozen.n_recordings <= 2  # the first call makes the film's storage


@pytest.mark.parametrize(
    "key", ["cube.vertex_positions", "sensor.to_world", "cube.bsdf.reflectance.value", "lamp.position"]
)
def test_frozen_steps(key):
    scene, integrator = room(small_lights()), rig(max_depth=3)
    assert_frozen_is_unfrozen(scene, integrator, key)


# ---------------------- Files ----------------------


def test_files_with_named_layers(tmp_path):
    scene = room({"sun": SUN, "lamp": LAMP})
    image = np.array(mi.render(scene, integrator=rig(), spp=1))
    write_layers(tmp_path / "rig.exr", image, rig().light_names(scene), {"spp": 1})
    found, names = read_layers(tmp_path / "rig.exr")
    np.testing.assert_array_equal(found, image)
    assert names == ["sun", "lamp"]  # not in the order of the alphabet
    layers, metadata = read_exr(tmp_path / "rig.exr")
    np.testing.assert_array_equal(layers["lamp"], layer(image, 1))
    assert metadata["spp"] == "1"


def test_files_that_cannot_be_are_refused(tmp_path):
    image = np.zeros((4, 4, 6), np.float32)
    for names, message in (
        (["a", "a"], "names that differ"),
        (["a", ""], "names that differ"),
        (["a"], "does not consist"),
    ):
        with pytest.raises(ValueError, match=message):
            write_layers(tmp_path / "a.exr", image, names)
    write_exr(tmp_path / "b.exr", {"": image[..., :3]})
    with pytest.raises(ValueError, match="order of the layers"):
        read_layers(tmp_path / "b.exr")


def test_names_of_shapes_that_emit():
    assert sorted(rig().light_names(room({"a": panel(), "b": panel(), "sun": SUN}))) == ["a", "b", "sun"]


# ---------------------- Refusals ----------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": -1}, '"max_depth" must be a whole number from 0 to 16, got -1'),
        ({"max_depth": 17}, '"max_depth" must be a whole number from 0 to 16, got 17'),
        ({"max_depth": 2.0}, '"max_depth" must be a whole number from 0 to 16, got 2.0'),
        ({"min_depth": -1}, '"min_depth" must be a whole number >= 0, got -1'),
        ({"rr_depth": 0}, '"rr_depth" must be a whole number >= 1, got 0'),
        ({"lights_per_path": -1}, '"lights_per_path" must be a whole number >= 0, got -1'),
        ({"sppp": -4}, '"sppp" must be a whole number >= 0, got -4'),
    ],
)
def test_impossible_parameters_are_refused(options, message):
    with pytest.raises(RuntimeError, match=f"rig: {message}"):
        rig(**options)


def test_impossible_scenes_are_refused():
    render = lambda lights, **options: rig(**options).render(room(lights), spp=1)
    with pytest.raises(RuntimeError, match="the scene has no lights"):
        render({})
    with pytest.raises(RuntimeError, match='only 2 of "lights_per_path" 3 lights'):
        render(small_lights(), lights_per_path=3)
    discs = {"type": "distant_lights", "directions": "0 1 0, 0 1 1", "angular_radius": 3}
    with pytest.raises(RuntimeError, match='set "hide_emitters"'):
        render({"discs": discs})
    with pytest.raises(RuntimeError, match="background"):
        render({"discs": {**discs, "background": colour(1, 1, 1)}}, hide_emitters=True)


def test_gradients_of_another_shape_are_refused():
    scene = room(small_lights())
    with pytest.raises(ValueError, match=r"shape \(16, 16, 6\), got \(16, 16, 3\)"):
        rig().render_backward(scene, mi.traverse(scene), mi.TensorXf(np.ones((16, 16, 3), np.float32)), spp=1)


def test_spectral_variants_are_refused():
    mi.set_variant("llvm_ad_spectral")
    try:
        with pytest.raises(RuntimeError, match="rig: spectral variants are not supported"):
            rig()
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_paths_go_where_the_density_is():
    """Images and derivatives stay right in the mean; where it is 0, nothing is rendered. Others are refused."""
    scene = room(small_lights())
    integrator, params = rig(max_depth=3), mi.traverse(scene)
    key = next(k for k in params.keys() if "reflectance" in k)  # noqa: SIM118
    height, width, _ = np.shape(integrator.render(scene, spp=1))
    density = 0.2 + np.random.default_rng(0).random((height, width))
    density[:, :4] = 0

    def measured(pixel_density) -> tuple[np.ndarray, np.ndarray]:
        integrator.pixel_density = pixel_density
        images = np.stack([np.array(integrator.render(scene, seed=s, spp=64)) for s in range(12)])[:, :, 4:]
        found = []
        for s in range(12):
            weights = np.ones_like(images[0], shape=(height, width, images.shape[-1]))
            weights[:, :4] = 0
            dr.enable_grad(params[key])
            params.update()
            integrator.render_backward(scene, params, mi.TensorXf(weights), seed=s, spp=64)
            found.append(np.array(dr.grad(params[key])).ravel())
            dr.disable_grad(params[key])
        return images.mean((1, 2)), np.stack(found)

    even, adapted = measured(None), measured(mi.Float(density.ravel().astype(np.float32)))
    for a, b in zip(even, adapted, strict=True):
        error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / len(a))
        assert np.all(np.abs(a.mean(0) - b.mean(0)) < 4 * error)
        assert np.all(error < 0.05 * np.abs(a.mean(0)))
    assert not np.array(integrator.render(scene, spp=4))[:, :4].any()
    integrator.pixel_density = mi.Float(1, 2, 3)
    with pytest.raises(RuntimeError, match=r'rig: "pixel_density" needs a box filter, and a number for each of'):
        integrator.render(scene, spp=1)
