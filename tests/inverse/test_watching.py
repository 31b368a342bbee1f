"""The page that shows a fit while it runs."""

from __future__ import annotations

import re
import urllib.error
import urllib.request

import pytest

from rimlight import inverse, scenes
from rimlight.inverse.problem import Free, Stage, Target

pytestmark = pytest.mark.usefixtures("no_derivative_image")


@pytest.fixture
def fit() -> inverse.Fit:
    return inverse.Fit(
        scene=scenes.path("two_triangles"),
        define={"res": "16"},
        target=Target(spp=16),
        free=Free(key="green.bsdf.reflectance.value", kind="material", rate=0.02, start=(0.2,)),
        integrator={"type": "direct_edge"},
        stage=(Stage(iterations=1, resolution=8), Stage(iterations=1)),
    )


def page(url: str, **headers: str) -> tuple[str, str | None]:
    """Text, and after how many seconds the browser asks again."""
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
        return answer.read().decode(), answer.headers["Refresh"]


def test_the_page_follows_the_fit(fit, monkeypatch):
    monkeypatch.setattr(inverse.watching, "PAUSE", 0.001)
    monkeypatch.setattr(inverse.watching, "SHARE", float("inf"))
    with inverse.Watch(fit, title="Mine & yours") as watch:
        assert watch.url.startswith("http://127.0.0.1:")
        assert "not done yet" in page(watch.url)[0]
        for step in fit:
            text, again = page(watch.url)
            assert f"{step.number + 1} of 2 steps" in text and "Mine &amp; yours" in text and again == "0.001"
            assert ">running<" in text and "did not finish" not in text and text.count("data:image/png") >= 3
    with pytest.raises(urllib.error.URLError):
        page(watch.url)


def test_other_names_of_the_page_are_refused(fit):
    """As of a page elsewhere whose name leads here."""
    with inverse.Watch(fit, title="Mine") as watch:
        for url, headers in ((watch.url, {"Host": "evil.example"}), (watch.url + "other", {})):
            with pytest.raises(urllib.error.HTTPError, match="404") as error:
                page(url, **headers)
            error.value.close()


def test_drawing_takes_a_twentieth_of_the_time(fit, monkeypatch):
    """With a clock of our own, for which a page takes a second."""
    now, drawn = [100.0], []
    monkeypatch.setattr(inverse.watching.time, "monotonic", lambda: now[0])
    watch = inverse.Watch(fit, title="Mine")

    def draw() -> None:
        watch._drawn = fit.image
        now[0] += 1
        drawn.append(now[0])

    watch._draw = draw
    for _ in range(100):
        if fit.shows():
            fit.image = object()
        watch(None)
        now[0] += 0.5
    watch._server.server_close()
    assert len(drawn) == 3 and drawn[1] - drawn[0] == pytest.approx(21, abs=0.6)


def test_the_command_prints_the_address(fit, tmp_path, capfd):
    from rimlight.cli import main

    inverse.problem.write(tmp_path / "fit.toml", fit.problem)
    assert main(["fit", "joint", str(tmp_path / "fit.toml"), "--out", str(tmp_path / "out"), "--watch"]) == 0
    assert re.search(r"^watch: http://127\.0\.0\.1:\d+/$", capfd.readouterr().out, re.MULTILINE)
