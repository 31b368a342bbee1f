"""Photometric stereo: whole reconstructions, and their options."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from photometric import LAMBERT, Scene, bowl, near_ball

from rimlight import ggx
from rimlight.inverse.photometric_stereo import reconstruction, start
from rimlight.inverse.photometric_stereo.dataset import angles


def reconstructed(scene: Scene, **options) -> tuple[reconstruction.Result, float]:
    """With a known scale; and the mean angular error of the start, degrees."""
    options = {"resolutions": (1.0,), "dark": 0.1, "brightness": 0.0, "exposures": False, **options}
    found = reconstruction.reconstruct(scene.data, reconstruction.Options(**options), progress=False)
    return found, float(angles(found.start, scene.data.truth).mean())


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


# ------------------------------------------------------------------ scale of the images


@pytest.mark.parametrize(("exposure", "brightness"), [(1.0, 0.6), (0.003, 0.6), (50.0, 0.2)])
def test_the_median_pixel_has_the_brightness_that_is_asked_for(exposure: float, brightness: float) -> None:
    """In its brightest colour, however bright the images are, and although a third of the pixels are dark."""
    scene = bowl(K=16, spread=20, albedo=0.7, rim=0.6)
    albedo = np.where(np.arange(len(scene.guess.albedo)) % 3, 1.0, 0.1)
    values = exposure * scene.model().predicted(dataclasses.replace(scene.guess, albedo=albedo))
    data = dataclasses.replace(scene.data, values=values)
    lobes = ggx.read_dictionary()[0]
    found = start.scale(data, lobes, reconstruction.Options(brightness=brightness))
    assert found == pytest.approx(brightness / (0.7 * exposure), rel=1e-3)


def test_scale_under_near_lights() -> None:
    """It is known as well as the distance is: the surface is taken for a plane."""
    scene = near_ball(LAMBERT, np.array([[0.3, 0.5, 0.4]]), 1000.0, K=20)
    data = dataclasses.replace(scene.data, values=scene.model().predicted(scene.guess))
    lobes = ggx.read_dictionary()[0]
    assert start.scale(data, lobes, reconstruction.Options(brightness=0.6)) == pytest.approx(0.6 / 0.5, rel=0.05)


def test_scales_that_are_known_or_that_nothing_tells() -> None:
    scene = bowl(K=16, spread=20)
    values = 3 * scene.model().predicted(scene.guess)
    data = dataclasses.replace(scene.data, values=values)
    lobes = ggx.read_dictionary()[0]
    assert start.scale(data, lobes, reconstruction.Options(brightness=0)) == 1
    values[: len(values) // 2 + 2] = 0
    assert start.scale(dataclasses.replace(data, values=values), lobes, reconstruction.Options(brightness=0.6)) == 1
