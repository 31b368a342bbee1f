"""The command line: what it writes, and that every mistake ends in one line that names it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes
from rimlight.checks import FiniteDifferences, derivative_image
from rimlight.cli import main
from rimlight.exr import read_exr
from rimlight.loading import InputError, check_scene, load_scene

TRIANGLES = str(scenes.path("two_triangles"))
SMALL = ["-D", "res=16"]
MOVE = ["--param", "green.vertex_positions", "--direction", "1,0,0"]

PLY = """ply
format ascii 1.0
element vertex {vertices}
property float x
property float y
property float z
element face {faces}
property list uchar int vertex_indices
end_header
"""


def scene_with(shape: str, sensor: str = '<sensor type="perspective" id="camera"/>') -> str:
    return f'<scene version="3.0.0">{sensor}<emitter type="constant"/>{shape}</scene>'


@pytest.fixture
def folder(tmp_path) -> Path:
    """Where bad scenes lie."""
    path = tmp_path / "scenes"
    path.mkdir()
    (path / "broken.xml").write_text('<scene version="3.0.0"><sensor type="perspective"></scene>')
    (path / "unknown.xml").write_text(scene_with('<shape type="spheer"/>'))
    (path / "property.xml").write_text(scene_with('<shape type="cube"><float name="siez" value="1"/></shape>'))
    (path / "no_mesh.xml").write_text(
        scene_with('<shape type="ply"><string name="filename" value="gone.ply"/></shape>')
    )
    (path / "no_sensor.xml").write_text(scene_with('<shape type="cube"/>', sensor=""))
    group = '<shape type="shapegroup" id="group"><shape type="sphere"/></shape>'
    copy = '<shape type="instance" id="copy"><ref id="group"/></shape>'
    (path / "instance.xml").write_text(scene_with(group + copy))
    for name, type_, width in (("no_width", "perspective", 0), ("no_width_orthographic", "orthographic", 0)):
        film = f'<film type="hdrfilm"><integer name="width" value="{width}"/></film>'
        (path / f"{name}.xml").write_text(scene_with("", sensor=f'<sensor type="{type_}" id="camera">{film}</sensor>'))
    meshes = {
        "no_vertices": PLY.format(vertices=0, faces=0),
        "no_faces": PLY.format(vertices=3, faces=0) + "0 0 0\n1 0 0\n0 1 0\n",
        "nan_text": PLY.format(vertices=3, faces=1) + "0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n",
    }
    for name, text in meshes.items():
        (path / f"{name}.ply").write_text(text)
    binary = PLY.format(vertices=3, faces=1).replace("ascii", "binary_little_endian").encode()
    vertices = np.array([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]], "<f4").tobytes()
    (path / "nan_binary.ply").write_bytes(binary + vertices + b"\3" + np.arange(3, dtype="<i4").tobytes())
    for name in (*meshes, "nan_binary"):
        flat = '<boolean name="face_normals" value="true"/>' if name == "nan_binary" else ""
        shape = f'<shape type="ply" id="thing"><string name="filename" value="{name}.ply"/>{flat}</shape>'
        (path / f"{name}.xml").write_text(scene_with(shape))
    (path / "file.txt").write_text("a file, no folder")
    return path


def check_refused(capfd, arguments: list[str], out: Path, *culprits: str) -> None:
    """Exit code 2, one line on standard error that holds all `culprits`, nothing written."""
    capfd.readouterr()
    assert main(arguments) == 2
    captured = capfd.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("rimlight: error: ")
    for culprit in culprits:
        assert culprit in lines[0]
    assert not out.exists()


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("name", "culprits"),
    [
        ("missing.xml", ["missing.xml", "does not exist"]),
        (".", ["is not a file"]),
        ("broken.xml", ["broken.xml", "line 1"]),
        ("unknown.xml", ["unknown.xml", '"spheer" not found']),
        ("property.xml", ["property.xml", '"siez"']),
        ("no_mesh.xml", ["no_mesh.xml", "gone.ply", "not found"]),
        ("no_sensor.xml", ["no_sensor.xml", "no sensor"]),
        ("no_width.xml", ["no_width.xml", "is the width or the height of the film 0?"]),
        ("no_width_orthographic.xml", ['"camera"', "0 x "]),
        ("no_vertices.xml", ["no_vertices.xml", "no vertices or no faces"]),
        ("no_faces.xml", ["no_faces.xml", "no vertices or no faces"]),
        ("nan_text.xml", ["nan_text.ply", '"float" value for field z']),
        ("nan_binary.xml", ["nan_binary.ply", "invalid vertex position"]),
    ],
)
def test_bad_scenes(capfd, folder, tmp_path, name, culprits):
    out = tmp_path / "out"
    check_refused(capfd, ["render", str(folder / name), "--out", str(out)], out, *culprits)


@pytest.mark.parametrize(
    ("options", "culprits"),
    [
        (
            ["--param", "gren.vertex_positions", "--direction", "1,0,0"],
            ['"gren.vertex_positions"', "did you mean green"],
        ),
        (["--param", "green.faces", "--direction", "1,0,0"], ['"green.faces"', "UInt"]),
        (["--param", "green.vertex_positions", "--direction", "1,0"], ["needs 3 numbers, got 2"]),
        (["--param", "green.vertex_positions", "--direction", "1,0,up"], ["--direction", '"1,0,up"']),
        (["--param", "green.vertex_positions", "--direction", "1,nan,0"], ["finite"]),
        (["--param", "green.vertex_positions", "--rotate", "0,0,0"], ["axis of rotation is zero"]),
        (["--param", "green.vertex_positions"], ["--direction", "--rotate"]),
        (["--direction", "1,0,0"], ["--param", "--camera"]),
        ([*MOVE, "--rotate", "0,0,1"], ["--direction", "--rotate"]),
        ([*MOVE, "--pivot", "0,0,1"], ["--pivot"]),
        ([*MOVE, "--camera", "translate"], ["--param", "--camera"]),
        (["--camera", "rotate", "--direction", "1,0,0"], ["--camera rotate needs --rotate"]),
        ([*MOVE, "--vertices", "0,7"], ["0 … 2", "7"]),
        ([*MOVE, "--vertices", "0,a"], ["--vertices", '"0,a"']),
        (["--param", "green.bsdf.reflectance.value", "--rotate", "0,0,1"], ["cannot rotate"]),
        (["--param", "camera.near_clip", "--direction", "1"], ['"camera.near_clip" is of type float, which has no']),
        ([*MOVE, "--spp", "0"], ["--spp must be >= 1, got 0"]),
        ([*MOVE, "--spp", "-4"], ["--spp must be >= 1, got -4"]),
        ([*MOVE, "--seed", "-1"], ["--seed must be >= 0"]),
        ([*MOVE, "--sensor", "3"], ["--sensor", "3"]),
        ([*MOVE, "--integrator", "direct_egde"], ['"direct_egde"', "did you mean direct_edge"]),
        ([*MOVE, "--integrator", "cube"], ['"cube"']),
        ([*MOVE, "--variant", "llvm_ad_rbg"], ['"llvm_ad_rbg"']),
        ([*MOVE, "--variant", "scalar_rgb"], ['"scalar_rgb"', "cannot differentiate"]),
        ([*MOVE, "-D", "res"], ['"res"', "key=value"]),
        ([*MOVE, "-D", "foo=3"], ["unused parameter", "foo"]),
    ],
)
def test_bad_options(capfd, tmp_path, options, culprits):
    out = tmp_path / "out"
    check_refused(capfd, ["gradient", TRIANGLES, *SMALL, *options, "--out", str(out)], out, *culprits)


def test_a_shape_that_cannot_move(capfd, folder, tmp_path):
    out = tmp_path / "out"
    options = ["--param", "copy.to_world", "--direction", "1,0,0", "--spp", "1", "--out", str(out)]
    check_refused(capfd, ["gradient", str(folder / "instance.xml"), *options], out, 'shape "copy" (Instance)')


def test_vertices_that_are_not_finite():
    scene = mi.load_file(TRIANGLES)
    params = mi.traverse(scene)
    params["red.vertex_positions"] = mi.Float([np.nan, *range(8)])
    params.update()
    with pytest.raises(InputError, match=r'"a.xml": shape "red" has 1 vertices that are not finite'):
        check_scene(scene, Path("a.xml"))


@pytest.mark.parametrize("command", ["render", "gradient"])
def test_output_that_cannot_be_a_folder(capfd, folder, command):
    out = folder / "file.txt" / "out"
    options = [] if command == "render" else MOVE
    check_refused(capfd, [command, TRIANGLES, *options, "--out", str(out)], out, "--out", "file.txt")
    assert main([command, TRIANGLES, *options, "--out", str(folder / "file.txt")]) == 2


def test_output_that_must_be_a_file(capfd, tmp_path):
    command = ["finite-differences", TRIANGLES, *MOVE, "--step", "0.001"]
    check_refused(capfd, [*command, "--out", str(tmp_path / "a.png")], tmp_path / "a.png", "must end in .exr")
    (tmp_path / "folder.exr").mkdir()
    assert main([*command, "--out", str(tmp_path / "folder.exr")]) == 2
    assert "is a folder" in capfd.readouterr().err


def test_steps_and_runs_out_of_range(capfd, tmp_path):
    out = tmp_path / "a.exr"
    command = ["finite-differences", TRIANGLES, *SMALL, *MOVE, "--out", str(out), "--step"]
    check_refused(capfd, [*command, "0"], out, "step must be > 0")
    check_refused(capfd, [*command, "0.1", "--runs", "1"], out, "2 runs")
    check_refused(capfd, [*command, "0.1", "--spp", str(2**24)], out, "exceed the limit")
    check_refused(capfd, ["check", TRIANGLES, *MOVE, "--step", "0.1", "--seeds", "1"], out, "--seeds must be >= 2")


@pytest.mark.parametrize(
    "arguments", [[], ["rendre"], ["render", TRIANGLES, "--nonsense"], ["render", TRIANGLES, "--spp", "x"]]
)
def test_usage_errors(capfd, arguments):
    assert main(arguments) == 2
    assert capfd.readouterr().err


def test_bugs_keep_their_traceback(monkeypatch, tmp_path):
    def fail(*_args, **_options):
        raise ValueError("a bug")

    monkeypatch.setattr("rimlight.cli._commands.derivative_image", fail)
    with pytest.raises(ValueError, match="a bug"):
        main(["gradient", TRIANGLES, *SMALL, *MOVE, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------ good runs


@pytest.mark.parametrize(
    ("options", "name"),
    [([], "direct_edge"), (["--integrator", "prb_edge"], "prb_edge"), (["-D", "integrator=path"], "prb_edge")],
)
def test_plan_is_that_of_the_integrator_of_the_scene(options, name, tmp_path, capsys):
    """If that is one of Rimlight, and no other one is named."""
    scene = tmp_path / "scene.xml"
    which = '<default name="integrator" value="direct_edge"/><integrator type="$integrator"/>'
    scene.write_text(scene_with(which + '<shape type="cube"/>'))
    assert main(["plan", str(scene), *options]) == 0
    assert capsys.readouterr().out.startswith(f"{name}: ")


def test_params(capsys):
    assert main(["params", TRIANGLES]) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert rows["green.vertex_positions"].split()[1:] == ["Float", "9", "∂,", "D"]
    assert rows["camera.to_world"].endswith("∂, D")
    assert rows["green.bsdf.reflectance.value"].endswith("∂")
    assert "green.faces" not in rows


#: As exporters write scenes: cameras and lights have no identifier, and materials are equal.
UNNAMED = """
<scene version="3.0.0">
    <bsdf type="diffuse" id="wall"/>
    <bsdf type="diffuse" id="floor"/>
    <shape type="cube"><ref id="floor"/></shape>
    <shape type="cube"><transform name="to_world"><translate x="4"/></transform><ref id="wall"/></shape>
    <shape type="cube" id="Cube_1"><transform name="to_world"><translate x="8"/></transform><ref id="wall"/></shape>
    <emitter type="point"/>
    <sensor type="perspective"/>
