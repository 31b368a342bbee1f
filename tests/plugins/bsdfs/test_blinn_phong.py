"""`blinn_phong`: the model and its derivatives against double precision, its bounds, its sampling, and renders."""

from __future__ import annotations

import inspect
import re
import textwrap

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdfs import chi_squared, context, direction, interaction, random_directions, random_numbers

from rimlight.checks import Motion, derivative_image, finite_differences, mean_and_error, z_scores

ROUGHNESSES = [1e-4, 1e-3, 0.02, 0.1, 0.3, 0.6, 1.0]
ANGLES = [0.0, 30.0, 60.0, 80.0, 89.0, 89.9]
NAMES = "diffuse_reflectance", "specular_reflectance", "roughness"
GLOSSY, DIFFUSE = 0, 1

#: What has a denormal number as a factor is 0 in one thread, and up to this in another: Dr.Jit's own threads flush such
#: numbers to 0, and the main thread, which renders after a fit with one thread, does not.
FLUSHED = 1e-30


def material(kd=0.6, ks=0.3, r=0.2) -> dict:
    return {"type": "blinn_phong", **dict(zip(NAMES, (kd, ks, r), strict=True))}


def sample(bsdf, wi: np.ndarray, count: int, seed: int = 0, component: int | None = None):
    """Samples from one direction: what was sampled, and the weights."""
    si = interaction(np.broadcast_to(wi, (3, count)))
    return bsdf.sample(context(component), si, *random_numbers(count, seed))


def model(kd, ks, r, wi, wo) -> np.ndarray:
    """f · cos θₒ, as the manual has it, in double precision; complex arguments give derivatives."""
    alpha, (cos_i, cos_o) = 2 / r - 2, (wi[2], wo[2])
    h = wi + wo
    h = h / np.sqrt((h * h).sum(0))
    s = lambda cos: np.sqrt(cos * cos + r * (1 - cos * cos))
    F = ks + (1 - ks) * (1 - (h * wi).sum(0)) ** 5
    D = (alpha + 2) / (2 * np.pi) * h[2] ** alpha
    G = 2 * cos_i * cos_o / (cos_o * s(cos_i) + cos_i * s(cos_o))
    glossy = F * D * G / (4 * cos_i * cos_o)
    return cos_o * (glossy + kd / np.pi * (1 - ks) * (1 - (1 - cos_i) ** 5) * (1 - (1 - cos_o) ** 5))


# ---------------------- The model ----------------------


@pytest.mark.parametrize("r", ROUGHNESSES)
def test_value(r):
    wi, wo = random_directions(4096)
    bsdf = mi.load_dict(material(0.6, 0.3, r))
    value = np.array(bsdf.eval(context(), interaction(wi), mi.Vector3f(np.float32(wo))))
    np.testing.assert_allclose(value[0], model(0.6, 0.3, r, wi, wo), rtol=5e-3, atol=1e-6)


@pytest.mark.parametrize("r", [1e-3, 0.02, 0.3, 1.0])
@pytest.mark.parametrize("name", [*NAMES, "wi", "wo"])
def test_derivative(name, r):
    """Complex steps are exact to rounding."""
    wi, wo = random_directions(4096, seed=1)
    arguments = {"diffuse_reflectance": 0.6, "specular_reflectance": 0.3, "roughness": r, "wi": wi, "wo": wo}
    step = np.array(1e-30j)
    if name in ("wi", "wo"):  # the direction turns
        axis = np.cross(arguments[name].T, [0.3, 0.5, 0.8]).T
        step = step * axis
    expected = model(*{**arguments, name: arguments[name] + step}.values()).imag / 1e-30

    bsdf, si, wo = mi.load_dict(material(0.6, 0.3, r)), interaction(wi), mi.Vector3f(np.float32(wo))
    t = mi.Float(0)
    dr.enable_grad(t)
    dr.set_grad(t, 1)
    if name == "wi":
        si.wi += t * mi.Vector3f(np.float32(axis))
    elif name == "wo":
        wo += t * mi.Vector3f(np.float32(axis))
    else:
        params = mi.traverse(bsdf)
        params[f"{name}.value"] = mi.Float(arguments[name]) + t
        params.update()
    value = bsdf.eval(context(), si, wo).x
    derivative = np.array(dr.forward_to(value))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(derivative, expected, rtol=0.01, atol=2e-5 * scale)


