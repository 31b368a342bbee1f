"""Photometric stereo: the fit of normals and reflectance, path tracing, descent, and whole reconstructions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import pytest
from photometric import LAMBERT, UP, disc, glossy

from rimlight import ggx
from rimlight.checks import mean_and_error
from rimlight.inverse.photometric_stereo import reconstruction, refinement
from rimlight.inverse.photometric_stereo.alternation import Alternations, State
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.descent import ExponentiatedGradient, NormalAdam
from rimlight.inverse.photometric_stereo.direct import HUBER, DirectModel, Guess, simplex_least_squares
from rimlight.inverse.photometric_stereo.evidence import Judge, Kind, left_out
from rimlight.inverse.photometric_stereo.rendering import Rendering
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit
from rimlight.leds import Led

# ------------------------------------------------------------------ direct light


class Scene(NamedTuple):
    """A surface and all that a rendering of it needs. depth : of the Q pixels of the domain."""

    data: Dataset
    rendering: Rendering
    guess: Guess
    depth: np.ndarray

    def model(self, **options) -> DirectModel:
        return DirectModel(self.data, self.rendering.lobes, points=self.rendering.domain.points(self.depth), **options)


def made(data: Dataset, lobes: ggx.Lobes, weights: np.ndarray, surface: Callable, max_depth: int) -> Scene:
    """surface : of rows and columns of the domain and its camera: depth, and normals of any length."""
    rendering = Rendering(data, lobes, max_depth=max_depth)
    domain, (P, K, _) = rendering.domain, data.values.shape
    depth, normals = surface(*np.nonzero(domain.wide), domain.camera)
    guess = Guess(unit(normals)[domain.inner], np.ones(P), np.ones(K), np.array(weights, np.float64))
    rendering.update(guess, depth)
    return Scene(dataclasses.replace(data, truth=guess.normals), rendering, guess, depth)


def height_field(
    lobes: ggx.Lobes,
    weights: np.ndarray,
    lights: np.ndarray,
    height: Callable,
    *,
    N: int = 24,
    max_depth: int = 3,
    mask: np.ndarray | None = None,
) -> Scene:
    """An orthographic view, of a disc that fills 0.9 of its width N.

    height : of x and y, pixels, 0 in the middle of the image: z and its two derivatives.
    """
    mask = disc(N, ((N - 1) / 2, (N - 1) / 2), 0.45 * N) if mask is None else mask
    K = len(lights)
    data = Dataset(np.ones((int(mask.sum()), K, 3), np.float32), mask, lights, np.ones((K, 3)))

    def surface(row: np.ndarray, column: np.ndarray, camera: None) -> tuple[np.ndarray, np.ndarray]:
        z, along_x, along_y = np.broadcast_arrays(*height(column - (N + 1) / 2, (N + 1) / 2 - row))
        return z, np.stack([-along_x, -along_y, np.ones_like(z)], 1)

    return made(data, lobes, weights, surface, max_depth)


def ball(x: np.ndarray, y: np.ndarray, R: float, sign: int = 1) -> tuple[np.ndarray, ...]:
    """A cap of a ball, convex (1) or concave (-1)."""
    root = np.sqrt(np.maximum(R**2 - x**2 - y**2, 0.01 * R**2))
    return sign * root, -sign * x / root, -sign * y / root


def near_ball(lobes: ggx.Lobes, weights: np.ndarray, unit_of_length: float = 1.0, K: int = 6) -> Scene:
    """Before a camera with its principal point off the centre, under LEDs; the middle of the LEDs is the camera."""
    camera = np.array([[40.0, 0, 8.0], [0, 40, 13.0], [0, 0, 1]])
    centre, R = np.array([0.4, -0.25, -6.0]) * unit_of_length, 1.5 * unit_of_length

    def surface(row: np.ndarray, column: np.ndarray, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.stack([(column - camera[0, 2]) / 40, (camera[1, 2] - row) / 40, -np.ones(len(row))], 1)
        a, b, c = (rays**2).sum(1), rays @ centre, centre @ centre - R**2
        depth = (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        return depth, depth[:, None] * rays - centre

    leds = []
    for k, (x, y, z) in enumerate(spiral(K, 80).tolist()):
        position = np.array([2 * x, 2 * y, 0.5 - z]) * unit_of_length
        leds.append(Led(tuple(position), (0.1 - 0.1 * x, -0.15 * y, -1.0), 0.5 * (k % 4), (1.0, 1.0, 1.0)))
    mask = disc(24, (10.6, 14.7), 8)
    values = np.ones((int(mask.sum()), K, 3), np.float32)
    data = Dataset(values, mask, tuple(leds), np.ones((K, 3)), camera, distance=unit_of_length)
    found = made(data, lobes, weights, surface, 3)
    distance = float(np.exp(np.log(found.depth).mean()))
    return found._replace(data=dataclasses.replace(found.data, distance=distance))


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
        errors, halves = judge.errors(guess, kind, *seen), np.nanmean(judge.disagreement(guess, *seen))
        states.append(State(guess, plastic.depth, kind, errors.mean(), errors.std() / np.sqrt(len(errors)), halves))
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


# ------------------------------------------------------------------ path tracing


def bowl(K: int = 6, spread: float = 50, albedo: float = 0.7, rim: float = 0.9, N: int = 24, **options) -> Scene:
    """Lambertian, a cap of a ball from within. rim : sine of its angle at the rim."""
    height = lambda x, y: ball(x, y, 0.45 * N / rim, -1)
    return height_field(LAMBERT, np.full((1, 3), albedo) * [1, 0.8, 0.5], spiral(K, spread), height, N=N, **options)


def test_interreflections_of_a_bowl() -> None:
    """Two points of a sphere see each other by the form factor dA / (4 π R²), wherever they are: a bowl's indirect
    light is the same everywhere."""
    N, rim = 40, 0.8
    scene = bowl(N=N, rim=rim, max_depth=5)
    vertices, faces = scene.rendering.domain.mesh(scene.depth)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a) / 2
    sphere = 4 * np.pi * (0.45 * N / rim) ** 2
    flux = areas.sum(0) @ scene.data.lights.T  # through the opening, all of which the bowl receives
    albedo = scene.guess.weights[0]
    once = flux[:, None] * albedo**2 / np.pi / sphere
    again = albedo * np.linalg.norm(areas, axis=1).sum() / sphere
    assert again.min() > 0.07

    first = bowl(N=N, rim=rim, max_depth=3).rendering.indirect(spp=128, seed=1)
    direct, indirect = scene.rendering.image(spp=1, seed=1, max_depth=2), scene.rendering.indirect(spp=128, seed=1)
    np.testing.assert_allclose(first.mean(0), once, rtol=0.01)
    np.testing.assert_allclose(indirect.mean(0), once * (1 + again + again**2), rtol=0.01)
    rings = np.hypot(*(np.argwhere(scene.data.mask).T - (N - 1) / 2)) // 5
    for ring in range(4):
        assert indirect[rings == ring].mean() == pytest.approx(indirect.mean(), rel=0.05)
    assert direct[..., 0].std() > 0.1 * direct[..., 0].mean()


def test_lights_behind_a_step() -> None:
    """Its shadow ends where height over length is the tangent of the light's elevation."""
    N, height, edge = 24, 5.0, 8
    angle = np.radians([15, 30, 45, 60])
    lights = np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], 1)
    step = lambda x, y: (np.where(x + (N - 1) / 2 <= edge, height, 0.0), 0.0, 0.0)
    scene = height_field(LAMBERT, np.full((1, 3), 0.5), lights, step, N=N, mask=np.ones((N, N), bool))
    visible = scene.rendering.visible(scene.model()).reshape(N, N, 4)
    for k, tangent in enumerate(np.tan(angle)):
        length = np.arange(N) - edge
        expected = (length <= 0) | (length > height * tangent)
        # Rays begin half a pixel above the surface
        sure = (length <= 0) | (length > height * tangent + 0.1) | (length < (height - 0.5) * tangent - 0.1)
        sure &= (length <= 0) | (length > 1.6)
        np.testing.assert_array_equal(visible[:, sure, k], np.broadcast_to(expected[sure], (N, sure.sum())))
    assert 0.1 < visible.mean() < 0.9


