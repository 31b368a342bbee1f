"""Runs of fits: checkpoints and what becomes of them, other processes and machines, the command line."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import signal
import subprocess
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rimlight import inverse, scenes
from rimlight.cli import main
from rimlight.inverse import checkpoint, executors, fitting, progress, report
from rimlight.inverse import problem as problems
from rimlight.inverse.problem import Free, Loss, Problem, Stage, Starts, Target
from rimlight.inverse.renderer import Gradient, Renderer
from rimlight.inverse.result import Result

GREEN, RED, COLOUR = "green.vertex_positions", "red.vertex_positions", "green.bsdf.reflectance.value"
SHAPE = Free(key=(GREEN,), kind="shape", move="xy", rate=0.05, start=(0.2, -0.1, 0))
MATERIAL = Free(key=(COLOUR,), kind="material", rate=0.02, start=(0.2,))


def triangles(*free: Free, steps: int = 6, **options) -> Problem:
    options = {"stage": (Stage(iterations=steps),), "integrator": {"type": "direct_edge"}} | options
    options = {"target": (Target(spp=64),), "define": {"res": "16"}} | options
    return Problem(scene=scenes.path("two_triangles"), free=free or (SHAPE,), **options)


def fit(problem: Problem, **options) -> Result:
    return inverse.fit(problem, progress=False, **options)


def stopping_after(steps: int):
    """An executor in the middle of whose work somebody presses Ctrl-C."""
    calls = []

    class Pressed(executors.Here):
        def gradient(self, values, tasks):
            calls.append(1)
            if len(calls) == steps:
                os.kill(os.getpid(), signal.SIGINT)
            return super().gradient(values, tasks)

    return Pressed(Renderer(triangles()))


# ------------------------------------------------------------------ checkpoints

#: Arguments: folder, "start" or "resume", and how it ends: "whole", or it kills itself in the step of a number, between
#: checkpoints ("between") or while it writes one ("writing"). It says in which step it began. Each in a process of its
#: own: a second scene in the same process adds up in another order.
SCRIPT = """
import os, signal, sys
from rimlight import inverse
import drjit as dr
import numpy as np
from rimlight import exr
from rimlight.inverse import checkpoint, executors, fitting, problem, progress

dr.set_thread_count(1)
fitting.INTERVAL, progress.SHARE = 0, float("inf")  # a checkpoint after each step

folder, start, end, last = sys.argv[1:]
run = fitting.Fit(problem.read("fit.toml"), out=folder, resume=start == "resume")
print(run.progress.step, flush=True)

class Killing(executors.Here):
    def gradient(self, values, tasks):
        if run.progress.step == int(last):
            if end == "between":
                os.kill(os.getpid(), signal.SIGKILL)
            if end == "writing":
                exr.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
        if end == "between" and run.progress.step == int(last) - 3:
            fitting.INTERVAL = 1000
        return super().gradient(values, tasks)

