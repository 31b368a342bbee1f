"""`ggx_dictionary`: lobes and derivatives against double precision, bounds, sampling, files and errors, and renders."""

from __future__ import annotations

import json
import re

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdfs import chi_squared, context, direction, interaction, random_directions, random_numbers, vector
from scipy import integrate

from rimlight import ggx

NAN = float("nan")
ALPHAS = [0.003, 0.01, 0.05, 0.2, 0.5, 1.0]
ETAS = [1.05, 1.5, 20.0]
LOBES = ggx.Lobes((*np.repeat(ALPHAS, 3).tolist(), NAN, NAN, NAN), (*ETAS * len(ALPHAS), 1.5, 4.0, NAN))
SMOOTH = ggx.Lobes((0.1, 0.2, NAN), (1.5, 3.0, NAN))
ROUGH = ggx.Lobes((0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, NAN, NAN), (1.5,) * 8 + (NAN,))
GLOSSY, DIFFUSE = 0, 1


def tensor(weights) -> mi.TensorXf:
    weights = np.asarray(weights)
    return mi.TensorXf(mi.Float(weights.ravel().tolist()), shape=weights.shape)


def material(weights, lobes: ggx.Lobes = LOBES) -> dict:
    return {
        "type": "ggx_dictionary",
        "weights": tensor(weights),
        "alpha": mi.Float(lobes.alpha),
        "eta": mi.Float(lobes.eta),
    }


def random_weights(lobes: ggx.Lobes = LOBES, seed: int = 0) -> np.ndarray:
    """(B, 3); each colour sums to 1."""
    weights = np.random.default_rng(seed).uniform(0.1, 1, (len(lobes), 3))
    return weights / weights.sum(0)


def one_lobe(alpha: float, eta: float, weight: float = 1.0) -> mi.BSDF:
    return mi.load_dict(material(np.full((1, 1), weight), ggx.Lobes((alpha,), (eta,))))


def model(alpha, eta, wi, wo) -> np.ndarray:
    """A lobe as in section 3.4 of Bangaru 2019, or a diffuse one, in double precision; complex arguments give
    derivatives."""
    if np.isnan(eta):
        return 0 * wi[2] + 1 / np.pi
    if np.isnan(alpha):
        mean, _ = integrate.quad(lambda c: 2 * c * fresnel(eta, c), 0, 1, epsabs=1e-12)
        return (1 - fresnel(eta, wi[2])) * (1 - fresnel(eta, wo[2])) / (np.pi * (1 - mean))
    h = wi + wo
    h = h / np.sqrt((h * h).sum(0))
    nl, nv, c = wi[2], wo[2], (wi * h).sum(0)
    D = alpha**2 / (np.pi * (h[2] ** 2 * (alpha**2 - 1) + 1) ** 2)
    G1 = lambda nv: 2 * nv / (nv + np.sqrt(alpha**2 + (1 - alpha**2) * nv**2))
    return D * fresnel(eta, c) * G1(nl) * G1(nv) / (4 * nl * nv)


def fresnel(eta: float, c):
    g = np.sqrt(eta**2 + c**2 - 1)
    return 0.5 * ((g - c) / (g + c)) ** 2 * (1 + (((g + c) * c - 1) / ((g - c) * c + 1)) ** 2)


# ---------------------- The model ----------------------


def test_lobes():
    """Each, in single precision: at the smallest alpha, too, where the peak is 0.01 wide."""
    wi, wo = random_directions()
    values = np.array(ggx.lobes(LOBES, vector(wi), vector(wo)))
    assert values.shape == (len(LOBES), 4096)
    for value, alpha, eta in zip(values, LOBES.alpha, LOBES.eta, strict=True):
        np.testing.assert_allclose(value, model(alpha, eta, wi, wo), rtol=2e-4 if alpha > 0.02 else 1e-3, atol=1e-7)


def test_value_is_the_weighted_sum():
    weights = random_weights()
    wi, wo = random_directions()
    bsdf = mi.load_dict(material(weights))
    value = np.array(bsdf.eval(context(), interaction(wi), vector(wo)))
    expected = weights.T @ [model(*lobe, wi, wo) for lobe in zip(LOBES.alpha, LOBES.eta, strict=True)] * wo[2]
    np.testing.assert_allclose(value, expected, rtol=5e-3)
    assert not np.allclose(value[0], value[1], rtol=0.05)