@pytest.mark.parametrize("r", ROUGHNESSES)
def test_reciprocal(r):
    wi, wo = random_directions(4096, seed=2)
    bsdf = mi.load_dict(material(r=r))
    there = np.array(bsdf.eval(context(), interaction(wi), mi.Vector3f(np.float32(wo)))) / wo[2]
    back = np.array(bsdf.eval(context(), interaction(wo), mi.Vector3f(np.float32(wi)))) / wi[2]
    np.testing.assert_allclose(there, back, rtol=1e-3, atol=1e-6)
    assert there.max() > 0.1


@pytest.mark.parametrize(("kd", "ks"), [(1, 0), (1, 0.04), (1, 0.5), (1, 1), (0, 1)])
def test_no_more_light_than_came(kd, ks):
    """The directional albedo, of all roughnesses and angles. The bound is nearly reached."""
    largest, count = 0, 1 << 16
    for r in ROUGHNESSES:
        bsdf = mi.load_dict(material(kd, ks, r))
        for angle in ANGLES:
            weight = np.array(sample(bsdf, direction(angle), count)[1][0])
            albedo, error = weight.mean(), weight.std() / np.sqrt(count)
            assert albedo <= 1 + 4 * error + 1e-5, (r, angle)
            largest = max(largest, albedo)
    assert largest > 0.95


def test_albedo_by_quadrature():
    """As the manual has it, and without any sampling: a white metal reflects 98 %, 55 %, and 31 %."""
    n = 400
    theta, phi = np.meshgrid((np.arange(n) + 0.5) * 90 / n, (np.arange(n) + 0.5) * 360 / n)
    wo = direction(theta.ravel(), phi.ravel())
    solid_angle = np.sqrt(1 - wo[2] ** 2) * (np.pi / 2 / n) * (2 * np.pi / n)
    si = interaction(np.broadcast_to(direction(0.0), wo.shape))
    albedo = lambda **kwargs: (
        np.array(mi.load_dict(material(**kwargs)).eval(context(), si, mi.Vector3f(np.float32(wo))))[0] @ solid_angle
    )
    assert [round(albedo(ks=1, r=r), 2) for r in (0.1, 0.5, 1.0)] == [0.98, 0.55, 0.31]
    assert albedo(kd=1, ks=0, r=0.05) == pytest.approx(20 / 21, abs=1e-3)


def test_black_behind():
    bsdf = mi.load_dict(material())
    below, above = direction(120.0), direction(40.0)
    for wi, wo in ((below, above), (above, below), (below, below)):
        value, pdf = bsdf.eval_pdf(context(), interaction(wi), mi.Vector3f(np.float32(wo)))
        assert np.all(np.array(value) == 0) and pdf[0] == 0
        assert np.all(np.array(sample(bsdf, below, 64)[1]) == 0)


