"""Photometric stereo tells from the shading how near the lights are, where no file does."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rimlight import ggx
from rimlight.inverse import checkpoint
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import nearness, progress, reconstruction, report, simulation
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import DirectModel, Guess
from rimlight.inverse.photometric_stereo.rendering import Domain
from rimlight.inverse.photometric_stereo.vectors import unit

N, AWAY = 32, 5.0
QUICK = {"resolutions": (1.0,), "iterations": (3,), "reflectance": False, "max_depth": 2}


def folds(*, near: bool) -> Dataset:
    """Taken to have distant lights and an orthographic camera. If they are near, lights are `AWAY` widths of the image
    away."""
    where = {"led_distance": AWAY, "focal": 3 * AWAY} if near else {}
    scene = simulation.Options(
        shape="folds", bsdf="diffuse:0.5,0.4,0.3", size=N, lights=24, spread=45, spp=64, max_depth=2, seed=3, **where
    )
    data, _ = simulation.simulate(scene, progress=False)
    if not near:
        return data
    offsets = np.array([led.position for led in data.lights]) - [0, 0, -3 * AWAY * N]
    values = data.values * np.float32((AWAY * N) ** 2)
    return dataclasses.replace(data, values=values, lights=unit(offsets), camera=None, distance=None)


@pytest.fixture(scope="module")
def lit_from_near() -> Dataset:
    return folds(near=True)


def test_near_lights_are_told(lit_from_near: Dataset) -> None:
    """The distance is somewhat too large, for the normals of distant lights make up for a part of it."""
    found = ps.reconstruct(lit_from_near, ps.Options(**QUICK), progress=False)
    without = ps.reconstruct(lit_from_near, ps.Options(**QUICK, near_lights=False), progress=False)
    print(found.away / N, found.error, without.error)
    assert 0.7 * AWAY < found.away / N < 2 * AWAY
    assert np.isinf(without.away) and found.error < 0.7 * without.error
    # The depth is that of an orthographic camera
    assert found.data.camera is None and not found.data.near
    off = angles(found.domain.normals(found.depth), found.guess.normals).mean()
    assert off == pytest.approx(found.curl["result"], rel=0.1)
    # The report renders near lights
    view, options = report.View.of(found), ps.Options(**QUICK)
    off = lambda of: np.abs(report.rendered_again(view, of, options) - view.data.values).mean()
    assert off(found) < 0.75 * off(dataclasses.replace(found, away=np.inf))


def test_distant_lights_stay_distant() -> None:
    assert np.isinf(ps.reconstruct(folds(near=False), ps.Options(**QUICK), progress=False).away)


def test_they_must_explain_more(lit_from_near: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """A distance with which what is found is no better is given up, and what was found before counts."""
    without = ps.reconstruct(lit_from_near, ps.Options(**QUICK, near_lights=False), progress=False)
    monkeypatch.setattr(nearness, "distance", lambda *_: 1.2 * N)
    found = ps.reconstruct(lit_from_near, ps.Options(**QUICK), progress=False)
    assert np.isinf(found.away) and len(found.history) > len(without.history)
    assert found.left_out == without.left_out and found.halves == without.halves


def test_the_middle_stays_as_bright(lit_from_near: Dataset) -> None:
    """Values are as at infinity in the middle of the object, and brighter at what is closer to a light."""
    lobes = ggx.Lobes((np.nan,), (np.nan,))
    normals = np.tile([0.0, 0, 1], (len(lit_from_near.values), 1))
    guess = Guess(normals, np.ones(len(normals)), np.ones(24), np.full((1, 3), 0.5))
    near = nearness.around(lit_from_near, 4.0 * N)
    domain = Domain(near)
    points = domain.points(np.full(domain.wide.sum(), near.distance))
    shown = DirectModel(near, lobes, points=points).predicted(guess)[..., 0]
    distant = DirectModel(lit_from_near, lobes).predicted(guess)[..., 0]
    rows, columns = np.nonzero(lit_from_near.mask)
    x = columns - columns.mean()
    middle = np.argmin(np.hypot(x, rows - rows.mean()))
    np.testing.assert_allclose(shown[middle], distant[middle], rtol=0.02)
    right, light = x.argmax(), lit_from_near.lights[:, 0].argmax()
    # The offset, in the distance of the light, brings the light closer, and lowers it
    offset, direction = x[right] / (4 * N), lit_from_near.lights[light]
    left = direction - np.array([offset, (rows.mean() - rows[right]) / (4 * N), 0])
    expected = left[2] / np.linalg.norm(left) ** 3 / direction[2]
    assert shown[right, light] / distant[right, light] == pytest.approx(expected, rel=0.005)
    assert expected > 1.1


def test_lights_that_are_few_or_known_are_left_as_they_are(lit_from_near: Dataset) -> None:
    run = reconstruction.Reconstruction(lit_from_near.without(range(8)), ps.Options(**QUICK))
    result = run.finish(False)
    assert np.isinf(result.away) and run.now.away == np.inf


def test_killed_in_the_trial_they_go_on(
    lit_from_near: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the same distance, to the same result."""
    monkeypatch.setattr(progress, "SELDOM", 0)
    options = ps.Options(**QUICK)
    whole = ps.reconstruct(lit_from_near, options, progress=False)
    assert np.isfinite(whole.away)
    last = len(whole.history) - 1  # in the trial of near lights, which is the last one

    def stop(result: ps.Result) -> None:
        if len(result.history) == last:
            raise KeyboardInterrupt

    file = tmp_path / "run.npz"
    with pytest.raises(KeyboardInterrupt):
        ps.reconstruct(lit_from_near, options, progress=False, after=stop, checkpoint=file)
    assert checkpoint.load(file)[1]["away"] == whole.away
    found = ps.reconstruct(lit_from_near, options, progress=False, checkpoint=file, resume=True)
    assert found.away == whole.away and len(found.history) == len(whole.history)
    np.testing.assert_allclose(found.guess.normals, whole.guess.normals, atol=1e-4)
