"""Fits of lobes to tables, and the reduction of dictionaries: on tables of which the answer is known."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import minimize

from rimlight import ggx, merl_tables
from rimlight.cli import main
from rimlight.inverse import reflectance
from rimlight.inverse.reflectance import dictionary

NAN = float("nan")
LOBES = ggx.Lobes((0.05, 0.2, 0.2, 0.6, NAN), (1.5, 1.2, 20.0, 3.0, NAN))


def table_of(lobes: ggx.Lobes, weights: np.ndarray) -> np.ndarray:
    """A table (90, 90, 180, 3) that is these lobes exactly; 0 below the horizon. Section 3.4 of Bangaru 2019."""
    theta_h, theta_d, phi_d = np.meshgrid(*merl_tables.angles(), indexing="ij", sparse=True)
    along, across = np.cos(theta_h) * np.cos(theta_d), np.sin(theta_h) * np.sin(theta_d) * np.cos(phi_d)
    cos = np.maximum([along - across, along + across], 1e-9)
    table = np.zeros(merl_tables.SHAPE)
    for alpha, eta, weight in zip(lobes.alpha, lobes.eta, weights, strict=True):
        if np.isnan(alpha):
            table += weight / np.pi
            continue
        c = np.cos(theta_d)
        g = np.sqrt(eta**2 + c**2 - 1)
        F = 0.5 * ((g - c) / (g + c)) ** 2 * (1 + (((g + c) * c - 1) / ((g - c) * c + 1)) ** 2)
        D = alpha**2 / (np.pi * (np.cos(theta_h) ** 2 * (alpha**2 - 1) + 1) ** 2)
        G = (2 * cos / (cos + np.sqrt(alpha**2 + (1 - alpha**2) * cos**2))).prod(0)
        table += (D * F * G / (4 * cos.prod(0)))[..., None] * weight
    table[merl_tables.elevation() < 0] = 0
    return table


def random_weights(lobes: ggx.Lobes = LOBES, seed: int = 0) -> np.ndarray:
    weights = np.random.default_rng(seed).uniform(0, 1, (len(lobes), 3))
    return 0.9 * weights / weights.sum(0)


# ---------------------- Fits ----------------------


def test_fit_recovers_weights():
    weights = random_weights()
    table = table_of(LOBES, weights)
    found = reflectance.fit(table, LOBES)
    np.testing.assert_allclose(found, weights, rtol=1e-6, atol=1e-9)
    assert max(reflectance.error(table, LOBES, found)) < 1e-6


def test_fit_among_other_lobes():
    """Of lobes that are not in the table, none is needed."""
    weights, more = random_weights(), ggx.Lobes((0.1, *LOBES.alpha, 0.3), (1.5, *LOBES.eta, 1.8))
    found = reflectance.fit(table_of(LOBES, weights), more)
    np.testing.assert_allclose(found[1:-1], weights, rtol=1e-6, atol=1e-9)
    assert np.all(found[[0, -1]] < 1e-9)


def test_sum_is_at_most_one():
    """A table twice too bright: the best weights within the bounds, and not the free ones, scaled."""
    table = table_of(LOBES, 2 * random_weights())
    found = reflectance.fit(table, LOBES)
    assert np.all(found >= 0)
    np.testing.assert_allclose(found.sum(0), 1, rtol=1e-6)
    values, design = dictionary._values(table)[0], dictionary._design(LOBES)
    w = dictionary._weights(values)
    cost = lambda a: (w * (values - design @ a) ** 2).sum() / (w * values**2).sum()
    best = minimize(
        cost,
        np.full(5, 0.2),
        bounds=[(0, 1)] * 5,
        constraints={"type": "eq", "fun": lambda a: a.sum() - 1},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert cost(found[:, 0]) < best.fun * (1 + 1e-6)
    free = 2 * random_weights()[:, 0]
    assert cost(found[:, 0]) < 0.99 * cost(free / free.sum())


def test_black_table():
    found = reflectance.fit(np.zeros(merl_tables.SHAPE), LOBES)
    assert np.all(found == 0)


def test_error():
    """Of black it is 100 %, and in both measures what a factor of 1.1 makes it."""
    weights = random_weights()
    table = table_of(LOBES, weights)
    np.testing.assert_allclose(reflectance.error(table, LOBES, 0 * weights), 1)
    np.testing.assert_allclose(reflectance.error(table, LOBES, 1.1 * weights), 0.1, rtol=1e-6)


def test_jacobian():
    """Means over the directions are those of independent ones, in proportion to their cosines."""
    _, wi, wo, jacobian = dictionary._directions()
    assert jacobian.sum() == pytest.approx(1) and 20_000 < len(jacobian) < 50_000
    cosines = np.array([wi[:, 2], wo[:, 2], wi[:, 2] ** 2, wi[:, 2] * wo[:, 2]])
    np.testing.assert_allclose(cosines @ jacobian, [2 / 3, 2 / 3, 1 / 2, 4 / 9], rtol=0.02)
    # The albedo of what is nearly a mirror
    (lobe,) = dictionary._design(ggx.Lobes((0.02,), (1e4,))).T
    assert lobe @ jacobian * np.pi == pytest.approx(1, rel=0.03)


def test_candidates():
    lobes = reflectance.candidates((0.01, 0.46), (1.05, 1.95), (30, 20))
    assert len(lobes) == 602
    np.testing.assert_array_equal(lobes.alpha[-2:], [NAN, NAN])
    np.testing.assert_array_equal(lobes.eta[-2:], [1.5, NAN])
    assert (lobes.alpha[0], lobes.alpha[-3]) == (0.01, 0.46) and (lobes.eta[0], lobes.eta[-3]) == (1.05, 1.95)
    assert len(reflectance.candidates(counts=(3, 2), diffuse=False)) == 6


# ---------------------- Reduction ----------------------


def test_reduction_finds_the_lobes_of_the_tables():
    """Four lobes of a few hundred, and the Lambertian one."""
    grid = reflectance.candidates((0.01, 1.0), (1.1, 20.0), (20, 12))
    true = [3 * 12 + 4, 11 * 12 + 4, 11 * 12 + 9, 17 * 12 + 9, 241]
    lobes = ggx.Lobes(*([column[i] for i in true] for column in (grid.alpha, grid.eta)))
    weights = {f"material {i}": random_weights(lobes, seed=i) for i in range(4)}
    tables = ((name, table_of(lobes, w)) for name, w in weights.items())
    found, fits, errors = reflectance.reduce(tables, grid, count=5, alphas=3, etas=2)
    np.testing.assert_array_equal(found.alpha, lobes.alpha)
    np.testing.assert_array_equal(found.eta, lobes.eta)
    assert list(fits) == list(weights) == list(errors)
    for name, fit in fits.items():
        np.testing.assert_allclose(fit, weights[name], rtol=1e-5, atol=1e-7)
        assert max(errors[name]) < 1e-5


def test_reduction_keeps_few_alphas_and_etas():
    """Of ten lobes that share nothing, no more than asked for, although the fits get worse."""
    alphas, etas = np.geomspace(0.05, 1, 10).tolist(), np.geomspace(1.1, 20, 10).tolist()
    lobes = ggx.Lobes((*alphas, NAN), (*etas, NAN))
    table = table_of(lobes, random_weights(lobes))
    grid = ggx.Lobes((*np.repeat(alphas, 10).tolist(), NAN), (*etas * 10, NAN))
    found, _, errors = reflectance.reduce([("material", table)], grid, count=8, alphas=4, etas=3)
    different = [len({x for x in column if x == x}) for column in (found.alpha, found.eta)]
    assert len(found) <= 8 and different[0] <= 4 and different[1] <= 3
    assert np.isnan(found.alpha[-1])
    assert 1e-5 < errors["material"].cost < 0.1


def test_dark_lobes_are_not_useful():
    """Of two lobes, the one with the smaller weight contributes more."""
    lobes = ggx.Lobes((0.2, 0.2), (1.05, 20.0))
    table = table_of(lobes, np.repeat([[0.5], [0.05]], 3, 1))
    found, _, _ = reflectance.reduce([("material", table)], lobes, count=1)
    assert found.eta == (20.0,)


def test_nothing_to_reduce_for():
    with pytest.raises(ValueError, match="there are no tables"):
        reflectance.reduce([], LOBES)


# ---------------------- The dictionary of the package ----------------------


def test_dictionary_of_the_package(shared, root):
    """Its weights are those of the fit, with the errors that the documentation lists."""
    networks = shared("brdf/merl_nbrdf.npz")
    path = networks.parents[2] / "tools" / "merl_table.py"
    specification = importlib.util.spec_from_file_location("merl_table", path)
    tool = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(tool)
    lobes, materials = ggx.read_dictionary()
    page = (root / "docs" / "performance" / "reflectance_errors.md").read_text(encoding="utf-8")
    listed = {name: values for name, *values in re.findall(r"\| ([\w-]+) \| ([\d.]+)% \| ([\d.]+)% \|", page)}
    assert set(listed) == set(materials) == set(np.load(networks))
    for name in ("gray-plastic", "alum-bronze", "white-diffuse-bball"):
        angles = np.meshgrid(*merl_tables.angles(), indexing="ij")
        table = tool.evaluate(np.load(networks)[name], *(a[dictionary.SUBSET] for a in angles))
        full = np.zeros(merl_tables.SHAPE)
        full[dictionary.SUBSET] = table
        np.testing.assert_allclose(reflectance.fit(full, lobes), materials[name], atol=1e-4)
        error = reflectance.error(full, lobes, materials[name])
        np.testing.assert_allclose([100 * e for e in error], [float(x) for x in listed[name]], atol=0.1)


# ---------------------- Command line ----------------------


def test_commands(tmp_path, capsys):
    """A folder is reduced; the result describes another table; a plugin loads both."""
    folder, out = tmp_path / "tables", tmp_path / "dictionary.json"
    folder.mkdir()
    lobes = ggx.Lobes((0.1, 0.5, NAN), (1.5, 10.0, NAN))
    for name, seed in (("first", 1), ("second", 2)):
        merl_tables.write_merl(folder / f"{name}.binary", table_of(lobes, random_weights(lobes, seed)))
    options = ["--lobes", "3", "--alpha-range", "0.02", "0.5", "--eta-range", "1.5", "10", "--candidates", "3", "2"]
    assert main(["reflectance", "reduce", str(folder), str(out), *options]) == 0
    assert re.search(r"^\| first \| 0\.0% \| 0\.0% \|$", capsys.readouterr().out, re.MULTILINE)
    content = json.loads(out.read_text())
    assert list(content["materials"]) == ["first", "second"] and content["alpha"] == [0.1, 0.5, None]
    bsdf = mi.load_dict({"type": "ggx_dictionary", "filename": str(out), "material": "second"})
    np.testing.assert_allclose(np.array(mi.traverse(bsdf)["weights"]), random_weights(lobes, 2), atol=1e-4)

    fitted = tmp_path / "fit.json"
    line = ["reflectance", "fit", str(folder / "first.binary"), str(fitted), "--dictionary", str(out)]
    assert main(line) == 0
    assert capsys.readouterr().out == "3 of 3 lobes, rms 0.0%, cost 0.0%\n"
    bsdf = mi.load_dict({"type": "ggx_dictionary", "filename": str(fitted)})
    np.testing.assert_allclose(np.array(mi.traverse(bsdf)["weights"]), random_weights(lobes, 1), atol=1e-4)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (["reduce", "nowhere", "out.json"], 'there are no files *.binary in "nowhere"'),
        (["reduce", ".", "."], 'OUT.json: "." is a folder'),
        (["reduce", ".", "out.json", "--lobes", "0"], "--lobes must be >= 1, got 0"),
        (["reduce", ".", "out.json", "--alpha-range", "0.1", "2"], "expected alpha in (0, 1] and eta > 1"),
        (["reduce", ".", "out.json"], "bad.binary: expected"),
        (["fit", "missing.binary", "out.json"], "missing.binary: there is no such file"),
        (["fit", "bad.binary", "out.json"], "bad.binary: expected"),
        (["fit", "bad.binary", "out.json", "--dictionary", "bad.json"], 'bad.json: expected an object with "alpha"'),
        (["fit", "bad.binary", "out.json", "--dictionary", "missing.json"], "missing.json"),
    ],
)
def test_wrong_input(line, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("bad.binary").write_bytes(b"no table at all")
    Path("bad.json").write_text("[]")
    assert main(["reflectance", *line]) == 2
    error = capsys.readouterr().err
    assert text in error and error.startswith("rimlight: error: ") and error.count("\n") == 1
    assert not Path("out.json").exists()