@pytest.mark.parametrize(("alpha", "eta"), [(0.003, 1.5), (0.01, 1.5), (0.05, 1.05), (0.2, 20.0), (1.0, 1.5)])
@pytest.mark.parametrize("name", ["wi", "wo", "normal"])
def test_derivative_by_directions(name, alpha, eta):
    """Complex steps are exact to rounding. When the normal turns, both directions turn in its frame."""
    wi, wo = random_directions(seed=1)
    turned = [np.cross(w.T, [0.3, 0.5, 0.8]).T * (name in (key, "normal")) for key, w in (("wi", wi), ("wo", wo))]
    wi_, wo_ = (w + 1e-30j * axis for w, axis in zip((wi, wo), turned, strict=True))
    expected = (model(alpha, eta, wi_, wo_) * wo_[2]).imag / 1e-30

    t = mi.Float(0)
    dr.enable_grad(t)
    dr.set_grad(t, 1)
    si, wo = interaction(wi), vector(wo)
    si.wi += t * vector(turned[0])
    wo += t * vector(turned[1])
    value = one_lobe(alpha, eta).eval(context(), si, wo).x
    derivative = np.array(dr.forward_to(value))
    np.testing.assert_allclose(derivative, expected, rtol=0.01, atol=2e-5 * np.abs(expected).max())


def test_derivative_by_normal_against_finite_differences():
    """In the plugin's own values, of a dictionary as fits have it; and backward as forward."""
    wi, wo = random_directions(256, seed=3)
    bsdf = mi.load_dict(material(random_weights(ROUGH), ROUGH))
    axis = np.array([0.6, -0.8, 0])

    def value(angle: mi.Float) -> mi.Float:
        turn = mi.Transform4f().rotate(mi.Vector3f(axis), angle)
        si = interaction(wi)
        si.wi = turn @ si.wi
        return mi.luminance(bsdf.eval(context(), si, turn @ vector(wo)))

    h = 0.02
    differences = [np.array(value(mi.Float(k * h)), np.float64) for k in (-2, -1, 1, 2)]
    expected = np.array([1, -8, 8, -1]) @ differences / (12 * h)
    t = mi.Float(0)
    dr.enable_grad(t)
    y = value(t)
    dr.forward(t, dr.ADFlag.ClearEdges)
    derivative = np.array(dr.grad(y))
    assert np.abs(derivative - expected).sum() < 0.01 * np.abs(expected).sum()
    t = mi.Float(0)
    dr.enable_grad(t)
    dr.backward(dr.sum(value(t)))
    assert dr.grad(t)[0] == pytest.approx(derivative.sum(), rel=1e-3)


def test_derivative_by_weights():
    """That of a lobe's weight is the lobe; in forward and in backward mode."""
    weights, (wi, wo) = random_weights(), random_directions(512)
    bsdf = mi.load_dict(material(weights))
    params = mi.traverse(bsdf)
    dr.enable_grad(params["weights"])
    params.update()
    direction_in_weights = random_weights(seed=1)
    dr.set_grad(params["weights"], tensor(direction_in_weights))
    value = bsdf.eval(context(), interaction(wi), vector(wo))
    forward = np.array(dr.forward_to(value, flags=dr.ADFlag.ClearInterior))
    lobes = np.array([model(*lobe, wi, wo) for lobe in zip(LOBES.alpha, LOBES.eta, strict=True)]) * wo[2]
    np.testing.assert_allclose(forward, direction_in_weights.T @ lobes, rtol=5e-3)

    dr.set_grad(params["weights"], 0)
    adjoint = np.random.default_rng(5).uniform(size=(3, 512)).astype(np.float32)
    dr.backward(dr.sum(bsdf.eval(context(), interaction(wi), vector(wo)) * mi.Color3f(adjoint), axis=None))
    np.testing.assert_allclose(np.array(dr.grad(params["weights"])), lobes @ adjoint.T, rtol=5e-3)


def test_gradient_by_weights_is_one_kernel():
    """All sums over the directions are in it. (A kernel for each weight would take ten times as long.)"""
    bsdf, (wi, wo) = mi.load_dict(material(random_weights())), random_directions(1000)
    params, si, wo = mi.traverse(bsdf), interaction(wi), vector(wo)
    dr.enable_grad(params["weights"])
    params.update()
    dr.eval(si, wo)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.backward(dr.sum(bsdf.eval(context(), si, wo), axis=None))
        dr.eval(dr.grad(params["weights"]))
        assert 0 < len(dr.kernel_history([dr.KernelType.JIT])) < 5


