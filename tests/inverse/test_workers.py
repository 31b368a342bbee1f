"""Fits over processes and machines, and what may happen to them: with real processes."""

from __future__ import annotations

import dataclasses
import logging
import os
import pickle
import signal

import numpy as np
import pytest
from machines import COLOUR, assert_same, fit_while, posed, run_fit, values_of, wait_for

from rimlight import inverse
from rimlight.cli import main
from rimlight.inverse import executors, fitting, packing, reproduce, workers
from rimlight.inverse import problem as problems
from rimlight.inverse.problem import Stage, Target
from rimlight.inverse.renderer import Gradient
from rimlight.pictures import write_image
from rimlight.scenes import turntable

distributed = pytest.importorskip("distributed")

pytestmark = [
    pytest.mark.usefixtures("no_derivative_image"),
    pytest.mark.filterwarnings("default::ResourceWarning", "default::DeprecationWarning"),
]

# ------------------------------------------------------------------ the same result


def test_workers_find_the_same(alone, machines, caplog, monkeypatch):
    """Whatever their number and that of their threads; also when one of them is killed at its work."""
    monkeypatch.setattr(workers, "POLL", 0.3)
    first, _ = machines.add(threads=4), machines.add(threads=2)
    with machines.cluster(posed(), 2) as cluster, caplog.at_level(logging.WARNING, logger=workers.__name__):
        assert_same(fit_while(posed(), cluster, 3, first.kill).values, alone)
        assert "a worker was lost; its part of the step is done again" in caplog.text


@pytest.mark.slow
def test_workers_that_freeze_or_are_replaced(alone, machines, monkeypatch):
    """One freezes; then the last one is killed, and a new one comes."""
    monkeypatch.setattr(workers, "SILENT", 3.0)
    monkeypatch.setattr(workers, "POLL", 0.3)
    first, second = machines.add(), machines.add()

    def replace() -> None:
        second.kill()
        machines.add()

    with machines.cluster(posed(), 2) as cluster:
        assert_same(fit_while(posed(), cluster, 3, lambda: first.send_signal(signal.SIGSTOP)).values, alone)
        first.kill()
        assert_same(fit_while(posed(), cluster, 3, replace).values, alone)


@pytest.mark.slow
def test_a_fit_stops_when_no_worker_is_left(machines, monkeypatch, tmp_path, caplog):
    """With a checkpoint, from which it goes on elsewhere; the pictures of the result are rendered here."""
    monkeypatch.setattr(workers, "POLL", 0.3)
    monkeypatch.setattr(workers, "PATIENCE", 1.0)
    only = machines.add()
    with machines.cluster(posed(), 1) as cluster:
        found = fit_while(posed(), cluster, 3, only.kill, out=tmp_path / "out")
    assert found.status == "stopped: the cluster has had no worker for 1 s; start some, and resume"
    assert 4 <= len(found.losses) < 12 and len(found.views) == 3
    resumed = fitting.Fit(posed(), out=tmp_path / "out", resume=True)
    assert resumed.progress.step == len(found.losses)


def test_a_fit_stops_when_the_scheduler_is_gone(machines, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "CONNECT", 3.0)
    machines.add()
    with machines.cluster(posed(), 1) as cluster:
        found = fit_while(posed(), cluster, 3, machines.scheduler.kill, out=tmp_path / "out")
    assert found.status.startswith(f"stopped: the scheduler at {machines.address} is gone")
    assert "\n" not in found.status and 4 <= len(found.losses) < 12
    assert fitting.Fit(posed(), out=tmp_path / "out", resume=True).progress.step == len(found.losses)