@pytest.mark.parametrize("r", [1e-4, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize(("kd", "ks"), [(0, 0), (0.5, 0.04), (1, 1), (-0.2, 1.3)])
def test_finite(kd, ks, r):
    """Value, density, sample and all gradients; on the horizon, beyond it, towards each other, and where an optimiser
    has left the range of the reflectances."""
    angles = np.array([0, 1e-4, 1, 45, 89, 89.999, 90 - 1e-6, 90, 90 + 1e-6, 91, 180])
    i, o, phi = (a.ravel() for a in np.meshgrid(angles, angles, [0, 1e-3, 90, 179.999, 180]))
    bsdf, si = mi.load_dict(material(r=r)), interaction(direction(i))
    wo, weight_of = mi.Vector3f(np.float32(direction(o, phi))), random_numbers(len(i))
    params = mi.traverse(bsdf)
    for name, value in zip(NAMES, (kd, ks, r), strict=True):
        params[f"{name}.value"] = mi.Float(value)
    leaves = [*(params[f"{name}.value"] for name in NAMES), si.wi, wo]
    dr.enable_grad(leaves)
    params.update()
    value, pdf = bsdf.eval_pdf(context(), si, wo)
    bs, weight = bsdf.sample(context(), si, *weight_of)
    assert np.all(np.array(pdf) >= 0) and np.all(np.array(bs.pdf) >= 0)
    results = [value, pdf, bs.wo, bs.pdf, weight]
    dr.backward(dr.sum(value + weight, axis=None))
    for a in [*results, *map(dr.grad, leaves)]:
        assert np.isfinite(np.array(a)).all()
    assert dr.grad(leaves[1])[0] != 0


# ---------------------- Sampling ----------------------


DENSITIES = [
    (0.01, 20.0, 0.5, 0.5, None),
    (0.01, 85.0, 0.5, 0.04, GLOSSY),
    (0.1, 0.0, 0.5, 0.5, None),
    (0.1, 70.0, 0.0, 1.0, None),
    (0.3, 45.0, 0.5, 0.5, GLOSSY),
    (0.3, 88.0, 0.8, 0.04, None),
    (0.6, 60.0, 0.3, 0.3, None),
    (1.0, 30.0, 0.3, 0.3, DIFFUSE),
    (1.0, 80.0, 0.3, 0.3, None),
]


@pytest.mark.parametrize(("r", "angle", "kd", "ks", "component"), DENSITIES)
def test_samples_have_their_density(r, angle, kd, ks, component):
    test = chi_squared(mi.load_dict(material(kd, ks, r)), angle, component)
    assert test.run(test_count=len(DENSITIES), quiet=True), test.messages


def test_a_wrong_density_is_noticed():
    bsdf, other = (mi.load_dict(material(r=r)) for r in (0.3, 0.35))
    assert not chi_squared(bsdf, 30.0, GLOSSY, other).run(quiet=True)


@pytest.mark.parametrize("component", [None, GLOSSY, DIFFUSE])
@pytest.mark.parametrize("r", ROUGHNESSES)
def test_samples_agree_with_values(r, component):
    bsdf, count = mi.load_dict(material(1.0, 0.04, r)), 4096
    for angle in ANGLES:
        bs, weight = sample(bsdf, direction(angle), count, component=component)
        si = interaction(np.broadcast_to(direction(angle), (3, count)))
        value, pdf = bsdf.eval_pdf(context(component), si, bs.wo)
        np.testing.assert_allclose(value, bsdf.eval(context(component), si, bs.wo), rtol=0, atol=FLUSHED)
        np.testing.assert_allclose(pdf, bsdf.pdf(context(component), si, bs.wo), rtol=0, atol=FLUSHED)
        valid = np.array(bs.pdf) > 0
        np.testing.assert_allclose(np.array(bs.pdf)[valid], np.array(pdf)[valid], rtol=1e-5)
        np.testing.assert_allclose(np.array(weight)[:, valid], np.array(value / pdf)[:, valid], rtol=1e-4, atol=1e-7)
        assert np.all(np.array(weight)[:, ~valid] == 0) and valid.mean() > 0.4
        assert np.array(weight).max() < 3
        chosen = np.array(bs.sampled_component)
        types = np.where(chosen == GLOSSY, +mi.BSDFFlags.GlossyReflection, +mi.BSDFFlags.DiffuseReflection)
        assert np.array_equal(bs.sampled_type, types)
        assert set(chosen) <= ({GLOSSY, DIFFUSE} if component is None else {component})


@pytest.mark.parametrize("name", NAMES)
def test_derivative_of_samples_has_no_bias(name):
    """The mean derivative of the weights is that of the albedo, although their density depends on the parameter."""
    count, h = 1 << 18, 0.02
    values = dict(zip(NAMES, (0.6, 0.3, 0.2), strict=True))
    bsdf = mi.load_dict(material(*values.values()))
    params = mi.traverse(bsdf)
    t = mi.Float(0)
    dr.enable_grad(t)
    dr.set_grad(t, 1)
    params[f"{name}.value"] = mi.Float(values[name]) + t
    params.update()
    weight = sample(bsdf, direction(50.0), count)[1].x
    derivative = np.array(dr.forward_to(weight))

    n = 500
    theta, phi = np.meshgrid((np.arange(n) + 0.5) * 90 / n, (np.arange(n) + 0.5) * 360 / n)
    wo = direction(theta.ravel(), phi.ravel())
    solid_angle = np.sqrt(1 - wo[2] ** 2) * (np.pi / 2 / n) * (2 * np.pi / n)
    albedo = lambda v: model(*{**values, name: v}.values(), direction(50.0), wo) @ solid_angle
    expected = (albedo(values[name] + h) - albedo(values[name] - h)) / (2 * h)
    error = derivative.std() / np.sqrt(count)
    assert abs(derivative.mean() - expected) < 4 * error + 1e-3 * abs(expected)
    assert error < 0.05 * abs(expected)


# ---------------------- Components, flags, parameters ----------------------


def test_components_add_up():
    wi, wo = random_directions(256)
    bsdf, si, wo = mi.load_dict(material()), interaction(wi), mi.Vector3f(np.float32(wo))
    value = lambda *c: np.array(bsdf.eval(context(*c), si, wo))
    assert np.all(value(GLOSSY) > 0) and np.all(value(DIFFUSE) > 0)
    np.testing.assert_allclose(value(GLOSSY) + value(DIFFUSE), value(), rtol=1e-5)
    by_type = context()
    by_type.type_mask = mi.BSDFFlags.DiffuseReflection
    assert np.array_equal(bsdf.eval(by_type, si, wo), value(DIFFUSE))
    by_type.type_mask = mi.BSDFFlags.DeltaReflection
    assert np.all(np.array(bsdf.eval(by_type, si, wo)) == 0)
    assert np.all(np.array(bsdf.sample(by_type, si, *random_numbers(256))[1]) == 0)


def bitmap(texels: np.ndarray) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.float32(texels)), "raw": True}