def test_reciprocal():
    wi, wo = random_directions(seed=2)
    bsdf = mi.load_dict(material(random_weights()))
    there = np.array(bsdf.eval(context(), interaction(wi), vector(wo))) / wo[2]
    back = np.array(bsdf.eval(context(), interaction(wo), vector(wi))) / wi[2]
    np.testing.assert_allclose(there, back, rtol=1e-3)
    assert there.max() > 0.1


def albedo(bsdf: mi.BSDF, angle: float, count: int = 1 << 16) -> tuple[float, float]:
    """Of a grey material, by its samples, with the standard error."""
    si = interaction(np.broadcast_to(direction(angle), (3, count)))
    weight = np.array(bsdf.sample(context(), si, *random_numbers(count))[1][0], np.float64)
    return weight.mean(), weight.std() / np.sqrt(count)


def test_no_more_light_than_came():
    """Each lobe, at all angles. Where F is nearly 1, mirrors and the Lambertian lobe reach the bound."""
    largest = 0
    for alpha in ALPHAS:
        for angle in (0, 30, 60, 80, 89, 89.9):
            mean, error = albedo(one_lobe(alpha, 1000.0), angle)
            assert mean <= 1 + 4 * error + 1e-5, (alpha, angle)
            largest = max(largest, mean)
    assert largest > 0.98
    assert albedo(one_lobe(NAN, NAN), 50.0)[0] == pytest.approx(1, abs=1e-4)
    for angle in (0, 50, 85):
        mean, error = albedo(one_lobe(NAN, 1.5), angle)
        assert abs(mean - (1 - fresnel(1.5, np.cos(np.radians(angle))))) < 4 * error + 1e-4


def test_albedo_by_quadrature():
    """Without any sampling: that of the samples."""
    n = 400
    theta, phi = np.meshgrid((np.arange(n) + 0.5) * 90 / n, (np.arange(n) + 0.5) * 360 / n)
    wo = direction(theta.ravel(), phi.ravel())
    solid_angle = np.sqrt(1 - wo[2] ** 2) * (np.pi / 2 / n) * (2 * np.pi / n)
    bsdf = mi.load_dict(material(random_weights(ROUGH), ROUGH))
    for angle in (0.0, 50.0):
        si = interaction(np.broadcast_to(direction(angle), wo.shape))
        expected = np.array(bsdf.eval(context(), si, vector(wo)))[0] @ solid_angle
        mean, error = albedo(bsdf, angle)
        assert abs(mean - expected) < 4 * error + 2e-3 * expected
        assert error < 0.01 * mean


def test_black_behind():
    bsdf = mi.load_dict(material(random_weights()))
    below, above = direction(120.0), direction(40.0)
    for wi, wo in ((below, above), (above, below), (below, below)):
        value, pdf = bsdf.eval_pdf(context(), interaction(wi), vector(wo))
        assert np.all(np.array(value) == 0) and pdf[0] == 0
    bs, weight = bsdf.sample(context(), interaction(np.repeat(below, 64, 1)), *random_numbers(64))
    assert np.all(np.array(weight) == 0) and np.all(np.array(bs.pdf) == 0)


@pytest.mark.parametrize("scale", [0.0, 1.0, -2.0, 1e-30])
def test_finite(scale):
    """Value, density, sample and all gradients; on the horizon, beyond it, towards each other, and where an optimiser
    has left the range of the weights."""
    angles = np.array([0, 1e-4, 1, 45, 89, 89.999, 90 - 1e-6, 90, 90 + 1e-6, 91, 180])
    i, o, phi = (a.ravel() for a in np.meshgrid(angles, angles, [0, 1e-3, 90, 179.999, 180]))
    bsdf, si, wo = mi.load_dict(material(random_weights())), interaction(direction(i)), vector(direction(o, phi))
    params = mi.traverse(bsdf)
    params["weights"] = tensor(scale * random_weights())
    leaves = [params["weights"], si.wi, wo]
    dr.enable_grad(leaves)
    params.update()
    value, pdf = bsdf.eval_pdf(context(), si, wo)
    bs, weight = bsdf.sample(context(), si, *random_numbers(len(i)))
    assert np.all(np.array(pdf) >= 0) and np.all(np.array(bs.pdf) >= 0)
    assert (np.array(value).max() > 0) == (scale > 0)
    results = [value, pdf, bs.wo, bs.pdf, weight]
    dr.backward(dr.sum(value + weight, axis=None))
    for a in [*results, *map(dr.grad, leaves)]:
        assert np.isfinite(np.array(a)).all()
    assert np.array(dr.grad(leaves[0])).min() > 0


