"""`merl` and its tables: files, angles, values and derivatives against double precision, sampling, renders."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import textwrap
from functools import cache
from pathlib import Path

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from rimlight.checks import mean_and_error, z_scores
from rimlight.merl_tables import GRAZING, SHAPE, angles, directions, elevation, half_difference, read_merl, write_merl

KD, KS = np.array([0.3, 0.2, 0.1]), np.array([0.05, 0.06, 0.08])
ANGLES = [0.0, 30.0, 60.0, 80.0, 88.0]


def analytic(wi: np.ndarray, wo: np.ndarray, alpha: float = 0.3, kd=KD, ks=KS) -> np.ndarray:
    """Lambert's reflectance and a lobe of the GGX distribution with Schlick's: (..., 3)."""
    theta_h, theta_d, _ = half_difference(wi, wo)
    cos_i, cos_o = (np.maximum(w[..., 2], 1e-3) for w in (wi, wo))
    D = alpha**2 / (np.pi * (np.cos(theta_h) ** 2 * (alpha**2 - 1) + 1) ** 2)
    s = lambda cos: np.sqrt(cos**2 + alpha**2 * (1 - cos**2))
    G = 2 * cos_i * cos_o / (cos_o * s(cos_i) + cos_i * s(cos_o))
    F = ks + (1 - ks) * (1 - np.cos(theta_d)[..., None]) ** 5
    return kd / np.pi + F * (D * G / (4 * cos_i * cos_o))[..., None]


@cache
def tabulate(**kwargs) -> np.ndarray:
    """The analytic reflectance, and -1 below the horizon, as in published tables."""
    table = analytic(*directions(*np.meshgrid(*angles(), indexing="ij", sparse=True)), **kwargs)
    return np.where((elevation() > 0)[..., None], table, -1.0)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 1, SHAPE).astype(np.float32)


def interpolate(table: np.ndarray, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f by trilinear interpolation, in double precision: (..., 3)."""
    last = (elevation() > 0).sum(1, keepdims=True) - 1
    j = np.minimum(np.arange(SHAPE[1])[None, :, None], last)
    filled = np.take_along_axis(table.astype(np.float64), j[..., None], 1)
    filled = np.concatenate([filled[:, :, -1:], filled, filled[:, :, :1]], 2)
    theta_h, theta_d, phi_d = half_difference(wi, wo)
    h = np.clip(90 * np.sqrt(theta_h * 2 / np.pi) - 0.5, 0, 89)
    d = np.clip(90 * theta_d * 2 / np.pi - 0.5, 0, 89)
    p = 180 * phi_d / np.pi + 0.5  # an entry was put before the first
    return np.stack([map_coordinates(filled[..., c], [h, d, p], order=1) for c in range(3)], -1)


def direction(theta, phi=0.0) -> np.ndarray:
    """Degrees -> (N, 3)."""
    theta, phi = np.broadcast_arrays(np.radians(theta), np.radians(phi))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)


def random_directions(count: int, seed: int = 0, lowest: float = 89.5) -> tuple[np.ndarray, np.ndarray]:
    """Pairs above the surface, half of them near to mirrors of each other: (N, 3) each, in single precision: near to
    the mirror, φ_d depends on the last digit."""
    rng = np.random.default_rng(seed)
    wi, wo = (direction(rng.uniform(0, lowest, count), rng.uniform(0, 360, count)) for _ in range(2))
    near = wi * [-1, -1, 1] + rng.normal(0, 0.1, (count, 3)) * rng.uniform(0, 1, (count, 1)) ** 3
    near *= np.sign(near[:, 2:])
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    near = np.where(near[:, 2:] > np.cos(np.radians(lowest)), near, wo)
    wo = np.where(np.arange(count)[:, None] % 2, near, wo)
    return tuple(w.astype(np.float32).astype(np.float64) for w in (wi, wo))


