"""What once failed without a word: edited files, absurd targets, two threads, numbers that are none."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from rimlight import inverse, scenes
from rimlight.exr import write_exr
from rimlight.inverse import targets
from rimlight.inverse.problem import Free, Problem, Stage, Target

pytestmark = pytest.mark.usefixtures("no_derivative_image")

GREEN, COLOUR = "green.vertex_positions", "green.bsdf.reflectance.value"
MATERIAL = Free(key=(COLOUR,), kind="material", rate=0.02, start=(0.2,))

#: With a mesh and a texture in files of their own, and a text that is too long for the name of one.
SCENE = """<scene version="3.0.0">
    <integrator type="direct"/>
    <sensor type="perspective" id="camera">
        <transform name="to_world"><lookat origin="0, 0, -5" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/></film>
    </sensor>
    <emitter type="constant"><spectrum name="radiance" value="LONG"/></emitter>
    <shape type="ply" id="body">
        <string name="filename" value="meshes/body.ply"/>
        <bsdf type="twosided"><bsdf type="diffuse">
            <texture type="bitmap" name="reflectance"><string name="filename" value="tiles.png"/></texture>
        </bsdf></bsdf>
    </shape>
    <shape type="sphere" id="ball"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
</scene>"""


def write_scene(folder: Path) -> Path:
    (folder / "meshes").mkdir(parents=True)
    shutil.copy(scenes.path("two_triangles").parent / "meshes" / "torus.ply", folder / "meshes" / "body.ply")
    shutil.copy(scenes.path("two_triangles").parent / "textures" / "tiles.png", folder / "tiles.png")
    (folder / "scene.xml").write_text(SCENE.replace("LONG", ", ".join(f"{n}:1" for n in range(400, 700, 5))))
    write_exr(folder / "target.exr", {"": np.full((12, 12, 3), 0.3, np.float32)})
    write_exr(folder / "mask.exr", {"": np.ones((12, 12, 1), np.float32)})
    return folder


def ball(folder: Path) -> Problem:
    return Problem(
        scene=folder / "scene.xml",
        target=Target(file=folder / "target.exr", mask=folder / "mask.exr"),
        free=Free(key="ball.bsdf.reflectance.value", kind="material"),
        integrator={"type": "direct"},
        stage=Stage(iterations=2, spp=1),
    )


def edit(file: Path) -> None:
    if file.suffix == ".exr":
        write_exr(file, {"": np.full((12, 12, 3 if file.stem == "target" else 1), 0.7, np.float32)})
    elif file.suffix == ".png":
        mi.Bitmap(np.zeros((4, 4, 3), np.uint8)).write(str(file))
    elif file.suffix == ".xml":
        file.write_text(file.read_text().replace('type="sphere"', 'type="cube"'))
    else:
        shutil.copy(scenes.path("two_triangles").parent / "meshes" / "square.ply", file)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Folder of a fit, and of all that it is made from."""
    folder = write_scene(tmp_path_factory.mktemp("finished") / "work")
    inverse.fit(ball(folder), out=folder / "out", progress=False)
    return folder


@pytest.mark.parametrize(
    ("name", "culprit"),
    [
        ("scene.xml", "scene"),
        ("meshes/body.ply", "scene"),
        ("tiles.png", "scene"),
        ("target.exr", r"target\.0\.file"),
        ("mask.exr", r"target\.0\.mask"),
    ],
)
def test_a_fit_of_edited_files_is_not_resumed(finished, tmp_path, name, culprit):
    folder = tmp_path / "copy"
    shutil.copytree(finished, folder)
    edit(folder / name)
    with pytest.raises(ValueError, match=rf"^fit: {culprit} changed since .*checkpoint\.npz.* start anew$"):
        inverse.Fit(ball(folder), out=folder / "out", resume=True)


def test_a_fit_whose_folder_moved_is_resumed(finished, tmp_path):
    folder = tmp_path / "elsewhere"
    shutil.copytree(finished, folder)
    again = inverse.Fit(ball(folder), out=folder / "out", resume=True)
    assert again.progress.step == 2 and again.run(progress=False).status == "finished"


# ------------------------------------------------------------------ targets


def triangles(**options) -> Problem:
    options = {"free": MATERIAL, "stage": Stage(iterations=4), "target": Target(spp=16)} | options
    return Problem(
        scene=scenes.path("two_triangles"), define={"res": "16"}, integrator={"type": "direct_edge"}, **options
    )


def picture(value: float = 0.3, channels: int = 3) -> np.ndarray:
    return np.full((16, 16, channels), value, np.float32)


