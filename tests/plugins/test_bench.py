"""`rimlight bench`: what its numbers mean, and what it writes."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rimlight.checks import FiniteDifferences
from rimlight.cli import _bench, main


def reference(value: float, error: float) -> FiniteDifferences:
    full = lambda x: np.full((4, 4, 3), x, np.float32)
    return FiniteDifferences(full(value), full(error), full(0), {})


def test_numbers_of_a_row():
    """Two calls, 10 % above and 30 % above the reference, which took 2 s after a first one of 5 s."""
    images = np.stack([np.full((4, 4, 3), x) for x in (1.1, 1.3)])
    row = _bench.row("cube", "direct_edge", {"type": "direct_edge"}, images, [5.0, 2.0], reference(1, 0))
    assert (row.calls, row.first, row.seconds) == (1, 5, 2)
    assert row.error == pytest.approx(0.2) and row.of_mean == pytest.approx(0.2)
    assert row.efficiency == pytest.approx(1 / ((0.1**2 + 0.3**2) / 2 * 2))


def test_noise_of_the_reference_is_not_that_of_the_method():
    rng = np.random.default_rng(0)
    images = 1 + rng.normal(0, 0.2, (400, 4, 4, 3))
    clean = _bench.row("cube", "m", {"type": "m"}, images, [1.0] * 401, reference(1, 0))
    noisy_reference = FiniteDifferences(
        (1 + rng.normal(0, 0.1, (4, 4, 3))).astype(np.float32), np.full((4, 4, 3), 0.1, np.float32), np.zeros(0), {}
    )
    noisy = _bench.row("cube", "m", {"type": "m"}, images, [1.0] * 401, noisy_reference)
    assert noisy.efficiency == pytest.approx(clean.efficiency, rel=0.15)
    assert clean.efficiency == pytest.approx(1 / 0.2**2, rel=0.02)


def test_it_writes_a_table_and_a_file(tmp_path, monkeypatch, capsys):
    ours = {"direct_edge": {"type": "direct_edge"}, "prb": {"type": "prb", "max_depth": 2}}
    monkeypatch.setattr(_bench.Case, "methods", lambda self: ours)
    monkeypatch.setattr(_bench, "CASES", _bench.CASES[:1])
    monkeypatch.setattr(_bench, "REFERENCE_SPP", 256)
    assert main(["bench", "--out", str(tmp_path / "bench.json"), "--seconds", "0.01"]) == 0
    printed = capsys.readouterr().out
    assert "| cube | direct_edge |" in printed and "| cube | prb (max_depth 2) |" in printed
    facts = json.loads((tmp_path / "bench.json").read_text("utf-8"))
    edge, prb = facts["rows"]
    assert edge["calls"] == 3 and edge["error"] < 0.5 and edge["of_mean"] < edge["error"]
    assert prb["error"] == pytest.approx(1, abs=0.05)  # it sees no outline
    assert facts["machine"]["versions"]["Rimlight"] and facts["settings"]["spp"] == 16


@pytest.mark.parametrize("options", [["--spp", "0"], ["--seconds", "0"]])
def test_bad_options(options, tmp_path, capsys):
    assert main(["bench", "--out", str(tmp_path / "bench.json"), *options]) == 2
    assert capsys.readouterr().err.startswith("rimlight: error: --")


def test_methods_that_are_better_than_the_reference_have_an_efficiency():
    """Where the derivative is less noisy than the reference, and without bias, its variance counts."""
    rng = np.random.default_rng(1)
    noisy = FiniteDifferences(
        (1 + rng.normal(0, 0.1, (4, 4, 3))).astype(np.float32), np.full((4, 4, 3), 0.2, np.float32), np.zeros(0), {}
    )
    row = _bench.row("cube", "m", {"type": "m"}, 1 + rng.normal(0, 0.01, (50, 4, 4, 3)), [1.0] * 51, noisy)
    assert row.efficiency == pytest.approx(1 / 0.01**2, rel=0.1)


def test_the_gain_is_over_our_defaults(variant):
    """Not over the balanced row, which is of the same integrator."""
    images = np.random.default_rng(0).normal(1, 0.1, (5, 4, 4, 3))
    rows = [
        _bench.row("cube", name, {"type": "direct_edge"}, images, [1.0, *[time] * 4], reference(1, 0))
        for name, time in ((_bench.OURS, 2.0), (_bench.BALANCED, 1.0))
    ]
    assert [line.split("|")[-2].strip() for line in _bench.table(rows)[2:]] == ["1", "2"]
