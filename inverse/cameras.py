"""Cameras of other programs: COLMAP's text files, and `transforms.json` of NeRF, Blender and instant-ngp."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from rimlight.loading import InputError

from .problem import Target

#: COLMAP's models without distortion: name -> where among their parameters f_x, f_y, c_x and c_y are. In models with
#: distortion, its parameters follow, and must be 0.
MODELS = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2),
    "RADIAL": (0, 0, 1, 2),
    "OPENCV": (0, 1, 2, 3),
    "FULL_OPENCV": (0, 1, 2, 3),
}

#: Relative difference of focal lengths up to which pixels count as square.
SQUARE = 1e-3

#: Cameras of COLMAP have x to the right, y down and z forward; those of OpenGL have y up and z backward; those of
#: Mitsuba have x to the left, y up and z forward.
FROM_COLMAP, FROM_OPENGL = np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, and the picture that it took.

    file : the picture. width, height : of it, pixels. focal : length, pixels. centre : principal point, pixels from the
        left and the top border; (width / 2, height / 2) is the middle. to_world : (4, 4), from Mitsuba's camera space.
    """

    file: Path
    width: int
    height: int
    focal: float
    centre: tuple[float, float]
    to_world: np.ndarray

    def sensor(self, *, width: int | None = None, **film: Any) -> dict[str, Any]:
        """A sensor, as `mi.load_dict` wants it. width : of its film, pixels. film : more properties of the film."""
        width = self.width if width is None else width
        height = max(round(self.height * width / self.width), 1)
        return {
            "type": "perspective",
            "fov_axis": "x",
            "fov": math.degrees(2 * math.atan(self.width / (2 * self.focal))),
            "principal_point_offset_x": 0.5 - self.centre[0] / self.width,
            "principal_point_offset_y": 0.5 - self.centre[1] / self.height,
            "to_world": mi.ScalarTransform4f(self.to_world),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **film},
        }


def add_to(scene: Mapping[str, Any], cameras: Sequence[Camera], **film: Any) -> tuple[dict[str, Any], list[Target]]:
    """A scene with cameras, and the targets that they took.

    scene : a dictionary without sensors, as `mi.load_dict` wants it. film : see `Camera.sensor`.
    """
    names = [f"camera_{i:04}" for i in range(len(cameras))]  # in the order of their names, as scenes keep them
    sensors = {name: camera.sensor(**film) for name, camera in zip(names, cameras, strict=True)}
    return {**scene, **sensors}, [Target(file=c.file, sensor=i, resize=True) for i, c in enumerate(cameras)]


def read_colmap(folder: Path | str, pictures: Path | str) -> list[Camera]:
    """Cameras of a model that COLMAP has exported as text, in the order of the names of their pictures.

    folder : holds cameras.txt and images.txt. pictures : folder of the pictures.

    Raises
    ------
    InputError : a file is damaged, or a camera has a distortion, or pixels that are not square. OSError : it cannot be
        read.
    """
    folder, pictures = Path(folder), Path(pictures)
    intrinsics = {}
    for number, line in _lines(folder / "cameras.txt"):
        with _damage(f'"{folder / "cameras.txt"}", line {number}'):
            key, model, width, height, *rest = line.split()
            if model not in MODELS:
                raise InputError(f"camera model {model} is unknown here; run colmap image_undistorter first")
            at, values = MODELS[model], [float(x) for x in rest]
            intrinsics[key] = int(width), int(height), *(values[i] for i in at), values[max(at) + 1 :]
    cameras = []
    # Two lines each: the camera, and points in its picture, which may be an empty line.
    for number, line in _lines(folder / "images.txt", keep_empty=True)[::2]:
        with _damage(f'"{folder / "images.txt"}", line {number}'):
            _, *pose, camera, name = line.split(maxsplit=9)
            from_world = np.eye(4)
            w, *xyz, x, y, z = (float(v) for v in pose)
            from_world[:3, :3] = _rotation([*xyz, w])
            from_world[:3, 3] = x, y, z
            to_world = np.linalg.inv(from_world) @ FROM_COLMAP
            cameras.append(_camera(pictures / name.strip(), *intrinsics[camera], to_world))
    return sorted(cameras, key=lambda camera: camera.file)


def read_transforms(path: Path | str) -> list[Camera]:
    """Cameras of a `transforms.json`, in its order. Names of pictures without an ending are PNG files, as Blender's.

    Raises
    ------
    InputError : the file is damaged, or a camera has a distortion, or pixels that are not square. OSError : it cannot
        be read.
    """
    path = Path(path)
    with _damage(f'"{path}"'):
        said = json.loads(path.read_text("utf-8"))
        cameras = []
        for frame in said["frames"]:
            facts = {**said, **frame}
            file = path.parent / facts["file_path"]
            file = file if file.suffix else file.with_suffix(".png")
            width, height = (int(facts[k]) for k in ("w", "h")) if "w" in facts else _size(file)
            across = facts.get("fl_x") or width / (2 * math.tan(facts["camera_angle_x"] / 2))
            distortion = [float(facts.get(k, 0)) for k in ("k1", "k2", "k3", "k4", "p1", "p2")]
            centre = facts.get("cx", width / 2), facts.get("cy", height / 2)
            to_world = np.array(facts["transform_matrix"], np.float64).reshape(4, 4) @ FROM_OPENGL
            down = facts.get("fl_y") or across
            cameras.append(_camera(file, width, height, across, down, *centre, distortion, to_world))
        return cameras


def _camera(
    file: Path, width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: list, to_world: Any
) -> Camera:
    if any(distortion):
        raise InputError(f'the camera of "{file.name}" distorts; undistort the pictures, with colmap image_undistorter')
    if abs(fx - fy) > SQUARE * fx:
        raise InputError(f'the camera of "{file.name}" has pixels that are not square: f_x is {fx:.6g}, f_y {fy:.6g}')
    return Camera(file, width, height, fx, (cx, cy), to_world)


def _rotation(quaternion: Sequence[float]) -> np.ndarray:
    """x, y, z, w -> (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion).as_matrix()


def _size(file: Path) -> tuple[int, int]:
    from PIL import Image

    with Image.open(file) as picture:
        return picture.size


def _lines(path: Path, keep_empty: bool = False) -> list[tuple[int, str]]:
    """Number and text of the lines that are no comments."""
    lines = enumerate(path.read_text("utf-8").splitlines(), 1)
    return [(i, line) for i, line in lines if not line.startswith("#") and (keep_empty or line.strip())]


class _damage:
    """Within it, what goes wrong becomes an `InputError` that names the place."""

    def __init__(self, where: str):
        self.where = where

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, _: Any) -> None:
        if isinstance(error, InputError):
            raise InputError(f"cameras: {self.where}: {error}") from None
        if isinstance(error, KeyError):
            raise InputError(f"cameras: {self.where}: {error} is missing") from None
        if isinstance(error, ValueError | IndexError | TypeError):
            raise InputError(f"cameras: {self.where}: {error}") from None