def test_weights_that_are_no_numbers_show():
    """They make images of NaN, and not of black: in samples, too."""
    bsdf, weights = mi.load_dict(material(random_weights())), random_weights()
    params = mi.traverse(bsdf)
    weights[2] = NAN
    params["weights"] = tensor(weights)
    params.update()
    wi, wo = random_directions(64)
    si = interaction(wi)
    bs, weight = bsdf.sample(context(), si, *random_numbers(64))
    assert np.isnan(np.array(bsdf.eval(context(), si, vector(wo)))).all()
    assert np.isfinite(np.array(bs.pdf)).all()
    assert np.isnan(np.array(weight)[:, np.array(bs.pdf) > 0]).all()


# ---------------------- Sampling ----------------------


@pytest.mark.parametrize(
    ("lobes", "angle", "component"),
    [(SMOOTH, 20.0, None), (SMOOTH, 70.0, GLOSSY), (ROUGH, 0.0, None), (ROUGH, 45.0, DIFFUSE), (ROUGH, 80.0, None)],
)
def test_samples_have_their_density(lobes, angle, component):
    test = chi_squared(mi.load_dict(material(random_weights(lobes), lobes)), angle, component)
    assert test.run(test_count=5, quiet=True), test.messages


BASE = {"base": {"type": "rgb", "value": [0.1, 0.4, 0.7]}}


@pytest.mark.parametrize("eta", [NAN, 1.5])
def test_a_base_is_a_diffuse_lobe_that_the_scale_leaves_alone(eta):
    weights, (wi, wo) = random_weights(), random_directions()
    coat = {} if np.isnan(eta) else {"base_eta": eta}
    bsdf = mi.load_dict({**material(weights), **BASE, **coat, "scale": 0.3})
    lobe = mi.load_dict(material([BASE["base"]["value"]], ggx.Lobes((NAN,), (eta,))))
    rest = mi.load_dict({**material(weights), "scale": 0.3})
    values = lambda b: np.array(b.eval(context(), interaction(wi), vector(wo)))
    np.testing.assert_allclose(values(bsdf), values(lobe) + values(rest), rtol=1e-5)
    glossy = np.array(bsdf.eval(context(GLOSSY), interaction(wi), vector(wo)))
    np.testing.assert_allclose(glossy, rest.eval(context(GLOSSY), interaction(wi), vector(wo)), rtol=1e-6)


def test_samples_of_a_base_have_their_density():
    bsdf = mi.load_dict({**material(random_weights(ROUGH) * ~np.isnan(ROUGH.alpha)[:, None], ROUGH), **BASE})
    test = chi_squared(bsdf, 45.0)
    assert test.run(test_count=5, quiet=True), test.messages


def test_a_base_under_an_impossible_coat_is_refused():
    with pytest.raises(RuntimeError, match=r'"base_eta" must be > 1, got 0\.9'):
        mi.load_dict({**material(random_weights()), **BASE, "base_eta": 0.9})


def test_the_wrong_density_is_noticed():
    weights = random_weights(ROUGH)
    glossy = weights * ~np.isnan(ROUGH.alpha)[:, None]
    bsdf, other = (mi.load_dict(material(w, ROUGH)) for w in (weights, glossy))
    assert not chi_squared(bsdf, 45.0, other=other).run(quiet=True)


def test_lobes_without_weight_are_sampled():
    """A tenth of the samples is spread evenly, so that derivatives by their weights are not only noise."""
    weights = np.zeros((len(SMOOTH), 3))
    weights[-1] = 0.5
    bsdf, si = mi.load_dict(material(weights, SMOOTH)), interaction(np.repeat(direction(30.0), 20_000, 1))
    bs, _ = bsdf.sample(context(), si, *random_numbers(20_000))
    glossy = (np.array(bs.sampled_component) == GLOSSY).mean()
    assert glossy == pytest.approx(0.1 * 2 / 3, abs=0.01)