run.executor = Killing(run.renderer)
found = run.run(progress=False)
errors = {label.replace("/", " "): e for label, e in found.errors.items()}
np.savez(folder + ".npz", losses=found.losses, segments=found.segments, **found.values, **errors)
"""


@pytest.mark.slow
def test_killed_fits_resume_bit_by_bit(tmp_path):
    """A fit that is killed among several starts, while a checkpoint is written, and in a later stage."""
    pose = Free(key=(RED,), kind="pose", move="xy", turn="z", start=(0.1, 0, 0, 0, 0, 20), rate=0.05)
    posed = triangles(
        *(SHAPE, MATERIAL, pose),
        stage=(Stage(iterations=10, resolution=12), Stage(iterations=20, rate=0.5, decay=0.1)),
        starts=Starts(count=3, move=0.1, turn=10, value=0.1),
        clip=2.0,
        parts=2,
        balance=True,
    )
    problems.write(tmp_path / "fit.toml", posed)
    (tmp_path / "run.py").write_text(SCRIPT)

    def run(folder: str, start: str, end: str = "whole", last: int = -1) -> int:
        """The step in which it began."""
        command = [sys.executable, "-W", "error", "run.py", folder, start, end, str(last)]
        process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
        assert process.returncode == (0 if end == "whole" else -signal.SIGKILL), process.stderr
        return int(process.stdout)

    assert run("whole", "start") == 0
    start, left = "start", 0
    for end, last in (("between", 17), ("writing", 37), ("between", 43)):
        assert run("killed", start, end, last) == left
        start, left = "resume", last if end == "writing" else last - 3
        _, facts = checkpoint.load(tmp_path / "killed" / "checkpoint.npz")
        assert facts["step"] == left
    assert run("killed", "resume") == left
    with np.load(tmp_path / "whole.npz") as whole, np.load(tmp_path / "killed.npz") as killed:
        assert len(whole["losses"]) == 50 and whole["losses"][-1] < whole["losses"][0]
        assert whole.keys() == killed.keys()
        for name in whole:
            np.testing.assert_array_equal(killed[name], whole[name], err_msg=name)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> Path:
    """Folder of a fit that was interrupted after 4 steps of 6."""
    folder = tmp_path_factory.mktemp("stopped") / "fit"
    found = fit(triangles(), out=folder, executor=stopping_after(4))
    assert found.status == "interrupted" and len(found.losses) == 4
    return folder


def test_interrupted_fits_resume(stopped, tmp_path):
    folder = tmp_path / "copy"
    folder.mkdir()
    (folder / "checkpoint.npz").write_bytes((stopped / "checkpoint.npz").read_bytes())
    whole = fit(triangles())
    resumed = fit(dataclasses.replace(triangles(), seconds=1000.0), out=folder, resume=True)
    assert resumed.status == "finished"
    np.testing.assert_allclose(resumed.losses, whole.losses, rtol=1e-4)
    np.testing.assert_allclose(resumed.values[GREEN], whole.values[GREEN], atol=1e-4)
    again = fit(triangles(), out=folder, resume=True)  # there is nothing left to do
    np.testing.assert_array_equal(again.losses, resumed.losses)
    np.testing.assert_array_equal(again.values[GREEN], resumed.values[GREEN])
    assert again.seconds == pytest.approx(resumed.seconds)


def test_checkpoints_hold_numbers_and_text_only(stopped):
    file = stopped / "checkpoint.npz"
    with zipfile.ZipFile(file) as archive:
        assert all(name.endswith(".npy") for name in archive.namelist())
    with np.load(file, allow_pickle=False) as arrays:
        kinds = {arrays[name].dtype.kind for name in arrays.files}
    assert kinds <= set("fiuU")
    assert sorted(path.name for path in stopped.iterdir()) == ["checkpoint.npz", "problem.toml"]
    assert problems.read(stopped / "problem.toml") == triangles()


@pytest.mark.parametrize(
    ("change", "culprits"),
    [
        ({"seed": 1}, ["seed"]),
        ({"loss": Loss(norm="l1"), "parts": 2}, ["loss, parts"]),
        ({"stage": (Stage(iterations=7),)}, ["stage"]),
        ({"free": (dataclasses.replace(SHAPE, rate=0.1),)}, ["free"]),
        ({"define": {"res": "15"}}, ["define"]),
    ],
)
def test_checkpoints_of_other_fits_are_refused(stopped, change, culprits):
    with pytest.raises(ValueError) as error:
        fit(dataclasses.replace(triangles(), **change), out=stopped, resume=True)
    message = str(error.value)
    assert "\n" not in message and f"another {culprits[0]};" in message and "checkpoint.npz" in message


def damaged(whole: bytes) -> dict[str, bytes]:
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    return {"empty": b"", "half": whole[:middle], "flipped": flipped, "text": b"no checkpoint", "short": whole[:-3]}


@pytest.mark.parametrize("kind", ["empty", "half", "flipped", "text", "short", "other", "newer"])
def test_damaged_checkpoints_are_refused(stopped, tmp_path, kind):
    file = tmp_path / "checkpoint.npz"
    if kind == "other":
        np.savez(file, a=np.zeros(3))
    elif kind == "newer":
        np.savez(file, facts=np.array(json.dumps({"version": checkpoint.VERSION + 1})))
    else:
        file.write_bytes(damaged((stopped / "checkpoint.npz").read_bytes())[kind])
    before = file.read_bytes()
    with pytest.raises(ValueError) as error:
        fit(triangles(), out=tmp_path, resume=True)
    assert "\n" not in str(error.value) and "checkpoint.npz" in str(error.value)
    assert file.read_bytes() == before


def test_there_must_be_a_checkpoint(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint.*checkpoint\.npz"):
        fit(triangles(), out=tmp_path, resume=True)
    with pytest.raises(ValueError, match="name the folder"):
        fit(triangles(), resume=True)


def test_a_full_disk_stops_the_fit(tmp_path, monkeypatch):
    """At the first checkpoint that cannot be written; the last good one is kept, and goes on later."""

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(fitting, "INTERVAL", 0)
    monkeypatch.setattr(progress, "SHARE", float("inf"))  # a checkpoint after each step
    run = fitting.Fit(triangles(), out=tmp_path)
    steps = iter(run)
    next(steps), next(steps)
    first = (tmp_path / "checkpoint.npz").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.np.lib.format, "write_array", full)
        found = run.run(progress=False)
    assert len(found.losses) == 3 and len(found.views) == 1
    assert re.fullmatch(
        r"stopped: cannot write .*checkpoint\.npz: No space left on device \([\d.e+]+ MB are free there\)", found.status
    )
    assert (tmp_path / "checkpoint.npz").read_bytes() == first
    assert fit(triangles(), out=tmp_path, resume=True).status == "finished"


def test_checkpoints_take_a_twentieth_of_the_time(tmp_path, monkeypatch):
    """With a clock of our own: a step takes 1 s, and a checkpoint 2 s, which every 5 s would be too much."""
    now, written = [0.0], []
    monkeypatch.setattr(fitting, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    run = fitting.Fit(triangles(MATERIAL, steps=100), out=tmp_path)

    class Idle(executors.Here):
        def gradient(self, values, tasks):
            now[0] += 1
            return Gradient({COLOUR: np.zeros(3, np.float32)}, {t.key: 1.0 for t in tasks}, {t.key: {} for t in tasks})

    def save(file):
        now[0] += 2
        written.append(run.progress.step)

    run.executor, run.save = Idle(run.renderer), save
    assert len(list(run)) == 100
    assert written[0] == 6 and written[1] - written[0] == 41  # the first one tells what they cost
    assert written[-1] == 100 and 2 * (len(written) - 1) <= 0.05 * 100 + 2


def test_a_report_is_written_with_what_fits(tmp_path, monkeypatch):
    """What cannot be written is named, and keeps nothing else from being written."""

    def full(path, *_):
        raise OSError(f"cannot write {path}: No space left on device")

    found = fit(triangles(steps=1))
    monkeypatch.setattr(report, "write_exr", full)
    with pytest.raises(OSError, match=r"start_0\.exr: No space left on device, and 2 other files; .* MB are free"):
        inverse.write(tmp_path, found, title="Full")
    names = {path.name for path in tmp_path.iterdir()}
    assert names >= {"report.html", "result.json", "result.npz", "problem.toml", "result_0.png", "target_0.png"}


# ------------------------------------------------------------------ command line


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "joint.toml"
    problems.write(path, triangles(SHAPE, MATERIAL))
    return path


def steps_of(folder: Path) -> int:
    return json.loads((folder / "result.json").read_text())["steps"]


def test_command(file, tmp_path, capfd):
    out = tmp_path / "deep" / "out"
    assert main(["fit", "joint", str(file), "--out", str(out)]) == 0
    said = capfd.readouterr().out
    assert "finished: 6 steps" in said and str(out / "report.html") in said and "green: farthest vertex" in said
    names = {path.name for path in out.iterdir()}
    assert names >= {"report.html", "result.json", "result.npz", "problem.toml", "checkpoint.npz", "result_0.exr"}
    assert steps_of(out) == 6
    assert "joint" in (out / "report.html").read_text("utf-8")
    with np.load(out / "result.npz") as found:
        assert found.keys() == {GREEN, COLOUR}
        first = dict(found)
    assert problems.read(out / "problem.toml") == problems.read(file)

    assert main(["fit", "joint", str(file), "--out", str(out)]) == 2  # not over a fit that is there
    (line,) = capfd.readouterr().err.splitlines()
    assert "holds a fit already" in line and "--resume" in line
    assert main(["fit", "joint", str(file), "--out", str(out), "--resume"]) == 0
    with np.load(out / "result.npz") as found:
        np.testing.assert_array_equal(found[GREEN], first[GREEN])
    assert main(["fit", "joint", str(file), "--out", str(out), "--resume", "--seed", "3"]) == 2
    assert "another seed" in capfd.readouterr().err


def test_kinds_and_options_of_the_command(file, tmp_path, capfd):
    out = tmp_path / "out"
    options = ["--stage.0.iterations", "3", "--loss.norm", "l1", "--seed", "5"]
    assert main(["fit", "material", str(file), "--out", str(out), *options]) == 0
    written = problems.read(out / "problem.toml")
    assert written.free == (MATERIAL,) and written.seed == 5 and written.loss.norm == "l1"
    assert written.stage == (Stage(iterations=3),) and steps_of(out) == 3
    with np.load(out / "result.npz") as found:
        assert found.keys() == {COLOUR}


def test_exit_codes_of_fits_that_stop(file, tmp_path, capfd, monkeypatch):
    gradient = Renderer.gradient
    broken = lambda *a: dataclasses.replace(gradient(*a), losses=dict.fromkeys((t.key for t in a[-1]), float("nan")))

    def pressed(*a):
        os.kill(os.getpid(), signal.SIGINT)
        return gradient(*a)

    for name, function, code, status in (("a", broken, 1, "gave up"), ("b", pressed, 130, "interrupted")):
        out = tmp_path / name
        monkeypatch.setattr(Renderer, "gradient", function)
        assert main(["fit", "joint", str(file), "--out", str(out), "--max-bad", "2"]) == code
        assert status in capfd.readouterr().out
        assert status in (out / "report.html").read_text("utf-8")
        assert json.loads((out / "result.json").read_text())["status"].startswith(status)


@pytest.mark.parametrize(
    ("arguments", "culprits"),
    [
        (["joint", "gone.toml", "--out", "o"], ["gone.toml"]),
        (["joint", "bad.toml", "--out", "o"], ["bad.toml", "sead"]),
        (["pose", "joint.toml", "--out", "o"], ['"pose"', "material, shape"]),
        (["joint", "joint.toml", "--out", "bad.toml"], ["bad.toml", "not a folder"]),
        (["joint", "joint.toml", "--out", "bad.toml/o"], ["bad.toml", "not a folder"]),
        (["joint", "joint.toml", "--out", "o", "--workers", "-1"], ["--workers", "-1"]),
        (["joint", "joint.toml", "--out", "o", "--parts", "0"], ["parts must be >= 1, got 0"]),
        (["joint", "joint.toml", "--out", "o", "--integrator.type", "direct_egde"], ["direct_egde"]),
        (["joint", "joint.toml", "--out", "o", "--resume"], ["checkpoint.npz"]),
        (["joint", "joint.toml", "--out", "o", "--cluster", "nonsense://1"], ["nonsense://1"]),
        (["joint", "unknown.toml", "--out", "o"], ["gren.vertex_positions", "did you mean green"]),
    ],
)
def test_mistakes_end_in_one_line(file, tmp_path, capfd, monkeypatch, arguments, culprits):
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text("sead = 3\n" + file.read_text())
    Path("unknown.toml").write_text(file.read_text().replace(GREEN, "gren.vertex_positions"))
    assert main(["fit", *arguments]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("rimlight: error: ")
    for culprit in culprits:
        assert culprit in line
    assert not Path("o", "report.html").exists()
