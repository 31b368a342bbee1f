"""Images that are too large for memory: their surface is found from smaller ones, their normals are fitted by rows."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rimlight.cli import main
from rimlight.exr import read_exr
from rimlight.inverse.photometric_stereo import dataset, full_size, reconstruction, simulation
from rimlight.inverse.photometric_stereo.dataset import angles
from rimlight.inverse.photometric_stereo.vectors import unit

QUICK = {"resolutions": (0.5, 1.0), "iterations": (2, 2), "spp": 4, "coat": False, "materials": "one"}
RUN = ["--reduce", "2", "--full-size", "--resolutions", "1", "--iterations", "1", "--spp", "1", "--materials", "one"]


def simulated(path: Path, **options) -> Path:
    wanted = {"size": 48, "lights": 16, "spp": 16, "shape": "bowl", "bsdf": "diffuse:0.7,0.5,0.3", "max_depth": 3}
    data, _ = simulation.simulate(simulation.Options(**(wanted | options)), progress=False)
    dataset.write(path, replace(data, names=tuple(f"{k:02d}.exr" for k in range(len(data.lights)))))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return simulated(tmp_path_factory.mktemp("data") / "bowl")


@pytest.fixture(scope="module")
def result(folder) -> reconstruction.Result:
    """Of images of half the width."""
    data = dataset.read(folder, reduce=2)
    return reconstruction.reconstruct(data, reconstruction.Options(**QUICK), progress=False)


def find(folder, out, result, **options) -> full_size.FullSize:
    return full_size.find(folder, out, result, reconstruction.Options(**(QUICK | options)), reduce=2)


def test_smaller_images_are_those_of_the_data_set(folder):
    found, expected = dataset.read(folder, reduce=2), dataset.read(folder).at(0.5)
    assert (found.mask == expected.mask).all() and found.names == expected.names
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-5, atol=1e-7)
    assert angles(found.truth, expected.truth).max() < 0.1


@pytest.mark.parametrize("camera", [None, [[60.0, 0, 5], [0, 60, 4], [0, 0, 1]]])
def test_what_is_clipped_in_part_is_clipped(tmp_path, camera):
    """A quarter of a block, of which the mean is not the largest value."""
    values = np.full((8 * 6, 4, 3), 0.2, np.float32)
    values[0, :2] = 1
    lights = unit(np.array([[0, 0, 1.0], [1, 0, 1], [0, 1, 1], [-1, 0, 1]]))
    camera = None if camera is None else np.array(camera)
    dataset.write(tmp_path, dataset.Dataset(values, np.ones((6, 8), bool), lights, np.ones((4, 3)), camera))
    found = dataset.read(tmp_path, reduce=2)
    assert found.clipped[0].tolist() == [True, True, False, False] and not found.clipped[1:].any()
    assert found.at(1 / 3).clipped[:, 0].tolist() == [True]
    assert not found.without([0]).clipped[0, 1:].any() and found.without([0]).clipped[0, 0]
    if camera is not None:
        np.testing.assert_allclose(found.camera, dataset.coarser(camera, 2))


@pytest.mark.parametrize("of", ["distant lights", "rig"])
def test_values_are_those_of_the_data_set(tmp_path, of):
    """Of a rig, they are divided by what arrives from its distance."""
    rng = np.random.default_rng(1)
    lights = unit(np.array([[0, 0, 1.0], [1, 0, 1], [0, 1, 1], [-1, 0, 1]]))
    values, intensities = rng.uniform(0, 1, (8 * 6, 4, 3)).astype(np.float32), rng.uniform(1, 2, (4, 3))
    values[3, 2] = 9
    camera = np.array([[60.0, 0, 3.5], [0, 60, 2.5], [0, 0, 1]]) if of == "rig" else None
    folder, mask = tmp_path / "data", np.ones((6, 8), bool)
    dataset.write(folder, dataset.Dataset(values, mask, lights, intensities, camera, distance=700.0))
    if of == "rig":
        (folder / dataset.LIGHT_DISTANCE).write_text("500")
    smaller, whole = (dataset.read(folder, reduce=step) for step in (2, 1))
    with full_size.Pixels(folder, tmp_path, dataset.read_setup(folder), smaller) as pixels:
        found = [pixels.of(slice(i, i + 20), 3.0) for i in (0, 20, 40)]
    np.testing.assert_allclose(np.concatenate([v for v, _ in found]), 3 * whole.values, rtol=1e-5)
    over = np.concatenate([over for _, over in found])
    assert (over == whole.clipped).all() and over.any()


@pytest.mark.parametrize("step", [2, 3])
def test_what_is_linear_is_interpolated_exactly(step):
    rows, columns = np.nonzero(np.ones((12, 18), bool))
    mask = np.ones((12 // step, 18 // step), bool)
    between = full_size.Between(mask, step)
    coarse = np.stack(np.nonzero(mask), 1) * step + (step - 1) / 2
    pixels, weights = between.weights(rows, columns)
    found = (coarse[pixels] * weights[..., None]).sum(1)
    limits = coarse.min(0), coarse.max(0)
    np.testing.assert_allclose(found, np.clip(np.stack([rows, columns], 1), *limits), atol=1e-5)
    block = coarse[between.block(rows, columns)]
    assert np.abs(block - np.stack([rows, columns], 1)).max() <= (step - 1) / 2


def of_interpolated(result, full, truth) -> float:
    """Mean error of the normals of a result, interpolated to the full images, degrees."""
    pixels, weights = full_size.Between(result.data.mask, 2).weights(*np.nonzero(full.mask))
    return float(angles(unit((result.guess.normals[pixels] * weights[..., None]).sum(1)), truth).mean())


def test_normals_are_those_of_a_run_at_full_size(tmp_path):
    """Better than interpolated ones where normals change within a block; their means stay what was judged."""
    folder = simulated(tmp_path / "data", shape="folds", size=64, spp=64)
    options = reconstruction.Options(**QUICK)
    result, whole = (
        reconstruction.reconstruct(dataset.read(folder, reduce=step), options, progress=False) for step in (2, 1)
    )
    full = find(folder, tmp_path, result)
    assert full.error == pytest.approx(angles(full.normals, whole.data.truth).mean(), rel=1e-4)
    assert full.error < 0.8 * of_interpolated(result, full, whole.data.truth) and full.error < 1.1 * whole.error
    means, between = np.zeros_like(result.guess.normals), full_size.Between(result.data.mask, 2)
    np.add.at(means, between.block(*np.nonzero(full.mask)), full.normals)
    assert angles(unit(means), result.guess.normals).mean() < 0.1 * of_interpolated(result, full, whole.data.truth)
    assert {path.name for path in tmp_path.iterdir()} == {"data"}


def test_rows_do_not_depend_on_how_many_are_fitted_at_a_time(folder, tmp_path, result, monkeypatch):
    at_once = find(folder, tmp_path, result)
    monkeypatch.setattr(full_size, "AT_ONCE", 16 * 101)
    by_parts = find(folder, tmp_path, result)
    assert angles(at_once.normals, by_parts.normals).max() < 0.01
    np.testing.assert_allclose(at_once.albedo, by_parts.albedo, rtol=1e-3)


@pytest.mark.parametrize("kind", ["several materials", "near lights", "distance told"])
def test_of_other_kinds(tmp_path, kind):
    """Each of them changes which numbers a pixel has, or where it is."""
    more = {
        "several materials": {"bsdf": "glaze:0.6,0.3,0.2|glaze:0.1,0.2,0.5"},
        "near lights": {"led_distance": 2.0, "focal": 4.0},
        "distance told": {},
    }
    folder = simulated(tmp_path / "data", shape="folds", lights=20, size=64, spp=64, **more[kind])
    options = {"materials": "several" if "several" in kind else "one"}
    data = dataset.read(folder, reduce=2)
    result = reconstruction.reconstruct(data, reconstruction.Options(**(QUICK | options)), progress=False)
    if kind == "distance told":  # far enough not to matter
        result = replace(result, away=2000.0)
    full = find(folder, tmp_path, result, **options)
    assert (full.base is not None) == (full.albedo is None) == (kind == "several materials")
    assert full.error < of_interpolated(result, full, dataset.read(folder).truth)


def test_the_command_writes_them(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["ps", "run", str(folder), "--out", str(out), *RUN]) == 0
    assert "normals of" in capsys.readouterr().out
    mask = dataset.read(folder).mask
    for name, channels in (("normals", 3), ("albedo", 1)):
        (layer,) = read_exr(out / "full_size" / f"{name}.exr")[0].values()
        assert layer.shape == (*mask.shape, channels) and (layer[mask] != 0).any(1).all() and not layer[~mask].any()
        (layer,) = read_exr(out / f"{name}.exr")[0].values()
        assert layer.shape[0] == mask.shape[0] // 2
    assert {path.name for path in (out / "full_size").iterdir()} == {
        "normals.exr", "normals.png", "albedo.exr", "metadata.json"
    }  # fmt: skip
    told = {at: json.loads((out / at / "metadata.json").read_text("utf-8")) for at in ("", "full_size")}
    assert told[""]["reduce"] == 2 and told["full_size"]["pixels"] == mask.sum()
    assert told["full_size"]["size"] == [*mask.shape[::-1]] and told["full_size"]["mean_angular_error_degrees"] < 30
    page = (out / "report.html").read_text("utf-8")
    assert "Full images" in page and f"{mask.sum()} pixels" in page


def test_interrupted_runs_fit_them_later(folder, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"

    def pressed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(full_size, "find", pressed)
        assert main(["ps", "run", str(folder), "--out", str(out), *RUN]) == 130
    assert "--resume" in capsys.readouterr().err and (out / "report.html").exists()
    assert main(["ps", "run", str(folder), "--out", str(out), *RUN, "--resume"]) == 0
    assert (out / "full_size" / "normals.exr").exists()


@pytest.mark.parametrize(
    "options, texts",
    [(["--full-size"], ["--reduce"]), (["--reduce", "0"], ["reduce"]), (["--reduce", "90"], ["mask", "no pixel"])],
)
def test_what_cannot_be_is_refused(folder, tmp_path, capfd, options, texts):
    assert main(["ps", "run", str(folder), "--out", str(tmp_path / "out"), *options]) == 2
    said = capfd.readouterr().err
    assert all(text in said for text in texts), said


def test_space_is_checked_before(folder, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(full_size.shutil, "disk_usage", lambda _: SimpleNamespace(free=1))
    assert main(["ps", "run", str(folder), "--out", str(tmp_path / "new" / "out"), *RUN]) == 2
    assert "full images need" in capfd.readouterr().err


def test_a_disk_that_is_full_all_the_same_is_named(folder, tmp_path, result, monkeypatch):
    class Full:
        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self):
            self.closed = True

    file = Full()
    monkeypatch.setattr(full_size.tempfile, "TemporaryFile", lambda dir: file)
    with pytest.raises(OSError, match=str(tmp_path)):
        find(folder, tmp_path, result)
    assert file.closed


def test_other_images_are_refused(folder, tmp_path, result):
    other = replace(result, data=replace(result.data, names=("other.exr", *result.data.names[1:])))
    with pytest.raises(ValueError, match="not those of the result"):
        find(folder, tmp_path, other)