@pytest.mark.parametrize("component", [None, GLOSSY, DIFFUSE])
def test_samples_agree_with_value_and_density(component):
    wi, _ = random_directions()
    bsdf, si = mi.load_dict(material(random_weights())), interaction(wi)
    bs, weight = bsdf.sample(context(component), si, *random_numbers(4096))
    value, pdf = bsdf.eval_pdf(context(component), si, bs.wo)
    valid = np.array(bs.pdf) > 0
    np.testing.assert_allclose(bs.pdf, pdf, rtol=1e-4)
    np.testing.assert_allclose(np.array(weight * bs.pdf), np.array(value), rtol=1e-4, atol=1e-7)
    assert np.all(np.array(weight)[:, ~valid] == 0) and valid.mean() > 0.4
    assert np.array(weight).max() < 12
    chosen = np.array(bs.sampled_component)
    types = np.where(chosen == GLOSSY, +mi.BSDFFlags.GlossyReflection, +mi.BSDFFlags.DiffuseReflection)
    assert np.array_equal(bs.sampled_type, types)
    assert set(chosen) == ({GLOSSY, DIFFUSE} if component is None else {component})


# ---------------------- Components, parameters, files ----------------------


def test_components_add_up():
    wi, wo = random_directions(256)
    bsdf, si, wo = mi.load_dict(material(random_weights())), interaction(wi), vector(wo)
    value = lambda *c: np.array(bsdf.eval(context(*c), si, wo))
    assert np.all(value(GLOSSY) > 0) and np.all(value(DIFFUSE) > 0)
    np.testing.assert_allclose(value(GLOSSY) + value(DIFFUSE), value(), rtol=1e-5)
    neither = context()
    neither.type_mask = mi.BSDFFlags.DeltaReflection
    assert np.all(np.array(bsdf.eval(neither, si, wo)) == 0)
    assert np.all(np.array(bsdf.sample(neither, si, *random_numbers(256))[1]) == 0)


def test_parameters():
    weights = random_weights()
    bsdf = mi.load_dict(material(weights))
    params = mi.traverse(bsdf)
    assert list(params.keys()) == ["weights"] and params.flags("weights") == mi.ParamFlags.Differentiable
    np.testing.assert_allclose(np.array(params["weights"]), weights, rtol=1e-6)
    reflectance = np.array(bsdf.eval_diffuse_reflectance(interaction(direction(0.0))))
    np.testing.assert_allclose(reflectance[:, 0], weights[-3:].sum(0), rtol=1e-6)
    assert "21 lobes" in str(bsdf)
    params["weights"] = mi.TensorXf(mi.Float([1.0]), shape=(1, 1))
    with pytest.raises(ValueError, match=re.escape('"weights" must keep its shape (21, 3), got (1, 1)')):
        params.update()


def test_scale():
    """It multiplies the value, and has its derivative; the density stays."""
    wi, wo = random_directions(256)
    texels = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 1), 0.5, np.float32)), "raw": True}
    plain, half, mixed = (
        mi.load_dict({**material(random_weights()), **more}) for more in ({}, {"scale": 0.5}, {"scale": texels})
    )
    value = lambda bsdf: np.array(bsdf.eval_pdf(context(), interaction(wi), vector(wo))[0])
    np.testing.assert_allclose(value(half), 0.5 * value(plain), rtol=1e-5)
    np.testing.assert_allclose(value(mixed), 0.5 * value(plain), rtol=1e-5)
    at = interaction(wi)
    assert half.eval_diffuse_reflectance(at)[0][0] == pytest.approx(0.5 * random_weights()[-3:, 0].sum())
    assert np.array_equal(half.pdf(context(), at, vector(wo)), plain.pdf(context(), at, vector(wo)))
    varying = mi.BSDFFlags.SpatiallyVarying
    assert mixed.flags() & varying and mixed.flags(GLOSSY) & varying and not half.flags() & varying
    params = mi.traverse(half)
    dr.enable_grad(params["scale.value"])
    params.update()
    dr.backward(dr.sum(half.eval(context(), at, vector(wo)), axis=None))
    assert dr.grad(params["scale.value"])[0] == pytest.approx(value(plain).sum(), rel=1e-4)


def test_new_weights_compile_nothing():
    """They come from memory: an optimisation's steps share their kernel."""
    bsdf = mi.load_dict(material(random_weights()))
    params, (wi, wo) = mi.traverse(bsdf), random_directions(1000)
    si, wo = interaction(wi), vector(wo)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for seed in range(3):
            params["weights"] = tensor(random_weights(seed=seed))
            params.update()
            dr.kernel_history_clear()
            dr.eval(bsdf.eval(context(), si, wo))
            kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        assert kernels and all(k["cache_hit"] for k in kernels)


