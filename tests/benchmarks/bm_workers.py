"""Fits over workers: what travels, what it costs, what kills do, and what a model says of many workers.

    python tests/benchmarks/bm_workers.py travel
    python tests/benchmarks/bm_workers.py checkpoints
    python tests/benchmarks/bm_workers.py crate             # the example of the docs
    python tests/benchmarks/bm_workers.py model
    python tests/benchmarks/bm_workers.py kills 20 0        # of workers: how many, and a seed
    python tests/benchmarks/bm_workers.py clients 20 0      # of the command

Each takes some minutes on two cores, the last one half an hour. Without a name, all are run.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster

from rimlight import inverse, scenes
from rimlight.inverse import Cluster, Free, Problem, Stage, Target, packing
from rimlight.inverse.renderer import Renderer
from rimlight.inverse.view import View

#: Views, their width, and the width of the texture that is fitted.
VIEWS, WIDTH, TEXTURE = 100, 256, 256

#: Steps that are timed, after as many that are not.
STEPS = 5


def scene_of(folder: Path, width: int = WIDTH, texture: int = TEXTURE) -> Path:
    """A textured box on a floor, under a sky, and a ring of cameras around it."""
    rng = np.random.default_rng(0)
    inverse.page.pictures.write_image(folder / "texture.png", rng.random((texture, texture, 3)))
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


#: On a worker: seconds in renders, and in all that is asked of a renderer for a step.
spent = {"render": 0.0, "backward": 0.0, "gradient": 0.0}


def watch_renders() -> None:
    """On a worker: note how long things take."""
    for of, name in ((View, "render"), (View, "backward"), (Renderer, "gradient")):
        inner = getattr(of, name)

        def timed(*arguments, inner=inner, name=name):
            began = time.perf_counter()
            try:
                return inner(*arguments)
            finally:
                sys.modules["bm_workers"].spent[name] += time.perf_counter() - began

        setattr(of, name, timed)


def times() -> dict[str, float]:
    """On a worker: seconds since this was asked last."""
    spent = sys.modules["bm_workers"].spent
    found = dict(spent)
    spent.update(dict.fromkeys(spent, 0.0))
    return found


@dataclass(frozen=True)
class Steps:
    """Medians over steps. step, rendering, gradient : seconds of a step, and of the slowest worker in renders and in
    all that is asked of it. bytes : over the client. size : of the gradient."""

    step: float
    rendering: float
    gradient: float
    bytes: float
    size: int


def measured(count: int, **options) -> Steps:
    """With so many workers of one thread each. options : see `scene_of`, `posed`."""
    import bm_workers  # as the workers import it

    with tempfile.TemporaryDirectory() as folder:
        problem = posed(scene_of(Path(folder), options.pop("width", WIDTH)), threads=None, **options)
        local = LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
        with local, Client((counter := Counter(local.scheduler_address)).address, set_as_default=False) as client:
            client.upload_file(__file__)
            client.run(bm_workers.watch_renders)
            client.run(_one_thread)
            with Cluster(problem, client) as cluster:
                fit = inverse.Fit(problem, executor=cluster)
                rows = []
                for _ in range(2 * STEPS):
                    client.run(bm_workers.times)
                    before, began = counter.bytes, time.perf_counter()
                    fit.step()
                    seconds, travelled = time.perf_counter() - began, counter.bytes - before
                    found = client.run(bm_workers.times).values()
                    slowest = (max(t["render"] + t["backward"] for t in found), max(t["gradient"] for t in found))
                    rows.append((seconds, *slowest, travelled))
                size = sum(4 * np.asarray(value).size for value in fit.values().values())
                return Steps(*np.median(np.array(rows[STEPS:]), 0), size)


def _one_thread() -> None:
    """On a worker: also if it is the only one of its machine."""
    import dask.system

    dask.system.CPU_COUNT = 1


def travel() -> None:
    found = measured(2)
    travelled, seconds = found.bytes / found.size, found.step / found.rendering
    print(f"gradient: {found.size} bytes; over the client: {found.bytes:.0f}, {travelled:.3f} times that")
    print(f"step: {found.step:.3f} s; renders of the slower worker: {found.rendering:.3f} s; {seconds:.3f} times that")


# ------------------------------------------------------------------ alone


def checkpoints() -> None:
    """Which part of the processor time of a fit its checkpoints take, with that at the end."""
    with tempfile.TemporaryDirectory() as folder:
        problem = posed(scene_of(Path(folder), texture=2 * TEXTURE), target=Target(spp=16))
        fit = inverse.Fit(replace(problem, stage=Stage(iterations=100)), out=folder)
        save, costs = fit.save, []

        def timed(file: Path) -> None:
            began = time.process_time()
            save(file)
            costs.append(time.process_time() - began)

        fit.save = timed  # type: ignore[method-assign]
        began = time.process_time()
        for _ in fit:
            pass
        whole, size = time.process_time() - began, (Path(folder) / "checkpoint.npz").stat().st_size / 1e6
        print(f"{len(costs)} checkpoints of {size:.1f} MB: {sum(costs):.2f} of {whole:.1f} s: {sum(costs) / whole:.1%}")


def crate() -> None:
    """The example of the docs: seconds by the clock and of processors, from the start of the command to its report."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "rimlight.scenes.turntable", folder], check=True)
        command = [sys.executable, "-m", "rimlight", "fit", "joint", "turntable.toml"]
        for options in (["--workers", "2"], []):
            began, before = time.perf_counter(), os.times()
            subprocess.run([*command, *options, "--out", "-".join(["result", *options])], cwd=folder, check=True)
            seconds, after = time.perf_counter() - began, os.times()
            busy = after.children_user + after.children_system - before.children_user - before.children_system
            print(
                f"{' '.join(options) or 'alone'}: {seconds:.0f} s by the clock, {busy:.0f} s of processors", flush=True
            )