def vectors(w: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(np.float32(w).T)


def interaction(wi: np.ndarray) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = vectors(wi)
    return si


def load(table: np.ndarray) -> mi.BSDF:
    return mi.load_dict({"type": "merl", "table": mi.TensorXf(np.float32(table))})


def evaluate(bsdf: mi.BSDF, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f · cos θₒ: (N, 3)."""
    return np.array(bsdf.eval(mi.BSDFContext(), interaction(wi), vectors(wo))).T


def sample(bsdf: mi.BSDF, angle: float, count: int, seed: int = 0):
    """Samples from one direction: what was sampled, and the weights."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    si = interaction(np.broadcast_to(direction(angle), (count, 3)))
    return bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())


def hemisphere(n: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Directions and their solid angles."""
    theta, phi = np.meshgrid((np.arange(n) + 0.5) * 90 / n, (np.arange(n) + 0.5) * 360 / n)
    wo = direction(theta.ravel(), phi.ravel())
    return wo, np.sqrt(1 - wo[:, 2] ** 2) * (np.pi / 2 / n) * (2 * np.pi / n)


def albedo(bsdf: mi.BSDF, angle: float) -> np.ndarray:
    """By quadrature: (3,)."""
    wo, solid_angle = hemisphere()
    return solid_angle @ evaluate(bsdf, np.broadcast_to(direction(angle), wo.shape), wo)


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    return tabulate()


@pytest.fixture(scope="module")
def file(table, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("merl") / "analytic.binary"
    write_merl(path, table)
    return path


@pytest.fixture
def bsdf(variant, table) -> mi.BSDF:
    return load(np.maximum(table, 0))


@pytest.fixture
def noisy(variant) -> mi.BSDF:
    return load(noise())


# ---------------------- Coordinates ----------------------


def test_coordinates_are_those_of_rusinkiewicz():
    """Who turns the half vector to the normal, about the normal and then the y axis, and `wi` with it."""
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in random_directions(500))
    theta_h, theta_d, phi_d = half_difference(wi, wo)
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    np.testing.assert_allclose(np.cos(theta_h), h[:, 2], atol=1e-12)
    phi = np.arctan2(h[:, 1], h[:, 0])
    x, y = np.cos(phi) * wi[:, 0] + np.sin(phi) * wi[:, 1], -np.sin(phi) * wi[:, 0] + np.cos(phi) * wi[:, 1]
    z, x = np.sin(theta_h) * x + np.cos(theta_h) * wi[:, 2], np.cos(theta_h) * x - np.sin(theta_h) * wi[:, 2]
    np.testing.assert_allclose(np.cos(theta_d), z, atol=1e-12)
    # On a circle: 0 and π are the same, and near to the half vector the azimuth is less certain
    turn = np.abs(np.exp(2j * phi_d) - np.exp(2j * np.arctan2(y, x))) * np.sin(theta_d) * np.sin(theta_h)
    assert turn.max() < 1e-9
    assert phi_d.min() >= 0 and phi_d.max() <= np.pi and np.ptp(phi_d) > 3
    assert np.array_equal(half_difference(wo, wi), (theta_h, theta_d, phi_d))


def test_directions_are_the_inverse():
    rng = np.random.default_rng(1)
    expected = rng.uniform(0, 1, (3, 500)) * [[np.pi / 2], [np.pi / 2], [np.pi]]
    wi, wo = directions(*expected)
    np.testing.assert_allclose(np.linalg.norm([wi, wo], axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose(half_difference(wi, wo), expected, atol=1e-9)
    grid = directions(*np.meshgrid(*angles(), indexing="ij", sparse=True))
    np.testing.assert_allclose(np.sin(elevation()), np.minimum(grid[0][..., 2], grid[1][..., 2]), atol=1e-12)


# ---------------------- Files ----------------------


def test_files(table, file, tmp_path):
    """Numbers and their places, as the database has them; and written again, the same bytes."""
    assert file.stat().st_size == 12 + 8 * 90 * 90 * 180 * 3
    assert np.fromfile(file, "<i4", 3).tolist() == [90, 90, 180]
    numbers = np.fromfile(file, "<f8", offset=12)
    for c, scale in enumerate((1 / 1500, 1.15 / 1500, 1.66 / 1500)):
        number = numbers[180 * (90 * (90 * c + 5) + 40) + 123]
        assert number * scale == pytest.approx(table[5, 40, 123, c], rel=1e-12)
    found = read_merl(file)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, np.maximum(table, 0), rtol=1e-12, atol=0)
    write_merl(tmp_path / "again.binary", found)
    assert np.array_equal(read_merl(tmp_path / "again.binary"), found)


DAMAGES = {
    "empty": (lambda data: b"", "expected 34992012 bytes, got 0; fetch or copy"),
    "cut off": (lambda data: data[:-8], "expected 34992012 bytes, got 34992004; fetch or copy"),
    "too long": (lambda data: data + b"\0", "expected 34992012 bytes, got 34992013"),
    "text": (lambda data: b"<html><body>404</body></html>", "expected 90 × 90 × 180 angles, got "),
    "other resolution": (
        lambda data: data[:8] + (360).to_bytes(4, "little") + data[12:],
        "got 90 × 90 × 360; it is no",
    ),
    "negative size": (lambda data: b"\xff\xff\xff\xff" + data[4:], "got -1 × 90 × 180; it is no"),
    "not a number": (lambda data: put(data, np.nan), "expected finite numbers, got nan at (5, 40, 123, 1), 1 in all"),
    "infinite": (lambda data: put(data, np.inf), "expected finite numbers, got inf at (5, 40, 123, 1), 1 in all"),
    "negative": (lambda data: put(data, -1), "expected numbers >= 0 above the horizon, got -0.00"),
}


def put(data: bytes, number: float, where=(1, 5, 40, 123)) -> bytes:
    numbers = np.frombuffer(data, "<f8", offset=12).reshape(3, 90, 90, 180).copy()
    numbers[where] = number
    return data[:12] + numbers.tobytes()


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_refused(file, damage, tmp_path):
    make, message = DAMAGES[damage]
    path = tmp_path / "damaged.binary"
    path.write_bytes(make(file.read_bytes()))
    with pytest.raises(ValueError, match=re.escape(f"merl: {path}: ")) as error:
        read_merl(path)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_negative_numbers_at_the_horizon_are_read_as_zero(file, tmp_path):
    up = np.degrees(elevation())
    low = tuple(np.argwhere((up > 0.9 * GRAZING) & (up < GRAZING))[0].tolist())
    below = tuple(np.argwhere(up < -60)[0].tolist())
    path = tmp_path / "low.binary"
    path.write_bytes(put(put(file.read_bytes(), -1, (0, *low)), -7, (2, *below)))
    table = read_merl(path)
    assert table[(*low, 0)] == 0 and table[(*low, 1)] > 0 and table[(*below, 2)] == 0
    assert table.min() == 0


def test_what_is_no_table_is_not_written(table, tmp_path):
    path = tmp_path / "new.binary"
    for bad, message in ((table[:, :, :90], "got (90, 90, 90, 3)"), (table * np.nan, "finite"), (-table, ">= 0")):
        with pytest.raises(ValueError, match=re.escape(f"merl: {path}: ")) as error:
            write_merl(path, bad)
        assert message in str(error.value)
    assert not list(tmp_path.iterdir())


# ---------------------- Values ----------------------


@pytest.mark.parametrize(("lowest", "tolerance"), [(60, 2e-3), (80, 0.01), (88, 0.2)])
def test_values_of_the_analytic_reflectance(bsdf, lowest, tolerance):
    wi, wo = random_directions(4096, lowest=lowest)
    error = np.abs(evaluate(bsdf, wi, wo) / (analytic(wi, wo) * wo[:, 2:]) - 1)
    print(f"up to {lowest} degrees: largest relative error {error.max():.2g}, mean {error.mean():.2g}")
    assert error.max() < tolerance and error.mean() < 2e-3


def test_sharp_highlights():
    """Of half a degree, in the direction of the mirror and beside it."""
    kwargs = {"alpha": 0.01, "kd": 0.0}
    bsdf = load(np.maximum(tabulate(**kwargs), 0))
    tilt = np.concatenate([np.zeros(10), np.linspace(0, 3, 200)])
    wi, wo = direction(np.full(210, 40.0)), direction(40 + tilt, 180)
    np.testing.assert_allclose(evaluate(bsdf, wi, wo), analytic(wi, wo, **kwargs) * wo[:, 2:], rtol=0.06)


def test_interpolation(noisy):
    """Of a table of noise, where neighbours have nothing in common; around φ_d = 0 and along all other borders."""
    wi, wo = random_directions(4096, seed=3)
    around = directions(*np.meshgrid([0.01, 0.2, 0.5], [1e-3, 0.1, 0.4], np.linspace(-0.02, 0.02, 41)))
    wi, wo = (np.concatenate([a, b.reshape(-1, 3)]) for a, b in zip((wi, wo), around, strict=True))
    wi, wo = (w[half_difference(wi, wo)[0] > 1e-4] for w in (wi, wo))  # nearer to the mirror, φ_d is rounding
    np.testing.assert_allclose(evaluate(noisy, wi, wo), interpolate(noise(), wi, wo) * wo[:, 2:], rtol=0.01)


def test_reciprocal(noisy):
    """To rounding, even of noise; at the mirror's direction, too, where φ_d is uncertain, and around φ_d = 0."""
    wi, wo = random_directions(1 << 16, seed=2)
    mirror = wi[:4096] * [-1, -1, 1]
    around = directions(*np.meshgrid([1e-5, 0.2, 0.5], [1e-5, 0.1, 0.4], np.linspace(-1e-3, 1e-3, 41)))
    wi = np.concatenate([wi, wi[:4096], around[0].reshape(-1, 3)])
    wo = np.concatenate([wo, mirror, around[1].reshape(-1, 3)])
    wi, wo = (w.astype(np.float32) for w in (wi, wo))
    there, back = evaluate(noisy, wi, wo) / wo[:, 2:], evaluate(noisy, wo, wi) / wi[:, 2:]
    np.testing.assert_allclose(there, back, rtol=5e-7)


def test_entries_below_the_horizon_do_not_count(bsdf, table):
    other = load(np.where((elevation() > 0)[..., None], table, 1e6))
    wi, wo = random_directions(1 << 16, seed=4, lowest=90)
    assert np.array_equal(evaluate(bsdf, wi, wo), evaluate(other, wi, wo))


def test_black_behind(bsdf):
    below, above = direction(120.0), direction(40.0)
    for wi, wo in ((below, above), (above, below), (below, below)):
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction(wi), vectors(wo))
        assert np.all(np.array(value) == 0) and pdf[0] == 0
    assert np.all(np.array(sample(bsdf, 120.0, 64)[1]) == 0)
    assert evaluate(bsdf, above, above).min() > 0


def test_negative_entries_are_black(table):
    bsdf = load(np.maximum(table, 0))
    params = mi.traverse(bsdf)
    params["table"] = -params["table"]
    params.update()
    wi, wo = random_directions(256)
    assert np.all(evaluate(bsdf, wi, wo) == 0)


# ---------------------- Derivatives ----------------------


def forward(value, t: mi.Float) -> np.ndarray:
    dr.set_grad(t, 1)
    return np.array(dr.forward_to(value)).T


def variable() -> mi.Float:
    t = mi.Float(0)
    dr.enable_grad(t)
    return t


@pytest.mark.parametrize("what", ["wi", "wo", "normal"])
def test_derivative_of_directions(bsdf, table, what):
    """Against central differences of the interpolated table in double precision."""
    wi, wo = random_directions(4096, seed=5, lowest=85)
    axis = np.array([0.3, 0.5, 0.8]) / np.sqrt(0.98)
    turn = lambda w, t: w + np.cross(axis, w) * t  # to first order a rotation

    def values(t: float) -> np.ndarray:
        i = turn(wi, t) if what != "wo" else wi
        o = turn(wo, t) if what != "wi" else wo
        i, o = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (i, o))
        return interpolate(np.maximum(table, 0), i, o) * o[:, 2:]

    step = 1e-6
    expected = (values(step) - values(-step)) / (2 * step)

    t, si, out = variable(), interaction(wi), vectors(wo)
    if what == "normal":  # the frame turns the other way
        frame = mi.Frame3f(vectors(direction(0.0)))
        a = mi.Vector3f(*axis.tolist())
        frame.s, frame.t, frame.n = (v - dr.cross(a, v) * t for v in (frame.s, frame.t, frame.n))
        si.wi, out = frame.to_local(si.wi), frame.to_local(out)
    elif what == "wi":
        si.wi += vectors(np.cross(axis, wi)) * t
    else:
        out += vectors(np.cross(axis, wo)) * t
    derivative = forward(bsdf.eval(mi.BSDFContext(), si, out), t)
    wrong = np.abs(derivative - expected) > 0.01 * np.abs(expected) + 1e-4 * np.abs(expected).max()
    print(f"{what}: {wrong.mean():.2%} differ, L1 {np.abs(derivative - expected).sum() / np.abs(expected).sum():.2%}")
    assert wrong.mean() < 0.01  # near to the mirror, derivatives are of differences of nearly equal numbers
    assert np.abs(derivative - expected).sum() < 0.003 * np.abs(expected).sum()