@pytest.mark.parametrize(
    ("name", "varying"), [(NAMES[0], {DIFFUSE}), (NAMES[1], {GLOSSY, DIFFUSE}), (NAMES[2], {GLOSSY})]
)
def test_flags(name, varying):
    flags = mi.BSDFFlags
    bsdf = mi.load_dict({**material(), name: bitmap(np.full((2, 2, 1), 0.5))})
    for component, kind in ((GLOSSY, flags.GlossyReflection), (DIFFUSE, flags.DiffuseReflection)):
        expected = kind | flags.FrontSide | (flags.SpatiallyVarying if component in varying else 0)
        assert bsdf.flags(component) == expected
    assert bsdf.component_count() == 2
    assert bsdf.flags() == bsdf.flags(GLOSSY) | bsdf.flags(DIFFUSE)


def test_parameters():
    bsdf = mi.load_dict(material(0.25, 0.5, 0.75))
    params = mi.traverse(bsdf)
    assert {key: value[0] for key, value in params} == {
        "diffuse_reflectance.value": 0.25,
        "specular_reflectance.value": 0.5,
        "roughness.value": 0.75,
    }
    assert all(params.flags(key) == mi.ParamFlags.Differentiable for key in params.properties)
    assert bsdf.eval_diffuse_reflectance(interaction(direction(0.0)))[0][0] == 0.25
    assert all(f"{name} = " in str(bsdf) for name in NAMES)


@pytest.mark.parametrize(
    ("name", "value", "interval"),
    [
        ("roughness", 2, "(0, 1]"),
        ("roughness", 0.0, "(0, 1]"),
        ("roughness", float("nan"), "(0, 1]"),
        ("diffuse_reflectance", 1.5, "[0, 1]"),
        ("specular_reflectance", -0.1, "[0, 1]"),
    ],
)
def test_numbers_out_of_range_are_refused(name, value, interval):
    with pytest.raises(RuntimeError, match=re.escape(f'blinn_phong: "{name}" must be in {interval}, got {value:g}')):
        mi.load_dict({"type": "blinn_phong", name: value})


