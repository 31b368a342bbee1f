"""Photometric stereo: the model of direct light, and the fit of normals, colours and reflectance to it."""

from __future__ import annotations

import dataclasses
from copy import deepcopy

import numpy as np
import pytest
from photometric import LAMBERT, Scene, ball, glossy, height_field, near_ball

from rimlight import ggx
from rimlight.inverse.photometric_stereo import reconstruction
from rimlight.inverse.photometric_stereo.alternation import Alternations, State
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import HUBER, DirectModel, Guess, simplex_least_squares
from rimlight.inverse.photometric_stereo.evidence import Judge, Kind, left_out, mean_angle
from rimlight.inverse.photometric_stereo.rendering import Rendering
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit


@pytest.fixture(scope="module")
def plastic() -> Scene:
    """Convex, under lights that shine on all of it."""
    lobes, _ = ggx.read_dictionary()
    found = height_field(lobes, glossy(lobes), spiral(24, 45), lambda x, y: ball(x, y, 27))
    albedo = 1 + 0.3 * np.sin(np.arange(len(found.guess.albedo)))
    guess = dataclasses.replace(found.guess, albedo=albedo, exposures=np.linspace(0.8, 1.2, 24))
    values = found.model().predicted(guess).astype(np.float32)
    return found._replace(guess=guess, data=dataclasses.replace(found.data, values=values))


@pytest.mark.parametrize("kind", ["at infinity", "near", "near, in millimetres"])
def test_predictions_are_renderings_of_direct_light(plastic: Scene, kind: str) -> None:
    if kind == "at infinity":
        scene = plastic
        guess = dataclasses.replace(scene.guess, albedo=np.linspace(0.7, 1.3, len(scene.guess.albedo)))
        scene.rendering.update(guess, scene.depth)
    else:
        lobes = plastic.rendering.lobes
        scene = near_ball(lobes, glossy(lobes), 1000.0 if "millimetres" in kind else 1.0)
        guess = scene.guess
    predicted, image = scene.model().predicted(guess), scene.rendering.image(spp=64, seed=0, max_depth=2)
    assert predicted.min() > 0 and predicted.max() > 3 * predicted.min()
    assert np.abs(image / predicted - 1).mean() < (0.004 if kind == "at infinity" else 0.008)
    assert np.median(image / predicted) == pytest.approx(1, abs=0.003)


@pytest.mark.parametrize("kind", ["at infinity", "near", "near, in millimetres"])
def test_normals_are_found_with_a_known_bsdf(plastic: Scene, kind: str) -> None:
    scene = plastic
    if kind != "at infinity":
        lobes = plastic.rendering.lobes
        scene = near_ball(lobes, glossy(lobes), 1000.0 if "millimetres" in kind else 1.0)
        values = scene.model().predicted(scene.guess).astype(np.float32)
        scene = scene._replace(data=dataclasses.replace(scene.data, values=values))
    rng = np.random.default_rng(0)
    guess = deepcopy(scene.guess)
    guess.normals = unit(guess.normals + rng.normal(0, 0.08, guess.normals.shape))
    guess.albedo = guess.albedo * rng.uniform(0.7, 1.3, guess.albedo.shape)
    assert angles(guess.normals, scene.guess.normals).mean() > 4
    scene.model().fit_normals(guess, steps=12)
    assert angles(guess.normals, scene.guess.normals).max() < 0.05
    np.testing.assert_allclose(guess.albedo, scene.guess.albedo, rtol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(guess.normals, axis=1), 1, atol=1e-6)


def test_normals_with_fixed_albedo(plastic: Scene) -> None:
    guess = deepcopy(plastic.guess)
    guess.normals = unit(guess.normals + np.array([0.05, 0.05, 0]))
    plastic.model().fit_normals(guess, steps=12, free_albedo=False)
    assert angles(guess.normals, plastic.guess.normals).max() < 0.05
    np.testing.assert_allclose(guess.albedo, plastic.guess.albedo, rtol=1e-6)