def test_derivative_of_the_analytic_reflectance(bsdf):
    """Which that of the interpolated one approximates to a few per cent."""
    wi, wo = random_directions(4096, seed=6, lowest=60)
    axis = np.cross(wo, [0.3, 0.5, 0.8])
    f = lambda o: analytic(wi, o / np.linalg.norm(o, axis=1, keepdims=True)) * o[:, 2:]
    expected = (f(wo + 1e-6 * axis) - f(wo - 1e-6 * axis)) / 2e-6
    t, out = variable(), vectors(wo)
    out += vectors(axis) * t
    derivative = forward(bsdf.eval(mi.BSDFContext(), interaction(wi), out), t)
    assert np.abs(derivative - expected).sum() < 0.05 * np.abs(expected).sum()


def attach(bsdf: mi.BSDF, V: np.ndarray) -> mi.Float:
    """The table goes along V."""
    params, t = mi.traverse(bsdf), variable()
    params["table"] = mi.TensorXf(params["table"]) + mi.TensorXf(V) * t
    params.update()
    return t


def test_derivative_of_the_table(table):
    """Values are linear in it. Forward, and backward."""
    wi, wo = random_directions(4096, seed=7)
    V, bsdf = noise(1), load(np.maximum(table, 0))
    si, out = interaction(wi), vectors(wo)
    t = attach(bsdf, V)
    derivative = forward(bsdf.eval(mi.BSDFContext(), si, out), t)
    np.testing.assert_allclose(derivative, evaluate(load(V), wi, wo), rtol=1e-5)

    bsdf, w = load(np.maximum(table, 0)), np.random.default_rng(8).uniform(size=derivative.shape)
    params = mi.traverse(bsdf)
    dr.enable_grad(params["table"])
    params.update()
    dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), si, out) * mi.Color3f(np.float32(w).T), axis=None))
    gradient = np.array(dr.grad(params["table"]))
    assert (gradient * V).sum(dtype=np.float64) == pytest.approx((w * derivative).sum(), rel=1e-5)
    assert np.all(gradient[elevation() <= 0] == 0)