def test_roughness_beyond_its_range_is_its_end():
    wi, wo = random_directions(64)
    value = lambda r: np.array(
        mi.load_dict({**material(), "roughness": bitmap(np.full((2, 2, 1), r))}).eval(
            context(), interaction(wi), mi.Vector3f(np.float32(wo))
        )
    )
    assert np.array_equal(value(-3), value(1e-4)) and np.array_equal(value(7), value(1))
    assert not np.allclose(value(1), value(0.5))


def test_tabs_of_the_manual_load():
    tabs = re.findall(
        r"\.\. code-tab:: (\w+)\n\n((?: {12}.*\n|\n)+)", inspect.getsource(type(mi.load_dict(material())))
    )
    (xml, python) = (textwrap.dedent(dict(tabs)[language]) for language in ("xml", "python"))
    for bsdf in (mi.load_string(xml.replace(">", ' version="3.0.0">', 1)), mi.load_dict(eval(f"{{{python}}}"))):
        params = mi.traverse(bsdf)
        np.testing.assert_allclose(params["brdf_0.roughness.value"], 0.05)
        np.testing.assert_allclose(np.array(params["brdf_0.diffuse_reflectance.value"]).ravel(), [0.6, 0.2, 0.1])


# ---------------------- Other variants ----------------------