def test_values_that_do_not_count_and_indirect_light(plastic: Scene) -> None:
    """Wrong values without weight change nothing, and known indirect light is taken off, for normals and BSDF."""
    rng = np.random.default_rng(0)
    values = plastic.data.values.copy()
    indirect = rng.uniform(0, 0.5, values.shape) * plastic.model().scale
    values += indirect.astype(np.float32)
    counts = np.ones(values.shape[:2])
    counts[:, 3:6] = 0
    values[:, 3:6] *= 3
    data = dataclasses.replace(plastic.data, values=values)
    start = dataclasses.replace(plastic.guess, normals=unit(plastic.guess.normals + np.array([0.05, -0.05, 0])))
    errors = {}
    for name, options in {"neither": {}, "both": {"counts": counts, "indirect": indirect}}.items():
        guess = deepcopy(start)
        model = DirectModel(data, plastic.rendering.lobes, **options)
        model.fit_normals(guess, steps=12)
        errors[name] = angles(guess.normals, plastic.guess.normals).max()
    assert errors["neither"] > 2
    assert errors["both"] < 0.05
    guess = deepcopy(plastic.guess)
    model.fit_bsdf(guess, rng)
    change = plastic.model().predicted(guess) - plastic.data.values
    assert np.abs(change).mean() < 0.003 * plastic.data.values.mean()


@pytest.mark.parametrize("several", [False, True])
def test_losses_of_pixels(plastic: Scene, several: bool) -> None:
    """Those of Huber, of what is not predicted."""
    rng, lobes = np.random.default_rng(0), plastic.rendering.lobes
    guess = Kind(several=several, coat=True).of(plastic.guess, lobes)
    guess.normals = unit(guess.normals + np.array([0.1, 0, 0]))
    counts = rng.uniform(0, 1, plastic.data.values.shape[:2]).astype(np.float32)
    indirect = rng.uniform(0, 0.1, plastic.data.values.shape) * plastic.model().scale
    model = DirectModel(plastic.data, lobes, counts=counts, indirect=indirect)
    x = np.linalg.norm(model.predicted(guess) - plastic.data.values, axis=2) / (HUBER * model.scale)
    expected = (counts * np.where(x < 1, x**2 / 2, x - 0.5)).sum(1)
    assert (x < 1).any() and (x > 1).any()
    np.testing.assert_allclose(model.losses(guess), expected, rtol=1e-3)


def test_pixels_begin_again_from_the_normals_of_the_surface(plastic: Scene) -> None:
    """Where that leaves less of their values; and else stay as they are."""
    data, lobes, rng = plastic.data, plastic.rendering.lobes, np.random.default_rng(0)
    counts = np.ones(data.values.shape[:2], np.float32)
    judge = Judge(data, lobes, left_out(data, 0), counts, 0, "trimmed")
    work = Alternations(data, lobes, Kind(), judge, reconstruction.Options(max_depth=2), rng)
    wrong = unit(plastic.guess.normals + np.array([1.0, 1.0, 0]))
    half = np.arange(len(wrong)) < len(wrong) / 2
    guess = dataclasses.replace(deepcopy(plastic.guess), normals=np.where(half[:, None], wrong, plastic.guess.normals))
    before = deepcopy(guess)
    work._begin_again(guess, plastic.model(), np.where(half[:, None], plastic.guess.normals, wrong))
    assert angles(guess.normals, plastic.guess.normals).max() < 0.5
    np.testing.assert_allclose(guess.albedo, plastic.guess.albedo, rtol=0.02)
    assert angles(before.normals, plastic.guess.normals)[half].min() > 20