def test_derivative_of_samples_has_no_bias(table):
    """The mean derivative of the weights is that of the albedo, although their density depends on the table."""
    V, count = noise(2), 1 << 16
    bsdf = load(np.maximum(table, 0))
    t = attach(bsdf, V)
    derivative = forward(sample(bsdf, 50.0, count)[1], t)
    expected, error = albedo(load(V), 50.0), derivative.std(0) / np.sqrt(count)
    assert np.all(np.abs(derivative.mean(0) - expected) < 4 * error + 1e-3 * expected)
    assert np.all(error < 0.01 * expected)


def test_a_black_table_has_a_derivative():
    bsdf = load(np.zeros(SHAPE))
    t = attach(bsdf, np.ones(SHAPE, np.float32))
    bs, weight = sample(bsdf, 30.0, 4096)
    assert np.all(np.array(weight) == 0) and np.all(np.array(bs.pdf)[np.array(bs.wo.z) > 0] > 0)
    assert forward(weight, t).mean() == pytest.approx(np.pi, rel=0.02)


def test_finite():
    """Value, density, sample and all gradients; on the horizon, beyond it, towards each other, and mirrored."""
    steps = np.array([0, 1e-5, 1e-3, 1, 45, 89, 89.999, 90 - 1e-6, 90, 90 + 1e-6, 91, 180])
    i, o, phi = (a.ravel() for a in np.meshgrid(steps, steps, [0, 1e-3, 90, 179.999, 180]))
    bsdf, si, wo = load(noise()), interaction(direction(i)), vectors(direction(o, phi))
    params = mi.traverse(bsdf)
    leaves = [params["table"], si.wi, wo]
    dr.enable_grad(leaves)
    params.update()
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(i))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    assert np.all(np.array(pdf) >= 0) and np.all(np.array(bs.pdf) >= 0)
    results = [value, pdf, bs.wo, bs.pdf, weight]
    assert not dr.grad_enabled([pdf, bs.wo, bs.pdf])
    dr.backward(dr.sum(value + weight, axis=None))
    for a in [*results, *map(dr.grad, leaves)]:
        assert np.isfinite(np.array(a)).all()
    assert np.any(np.array(dr.grad(leaves[1])) != 0)


