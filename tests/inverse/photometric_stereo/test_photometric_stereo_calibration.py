"""Photometric stereo: lights from pictures of balls, and exposures from the images themselves."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import pytest
from photometric import disc, glossy
from PIL import Image

from rimlight import ggx
from rimlight.cli import main
from rimlight.exr import write_exr
from rimlight.inverse.photometric_stereo import calibration, dataset, least_squares
from rimlight.inverse.photometric_stereo.calibration import Ball
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import DirectModel, Guess
from rimlight.inverse.photometric_stereo.simulation import spiral
from rimlight.inverse.photometric_stereo.vectors import unit


class Pictures(NamedTuple):
    """images : (N, N, 3) each. mask : (N, N). camera : (3, 3), or None."""

    images: list[np.ndarray]
    mask: np.ndarray
    camera: np.ndarray | None


BALL_LIGHTS = unit(np.array([[0, 0, 1], [0.6, 0.1, 1], [-0.3, 0.8, 1], [-0.7, -0.7, 1.2]]))


BALL_IRRADIANCE = np.array([[1, 1, 1], [0.5, 0.7, 0.9], [2, 1.6, 1.2], [1.2, 0.6, 0.8]])


def ball_pictures(kind: str, perspective: bool) -> Pictures:
    """A ball off the centre of the image, under lights at infinity: discs of 3 degrees for a mirror."""
    T, N = mi.ScalarTransform4f, 192
    film = {"type": "hdrfilm", "width": N, "height": N, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    v, u = np.mgrid[:N, :N]
    camera = None
    if perspective:
        centre, focal = np.array([0.7, 0.5, -5.0]), 1.3 * N
        camera = np.array([[focal, 0, N / 2 - 0.5], [0, focal, N / 2 - 0.5], [0, 0, 1]])
        fov = float(np.degrees(2 * np.arctan(N / 2 / focal)))
        look = T().look_at(origin=[0, 0, 0], target=[0, 0, -1], up=[0, 1, 0])
        sensor = {"type": "perspective", "fov": fov, "to_world": look}
        rays = unit(np.stack([(u - camera[0, 2]) / focal, (camera[1, 2] - v) / focal, -np.ones((N, N))], -1))
        mask = (rays @ centre) ** 2 > centre @ centre - 1
    else:
        centre = np.array([-0.1, 0.05, 0])
        look = T().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
        sensor = {"type": "orthographic", "to_world": look @ T().scale([1.2, 1.2, 1])}
        x, y = (2 * u + 1 - N) / N * 1.2, (N - 1 - 2 * v) / N * 1.2
        mask = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < 1
    chrome = kind == "chrome"
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {
                "type": "sphere",
                "center": centre.tolist(),
                "bsdf": {"type": "conductor", "material": "none"} if chrome else diffuse,
            },
            "sensor": {**sensor, "film": film},
            "lights": {
                "type": "distant_lights",
                "directions": mi.TensorXf(np.float32([[0, 0, 1]])),
                "angular_radius": 3.0 if chrome else 0.0,
            },
            "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
        }
    )
    params = mi.traverse(scene)
    images = []
    for direction, irradiance in zip(BALL_LIGHTS, BALL_IRRADIANCE, strict=True):
        params["lights.directions"] = mi.TensorXf(np.float32(direction[None]))
        params["lights.irradiance"] = mi.TensorXf(np.float32(irradiance[None]))
        params.update()
        images.append(np.array(mi.render(scene, spp=64)))
    return Pictures(images, mask, camera)


def calibration_folder(folder: Path, kind: str, perspective: bool, exposure: float = 1.0) -> Path:
    """Pictures as PNG of 16 bits."""
    found = ball_pictures(kind, perspective)
    brightest = max(image.max() for image in found.images)
    for k, image in enumerate(found.images):
        levels = np.round(np.minimum(image * exposure / brightest, 1) * 65535).astype(np.uint16)
        mi.Bitmap(levels).write(str(folder / f"{k}.png"))
    Image.fromarray(found.mask.astype(np.uint8) * 255).save(folder / "ball.png")
    if perspective:
        np.savetxt(folder / "K.txt", found.camera)
    return folder


@pytest.mark.parametrize("perspective", [False, True], ids=["orthographic", "perspective"])
@pytest.mark.parametrize("kind", ["chrome", "matte"])
def test_balls(tmp_path: Path, kind: str, perspective: bool, capsys: pytest.CaptureFixture) -> None:
    """Measured: 0.25 degrees for a mirror, 0.05 degrees and 0.02 % for a matte ball. Highlights may be overexposed."""
    folder = calibration_folder(tmp_path, kind, perspective, exposure=5.0 if kind == "chrome" else 1.0)
    assert main(["ps", "calibrate", str(folder), "--ball", str(folder / "ball.png"), "--kind", kind]) == 0
    assert "4 lights: " in capsys.readouterr().out
    directions = np.loadtxt(folder / "light_directions.txt")
    assert angles(directions, BALL_LIGHTS).max() < 0.5
    if kind == "matte":
        intensities = np.loadtxt(folder / "light_intensities.txt")
        np.testing.assert_allclose(intensities, BALL_IRRADIANCE / BALL_IRRADIANCE.mean(), rtol=0.01)
        assert angles(directions, BALL_LIGHTS).max() < 0.1
    assert (folder / "light_intensities.txt").exists() == (kind == "matte")


@pytest.mark.parametrize("centre", [(30.3, 33.8), (12.4, 50.2)], ids=["inside", "beyond the image"])
def test_normals_of_a_ball(centre: tuple[float, float]) -> None:
    mask = disc(64, centre, 24.6)
    ball = Ball.of_mask(mask)
    v, u = np.nonzero(mask)
    x, y = (u - centre[0]) / 24.6, (centre[1] - v) / 24.6
    z = np.sqrt(1 - x**2 - y**2)
    off = (ball.normals - np.stack([x, y, z], 1))[z > 0.3] * 24.6
    assert np.abs(off[:, :2]).max() < (0.1 if centre[0] > 24 else 0.4)  # pixels


BLACK = np.zeros((64, 64, 3), np.float32)


SPOTS = BLACK + (disc(64, (25, 25), 2) | disc(64, (45, 40), 2))[..., None]


@pytest.mark.parametrize(
    ("kind", "image", "message"),
    [
        ("chrome", BLACK, "no highlight: the ball is black"),
        ("chrome", BLACK + 1, "no single small highlight: .* scatter by 81 degrees; is the picture overexposed"),
        ("chrome", SPOTS, "no single small highlight: .* or are there two lights"),
        ("matte", BLACK, "the ball is black"),
        ("matte", np.minimum(BLACK + np.linspace(0, 2, 64, dtype=np.float32)[:, None], 1), "overexposed: 5[0-9] %"),
        (
            "matte",
            SPOTS * disc(64, (25, 25), 1.2)[..., None] * np.linspace(0.9, 1, 64)[:, None],
            "the light meets fewer than 10 pixels",
        ),
    ],
)
def test_pictures_that_tell_no_light(tmp_path: Path, kind: str, image: np.ndarray, message: str) -> None:
    """Errors name the picture."""
    write_exr(tmp_path / "7.exr", {"": np.broadcast_to(image, (64, 64, 3)).astype(np.float32)})
    Image.fromarray(disc(64, (32, 32), 25)).convert("L").save(tmp_path / "ball_mask.png")
    with pytest.raises(ValueError, match=f'ps: "7.exr": .*{message}'):
        calibration.calibrate(tmp_path, tmp_path / "ball_mask.png", kind)
    assert not (tmp_path / "light_directions.txt").exists()


def test_masks_that_are_no_balls() -> None:
    square = np.zeros((64, 64), bool)
    square[10:50, 10:50] = True
    for camera in (None, np.array([[80.0, 0, 30], [0, 80, 30], [0, 0, 1]])):
        with pytest.raises(ValueError, match=r"ps: the ball's mask is no disc: its outline is [0-9.]+ pixels off"):
            Ball.of_mask(square, camera)
    with pytest.raises(ValueError, match="ps: the ball's mask has 4096 pixels and no outline in the image"):
        Ball.of_mask(~BLACK[..., 0].astype(bool))


def test_exposures_of_a_group_of_images() -> None:
    """A quarter of the images, one after the other, is 20 % too bright, on a surface that shines."""
    lobes, _ = ggx.read_dictionary()
    rng = np.random.default_rng(0)
    mask = np.ones((20, 20), bool)
    truth = unit(np.c_[rng.uniform(-0.6, 0.6, (400, 2)), np.ones(400)])
    lights = spiral(40, 50)
    data = Dataset(np.ones((400, 40, 3), np.float32), mask, lights, np.ones((40, 3)))
    wrong = np.where((np.arange(40) >= 14) & (np.arange(40) < 24), 1.2, 1.0)
    values = DirectModel(data, lobes).predicted(Guess(truth, np.ones(400), wrong, glossy(lobes))) @ dataset.LUMINANCE
    predicted = lambda exposures: least_squares.trimmed(values / exposures, lights) @ lights.T
    found = np.ones(40)
    for _ in range(3):
        found *= calibration.exposures(values / found, predicted(found), np.ones(values.shape), lights)
    assert np.median(found) == pytest.approx(1, abs=0.01)
    np.testing.assert_allclose(found, wrong, rtol=0.05)


def test_exposures_are_no_errors_of_the_material() -> None:
    """What predictions lack as a smooth function of the light's direction is none; nor is noise, nor an image in which
    nothing counts."""
    rng = np.random.default_rng(0)
    lights, predicted = spiral(40, 50), rng.uniform(0.3, 1, (300, 40))
    x, y, _ = lights.T
    wrong = np.ones(40)
    wrong[[3, 30, 31]] = (1.3, 0.8, 0.8)
    values = predicted * wrong * np.exp(0.4 * x - 0.5 * y**2 + 0.3 * x * y) * rng.normal(1, 0.1, (300, 40))
    for k in range(40):
        values[: 8 * (k % 5), k] *= 3  # highlights
    counts = np.ones((300, 40))
    counts[:, 7] = 0
    np.testing.assert_allclose(calibration.exposures(values, predicted, counts, lights), wrong, atol=0.04)


def test_exposures_of_few_images_are_left_alone() -> None:
    values = np.random.default_rng(0).uniform(0.5, 1, (10, 19))
    np.testing.assert_array_equal(calibration.exposures(values, values * 2, values, spiral(19, 40)), 1)


def test_exposures_of_bear(diligent) -> None:
    """The first 19 images are 15 to 33 % too bright, and many authors leave them out; nobody tells the program."""
    data = diligent("bear").at(0.25)
    values = data.luminance.astype(np.float64)
    found = np.ones(96)
    for _ in range(3):
        b = least_squares.trimmed(values / found, data.lights)
        found *= calibration.exposures(values / found, b @ data.lights.T, np.ones(values.shape), data.lights)
    assert found[:19].min() > 1.1 and found[:19].max() < 1.4
    assert np.abs(found[19:] - 1).max() < 0.1


def matte_images(K: int, off: np.ndarray, near: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """values : (P, K), of a matte surface that all lights shine on. lights : (K, 3), or (P, K, 3)."""
    rng, lights = np.random.default_rng(4), spiral(K, 40)
    normals = unit(np.c_[rng.uniform(-0.5, 0.5, (400, 2)), np.ones(400)])
    if near:
        lights = unit(lights + 0.1 * normals[:, None])
    values = rng.uniform(0.2, 0.9, (400, 1)) * np.einsum("pi,pki->pk", normals, np.broadcast_to(lights, (400, K, 3)))
    return values * off, lights


@pytest.mark.parametrize("near", [False, True], ids=["at infinity", "near"])
def test_exposures_of_a_matte_surface(near: bool) -> None:
    """However they are spread. Of what is black, nothing is known."""
    off = np.exp(0.3 * np.random.default_rng(1).standard_normal(12))
    off[5] = 0
    values, lights = matte_images(12, off, near)
    found, known = calibration.of_matte(values, np.ones(values.shape), lights), off > 0
    assert found[5] == 0
    np.testing.assert_allclose(found[known] / np.median(found[known]), off[known] / np.median(off[known]), rtol=1e-6)


def test_exposures_that_are_off_at_random_have_a_trend() -> None:
    """Most of them. Without that trend they are off, and so are the normals. A trend of all images, with few
    exposures that are off, is the material's."""
    K = 36
    counts = np.ones((400, K))

    def found(values: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        exposures = np.ones(K)
        for _ in range(3):
            predicted = least_squares.trimmed(values / exposures, lights) @ lights.T
            exposures *= calibration.exposures(values / exposures, predicted, counts, lights)
        return exposures, calibration.with_trend(exposures, values, counts, lights)

    random = [np.random.default_rng(seed) for seed in range(6)]
    offs = [np.exp(0.12 * rng.standard_normal(K) * (rng.random(K) < 0.9)) for rng in random]
    errors = np.array([[np.log(x / off).std() for x in found(*matte_images(K, off))] for off in offs])
    without, given_back = errors.T
    assert without.mean() > 0.02 and given_back.mean() < 0.5 * without.mean()
    few = np.where(np.arange(K) % 9 == 4, offs[0], 1)
    values, lights = matte_images(K, few)
    without, given_back = found(values * np.exp(-0.3 * (lights[:, 0] ** 2 + lights[:, 1] ** 2)), lights)
    np.testing.assert_allclose(given_back, without, rtol=0.003)
    np.testing.assert_allclose(given_back, few / np.median(few), rtol=0.05)
