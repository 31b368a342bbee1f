"""`rimlight ps inspect`: what is wrong with a data set is said, and nothing else."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from pages import Page
from PIL import Image

from rimlight.cli import main
from rimlight.exr import write_exr
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import cost, dataset, inspection, simulation
from rimlight.inverse.photometric_stereo.dataset import Dataset
from rimlight.inverse.photometric_stereo.vectors import unit

N, LIGHTS = 24, 24


@pytest.fixture(scope="module")
def matte() -> Dataset:
    options = simulation.Options(size=N, lights=LIGHTS, spp=16, max_depth=2, noise=0.005)
    return simulation.simulate(options, progress=False)[0]


def write(folder: Path, data: Dataset, *, bits: int = 0, srgb: bool = False) -> Path:
    """As EXR; or as PNG of so many bits, the brightest value nearly white."""
    dataset.write(folder, data)
    names = []
    for k in range(len(data.lights) if bits else 0):
        picture = np.clip(0.95 * data.image(data.values[:, k]) / data.values.max(), 0, 1)
        if srgb:
            picture = np.where(picture <= 0.0031308, 12.92 * picture, 1.055 * picture ** (1 / 2.4) - 0.055)
        names.append(f"{k + 1:03d}.png")
        levels = np.round((2**bits - 1) * picture).astype(f"u{bits // 8}")
        mi.Bitmap(levels).write(str(folder / names[-1]))
    if bits:
        (folder / "filenames.txt").write_text("\n".join(names))
    return folder


def changed(data: Dataset, how: str) -> Dataset:
    values, lights, intensities, mask = data.values.copy(), data.lights, data.intensities.copy(), data.mask
    if how == "clipped":
        values[:, 5] = np.minimum(values[:, 5] * 4, values.max())
    elif how == "black":
        values[:, 7] = 0
    elif how == "plane":
        lights = unit(lights * [1, 0, 1])
    elif how == "narrow":
        lights = unit(lights * [0.05, 0.05, 1])
    elif how == "one side":
        lights = unit(np.where(lights[:, :1] < 0, -lights, lights) * [1, 1, 0] + [0.2, 0, 0] + lights * [0, 0, 1])
    elif how == "exposed":
        values[:, 3] *= 1.5
    elif how == "few":
        values, lights, intensities = values[:, -3:], lights[-3:], intensities[-3:]
    elif how == "pieces":
        mask = mask.copy()
        mask[:, N // 2] = False
        values = values[mask[data.mask]]
    return Dataset(values, mask, lights, intensities)


def test_a_good_set_gives_no_warning(matte: Dataset, tmp_path: Path) -> None:
    found = inspection.inspect(write(tmp_path, matte))
    assert inspection.warnings(found) == []
    assert (found.images, found.pixels, found.parts, found.rank) == (LIGHTS, len(matte.values), 1, 3)
    assert found.bits == "EXR, floating point"
    np.testing.assert_allclose(found.directions, matte.lights, atol=1e-6)
    np.testing.assert_allclose(found.exposures, 1, atol=0.02)
    # A sphere, on which shadows are where it turns away from the light
    away = (matte.truth @ matte.lights.T <= 0).mean(0)
    np.testing.assert_allclose(found.shadowed, away, atol=0.05)
    assert found.shadowed.max() > 0.1
    assert found.small[0].shape == (N, N, 3)


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ("clipped", "% of 006.exr is saturated"),
        ("black", "% of 008.exr is black"),
        ("plane", "in a plane: normals cannot be told"),
        ("narrow", "close together"),
        ("one side", "There is no light in"),
        ("exposed", "exposure of 004.exr seems to be off"),
        ("few", "none can be left out"),
        ("pieces", "The mask has 2 pieces"),
    ],
)
def test_what_is_wrong_is_said_first(matte: Dataset, tmp_path: Path, how: str, text: str) -> None:
    said = inspection.warnings(inspection.inspect(write(tmp_path, changed(matte, how))))
    assert said and text in said[0], said


@pytest.mark.parametrize(("bits", "srgb"), [(8, True), (16, True), (8, False), (16, False)])
def test_pictures_for_the_screen(matte: Dataset, tmp_path: Path, bits: int, srgb: bool) -> None:
    found = inspection.inspect(write(tmp_path, matte, bits=bits, srgb=srgb))
    assert found.bits == f"PNG, {bits} bits"
    assert any("sRGB" in text for text in inspection.warnings(found)) == srgb


def test_sixteen_bits_of_which_eight_are_used(matte: Dataset, tmp_path: Path) -> None:
    folder = write(tmp_path, matte, bits=8)
    for path in folder.glob("[0-9]*.png"):
        mi.Bitmap(np.asarray(Image.open(path)).astype(np.uint16) * 257).write(str(path))
    assert inspection.inspect(folder).bits == "PNG, 16 bits (only 8 are used)"


def test_near_lights(tmp_path: Path) -> None:
    options = simulation.Options(size=N, lights=12, spp=4, max_depth=2, focal=2.0, led_distance=2.0)
    data, depth = simulation.simulate(options, progress=False)
    simulation.write(tmp_path / "near", data, depth, options)
    found = inspection.inspect(tmp_path / "near")
    assert dict(inspection.table(found))["lights"].startswith("near, at known positions")
    assert dict(inspection.table(found))["camera"] == "perspective"
    assert found.rank == 3 and found.angles.max() < 80


def test_estimates_grow_with_the_work() -> None:
    options = ps.Options()
    assert cost.seconds(4000, 96, options, cores=2) < cost.seconds(400_000, 96, options, cores=2)
    one = ps.Options(materials="one", coat=False)
    assert cost.seconds(4000, 96, one, cores=2) < cost.seconds(4000, 96, options, cores=2)
    coarse = ps.Options(resolutions=(0.25,), iterations=(10,))
    assert cost.memory(4000, 96, coarse) < cost.memory(4000, 96, options)


def test_memory_that_is_not_there(matte: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "available_memory", lambda: 1000)
    assert "GiB of memory" in inspection.warnings(inspection.inspect(write(tmp_path, matte)))[0]


def test_command(matte: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Prints the table, and writes a page that holds all images and loads nothing."""
    folder, out = write(tmp_path / "<b>", changed(matte, "black")), tmp_path / "new" / "page.html"
    assert main(["ps", "inspect", str(folder), "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split(maxsplit=1) == ["images", f"{LIGHTS} of {N} x {N} pixels, EXR, floating point"]
    assert sum(line.startswith("look at this: ") for line in lines) == 1
    assert lines[-1] == f"page: {out}"
    page = Page(out.read_text("utf-8"))
    assert "one thing to look at" in page.text and "008.exr" in page.text
    assert "Data set: <b>" in page.texts
    images = page.images()
    assert len(images) == 1 + LIGHTS
    assert np.ptp(np.asarray(images[8].convert("RGB"))) == 0  # the black one
    for tag, attributes in page.elements:
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("data:", "#")), tag


@pytest.mark.parametrize("how", ["no mask", "NaN", "no folder"])
def test_bad_sets_are_refused(matte: Dataset, tmp_path: Path, capfd: pytest.CaptureFixture, how: str) -> None:
    folder = write(tmp_path / "data", matte)
    if how == "no mask":
        (folder / "mask.png").unlink()
    elif how == "NaN":
        write_exr(folder / "001.exr", {"": np.full((N, N, 3), np.nan)})
    else:
        folder = tmp_path / "none"
    assert main(["ps", "inspect", str(folder), "--out", str(tmp_path / "page.html")]) == 2
    text = {"no mask": "mask.png", "NaN": "not finite", "no folder": "there is no folder"}[how]
    assert text in capfd.readouterr().err
    assert not (tmp_path / "page.html").exists()