# ---------------------- Sampling ----------------------


def chi_squared(path: Path, angle: float) -> mi.chi2.ChiSquareTest:
    filename = f'<string name="filename" value="{path}"/>'
    draw, density = mi.chi2.BSDFAdapter("merl", filename, wi=direction(angle)[0].tolist())
    return mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), draw, density, 3, 100_000, res=101, ires=16)


@pytest.mark.parametrize("angle", ANGLES)
def test_samples_have_their_density(file, angle):
    test = chi_squared(file, angle)
    assert test.run(test_count=len(ANGLES), quiet=True), test.messages


def test_a_wrong_density_is_noticed(file):
    test, other = chi_squared(file, 30.0), chi_squared(file, 33.0)
    test.pdf_func = other.pdf_func
    assert not test.run(quiet=True)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("alpha", [0.3, 0.03])
def test_weights(alpha, angle):
    """Their mean is the albedo, they vary little, and are the values over the densities."""
    bsdf, count = load(np.maximum(tabulate(alpha=alpha), 0)), 1 << 15
    bs, weight = sample(bsdf, angle, count)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction(np.broadcast_to(direction(angle), (count, 3))), bs.wo)
    valid = np.array(bs.pdf) > 0
    assert np.array_equal(np.array(bs.pdf)[valid], np.array(pdf)[valid]) and valid.mean() > 0.95
    assert np.array_equal(bs.sampled_component, np.zeros(count))
    weight = np.array(weight).T
    np.testing.assert_allclose(weight[valid], np.array(value / pdf).T[valid], rtol=1e-5)
    grey = weight.mean(1)  # colours share their samples
    print(f"variance {grey.var() / grey.mean() ** 2:.3f}, largest {grey.max() / grey.mean():.2f}")
    assert grey.var() < 0.1 * grey.mean() ** 2 and grey.max() < 4 * grey.mean()
    if alpha > 0.1:  # the quadrature sees no sharper highlight
        expected = albedo(bsdf, angle)
        assert np.all(np.abs(weight.mean(0) - expected) < 4 * weight.std(0) / np.sqrt(count) + 1e-3 * expected)


