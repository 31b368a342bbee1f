"""Photometric stereo: data sets, as files and in memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from photometric import LAMBERT, UP
from PIL import Image
from scipy.io import savemat
from skimage import io

from rimlight.exr import write_exr
from rimlight.inverse.photometric_stereo import dataset, least_squares
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import DirectModel
from rimlight.inverse.photometric_stereo.vectors import unit
from rimlight.leds import Led


def small(near: bool = False) -> Dataset:
    """Four images of 6 x 7 pixels, 30 of which are in the mask."""
    rng = np.random.default_rng(3)
    mask = np.ones((6, 7), bool)
    mask[:2] = mask[2:, 5] = False
    mask[1, 1:7] = True
    P, K = int(mask.sum()), 4
    lights = unit(rng.normal(0, 0.4, (K, 3)) + UP)
    leds = tuple(Led((x, y, 0.1), (-x, -y, -z), 1.0 + z, (1.0, 1.0, 1.0)) for x, y, z in lights.tolist())
    return Dataset(
        values=rng.uniform(0.05, 0.6, (P, K, 3)).astype(np.float32),
        mask=mask,
        lights=leds if near else lights,
        intensities=rng.uniform(0.5, 1.5, (K, 3)),
        camera=np.array([[50.0, 0, 3.2], [0, 50, 2.4], [0, 0, 1]]) if near else None,
        truth=unit(rng.normal(0, 0.3, (P, 3)) + UP),
        names=("b.exr", "a.exr", "d.exr", "c.exr"),
        distance=1.25 if near else None,
    )


@pytest.mark.parametrize("near", [False, True], ids=["at infinity", "near"])
def test_data_sets_are_read_as_written(tmp_path: Path, near: bool) -> None:
    data = small(near)
    dataset.write(tmp_path / "set", data)
    found = dataset.read(tmp_path / "set")
    for name in ("values", "mask", "intensities", "truth"):
        np.testing.assert_allclose(getattr(found, name), getattr(data, name), rtol=1e-6, atol=1e-7)
    assert found.names == data.names and found.near == near and found.distance == data.distance
    if near:
        np.testing.assert_array_equal(found.camera, data.camera)
        assert found.lights == data.lights
    else:
        assert found.camera is None
        np.testing.assert_allclose(found.lights, data.lights, atol=1e-8)


@pytest.mark.parametrize("kind", ["exr", "mat"])
def test_true_normals_that_are_not_known_of_all_pixels(tmp_path: Path, caplog, kind: str) -> None:
    """NaN or 0 in the file: such pixels have no error, of coarse images either."""
    data = small()
    dataset.write(tmp_path, data)
    normals = data.image(data.truth)
    rows, columns = np.nonzero(data.mask)
    normals[rows[:3], columns[:3]] = np.nan
    normals[rows[3], columns[3]] = 0
    if kind == "mat":
        (tmp_path / "Normal_gt.exr").unlink()
        savemat(tmp_path / "Normal_gt.mat", {"Normal_gt": normals})
    else:
        write_exr(tmp_path / "Normal_gt.exr", {"": normals.astype(np.float32)})
    found = dataset.read(tmp_path)
    assert f"Normal_gt.{kind} has no normals of 4 pixels" in caplog.text
    off = found.off(np.tile(UP, (len(data.values), 1)))
    np.testing.assert_array_equal(np.isnan(off), np.arange(len(off)) < 4)
    np.testing.assert_allclose(off[4:], angles(np.array(UP), data.truth)[4:], atol=1e-4)
    coarse = found.at(0.5)
    assert np.isfinite(coarse.truth).all() and np.isfinite(coarse.off(coarse.truth)).any()
    normals[:] = np.nan
    savemat(tmp_path / "Normal_gt.mat", {"Normal_gt": normals})
    (tmp_path / "Normal_gt.exr").unlink(missing_ok=True)
    assert dataset.read(tmp_path).truth is None


def test_lights_at_a_distance(tmp_path: Path) -> None:
    """In a plane; where the object is, in their directions and as bright as at infinity. Elsewhere they are not."""
    data = dataclasses.replace(small(), camera=small(near=True).camera, distance=10.0)
    dataset.write(tmp_path, data)
    (tmp_path / "light_distance.txt").write_text("20  # millimetres")
    near = dataset.read(tmp_path)
    rows, columns = np.nonzero(data.mask)
    middle = 10 * np.array([columns.mean() - 3.2, 2.4 - rows.mean(), -50]) / 50
    positions = np.array([led.position for led in near.lights])
    np.testing.assert_allclose(positions[:, 2], 10, rtol=1e-6)
    np.testing.assert_allclose(unit(positions - middle), data.lights, atol=1e-6)
    raw = lambda d: d.values * d.intensities
    np.testing.assert_allclose(raw(near), raw(data), rtol=1e-5)
    points = np.tile(middle, (len(data.values), 1))
    points[1] += (2, 0, 0)
    directions, irradiance = DirectModel(near, LAMBERT, points=points).lighting()
    np.testing.assert_allclose(directions[0], data.lights, atol=1e-6)
    # What a surface there reflects of an LED of intensity 1 is to `near.values` as of a distant one to `data.values`
    np.testing.assert_allclose(data.values[0] * irradiance[0, :, None], near.values[0], rtol=1e-5)
    assert not np.allclose(directions[1], directions[0], atol=0.01)
    dataset.write(tmp_path / "again", near)
    again = dataset.read(tmp_path / "again")
    np.testing.assert_allclose([led.position for led in again.lights], positions, rtol=1e-6)
    np.testing.assert_allclose(again.values, near.values, rtol=1e-5)


def test_some_of_the_images(tmp_path: Path) -> None:
    """Evenly from the list, with their lights."""
    data = small()
    dataset.write(tmp_path, dataclasses.replace(data, names=("a", "b", "c", "d")))
    (tmp_path / dataset.NAMES).unlink()  # then, all there are, by name; not the mask, nor the truth
    found = dataset.read(tmp_path, images=3)
    assert found.names == ("a.exr", "b.exr", "c.exr")
    np.testing.assert_allclose(found.lights, data.lights[:3], atol=1e-8)
    np.testing.assert_allclose(found.values, data.values[:, :3], rtol=1e-6)
    (tmp_path / dataset.NAMES).write_text("a.exr\n\nb.exr\nc.exr \nd.exr\n")
    found = dataset.read(tmp_path, images=3)
    assert found.names == ("a.exr", "b.exr", "c.exr")


def pictures(folder: Path, colours: np.ndarray, suffix: str, encode: Callable[[np.ndarray], np.ndarray]) -> Dataset:
    """Read a folder of images of a single colour each, (K, 3)."""
    data = small()
    dataset.write(folder, dataclasses.replace(data, intensities=np.ones((4, 3)), names=()))
    names = [f"{k}{suffix}" for k in range(len(colours))]
    for name, colour in zip(names, colours, strict=True):
        encoded = np.ascontiguousarray(np.broadcast_to(encode(colour), (*data.mask.shape, np.size(encode(colour)))))
        if suffix == ".jpg":
            Image.fromarray(encoded).save(folder / name, quality=100, subsampling=0)
        else:
            mi.Bitmap(encoded).write(str(folder / name))
    (folder / dataset.NAMES).write_text("\n".join(names))
    return dataset.read(folder)


COLOURS = np.array([[0.1, 0.2, 0.9], [0.5, 0.01, 0.3], [1, 1, 1], [0, 0.04, 0.7]])


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, 8 bits."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(encoded * 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("suffix", "encode", "tolerance"),
    [
        (".png", lambda c: np.round(c * 65535).astype(np.uint16), 1e-5),
        (".png", lambda c: np.round(c * 255).astype(np.uint8), 2.1e-3),
        (".png", lambda c: np.round(np.append(c, 0.5) * 65535).astype(np.uint16), 1e-5),
        (".exr", lambda c: c.astype(np.float32), 1e-7),
        (".jpg", srgb, 0.015),
    ],
    ids=["png, 16 bits", "png, 8 bits", "png, alpha", "exr", "jpeg"],
)
def test_pictures_become_linear(tmp_path: Path, suffix: str, encode: Callable, tolerance: float) -> None:
    found = pictures(tmp_path, COLOURS, suffix, encode)
    np.testing.assert_allclose(found.values, np.broadcast_to(COLOURS, found.values.shape), atol=tolerance)


def test_grey_pictures(tmp_path: Path) -> None:
    grey = lambda c: np.round(c[:1] * 65535).astype(np.uint16)
    colours = np.maximum(COLOURS, 0.01)  # black images would be left out
    found = pictures(tmp_path, colours, ".png", grey)
    np.testing.assert_allclose(found.values[7], np.repeat(colours[:, :1], 3, 1), atol=1e-5)


@pytest.mark.parametrize(("suffix", "of"), [(".tif", np.uint16), (".tiff", np.float32)])
def test_tiff(tmp_path: Path, suffix: str, of: type) -> None:
    """What developers of raw pictures write: linear. Also without a list of names."""
    data = small()
    dataset.write(tmp_path, data)
    (tmp_path / dataset.NAMES).unlink()
    whole = 65535 if of is np.uint16 else 1
    for k, colour in enumerate(COLOURS):
        (tmp_path / f"{'abcd'[k]}.exr").unlink()
        picture = np.broadcast_to(colour * whole, (*data.mask.shape, 3)).astype(of)
        io.imsave(tmp_path / f"{k}{suffix}", picture, check_contrast=False)
    np.testing.assert_allclose(dataset.read(tmp_path).values[3] * data.intensities, COLOURS, atol=1e-5)


def test_numbers_in_names_count_as_numbers(tmp_path: Path) -> None:
    """Pictures that no file lists belong to the lights in this order."""
    for name in ("img10.png", "img2.png", "img1.png", "2 b.exr", "mask.png", "b1.jpg"):
        (tmp_path / name).touch()
    assert dataset.read_names(tmp_path) == ["2 b.exr", "b1.jpg", "img1.png", "img2.png", "img10.png"]


@pytest.mark.parametrize("separator", [" ", ",", ", ", ";", "\t"])
def test_tables_of_other_programs(tmp_path: Path, separator: str) -> None:
    """With marks of byte order, line ends of Windows, and comments."""
    data = small()
    dataset.write(tmp_path, data)
    rows = [separator.join(map(str, row)) for row in data.lights]
    table = "\r\n".join(["# x y z", *rows[:2], "", *rows[2:]])
    (tmp_path / dataset.DIRECTIONS).write_bytes(table.encode("utf-8-sig"))
    (tmp_path / dataset.NAMES).write_bytes("\r\n".join([*data.names, ""]).encode("utf-8-sig"))
    found = dataset.read(tmp_path)
    np.testing.assert_allclose(found.lights, data.lights, atol=1e-12)
    assert found.names == data.names


MASKS = {
    "green": lambda m: Image.fromarray(np.stack([0 * m, m, 0 * m], -1)),
    "colours and alpha": lambda m: Image.fromarray(np.stack([0 * m + 99, m, m, 0 * m + 255], -1)),
    "cut out": lambda m: Image.fromarray(np.stack([255 - m, 0 * m, 0 * m, m], -1)),
    "grey, cut out": lambda m: Image.fromarray(np.stack([0 * m + 9, m], -1)),
    "numbers of parts": lambda m: Image.fromarray(m // 255 * 3),
}


@pytest.mark.parametrize("kind", MASKS)
def test_masks_of_other_programs(tmp_path: Path, kind: str) -> None:
    mask = small().mask
    MASKS[kind](mask.astype(np.uint8) * 255).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(dataset.read_mask(tmp_path / "mask.png"), mask)


@pytest.mark.parametrize("near", [False, True])
def test_black_images_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture, near: bool) -> None:
    data = small(near)
    dataset.write(tmp_path, data)
    write_exr(tmp_path / "a.exr", {"": np.zeros((*data.mask.shape, 3), np.float32)})
    found, rest = dataset.read(tmp_path), [0, 2, 3]
    assert caplog.messages == ["ps: black in the mask, and left out: a.exr; were these lamps on?"]
    assert found.names == ("b.exr", "d.exr", "c.exr")
    np.testing.assert_allclose(found.values, data.values[:, rest], rtol=1e-6)
    np.testing.assert_allclose(found.intensities, data.intensities[rest])
    assert [str(light) for light in found.lights] == [str(data.lights[k]) for k in rest]


def test_lights_behind_the_object_are_refused() -> None:
    lights = np.array([[0, 0.6, -0.8], [0.6, 0, -0.8], [0, 0, -1]])
    with pytest.raises(ValueError, match="ps: all lights are behind the object: z must point towards the camera"):
        least_squares.check_lights(lights)
    least_squares.check_lights(lights * [1, 1, -1])


def replaced(name: str, text: str, encoding: str = "utf-8") -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text, encoding=encoding)


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def picture(name: str, *shape: int, value: float = 1.0) -> Callable[[Path], None]:
    return lambda folder: write_exr(folder / name, {"": np.full(shape, value, np.float32)})


def black_mask(folder: Path) -> None:
    Image.fromarray(np.zeros((6, 7), np.uint8)).save(folder / "mask.png")


def layers_without_a_picture(folder: Path) -> None:
    layer = np.ones((6, 7, 3), np.float32)
    write_exr(folder / "a.exr", {"albedo": layer, "beauty": layer})


def printed(folder: Path) -> None:
    Image.new("CMYK", (7, 6)).save(folder / "a.jpg")
    (folder / "filenames.txt").write_text("a.jpg\nb.exr\nc.exr\nd.exr")


THREE = "0 0 1\n" * 3


@pytest.mark.parametrize(
    ("change", "near", "message"),
    [
        (without("mask.png"), False, 'ps: there is no file ".*mask.png"'),
        (replaced("mask.png", "no picture"), False, 'ps: cannot read ".*mask.png"'),
        (black_mask, False, "ps: the mask is empty"),
        (without("a.exr"), False, 'ps: there is no file ".*a.exr"'),
        (replaced("a.exr", "no picture"), False, "a.exr"),
        (picture("a.exr", 5, 7, 3), False, 'ps: "a.exr" has 7 x 5 pixels, the mask 7 x 6'),
        (picture("a.exr", 6, 7, 3, value=np.nan), False, "ps: 30 pixels of the mask have values that are not finite"),
        (replaced("filenames.txt", "a.exr\nb.exr"), False, "2 images, 4 lights, 4 intensities"),
        (replaced("light_directions.txt", THREE), False, "4 images, 3 lights, 4 intensities"),
        (replaced("light_intensities.txt", THREE), False, "4 images, 4 lights, 3 intensities"),
        (replaced("light_intensities.txt", "1 1 1\n" * 3 + "1 0 1"), False, "light 4 has no intensity"),
        (without("light_directions.txt"), False, 'ps: there is no file ".*light_directions.txt"'),
        (replaced("light_directions.txt", ""), False, "ps: light_directions.txt is empty"),
        (replaced("light_directions.txt", "0 0 1\n0 0\n"), False, 'line 2: expected 3 .*, got "0 0"; it has x y z'),
        (replaced("light_directions.txt", "0 0 1\n0 nan 1\n"), False, "line 2: expected 3 finite numbers"),
        (replaced("light_directions.txt", "x y z\n0 0 1\n"), False, 'line 1: .* got "x y z"; take a header away'),
        (replaced("light_directions.txt", "0 0 1\n", "utf-16"), False, "light_directions.txt is not text in UTF-8"),
        (replaced("filenames.txt", "bühne.exr\n", "latin-1"), False, "ps: filenames.txt is not text in UTF-8"),
        (replaced("filenames.txt", "a.exr\nb.exr\na.exr\n"), False, 'ps: filenames.txt lists "a.exr" twice'),
        (replaced("filenames.txt", "a.bmp\nb.exr\nc.exr\nd.exr"), False, 'ps: "a.bmp" is of a format that is not read'),
        (layers_without_a_picture, False, 'ps: "a.exr" has the layers albedo, beauty, and which of them'),
        (printed, False, 'ps: "a.jpg" is printed in four colours'),
        (replaced("light_directions.txt", "0 0 1\n0 0 0\n" * 2), False, "light_directions.txt, line 2: the direction"),
        (replaced("K.txt", "1 0 0\n0 1 0\n"), False, "ps: K.txt: the camera must be a matrix"),
        (replaced("K.txt", "-9 0 0\n0 9 0\n0 0 1"), False, "ps: K.txt: the camera must be a matrix"),
        (picture("Normal_gt.exr", 4, 7, 3), False, "ps: Normal_gt.exr holds no normals of the size of the mask"),
        (replaced("distance.txt", "-2"), True, "ps: the distance must be positive, got -2"),
        (without("distance.txt"), True, "ps: lights at finite distance need the distance .* write it to distance.txt"),
        (without("K.txt"), True, "ps: lights at finite distance need a camera; write its matrix to K.txt"),
        (replaced("leds.csv", "x,y,z\n1,2,3"), True, "leds.csv, line 1: the columns must be"),
        (replaced("light_distance.txt", "2"), False, "ps: near lights need K.txt and distance.txt, which tell where"),
        (replaced("light_distance.txt", "2"), True, "ps: lights have positions already; take leds.csv"),
        (
            replaced("light_distance.txt", "-2"),
            False,
            "light_distance.txt: the distance of the lights must be positive, got -2",
        ),
    ],
)
def test_errors_of_folders(tmp_path: Path, change: Callable[[Path], None], near: bool, message: str) -> None:
    folder = tmp_path / "set"
    dataset.write(folder, small(near))
    change(folder)
    with pytest.raises((ValueError, OSError), match=message):
        dataset.read(folder)


def test_there_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r'ps: there is no folder ".*nowhere"'):
        dataset.read_names(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": np.ones((5, 4, 3), np.float32)}, r"values of the shape \(5, 4, 3\) for 30 pixels of the mask"),
        ({"intensities": np.ones((3, 3))}, "4 images, 4 lights and 3 intensities: there must be as many of each"),
        (
            {"values": np.ones((30, 2, 3), np.float32), "lights": np.eye(3)[:2], "intensities": np.ones((2, 3))},
            "at least three images are needed, got 2",
        ),
        ({"camera": np.eye(4)}, "the camera must be a matrix"),
        ({"distance": 0.0}, "the distance must be positive, got 0.0"),
    ],
)
def test_errors_of_data_sets(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"^ps: .*{message}"):
        dataclasses.replace(small(), **changes)


@pytest.mark.parametrize("step", [2, 3])
def test_smaller_images(step: int) -> None:
    """Means over the pixels of the mask, where it has at least half of a block."""
    data = small(near=True)
    found = data.at(1 / step)
    H, W = data.mask.shape
    full, inside = data.image(data.values), data.image(data.truth)
    means, normals, mask = [], [], np.zeros((-(-H // step), -(-W // step)), bool)
    for row, column in np.ndindex(mask.shape):
        block = np.s_[row * step : (row + 1) * step, column * step : (column + 1) * step]
        if 2 * data.mask[block].sum() >= step**2:
            mask[row, column] = True
            means.append(full[block][data.mask[block]].mean(0))
            normals.append(unit(inside[block][data.mask[block]].mean(0)))
    assert 0 < mask.sum() < mask.size
    np.testing.assert_array_equal(found.mask, mask)
    np.testing.assert_allclose(found.values, means, rtol=1e-6)
    np.testing.assert_allclose(found.truth, normals, atol=1e-12)
    # The same point of the world lies where the coarse pixel's centre does
    point = np.array([0.3, -0.2, 1.7])
    fine, coarse = (K @ point / point[2] for K in (data.camera, found.camera))
    np.testing.assert_allclose(coarse[:2] * step + (step - 1) / 2, fine[:2])
    assert data.at(1.0) is data and found.distance == data.distance
    with pytest.raises(ValueError, match=r"ps: the mask is too small: at a size of 0.05, no pixel of it is left"):
        data.at(1 / 20)


def test_axes(diligent) -> None:
    """x to the right, y up, z towards the camera, of lights and normals."""
    data = diligent("ball")
    truth = data.image(data.truth)
    H, W = data.mask.shape
    assert truth[H // 2, -20, 0] > 0.5 > -0.5 > truth[H // 2, 20, 0]
    assert truth[20, W // 2, 1] > 0.5 > -0.5 > truth[-20, W // 2, 1]
    image = data.image(data.luminance)
    right, up = np.argmax(data.lights[:, 0]), np.argmax(data.lights[:, 1])
    assert image[:, W // 2 :, right].mean() > 1.5 * image[:, : W // 2, right].mean()
    assert image[: H // 2, :, up].mean() > 1.5 * image[H // 2 :, :, up].mean()
