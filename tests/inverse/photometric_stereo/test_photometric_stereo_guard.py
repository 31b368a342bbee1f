"""Photometric stereo of what is hard: results are never worse than their start; data that tell nothing are refused, and
those that tell less than they seem to are reported."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from photometric import glossy
from PIL import Image
from scipy import ndimage

from rimlight import ggx
from rimlight.cli import main
from rimlight.exr import read_exr, replacing
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import (
    alternation,
    cost,
    dataset,
    least_squares,
    output,
    progress,
    report,
    simulation,
    start,
    taking_back,
)
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import Guess
from rimlight.inverse.photometric_stereo.evidence import FAR, Judge, Kind, left_out, mean_angle
from rimlight.inverse.photometric_stereo.rendering import Rendering, unlit
from rimlight.inverse.photometric_stereo.vectors import unit

N = 24
QUICK = {"resolutions": (1.0,), "iterations": (2,), "max_depth": 2, "brightness": 0.0}


def simulated(**options) -> Dataset:
    given = {"size": N, "lights": 12, "spp": 16, "max_depth": 2, **options}
    return simulation.simulate(simulation.Options(**given), progress=False)[0]


@pytest.fixture(scope="module")
def matte() -> Dataset:
    return simulated(noise=0.01)


def of_lights(data: Dataset, chosen: list[int]) -> Dataset:
    few = {"values": data.values[:, chosen], "lights": data.lights[chosen], "intensities": data.intensities[chosen]}
    return dataclasses.replace(data, **few)


# ------------------------------------------------------------------ the guard


def test_a_ruined_state_is_taken_back(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alternations that turn normals away from what the images show: the start is returned, and the result says so."""
    fit = alternation.Alternations.fit

    def ruined(self, guess, view):
        residual = fit(self, guess, view)
        guess.normals = unit(guess.normals + np.array([0.5, 0, 0]))
        return residual

    score = alternation.Alternations.score

    def without_refit(self, state, view):
        """As if nothing brought the normals back."""
        with monkeypatch.context() as patch:
            patch.setattr("rimlight.inverse.photometric_stereo.evidence.REFITS", 0)
            score(self, state, view)

    monkeypatch.setattr(alternation.Alternations, "fit", ruined)
    monkeypatch.setattr(alternation.Alternations, "score", without_refit)
    found = ps.reconstruct(matte, ps.Options(**QUICK, reflectance=False), progress=False)
    assert found.history[-1]["error"] > 10
    assert found.verdict == "start"
    np.testing.assert_allclose(found.guess.normals, found.start, atol=1e-9)
    assert found.left_out["start"] <= found.left_out["result"]