def test_lights_behind_the_rim_of_a_bowl() -> None:
    """A ray leaves the sphere above the rim, or it does not leave it."""
    scene = bowl(K=12, spread=70)
    visible = scene.rendering.visible(scene.model())
    points = scene.rendering.domain.points(scene.depth)
    centre = np.array([12.5, -12.5, 0])  # of the first pixel of the larger image, in pixels
    p, towards = points - centre, scene.data.lights
    R = 0.45 * 24 / 0.9
    rim = -np.sqrt(R**2 - (0.45 * 24 + 0.5) ** 2)
    exit_height = p[:, 2:] - 2 * (p @ towards.T) * towards[:, 2]
    sure = np.abs(exit_height - rim) > 2.5
    assert sure.mean() > 0.7 and 0.05 < (exit_height < rim)[sure].mean() < 0.5
    assert (visible == (exit_height > rim))[sure].mean() > 0.998
    lit = scene.rendering.image(spp=16, seed=0, max_depth=2)[..., 0] > 1e-4
    assert (lit == visible)[sure & (p @ -towards.T > 1)].mean() > 0.99


def test_leds_inside_a_bowl() -> None:
    """Nothing that lies behind a light hides it."""
    camera = np.array([[40.0, 0, 12], [0, 40, 12], [0, 0, 1]])
    centre, R = np.array([0, 0, -5.0]), 1.6

    def surface(row: np.ndarray, column: np.ndarray, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.stack([(column - camera[0, 2]) / 40, (camera[1, 2] - row) / 40, -np.ones(len(row))], 1)
        a, b, c = (rays**2).sum(1), rays @ centre, centre @ centre - R**2
        depth = (b + np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        return depth, centre - depth[:, None] * rays

    leds = tuple(
        Led((x, 0.1, -6.0), (0.0, 0.0, -1.0), mu, (1.0, 1.0, 1.0)) for x, mu in ((-0.4, 0.0), (0, 1), (0.4, 3))
    )
    mask = disc(25, (12, 12), 8)
    data = Dataset(np.ones((int(mask.sum()), 3, 3), np.float32), mask, leds, np.ones((3, 3)), camera, distance=6.0)
    scene = made(data, LAMBERT, np.full((1, 3), 0.5), surface, 2)
    assert scene.rendering.visible(scene.model()).all()


@pytest.fixture(scope="module")
def plates() -> Scene:
    """Two plates that face each other, with a Lambertian and a glossy lobe; the lights shine on all of them.

    Flat, for derivatives of indirect light lack two terms: of edges, also between triangles of a smooth surface; and of
    the jumps where shading normals turn away from what triangles still see. In a smooth bowl of this size they are 2 to
    4 % of the derivative of indirect light with respect to depth."""
    lobes, N = ggx.Lobes((0.4, np.nan), (1.6, np.nan)), 16
    y, x = np.mgrid[:N, :N] - (N - 1) / 2
    lights = unit(spiral(4, 15) + np.array([0.25, 0.25, 0]))
    return height_field(
        lobes,
        np.array([[0.15] * 3, [0.8] * 3]),
        lights,
        lambda x, y: (np.abs(x), np.sign(x), 0.0),
        N=N,
        max_depth=4,
        mask=(np.abs(x) > 2) & (np.abs(y) < 6),
    )


def changes(scene: Scene) -> dict[str, np.ndarray]:
    """Directions of derivatives. Normals: all tilted to one side. Depth: the plates stand up. (What they exchange
    hardly depends on their form between fixed borders.)"""
    n, wide = scene.guess.normals, scene.rendering.domain.wide
    x = np.nonzero(wide)[1] - (wide.shape[1] - 1) / 2
    tilt = np.array([0.4, 0.9, 0])
    return {
        "normals": tilt - n * (n @ tilt)[:, None],
        "albedo": 1 + 0.5 * n[:, 0],
        "weights": np.array([[0.5, 1, 0.2], [0.3, 0.4, 1]]),
        "depth": np.abs(x) / 4 - 1,
    }


@pytest.mark.parametrize(
    ("name", "step", "spp", "gradient_spp"),
    [
        ("normals", 0.05, 1024, 1024),
        ("albedo", 0.05, 512, 512),
        ("weights", 0.05, 512, 512),
        ("depth", 0.5, 4096, 4096),
    ],
)
def test_gradients_with_interreflections(plates: Scene, name: str, step: float, spp: int, gradient_spp: int) -> None:
    """Against central differences of images with the same random numbers."""
    rendering, change = plates.rendering, changes(plates)[name]
    adjoint = np.broadcast_to(1 + plates.data.lights[:, :1], plates.data.values.shape)
    seeds = range(4)

    def loss(seed: int, step: float, max_depth: int) -> float:
        guess, depth = deepcopy(plates.guess), plates.depth
        if name == "depth":
            depth = depth + step * change
        else:
            setattr(guess, name, getattr(guess, name) + step * change)
            guess.normals = unit(guess.normals)
        rendering.update(guess, depth)
        return (rendering.image(spp=spp, seed=seed, max_depth=max_depth).astype(np.float64) * adjoint).sum()

    slope = lambda seed, depth: (loss(seed, step, depth) - loss(seed, -step, depth)) / (2 * step)
    reference, reference_error = mean_and_error(np.array([slope(seed, 4) for seed in seeds]))
    direct = slope(0, 2)
    rendering.update(plates.guess, plates.depth)
    gradient = lambda seed: rendering.gradient(adjoint, spp=gradient_spp, seed=seed, depth=name == "depth")[name]
    found, found_error = mean_and_error(np.array([(gradient(100 + seed) * change).sum() for seed in seeds]))
    assert np.hypot(reference_error, found_error) < 0.004 * abs(reference)
    assert abs(found - reference) < 0.01 * abs(reference)
    assert abs(direct - reference) > 0.05 * abs(reference)  # interreflections matter


# ------------------------------------------------------------------ descent


def test_steps_of_normals() -> None:
    """The first goes along the gradient in the tangent plane, by the rate, however long gradients are."""
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(50, 3)))
    gradient = rng.normal(size=(50, 3)) * 10.0 ** rng.uniform(-6, 6, (50, 1))
    gradient[8] = 0
    found = NormalAdam(50, 0.01).step(normals, gradient)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(found[8], normals[8], atol=1e-15)
    others = np.arange(50) != 8
    g, n = gradient[others], normals[others]
    tangential = unit(g - n * (g * n).sum(1, keepdims=True))
    np.testing.assert_allclose(found[others], unit(n - 0.01 * tangential), atol=1e-9)
    half = NormalAdam(50, 0.01).step(normals, gradient, factor=0.5)
    np.testing.assert_allclose(angles(half, normals)[others], np.degrees(np.arctan(0.005)), rtol=1e-6)