@pytest.mark.slow
def test_a_client_that_was_killed_resumes_on_fewer_workers(alone, machines, tmp_path, monkeypatch):
    first = machines.add()
    machines.add()
    long = dataclasses.replace(posed(), stage=(Stage(iterations=400),))
    problems.write(tmp_path / "fit.toml", long)
    whole = run_fit(tmp_path, "--out", "whole")
    killed = run_fit(tmp_path, "--out", "killed", "--cluster", machines.address)
    wait_for(lambda: (tmp_path / "killed" / "checkpoint.npz").exists())
    began = (tmp_path / "killed" / "checkpoint.npz").read_bytes()
    wait_for(lambda: (tmp_path / "killed" / "checkpoint.npz").read_bytes() != began)
    killed.kill()
    killed.communicate()
    first.kill()
    resumed = run_fit(tmp_path, "--out", "killed", "--cluster", machines.address, "--resume")
    for process in (resumed, whole):
        _, said = process.communicate(timeout=120)
        assert process.returncode == 0, said
    assert_same(values_of(tmp_path / "killed"), values_of(tmp_path / "whole"))


@pytest.mark.slow
def test_an_interruption_of_the_terminal_reaches_the_fit_alone(tmp_path):
    """Ctrl-C goes to all of its processes. Workers that died of it would be waited for."""
    problems.write(tmp_path / "fit.toml", posed(stage=(Stage(iterations=4000),)))
    process = run_fit(tmp_path, "--out", "out", "--workers", "2")
    file = tmp_path / "out" / "checkpoint.npz"
    wait_for(file.exists)
    began = file.read_bytes()
    wait_for(lambda: file.read_bytes() != began)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=100)
    assert process.returncode == 130
    line = "rimlight: interrupted: the fit ends after this step, with a result; Ctrl-C ends it at once"
    assert said.splitlines() == [line]


# ------------------------------------------------------------------ who may work


def test_workers_of_another_version_are_refused(machines, monkeypatch):
    machines.add()
    monkeypatch.setattr(workers.rimlight, "__version__", "0.0.1")
    with machines.cluster(posed(), 1) as cluster, pytest.raises(RuntimeError) as error:
        inverse.Fit(posed(), executor=cluster)
    assert "this worker has Rimlight " in str(error.value) and "the fit 0.0.1; install the same" in str(error.value)
    assert "\n" not in str(error.value)


def test_threads_of_the_same_process_are_refused():
    with distributed.Client(processes=False, dashboard_address=":0", set_as_default=False) as client:
        with (
            executors.Cluster(posed(), client) as cluster,
            pytest.raises(RuntimeError, match="thread of the fit's own"),
        ):
            inverse.Fit(posed(), executor=cluster)
        assert client.status == "running"  # what was given is left as it was


def test_a_cluster_works_for_its_own_problem():
    """Once its workers compared the targets of the other one."""
    with (
        distributed.Client(processes=False, dashboard_address=":0", set_as_default=False) as client,
        executors.Cluster(posed(steps=5), client) as cluster,
        pytest.raises(ValueError, match="this cluster was made for another problem"),
    ):
        inverse.Fit(posed(), executor=cluster)


@pytest.mark.parametrize(
    ("cluster", "culprit"),
    [
        ("nonsense://1", 'no cluster at "nonsense://1"'),
        ([2], r'no cluster at "\[2\]"'),
        (0, "workers must be >= 1, got 0"),
        (None, "a cluster is a number of processes, the address of a scheduler, or one of Dask, got None"),
    ],
)
def test_there_must_be_a_cluster(cluster, culprit):
    with pytest.raises(ValueError, match=culprit) as error:
        inverse.Cluster(posed(), cluster)
    assert "\n" not in str(error.value)


