"""`rimlight ps`: simulated data sets have the truth that they claim; runs write their files, whatever happens."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import psutil
import pytest
from pages import Page, in_browser

from rimlight import ggx
from rimlight.cli import _ps, main
from rimlight.exr import read_exr, write_exr
from rimlight.inverse.photometric_stereo import cost, dataset, output, reconstruction, report, simulation
from rimlight.inverse.photometric_stereo.dataset import angles
from rimlight.inverse.photometric_stereo.integration import normals_of
from rimlight.inverse.photometric_stereo.rendering import Rendering
from rimlight.inverse.photometric_stereo.vectors import unit

N, LIGHTS = 24, 12
SMALL = {"size": N, "lights": LIGHTS, "spp": 16}
QUICK = ["--resolutions", "0.5", "1", "--iterations", "2", "1", "--no-exposures"]

FILES = {"normals.exr", "depth.exr", "albedo.exr", "bsdf.json", "exposures.txt", "metadata.json"}
PICTURES = {"normals.png", "bsdf.png", "mesh.ply", "report.html"}


def simulated(**options) -> tuple[dataset.Dataset, np.ndarray]:
    return simulation.simulate(simulation.Options(**{**SMALL, **options}), progress=False)


def ball(data: dataset.Dataset, radius: float) -> np.ndarray:
    """Normals of a sphere in the middle of the image, (P, 3)."""
    rows, columns = np.nonzero(data.mask)
    middle = (N - 1) / 2
    x, y = columns - middle, middle - rows
    return np.stack([x, y, np.sqrt(radius**2 - x * x - y * y)], 1) / radius


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A bowl with interreflections, by the command."""
    path = tmp_path_factory.mktemp("data") / "bowl"
    options = ["--size", str(N), "--lights", str(LIGHTS), "--spp", "16", "--max-depth", "4"]
    assert main(["ps", "simulate", str(path), "--shape", "bowl", "--bsdf", "diffuse:0.7,0.5,0.3", *options]) == 0
    return path


@pytest.fixture(scope="module")
def result(folder, tmp_path_factory) -> tuple[Path, str]:
    """What a run writes, and its last line."""
    out = tmp_path_factory.mktemp("result") / "new" / "out"
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_ps, "print", lambda *words, **_: lines.append(" ".join(words)), raising=False)
        one = ["--materials", "one", "--coat", "False"]
        assert main(["ps", "run", str(folder), "--out", str(out), *QUICK, *one, "--brightness", "0"]) == 0
    return out, lines[-1]


# ------------------------------------------------------------------ simulation


def test_sphere_is_what_formulas_say():
    data, depth = simulated(max_depth=2, spp=64)
    radius = simulation.FILLED * N / 2
    normals = ball(data, radius)
    assert data.values.shape == (data.mask.sum(), LIGHTS, 3)
    assert data.mask.sum() > 0.8 * np.pi * radius**2
    flat = normals[:, 2] > 0.4  # else, normals differ within a pixel
    assert angles(data.truth, normals)[flat].max() < 0.4
    np.testing.assert_allclose(depth[data.mask], radius * normals[:, 2], atol=1e-4)
    assert np.isnan(depth[~data.mask]).all()
    cosine = normals @ data.lights.T
    lit = flat[:, None] & (cosine > 0.3)
    ratio = data.values[lit][:, 1] / (0.5 / np.pi * cosine[lit])
    assert abs(ratio - 1).max() < 0.08
    assert ratio.mean() == pytest.approx(1, abs=0.005)
    assert data.values[cosine < -0.2].max() == 0


def test_bowl_faces_the_camera_and_reflects_on_itself():
    single, depth = simulated(shape="bowl", max_depth=2, bsdf="diffuse:0.8,0.8,0.8")
    multiple, _ = simulated(shape="bowl", max_depth=4, bsdf="diffuse:0.8,0.8,0.8")
    a = simulation.FILLED * N / 2
    height = 2 * a * simulation.Options().hollow
    radius = (a * a + height * height) / (2 * height)
    normals = ball(single, radius) * [-1, -1, 1]
    assert angles(single.truth, normals).max() < 1
    np.testing.assert_allclose(depth[single.mask], radius - height - radius * normals[:, 2], atol=1e-3)
    assert multiple.values.mean() > 1.2 * single.values.mean()
    shadows = (normals @ single.lights.T > 0.1) & (single.values[..., 0] == 0)
    assert shadows.mean() > 0.01
    assert (multiple.values[shadows] > 0).mean() > 0.95

    convex = [simulated(max_depth=d)[0].values for d in (2, 4)]
    np.testing.assert_allclose(convex[1], convex[0], atol=1e-6)