def test_normals_converge() -> None:
    """To those that least squares would find, for gradients of very different sizes and with noise."""
    rng = np.random.default_rng(0)
    truth, normals = unit(rng.normal(size=(50, 3)) + 3 * UP), unit(rng.normal(size=(50, 3)) + 3 * UP)
    size = 10.0 ** rng.uniform(-3, 3, (50, 1))
    adam = NormalAdam(50, 0.1)
    for i in range(300):
        noise = 0.1 * rng.normal(size=(50, 3))
        normals = adam.step(normals, size * (normals - truth + noise), factor=0.98**i)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    assert angles(normals, truth).max() < 2


def test_steps_of_weights() -> None:
    """The logarithms of weights fall by what their gradients exceed the mean by, the black lobe's being 0; at most by
    the rate, however large gradients are. Colours have steps of their own."""
    weights = np.array([[0.5, 0.1], [0.2, 0.3], [0, 0.2]])
    gradient = np.array([[3.0, 1e-6], [1.0, -2e-6], [0, 3e-6]])
    found = ExponentiatedGradient(2, 0.1).step(weights, gradient)
    all_w, all_g = np.r_[weights, 1 - weights.sum(0)[None]], np.r_[gradient, np.zeros((1, 2))]
    above = all_g - (all_w * all_g).sum(0)
    expected = all_w * np.exp(-0.1 * above / np.abs(above).max(0))
    np.testing.assert_allclose(found, (expected / expected.sum(0))[:-1], rtol=1e-12)
    half = ExponentiatedGradient(2, 0.1).step(weights, 7 * gradient, factor=0.5)
    expected = all_w * np.exp(-0.05 * above / np.abs(above).max(0))
    np.testing.assert_allclose(half, (expected / expected.sum(0))[:-1], rtol=1e-12)