def test_file(tmp_path):
    weights = random_weights(SMOOTH)
    ggx.write(tmp_path / "weights.json", SMOOTH, weights)
    bsdf = mi.load_dict({"type": "ggx_dictionary", "filename": str(tmp_path / "weights.json")})
    assert json.loads((tmp_path / "weights.json").read_text())["alpha"] == [0.1, 0.2, None]
    np.testing.assert_allclose(np.array(mi.traverse(bsdf)["weights"]), weights, rtol=1e-5)
    np.testing.assert_array_equal(bsdf.lobes.eta, SMOOTH.eta)


def test_material_of_the_package():
    lobes, materials = ggx.read_dictionary()
    assert len(materials) == 100 and len(lobes) == 40
    for name, weights in materials.items():
        assert weights.shape == (40, 3), name
        ggx.check_weights(weights, lobes)
    bsdf = mi.load_string(
        '<bsdf version="3.0.0" type="ggx_dictionary"><string name="material" value="gold-paint"/></bsdf>'
    )
    np.testing.assert_allclose(np.array(mi.traverse(bsdf)["weights"]), materials["gold-paint"], rtol=1e-6)
    np.testing.assert_array_equal(bsdf.lobes.alpha, lobes.alpha)
    r, _, b = np.array(bsdf.eval(context(), interaction(direction(30.0)), vector(direction(30.0, 180.0)))).ravel()
    assert r > 1.5 * b


W = np.full((3, 3), 0.3)


@pytest.mark.parametrize(
    ("properties", "text"),
    [
        ({}, 'ggx_dictionary: give either "weights", or both "alpha" and "eta" with them, or "filename" or "material"'),
        ({}, "or both; got nothing"),
        ({"weights": W, "alpha": None, "eta": None, "material": "teflon"}, "got material, weights"),
        ({"weights": W, "eta": None}, "got alpha, weights"),
        ({"weights": W[:2]}, '"weights" must have the shape (3, 3) or (3, 1), for 3 lobes, got (2, 3)'),
        ({"weights": W[:, :2]}, "got (3, 2)"),
        ({"weights": -W}, '"weights" must be >= 0, got -0.3'),
        ({"weights": W * NAN}, '"weights" must be finite'),
        ({"weights": W + 0.04}, '"weights" must sum to at most 1 for each colour, got 1.02'),
        ({"weights": "many"}, '"weights" must be numbers'),
        ({"weights": W, "alpha": [0.0, 0.2, NAN]}, "lobe 1: expected alpha in (0, 1] and eta > 1, or eta"),
        ({"weights": W, "alpha": [0.1, 0.2, 0.3]}, "lobe 3: expected alpha in (0, 1]"),
        ({"weights": W, "eta": [1.5, 1.0, NAN]}, "lobe 2: expected alpha in (0, 1] and eta > 1"),
        ({"weights": W, "eta": [1.5, 2.0]}, '"alpha" and "eta" must have a number for each lobe, got 3 and 2'),
        ({"material": "gold-pant"}, 'unknown "material" gold-pant, did you mean gold-paint?'),
        ({"filename": "missing.json"}, "missing.json"),
        ({"material": "teflon", "scale": -0.5}, 'ggx_dictionary: "scale" must be >= 0, got -0.5'),
    ],
)
def test_errors(properties, text):
    ours = {"alpha": [*SMOOTH.alpha], "eta": [*SMOOTH.eta]} if "weights" in properties else {}
    found = {"type": "ggx_dictionary", **ours, **properties}
    convert = lambda v: tensor(v) if isinstance(v, np.ndarray) else mi.Float(v) if isinstance(v, list) else v
    with pytest.raises(RuntimeError, match=re.escape(text)):
        mi.load_dict({key: convert(value) for key, value in found.items() if value is not None})


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("[]", 'expected an object with "alpha", "eta" and "weights"'),
        ('{"alpha": [0.1], "eta": [1.5]}', 'expected an object with "alpha", "eta" and "weights"'),
        ('{"alpha": [0.1], "eta": [1.5], "weights": [["a"]]}', '"weights" must be an array of numbers'),
        ('{"alpha": [0.1], "eta": [1.5], "weights": [[1], [2]]}', "got (2, 1)"),
        ("{", "Expecting property name"),
    ],
)
def test_errors_in_files(content, text, tmp_path):
    (tmp_path / "weights.json").write_text(content)
    with pytest.raises(ValueError, match=re.escape(text)) as error:
        ggx.read(tmp_path / "weights.json")
    assert str(error.value).startswith(str(tmp_path / "weights.json"))