def test_outliers(plastic: Scene) -> None:
    """Of values that are six times too large, no more counts than of those that are a tenth of the median too large."""
    values = plastic.data.values.copy()
    values[:, 4] *= 6
    slightly = plastic.data.values.copy()
    slightly[:, 4] += 0.1 * plastic.model().scale
    normals, reflected = [], []
    for wrong in (values, slightly):
        data = dataclasses.replace(plastic.data, values=wrong)
        model, guess = DirectModel(data, plastic.rendering.lobes), deepcopy(plastic.guess)
        for _ in range(3):
            model.fit_bsdf(guess, np.random.default_rng(0))
        reflected.append(np.abs(plastic.model().predicted(guess) / plastic.data.values - 1).mean())
        guess = deepcopy(plastic.guess)
        model.fit_normals(guess, steps=12)
        normals.append(angles(guess.normals, plastic.guess.normals).mean())
    assert normals[0] < 2 * normals[1] < 0.5
    assert reflected[0] < 2 * reflected[1] < 0.01


def test_bsdf_is_found_with_known_normals(plastic: Scene) -> None:
    """Its values, not its weights: several sums of lobes are alike."""
    model, guess = plastic.model(), deepcopy(plastic.guess)
    guess.weights = np.zeros_like(guess.weights)
    guess.weights[np.isnan(plastic.rendering.lobes.eta)] = 0.3
    error = lambda: np.abs(model.predicted(guess) - plastic.data.values).mean() / plastic.data.values.mean()
    assert error() > 0.2
    rng = np.random.default_rng(0)
    for _ in range(5):
        model.fit_bsdf(guess, rng)
    assert error() < 0.003
    assert guess.weights.min() >= 0 and guess.weights.sum(0).max() <= 1 + 1e-6


def leaning(normals: np.ndarray) -> np.ndarray:
    """Outwards, by up to 3 degrees."""
    return unit(normals + 0.06 * normals * [1, 1, 0])


def test_bsdf_is_found_while_normals_follow(plastic: Scene) -> None:
    """From normals that lean, it is right for those that do not."""
    model, guess = plastic.model(), deepcopy(plastic.guess)
    guess.normals = leaning(guess.normals)
    rng = np.random.default_rng(0)
    for _ in range(3):
        model.fit_bsdf(guess, rng)
    of_truth = dataclasses.replace(guess, normals=plastic.guess.normals)
    error = np.abs(model.predicted(of_truth) - plastic.data.values).mean() / plastic.data.values.mean()
    assert error < 0.002  # 0.0065 for normals that are held


@pytest.mark.parametrize("coat", [True, False])
def test_coat_needs_evidence(plastic: Scene, coat: bool) -> None:
    """It is taken where light is diffuse under a coat: if it then predicts better what was left out."""
    lobes = plastic.rendering.lobes
    coated = np.isnan(lobes.alpha) & ~np.isnan(lobes.eta)
    truth = deepcopy(plastic.guess)
    if coat:
        truth.weights[np.isnan(lobes.eta)] = 0
        truth.weights[coated] = (0.5, 0.35, 0.2)
    values = plastic.model().predicted(truth).astype(np.float32)
    values += np.float32(0.01 * np.median(values)) * np.random.default_rng(1).standard_normal(values.shape, np.float32)
    data = dataclasses.replace(plastic.data, values=values)
    model = plastic._replace(data=data).model()
    states = []
    for kind in (Kind(), Kind(coat=True)):
        guess, rng = deepcopy(truth), np.random.default_rng(0)
        guess.weights = glossy(lobes)
        guess.normals = leaning(guess.normals)
        for _ in range(4):
            model.fit_bsdf(guess, rng, coat=kind.coat)
            model.fit_normals(guess)
        judge, seen = judge_of(data, lobes), seen_by_all(data)
        errors, halves = judge.errors(guess, kind, *seen), np.nanmean(mean_angle(judge.apart(guess, *seen)))
        states.append(State(guess, plastic.depth, kind, errors.mean(), halves))
    plain, with_coat = states
    assert with_coat.needed_beside(plain) == coat
    found = states[coat].guess
    assert (found.weights[coated].sum(0) > 0.15).all() if coat else (found.weights[coated] == 0).all()
    assert angles(found.normals, truth.normals).mean() < 0.3