def test_weights_converge_on_the_simplex() -> None:
    """To the least of a quadratic, given by `simplex_least_squares`, on its faces and inside."""
    rng = np.random.default_rng(0)
    A = rng.uniform(0, 1, (60, 6))
    truths = np.array([[0.2, 0.3, 0, 0, 0.1, 0.1], [0.9, 0.5, 0, 0.2, 0, 0], [0, 0, 0.6, 0, 0, 0.4]]).T
    gram, moments = A.T @ A, A.T @ A @ truths
    best = np.stack([simplex_least_squares(gram, m) for m in moments.T], 1)
    assert best[:, 0].sum() < 0.75 and best[:, 1].sum() > 1 - 1e-6
    descent, weights = ExponentiatedGradient(3, 0.5), np.full((6, 3), 1 / 7)
    weights[2, 0] = 0
    for i in range(2000):
        weights = descent.step(weights, gram @ weights - moments, factor=0.998**i)
        assert weights.min() >= 0 and weights.sum(0).max() <= 1 + 1e-12 and weights[2, 0] == 0
    loss = lambda x: np.einsum("ic,ij,jc->c", x - truths, gram, x - truths)
    assert (loss(weights) < loss(best) + 1e-4 * loss(np.zeros((6, 3)))).all()
    np.testing.assert_allclose(weights, best, atol=0.01)


