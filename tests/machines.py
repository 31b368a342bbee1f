"""Clusters of real processes, and connections that break, for tests of fits over machines."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from rimlight import inverse, scenes
from rimlight.inverse import executors, fitting
from rimlight.inverse import problem as problems
from rimlight.inverse.problem import Free, Problem, Stage, Target

GREEN, COLOUR = "green.vertex_positions", "green.bsdf.reflectance.value"


def posed(steps: int = 12, **options) -> Problem:
    """Three views, of two scenes, in two parts each. With one thread, results are the same bit by bit."""
    free = (
        Free(key=(GREEN,), kind="shape", move="xy", rate=0.05, start=(0.2, -0.1, 0)),
        Free(key=(COLOUR,), kind="material", rate=0.02, start=(0.2,)),
    )
    other = Target(scene=scenes.path("two_triangles"), spp=32)
    options = {"target": (Target(spp=64), other, Target(spp=16)), "parts": 2, "threads": 1} | options
    options = {"stage": (Stage(iterations=steps),), "integrator": {"type": "direct_edge"}} | options
    return Problem(scene=scenes.path("two_triangles"), define={"res": "16"}, free=free, **options)


def run_fit(folder: Path, *options: str) -> subprocess.Popen:
    """`rimlight fit joint fit.toml` in a process of its own, without the derivative image of the report."""
    command = [sys.executable, "-m", "rimlight", "fit", "joint", "fit.toml", *options]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def values_of(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "result.npz") as found:
        return dict(found)


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value, err_msg=key)


def values_alone(folder: Path) -> dict[str, np.ndarray]:
    """What a fit finds without workers, in a process of its own: what was loaded before in this one adds up in another
    order."""
    problems.write(folder / "fit.toml", posed())
    process = run_fit(folder, "--out", "alone")
    _, said = process.communicate(timeout=100)
    assert process.returncode == 0, said
    return values_of(folder / "alone")


class Machines:
    """A scheduler and workers, each a process."""

    def __init__(self, folder: Path):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.folder, self.address = folder, f"tcp://127.0.0.1:{port}"
        self.scheduler = self._start("dask_scheduler", "--host", "127.0.0.1", "--port", str(port))
        self.workers: list[subprocess.Popen] = []

    def add(self, threads: int = 1, scheduler: str = "") -> subprocess.Popen:
        """scheduler : its address, as the worker sees it."""
        name = f"w{len(self.workers)}"
        options = ["--nthreads", str(threads), "--no-nanny", "--name", name, "--local-directory", str(self.folder)]
        self.workers.append(self._start("dask_worker", scheduler or self.address, *options))
        return self.workers[-1]

    def _start(self, module: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--dashboard-address", ":0"]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def cluster(self, problem: Problem, count: int, scheduler: str = "") -> executors.Cluster:
        """When that many workers are there."""
        connect(self.address).close()
        cluster = executors.Cluster(problem, scheduler or self.address)
        wait_for(lambda: len(cluster.workers.present()) == count)
        return cluster

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()


def connect(address: str, seconds: float = 60) -> socket.socket:
    """To a scheduler, as soon as it is there."""
    host, port = address.removeprefix("tcp://").split(":")
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        with suppress(ConnectionRefusedError):
            return socket.create_connection((host, int(port)))
        time.sleep(0.05)
    raise OSError(f"nobody listens at {address}")


class Relay:
    """Connections to a scheduler that can be cut, all at once. address : where it listens."""

    def __init__(self, address: str):
        self.to, self.open = address, True
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self.server.getsockname()[1]}"
        self.pairs: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                here, _ = self.server.accept()
                there = connect(self.to)
                self.pairs += [here, there]
                if not self.open:
                    self.cut()
                for one, other in ((here, there), (there, here)):
                    threading.Thread(target=self._copy, args=(one, other), daemon=True).start()

    def _copy(self, one: socket.socket, other: socket.socket) -> None:
        with suppress(OSError):
            while data := one.recv(2**16):
                other.sendall(data)
        self._shut(one, other)

    @staticmethod
    def _shut(*ends: socket.socket) -> None:
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def cut(self) -> None:
        """What is connected now. New connections are cut at once, too, unless the relay is `open`."""
        self._shut(*self.pairs)
        self.pairs.clear()

    def close(self) -> None:
        self.open = False
        self._shut(self.server, *self.pairs)


def wait_for(condition: Callable[[], bool], seconds: float = 60) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def fit_while(problem: Problem, cluster: executors.Cluster, step: int, happens: Callable[[], object], **options):
    """A fit, and what happens in the middle of one of its steps."""
    run = fitting.Fit(problem, executor=cluster, **options)

    @run.on_step
    def after(done: inverse.Step) -> None:
        if done.number == step:
            timer = threading.Timer(0.01, happens)
            timer.start()

    return run.run(progress=False)