def judge_of(data: Dataset, lobes: ggx.Lobes) -> Judge:
    return Judge(data, lobes, left_out(data, 0), np.ones(data.values.shape[:2], np.float32), 0, "trimmed")


def seen_by_all(data: Dataset) -> tuple[np.ndarray, np.ndarray, None]:
    """Points, and what they see, far from all lights."""
    P, K, _ = data.values.shape
    return np.zeros((P, 3)), np.ones((P, K), bool), None


def glazed(plastic: Scene) -> tuple[Dataset, Guess]:
    """A dark half and a light one, under one clear coat."""
    lobes, truth = plastic.rendering.lobes, deepcopy(plastic.guess)
    truth = Kind(several=True, coat=True).of(truth, lobes)
    truth.weights[:] = 0
    truth.weights[np.nanargmin(np.abs(np.array(lobes.alpha) - 0.2))] = 0.8
    right = np.nonzero(plastic.data.mask)[1] > plastic.data.mask.shape[1] // 2
    truth.base = np.where(right[:, None], [0.03, 0.04, 0.2], [0.7, 0.65, 0.6])
    values = plastic.model().predicted(truth).astype(np.float32)
    return dataclasses.replace(plastic.data, values=values), truth


def test_where_a_glaze_is(plastic: Scene) -> None:
    """Of an object with a glaze on its upper half, normals of the lower half lean, as if there were one, too."""
    data, truth = glazed(plastic)
    upper = np.nonzero(data.mask)[0] < data.mask.shape[0] // 2
    truth.albedo = np.where(upper, 1.0, 0.0)
    data = dataclasses.replace(data, values=plastic.model().predicted(truth).astype(np.float32))
    model, lobes = plastic._replace(data=data).model(), plastic.rendering.lobes
    options, kind = reconstruction.Options(max_depth=2), Kind(several=True, coat=True)
    work = Alternations(data, lobes, kind, judge_of(data, lobes), options, np.random.default_rng(0))
    guess = dataclasses.replace(deepcopy(truth), albedo=np.ones_like(truth.albedo))
    model.fit_normals(guess, steps=6)
    before = angles(guess.normals, truth.normals)
    work._glaze(guess, model)
    after = angles(guess.normals, truth.normals)
    assert (guess.albedo == truth.albedo).mean() > 0.95
    assert before[~upper].mean() > 1 and after.mean() < 0.2 * before[~upper].mean()