# ------------------------------------------------------------------ reconstruction


def reconstructed(scene: Scene, **options) -> tuple[reconstruction.Result, float]:
    """With a known scale; and the error of trimmed least squares, or of the start at a smaller resolution, degrees."""
    options = {"resolutions": (1.0,), "dark": 0.1, "brightness": 0.0, "exposures": False, **options}
    found = reconstruction.reconstruct(scene.data, reconstruction.Options(**options), progress=False)
    return found, float(angles(found.start, scene.data.at(options["resolutions"][0]).truth).mean())


def rendered(scene: Scene, spp: int) -> Scene:
    """With images of all its light as values."""
    return scene._replace(data=dataclasses.replace(scene.data, values=scene.rendering.image(spp=spp, seed=5)))


def test_interreflections_are_undone() -> None:
    """A bowl that is rendered with them, and its shape with and without them. Measured: 6.8 degrees at the start, 1.9
    in the end, 7.1 without. Its albedo is found, too."""
    scene = rendered(bowl(K=16, spread=40, albedo=0.8, max_depth=5), 256)
    options = {"reflectance": False, "spp": 64, "iterations": (12,)}
    found, start = reconstructed(scene, max_depth=5, **options)
    direct, _ = reconstructed(scene, max_depth=2, **options)
    assert found.error < start / 3
    assert found.error < direct.error / 2
    np.testing.assert_allclose(found.guess.weights, scene.guess.weights, rtol=0.04)