</scene>
"""


def test_files_without_names(capsys, tmp_path):
    """What a file has is there, nothing merged, with the same names in each run."""
    (tmp_path / "scene.xml").write_text(UNNAMED)
    scene = load_scene(tmp_path / "scene.xml")
    assert [s.id() for s in scene.shapes()] == ["Cube", "Cube_2", "Cube_1"]
    assert [float(s.bbox().center().x) for s in scene.shapes()] == [0, 4, 8]
    assert main(["params", str(tmp_path / "scene.xml")]) == 0
    out = capsys.readouterr().out
    for key in (
        "Cube.vertex_positions",
        "Cube_2.vertex_positions",
        "Cube_1.vertex_positions",
        "PerspectiveCamera.to_world",
        "PointLight.intensity.value",
        "wall.reflectance.value",
        "floor.reflectance.value",
    ):
        assert re.search(rf"^{re.escape(key)} ", out, re.MULTILINE), key
    assert "object_" not in out


def test_render_to_a_folder_and_to_a_file(tmp_path):
    options = ["render", TRIANGLES, "-Dres=16", "--spp", "8", "--seed", "3"]
    assert main([*options, "--out", str(tmp_path / "a" / "b")]) == 0
    assert main([*options, "--out", str(tmp_path / "c.exr")]) == 0
    layers, metadata = read_exr(tmp_path / "a" / "b" / "image.exr")
    assert layers[""].shape == (16, 16, 3)
    assert metadata["spp"] == "8"
    assert metadata["seed"] == "3"
    assert metadata["define"] == "res=16"
    np.testing.assert_array_equal(read_exr(tmp_path / "c.exr")[0][""], layers[""])
    assert tuple(mi.Bitmap(str(tmp_path / "c.png")).size()) == (16, 16)
    assert {file.name for file in tmp_path.rglob("*") if file.is_file()} == {"image.exr", "image.png", "c.exr", "c.png"}


@pytest.mark.parametrize(
    ("motion", "key", "unit"),
    [
        ([*MOVE, "--vertices", "0"], "green.vertex_positions", "scene unit"),
        (["--camera", "rotate", "--rotate=0,-1,0"], "camera.to_world", "radian"),
        (["--camera", "translate", "--direction", "-1,0,0"], "camera.to_world", "scene unit"),
        (["--param", "red.bsdf.reflectance.value", "--direction", "1"], "red.bsdf.reflectance.value", "unit"),
    ],
)
def test_gradient(tmp_path, motion, key, unit):
    out = tmp_path / "out"
    assert main(["gradient", TRIANGLES, *SMALL, *motion, "--spp", "4", "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["derivative.exr", "derivative.png", "image.exr", "image.png"]
    layers, metadata = read_exr(out / "derivative.exr")
    assert layers[""].shape == (16, 16, 3)
    assert np.isfinite(layers[""]).all()
    assert np.abs(layers[""]).max() > 0
    assert metadata["key"] == key
    assert metadata["unit"] == unit
    assert metadata["motion"].startswith(key)
    assert {"scene", "integrator", "spp", "seed", "rimlight", "mitsuba", "drjit", "seconds"} <= metadata.keys()


def test_many_samples_are_split(tmp_path, monkeypatch):
    """Launches with different seeds add up to the mean that one launch has, within the noise."""
    options = ["gradient", TRIANGLES, *SMALL, *MOVE, "--spp", "100", "--out"]
    assert main([*options, str(tmp_path / "one")]) == 0
    monkeypatch.setattr("rimlight.cli._shared.MAX_SAMPLES", 16 * 16 * 7)
    assert main([*options, str(tmp_path / "many")]) == 0
    one, many = (read_exr(tmp_path / name / "derivative.exr")[0][""] for name in ("one", "many"))
    assert 0 < np.abs(one - many).sum() < 0.2 * np.abs(one).sum()


def test_finite_differences(tmp_path):
    file = tmp_path / "new" / "reference.exr"
    options = ["--step", "0.01", "--runs", "2", "--spp", "16", "--out", str(file)]
    assert main(["finite-differences", TRIANGLES, *SMALL, *MOVE, *options]) == 0
    reference = FiniteDifferences.read(file)
    assert reference.mean.shape == reference.standard_error.shape == (16, 16, 3)
    assert reference.settings["runs"] == "2"
    assert reference.settings["key"] == "green.vertex_positions"


def test_check_tells_right_from_wrong(capsys, tmp_path):
    options = [
        "check",
        TRIANGLES,
        *SMALL,
        *MOVE,
        "--vertices",
        "0",
        "--step",
        "0.005",
        "--runs",
        "8",
        "--fd-spp",
        "256",
    ]
    picture = tmp_path / "check.png"
    assert main([*options, "--seeds", "8", "--out", str(picture)]) == 0
    assert "agree" in capsys.readouterr().out
    assert mi.Bitmap(str(picture)).size().x > 500
    # Mitsuba's `direct` does not know the boundary
    assert main([*options, "--seeds", "4", "--integrator", "direct"]) == 1
    out = capsys.readouterr().out
    assert "DISAGREE" in out
    # But the image has a derivative.
    assert "differences before and after differ by" in out
    assert "no derivative" not in out


def test_interruption_leaves_nothing(capfd, tmp_path, monkeypatch):
    """As when Ctrl-C is pressed during the third of four launches."""
    seeds = []

    def interrupted(*arguments, seed, **options):
        seeds.append(seed)
        if len(seeds) == 3:
            raise KeyboardInterrupt
        return derivative_image(*arguments, seed=seed, **options)

    monkeypatch.setattr("rimlight.cli._commands.derivative_image", interrupted)
    monkeypatch.setattr("rimlight.cli._shared.MAX_SAMPLES", 16 * 16)
    assert main(["gradient", TRIANGLES, *SMALL, *MOVE, "--spp", "4", "--out", str(tmp_path / "out")]) == 130
    assert capfd.readouterr().err.splitlines()[-1] == "rimlight: interrupted"
    assert seeds == [0, 1, 2]
    assert list(tmp_path.iterdir()) == []


def test_module_and_system_information():
    process = subprocess.run(
        [sys.executable, "-m", "rimlight", "sys-info"], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0
    assert "Mitsuba" in process.stdout