def test_colours_under_a_glaze(plastic: Scene) -> None:
    """They are found with the normals and the glaze, none of which one material times a factor explains."""
    data, truth = glazed(plastic)
    model = plastic._replace(data=data).model()
    rng, errors, predicted = np.random.default_rng(0), {}, {}
    for kind in (Kind(), Kind(several=True, coat=True)):
        guess = deepcopy(plastic.guess)
        guess.normals, guess.weights = leaning(guess.normals), glossy(plastic.rendering.lobes)
        guess = kind.of(guess, plastic.rendering.lobes)
        for _ in range(8):
            model.fit_bsdf(guess, rng, coat=kind.coat)
            model.fit_normals(guess)
        errors[kind.several] = angles(guess.normals, truth.normals).mean()
        of_left = judge_of(data, plastic.rendering.lobes).errors(guess, kind, *seen_by_all(data))
        predicted[kind.several] = of_left.mean()
    print(errors, predicted, np.abs(guess.base - truth.base).mean())
    assert errors[True] < 0.5 < errors[False]
    assert predicted[True] < 0.2 * predicted[False]
    np.testing.assert_allclose(guess.base, truth.base, atol=0.03)
    rendered = Rendering(data, plastic.rendering.lobes, max_depth=2, several=True, base_eta=truth.base_eta)
    rendered.update(truth, plastic.depth)
    inside = np.abs(np.nonzero(data.mask)[1] - data.mask.shape[1] // 2 - 0.5) > 2  # the mesh blends the two colours
    image, values = rendered.image(spp=64, seed=0)[inside], data.values[inside]
    assert np.abs(image - values).mean() < 0.01 * values.mean()


def test_what_is_left_out(plastic: Scene) -> None:
    """Whole lights, and others of blocks; none of which the refit sees, so that wrong values there change no normal."""
    left = left_out(plastic.data, 0)
    K = left.shape[1]
    share = left.mean(0)
    assert (share == 1).sum() == max(round(0.1 * K), 1)
    assert ((share > 0) & (share < 1)).any()
    assert 0.1 < left.mean() < 0.35
    np.testing.assert_array_equal(left, left_out(plastic.data, 0))
    assert (left != left_out(plastic.data, 1)).any()
    few = dataclasses.replace(
        plastic.data, values=plastic.data.values[:, :3], lights=plastic.data.lights[:3], intensities=np.ones((3, 3))
    )
    assert not left_out(few, 0).any()
    judge = judge_of(plastic.data, plastic.rendering.lobes)
    right = judge.errors(plastic.guess, Kind(), *seen_by_all(plastic.data))
    values = plastic.data.values.copy()
    values[left] *= 1.2
    wrong = dataclasses.replace(judge, data=dataclasses.replace(plastic.data, values=values))
    found = wrong.errors(plastic.guess, Kind(), *seen_by_all(plastic.data))
    assert right.mean() < 0.01
    assert found.mean() == pytest.approx(0.2, rel=0.35)


def test_lighting() -> None:
    """Directions and irradiance of LEDs, by their formula; of lights at infinity."""
    scene = near_ball(LAMBERT, np.full((1, 3), 0.5), 1000.0)
    directions, irradiance = scene.model().lighting()
    points = scene.rendering.domain.points(scene.depth)
    for k, led in enumerate(scene.data.lights):
        offset = np.array(led.position) - points
        expected = np.clip(-unit(offset) @ unit(np.array(led.axis)), 0, 1) ** led.mu / (offset**2).sum(1)
        np.testing.assert_allclose(irradiance[:, k], expected, rtol=1e-4)
        np.testing.assert_allclose(directions[:, k], unit(offset), atol=1e-5)
    assert angles(scene.model().mean_directions(), directions.mean(0)).max() < 2
    lights = spiral(5, 30)
    model = DirectModel(Dataset(np.ones((4, 5, 3)), np.ones((2, 2), bool), lights, np.ones((5, 3))), LAMBERT)
    directions, irradiance = model.lighting()
    np.testing.assert_allclose(directions, lights, atol=1e-6)
    np.testing.assert_array_equal(irradiance, np.ones((1, 5)))
    np.testing.assert_allclose(model.mean_directions(), lights, atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_least_squares_on_a_simplex(seed: int) -> None:
    """Conditions of Karush, Kuhn and Tucker: where a number is not 0, the gradient is -λ; elsewhere, it is not less. λ
    is 0 unless the sum is 1."""
    rng = np.random.default_rng(seed)
    A = rng.uniform(0, 1, (40, 7)) * 10.0 ** rng.uniform(-2, 2)
    truth = rng.dirichlet(np.ones(7)) * (0.5 if seed % 2 else 3.0) - (0.05 if seed > 2 else 0)
    gram, moments = A.T @ A, A.T @ (A @ truth + rng.normal(0, 0.05, 40) * A.mean())
    x = simplex_least_squares(gram, moments)
    assert x.min() >= 0 and x.sum() <= 1 + 1e-9
    gradient = (gram @ x - moments) / np.abs(moments).max()
    multiplier = -gradient[x > 0].mean()
    np.testing.assert_allclose(gradient[x > 0], -multiplier, atol=2e-5)
    assert (gradient >= -multiplier - 2e-5).all()
    if seed % 2:
        assert x.sum() < 0.9 and multiplier == pytest.approx(0, abs=2e-5)
    else:
        assert x.sum() == pytest.approx(1) and multiplier > 0.01