def test_near_lights() -> None:
    """The start takes the surface for a plane; alternations find its depth, in the unit of the LEDs, here millimetres,
    at two resolutions. Measured: 0.7 and 0.03 degrees; 13 degrees if the lights are taken to be at infinity."""
    scene = near_ball(LAMBERT, np.full((1, 3), 0.5), 1000.0, K=20)
    data = dataclasses.replace(scene.data, values=scene.model().predicted(scene.guess))
    options = {"max_depth": 2, "reflectance": False, "resolutions": (0.5, 1.0), "iterations": (10, 10)}
    found, start = reconstructed(scene._replace(data=data), **options)
    inner = scene.rendering.domain.inner
    far = dataclasses.replace(data, lights=scene.model().mean_directions())
    at_infinity, _ = reconstructed(scene._replace(data=far), **options)
    assert found.error < start / 3
    assert at_infinity.error > 5 * found.error
    assert np.abs(found.depth / scene.depth - 1)[inner].max() < 0.005


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"brightness": -1.0}, '"brightness" must be at least 0; 0.6 is usual, got -1.0'),
        ({"brightness": np.nan}, '"brightness" must be at least 0'),
        ({"seed": -1}, '"seed" must be at least 0, got -1'),
        ({"max_depth": 17}, '"max_depth" must be from 2 to 16, got 17'),
        ({"tolerance": np.nan}, '"tolerance" must be at least 0'),
        ({"bilateral": 0.0}, '"bilateral" must be positive'),
        ({"dark": 1.0}, r'"dark" must be in \[0, 1\), got 1.0'),
    ],
    ids=str,
)
def test_options_out_of_range(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"ps: {message}"):
        reconstruction.Options(**options)


def test_descent_refuses_what_it_cannot() -> None:
    with pytest.raises(ValueError, match='"spp" of the descent must be at least 1'):
        refinement.Descent(spp=0)
    with pytest.raises(ValueError, match="other options 0"):
        refinement.Descent(rate=float("nan"))
    scene = bowl(K=4, spread=30)
    camera = np.array([[400.0, 0, 12], [0, 400, 12], [0, 0, 1]])
    with pytest.raises(ValueError, match="pixels are not square"):
        Rendering(dataclasses.replace(scene.data, camera=camera * [[1], [1.2], [1]]), scene.rendering.lobes)


@pytest.mark.parametrize("focal", [0, 400], ids=["orthographic", "perspective"])
def test_heights_of_steps_follow_from_their_shadows(focal: int) -> None:
    """Normals do not tell them. A plateau, in depth; with a camera, from far away."""
    N, true, start = 24, 6.0, 3.0
    lights = unit(spiral(6, 45) + np.array([0.3, 0, 0]))
    flat = lambda x, y: (0 * x, 0.0, 0.0)
    scene = height_field(LAMBERT, np.full((1, 3), 0.5), lights, flat, N=N, mask=np.ones((N, N), bool))
    camera = np.array([[focal, 0, 11.5], [0, focal, 11.5], [0, 0, 1.0]]) if focal else None
    data = dataclasses.replace(scene.data, camera=camera, distance=focal or None)
    rendering = Rendering(data, LAMBERT, max_depth=2)
    v, u = np.nonzero(rendering.domain.wide)
    high = (np.abs(u - 12.5) < 5) & (np.abs(v - 12.5) < 5)
    raised = lambda height: focal * np.exp(-height * high / focal) if focal else height * high
    height = lambda d: (-1 if focal else 1) * (d[high].mean() - d[~high].mean())
    rendering.update(scene.guess, raised(true))
    data = dataclasses.replace(data, values=rendering.image(spp=64, seed=1))
    options = refinement.Descent(steps=25, spp=4, rate=0, bsdf_rate=0, depth_rate=0.3, integrability=0)
    counts = np.ones(data.values.shape[:2], np.float32)
    found: list[float] = []
    refinement.descend(
        rendering, data, deepcopy(scene.guess), raised(start), counts, options, np.random.default_rng(0),
        after=lambda depth, _: found.append(height(depth)),
    )  # fmt: skip
    print(np.round(found, 2))
    assert found[0] < 4 and found[-1] == pytest.approx(true, abs=0.5)


def test_derivatives_that_are_not_finite_are_reported(monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    scene = bowl(K=4, spread=30)
    gradient = Rendering.gradient

    def broken(*args, **options):
        found = gradient(*args, **options)
        found["normals"][3, 1] = np.nan
        return found

    monkeypatch.setattr(Rendering, "gradient", broken)
    guess, counts = deepcopy(scene.guess), np.ones(scene.data.values.shape[:2])
    options = refinement.Descent(steps=2, spp=1)
    refinement.descend(scene.rendering, scene.data, guess, scene.depth, counts, options, np.random.default_rng(0))
    assert "step 1: 1 numbers of the derivative are not finite" in caplog.text
    assert np.isfinite(guess.normals).all()
