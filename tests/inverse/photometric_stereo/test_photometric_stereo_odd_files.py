"""Folders as people have them: what is odd about their files is read rightly, reported, or refused with the remedy."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from photometric import write_jpeg
from PIL import Image

from rimlight.cli import main
from rimlight.inverse.photometric_stereo import dataset, inspection, plausibility, simulation
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles

N, LIGHTS = 24, 12


@pytest.fixture(scope="module")
def matte() -> Dataset:
    options = simulation.Options(size=N, lights=LIGHTS, spp=16, max_depth=2, noise=0.005)
    data = simulation.simulate(options, progress=False)[0]
    return dataclasses.replace(data, names=tuple(f"{k + 1:03d}.exr" for k in range(LIGHTS)))


@pytest.fixture
def folder(matte: Dataset, tmp_path: Path) -> Path:
    dataset.write(tmp_path / "data", matte)
    return tmp_path / "data"


def doubts(folder: Path) -> list[str]:
    """Of a set, which reading and inspecting must agree on."""
    read, found = dataset.read(folder), inspection.inspect(folder)
    assert list(read.doubts) == [*found.of_files, *found.compression.said()]
    said = list(plausibility.checked(read).doubts)
    assert set(said) <= set(inspection.warnings(found))
    return said


def test_nothing_is_said_of_a_good_folder(folder: Path) -> None:
    assert doubts(folder) == []


# ------------------------------------------------------------------ names


def test_names_with_spaces_and_umlauts(matte: Dataset, tmp_path: Path) -> None:
    """Of pictures of all kinds, of the folder, of results and of pages."""
    folder, out, names = tmp_path / "Bär mit Hut", tmp_path / "Größe 1", []
    dataset.write(folder, matte)
    for k in range(LIGHTS):
        linear = np.clip(matte.image(matte.values[:, k]) / matte.values.max(), 0, 1)
        names.append(f"Bild {k + 1} ü" + (".png", ".tif")[k % 2])
        Image.fromarray(np.round(255 * linear).astype(np.uint8)).save(folder / names[-1])
    (folder / "filenames.txt").write_text("\n".join(names), "utf-8")
    assert main(["ps", "inspect", str(folder), "--out", str(tmp_path / "Prüfung.html")]) == 0
    assert "Bild 1 ü.png" in (tmp_path / "Prüfung.html").read_text("utf-8")
    quick = ["--no-reflectance", "--resolutions", "1", "--iterations", "1", "--max-depth", "2"]
    assert main(["ps", "run", str(folder), "--out", str(out), *quick]) == 0
    assert "Bär mit Hut" in (out / "report.html").read_text("utf-8") and (out / "mesh.ply").exists()


def test_hidden_files_are_no_pictures(folder: Path) -> None:
    """macOS writes ._1.png beside 1.png on disks of other systems, and into archives. Nor are folders."""
    (folder / "filenames.txt").unlink()
    (folder / "000.png").mkdir()
    for k in range(LIGHTS):
        (folder / f"._{k + 1:03d}.exr").write_bytes(b"\0\5\x16\7")
    assert dataset.read(folder).names == tuple(f"{k + 1:03d}.exr" for k in range(LIGHTS))


@pytest.mark.parametrize("line", ['"{}"', "'{}'", ".\\{}", "{}\r"], ids=["quotes", "single quotes", "Windows", "CR"])
def test_lists_of_other_programs(folder: Path, line: str) -> None:
    text = "# the images\n" + "\n".join(line.format(f"{k + 1:03d}.exr") for k in range(LIGHTS))
    (folder / "filenames.txt").write_text(text, newline="")
    assert dataset.read(folder).names == tuple(f"{k + 1:03d}.exr" for k in range(LIGHTS))


def elsewhere(folder: Path, names: str) -> None:
    """Pictures go to a folder of this name, or become files of this kind."""
    (folder / "filenames.txt").unlink()
    (folder / "images").mkdir()
    for picture in folder.glob("0*.exr"):
        picture.rename(folder / "images" / picture.name if names == "images" else picture.with_suffix(names))


def renamed(folder: Path, before: str, after: str) -> None:
    (folder / before).rename(folder / after)


def one_more(folder: Path) -> None:
    (folder / "filenames.txt").unlink()
    shutil.copy(folder / "001.exr", folder / "preview.exr")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: renamed(f, "mask.png", "Mask.jpg"), 'mask.png"; it is a picture .* is it "Mask.jpg"?$'),
        (lambda f: renamed(f, "005.exr", "005.EXR"), '005.exr"; is it "005.EXR"?$'),
        (lambda f: renamed(f, "005.exr", "x"), '005.exr"$'),
        (lambda f: renamed(f, "light_directions.txt", "Light_Direction.txt"), 'calibrate" .* is it "Light_D.*.txt"?$'),
        (lambda f: elsewhere(f, "images"), "ps: there are no pictures in .*images.* list them .* as images/001.exr$"),
        (lambda f: elsewhere(f, ".CR2"), "ps: there are no pictures in .*; make EXR, PNG .* of the files .CR2$"),
        (one_more, "13 images, .* all that are there: 001.exr, 002.exr, ..., 011.exr, 012.exr, preview.exr$"),
        (lambda f: Image.new("L", (N, N)).save(f / "mask.png"), "the mask is empty; make white in mask.png what"),
    ],
)
def test_what_is_missing(folder: Path, change: Callable[[Path], None], message: str) -> None:
    """Is said with what it should be, and which file may be meant."""
    change(folder)
    for read in (dataset.read, inspection.inspect):
        with pytest.raises((ValueError, OSError), match=message.replace("?$", r"\?$")):
            read(folder)


# ------------------------------------------------------------------ pictures


@pytest.mark.parametrize(("of", "suffix"), [("JPEG", ".png"), ("PNG", ".jpg"), ("TIFF", ".png"), ("PNG", ".tif")])
def test_pictures_of_other_kinds_than_their_names_say(folder: Path, of: str, suffix: str) -> None:
    """Some are decoded from sRGB, others are not."""
    Image.new("RGB", (N, N), "gray").save(folder / f"1{suffix}", format=of)
    names = (folder / "filenames.txt").read_text().split()
    (folder / "filenames.txt").write_text("\n".join([f"1{suffix}", *names[1:]]))
    with pytest.raises(ValueError, match=f'^ps: "1{suffix}" is a {of} file, whatever its name says; rename it'):
        dataset.read(folder)


@pytest.mark.parametrize("orientation", [3, 6])
def test_pictures_that_other_programs_turn(matte: Dataset, tmp_path: Path, orientation: int) -> None:
    """By a camera that looks down, say: the mask may be of what is shown, or of what is stored."""
    folder = write_jpeg(tmp_path, matte, 95)
    with Image.open(folder / "003.jpg") as picture:
        entries = picture.getexif()
        entries[0x0112] = 1
        picture.save(folder / "003.jpg", exif=entries, quality=95)
    assert dataset.read(folder).names[2] == "003.jpg"
    entries[0x0112] = orientation
    with Image.open(folder / "003.jpg") as picture:
        picture.save(folder / "003.jpg", exif=entries, quality=95)
    with pytest.raises(ValueError, match=f'"003.jpg" says .EXIF, orientation {orientation}. that it must be turned'):
        dataset.read(folder)


def test_pictures_of_several_kinds(matte: Dataset, folder: Path, tmp_path: Path) -> None:
    """Some are decoded, and others are not: numbers of 255 parts beside those of radiance."""
    write_jpeg(tmp_path / "jpeg", matte, 98)
    names = (folder / "filenames.txt").read_text().split()
    for k in (1, 4):
        names[k] = f"{k + 1:03d}.jpg"
        shutil.copy(tmp_path / "jpeg" / names[k], folder / names[k])
    (folder / "filenames.txt").write_text("\n".join(names))
    said = doubts(folder)
    assert "The pictures are of several kinds: 10 EXR and 2 JPEG." in said[0]
    assert inspection.inspect(folder).bits == "of several kinds"


def test_a_picture_that_is_there_twice(folder: Path) -> None:
    """Under another light: one is a copy by mistake. Two pictures under the same light may be equal."""
    shutil.copy(folder / "004.exr", folder / "008.exr")
    (said,) = (text for text in doubts(folder) if "are the same" in text)
    assert said.startswith("The pictures 004.exr and 008.exr are the same, though their lights are ")
    directions = np.loadtxt(folder / "light_directions.txt")
    directions[7] = directions[3]
    np.savetxt(folder / "light_directions.txt", directions)
    assert not any("are the same" in text for text in doubts(folder))


def test_a_mask_of_the_background(matte: Dataset, folder: Path) -> None:
    """All is black in it."""
    Image.fromarray(~matte.mask).save(folder / "mask.png")
    for read in (dataset.read, inspection.inspect):
        with pytest.raises(ValueError, match=r"^ps: all images are black in the mask; check the images"):
            read(folder)


@pytest.mark.skipif(find_spec("imagecodecs") is not None, reason="it is there, and reads such files")
def test_tiff_with_lzw(folder: Path) -> None:
    """Which needs a package that we do not: the message says what to do."""
    Image.new("RGB", (N, N)).save(folder / "1.tif", compression="tiff_lzw")
    (folder / "filenames.txt").write_text("1.tif\n" + "\n".join(f"{k + 1:03d}.exr" for k in range(1, LIGHTS)))
    with pytest.raises(OSError, match=r'ps: cannot read ".*1.tif": .*LZW.*; save it without compression$'):
        dataset.read(folder)


# ------------------------------------------------------------------ lights


def test_lengths_of_directions(matte: Dataset, folder: Path) -> None:
    """Only where they point counts. They may be meant as intensities, unless these are given."""
    longer = matte.lights * np.linspace(1, 2, LIGHTS)[:, None]
    np.savetxt(folder / "light_directions.txt", longer)
    assert doubts(folder) == []
    assert angles(dataset.read(folder).lights, matte.lights).max() < 1e-4
    (folder / "light_intensities.txt").unlink()
    (said,) = doubts(folder)
    assert said.startswith("The directions in light_directions.txt have lengths from 1 to 2, which do not count.")
    np.savetxt(folder / "light_directions.txt", matte.lights, "%.2f")
    assert doubts(folder) == []


@pytest.mark.parametrize("separator", [" ", ";", ", "])
def test_commas_in_the_place_of_points(matte: Dataset, folder: Path, separator: str) -> None:
    rows = [separator.join(f"{x:.3f}" for x in row).replace(".", ",") for row in matte.lights]
    (folder / "light_directions.txt").write_text("\n".join(rows))
    with pytest.raises(ValueError, match=r"light_directions.txt, line 1: expected 3 .*; write decimals with a point$"):
        dataset.read(folder)


def test_a_lamp_that_was_off(folder: Path) -> None:
    rows = (folder / "light_intensities.txt").read_text().splitlines()
    rows[3] = "0 0 0"
    (folder / "light_intensities.txt").write_text("\n".join(rows))
    with pytest.raises(ValueError, match=r'light 4 has no intensity.* take it out .* and "004.exr" out of the folder'):
        dataset.read(folder)


def test_one_number_of_a_light(matte: Dataset, folder: Path) -> None:
    """Stands for all three of its intensity."""
    np.savetxt(folder / "light_intensities.txt", np.full(LIGHTS, 2.0))
    np.testing.assert_allclose(dataset.read(folder).values, matte.values / 2, rtol=1e-5)
    (folder / "light_intensities.txt").write_text("2 2\n" * LIGHTS)
    with pytest.raises(ValueError, match=r"line 1: expected 3 .* it has r g b of its light .* or one number"):
        dataset.read(folder)


@pytest.mark.parametrize("row", ["1 {}", "0.5", "30 45"], ids=["a number before", "one", "angles"])
def test_lines_of_directions(matte: Dataset, folder: Path, row: str) -> None:
    text = "\n".join(row.format(f"{x:.3f} {y:.3f} {z:.3f}") for x, y, z in matte.lights)
    (folder / "light_directions.txt").write_text(text)
    with pytest.raises(ValueError, match=r"light_directions.txt, line 1: expected 3 finite numbers.* it has x y z"):
        dataset.read(folder)


def test_some_lights_behind_the_object(matte: Dataset, folder: Path) -> None:
    """Of which only signs are wrong: three of twelve, too many to be told one by one from the images."""
    signs = np.ones((LIGHTS, 1))
    signs[[3, 6, 8]] = -1
    np.savetxt(folder / "light_directions.txt", matte.lights * signs)
    assert doubts(folder)[0].startswith("The lights of line 4, 7, 9 of light_directions.txt have a z of 0 or less")
