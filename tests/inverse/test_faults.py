"""What disks and networks do to fits over machines: the same result, or one line and a checkpoint."""

from __future__ import annotations

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from machines import Machines, Relay, assert_same, fit_while, posed

from rimlight import inverse
from rimlight.inverse import fitting, workers

distributed = pytest.importorskip("distributed")

pytestmark = [
    pytest.mark.usefixtures("no_derivative_image"),
    pytest.mark.filterwarnings("default::ResourceWarning", "default::DeprecationWarning"),
]


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(workers, "POLL", 0.3)
    monkeypatch.setattr(workers, "CONNECT", 3.0)


@contextmanager
def disk_full(process: int = 0) -> Iterator[None]:
    """Of this process, or of another one: no file can grow."""
    before = resource.prlimit(process, resource.RLIMIT_FSIZE)
    resource.prlimit(process, resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.prlimit(process, resource.RLIMIT_FSIZE, before)


def assert_goes_on(stopped: inverse.Result, folder) -> None:
    """In one line it is said why, and a checkpoint holds all steps."""
    assert "\n" not in stopped.status and 4 <= len(stopped.losses) < 12 and len(stopped.views) == 3
    assert fitting.Fit(posed(), out=folder, resume=True).progress.step == len(stopped.losses)


# ------------------------------------------------------------------ networks


def test_the_network_of_the_client_drops_for_a_moment(alone, machines: Machines, caplog):
    """Dask connects again, and the step is done again."""
    machines.add()
    relay = Relay(machines.address)
    with machines.cluster(posed(), 1, relay.address) as cluster:
        assert_same(fit_while(posed(), cluster, 3, relay.cut).values, alone)
    assert "the step is done again" in caplog.text


@pytest.mark.slow
def test_the_network_of_the_client_drops_for_good(machines: Machines, tmp_path):
    machines.add()
    relay = Relay(machines.address)
    with machines.cluster(posed(), 1, relay.address) as cluster:
        found = fit_while(posed(), cluster, 3, relay.close, out=tmp_path / "out")
    assert found.status == f"stopped: the scheduler at {relay.address} is gone; start a cluster, and resume"
    assert_goes_on(found, tmp_path / "out")


@pytest.mark.slow
def test_the_network_of_a_worker_drops(alone, machines: Machines):
    machines.add()
    relay = Relay(machines.address)
    machines.add(scheduler=relay.address)
    with machines.cluster(posed(), 2) as cluster:
        assert_same(fit_while(posed(), cluster, 3, relay.close).values, alone)


@pytest.mark.slow
def test_the_scheduler_freezes(machines: Machines, monkeypatch, tmp_path):
    """Its machine still answers for it, so that no connection breaks."""
    machines.add()
    with machines.cluster(posed(), 1) as cluster:
        monkeypatch.setattr(workers, "ANSWER", 4.0)
        freeze = lambda: machines.scheduler.send_signal(signal.SIGSTOP)
        found = fit_while(posed(), cluster, 3, freeze, out=tmp_path / "out")
    assert found.status.startswith(f"stopped: the scheduler at {machines.address} has not answered for 4 s")
    assert_goes_on(found, tmp_path / "out")


# ------------------------------------------------------------------ disks


@pytest.mark.slow
def test_the_disk_of_a_worker_is_full(alone, machines: Machines):
    worker = machines.add()
    with machines.cluster(posed(), 1) as cluster, disk_full(worker.pid):
        assert_same(fitting.Fit(posed(), executor=cluster).run(progress=False).values, alone)


@pytest.mark.slow
def test_the_disk_of_the_client_is_full(machines: Machines, monkeypatch, tmp_path):
    """The last checkpoint that could be written is the first one."""
    monkeypatch.setattr(fitting, "INTERVAL", 0.0)
    machines.add()
    with machines.cluster(posed(), 1) as cluster:
        fit = fitting.Fit(posed(), executor=cluster, out=tmp_path / "out")
        with disk_full():
            found = fit.run(progress=False)
    assert (
        found.status.startswith("stopped: ") and "checkpoint.npz" in found.status and "are free there" in found.status
    )
    assert len(found.losses) == 1 and len(found.views) == 3 and "\n" not in found.status
    assert fitting.Fit(posed(), out=tmp_path / "out", resume=True).progress.step == 0
