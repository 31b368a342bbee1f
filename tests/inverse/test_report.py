"""The report of a fit: it needs nothing but itself, says what happened, works in a browser; and the files beside it."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pages import Page, in_browser
from PIL import Image

from rimlight import scenes
from rimlight.exr import read_exr
from rimlight.inverse import animation, fitting, page, problem, report, result
from rimlight.inverse.problem import Free, Problem, Stage, Starts, Target
from rimlight.inverse.result import Result, ViewOfFit

NASTY = '<script>alert("a&b")</script> \'$x^$'


@pytest.fixture(scope="module")
def fit() -> Result:
    free = lambda name, start: Free(
        key=(f"{name}.vertex_positions",), kind="shape", move="xy", rate=0.05, start=(*start, 0.0)
    )
    posed = Problem(
        scene=scenes.path("two_triangles"),
        define={"res": "32"},
        target=(Target(spp=256),),
        free=(free("green", (0.2, -0.1)), free("red", (-0.2, 0.3))),
        stage=(Stage(iterations=8), Stage(iterations=4, rate=0.5)),
        integrator={"type": "direct_edge"},
    )
    return fitting.fit(posed, progress=False)


@pytest.fixture(scope="module")
def folder(fit, tmp_path_factory) -> Path:
    """Everything of the fit."""
    path = tmp_path_factory.mktemp("report") / "new" / "folder"
    report.write(path, fit, title="Two triangles")
    return path


def written(path: Path, fit: Result, **options) -> Page:
    report.write_report(path, fit, **{"title": "A fit", **options})
    return Page(path.read_text("utf-8"))


# ------------------------------------------------------------------ the page


def test_durations_are_short():
    assert [report._duration(s) for s in (0.01234, 59.96, 599, 2206.6)] == ["0.0123 s", "60 s", "599 s", "37 min"]


def test_page_needs_nothing_but_itself(folder):
    source = (folder / "report.html").read_text("utf-8")
    for tag, attributes in Page(source).elements:
        for name in ("src", "href", "xlink:href", "srcset", "data", "poster", "action"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), f"<{tag} {name}={value[:80]}>"
    style = "".join(re.findall(r"<style.*?</style>", source, re.DOTALL))
    assert "@import" not in source
    assert not re.search(r"url\((?!#)", source)
    assert "http" not in style + page.SCRIPT
    assert "default-src 'none'" in source


def test_images_are_whole_and_not_blank(folder, fit):
    images = Page((folder / "report.html").read_text("utf-8")).images()
    pixels = [np.asarray(image.convert("RGB")) for image in images]
    assert len(pixels) == 6 + (folder / "convergence.gif").exists()
    assert all(np.ptp(a) > 0 for a in pixels)
    expected = [report.pictures.to_srgb(image) for image in (fit.views[0].target, fit.views[0].result)]
    np.testing.assert_array_equal(pixels[0], expected[0])
    np.testing.assert_array_equal(pixels[1], expected[1])


def test_page_says_what_happened(folder, fit):
    text = Page((folder / "report.html").read_text("utf-8")).text
    assert "finished" in text
    assert f"12 steps in {fit.seconds:.3g} s; loss {page.number(fit.losses[0])} → " in text
    for label, errors in fit.errors.items():
        assert label in text
        assert page.number(errors[0]) in text
        assert page.number(errors[-1]) in text
    for part in ("stage 2", "structural similarity", "−1.5000", "two_triangles.xml", "Mitsuba", "threads"):
        assert part in text
    assert "influence" not in text
    assert "farther" not in text


@pytest.mark.slow
def test_many_views_are_small(fit, tmp_path):
    """A page of 100 views, even of noise, which does not compress: the first and the worst ones in detail."""
    rng = np.random.default_rng(0)
    noise = [rng.random((256, 256, 3), np.float32) for _ in range(4)]
    view = lambda i: ViewOfFit(*(noise[(i + k) % 4] for k in range(3)), np.ones((256, 256), np.float32))
    measures = [{"root mean square error": (0.5, 0.9 if i in (17, 42, 99) else 0.1)} for i in range(100)]
    many = dataclasses.replace(fit, views=[view(i) for i in range(100)], measures=measures, floors=[])
    assert report._in_detail(many) == [0, 17, 42, 99]
    shown = written(tmp_path / "report.html", many)
    assert (tmp_path / "report.html").stat().st_size < 20e6
    assert len(shown.images()) >= 200 and "View 57: 0.50 → 0.10" in shown.text
    linked = report._views(many, beside=True)
    assert 'href="result_57.png"' in linked and 'href="result_57.png"' not in report._views(many)


def test_names_are_escaped(fit, tmp_path):
    odd = dataclasses.replace(
        fit,
        status=f"gave up: {NASTY}",
        silent=[NASTY],
        errors={f"{NASTY}: distance (scene units)": fit.errors[next(iter(fit.errors))]},
        latents={NASTY: np.ones(3, np.float32)},
        start={NASTY: np.zeros(3, np.float32)},
        measures=[{**fit.measures[0], NASTY: (1.0, 0.5)}],
        problem=dataclasses.replace(fit.problem, define={"name": NASTY}),
    )
    shown = written(tmp_path / "a.html", odd, title=NASTY, text=f"One {NASTY}\n\nTwo")
    source = (tmp_path / "a.html").read_text("utf-8")
    assert source.count("<script") == 1  # ours
    assert "alert(&quot;a&amp;b&quot;)" in source
    assert shown.text.count(NASTY) >= 9
    assert "Two" in shown.texts


def test_warnings_are_shown(fit, tmp_path):
    measures = [{"root mean square error": (0.1, 0.2)}]
    odd = dataclasses.replace(fit, status="interrupted", silent=["floor"], skipped=3, measures=measures)
    text = written(tmp_path / "a.html", odd).text
    assert "interrupted : 12 of 12 steps" in text
    assert "did not finish: interrupted" in text
    assert "Without influence on the pictures, and so not fitted: “floor”" in text
    assert "3 steps were skipped" in text
    assert "The picture is farther from its target than at the start" in text


def test_odd_fits_can_be_shown(fit, tmp_path):
    """Values that are not finite, views of other shapes, no truth, many numbers, several starts."""
    view = fit.views[0]
    grey = [image[:20, :, :1] for image in (view.start * np.nan, view.result, view.target)]
    wide = [np.tile(image, (1, 40, 1)) for image in (view.start, view.result, view.target)]
    views = [view, *(result.ViewOfFit(*images, images[0][..., 0] * 0) for images in (grey, wide))]
    many = np.linspace(0, 1, 300, dtype=np.float32)
    odd = dataclasses.replace(
        fit,
        losses=np.where(np.arange(12) < 9, fit.losses, np.nan),
        segments=np.repeat([0, 1, 2], 4),
        errors={f"body {i}: angle (degrees)": np.zeros(13) for i in range(report.CURVES + 1)},
        latents={"body.turn": np.float32([np.pi, 0, 0]), "body.move": np.float32([1e-6, 0, 0]), "texture": many},
        start={"body.turn": np.float32([0, 0, 0]), "body.move": np.float32([0, 0, 0]), "texture": 0 * many},
        views=views,
        measures=[*fit.measures, {"root mean square error": (np.nan, 1.0)}, *fit.measures],
        frames=[(0, view.start * np.nan), (12, view.result)],
        problem=dataclasses.replace(fit.problem, starts=Starts(count=2, value=0.1)),
    )
    shown = written(tmp_path / "a.html", odd)
    assert all(image.width <= max(page.WIDEST, 2 * animation.LARGEST) for image in shown.images())
    for part in ("View 2", "not finite", "180.00", "1.000 × 10⁻⁶", "300 numbers, mean 0.5000", "start 2", "of 13"):
        assert part in shown.text
    assert "body.turn (degrees)" in shown.text

    unknown = written(tmp_path / "b.html", dataclasses.replace(fit, errors={}))
    assert "truth" not in unknown.text


@pytest.mark.parametrize(
    ("x", "text"),
    [
        (0, "0"),
        (1, "1.00"),
        (0.0123456, "0.0123"),
        (-12345.6, "−12346"),
        (0.00099999, "0.00100"),
        (1.234e-5, "1.23 × 10⁻⁵"),
        (-9.999e7, "−1.00 × 10⁸"),
        (1e-40, "1.00 × 10⁻⁴⁰"),
        (float("nan"), "not finite"),
    ],
)
def test_numbers(x, text):
    assert page.number(x) == text


# ------------------------------------------------------------------ the files beside it


def test_files_read_back(folder, fit):
    names = {path.name for path in folder.iterdir()}
    video = {"convergence.gif", "convergence.mp4"} & names
    views = {f"{name}_0.{kind}" for name in ("start", "result", "target") for kind in ("exr", "png")}
    assert names == {"report.html", "result.json", "result.npz", "problem.toml"} | views | video
    assert len(video) == 1
    summary = json.loads((folder / "result.json").read_text("utf-8"))
    assert summary["steps"] == 12
    with np.load(folder / "result.npz", allow_pickle=False) as file:
        assert set(file.files) == set(fit.values)
        for key, value in fit.values.items():
            np.testing.assert_array_equal(file[key], value)
    assert problem.read(folder / "problem.toml") == problem.relative_to(fit.problem, Path.cwd())
    for name in ("start", "result", "target"):
        np.testing.assert_array_equal(read_exr(folder / f"{name}_0.exr")[0][""], getattr(fit.views[0], name))


def test_animation_as_gif(fit, tmp_path, monkeypatch):
    monkeypatch.setattr(animation.shutil, "which", lambda name: None)
    path = animation.write_animation(tmp_path, fit)
    assert path == tmp_path / "convergence.gif"
    with Image.open(path) as image:
        assert image.n_frames == len(fit.frames)
        assert image.info["loop"] == 0
        assert min(image.size) >= animation.ENLARGED
        shown = []
        for i in range(image.n_frames):
            image.seek(i)
            shown.append(np.asarray(image.convert("RGB"), np.int32))
    moved = lambda a, b: np.abs(a - b)[:, : a.shape[1] // 2].mean()
    assert moved(shown[0], shown[-1]) > 1
    monkeypatch.setattr(animation, "MOST", 1)  # bytes
    path = animation.write_animation(tmp_path, dataclasses.replace(fit, frames=[*fit.frames, *fit.frames]))
    with Image.open(path) as image:
        assert image.n_frames < 8


def test_animation_as_video(fit, tmp_path):
    if shutil.which("ffmpeg") is None:
        pytest.skip("needs ffmpeg")
    path = animation.write_animation(tmp_path, fit)
    if path.suffix == ".gif":
        pytest.skip("ffmpeg has no encoder for H.264")
    assert path.read_bytes()[4:8] == b"ftyp"
    assert "data:video/mp4" in (written(tmp_path / "a.html", fit), (tmp_path / "a.html").read_text("utf-8"))[1]


@pytest.mark.parametrize("program", ["#!/bin/sh\nexit 1\n", "no program"])
def test_broken_ffmpeg_gives_a_gif(fit, tmp_path, monkeypatch, program):
    if os.name != "posix":
        pytest.skip("needs a shell")
    (tmp_path / "bin").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "bin" / "ffmpeg").write_text(program)
    (tmp_path / "bin" / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert animation.write_animation(tmp_path / "out", fit) == tmp_path / "out" / "convergence.gif"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["convergence.gif"]


def test_nothing_is_left_behind(fit, tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("mine")
    for path in (file / "report.html", tmp_path / "none" / "report.html"):
        with pytest.raises(OSError, match=re.escape(str(path))):
            report.write_report(path, fit, title="A fit")
    for path in (file, file / "folder"):
        with pytest.raises(OSError, match=re.escape(str(file))):
            report.write(path, fit, title="A fit")
    (tmp_path / "old.html").write_text("old")
    monkeypatch.setattr(page, "page", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        report.write_report(tmp_path / "old.html", fit, title="A fit")
    assert (tmp_path / "old.html").read_text() == "old"
    assert file.read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"file", "old.html"}


# ------------------------------------------------------------------ in a browser

CHECK = """<script>
window.onload = () => {
  const done = {};
  const compare = document.querySelector(".compare");
  const [stack, slider] = [compare.querySelector(".stack"), compare.querySelector("input[type=range]")];
  const left = (name) => compare.querySelector(`.left[data-name=${name}]`);
  const clip = () => getComputedStyle(left("result")).clipPath;
  done.before = clip();
  slider.value = 25;
  slider.dispatchEvent(new Event("input"));
  done.after = clip();
  const box = stack.getBoundingClientRect();
  stack.setPointerCapture = () => {};
  stack.hasPointerCapture = () => true;
  const at = (part) => ({ clientX: box.left + part * box.width, clientY: box.top + 9, button: 0, bubbles: true });
  stack.dispatchEvent(new PointerEvent("pointerdown", at(0.4)));
  done.pressed = slider.valueAsNumber;
  done.focus = document.activeElement === slider;
  stack.dispatchEvent(new PointerEvent("pointermove", at(0.8)));
  done.dragged = slider.valueAsNumber;
  compare.querySelector("input[value=before]").click();
  done.shown = ["before", "result"].map((name) => left(name).checkVisibility());
  done.tag = compare.querySelector(".tag").textContent;
  done.loaded = [...document.images].every((image) => image.complete && image.naturalWidth > 0);
  done.width = document.documentElement.scrollWidth - window.innerWidth;
  done.errors = errors;
  document.title = JSON.stringify(done);
};
</script>"""


@pytest.mark.parametrize("width", [1200, 500])
def test_page_works_in_a_browser(folder, tmp_path, width):
    done = in_browser((folder / "report.html").read_text("utf-8"), CHECK, tmp_path, width)
    assert done["errors"] == []
    assert done["loaded"]
    assert "50%" in done["before"]
    assert "75%" in done["after"]  # hidden on the right
    assert done["pressed"] == pytest.approx(40, abs=0.5)
    assert done["dragged"] == pytest.approx(80, abs=0.5)
    assert done["focus"]
    assert done["shown"] == [True, False]
    assert done["tag"] == "before"
    assert done["width"] <= 0  # nothing sticks out
