"""Fits over workers: what travels, what it costs, what kills do, and what a model says of many workers.

    python tests/benchmarks/bm_workers.py travel
    python tests/benchmarks/bm_workers.py kills
    python tests/benchmarks/bm_workers.py model

`travel` needs a few minutes, and prints what `model` takes for granted: see `Measured`.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster

from rimlight import inverse, scenes
from rimlight.inverse import Cluster, Free, Problem, Stage, Target
from rimlight.inverse.view import View

#: Views, their width, and the width of the texture that is fitted.
VIEWS, WIDTH, TEXTURE = 100, 256, 256

#: Steps that are timed, after as many that are not.
STEPS = 5


def scene_of(folder: Path, width: int = WIDTH) -> Path:
    """A textured box on a floor, under a sky, and a ring of cameras around it."""
    rng = np.random.default_rng(0)
    inverse.page.pictures.write_image(folder / "texture.png", rng.random((TEXTURE, TEXTURE, 3)))
    sensors = "".join(
        f"""<sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
        <lookat origin="{5 * np.cos(a):.4f}, 3, {5 * np.sin(a):.4f}" target="0, 0.5, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{width}"/>
        <rfilter type="box"/></film></sensor>"""
        for a in 2 * np.pi * np.arange(VIEWS) / VIEWS
    )
    (folder / "scene.xml").write_text(f"""<scene version="3.0.0"><integrator type="direct"/>{sensors}
        <emitter type="constant"/>
        <shape type="cube" id="box"><transform name="to_world"><translate y="1"/></transform>
        <bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="texture.png"/>
        <boolean name="raw" value="true"/><string name="format" value="variant"/></texture></bsdf></shape>
        <shape type="rectangle" id="floor"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
        </transform><bsdf type="diffuse"/></shape></scene>""")
    return folder / "scene.xml"


def posed(scene: Path, **options) -> Problem:
    texture = Free(key="box.bsdf.reflectance.data", kind="material", rate=0.02, start=(0.5,))
    stage = Stage(iterations=2 * STEPS, spp=4)
    targets = tuple(Target(sensor=i, spp=16) for i in range(VIEWS))
    options = {"target": targets, "stage": stage, "integrator": {"type": "direct_edge"}} | options
    return Problem(scene=scene, free=texture, **options)


# ------------------------------------------------------------------ what travels


class Counter:
    """A relay to a scheduler that counts the bytes of both directions."""

    def __init__(self, address: str):
        self.host, self.port = address.removeprefix("tcp://").split(":")
        self.bytes = 0
        self.loop = asyncio.new_event_loop()
        started = threading.Event()

        async def serve() -> None:
            server = await asyncio.start_server(self._relay, "127.0.0.1", 0)
            self.address = f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
            started.set()

        def run() -> None:
            self.loop.run_until_complete(serve())
            self.loop.run_forever()

        threading.Thread(target=run, daemon=True).start()
        started.wait()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(self.host, self.port)
        await asyncio.gather(self._copy(reader, back), self._copy(there, writer))

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(2**20):
            self.bytes += len(data)
            writer.write(data)
            await writer.drain()
        writer.close()


rendering = [0.0]


def watch_renders() -> None:
    """On a worker: add up how long it renders."""
    for name in ("render", "backward"):
        inner = getattr(View, name)

        def timed(*arguments, inner=inner):
            began = time.perf_counter()
            try:
                return inner(*arguments)
            finally:
                module = sys.modules["bm_workers"]
                module.rendering[0] += time.perf_counter() - began

        setattr(View, name, timed)


def rendered() -> float:
    """On a worker: seconds since this was asked last."""
    module = sys.modules["bm_workers"]
    seconds, module.rendering[0] = module.rendering[0], 0.0
    return seconds


def travel() -> None:
    with tempfile.TemporaryDirectory() as folder:
        scene = scene_of(Path(folder))
        with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as local:
            counter = Counter(local.scheduler_address)
            with Client(counter.address, set_as_default=False) as client:
                import bm_workers  # as the workers import it

                client.upload_file(__file__)
                client.run(bm_workers.watch_renders)
                with Cluster(posed(scene), client) as cluster:
                    fit = inverse.Fit(posed(scene), executor=cluster)
                    time_steps(fit, client, counter)


def time_steps(fit: inverse.Fit, client: Client, counter: Counter) -> None:
    import bm_workers  # as the workers import it

    size = sum(4 * np.asarray(value).size for value in fit.values().values())
    rows = []
    for i in range(2 * STEPS):
        client.run(bm_workers.rendered)
        before, began = counter.bytes, time.perf_counter()
        fit.step()
        seconds, travelled = time.perf_counter() - began, counter.bytes - before
        rows.append((seconds, max(client.run(bm_workers.rendered).values()), travelled))
        print(f"step {i}: {seconds:.2f} s, rendering {rows[-1][1]:.2f} s, {travelled} bytes", flush=True)
    seconds, renders, travelled = np.median(np.array(rows[STEPS:]), 0)
    print(f"gradient: {size} bytes; over the client: {travelled:.0f} bytes, {travelled / size:.3f} times that")
    print(f"step: {seconds:.3f} s; rendering, slower worker: {renders:.3f} s; {seconds / renders:.3f} times that")


# ------------------------------------------------------------------ kills


def kills(count: int = 20) -> None:
    """Fits over two workers that lose one at a random moment; with one thread, results are equal bit by bit."""
    problem = Problem(
        scene=scenes.path("two_triangles"),
        define={"res": "32"},
        target=tuple(Target(spp=64) for _ in range(6)),
        free=(
            Free(key="green.vertex_positions", kind="shape", move="xy", rate=0.02, start=(0.2, -0.1, 0)),
            Free(key="red.bsdf.reflectance.value", kind="material", rate=0.02, start=(0.2,)),
        ),
        stage=Stage(iterations=40),
        integrator={"type": "direct_edge"},
        threads=1,
    )
    random.seed(0)
    results = []
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as local:
        for i in range(count + 1):
            with Client(local, set_as_default=False) as client, Cluster(problem, client) as cluster:
                fit = inverse.Fit(problem, executor=cluster)
                processes = list(client.run(os.getpid).values())
                moment = random.uniform(0.2, 4.0)
                if i:
                    timer = threading.Timer(moment, os.kill, (random.choice(processes), signal.SIGKILL))
                    timer.start()
                for _ in fit:
                    pass
                results.append(fit.latents())
                same = all(np.array_equal(results[0][key], value) for key, value in results[-1].items())
                print(
                    f"{i}: killed after {moment:.2f} s: {fit.status}, {'the same' if same else 'ANOTHER'}", flush=True
                )
                if i:
                    timer.join()
                    client.wait_for_workers(2)


# ------------------------------------------------------------------ a model


@dataclass(frozen=True)
class Measured:
    """Seconds and bytes of parts of a step, as `travel` and the scheduler's log give them.

    render : of a part of a view. update : of the scene, once per worker. client : of the optimiser and of packing.
    task : of giving one task out and taking it back. add : of adding one gradient to another. gradient : bytes.
    """

    render: float
    update: float
    client: float
    task: float
    add: float
    gradient: float
    latency: float = 1e-3
    bandwidth: float = 1e9
    spread: float = 0.05


def step_of(m: Measured, pieces: int, workers: int, loss: float, rng: np.random.Generator) -> float:
    """Seconds of a step. loss : probability that a worker is lost in it; it is back in the next one."""
    fan, poll = inverse.workers.FAN, inverse.workers.POLL
    send = m.gradient / m.bandwidth + m.latency
    owned = np.bincount(np.arange(pieces) * workers // pieces, minlength=workers)
    slow = lambda n: n * m.render * np.maximum(1 + m.spread * rng.standard_normal(np.shape(n)), 0.5)
    # The values reach the workers one after the other, from those who have them: in log2 rounds.
    ready = m.client + m.task * workers + send * (1 + np.ceil(np.log2(max(workers, 2))))
    done = ready + np.max(m.update + slow(owned))
    lost = rng.random(workers) < loss
    if lost.any() and not lost.all():
        left = workers - lost.sum()
        done += poll + m.task * left + send + m.update + np.max(slow(np.full(left, np.ceil(owned[lost].sum() / left))))
    level = workers
    while True:  # doubles travel between workers
        done += m.task * np.ceil(level / fan) + min(level, fan) * (2 * m.gradient / m.bandwidth + m.add) + m.latency
        level = int(np.ceil(level / fan))
        if level <= 1:
            return done + send


def efficiency(m: Measured, pieces: int, workers: int, loss: float, steps: int = 400) -> tuple[float, float]:
    """Seconds of a step, and rendering time over the time of all workers."""
    rng = np.random.default_rng(0)
    seconds = np.mean([step_of(m, pieces, workers, loss, rng) for _ in range(steps)])
    return float(seconds), pieces * m.render / (workers * seconds)


def model(m: Measured, parts: int = 8) -> None:
    print("| workers | parts | losses | seconds a step | efficiency |\n|---:|---:|---:|---:|---:|")
    for workers in (2, 16, 64, 256, 1000):
        for loss in (0, 0.01):
            seconds, share = efficiency(m, VIEWS * parts, workers, loss)
            print(f"| {workers} | {parts} | {loss:.0%} | {seconds:.2f} | {share:.0%} |")


if __name__ == "__main__":
    {"travel": travel, "kills": kills}[sys.argv[1]]()