def test_concave_is_mirrored():
    convex, mould = (simulation.height_field(simulation.Options(size=N, concave=c)) for c in (False, True))
    np.testing.assert_array_equal(mould.depth, -convex.depth)
    np.testing.assert_array_equal(mould.normals, convex.normals * [-1, -1, 1])


@pytest.mark.parametrize("concave", [False, True])
def test_mesh(tmp_path, concave):
    """A plane z = 0.5 x, turned until it is z = 0.5 y, and cropped."""
    (tmp_path / "plane.obj").write_text("v 0 0 0\nv 2 0 1\nv 2 2 1\nv 0 2 0\nf 1 2 3 4\n")
    options = {"shape": str(tmp_path / "plane.obj"), "rotate": (0, 0, 90), "crop": (0, 0, 1, 0.5, 0)}
    data, depth = simulated(**options, concave=concave, smooth=0, max_depth=2, spp=1)
    sign = -1 if concave else 1
    assert angles(data.truth, unit(np.array([0, -0.5 * sign, 1]))).max() < 0.01
    np.testing.assert_allclose(np.diff(depth, axis=0)[N // 2, N // 2], -0.5 * sign, atol=1e-4)
    rows, columns = np.nonzero(data.mask)
    assert np.ptp(columns) > 1.8 * np.ptp(rows) > 0.8 * simulation.FILLED * N / 2


def test_camera_and_leds():
    """Lambertian, by the law of the inverse square, in the units of the data set."""
    data, depth = simulated(shape="bowl", hollow=0.1, focal=2.0, led_distance=1.5, max_depth=2, spp=64)
    z = depth[data.mask]
    rows, columns = np.nonzero(data.mask)
    K = data.camera
    point = np.stack([z * (columns - K[0, 2]) / K[0, 0], -z * (rows - K[1, 2]) / K[1, 1], -z], 1)
    assert data.distance == pytest.approx(np.exp(np.log(z).mean()))
    assert data.distance == pytest.approx(2 * N, rel=0.1)
    for k, led in enumerate(data.lights):
        offset = np.array(led.position) - point
        r = np.linalg.norm(offset, axis=1)
        emitted = -(offset @ np.array(led.axis)) / r
        expected = 0.5 / np.pi * emitted * (offset * data.truth).sum(1) / r**3
        np.testing.assert_allclose(data.values[:, k, 1], expected, rtol=0.05)


def test_noise():
    clean, first, again, other = (
        simulated(noise=noise, seed=seed, max_depth=2)[0].values
        for noise, seed in ((0, 1), (0.1, 1), (0.1, 1), (0.1, 2))
    )
    noise = first - clean
    assert noise.std() == pytest.approx(0.1 * np.median(clean), rel=0.05)
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(noise.ravel(), (other - clean).ravel())[0, 1]) < 0.2


def test_lights_fill_a_cap():
    lights = simulation.spiral(96, 55)
    assert np.linalg.norm(lights, axis=1) == pytest.approx(1)
    assert 50 < np.degrees(np.arccos(lights[:, 2].min())) < 55
    nearest = np.sort(np.degrees(np.arccos(np.clip(lights @ lights.T, -1, 1))), axis=1)[:, 1]
    assert nearest.min() > 0.5 * nearest.max() > 3


def test_written_data_set_reads_back(folder):
    data = dataset.read(folder)
    expected, depth = simulated(shape="bowl", bsdf="diffuse:0.7,0.5,0.3", max_depth=4)
    np.testing.assert_allclose(data.values, expected.values, rtol=1e-5)  # samples add up in any order
    np.testing.assert_array_equal(data.mask, expected.mask)
    np.testing.assert_allclose(data.truth, expected.truth, atol=1e-6)
    layers, header = read_exr(folder / "Depth_gt.exr")
    np.testing.assert_allclose(layers[""][..., 0][data.mask], depth[data.mask], rtol=1e-6)
    assert header["shape"] == "bowl"
    fewer = dataset.read(folder, images=4)
    np.testing.assert_array_equal(fewer.values, data.values[:, ::3])
    np.testing.assert_array_equal(fewer.lights, data.lights[::3])
    assert fewer.names == data.names[::3]


def test_near_data_set_reads_back(tmp_path):
    options = simulation.Options(size=N, lights=3, spp=1, max_depth=2, focal=2.0, led_distance=2.0)
    data, depth = simulation.simulate(options, progress=False)
    simulation.write(tmp_path / "near", data, depth, options)
    read = dataset.read(tmp_path / "near")
    assert read.lights == data.lights
    np.testing.assert_allclose(read.values, data.values, rtol=1e-6)
    np.testing.assert_array_equal(read.camera, data.camera)


# ------------------------------------------------------------------ runs


def test_run_writes_everything(folder, result):
    out, last = result
    assert {path.name for path in out.iterdir()} == FILES | PICTURES
    metadata = json.loads((out / "metadata.json").read_text("utf-8"))
    data = dataset.read(folder)
    normals = read_exr(out / "normals.exr")[0][""]
    error = angles(normals[data.mask], data.truth).mean()
    assert last == f"mean angular error {error:.2f} deg"
    assert metadata["mean_angular_error_degrees"] == pytest.approx(error, abs=1e-4)
    assert metadata["status"] == "finished"
    assert metadata["options"]["resolutions"] == [0.5, 1.0]
    # At the smallest size, alternations begin from normals of a glossy surface, too.
    sizes = [0.5] * (2 + reconstruction.SETTLED) + [1.0]
    assert [entry["size"] for entry in metadata["history"]] == sizes
    assert (normals[~data.mask] == 0).all()
    encoded = np.asarray(mi.Bitmap(str(out / "normals.png")))
    assert encoded.dtype == np.uint16
    np.testing.assert_allclose(encoded[data.mask] / 65535 * 2 - 1, normals[data.mask], atol=2e-5)

    depth, header = read_exr(out / "depth.exr")
    assert header["unit"].startswith("pixels")
    mesh = mi.load_dict({"type": "ply", "filename": str(out / "mesh.ply")})
    vertices = np.array(mi.traverse(mesh)["vertex_positions"]).reshape(-1, 3)
    rows, columns = np.nonzero(data.mask)
    np.testing.assert_allclose(vertices, np.stack([columns, -rows, depth[""][data.mask][:, 0]], 1), atol=1e-5)
    assert metadata["depth_error"] < 1

    lobes, weights = ggx.read(out / "bsdf.json")
    assert metadata["factor_of_bsdf"] == 1
    found = mi.load_dict({"type": "ggx_dictionary", "filename": str(out / "bsdf.json")})
    reflected = output.reflected(found, 0, np.array([45.0]))[0] / np.cos(np.pi / 4) * np.pi
    np.testing.assert_allclose(reflected, [0.7, 0.5, 0.3], rtol=0.15)
    assert len(lobes) == len(weights)
    assert np.loadtxt(out / "exposures.txt") == pytest.approx(np.ones(LIGHTS))


def test_several_data_sets_on_workers(folder, result, tmp_path, capfd):
    """What is wrong with one does not stop the others, and is not done again."""
    pytest.importorskip("distributed")
    (tmp_path / "empty").mkdir()
    one = ["--materials", "one", "--coat", "False"]
    arguments = ["ps", "run", str(folder), str(tmp_path / "empty"), "--out", str(tmp_path / "out"), *QUICK, *one]
    assert main([*arguments, "--brightness", "0", "--workers", "1"]) == 2
    said = capfd.readouterr().out.splitlines()
    assert said[0].startswith("bowl: finished: ") and said[-1].startswith("empty: ps: there are no pictures in")
    both = [json.loads((out / "metadata.json").read_text()) for out in (result[0], tmp_path / "out" / "bowl")]
    assert both[0]["status"] == both[1]["status"] == "finished"
    normals = [read_exr(out / "normals.exr")[0][""] for out in (result[0], tmp_path / "out" / "bowl")]
    assert np.abs(normals[0] - normals[1]).mean() < 2e-3
    assert main([*arguments, "--brightness", "0"]) == 2
    assert "bowl" in (refused := capfd.readouterr().err) and "holds a result already" in refused
    assert main([*arguments, "--brightness", "0", "--resume"]) == 2
    assert capfd.readouterr().out.startswith("bowl: finished already: ")


def test_data_sets_need_different_names(folder, tmp_path, capfd):
    assert main(["ps", "run", str(folder), str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "data sets need different names, got bowl, bowl" in capfd.readouterr().err
    assert main(["ps", "run", "--out", str(tmp_path / "out")]) == 2
    assert "name a folder with images" in capfd.readouterr().err


def test_page_shows_the_result(result):
    out, _ = result
    source = (out / "report.html").read_text("utf-8")
    page = Page(source)
    metadata = json.loads((out / "metadata.json").read_text("utf-8"))
    for text in (
        "finished",
        f"mean angular error {metadata['mean_angular_error_degrees']:.2f}°",
        "001.exr",
        "rendering",
    ):
        assert text in page.text
    images = page.images()
    assert len(images) >= 3 + 2 + 2 + report.LIGHTS + 3 * report.PHOTOGRAPHS
    assert all(np.ptp(np.asarray(image.convert("RGB"))) > 0 for image in images)
    for tag, attributes in page.elements:
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("data:", "#")), tag


def test_relighting_follows_the_light(result):
    """The side to the light is the brighter one, but of a bowl the other."""
    images = Page((result[0] / "report.html").read_text("utf-8")).images()
    relit = [np.asarray(i.convert("L"), float) for i in images if i.format == "JPEG"]
    assert len(relit) == report.LIGHTS
    brightness = lambda image: (image[:, : image.shape[1] // 2].mean(), image[:, image.shape[1] // 2 :].mean())
    left, right = brightness(relit[0])  # from the right
    assert left > 1.2 * right
    left, right = brightness(relit[report.LIGHTS // 2])
    assert right > 1.2 * left


def test_large_results_are_shown_small(folder, tmp_path, monkeypatch):
    """Means over blocks of pixels: of normals, and of depth in larger pixels."""
    options = reconstruction.Options(reflectance=False, resolutions=(1.0,), iterations=(1,), max_depth=2)
    found = reconstruction.reconstruct(dataset.read(folder), options, progress=False)
    monkeypatch.setattr(report, "SHOWN", N // 2)
    view = report.View.of(found)
    assert view.data.mask.shape == (N // 2, N // 2)
    assert angles(view.guess.normals, view.data.truth).mean() < 1.5 * found.error
    of_depth = normals_of(view.data.image(view.depth, np.nan), view.data.mask)[view.data.mask]
    assert np.median(angles(of_depth, view.guess.normals)) < 10
    report.write(tmp_path, found, options, title="<b>", status="finished")
    page = Page((tmp_path / "report.html").read_text("utf-8"))
    assert "<b>" in page.texts
    assert max(image.width for image in page.images()) <= N // 2


CHECK = """<script>
window.onload = () => {
  const done = {};
  const relit = document.querySelector(".relit");
  const slider = relit.querySelector("input");
  const shown = () => [...relit.querySelectorAll("img")].map((image, i) => image.checkVisibility() ? i : -1)
    .filter((i) => i >= 0);
  done.before = shown();
  slider.value = 6;
  slider.dispatchEvent(new Event("input"));
  done.after = shown();
  done.dot = relit.querySelector(".dot").getAttribute("cy");
  done.loaded = [...document.images].every((image) => image.complete && image.naturalWidth > 0);
  done.width = document.documentElement.scrollWidth - window.innerWidth;
  done.errors = errors;
  document.title = JSON.stringify(done);
};
</script>"""


@pytest.mark.parametrize("width", [1200, 500])
def test_page_works_in_a_browser(result, tmp_path, width):
    done = in_browser((result[0] / "report.html").read_text("utf-8"), CHECK, tmp_path, width)
    assert done["errors"] == []
    assert done["loaded"]
    assert done["before"] == [0]
    assert done["after"] == [6]
    assert float(done["dot"]) == pytest.approx(6)
    assert done["width"] <= 0


@pytest.mark.parametrize("alternations", [0, 1])
def test_interruption(folder, tmp_path, monkeypatch, capfd, alternations):
    """As when Ctrl-C is pressed: results are on disk before, as they must be for a kill; and complete afterwards."""
    out = tmp_path / "out"
    update, calls = Rendering.update, []

    def interrupted(*arguments):
        calls.append({path.name for path in out.iterdir()} if out.exists() else set())
        if len(calls) == 2 * alternations + 1:  # of the start; then of the state that each makes
            raise KeyboardInterrupt
        return update(*arguments)

    monkeypatch.setattr(Rendering, "update", interrupted)
    assert main(["ps", "run", str(folder), "--out", str(out), *QUICK, "--no-reflectance"]) == 130
    captured = capfd.readouterr()
    if not alternations:
        assert captured.err.splitlines()[-1] == "rimlight: interrupted"
        assert {path.name for path in out.iterdir()} == {_ps.CHECKPOINT}
        return
    assert calls[2] == FILES | {_ps.CHECKPOINT}
    assert {path.name for path in out.iterdir()} == FILES | PICTURES | {_ps.CHECKPOINT}
    metadata = json.loads((out / "metadata.json").read_text("utf-8"))
    assert metadata["status"] == "interrupted"
    assert len(metadata["history"]) == 1
    assert metadata["size"] == [N // 2, N // 2]
    assert "mean angular error" in captured.out.splitlines()[-1]
    assert "interrupted" in Page((out / "report.html").read_text("utf-8")).text


def test_snapshot_does_not_change(folder):
    taken: list[tuple[reconstruction.Result, np.ndarray, np.ndarray]] = []

    def after(result):
        copy = output.snapshot(result)
        taken.append((copy, copy.guess.normals.copy(), copy.guess.weights.copy()))

    options = reconstruction.Options(reflectance=False, resolutions=(0.5, 1.0), iterations=(2, 1), max_depth=2)
    reconstruction.reconstruct(dataset.read(folder), options, progress=False, after=after)
    assert [len(copy.history) for copy, *_ in taken] == [1, 2, 3]
    for copy, normals, weights in taken:
        np.testing.assert_array_equal(copy.guess.normals, normals)
        np.testing.assert_array_equal(copy.guess.weights, weights)
        assert len(copy.data.values) == len(normals)


def test_bright_images_have_a_bsdf_that_can_be_read(folder):
    """Images in any unit: weights that would sum to more than 1 are divided by a factor."""
    data = dataset.read(folder)
    options = reconstruction.Options(reflectance=False, resolutions=(1.0,), iterations=(1,), max_depth=2)
    bright = reconstruction.reconstruct(
        dataset.Dataset(data.values * 1000, data.mask, data.lights, data.intensities), options, progress=False
    )
    weights, factor = output.bsdf(bright)
    ggx.check_weights(weights, bright.lobes)
    assert weights.sum(0).max() == pytest.approx(1)
    assert factor == pytest.approx(700, rel=0.3)


# ------------------------------------------------------------------ bad input


def refused(capfd, arguments: list[str], *texts: str) -> None:
    assert main(["ps", *arguments]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    for text in ("rimlight: error: ", *texts):
        assert text in lines[0]


def damage(folder: Path, how: str) -> None:
    first = folder / "001.exr"
    if how == "no image":
        first.unlink()
    elif how == "fewer images":
        names = (folder / "filenames.txt").read_text().splitlines()
        (folder / "filenames.txt").write_text("\n".join(names[:-1]))
    elif how == "damaged PNG":
        (folder / "filenames.txt").write_text("\n".join(["001.png", *(f"{k:03d}.exr" for k in range(2, LIGHTS + 1))]))
        (folder / "001.png").write_bytes((folder / "mask.png").read_bytes()[:60])
    elif how == "mask of another size":
        mi.Bitmap(np.full((N, N + 1, 1), 255, np.uint8)).write(str(folder / "mask.png"))
    elif how == "empty mask":
        mi.Bitmap(np.zeros((N, N, 1), np.uint8)).write(str(folder / "mask.png"))
    elif how == "no mask":
        (folder / "mask.png").unlink()
    elif how == "NaN":
        write_exr(first, {"": np.full((N, N, 3), np.nan)})
    elif how == "no directions":
        (folder / "light_directions.txt").unlink()
    elif how == "words":
        (folder / "light_directions.txt").write_text("up up up\n" * LIGHTS)


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ("no image", "001.exr"),
        ("fewer images", f"{LIGHTS - 1} images, {LIGHTS} lights"),
        ("damaged PNG", "cannot read"),
        ("mask of another size", f"{N} x {N} pixels, the mask {N + 1} x {N}"),
        ("empty mask", "the mask is empty"),
        ("no mask", "mask.png"),
        ("NaN", "not finite"),
        ("no directions", "light_directions.txt"),
        ("words", "light_directions.txt"),
    ],
)
def test_bad_data_sets(folder, tmp_path, capfd, how, text):
    shutil.copytree(folder, tmp_path / "data")
    damage(tmp_path / "data", how)
    refused(capfd, ["run", str(tmp_path / "data"), "--out", str(tmp_path / "out")], text)
    assert not (tmp_path / "out").exists()


def test_bad_folders(folder, result, tmp_path, capfd, monkeypatch):
    run = ["run", str(folder), "--out"]
    refused(capfd, ["run", str(tmp_path / "none"), "--out", str(tmp_path / "out")], "there is no folder")
    refused(capfd, [*run, str(result[0])], "holds a result already")
    refused(capfd, [*run, str(folder)], "--out", "is the folder of the images")
    refused(capfd, [*run, str(tmp_path / "out"), "--variant", "llvm_ad_spectral"], "three colours", "llvm_ad_rgb")
    mi.set_variant("llvm_ad_rgb")
    refused(capfd, ["simulate", str(folder)], "holds a data set already")
    (tmp_path / "file").write_text("mine")
    refused(capfd, [*run, str(tmp_path / "file" / "out")], "--out", "is not a folder")
    monkeypatch.setattr("os.access", lambda *_: False)
    refused(capfd, [*run, str(tmp_path / "out")], "--out", "no permission")
    refused(capfd, ["simulate", str(tmp_path / "out")], "OUT", "no permission")
    assert {path.name for path in tmp_path.iterdir()} == {"file"}


def test_disk_that_fails(folder, tmp_path, capfd, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(output, "write_exr", full)
    refused(capfd, ["run", str(folder), "--out", str(tmp_path / "out"), *QUICK, "--no-reflectance"], "No space left")
    assert not list((tmp_path / "out").glob("*.exr"))


def test_a_control_group_limits_memory(tmp_path, monkeypatch):
    """What the system keeps of files counts as free; a group without a limit does not count."""
    files = [tmp_path / name for name in ("max", "current", "stat")]
    monkeypatch.setattr(cost, "GROUPS", (tuple(map(str, files)),))
    machine = cost.available_memory()
    assert 2**20 < machine <= psutil.virtual_memory().total
    for file, text in zip(files, ("5000", "3000", "anon 2000\ninactive_file 700\n"), strict=True):
        file.write_text(text)
    assert cost.available_memory() == 5000 - 3000 + 700
    files[0].write_text("max\n")
    assert cost.available_memory() > 2**20


def test_memory_is_checked(folder, tmp_path, capfd, monkeypatch):
    P, K, _ = dataset.read(folder).values.shape
    needed = cost.memory(P, K, reconstruction.Options())
    monkeypatch.setattr(cost, "available_memory", lambda: needed - 1)
    run = ["run", str(folder), "--out", str(tmp_path / "out")]
    refused(capfd, run, f"{K} images of {P} pixels", "GiB", "--images", "--resolutions")
    monkeypatch.setattr(_ps.Run, "_reconstruct", lambda *_: (0, []))
    assert main(["ps", *run, "--images", str(K - 1)]) == 0
    assert main(["ps", *run, "--resolutions", "0.5", "--iterations", "1"]) == 0


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        (["--bsdf", "gray-plastik"], ["gray-plastik"]),
        (["--bsdf", "gone.binary"], ["there is no file", "gone.binary"]),
        (["--bsdf", "diffuse:1,2"], ["diffuse:R,G,B"]),
        (["--bsdf", "short.binary"], ["short.binary", "bytes"]),
        (["--shape", "cube"], ["unknown shape"]),
        (["--shape", "gone.obj"], ["there is no file", "gone.obj"]),
        (["--shape", "empty.obj"], ["no faces"]),
        (["--shape", "broken.ply"], ["cannot read", "broken.ply"]),
        (["--shape", "line.obj"], ["sees nothing"]),
    ],
)
def test_bad_simulations(tmp_path, capfd, monkeypatch, options, texts):
    monkeypatch.chdir(tmp_path)
    Path("short.binary").write_bytes(np.array([90, 90, 180], "<i4").tobytes())
    Path("empty.obj").write_text("nothing\n")
    Path("broken.ply").write_text("ply nonsense\n")
    Path("line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    refused(capfd, ["simulate", "out", "--size", "16", *options], *texts)
    assert not Path("out").exists()


@pytest.mark.parametrize(
    "options", [{"size": 4}, {"spread": 90}, {"hollow": 0.6}, {"led_distance": 2.0}, {"lights": 2}]
)
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f'"{next(iter(options))}" is out of its range'):
        simulation.Options(**options)
