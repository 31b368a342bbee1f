"""Photometric stereo: shadows, interreflections, and their derivatives."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from photometric import LAMBERT, Scene, bowl, disc, height_field, made

from rimlight import ggx
from rimlight.checks import mean_and_error
from rimlight.inverse.photometric_stereo.dataset import Dataset
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit
from rimlight.leds import Led


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