@pytest.mark.parametrize("angle", ANGLES)
def test_white_surface(angle):
    """1 / π reflects all light, from wherever it comes."""
    bsdf, count = load(np.full(SHAPE, 1 / np.pi)), 1 << 14
    np.testing.assert_allclose(albedo(bsdf, angle), 1, rtol=1e-4)
    weight = np.array(sample(bsdf, angle, count)[1][0])
    assert abs(weight.mean() - 1) < 4 * weight.std() / np.sqrt(count) + 1e-5


# ---------------------- Parameters, variants ----------------------


def test_parameters(bsdf):
    params = mi.traverse(bsdf)
    assert params.properties.keys() == {"table"} and params["table"].shape == SHAPE
    assert params.flags("table") == mi.ParamFlags.Differentiable
    flags = mi.BSDFFlags
    assert bsdf.component_count() == 1
    assert bsdf.flags() == bsdf.flags(0) == flags.DiffuseReflection | flags.GlossyReflection | flags.FrontSide
    context = mi.BSDFContext()
    context.type_mask = flags.DeltaReflection
    si, wo = interaction(direction(30.0)), vectors(direction(20.0))
    assert bsdf.eval(context, si, wo)[0][0] == 0 and "(90, 90, 180, 3)" in str(bsdf)


def test_updates_reach_values_and_samples(table):
    bsdf = load(np.maximum(table, 0))
    params = mi.traverse(bsdf)
    sharp = np.maximum(tabulate(alpha=0.03), 0)
    params["table"] = mi.TensorXf(np.float32(sharp))
    params.update()
    wi, wo = random_directions(256)
    assert np.array_equal(evaluate(bsdf, wi, wo), evaluate(load(sharp), wi, wo))
    weight = np.array(sample(bsdf, 40.0, 4096)[1][0])
    assert weight.var() < 0.1 * weight.mean() ** 2
    params["table"] = dr.zeros(mi.TensorXf, (90, 90, 90, 3))
    with pytest.raises(Exception, match=r'merl: "table" must keep its shape .* got \(90, 90, 90, 3\)'):
        params.update()


def test_impossible_parameters_are_refused():
    ones = dr.ones(mi.TensorXf, (2, 2, 2, 3))
    for options, message in (
        ({}, 'merl: give either "filename" or "table"'),
        ({"filename": "a.binary", "table": ones}, 'merl: give either "filename" or "table"'),
        ({"filename": "nowhere.binary"}, "merl: nowhere.binary: there is no such file"),
        ({"table": ones}, 'merl: "table": expected a table of shape (90, 90, 180, 3), got (2, 2, 2, 3)'),
        ({"table": mi.TensorXf(noise() - 0.5)}, 'merl: "table": expected numbers >= 0 above the horizon'),
        ({"table": "gray-plastic.binary"}, 'merl: "table" must be mi.TensorXf of shape (90, 90, 180, 3), got str'),
    ):
        with pytest.raises(RuntimeError, match=re.escape(message)):
            mi.load_dict({"type": "merl", **options})


def test_tabs_of_the_manual_load(file):
    """Names of files are those of the folders that Mitsuba searches."""
    (file.parent / "gray-plastic.binary").write_bytes(file.read_bytes())
    tabs = re.findall(
        r"\.\. code-tab:: (\w+)\n\n((?: {12}.*\n|\n)+)",
        inspect.getsource(type(mi.load_dict({"type": "merl", "filename": str(file)}))),
    )
    xml, python = (textwrap.dedent(dict(tabs)[language]) for language in ("xml", "python"))
    mi.file_resolver().prepend(str(file.parent))
    for bsdf in (mi.load_string(xml.replace(">", ' version="3.0.0">', 1)), mi.load_dict(eval(f"{{{python}}}"))):
        np.testing.assert_allclose(mi.traverse(bsdf)["brdf_0.table"], read_merl(file), rtol=1e-6)