def strict_json(text: str):
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
def test_parameters_stay_finite(tmp_path):
    """Of a target so bright that squares of its gradients are not."""
    posed = triangles(target=picture(1e30), stage=Stage(iterations=30), max_bad=3)
    found = inverse.fit(posed, out=tmp_path, progress=False)
    assert found.status == "gave up: 3 steps in a row led to numbers that are not finite"
    assert found.skipped == 3 == len(found.losses)
    np.testing.assert_array_equal(found.values[COLOUR], np.float32([0.2] * 3))
    inverse.write(tmp_path, found, title="Absurd")
    summary = strict_json((tmp_path / "result.json").read_text())
    assert summary["values"][COLOUR] == pytest.approx([0.2] * 3)
    assert "not finite" in (tmp_path / "report.html").read_text("utf-8")


def test_a_result_that_is_not_finite_is_valid_json():
    found = inverse.fit(triangles(stage=Stage(iterations=1)), progress=False)
    found.losses[:] = found.errors[f"{COLOUR}: relative error"][:] = np.nan
    found.values[COLOUR][1] = np.inf
    summary = strict_json(inverse.result.summary(found))
    assert summary["errors"][f"{COLOUR}: relative error"] == [None, None]
    assert summary["values"][COLOUR][1] is None


def odd(change) -> np.ndarray:
    image = picture()
    change(image)
    return image


def put(value, *place):
    return lambda image: image.__setitem__(place, value)


@pytest.mark.parametrize(
    ("target", "culprit"),
    [
        (picture(1e6), r"mean of 1e\+06, the scene shows"),
        (odd(put(1e12, 3, 4)), r"1 of 256 pixels, up to 1e\+12, that outweigh all others.*exclude_above"),
        (odd(put(-1.0, slice(0, 4))), r"192 values below 0, down to -1"),
        (picture(0.4, 1), "is grey, the film has 3 channels"),
    ],
    ids=["bright", "pixel", "negative", "grey"],
)
def test_a_loss_without_meaning_is_said(caplog, tmp_path, target, culprit):
    found = inverse.fit(triangles(target=target), progress=False)
    (doubt,) = found.doubts
    assert doubt.startswith("Target 0 ") and doubt in caplog.messages
    with pytest.raises(AssertionError, match=culprit):
        raise AssertionError(doubt)
    inverse.write_report(tmp_path / "report.html", found, title="Doubts")
    assert doubt[:30] in (tmp_path / "report.html").read_text("utf-8")


def test_ordinary_targets_raise_no_doubts():
    rng = np.random.default_rng(0)
    image, weight = rng.uniform(0, 1, (32, 32, 3)), np.ones((32, 32))
    lamp, sun = image.copy(), image.copy()
    lamp[3:5, 3:6] = 20
    sun[7, 7], masked = 1e9, weight.copy()
    masked[7, 7] = 0
    ringing = image - 0.01 * (rng.uniform(0, 1, image.shape) < 0.1)  # of a filter with negative lobes
    for target, counts in ((image, weight), (lamp, weight), (sun, masked), (ringing, weight), (0 * image, weight)):
        assert targets.doubts(image, target.astype(np.float32), counts) == []
    assert len(targets.doubts(image, sun.astype(np.float32), weight)) == 2  # its mean is absurd as well


# ------------------------------------------------------------------ threads, numbers


def test_two_fits_in_two_threads():
    """They take turns, and find what each finds alone."""
    alone = [inverse.fit(triangles(seed=seed), progress=False) for seed in (1, 2)]
    found = {}

    def work(seed: int) -> None:
        found[seed] = inverse.fit(triangles(seed=seed), progress=False)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    for seed, expected in zip((1, 2), alone, strict=True):
        np.testing.assert_allclose(found[seed].losses, expected.losses, rtol=1e-4)


def test_steps_of_two_fits_alternate_in_two_threads():
    """Each records what depends on what the other one has just made."""
    here, there = inverse.Fit(triangles(seed=1)), inverse.Fit(triangles(seed=2))
    steps: list[object] = []

    def step() -> None:
        try:
            steps.append(there.step())
        except RuntimeError as error:
            steps.append(error)

    for _ in range(3):
        steps.append(here.step())
        thread = threading.Thread(target=step)
        thread.start()
        thread.join()
    assert [type(step) for step in steps] == 6 * [inverse.Step], steps


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_start_that_is_not_finite_is_said(bad):
    posed = triangles(free=Free(key=GREEN, kind="pose", start=(0, 0, 0, 0, 0, bad)))
    with pytest.raises(ValueError, match=f'^fit: the start of "green" must be finite, got {bad}$'):
        inverse.Fit(posed)
