"""Reconstructions that are killed go on from their checkpoint, to the same result, bit by bit."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rimlight.cli import main
from rimlight.inverse import checkpoint
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import alternation, dataset, progress, simulation

N, LIGHTS = 20, 10
OPTIONS = ["--resolutions", "0.5", "1", "--iterations", "2", "2", "--brightness", "0", "--tolerance", "0"]
TWO_KINDS, QUICK = ["--coat", "False"], ["--no-reflectance", "--max-depth", "2"]

#: Arguments: how it ends, "whole", or it kills itself in the fit of an alternation ("fitting"), or in place of putting
#: the checkpoint after it where it belongs ("writing"); the number of that alternation; and those of `rimlight`.
#: Each in a process of its own.
SCRIPT = """
import os, signal, sys
from rimlight import exr
from rimlight.cli import main
from rimlight.inverse.photometric_stereo import alternation, progress, reconstruction, report

report.write = lambda *_, **__: None
progress.SELDOM, reconstruction.SETTLED = 0, 1
end, last, fit, made = sys.argv[1], int(sys.argv[2]), alternation.Alternations.fit, []

def killed(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def fitting(self, *arguments):
    made.append(1)
    if len(made) == last and end == "fitting":
        killed()
    if len(made) == last and end == "writing":
        exr.os.replace = killed
    return fit(self, *arguments)

alternation.Alternations.fit = fitting
sys.exit(main(sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("data") / "bowl"
    options = simulation.Options(shape="bowl", bsdf="diffuse:0.7,0.5,0.3", size=N, lights=LIGHTS, spp=16, noise=0.01)
    simulation.write(path, *simulation.simulate(options, progress=False), options)
    return path


def numbers(out: Path) -> dict:
    """All that a result says, but for times."""
    metadata = json.loads((out / "metadata.json").read_text("utf-8"))
    for entry in [metadata, *metadata["history"]]:
        entry.pop("seconds")
    return metadata


def test_killed_runs_resume_bit_by_bit(folder: Path, tmp_path: Path) -> None:
    """In a fit from the normals of a glossy surface, and in one with the second kind of material; and at the larger
    size, while a checkpoint is written."""
    (tmp_path / "run.py").write_text(SCRIPT)

    def run(out: str, *more: str, end: str = "whole", last: int = -1) -> None:
        command = [sys.executable, "run.py", end, str(last), "ps", "run", str(folder), "--out", out, "--threads", "1"]
        process = subprocess.run(
            [*command, *OPTIONS, *TWO_KINDS, *more], cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert process.returncode == (0 if end == "whole" else -signal.SIGKILL), process.stderr

    made = lambda: checkpoint.load(tmp_path / "killed" / "checkpoint.npz")[1]
    run("whole")
    assert [entry["size"] for entry in numbers(tmp_path / "whole")["history"]] == [0.5] * 5 + [1.0] * 2
    run("killed", end="fitting", last=3)
    assert len(made()["history"]) == 2 and made()["trial"] == 0
    run("killed", "--resume", end="fitting", last=3)
    assert len(made()["history"]) == 4 and made()["trial"] == 2
    run("killed", "--resume", end="writing", last=3)
    assert len(made()["history"]) == 6 and made()["level"] == 1
    assert list((tmp_path / "killed").glob(".checkpoint.*"))  # half of one
    (tmp_path / "killed" / ".normals.123.exr").write_text("half of another file")
    run("killed", "--resume")
    assert numbers(tmp_path / "killed") == numbers(tmp_path / "whole")
    names = {path.name for path in (tmp_path / "whole").iterdir()}
    assert {path.name for path in (tmp_path / "killed").iterdir()} == names
    for name in names - {"metadata.json"}:
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


@pytest.fixture(scope="module")
def stopped(folder: Path, tmp_path_factory) -> Path:
    """A run that was interrupted after its first alternation."""
    out = tmp_path_factory.mktemp("stopped") / "out"
    fit, calls = alternation.Alternations.fit, []

    def interrupted(self, *arguments):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return fit(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alternation.Alternations, "fit", interrupted)
        assert main(["ps", "run", str(folder), "--out", str(out), *OPTIONS, *QUICK]) == 130
    return out


def refused(capfd, arguments: list[str], *texts: str) -> None:
    assert main(["ps", "run", *arguments]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    for text in texts:
        assert text in line


def test_interrupted_runs_resume(folder: Path, stopped: Path, tmp_path: Path, capfd) -> None:
    out = tmp_path / "out"
    shutil.copytree(stopped, out)
    refused(capfd, [str(folder), "--out", str(out), *OPTIONS, *QUICK], "holds a run already", "add --resume")
    assert numbers(out)["status"] == "interrupted"
    assert main(["ps", "run", str(folder), "--out", str(out), *OPTIONS, *QUICK, "--resume"]) == 0
    assert numbers(out)["status"] == "finished"
    assert not (out / "checkpoint.npz").exists()
    assert main(["ps", "run", str(folder), "--out", str(out), *OPTIONS, *QUICK, "--resume"]) == 0
    assert "finished already" in capfd.readouterr().out


def test_there_must_be_a_checkpoint(folder: Path, tmp_path: Path, capfd) -> None:
    refused(capfd, [str(folder), "--out", str(tmp_path), "--resume"], "there is no checkpoint", "leave out --resume")


def test_other_options_are_refused(folder: Path, stopped: Path, capfd) -> None:
    given = [str(folder), "--out", str(stopped), *OPTIONS, *QUICK, "--resume"]
    refused(capfd, [*given, "--spp", "4", "--dark", "0.1"], "other options (dark, spp)", "give the same ones")
    refused(capfd, [*given, "--images", "8"], "number of images")
    assert numbers(stopped)["status"] == "interrupted"  # as before


@pytest.mark.parametrize("what", ["images", "mask", "lights"])
def test_other_data_are_refused(folder: Path, stopped: Path, tmp_path: Path, capfd, what: str) -> None:
    data = dataset.read(folder)
    if what == "images":
        values = data.values.copy()
        values[17, 3, 1] *= 1.001
        data = dataclasses.replace(data, values=values)
    elif what == "mask":
        mask = data.mask.copy()
        mask.flat[np.flatnonzero(mask)[0]] = False
        data = dataclasses.replace(data, mask=mask, values=data.values[1:], truth=data.truth[1:])
    else:
        data = dataclasses.replace(data, lights=data.lights[:, [1, 0, 2]])
    dataset.write(tmp_path / "data", data)
    given = [str(tmp_path / "data"), "--out", str(stopped), *OPTIONS, *QUICK, "--resume"]
    refused(capfd, given, "the data set has changed", what, "put the old one back")
    assert numbers(stopped)["status"] == "interrupted"  # as before


@pytest.mark.parametrize("damage", ["empty", "half", "another layout"])
def test_damaged_checkpoints_are_refused(folder: Path, stopped: Path, tmp_path: Path, capfd, damage: str) -> None:
    whole = (stopped / "checkpoint.npz").read_bytes()
    (tmp_path / "checkpoint.npz").write_bytes({"empty": b"", "half": whole[: len(whole) // 2]}.get(damage, b""))
    if damage == "another layout":
        np.savez(tmp_path / "checkpoint.npz", facts=np.array(json.dumps({"version": checkpoint.VERSION + 1})))
    refused(capfd, [str(folder), "--out", str(tmp_path), *OPTIONS, *QUICK, "--resume"], "ps: ", "checkpoint.npz")


def test_disk_that_fails_does_not_end_a_reconstruction(folder: Path, tmp_path: Path, monkeypatch, caplog) -> None:
    """The last checkpoint stays, and it is said once."""
    data, file = dataset.read(folder), tmp_path / "checkpoint.npz"
    options = ps.Options(resolutions=(1.0,), iterations=(2,), reflectance=False, max_depth=2, tolerance=0)
    save, calls = checkpoint.save, []

    def full(*arguments):
        calls.append(1)
        if len(calls) > 1:
            raise OSError(28, "No space left on device")
        save(*arguments)

    monkeypatch.setattr(progress, "SELDOM", 0)
    monkeypatch.setattr(checkpoint, "save", full)
    found = ps.reconstruct(data, options, progress=False, checkpoint=file)
    assert len(found.history) == 2 and len(calls) == 3
    assert sum("its last checkpoint stays" in record.message for record in caplog.records) == 1
    assert checkpoint.load(file)[1]["history"] == []


def test_writing_takes_a_small_part_of_the_time(folder: Path, tmp_path: Path, monkeypatch) -> None:
    """However long it takes."""
    written = progress.Checkpoint(tmp_path / "checkpoint.npz", dataset.read(folder), ps.Options())
    clock, saves = [0.0], []
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])

    def save(*_):
        saves.append(clock[0])
        clock[0] += 3

    monkeypatch.setattr(checkpoint, "save", save)
    now = progress.Progress(kind=ps.Options().kinds()[0])
    while clock[0] < 1000:
        written.save_if_due(now, np.random.default_rng(0))
        clock[0] += 5
    assert 10 < len(saves) <= 1000 / (3 * progress.SELDOM) + 1


def test_interruption_leaves_the_best_state(folder: Path, monkeypatch) -> None:
    """And not the last one."""
    scores, states = iter([3.0, 1.0, 2.0, 2.5]), []

    def score(self, state, view):
        state.left_out = next(scores)

    def after(result):
        states.append((result.guess.normals.copy(), result.left_out["result"]))
        if len(states) == 3:
            raise KeyboardInterrupt

    begin = alternation.Alternations.judged_start

    def judged_start(self, *arguments):
        state, view = begin(self, *arguments)
        return dataclasses.replace(state, left_out=4.0), view

    monkeypatch.setattr(alternation.Alternations, "score", score)
    monkeypatch.setattr(alternation.Alternations, "judged_start", judged_start)
    options = ps.Options(resolutions=(1.0,), iterations=(4,), reflectance=False, max_depth=2, tolerance=0)
    with pytest.raises(KeyboardInterrupt):
        ps.reconstruct(dataset.read(folder), options, progress=False, after=after)
    assert [left_out for _, left_out in states] == [3.0, 1.0, 1.0]
    np.testing.assert_array_equal(states[2][0], states[1][0])
    assert not np.array_equal(states[1][0], states[0][0])
