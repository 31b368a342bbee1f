"""Cameras of other programs: their rays go through the points that textbook projections put into their pixels."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rimlight.inverse import cameras

WIDTH, HEIGHT, FOCAL, CENTRE = 80, 60, 70.0, (43.0, 26.0)
POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (6, 3))


def pose() -> tuple[np.ndarray, np.ndarray]:
    """From the world into the camera of COLMAP: rotation, and translation that puts the points before it."""
    return Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix(), np.array([0.1, -0.2, 4.0])


def expected_pixels() -> np.ndarray:
    """K (R X + t), of a camera with x to the right, y down, z forward: Hartley and Zisserman 2004, Eq. 6.8."""
    R, t = pose()
    seen = POINTS @ R.T + t
    return FOCAL * seen[:, :2] / seen[:, 2:] + CENTRE


def assert_sees(camera: cameras.Camera) -> None:
    """The ray of each pixel goes through its point."""
    sensor = mi.load_dict(camera.sensor())
    for point, pixel in zip(POINTS, expected_pixels(), strict=True):
        at = pixel / (WIDTH, HEIGHT)
        ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(at.tolist()), mi.Point2f(0.5), True)
        way = point - np.array(ray.o).ravel()
        direction = np.array(ray.d).ravel()
        assert way @ direction > 0
        np.testing.assert_allclose(np.cross(way, direction), 0, atol=2e-5)


def colmap(folder: Path, camera: str, name: str = "b c.png") -> Path:
    R, t = pose()
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {camera}\n")
    numbers = " ".join(map(str, (w, x, y, z, *t)))
    (folder / "images.txt").write_text(f"# Images\n1 {numbers} 7 {name}\n1.0 2.0 -1\n2 {numbers} 7 a.png\n\n")
    return folder


@pytest.mark.parametrize(
    "camera",
    [
        f"SIMPLE_PINHOLE {WIDTH} {HEIGHT} {FOCAL} {CENTRE[0]} {CENTRE[1]}",
        f"PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {CENTRE[0]} {CENTRE[1]}",
        f"RADIAL {WIDTH} {HEIGHT} {FOCAL} {CENTRE[0]} {CENTRE[1]} 0 0",
    ],
)
def test_colmap(tmp_path, camera):
    first, second = cameras.read_colmap(colmap(tmp_path, camera), tmp_path / "images")
    assert (first.file, second.file) == (tmp_path / "images" / "a.png", tmp_path / "images" / "b c.png")
    assert_sees(first)
    assert_sees(second)


def test_transforms(tmp_path):
    R, t = pose()
    to_world = np.eye(4)  # of OpenGL: x to the right, y up, z backward
    to_world[:3, :3] = R.T @ np.diag([1, -1, -1])
    to_world[:3, 3] = -R.T @ t
    frame = {"file_path": "./train/r_0", "transform_matrix": to_world.tolist()}
    size = {"w": WIDTH, "h": HEIGHT, "cx": CENTRE[0], "cy": CENTRE[1]}
    for facts in ({"fl_x": FOCAL, "fl_y": FOCAL}, {"camera_angle_x": 2 * np.arctan(WIDTH / (2 * FOCAL))}):
        (tmp_path / "transforms.json").write_text(json.dumps({**facts, **size, "frames": [frame]}))
        (camera,) = cameras.read_transforms(tmp_path / "transforms.json")
        assert camera.file == tmp_path / "train" / "r_0.png"
        assert_sees(camera)


def test_size_of_the_picture(tmp_path):
    from PIL import Image

    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "r_0.png")
    frame = {"file_path": "r_0", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    (camera,) = cameras.read_transforms(tmp_path / "transforms.json")
    assert (camera.width, camera.height, camera.centre) == (WIDTH, HEIGHT, (WIDTH / 2, HEIGHT / 2))
    assert camera.sensor(width=40)["film"]["height"] == HEIGHT // 2


def test_cameras_in_a_scene(tmp_path):
    """Sensors of a scene have the order of their targets, also of more than ten."""
    many = [cameras.Camera(tmp_path / f"{i}.png", WIDTH, HEIGHT, 50.0 + i, CENTRE, np.eye(4)) for i in range(12)]
    scene, targets = cameras.add_to({"type": "scene", "ball": {"type": "sphere"}}, many, width=16)
    sensors = mi.load_dict(scene).sensors()
    for camera, target in zip(many, targets, strict=True):
        fov = float(mi.traverse(sensors[target.sensor])["x_fov"][0])
        assert fov == pytest.approx(camera.sensor()["fov"], rel=1e-5)
        assert target.file == camera.file and tuple(sensors[target.sensor].film().size()) == (16, 12)


@pytest.mark.parametrize(
    ("camera", "culprit"),
    [
        ("OPENCV 80 60 70 70 40 30 0.1 0 0 0", "distorts"),
        ("FISHEYE 80 60 70 40 30", "FISHEYE is unknown"),
        ("PINHOLE 80 60 70 60 40 30", "not square"),
        ("PINHOLE 80 60 70", "line 2"),
        ("PINHOLE 80 60 70 a 40 30", "line 2"),
    ],
)
def test_cameras_that_cannot_be_used(tmp_path, camera, culprit):
    with pytest.raises(ValueError, match=culprit) as error:
        cameras.read_colmap(colmap(tmp_path, camera), tmp_path)
    assert str(error.value).startswith("cameras: ") and "\n" not in str(error.value)


def test_damaged_transforms(tmp_path):
    file = tmp_path / "transforms.json"
    for text, culprit in (("{", "line 1"), ("{}", "'frames' is missing"), ('{"frames": [{}]}', "'file_path'")):
        file.write_text(text)
        with pytest.raises(ValueError, match=culprit):
            cameras.read_transforms(file)