# ------------------------------------------------------------------ kills


def small() -> Problem:
    """A fit of some seconds. With one thread, results are equal bit by bit."""
    return Problem(
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


def clients(count: int = 20, seed: int = 0) -> None:
    """The command, with two workers, is killed at a random moment, and resumed on one."""
    random.seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        inverse.problem.write(Path(folder) / "fit.toml", replace(small(), stage=Stage(iterations=400)))
        command = [sys.executable, "-m", "rimlight", "fit", "joint", "fit.toml"]
        start = lambda *options: subprocess.Popen([*command, *options], cwd=folder, stdout=subprocess.DEVNULL)
        began = time.perf_counter()
        start("--out", "whole", "--workers", "2").wait()
        seconds, result = time.perf_counter() - began, lambda name: np.load(Path(folder) / name / "result.npz")
        for i in range(1, count + 1):
            killed, moment = start("--out", str(i), "--workers", "2"), random.uniform(0.1, 0.9) * seconds
            with suppress(subprocess.TimeoutExpired):
                killed.wait(moment)
            killed.kill()
            killed.wait()
            begun = (Path(folder) / str(i) / "checkpoint.npz").exists()
            resumed = start("--out", str(i), "--workers", "1", *["--resume"] * begun)
            code, expected, found = resumed.wait(), result("whole"), result(str(i))
            same = all(np.array_equal(expected[key], found[key]) for key in expected.files)
            what = "resumed" if begun else "begun anew"
            print(f"{i}: killed after {moment:.1f} of {seconds:.1f} s, {what}: {code}, {same}", flush=True)


def kills(count: int = 20, seed: int = 0) -> None:
    """Fits over two workers that lose one at a random moment."""
    problem = small()
    random.seed(seed)
    expected: dict[str, np.ndarray] = {}
    for i in range(count + 1):
        local = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
        with local, Client(local, set_as_default=False) as client, Cluster(problem, client) as cluster:
            fit = inverse.Fit(problem, executor=cluster)
            moment = random.uniform(0.2, 2.5)
            timer = threading.Timer(
                moment, os.kill, (random.choice(list(client.run(os.getpid).values())), signal.SIGKILL)
            )
            if i:  # the first one is left alone
                timer.start()
            for _ in fit:
                pass
            lived = not timer.finished.is_set()
            timer.cancel()
            found = fit.latents()
            expected = expected or found
            same = all(np.array_equal(expected[key], value) for key, value in found.items())
            killed = "nobody was killed" if lived else f"killed after {moment:.2f} of {fit.progress.seconds:.2f} s"
            print(f"{i}: {killed}: {fit.status}, {'the same' if same else 'ANOTHER'}", flush=True)


# ------------------------------------------------------------------ a model


@dataclass(frozen=True)
class Costs:
    """Seconds and bytes of parts of a step.

    piece : of a part of a view, on one core. rest : of all else of a step, with one worker. task : of giving one task
    out and taking it back. add : of adding one gradient to another. size : of a gradient, bytes. latency, bandwidth :
    of the network, seconds and bytes per second. spread : standard deviation of the times of pieces, relative.
    """

    piece: float
    rest: float
    task: float
    add: float
    size: int
    latency: float = 1e-3
    bandwidth: float = 1e9
    spread: float = 0.2


def costs(**options) -> Costs:
    """Measured with one worker."""
    one = measured(1, **options)
    pieces = len(options.get("target", range(VIEWS))) * options.get("parts", 1)
    local = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
    with local, Client(local, set_as_default=False) as client:
        client.gather([client.submit(pow, i, 2, pure=False) for i in range(10)])
        began = time.perf_counter()
        client.gather([client.submit(pow, i, 2, pure=False) for i in range(200)])
        task = (time.perf_counter() - began) / 200
    packed = packing.pack({"a": np.random.default_rng(0).standard_normal(one.size // 4)})
    began = time.perf_counter()
    for _ in range(5):
        packing.pack({"a": packing.unpack(packed)["a"] + 1.0})
    return Costs(one.gradient / pieces, one.step - one.gradient, task, (time.perf_counter() - began) / 5, one.size)


def step_of(c: Costs, pieces: int, workers: int, loss: float, rng: np.random.Generator) -> float:
    """Seconds of a step. loss : probability, for each worker, that it is lost in a step; it is back in the next one."""
    fan, poll = inverse.workers.FAN, inverse.workers.POLL
    send = c.size / c.bandwidth + c.latency
    owned = np.bincount(np.arange(pieces) * workers // pieces, minlength=workers)
    times = lambda counts: c.piece * (counts + c.spread * np.sqrt(counts) * rng.standard_normal(len(counts)))
    # Values reach the other workers from those that have them, in log2 rounds.
    seconds = c.rest + c.task * (workers - 1) + send * np.ceil(np.log2(workers))
    done = times(owned)
    lost = rng.random(workers) < loss
    if 0 < lost.sum() < workers:  # what they had to do is put behind what the others have to do
        again = np.arange(owned[lost].sum()) * (workers - lost.sum()) // owned[lost].sum()
        noticed = rng.random() * done.max() + poll + c.task * len(set(again)) + send
        more = times(np.bincount(again, minlength=workers - lost.sum()))
        done = np.where(more > 0, np.maximum(done[~lost], noticed) + more, done[~lost])
    seconds += done.max()
    while workers > 1:  # double precision travels between workers
        seconds += c.task * -(-workers // fan) + min(workers, fan) * (2 * c.size / c.bandwidth + c.add) + c.latency
        workers = -(-workers // fan)
    return float(seconds)


def mean_step(c: Costs, pieces: int, workers: int, loss: float, steps: int = 400) -> float:
    rng = np.random.default_rng(0)
    return float(np.mean([step_of(c, pieces, workers, loss, rng) for _ in range(steps)]))


def model() -> None:
    """Checked with two real workers; then for many, with large pictures."""
    some = tuple(Target(sensor=i, spp=16) for i in range(0, VIEWS, 5))
    small = costs(target=some)
    print(small)
    two = measured(2, target=some)
    # How fast a core is while other cores work, and others use the machine, is not the model's matter.
    said = mean_step(replace(small, piece=two.gradient / (len(some) / 2), spread=0), len(some), 2, 0)
    print(f"two workers, {len(some)} views of {WIDTH}²: {said:.2f} s by the model, {two.step:.2f} s real")
    few = tuple(Target(sensor=i, spp=4) for i in range(2))
    large = costs(width=1024, target=few, parts=2, stage=Stage(iterations=2 * STEPS, spp=1))
    print(large)
    print("| workers | parts | losses | seconds a step | efficiency |\n|---:|---:|---:|---:|---:|")
    for workers, parts in ((2, 8), (16, 8), (64, 4), (64, 8), (64, 16), (256, 16), (1000, 16)):
        for loss in (0, 0.01):
            seconds = mean_step(large, VIEWS * parts, workers, loss)
            efficiency = VIEWS * parts * large.piece / (workers * seconds)
            print(f"| {workers} | {parts} | {loss:.0%} | {seconds:.2f} | {efficiency:.0%} |")


if __name__ == "__main__":
    all_of_them = {f.__name__: f for f in (travel, checkpoints, crate, model, kills, clients)}
    for name in sys.argv[1:2] or all_of_them:
        print(f"--- {name}", flush=True)
        all_of_them[name](*map(int, sys.argv[2:]))