def test_mono_sees_the_luminance():
    wi, wo = random_directions(256)
    weights = random_weights()
    rgb = mi.luminance(mi.load_dict(material(weights)).eval(context(), interaction(wi), vector(wo))).numpy()
    mi.set_variant("llvm_ad_mono")
    try:
        bsdf = mi.load_dict(material(weights))
        mono = bsdf.eval(context(), interaction(wi), vector(wo))[0].numpy()
        shape = mi.traverse(bsdf)["weights"].shape
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert shape == (len(LOBES), 1)
    np.testing.assert_allclose(mono, rgb, rtol=1e-4)


@pytest.mark.parametrize("other_variant", ["llvm_ad_spectral", "llvm_ad_spectral_polarized"])
def test_other_variants_are_refused(other_variant):
    mi.set_variant(other_variant)
    try:
        with pytest.raises(RuntimeError, match="ggx_dictionary: spectral and polarised variants are not supported"):
            mi.load_dict({"type": "ggx_dictionary", "material": "teflon"})
    finally:
        mi.set_variant("llvm_ad_rgb")


# ---------------------- In renders ----------------------


def room() -> mi.Scene:
    """A floor of a few lobes, on which a cube throws a shadow."""
    sensor = lambda: cases.camera(film=cases.film(width=16, height=16))
    return cases.room(sensor, lambda: {"type": "twosided", "material": material(random_weights(SMOOTH), SMOOTH)})()


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "rig"])
def test_weights_in_a_render(kind):
    """The image is linear in the weights, and has their derivative; forward and backward."""
    scene = room()
    integrator = mi.load_dict({"type": kind})
    params = mi.traverse(scene)
    (key,) = (key for key, _ in params if key.endswith("weights"))
    initial, direction_in_weights = np.array(params[key]), 0.1 * random_weights(SMOOTH, seed=1)

    def image(theta: mi.Float | float) -> mi.TensorXf:
        params[key] = tensor(initial) + tensor(direction_in_weights) * theta
        params.update()

    spp = dict(spp=512, seed=0)
    image(1.0)
    above = np.array(mi.render(scene, integrator=integrator, **spp))
    image(-1.0)
    expected = (above - np.array(mi.render(scene, integrator=integrator, **spp))) / 2
    theta = mi.Float(0)
    dr.enable_grad(theta)
    image(theta)
    dr.forward(theta, dr.ADFlag.ClearEdges)
    forward = np.array(integrator.render_forward(scene, params, **spp))
    assert forward.sum() == pytest.approx(expected.sum(), rel=0.01)
    assert np.abs(forward - expected).sum() < 0.1 * np.abs(expected).sum()

    adjoint = np.random.default_rng(7).uniform(size=forward.shape).astype(np.float32)
    image(0.0)
    dr.enable_grad(params[key])
    params.update()
    integrator.render_backward(scene, params, mi.TensorXf(adjoint), **spp)
    backward = (np.array(dr.grad(params[key])) * direction_in_weights).sum()
    assert backward == pytest.approx((adjoint * forward).sum(), rel=1e-3)


def test_frozen():
    """`dr.freeze` finds the weights: a replay sees their new values."""
    scene, integrator = room(), mi.load_dict({"type": "path", "max_depth": 2})
    params = mi.traverse(scene)
    (key,) = (key for key, _ in params if key.endswith("weights"))
    step = lambda scene, seed: mi.render(scene, integrator=integrator, spp=4, seed=seed)
    frozen, images = dr.freeze(step), []
    for i in range(4):
        params[key] = tensor(random_weights(SMOOTH, seed=i))
        params.update()
        seed = dr.opaque(mi.UInt32, 3)
        images.append(np.array(frozen(scene, seed)))
        np.testing.assert_allclose(images[-1], np.array(step(scene, seed)), rtol=1e-4, atol=1e-5)
    assert frozen.n_recordings <= 2  # the first call makes the film's storage
    assert np.abs(images[3] - images[2]).max() > 1e-3