def test_monochromatic_variants_see_the_luminance(bsdf, file):
    wi, wo = random_directions(256)
    expected = np.array(mi.luminance(mi.Color3f(evaluate(bsdf, wi, wo).T)))
    mi.set_variant("llvm_ad_mono")
    try:
        grey = mi.load_dict({"type": "merl", "filename": str(file)})
        value = evaluate(grey, wi, wo)
        found = np.array(sample(grey, 40.0, 4096)[1][0])
    finally:
        mi.set_variant("llvm_ad_rgb")
    np.testing.assert_allclose(value, expected[:, None], rtol=1e-5)
    assert found.var() < 0.1 * found.mean() ** 2


@pytest.mark.parametrize(
    ("variant_", "message"),
    [
        ("llvm_ad_spectral", "merl: spectral variants are not supported, got llvm_ad_spectral: tables are RGB"),
        ("llvm_ad_spectral_polarized", "merl: polarised variants are not supported"),
    ],
)
def test_other_variants_are_refused(variant_, message):
    mi.set_variant(variant_)
    try:
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({"type": "merl", "filename": "a.binary"})
    finally:
        mi.set_variant("llvm_ad_rgb")


# ---------------------- In renders ----------------------


def twosided(bsdf: mi.BSDF) -> dict:
    return {"type": "twosided", "material": bsdf}


def stage(bsdf: mi.BSDF, **lights) -> mi.Scene:
    """A ball above a floor: where they touch, rounding decides which shadow rays are blocked."""
    lights = lights or {"lamp": {"type": "point", "position": [-2, 4, -3], "intensity": 20.0}, "sky": cases.constant()}
    return cases.scene(
        sensor=cases.camera((0, 2, -4), (0, 0, 0), film=cases.film(width=16, height=16)),
        floor=cases.horizontal((0, -1, 0), 3, "floor", bsdf=twosided(bsdf)),
        ball={"type": "sphere", "radius": 0.8, "bsdf": twosided(bsdf)},
        **lights,
    )


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "rig"])
def test_images_are_those_of_path(bsdf, kind):
    lights = {"rig": {"type": "distant_lights", "directions": "0 1 0, -0.6 0.8 0"}} if kind == "rig" else {}
    scene = stage(bsdf, **lights)
    path = mi.load_dict({"type": "path", "max_depth": 2 if kind == "direct_edge" else 3})
    mine = mi.load_dict({"type": kind, **({} if kind == "direct_edge" else {"max_depth": 3})})
    render = lambda it, seed: np.array(mi.render(scene, integrator=it, spp=256, seed=seed))
    images = [np.array([render(it, 8 * k + seed) for seed in range(6)]) for k, it in enumerate((path, mine))]
    if kind == "rig":
        images[1] = images[1].reshape(*images[1].shape[:3], 2, 3).sum(3)
    z = z_scores(*mean_and_error(images[0]), *mean_and_error(images[1]))
    total = [image.sum(dtype=np.float64) for image in images]
    print(f"{kind}: largest |z| {np.abs(z).max():.2f}, sum {total[1] / total[0]:.4f}")
    assert np.abs(z).max() < 6 and np.abs(np.mean(z**2)) < 2
    assert total[0] > 0 and total[1] == pytest.approx(total[0], rel=5e-3)


def test_white_furnace():
    """In light of one brightness, white things are invisible."""
    scene = stage(load(np.full(SHAPE, 1 / np.pi)), sky=cases.constant())
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 20}), spp=256))
    assert image.mean() == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge"])