@pytest.mark.parametrize("other_variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_agree_with_rgb(other_variant):
    def grey():
        wi, wo = random_directions(256)
        bsdf, si = mi.load_dict(material()), interaction(wi)
        value, pdf = bsdf.eval_pdf(context(), si, mi.Vector3f(np.float32(wo)))
        bs, weight = bsdf.sample(context(), si, *random_numbers(256))
        return [np.array(a) for a in (value[0], pdf, bs.wo, bs.pdf, weight[0])]

    rgb = grey()
    mi.set_variant(other_variant)
    try:
        other = grey()
    finally:
        mi.set_variant("llvm_ad_rgb")
    for a, b in zip(rgb, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_polarised_variants_are_refused():
    mi.set_variant("llvm_ad_spectral_polarized")
    try:
        with pytest.raises(RuntimeError, match="blinn_phong: polarised variants are not supported"):
            mi.load_dict({"type": "blinn_phong"})
    finally:
        mi.set_variant("llvm_ad_rgb")


# ---------------------- In renders ----------------------


def textured_room() -> mi.Scene:
    """A floor with a bitmap for each parameter, on which a cube throws a shadow."""
    rng = np.random.default_rng(5)
    floor = {
        "type": "blinn_phong",
        "diffuse_reflectance": bitmap(rng.uniform(0.2, 0.8, (4, 4, 3))),
        "specular_reflectance": bitmap(rng.uniform(0.1, 0.6, (4, 4, 3))),
        "roughness": bitmap(rng.uniform(0.1, 0.5, (4, 4, 1))),
    }
    sensor = lambda: cases.camera(film=cases.film(width=16, height=16))
    return cases.room(sensor, lambda: {"type": "twosided", "material": floor})()


class Texels:
    """Those of a bitmap on the floor, which change along a random direction."""

    def __init__(self, scene: mi.Scene, name: str):
        self.params = mi.traverse(scene)
        (self.key,) = (key for key, _ in self.params if key.endswith(f"{name}.data"))
        self.initial = mi.TensorXf(self.params[self.key])
        self.direction = np.random.default_rng(6).uniform(0.5, 1, self.initial.shape).astype(np.float32)

    def apply(self, theta: mi.Float | float) -> None:
        self.params[self.key] = self.initial + mi.TensorXf(self.direction) * theta
        self.params.update()

    def derivative_image(self, scene, integrator, seed: int) -> np.ndarray:
        theta = mi.Float(0)
        dr.enable_grad(theta)
        self.apply(theta)
        dr.forward(theta, dr.ADFlag.ClearEdges)
        return np.array(integrator.render_forward(scene, self.params, seed=seed, spp=64))


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge"])
@pytest.mark.parametrize("name", NAMES)
def test_textures_in_a_render(name, kind):
    """Against finite differences of the integrator's own images; and forward against backward."""
    scene, step, seeds = textured_room(), 0.02, range(8)
    integrator = mi.load_dict({"type": kind, **({"max_depth": 3} if kind == "prb_edge" else {})})
    texels = Texels(scene, name)
    J = np.array([texels.derivative_image(scene, integrator, seed) for seed in seeds])
    images = []
    for theta in (step, -step):
        texels.apply(theta)
        images.append(np.array([mi.render(scene, integrator=integrator, spp=1024, seed=i) for i in seeds]))
    mean, error = mean_and_error(J)
    reference, reference_error = mean_and_error((images[0] - images[1]) / (2 * step))
    z = z_scores(mean, error, reference, reference_error)
    sums = [a.sum((1, 2, 3), dtype=np.float64) for a in (J, (images[0] - images[1]) / (2 * step))]
    error = np.hypot(*(a.std(ddof=1) / np.sqrt(len(a)) for a in sums))
    J_sum, reference_sum = map(np.mean, sums)
    print(f"{name}, {kind}: sum {J_sum:.4g}, {reference_sum:.4g} ± {error:.2g}, largest |z| {np.abs(z).max():.2f}")
    assert np.abs(z).max() < 5
    assert abs(J_sum - reference_sum) < 4 * error and error < 0.025 * abs(reference_sum)

    weights = np.random.default_rng(7).uniform(size=J[0].shape).astype(np.float32)
    texels.apply(0.0)
    params, key = texels.params, texels.key
    dr.enable_grad(params[key])
    params.update()
    integrator.render_backward(scene, params, mi.TensorXf(weights), seed=0, spp=64)
    backward = (np.array(dr.grad(params[key])) * texels.direction).sum()
    assert backward == pytest.approx((weights * J[0]).sum(), rel=1e-3)


def test_shadows_and_reflections_move():
    """Of a blocker that stands on a glossy floor, before a light: edges are found through the lobe of the material."""
    scene = cases.scene(
        sensor=cases.camera((0, 2, -4), (0, -1, 0), film=cases.film(width=16, height=16)),
        floor=cases.horizontal((0, 0, 0), 4, "floor", bsdf=material(0.4, 0.5, 0.02)),
        blocker=cases.quad([-0.3, 0.2, 0.9], [0.2, 1.1, 0.1], [0.7, 0.1, 0], "blocker", bsdf=cases.diffuse(0.5)),
        light=cases.quad([-2, 0.1, 4], [0, 3, 0], [4, 0, 0], "light", emitter=cases.light(2, 2, 2)),
    )
    motion = Motion(scene, "blocker.vertex_positions", direction=[1, 0.2, 0])
    reference = finite_differences(scene, motion, step=0.01, runs=12, spp=1024, max_depth=3)
    integrator = mi.load_dict({"type": "prb_edge", "max_depth": 3})
    images = [np.array(derivative_image(scene, integrator, motion, spp=256, seed=i)) for i in range(8)]
    mean, error = mean_and_error(np.array(images))
    z = z_scores(mean, error, reference.mean, reference.standard_error, reference.step_error)
    relative = np.abs(mean - reference.mean).sum() / np.abs(reference.mean).sum()
    noise = np.sqrt(2 / np.pi) * np.hypot(error, reference.standard_error).sum() / np.abs(reference.mean).sum()
    print(f"relative L1 {relative:.4f}, of noise {noise:.4f}, largest |z| {np.abs(z).max():.2f}")
    assert np.abs(z).max() < 5 and relative < 1.5 * noise and noise < 0.08


def test_frozen():
    """`dr.freeze` finds its textures: a replay sees their new values."""
    scene = textured_room()
    texels, integrator = Texels(scene, "roughness"), mi.load_dict({"type": "path", "max_depth": 2})
    step = lambda scene, seed: mi.render(scene, integrator=integrator, spp=4, seed=seed)
    frozen, images = dr.freeze(step), []
    for i in range(4):
        texels.apply(dr.opaque(mi.Float, 0.1 * i))
        seed = dr.opaque(mi.UInt32, 3)
        images.append(np.array(frozen(scene, seed)))
        np.testing.assert_allclose(images[-1], np.array(step(scene, seed)), rtol=1e-4, atol=1e-5)
    assert frozen.n_recordings <= 2  # the first call makes the film's storage
    assert np.abs(images[3] - images[2]).max() > 1e-3