def test_the_best_state_is_kept(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the last one."""
    scores = iter([3.0, 1.0, 2.0, 2.5])

    def score(self, state, view):
        state.left_out = next(scores)

    states = []
    monkeypatch.setattr(alternation.Alternations, "score", score)
    monkeypatch.setattr(taking_back, "of_the_whole", lambda *_: 0.0)  # no mean with the start
    monkeypatch.setattr(alternation.Alternations, "judged_start", lambda self, guess, *_: (alternation.State(
        guess, self.integrate(guess), self.kind, 4.0, start=True), None))  # fmt: skip
    options = ps.Options(**{**QUICK, "iterations": (4,), "tolerance": 0.0}, reflectance=False)
    found = ps.reconstruct(matte, options, progress=False, after=lambda r: states.append(r.guess.normals.copy()))
    assert len(states) == 4
    np.testing.assert_array_equal(found.guess.normals, states[1])
    assert found.verdict == "judged"
    assert found.left_out == {"start": 4.0, "result": 1.0}


def test_normals_of_halves_tell_a_wrong_model(matte: Dataset) -> None:
    """Of the right material they agree; of a wrong one they depend on where the lights are."""
    options = ps.Options(**QUICK)
    lobes = ggx.read_dictionary()[0]
    counts = np.ones(matte.values.shape[:2], np.float32)
    judge = Judge(matte, lobes, left_out(matte, 0), counts, 0, "trimmed")
    work = alternation.Alternations(matte, lobes, Kind(), judge, options, np.random.default_rng(0))
    guess = start.guess(matte, lobes, counts, options)
    guess.weights = glossy(lobes)
    guess.weights[~np.isnan(lobes.eta)] = 0
    view = work.view(guess, work.integrate(guess))
    right = mean_angle(judge.apart(guess, view.points, view.seen, None))
    assert np.nanmean(right) < 1
    guess.weights = glossy(lobes)
    assert np.nanmean(mean_angle(judge.apart(guess, view.points, view.seen, None))) > 2 * np.nanmean(right)
    shown = np.zeros_like(view.seen)
    assert np.isnan(mean_angle(judge.apart(guess, view.points, shown, None))).all()


def test_images_without_light_spoil_no_half(matte: Dataset) -> None:
    """Halves are those of the lights that shone, also of the start: it trims its values, which is robust against few
    that are black."""
    lobes, options, off = ggx.read_dictionary()[0], ps.Options(**QUICK), [1, 4]
    values = matte.values.copy()
    values[:, off] *= np.float32(0.01)
    found = []
    for data in (dataclasses.replace(matte, values=values), matte.without(off)):
        counts = start.counts(data, data, 1.0, 0.0)
        guess, plane = start.guess(data, lobes, counts, options), start.flat(data)
        seen = np.ones(counts.shape, bool)
        judge = Judge(data, lobes, left_out(data, 0), counts, 0, "trimmed")
        guess.exposures = np.ones(len(data.lights))
        points = np.array(plane.points).reshape(-1, 3)
        found.append(mean_angle(judge.apart(guess, points, seen, None, lights=plane.lighting())))
    assert list(np.flatnonzero(~counts_of(matte, values).any(0))) == off
    np.testing.assert_allclose(*found, atol=1e-4)


def counts_of(data: Dataset, values: np.ndarray) -> np.ndarray:
    changed = dataclasses.replace(data, values=values)
    return start.counts(changed, changed, 1.0, 0.0)


@pytest.mark.parametrize("spp", [8, 2000])
def test_small_images_are_smoothed_less_at_equal_noise(
    matte: Dataset, monkeypatch: pytest.MonkeyPatch, spp: int
) -> None:
    """Samples times the square of the width of the Gaussian is what the options say; `spp` is the fewest samples."""
    lobes, counts = ggx.read_dictionary()[0], np.ones(matte.values.shape[:2], np.float32)
    options = ps.Options(**{**QUICK, "max_depth": 3}, spp=spp, smoothing=1.5)
    judge = Judge(matte, lobes, left_out(matte, 0), counts, 0, "trimmed")
    work = alternation.Alternations(matte, lobes, Kind(), judge, options, np.random.default_rng(0))
    asked = {}

    def indirect(*, spp: int, seed: int) -> np.ndarray:
        asked["spp"] = spp
        return np.zeros_like(matte.values)

    monkeypatch.setattr(work.rendering, "indirect", indirect)
    monkeypatch.setattr(alternation, "_smooth", lambda pixels, mask, width: asked.update(width=width))
    guess = start.guess(matte, lobes, counts, options)
    work.view(guess, work.integrate(guess))
    assert asked["spp"] == max(spp, round(alternation.PATHS / N**2))
    assert asked["spp"] * asked["width"] ** 2 == pytest.approx(1.5**2 * spp)


def test_regions_are_taken_back(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the halves of the lights say that the start is better, it is kept, and elsewhere the result."""
    states = []
    left = np.nonzero(matte.mask)[1] < N / 2

    def apart(self, guess, points, seen, indirect, *, lights=None, pixels=None):
        pixels = self.pixels() if pixels is None else pixels
        off = np.full(len(pixels), 0.04) if lights is not None else np.where(left[pixels], 0.1, 0.002)
        return np.stack([off, 0 * off, 0 * off], 1)[None]

    monkeypatch.setattr(taking_back, "WIDTH", 1.0)
    monkeypatch.setattr(Judge, "apart", apart)
    monkeypatch.setattr(taking_back, "of_the_whole", lambda *_: 0.0)
    monkeypatch.setattr(alternation.State, "beats", lambda self, start: True)
    monkeypatch.setattr(alternation.State, "better_than", lambda self, other: True)
    options = ps.Options(**QUICK, reflectance=False)
    found = ps.reconstruct(matte, options, progress=False, after=lambda r: states.append(r.guess.normals.copy()))
    columns = np.nonzero(matte.mask)[1]
    far = columns < N / 2 - 4, columns > N / 2 + 4
    np.testing.assert_allclose(found.guess.normals[far[0]], found.start[far[0]], atol=0.01)
    assert min(np.abs(found.guess.normals[far[1]] - n[far[1]]).max() for n in states) < 1e-6
    assert found.taken_back == pytest.approx(0.5, abs=0.1)
    assert "The start has a share of" in output.judgement(found)[-1]


def test_means_of_start_and_result_have_the_least_error(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of normals with errors that are known: half of those of the result are those of the start, too."""
    rng, lobes = np.random.default_rng(0), ggx.read_dictionary()[0]
    options, counts = ps.Options(**QUICK, reflectance=False), np.ones(matte.values.shape[:2], np.float32)
    judge = Judge(matte, lobes, left_out(matte, 0), counts, 0, "trimmed")
    work = alternation.Alternations(matte, lobes, Kind(), judge, options, np.random.default_rng(0))
    guess = start.guess(matte, lobes, counts, options)
    errors = 0.1 * rng.standard_normal((3, 9, len(counts), 3))  # of eight halves, and of all lights
    of_both = {"start": errors[0] + errors[1], "result": errors[0] + 0.5 * errors[2]}

    def apart(self, guess, points, seen, indirect, *, lights=None, pixels=None):
        e = of_both["result" if lights is None else "start"][:, self.pixels() if pixels is None else pixels]
        return e[:4] - e[4:8]

    monkeypatch.setattr(Judge, "apart", apart)
    normals = {name: unit(matte.truth + e[8]) for name, e in of_both.items()}
    depth = work.integrate(guess)
    first, best = (alternation.State(dataclasses.replace(guess, normals=n), depth, Kind()) for n in normals.values())
    lights = start.flat(matte).lighting()
    found, share = taking_back.taken_back(work, best, first, lights, work.view(guess, best.depth))
    assert share == pytest.approx(0.25 / 1.25, abs=0.02)
    square = lambda n: np.square(np.radians(angles(n, matte.truth))).mean()
    assert square(found.guess.normals) < 0.98 * min(square(n) for n in normals.values())


def test_a_result_must_win_in_all() -> None:
    state = lambda left_out, halves, curl: alternation.State(
        None, None, Kind(), left_out=left_out, halves=halves, curl=curl
    )
    start = state(0.1, 5.0, 2.0)
    assert state(0.09, 4.9, 2.9).beats(start)
    assert not state(0.09, 5.1, 1.0).beats(start)
    assert not state(0.11, 4.0, 1.0).beats(start)
    assert not state(0.09, 4.0, 3.1).beats(start)
    nothing = state(np.nan, np.nan, np.nan)
    assert not nothing.beats(nothing)


def test_a_result_whose_halves_have_nothing_in_common_is_not_taken() -> None:
    """However much better it is than the start."""
    state = lambda halves: alternation.State(None, None, Kind(), left_out=0.3, halves=halves, curl=2.0)
    start = dataclasses.replace(state(26.0), left_out=0.4)
    assert state(FAR / 2 - 0.1).beats(start)
    assert not state(FAR / 2 + 0.1).beats(start)


def test_other_materials_must_be_clearly_better() -> None:
    """Predictions and halves of the lights together by a part; and predictions must not be worse."""
    state = lambda left_out, halves, kind: alternation.State(None, None, kind, left_out=left_out, halves=halves)
    plain = state(0.1, 5.0, Kind())
    assert state(0.09, 4.0, Kind(several=True)).needed_beside(plain)
    assert not state(0.09, 4.5, Kind(several=True)).needed_beside(plain)
    assert state(0.099, 3.7, Kind(several=True)).needed_beside(plain)
    assert not state(0.101, 3.0, Kind(several=True)).needed_beside(plain)


def test_states_are_compared_by_predictions_and_halves_together() -> None:
    """Under a coat, too. Where halves are not known, by predictions; where nothing is, the newer one is kept."""
    state = lambda left_out, halves: alternation.State(None, None, Kind(coat=True), left_out=left_out, halves=halves)
    before = state(0.1, 5.0)
    assert state(0.101, 4.9).better_than(before)
    assert not state(0.103, 4.9).better_than(before)
    assert not state(0.099, 5.1).better_than(before)
    assert state(0.099, np.nan).better_than(before)
    assert state(0.11, 6.0).better_than(state(np.inf, np.nan))
    assert state(np.nan, np.nan).better_than(before)


def test_a_coat_is_put_on_colours_and_taken_off() -> None:
    lobes, count = ggx.read_dictionary()[0], 4
    bare = Guess(np.zeros((count, 3)), np.ones(count), np.ones(2), np.full((len(lobes), 3), 0.01))
    plain = Kind(several=True).of(bare, lobes)
    assert np.isnan(plain.base_eta)
    coated = Kind(several=True, coat=True).of(plain, lobes)
    assert coated.base_eta == 1.5 and np.isnan(Kind(several=True).of(coated, lobes).base_eta)
    np.testing.assert_array_equal(coated.base, plain.base)


def test_of_another_material_only_what_was_fitted_is_kept(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """And from the normals of a glossy surface; of the same material, what was there before is kept."""
    begun = []
    run = alternation.Alternations.run

    def noted(self, course, record, view=None):
        unfitted = course.state.guess.normals.copy()
        best = run(self, course, record, view)
        begun.append((self.kind.coat, np.array_equal(best.guess.normals, unfitted)))
        return best

    # Each state is worse than the one before
    scores = iter(np.arange(1.0, 99.0))
    score = lambda self, state, view: setattr(state, "left_out", next(scores))
    monkeypatch.setattr(alternation.Alternations, "score", score)
    monkeypatch.setattr(alternation.Alternations, "judged_start", lambda self, guess, *_: (alternation.State(
        guess, self.integrate(guess), self.kind, 99.0, start=True), None))  # fmt: skip
    monkeypatch.setattr(alternation.Alternations, "run", noted)
    ps.reconstruct(matte, ps.Options(**QUICK, materials="one"), progress=False)
    assert begun[1:] == [(False, False), (False, True), (True, False)]


def test_each_state_has_the_interreflections_of_the_one_before(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """No mean of older ones, of wrong surfaces."""
    made, used, fit = iter(range(1, 99)), [], alternation.Alternations.fit

    def noted(self, guess, view):
        used.append(view.indirect.max())
        return fit(self, guess, view)

    def indirect(self, *, spp: int, seed: int) -> np.ndarray:
        return np.full_like(self.data.values, 1e-6 * next(made))

    monkeypatch.setattr(Rendering, "indirect", indirect)
    monkeypatch.setattr(alternation.Alternations, "fit", noted)
    options = ps.Options(**{**QUICK, "max_depth": 3, "iterations": (4,)}, reflectance=False, tolerance=0.0)
    ps.reconstruct(matte, options, progress=False)
    np.testing.assert_allclose(used, 1e-6 * np.arange(1, 5), rtol=1e-4)


def test_the_coat_is_reconsidered_at_the_largest_size(matte: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    run = alternation.Alternations.run

    def noted(self, course, record, view=None):
        made.append((self.data.mask.shape[0], self.kind, course.most))
        return run(self, course, record, view)

    monkeypatch.setattr(alternation.Alternations, "run", noted)
    options = ps.Options(resolutions=(0.5, 1.0), iterations=(1, 1), max_depth=2, brightness=0.0, materials="one")
    ps.reconstruct(matte, options, progress=False)
    assert [(kind, most) for size, kind, most in made if size == N // 2] == [
        (Kind(), 1), (Kind(), 3), (Kind(), 3), (Kind(coat=True), 3)]  # fmt: skip
    kinds = [kind for size, kind, _ in made if size == N]
    assert sorted(kind.coat for kind in kinds) == [False, True]
    assert options.others() == (9, 2) and cost.seconds(100, 12, options) > 0


def test_background_in_the_mask(matte: Dataset, caplog: pytest.LogCaptureFixture) -> None:
    """Its dark pixels, of any normals, do not wall in the object; dark parts of the object stay what they are."""
    mask = ndimage.binary_dilation(matte.mask, iterations=2)
    old = matte.mask[mask]
    values = np.zeros((len(old), *matte.values.shape[1:]), np.float32)
    values[old] = matte.values
    values[~old] = 0.03 * matte.typical * np.random.default_rng(0).random(values[~old].shape, np.float32)
    wide = dataclasses.replace(matte, mask=mask, values=values, truth=None)
    np.testing.assert_array_equal(unlit(wide), ~old)
    rows, columns = np.nonzero(matte.mask)
    middle = (abs(rows - N // 2) < 3) & (abs(columns - N // 2) < 3)
    values = np.where(middle[:, None, None], 0, matte.values)
    assert not unlit(dataclasses.replace(matte, values=values)).any()
    assert not unlit(dataclasses.replace(matte, values=np.zeros_like(values))).any()
    found = ps.reconstruct(wide, ps.Options(**QUICK, reflectance=False), progress=False)
    assert "taken for the background" in caplog.text
    assert angles(found.guess.normals[old], matte.truth).mean() < 1
    depth = found.depth[found.domain.inner]
    without = ps.reconstruct(matte, ps.Options(**QUICK, reflectance=False), progress=False)
    off = depth[old] - without.depth[without.domain.inner]
    assert np.ptp(off) < 1


def test_colours_are_written_and_shown(matte: Dataset, tmp_path: Path) -> None:
    """Of several materials, in the unit of the images."""
    options = ps.Options(**QUICK, reflectance=False)
    found = ps.reconstruct(matte, options, progress=False)
    found.guess = Kind(several=True).of(found.guess, found.lobes)
    output.write_numbers(tmp_path, found, options, status="finished")
    base = read_exr(tmp_path / "base.exr")[0][""]
    np.testing.assert_allclose(base[matte.mask], found.guess.base, rtol=1e-6)
    assert base[matte.mask].mean() == pytest.approx(0.5, rel=0.05)
    assert json.loads((tmp_path / "metadata.json").read_text("utf-8"))["materials"] == "several"
    report.write(tmp_path, found, options, title="colours", status="finished")
    text = (tmp_path / "report.html").read_text("utf-8")
    for said in ("Diffuse colours", "Glaze: on 100 % of the surface", "Values that were left out are predicted"):
        assert said in text


def test_maps_of_a_result(matte: Dataset) -> None:
    found = ps.reconstruct(matte, ps.Options(**QUICK, reflectance=False), progress=False)
    np.testing.assert_array_equal(found.normal_map[matte.mask], found.guess.normals)
    assert (found.normal_map[~matte.mask] == 0).all()
    assert found.depth_map.shape == matte.mask.shape
    np.testing.assert_array_equal(np.isfinite(found.depth_map), matte.mask)


# ------------------------------------------------------------------ several materials


def test_regions_of_materials() -> None:
    """As large as each other, another for each seed, each with its own colour, under one glaze."""
    colours = "glaze:0.05,0.05,0.4|glaze:0.7,0.7,0.7"
    first, again, other = (simulated(shape="folds", bsdf=colours, seed=s, spp=4) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.mask, again.mask)
    np.testing.assert_allclose(first.values, again.values, rtol=1e-5)
    assert first.values.shape != other.values.shape or np.abs(first.values - other.values).mean() > 0.01
    b = [least_squares.trimmed(first.values[..., c], first.lights) for c in (0, 2)]
    red, blue = (np.linalg.norm(x, axis=1) for x in b)
    assert 0.35 < (blue > 2 * red).mean() < 0.65


# ------------------------------------------------------------------ few lights


@pytest.mark.parametrize("method", ["trimmed", "least squares"])
def test_three_lights(matte: Dataset, method: str) -> None:
    """Trimming would leave one value of each pixel."""
    few = of_lights(matte, [3, 4, 5])
    lit = (few.values > 0).all((1, 2))
    found = least_squares.normals(few.luminance, few.lights, method)
    assert angles(found, matte.truth)[lit].mean() < 2


@pytest.mark.parametrize("K", [3, 4, 5, 7])
def test_few_lights_end_no_worse_than_they_start(K: int) -> None:
    """Of two colours, which one material with a factor for each pixel ruins if nothing is judged."""
    data = simulated(shape="folds", bsdf="diffuse:0.5,0.4,0.3|diffuse:0.2,0.3,0.5", lights=K, spread=45, seed=5)
    options = ps.Options(**QUICK | {"iterations": (3,)}, materials="one", coat=False)
    found = ps.reconstruct(data, options, progress=False)
    counts = start.counts(data, data, 1.0, options.dark)
    begun = start.guess(data, found.lobes, counts, options).normals
    before = angles(begun, data.truth).mean()
    if K == 3:
        np.testing.assert_array_equal(found.guess.normals, begun)
        assert found.verdict == "not judged" and "The start is kept" in output.judgement(found)[0]
    else:
        assert found.verdict in ("judged", "start") and np.isfinite(found.left_out["result"])
        assert found.error < before + 0.05


def test_what_is_left_out_of_few_lights() -> None:
    """At least three values of each pixel are kept, and each light is left out somewhere."""
    mask = np.ones((64, 64), bool)
    for K, count in ((3, 0), (4, 1), (7, 1), (8, 2)):
        data = Dataset(np.ones((64**2, K, 3), np.float32), mask, simulation.spiral(K, 40), np.ones((K, 3)))
        left = left_out(data, 0)
        assert (left.sum(1) == count).all() and left.all(0).sum() == (K >= 8)
        assert left.any() == (K > 3) == left.any(0).all()


def test_what_is_left_out_may_not_count() -> None:
    """Of a small flat thing, the darkest value of all pixels: then nothing is judged, and nothing divided by 0."""
    mask, lights = np.zeros((10, 10), bool), simulation.spiral(5, 40)
    mask[:8, :8] = True
    values = np.random.default_rng(0).normal(1, 1e-3, (64, 5, 3)) * (lights[:, 2:] / np.pi)
    data = Dataset(values.astype(np.float32), mask, lights, np.ones((5, 3)))
    darkest = lights[:, 2].argmin()
    for seed in range(40):
        left = left_out(data, seed)
        found = ps.reconstruct(data, ps.Options(**QUICK, seed=seed), progress=False) if left[0, darkest] else None
        if found is not None:
            break
    assert found.verdict == "not judged" and angles(found.guess.normals, [0, 0, 1]).mean() < 1
    exact = alternation.State(None, None, Kind(), left_out=0.0)
    assert exact.better_than(exact) and not dataclasses.replace(exact, left_out=0.1).better_than(exact)


def test_darkest_values_of_few_lights() -> None:
    values = np.random.default_rng(0).uniform(size=(20, 40))
    for K, kept in ((3, 3), (4, 4), (5, 4), (10, 8), (40, 32)):
        assert (least_squares.brightest(values[:, :K], 0.2).sum(1) == kept).all()


@pytest.mark.parametrize("how", ["equal", "in a plane"])
def test_lights_that_do_not_tell_normals(matte: Dataset, how: str) -> None:
    lights = np.tile(matte.lights[3], (12, 1)) if how == "equal" else unit(matte.lights * [1, 0, 1])
    with pytest.raises(ValueError, match="all equal, or lie in a plane"):
        ps.reconstruct(dataclasses.replace(matte, lights=lights), ps.Options(**QUICK), progress=False)


# ------------------------------------------------------------------ images


def test_black_images(matte: Dataset) -> None:
    black = dataclasses.replace(matte, values=np.zeros_like(matte.values))
    with pytest.raises(ValueError, match="all images are black"):
        ps.reconstruct(black, ps.Options(**QUICK), progress=False)


def test_a_mask_of_one_pixel(matte: Dataset) -> None:
    mask = np.zeros_like(matte.mask)
    mask[N // 2, N // 2] = True
    one = dataclasses.replace(matte, mask=mask, values=matte.values[:1], truth=matte.truth[:1])
    with pytest.raises(ValueError, match="1 pixels, at least 9"):
        ps.reconstruct(one, ps.Options(**QUICK), progress=False)


def test_clipped_images_are_reported_and_do_not_count(matte: Dataset, caplog: pytest.LogCaptureFixture) -> None:
    """At half of their maximum."""
    assert not matte.clipped.any()
    most = 0.5 * matte.values.max()
    data = dataclasses.replace(matte, values=np.minimum(matte.values, most))
    assert (data.clipped == (data.values >= most).any(2)).mean() > 0.999
    found = ps.reconstruct(data, ps.Options(**QUICK, reflectance=False), progress=False)
    assert "are clipped" in caplog.text
    whole = ps.reconstruct(matte, ps.Options(**QUICK, reflectance=False), progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dataset, "clipped", property(lambda self: np.zeros(self.values.shape[:2], bool)))
        counted = ps.reconstruct(data, ps.Options(**QUICK, reflectance=False), progress=False)
    print(whole.error, found.error, counted.error)
    assert found.error < 0.6 * counted.error


@pytest.mark.parametrize("method", least_squares.METHODS)
def test_starts_of_clipped_images(matte: Dataset, method: str) -> None:
    """Clipped at half of the brightest tenth, they leave that out, with a start twice as good or nearly. Trimming has
    no need of it where a few highlights are clipped and as many values are in shadow, and stays as robust as it is."""
    rng, most = np.random.default_rng(3), matte.values.max()
    few = np.where((rng.random(matte.values.shape[:2]) < 0.1)[..., None], most, matte.values)
    few = np.where((rng.random(matte.values.shape[:2]) < 0.1)[..., None], 0, few)
    for values, least in (
        (np.minimum(matte.values, 0.5 * np.quantile(matte.values, 0.9)), 1.4),
        (np.minimum(few, 0.95 * most), 1.0),
    ):
        data, options = dataclasses.replace(matte, values=values), ps.Options(start=method, exposures=False)
        counts, of = start.counts(data, data, 1.0, options.dark), start.method(data, data, 1.0, options)
        error = lambda used, name, data=data: angles(
            least_squares.normals(data.luminance, data.lights, name, used), data.truth
        ).mean()
        before = error(None, method)
        errors = [before, *(error(u, n) for n in (method, "least squares") for u in (~data.clipped, counts > 0))]
        found = start.guess(data, ggx.Lobes((np.nan,), (np.nan,)), counts, options, of).normals
        found = angles(found, data.truth).mean()
        print(data.clipped.mean(), errors, of[0], found)
        assert data.clipped.any() and found < before / least + 1e-6 and found < 1.2 * min(errors)


@pytest.mark.parametrize(("kind", "reported"), [("sRGB", True), ("linear", False)])
def test_pictures_of_8_bits_encoded_as_srgb(matte: Dataset, tmp_path, caplog, kind: str, reported: bool) -> None:
    folder = tmp_path / "data"
    simulation.dataset.write(folder, matte)
    names = []
    for k in range(12):
        linear = np.clip(matte.image(matte.values[:, k]) / matte.values.max(), 0, 1)
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        picture = np.round(255 * (srgb if kind == "sRGB" else linear)).astype(np.uint8)
        names.append(f"{k + 1:03d}.png")
        Image.fromarray(picture).save(folder / names[-1])
    (folder / "filenames.txt").write_text("\n".join(names))
    dataset.read(folder)
    assert ("look as if they were encoded as sRGB" in caplog.text) == reported


# ------------------------------------------------------------------ interruption, disk


def test_ctrl_c_waits_for_the_end_of_an_alternation(matte: Dataset, tmp_path, monkeypatch) -> None:
    """And then writes all that was found."""
    dataset.write(tmp_path / "data", matte)
    # Of a process in the background, a shell may have it ignored.
    visible, calls, before = Rendering.visible, [], signal.getsignal(signal.SIGINT)

    def pressed(self, model):
        calls.append(model)
        if len(calls) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return visible(self, model)

    monkeypatch.setattr(Rendering, "visible", pressed)
    out = tmp_path / "out"
    options = ["--resolutions", "1", "--iterations", "5", "--max-depth", "2", "--no-reflectance"]
    assert main(["ps", "run", str(tmp_path / "data"), "--out", str(out), *options]) == 130
    assert len(calls) == 2  # of the start, and of the state that the alternation made, which is judged, too
    metadata = json.loads((out / "metadata.json").read_text("utf-8"))
    assert metadata["status"] == "interrupted"
    assert len(metadata["history"]) == 1
    assert {"report.html", "mesh.ply", "normals.exr"} <= {path.name for path in out.iterdir()}
    assert signal.getsignal(signal.SIGINT) is before


def test_disk_full_names_the_file(tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match=r"cannot write .*numbers\.txt: No space left"),
        replacing(tmp_path / "numbers.txt"),
    ):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())


def test_beside_the_start_no_material_costs_more() -> None:
    """It was judged with the best of all. Beside a material that was fitted, and is worse than the start, another one
    need not be clearly better than the start."""
    state = lambda left_out, halves, **what: alternation.State(
        None, None, what.pop("kind", Kind()), left_out=left_out, halves=halves, curl=13.0, **what
    )
    begun, several = state(0.0869, 9.01, start=True), Kind(several=True)
    now = progress.Progress(kind=Kind(), start=begun)
    now.end_trial(begun)
    now.end_trial(state(0.0898, 8.03))
    assert now.best is begun
    now.end_trial(state(0.0820, 8.06, kind=several))
    assert now.best.kind == now.best_so_far().kind == several
    now.end_trial(state(0.0815, 7.54, kind=Kind(True, True)))
    assert now.best.kind == several


def test_materials_begin_from_glossy_normals_if_they_are_better() -> None:
    """In predictions and halves together, also where the start is kept until then."""
    state = lambda left_out, halves, **what: alternation.State(
        None, None, Kind(), left_out=left_out, halves=halves, curl=10.0, **what
    )
    for found, better in ((state(0.18, 8.0), True), (state(0.3, 10.0), False)):
        begun = state(0.17, 14.0, start=True)
        now = progress.Progress(kind=Kind(), start=begun)
        now.end_trial(begun)
        now.end_trial(found, settles=True)
        assert now.settled is (found if better else begun) and now.best is begun
        now.end_trial(state(0.1, 5.0))
        assert now.settled is (found if better else begun) and now.best is not begun