def test_the_command_starts_workers(tmp_path, capfd):
    """And what a worker says about a bad target is one line."""
    problems.write(tmp_path / "fit.toml", posed(steps=3))
    arguments = ["fit", "joint", str(tmp_path / "fit.toml"), "--workers", "1"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    assert "finished: 3 steps" in capfd.readouterr().out and (tmp_path / "out" / "report.html").exists()
    write_image(tmp_path / "small.png", np.full((8, 9, 3), 0.5))
    bad = dataclasses.replace(posed(steps=3), target=(Target(file=tmp_path / "small.png"),))
    problems.write(tmp_path / "fit.toml", bad)
    assert main([*arguments, "--out", str(tmp_path / "bad")]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert '"small.png" has 9 x 8 pixels' in line and "said by the worker" in line


def test_seeds_share_workers(tmp_path, capfd):
    """Each has a fit and a folder of its own; those that are done are not done again."""
    problems.write(tmp_path / "fit.toml", posed(steps=3))
    arguments = ["fit", "joint", str(tmp_path / "fit.toml"), "--out", str(tmp_path / "out"), "--seeds", "2"]
    assert main([*arguments, "--workers", "1"]) == 0
    said = capfd.readouterr().out
    assert "seed 0: finished: 3 steps" in said and "seed 1: finished: 3 steps" in said
    first, second = (values_of(tmp_path / "out" / f"seed_{seed}") for seed in (0, 1))
    assert first.keys() == second.keys() and not np.array_equal(first[COLOUR], second[COLOUR])
    assert main(arguments) == 2
    assert "holds a fit already; add --resume" in capfd.readouterr().err
    assert main([*arguments, "--resume"]) == 0
    assert_same(values_of(tmp_path / "out" / "seed_1"), second)
    assert main([*arguments, "--resume", "--watch"]) == 2


@pytest.mark.slow
def test_reproductions_share_workers(tmp_path):
    """Each fit runs as a whole on one of them, and reports."""
    with inverse.Workers(1) as one:
        (outcome,) = reproduce.reproduce("fig6a", tmp_path, seeds=[3], workers=one)
    assert outcome.left < 0.05 and (tmp_path / "fig6a" / "ours_3" / "report.html").exists()


# ------------------------------------------------------------------ what travels


def test_packing_loses_nothing():
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((64, 64, 3)).astype(np.float32)
    odd = np.resize(np.float64([0, 5e-324, -1e300, np.nan, np.inf, -0.1]), 2000)
    sparse = np.where(rng.random(normal.shape) < 0.3, normal, np.float32(0))
    arrays = {"normal": normal, "sparse": sparse, "zeros": 0 * normal, "odd": odd, "short": normal[0, 0]}
    there = pickle.loads(pickle.dumps(packing.pack(arrays)))
    for key, array in packing.unpack(there).items():
        np.testing.assert_array_equal(array, arrays[key])
        assert array.dtype == arrays[key].dtype and array.shape == arrays[key].shape
    size = lambda key: len(pickle.dumps(packing.pack({key: arrays[key]}))) / arrays[key].nbytes
    assert size("normal") < 0.9 and size("sparse") < 0.32 and size("zeros") < 0.01


def test_sums_do_not_depend_on_their_order():
    """Rounded to single precision."""
    rng = np.random.default_rng(0)
    parts = [Gradient({"a": rng.standard_normal(1000).astype(np.float32)}, {(i, 0): float(i)}) for i in range(100)]
    whole = Gradient.sum(parts).single()
    halves = Gradient.sum([Gradient.sum(parts[:37][::-1]), Gradient.sum(parts[37:])]).single()
    np.testing.assert_array_equal(whole.gradients["a"], halves.gradients["a"])
    assert whole.gradients["a"].dtype == np.float32 and whole.losses == halves.losses


# ------------------------------------------------------------------ an example


@pytest.mark.slow
def test_the_crate_on_the_turntable(tmp_path):
    """The example of the docs, much smaller."""
    example = problems.read(turntable.write(tmp_path))
    assert len(example.target) == turntable.CAMERAS and example.views_per_step == 6
    targets = tuple(dataclasses.replace(target, spp=16) for target in example.target[::6])
    stage = (Stage(iterations=20),)
    small = dataclasses.replace(example, target=targets, views_per_step=None, define={"res": "24"}, stage=stage)
    found = inverse.fit(small, progress=False)
    errors = {label: (e[0], e[-1]) for label, e in found.errors.items()}
    assert errors["crate: angle (degrees)"][0] == pytest.approx(12, abs=1e-3)
    assert all(after < before for before, after in errors.values()), errors
    ratios = [measures["peak signal-to-noise ratio (dB)"] for measures in found.measures]
    assert all(after > before for before, after in ratios), ratios