def test_table_in_a_render(table, kind):
    """Against finite differences of the integrator's own images; and forward against backward."""
    scene = stage(load(np.maximum(table, 0)))
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": kind, **({"max_depth": 3} if kind == "prb_edge" else {})})
    key = "floor.bsdf.brdf_0.table"
    initial, V = mi.TensorXf(params[key]), mi.TensorXf(noise(3))

    def derivative(seed: int) -> np.ndarray:
        t = variable()
        params[key] = initial + V * t
        params.update()
        dr.forward(t, dr.ADFlag.ClearEdges)
        return np.array(integrator.render_forward(scene, params, seed=seed, spp=64))

    def image(t: float, seed: int) -> np.ndarray:
        params[key] = initial + V * t
        params.update()
        return np.array(mi.render(scene, integrator=integrator, spp=256, seed=seed))

    J = np.array([derivative(seed) for seed in range(4)])
    step = 0.05
    differences = np.array([(image(step, seed) - image(-step, seed)) / (2 * step) for seed in range(4)])
    z = z_scores(*mean_and_error(J), *mean_and_error(differences))
    total = J.mean(0).sum(), differences.mean(0).sum()
    print(f"{kind}: sums {total[0]:.5g}, {total[1]:.5g}, largest |z| {np.abs(z).max():.2f}")
    assert np.mean(z**2) < 3 and total[0] == pytest.approx(total[1], rel=0.01)

    params[key] = mi.TensorXf(initial)
    dr.enable_grad(params[key])
    params.update()
    w = np.random.default_rng(9).uniform(size=J[0].shape).astype(np.float32)
    integrator.render_backward(scene, params, mi.TensorXf(w), seed=0, spp=64)
    backward = (np.array(dr.grad(params[key])) * np.array(V)).sum(dtype=np.float64)
    assert backward == pytest.approx((w * J[0]).sum(), rel=1e-3)


def test_frozen(table):
    """A whole step of a fit: the table and the distribution are made anew, and there is a derivative.

    Dr.Jit refuses to freeze while there is a BSDF that is none of the scene's: no fixture of this file is one for long.
    """
    scene, integrator = stage(load(np.maximum(table, 0))), mi.load_dict({"type": "direct_edge"})
    params, key = mi.traverse(scene), "floor.bsdf.brdf_0.table"
    initial = mi.TensorXf(params[key])

    def step(scene, params, initial, factor, seed):
        dr.enable_grad(factor)
        params[key] = initial * factor
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=4, seed=seed)
        dr.backward(dr.sum(image, axis=None))
        return dr.detach(image), dr.grad(factor)

    frozen = dr.freeze(step, state_fn=lambda scene, *_: integrator.find_boundaries(scene))
    images = []
    for i in range(4):
        arguments = lambda i=i: (scene, params, initial, dr.opaque(mi.Float, 1 + 0.5 * i), dr.opaque(mi.UInt32, 3))
        (image, gradient), (expected, its_gradient) = frozen(*arguments()), step(*arguments())
        np.testing.assert_allclose(np.array(image), np.array(expected), rtol=1e-4, atol=1e-5)
        assert gradient[0] == pytest.approx(its_gradient[0], rel=1e-4) and gradient[0] > 0
        images.append(np.array(image))
    assert frozen.n_recordings <= 2  # the first call makes the film's storage
    assert np.abs(images[3] - images[2]).max() > 1e-3


# ---------------------- Tables of measured materials ----------------------


@pytest.fixture(scope="module", params=["gray-plastic", "dark-blue-paint"])
def measured(request, root, tmp_path_factory) -> Path:
    tool = root.parent / "shared" / "tools" / "merl_table.py"
    if not tool.exists():
        pytest.skip(f"needs {tool}")
    path = tmp_path_factory.mktemp("measured") / f"{request.param}.binary"
    subprocess.run([sys.executable, str(tool), request.param, str(path)], check=True)
    return path


def test_measured_materials(measured):
    table, bsdf = read_merl(measured), mi.load_dict({"type": "merl", "filename": str(measured)})
    wi, wo = random_directions(4096, seed=10, lowest=85)
    np.testing.assert_allclose(evaluate(bsdf, wi, wo), interpolate(table, wi, wo) * wo[:, 2:], rtol=0.02)
    ratios = []
    for angle in ANGLES:
        weight = np.array(sample(bsdf, angle, 1 << 16)[1]).mean(0)
        assert weight.var() < 0.05 * weight.mean() ** 2 and weight.max() < 4 * weight.mean()
        wo = np.array(mi.warp.square_to_cosine_hemisphere(mi.Point2f(np.random.default_rng(0).random((2, 1 << 16))))).T
        by_cosine = (evaluate(bsdf, np.broadcast_to(direction(angle), wo.shape), wo) * np.pi / wo[:, 2:]).mean(1)
        assert weight.mean() == pytest.approx(by_cosine.mean(), abs=5 * float(by_cosine.std()) / 2**8)
        ratios.append(by_cosine.var() / weight.var())
    print(f"{measured.stem}: the cosine's variance is " + ", ".join(f"{r:.0f}" for r in ratios) + " times as large")
    assert min(ratios) > 10
    test = chi_squared(measured, 45.0)
    assert test.run(quiet=True), test.messages
