"""The tables of docs/support.md, row by row.

`exact` is checked on charts: one scene with a cell of the film for each row, whose derivative is compared with finite
differences cell by cell; or it names cases of `test_derivatives.py`. `warned` and `refused` are checked by the message.
To add a row: a line in the document, and an entry in `CELLS`, `MESSAGES` or `ELSEWHERE`. Finite differences are stored;
``RENEW_REFERENCES=1 python -m pytest tests/plugins/integrators/test_support.py`` makes them anew (a few minutes).
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cases
import drjit as dr
import leaves
import mitsuba as mi
import numpy as np
import pytest
from invariance import Together

import rimlight
from rimlight import merl_tables
from rimlight.checks import (
    Agreement,
    FiniteDifferences,
    Motion,
    compare,
    derivative_image,
    mean_and_error,
    z_scores,
)
from rimlight.edge_sampling import EdgeKind, Geometry, find_edges, jumping_textures
from rimlight.edge_sampling.geometry import texture_lines

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "support.md"
WORDS = ("exact", "warned", "refused", "untested", "—")
COLUMNS = {"moves": "moves", "changes": "changes", "is passed": "passed", "sees something move": "passed"}

#: Error that the step of the finite differences may make: it is long, so that few samples suffice.
STEP = 0.01

#: Samples per pixel of each term of a chart. Where plates pass, the interior has no noise, the film boundary little.
CHART_SAMPLES = {"passed": {"sppc": 16, "sppp": 64, "sppi": 128}}

#: The largest noise of a cell of a chart, relative to its L1 norm; and of lights, where it is more than usual.
CHART_NOISE = 0.15
NOISY = {("`sunsky` without its sun", "moves"): 0.3}


def reference(name: str, of: Sequence[str], scene: mi.Scene, motion: Any, **options: Any) -> FiniteDifferences:
    return cases.stored_differences(f"support_{name}", of, scene, motion, runs=6, **options)


def runs_of(scene: mi.Scene, motion: Any, runs: int, spp: int = 0, **samples: int) -> np.ndarray:
    """Derivatives with several seeds: (runs, H, W, C). samples : per pixel, of each term, where `spp` is 0."""
    integrator = mi.load_dict({"type": "direct_edge", **samples})
    images = [derivative_image(scene, integrator, motion, spp=spp, seed=100 + i) for i in range(runs)]
    return np.array(images, np.float64)


def compare_part(runs: np.ndarray, whole: FiniteDifferences, part: Any) -> Agreement:
    """part : of the pixels."""
    layers = (whole.mean, whole.standard_error, whole.step_error)
    of_part = FiniteDifferences(*(a[part] for a in layers), whole.settings)
    return compare(np.array([run[part] for run in runs]), of_part, tolerance=STEP)


def rows() -> dict[tuple[str, str], str]:
    """(first cell, column) → what it says, of all tables with the columns `COLUMNS`."""
    found, columns = {}, []
    for line in DOCUMENT.read_text().splitlines():
        cells = [c.strip() for c in line.strip("|").split("|")] if line.startswith("|") else []
        if not cells:
            columns = []
        elif set(cells[1:]) <= set(COLUMNS):
            columns = [COLUMNS[c] for c in cells[1:]]
        elif columns and not cells[0].startswith("---"):
            found.update({(cells[0], column): says for column, says in zip(columns, cells[1:], strict=True)})
    return found


ROWS = rows()


def says(word: str) -> list[tuple[str, str]]:
    return [row for row, text in ROWS.items() if re.search(rf"\b{word}\b", text)]


# ---------------------- Cells of the charts ----------------------


@dataclass(frozen=True)
class Cell:
    """What one cell of a chart shows.

    make : of a BSDF, or with the name of a shape: of that shape.
    change : parameter below it, of which `direction` is the change.
    """

    make: Callable[..., Any]
    change: str | None = None
    direction: tuple[float, ...] = (1.0,)
    shape: bool = False


def bitmap(channels: int = 3, low: float = 0.1, high: float = 0.9, **options) -> dict:
    texels = np.random.default_rng(0).uniform(low, high, (3, 3, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, **options}


def slopes() -> dict:
    """Normals about the z axis, as the map has them."""
    n = np.random.default_rng(1).uniform(-0.25, 0.25, (3, 3, 3))
    n[..., 2] = 1
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return {"type": "bitmap", "bitmap": mi.Bitmap((n * 0.5 + 0.5).astype(np.float32)), "raw": True}


def two(bsdf: dict) -> dict:
    return {"type": "twosided", "bsdf": bsdf}


def textured(texture: dict) -> dict:
    return two({"type": "diffuse", "reflectance": texture})


def bsdf(kind: str, **options) -> Callable[[], dict]:
    return lambda: {"type": kind, **options}


def principled() -> dict:
    return two({"type": "principled", "roughness": 0.4, "metallic": 0.3, "anisotropic": 0.5, "clearcoat": 0.3})


def sheet(name: str, place, bsdf: dict, uv: bool = True, colours: str = "", smooth: bool = False) -> mi.Mesh:
    """A bent square, all of whose faces turn to the camera, with texture coordinates that are not linear.

    colours : "vertex" or "face", which have random ones.
    smooth : with interpolated normals.
    """
    n = 4
    y, x = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij"))
    p = 0.37 * np.stack([x + 0.13 * y, y, 0.25 * (x * x + y * y) + 0.2 * x], -1) + place
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    t = 1.2 * np.stack([x + 0.15 * y * y, y - 0.2 * x * x], -1) if uv else None
    m = cases.mesh(name, p, faces, smooth, t, bsdf=bsdf)
    if colours:
        count = len(p) if colours == "vertex" else len(faces)
        m.add_attribute(f"{colours}_color", 3, np.random.default_rng(2).uniform(0.1, 0.9, 3 * count).astype(np.float32))
    return m


def attribute(name: str) -> dict:
    return textured({"type": "mesh_attribute", "name": name})


def curve(kind: str, folder: Path, place) -> dict:
    file = folder / f"{kind}.txt"
    points = np.array([[-0.3, -0.3, 0], [-0.1, 0.2, 0], [0.1, -0.1, 0], [0.3, 0.3, 0]]) + place
    file.write_text("\n".join(f"{x} {y} {z} 0.1" for x, y, z in points))
    return {"type": kind, "filename": str(file)}


def volume(filter_type: str, voxels: np.ndarray | None = None) -> dict:
    """Colours in space. voxels : (Z, Y, X, 3); None: random ones."""
    voxels = np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 4, 3)) if voxels is None else voxels
    grid = mi.VolumeGrid(voxels.astype(np.float32))
    box = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2.2)
    of = {"type": "gridvolume", "grid": grid, "raw": True, "filter_type": filter_type, "to_world": box}
    return textured({"type": "volume", "volume": of})


def at(place, size: float = 0.35):
    return mi.ScalarTransform4f().translate(list(place)).rotate([0.3, 1, 0], 25).scale(size)


def analytic(kind: str) -> Callable[..., dict]:
    bsdf = cases.diffuse(0.5, two_sided=True)
    return lambda name, place, folder: {"type": kind, "to_world": at(place), "bsdf": bsdf}


def mask() -> dict:
    return {"type": "mask", "opacity": bitmap(1), "bsdf": cases.diffuse(0.8, 0.2, 0.2, two_sided=True)}


def blend() -> dict:
    rough = {"type": "roughconductor", "alpha": 0.3}
    return two({"type": "blendbsdf", "weight": bitmap(1), "a": cases.diffuse(0.8, 0.2, 0.2), "b": rough})


def blend_mirror() -> dict:
    return two({"type": "blendbsdf", "weight": 0.4, "a": cases.diffuse(0.5), "b": {"type": "conductor"}})


CELLS = {
    "`diffuse`": Cell(lambda: two(cases.diffuse(0.6, 0.3, 0.2)), "brdf_0.reflectance.value"),
    "`roughconductor`": Cell(lambda: two(cases.conductor(0.3)), "brdf_0.alpha.value"),
    "`roughconductor`, anisotropic": Cell(
        lambda: two({"type": "roughconductor", "alpha_u": 0.15, "alpha_v": 0.4}), "brdf_0.alpha_u.value"
    ),
    "`roughdielectric`": Cell(bsdf("roughdielectric", alpha=0.3), "eta"),
    "`blinn_phong`": Cell(lambda: two({"type": "blinn_phong", "roughness": 0.3}), "brdf_0.diffuse_reflectance.value"),
    "`roughplastic`": Cell(lambda: two({"type": "roughplastic", "alpha": 0.3}), "brdf_0.diffuse_reflectance.value"),
    "`pplastic`": Cell(lambda: two({"type": "pplastic", "alpha": 0.3}), "brdf_0.diffuse_reflectance.value"),
    "`principled`": Cell(principled, "brdf_0.roughness.value"),
    "`principledthin`": Cell(
        bsdf("principledthin", roughness=0.4, spec_trans=0.3, diff_trans=0.6, eta=1.4), "diff_trans.value"
    ),
    "`hair`": Cell(bsdf("hair")),
    "`normalmap`": Cell(
        lambda: two({"type": "normalmap", "normalmap": slopes(), "bsdf": cases.diffuse(0.6)}), "brdf_0.normalmap.data"
    ),
    "`bumpmap`": Cell(
        lambda: two({"type": "bumpmap", "texture": bitmap(1), "scale": 0.2, "bsdf": cases.diffuse(0.6)}),
        "brdf_0.nested_texture.data",
        tuple(np.random.default_rng(3).normal(size=9)),
    ),
    "`blendbsdf`": Cell(blend, "brdf_0.weight.data"),
    "`twosided`": Cell(
        lambda: {"type": "twosided", "a": cases.diffuse(0.8, 0.3, 0.2), "b": cases.diffuse(0.2)},
        "brdf_0.reflectance.value",
    ),
    "`mask` in `direct_edge`": Cell(mask, "opacity.data"),
    "`null` in `direct_edge`": Cell(bsdf("null")),
    "`blendbsdf` with a mirror": Cell(blend_mirror),
    "`thindielectric`": Cell(bsdf("thindielectric")),
    "`conductor`": Cell(
        lambda: two({"type": "conductor", "specular_reflectance": 0.5}), "brdf_0.specular_reflectance.value"
    ),
    "`dielectric`": Cell(bsdf("dielectric", specular_reflectance=0.7), "specular_reflectance.value"),
    "`plastic`": Cell(lambda: two({"type": "plastic"}), "brdf_0.diffuse_reflectance.value"),
    "`bitmap`, `bilinear`, wrapped by `repeat`, `mirror`, `clamp`": Cell(
        lambda: textured(bitmap()), "brdf_0.reflectance.data"
    ),
    "`bitmap`, `nearest`": Cell(lambda: textured(bitmap(filter_type="nearest")), "brdf_0.reflectance.data"),
    "`bitmap` on a mesh without texture coordinates": Cell(
        lambda name, place, folder: sheet(name, place, textured(bitmap()), uv=False),
        "bsdf.brdf_0.reflectance.data",
        shape=True,
    ),
    "`checkerboard`": Cell(lambda: textured({"type": "checkerboard"}), "brdf_0.reflectance.color0.value"),
    "`mesh_attribute`, `vertex_…`": Cell(
        lambda name, place, folder: sheet(name, place, attribute("vertex_color"), colours="vertex"),
        "vertex_color",
        shape=True,
    ),
    "`mesh_attribute`, `face_…`": Cell(
        lambda name, place, folder: sheet(name, place, attribute("face_color"), colours="face"),
        "face_color",
        shape=True,
    ),
    "`cube`": Cell(analytic("cube"), shape=True),
    "`sphere`": Cell(analytic("sphere"), shape=True),
    "`disk`": Cell(analytic("disk"), shape=True),
    "`cylinder`": Cell(analytic("cylinder"), shape=True),
    "`bsplinecurve`": Cell(lambda name, place, folder: curve("bsplinecurve", folder, place), shape=True),
    "`linearcurve`": Cell(lambda name, place, folder: curve("linearcurve", folder, place), shape=True),
}
ANALYTIC = ("`sphere`", "`disk`", "`cylinder`", "`bsplinecurve`")
PIXELS = 8
VOXELS = "thing.bsdf.brdf_0.reflectance.volume.data"


def names(first: str) -> list[str]:
    """The names of cells in the first cell of a row: the whole, or if there is none, each part."""
    return [first] if first in CELLS else first.split(", ")


def on_chart(name: str, column: str) -> bool:
    if column == "moves" and name in ANALYTIC:
        return False  # cases of test_derivatives.py
    return name in CELLS and (column != "changes" or CELLS[name].change is not None)


#: Cells that are checked on charts, each with its column.
ON_CHARTS = sorted(
    {(n, c) for (first, c), text in ROWS.items() if text.startswith("exact") for n in names(first) if on_chart(n, c)},
    key=lambda cell: cell[::-1],
)


class Chart:
    """Cells side by side on the film, before a camera that sees them from the front, in the light of a lamp and of the
    sky."""

    def __init__(self, column: str, folder: Path):
        self.names = [name for name, c in ON_CHARTS if c == column]
        self.column = column
        self.columns = int(np.ceil(np.sqrt(len(self.names))))
        self.lines = -(-len(self.names) // self.columns)
        T = mi.ScalarTransform4f
        width, height = PIXELS * self.columns, PIXELS * self.lines
        film = cases.film(width=width, height=height)
        view = T().look_at([0, 0, -5], [0, 0, 0], [0, 1, 0]) @ T().scale([self.columns / 2, self.columns / 2, 1])
        things = {f"thing{k}": self._thing(k, name, folder) for k, name in enumerate(self.names)}
        if column == "passed":
            things["plates"] = self._plates()
        scene = cases.scene(
            sensor={"type": "orthographic", "to_world": view, "film": film},
            lamp={
                "type": "rectangle",
                "to_world": T().look_at([1, 9, -15], [0, 0, 0], [0, 1, 0]).scale(3),
                "bsdf": cases.diffuse(0.0),
                "emitter": cases.light(12, 11, 10),
            },
            environment=cases.constant(0.3),
            **things,
        )
        #: Mean derivative and its standard error, and the finite differences. The scene itself is not kept: as long as
        #: it lived, every kernel of every other test would contain its many materials.
        self.measured = self._measure(scene, Together(list(self._motions(column, scene))))

    def place(self, k: int) -> np.ndarray:
        i, j = k % self.columns, k // self.columns
        return np.array([self.columns / 2 - i - 0.47, self.lines / 2 - j - 0.52, 0])

    def _thing(self, k: int, name: str, folder: Path):
        cell, thing = CELLS[name], f"thing{k}"
        return cell.make(thing, self.place(k), folder) if cell.shape else sheet(thing, self.place(k), cell.make())

    def _plates(self) -> mi.Mesh:
        corners = np.array([[-0.2, -0.16, -0.8], [0.22, -0.1, -0.8], [0.03, 0.2, -0.75]])
        p = np.concatenate([corners + self.place(k) for k in range(len(self.names))])
        return cases.mesh(
            "plates", p, np.arange(len(p)).reshape(-1, 3)[:, ::-1], bsdf=cases.diffuse(0.3, two_sided=True)
        )

    def _motions(self, column: str, scene: mi.Scene):
        if column == "passed":
            yield Motion(scene, "plates.vertex_positions", direction=[1, 0.3, 0.1])
            return
        for k, name in enumerate(self.names):
            if column == "moves":
                yield Motion(scene, f"thing{k}.vertex_positions", direction=[1, 0.3, 0.2])
            else:
                cell = CELLS[name]
                key = f"thing{k}.{cell.change}" if cell.shape else f"thing{k}.bsdf.{cell.change}"
                yield Motion(scene, key, direction=cell.direction)

    def _measure(self, scene: mi.Scene, motion: Together):
        expected = reference(f"chart_{self.column}", self.names, scene, motion, step=1e-2, spp=1024)
        return runs_of(scene, motion, runs=16, **CHART_SAMPLES.get(self.column, {"spp": 128})), expected

    def compare(self, name: str) -> Agreement:
        """In the cell of a row."""
        runs, stored = self.measured
        k = self.names.index(name)
        i, j = PIXELS * (k % self.columns), PIXELS * (k // self.columns)
        return compare_part(runs, stored, np.s_[j : j + PIXELS, i : i + PIXELS])


@pytest.mark.parametrize("column", sorted({column for _, column in ON_CHARTS}))
def test_exact_on_charts(variant, column, tmp_path):
    # All rows in one test: by themselves, each of two processes would render the chart.
    chart = Chart(column, tmp_path)
    agreements = {name: chart.compare(name) for name in chart.names}
    print(*(f"{name} {column}: {agreement}" for name, agreement in agreements.items()), sep="\n")
    assert not faults_of(agreements, dict.fromkeys(agreements, CHART_NOISE))


def faults_of(agreements: dict[str, Agreement], noise: dict[str, float]) -> dict[str, list[str]]:
    """What is wrong, row by row. noise : the largest that is allowed."""
    found = {row: agreement.faults(noise=noise[row]) for row, agreement in agreements.items()}
    return {row: faults for row, faults in found.items() if faults}


# ---------------------- Lights, by the colours of one scene ----------------------


def lamp(kind: str, channel: int) -> dict:
    """A light of one colour only."""
    T = mi.ScalarTransform4f
    colour = lambda value: {"type": "rgb", "value": [value * (channel == i) for i in range(3)]}
    towards = T().look_at([-1, 4, -2], [0, -1, 0], [0, 1, 0.1])
    texels = (
        np.random.default_rng(4).uniform(0.2, 1.5, (8, 16, 3)).astype(np.float32) * np.eye(3, dtype=np.float32)[channel]
    )
    area = {"type": "area", "radiance": colour(20)}
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(10 * texels), "raw": True}
    return {
        "area": lambda: {"type": "rectangle", "to_world": towards.scale(0.6), "emitter": area},
        "sphere": lambda: {"type": "sphere", "center": [1, 4, -2], "radius": 0.5, "emitter": area},
        "textured": lambda: {
            "type": "rectangle",
            "to_world": towards.scale(0.6),
            "emitter": {"type": "area", "radiance": texture},
        },
        "point": lambda: {"type": "point", "position": [-1, 4, -2], "intensity": colour(20)},
        "spot": lambda: {"type": "spot", "to_world": towards, "intensity": colour(20), "cutoff_angle": 40},
        "directional": lambda: {"type": "directional", "direction": [0.3, -1, 0.4], "irradiance": colour(2)},
        "projector": lambda: {"type": "projector", "to_world": towards, "irradiance": texture, "fov": 70},
        "constant": lambda: {"type": "constant", "radiance": colour(0.8)},
        "envmap": lambda: {"type": "envmap", "bitmap": mi.Bitmap(texels)},
        "sky": lambda: {
            "type": "sunsky",
            "sun_scale": 0.0,
            "sky_scale": 0.2,
            "sun_direction": [0.3, 0.3, 1],
            "to_world": T().rotate([1, 0, 0], -90),
        },
        "timed": lambda: {"type": "timed_sunsky"},
        "sunsky": lambda: {
            "type": "sunsky",
            "sun_scale": 0.2,
            "sky_scale": 0.2,
            "sun_direction": [0.3, 0.3, 1],
            "to_world": T().rotate([1, 0, 0], -90),
        },
    }[kind]()


SIDEWAYS, TURN = {"direction": [1, 0.3, 0.2]}, {"rotate": [0.2, 1, 0.3]}
#: Of each row: which lamp it is, how it moves, what changes about it.
LAMPS = {
    "`area` on meshes": ("area", {}, "emitter.radiance.value"),
    "`area` on `sphere`, `disk`, `cylinder`": ("sphere", {}, "emitter.radiance.value"),
    "`area` with a bilinear bitmap": ("textured", SIDEWAYS, "emitter.radiance.data"),
    "`point`": ("point", {}, "intensity.value"),
    "`spot`": ("spot", {}, "intensity.value"),
    "`directional`": ("directional", {}, "irradiance.value"),
    "`projector`": ("projector", {}, "irradiance.data"),
    "`constant`": ("constant", {}, "radiance.value"),
    "`envmap`": ("envmap", TURN, "data"),
    "`sunsky` without its sun": ("sky", TURN, None),
    "`sunsky`": ("sunsky", TURN, None),
}
#: Which three may share a scene: one of them a part of the sky at most. The sun has all colours.
TRIOS = [
    ("`area` on meshes", "`area` on `sphere`, `disk`, `cylinder`", "`constant`"),
    ("`area` with a bilinear bitmap", "`envmap`", "`projector`"),
    ("`point`", "`spot`", "`directional`"),
    ("`sunsky` without its sun",),
    ("`sunsky`",),
]


def stage(lamps: dict[str, dict]) -> mi.Scene:
    """A plate above a floor."""
    plate = np.array([[-0.85, 0.25, -0.5], [0.4, 0.3, -0.55], [-0.3, 0.33, 0.45]])
    return cases.scene(
        sensor=cases.camera((0, 1.6, -4.2), (0, -0.3, 0), film=cases.film(width=16, height=16)),
        floor=cases.horizontal((0, -1, 0), 2.5, "floor", bsdf=cases.diffuse(0.5, two_sided=True)),
        plate=cases.mesh("plate", plate, [[0, 2, 1]], bsdf=cases.diffuse(0.6, two_sided=True)),
        **lamps,
    )


def in_light(row: str, column: str) -> bool:
    """Is this row checked here? What moves is checked by `test_derivatives.py` otherwise."""
    return row in LAMPS and bool({"moves": LAMPS[row][1], "changes": LAMPS[row][2], "passed": True}[column])


IN_LIGHT = [(r, c) for (r, c), text in ROWS.items() if text.startswith("exact") and in_light(r, c)]


def light_images(trio: tuple[str, ...], column: str):
    """As `Chart.measured`."""
    scene = stage({f"lamp{i}": lamp(LAMPS[row][0], i) for i, row in enumerate(trio)})
    if column == "passed":
        motions = [Motion(scene, "plate.vertex_positions", **SIDEWAYS)]
    else:
        motions = []
        for i, row in enumerate(trio):
            _, moves, changes = LAMPS[row]
            if in_light(row, column) and column == "moves":
                motions.append(Motion(scene, f"lamp{i}.to_world", **moves))
            elif in_light(row, column):
                motions.append(Motion(scene, f"lamp{i}.{changes}", direction=[1]))
    motion = Together(motions)
    name = re.sub(r"\W+", "_", "_".join([*trio, column])).strip("_")
    spp = 4096 if column == "passed" else 1024
    expected = reference(name, trio, scene, motion, step=0.1 if column == "changes" else 6e-3, spp=spp)
    return runs_of(scene, motion, runs=16, spp=128), expected


TRIOS_IN_LIGHT = sorted({(next(t for t in TRIOS if row in t), column) for row, column in IN_LIGHT})


@pytest.mark.parametrize(("trio", "column"), TRIOS_IN_LIGHT, ids=lambda v: v if isinstance(v, str) else ", ".join(v))
def test_exact_in_these_lights(variant, trio, column):
    runs, stored = light_images(trio, column)
    agreements = {}
    for i, row in enumerate(trio):
        if (row, column) in IN_LIGHT:
            channels = slice(None) if len(trio) == 1 else [i]
            agreements[row] = compare_part(runs, stored, np.s_[..., channels])
    print(*(f"{row} {column}: {agreement}" for row, agreement in agreements.items()), sep="\n")
    assert not faults_of(agreements, {row: NOISY.get((row, column), 0.05) for row in agreements})


# ---------------------- Files of meshes ----------------------


def write_obj(file: Path, v, f, n, t) -> None:
    lines = [f"v {x} {y} {z}" for x, y, z in v.tolist()]
    lines += [f"vt {x} {y}" for x, y in t.tolist()] if t is not None else []
    lines += [f"vn {x} {y} {z}" for x, y, z in n.tolist()] if n is not None else []
    part = lambda i: f"{i}/{i if t is not None else ''}/{i if n is not None else ''}"
    lines += ["f " + " ".join(part(i + 1) for i in face) for face in f.tolist()]
    file.write_text("\n".join(lines))


def write_serialized(file: Path, v, f, n, t) -> None:
    flags = 0x1000 | 0x1 * (n is not None) | 0x2 * (t is not None)
    data = [struct.pack("<I", flags), b"thing\0", struct.pack("<QQ", len(v), len(f))]
    data += [np.float32(a).tobytes() for a in (v, n, t) if a is not None] + [np.uint32(f).tobytes()]
    body = struct.pack("<HH", 0x041C, 4) + zlib.compress(b"".join(data))
    file.write_bytes(body + struct.pack("<QI", 0, 1))


def write_ply(file: Path, v, f, n, t) -> None:
    columns = ["x", "y", "z"] + ["nx", "ny", "nz"] * (n is not None) + ["u", "v"] * (t is not None)
    rows = np.concatenate([a for a in (v, n, t) if a is not None], 1)
    head = ["ply", "format ascii 1.0", f"element vertex {len(v)}", *(f"property float {c}" for c in columns)]
    head += [f"element face {len(f)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(map(str, r)) for r in rows.tolist()] + ["3 " + " ".join(map(str, r)) for r in f.tolist()]
    file.write_text("\n".join(head + body) + "\n")


WRITERS = {"ply": write_ply, "obj": write_obj, "serialized": write_serialized}


def beside_plate(thing) -> mi.Scene:
    return stage({"thing": thing, "environment": cases.constant(0.5)})


def derivative_of(scene, key: str) -> np.ndarray:
    it = mi.load_dict({"type": "direct_edge"})
    return np.array(derivative_image(scene, it, Motion(scene, key, **SIDEWAYS), spp=64, seed=5), np.float64)


@pytest.mark.parametrize(
    ("normals", "uv", "options"),
    [(False, False, {}), (True, True, {}), (True, True, {"face_normals": True})],
    ids=["plain", "normals", "face_normals"],
)
@pytest.mark.parametrize("kind", WRITERS)
def test_files_equal_meshes_in_memory(kind, normals, uv, options, tmp_path):
    """In derivative, with equal random numbers. Interpolated normals are made anew whenever vertices move."""
    m = mi.load_dict({"type": "cube", "to_world": at([0.1, 0, 0.2], 0.6)})
    params = mi.traverse(m)
    v, n, t = (np.array(params[f"vertex_{k}"]) for k in ("positions", "normals", "texcoords"))
    v, n, t = v.reshape(-1, 3), n.reshape(-1, 3), t.reshape(-1, 2)
    f = np.array(params["faces"]).reshape(-1, 3)
    file = tmp_path / f"thing.{kind}"
    WRITERS[kind](file, v, f, n if normals else None, t if uv else None)
    texture = textured(bitmap()) if uv else cases.diffuse(0.5, 0.4, 0.3, two_sided=True)
    loaded = mi.load_dict({"type": kind, "filename": str(file), "id": "thing", "bsdf": texture, **options})
    params = mi.traverse(loaded)
    assert loaded.vertex_count() == len(v)
    assert loaded.has_vertex_texcoords() == uv
    p, faces = (np.array(params[k]).reshape(-1, 3) for k in ("vertex_positions", "faces"))
    t = np.array(params["vertex_texcoords"]).reshape(-1, 2) if uv else None
    smooth = loaded.has_vertex_normals() and not loaded.has_face_normals()
    expected = cases.mesh("thing", p, faces, smooth, t, bsdf=texture)
    scenes = [beside_plate(thing) for thing in (loaded, expected)]
    for key in ("thing.vertex_positions", "plate.vertex_positions"):
        images = [derivative_of(scene, key) for scene in scenes]
        assert np.abs(images[1]).sum() > 0
        assert np.abs(images[0] - images[1]).sum() < 2e-3 * np.abs(images[1]).sum()


def merged(thing: dict) -> dict:
    return {"type": "merge", "id": "thing", "part": {**thing, "id": "part"}}


def grouped(thing: dict) -> dict:
    group = {"type": "shapegroup", "id": "group", "part": thing}
    return {"thing": {"type": "instance", "reference": {"type": "ref", "id": "group"}}, "group": group}


@pytest.mark.parametrize("key", ["thing.vertex_positions", "plate.vertex_positions"])
def test_merged_shapes_equal_their_parts(key):
    thing = {"type": "cube", "to_world": at([0.1, 0, 0.2], 0.6), "bsdf": textured(bitmap())}
    images = [derivative_of(beside_plate(t), key) for t in (merged(thing), thing)]
    assert np.abs(images[1]).sum() > 0
    assert np.abs(images[0] - images[1]).sum() < 2e-3 * np.abs(images[1]).sum()


def test_something_passes_an_instance():
    """That stands still, as the shape that it is made of does."""
    thing = {"type": "cube", "to_world": at([0.1, -0.6, 0.2], 0.3), "bsdf": cases.diffuse(0.5)}
    things = [grouped(thing), {"thing": thing}]
    scenes = [stage({**t, "lamp": lamp("point", 0)}) for t in things]
    images = [derivative_of(scene, "plate.vertex_positions") for scene in scenes]
    assert np.abs(images[1]).sum() > 0
    assert np.abs(images[0] - images[1]).sum() < 2e-3 * np.abs(images[1]).sum()


def assert_exact(name: str, scene: mi.Scene, key: str, step: float = 5e-3, spp: int = 128, **motion) -> None:
    """Against finite differences. name : of the reference."""
    motion = Motion(scene, key, **(motion or SIDEWAYS))
    expected = reference(name, [str(motion)], scene, motion, step=step, spp=8 * spp)
    agreement = compare(runs_of(scene, motion, runs=16, spp=spp // 2), expected, tolerance=STEP)
    print(f"{name}: {agreement}")
    assert not agreement.faults(noise=0.05)


def test_thin_glass_changes():
    """Before a light: what it reflects and lets through of a sky of one brightness always sums up to that."""
    glass = sheet("thing", np.array([0, 0, 0.5]), {"type": "thindielectric"})
    back = cases.quad([-3, -2, 3], [0, 5, 0], [6, 0, 0], "lamp", bsdf=cases.diffuse(0.0), emitter=cases.light(2, 2, 2))
    assert_exact("thin_glass", stage({"thing": glass, "lamp": back}), "thing.bsdf.eta", 0.02, 512, direction=[1])


def test_what_is_seen_through_polarisers():
    """As through nothing, but for the part of the light that they let through."""

    def derivative(kind: str, **options: float) -> np.ndarray:
        scene = leaves.beside_leaf(lambda: {"type": kind, **options})()
        motion, made = Motion(scene, **leaves.GLOW), mi.load_dict({"type": "prb_edge", "max_depth": 3})
        return np.array(derivative_image(scene, made, motion, spp=16, seed=1), float)

    nothing, black = derivative("null"), derivative("polarizer", transmittance=0.0)
    through = nothing - black
    assert np.abs(through).sum() > 0.5 * np.abs(nothing).sum()
    for kind, part in (("polarizer", 0.5), ("retarder", 1), ("circular", 0.5)):
        assert np.abs(derivative(kind) - black - part * through).sum() < 1e-3 * np.abs(through).sum()


@pytest.mark.parametrize("column", ["moves", "changes", "passed"])
def test_colours_in_space(column):
    key = {"moves": "thing.vertex_positions", "changes": VOXELS, "passed": "plate.vertex_positions"}[column]
    scene = stage({"thing": sheet("thing", np.array([0.2, -0.4, -0.3]), volume("trilinear")), "lamp": lamp("area", 0)})
    motion = {"direction": [1]} if column == "changes" else SIDEWAYS
    assert_exact(f"volume_{column}", scene, key, 0.02 if column == "changes" else 5e-3, 128, **motion)


def test_voxels_that_jump_change():
    scene = stage({"thing": sheet("thing", np.array([0.2, -0.4, -0.3]), volume("nearest")), "lamp": lamp("area", 0)})
    assert_exact("voxels", scene, VOXELS, 0.02, 128, direction=[1])


@pytest.mark.parametrize("key", ["eumelanin", "longitudinal_roughness"])
def test_hair_changes(key):
    hair = {"type": "hair", "eumelanin": 0.3, "pheomelanin": 0.2, "longitudinal_roughness": 0.5}
    thing = sheet("thing", np.array([0.2, -0.4, -0.3]), hair)
    scene = stage({"thing": thing, "lamp": lamp("area", 0)})
    assert_exact(f"hair_{key}", scene, f"thing.bsdf.{key}", 0.02, 512, direction=[1])


def test_nobody_sees_the_light_of_directionalarea():
    shade = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90)}
    scene = stage({"lamp": {**shade, "emitter": {"type": "directionalarea", "radiance": 5.0}}})
    for integrator in ({"type": "path"}, {"type": "direct_edge"}, {"type": "prb_edge"}):
        assert not np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=16)).any()


@pytest.mark.parametrize(
    ("key", "step", "motion"),
    [
        ("thing.vertex_positions", 5e-3, SIDEWAYS),
        ("thing.bsdf.brdf_0.table", 0.05, {"direction": [1]}),
        ("plate.vertex_positions", 5e-3, SIDEWAYS),
    ],
)
def test_measured_material(key, step, motion):
    """A highlight on a diffuse ground, below the plate."""
    theta_h, theta_d, phi_d = np.meshgrid(*merl_tables.angles(), indexing="ij")
    table = 0.15 + 0.3 * np.exp(-((theta_h / 0.3) ** 2)) * (1 + 2 * np.sin(theta_d) ** 4 + 0.5 * np.cos(2 * phi_d))
    material = two({"type": "merl", "table": mi.TensorXf(np.repeat(table[..., None], 3, 3).astype(np.float32))})
    scene = stage({"thing": sheet("thing", np.array([0.2, -0.4, -0.3]), material), "lamp": lamp("area", 0)})
    name = re.sub(r"\W+", "_", f"merl_{key}")
    assert_exact(name, scene, key, step, 128, **motion)


@pytest.mark.parametrize(
    ("key", "step", "motion"),
    [
        ("thing.vertex_positions", 5e-3, SIDEWAYS),
        ("thing.bsdf.brdf_0.weights", 0.05, {"direction": [0.5, 0, 1, 1, 0, 0.5]}),
        ("plate.vertex_positions", 5e-3, SIDEWAYS),
    ],
)
def test_dictionary_of_lobes(key, step, motion):
    """A lobe on a diffuse ground, below the plate."""
    lobes = {"alpha": mi.Float(0.3, np.nan), "eta": mi.Float(3.0, np.nan)}
    weights = mi.TensorXf([0.5, 0.4, 0.3, 0.3, 0.4, 0.5], shape=(2, 3))
    material = two({"type": "ggx_dictionary", "weights": weights, **lobes})
    scene = stage({"thing": sheet("thing", np.array([0.2, -0.4, -0.3]), material), "lamp": lamp("area", 0)})
    name = re.sub(r"\W+", "_", f"ggx_dictionary_{key}")
    assert_exact(name, scene, key, step, 128, **motion)


# ---------------------- Warnings and refusals ----------------------


@pytest.fixture
def log():
    with cases.messages() as found:
        yield found


SILHOUETTES, SENSOR, TIMED = REFUSALS = (
    "silhouettes cannot be sampled",
    "is not supported, use one of",
    "in symbolic loops",
)


def enable(scene: mi.Scene, key: str) -> mi.SceneParameters:
    params = mi.traverse(scene)
    value = params[key]
    dr.enable_grad(value)
    params[key] = value
    params.update()
    return params


@dataclass(frozen=True)
class Message:
    """What is said about a row.

    things : makes what is in the scene besides floor and plate.
    text : part of the message.
    moves : name of the parameter that moves.
    deep : does `prb_edge` say it, in indirect light?
    """

    things: Callable[[Path], dict]
    text: str
    moves: str = "thing.vertex_positions"
    deep: bool = False

    def scene(self, folder: Path) -> mi.Scene:
        things = self.things(folder)
        return stage({"environment": cases.constant(0.5), **things} if "lamp" not in things else things)

    def integrator(self) -> mi.Integrator:
        return mi.load_dict({"type": "prb_edge", "max_depth": 4} if self.deep else {"type": "direct_edge"})


def material(make: Callable[[], dict], text: str, deep: bool = False) -> Message:
    return Message(lambda folder: {"thing": sheet("thing", np.array([0, 0, 1]), make())}, text, deep=deep)


def still(make: Callable[[], dict], moves: str, text: str = SILHOUETTES) -> Message:
    return Message(lambda folder: {"thing": make()}, text, moves)


def in_lamp(kind: str, text: str) -> Message:
    return Message(lambda folder: {"lamp": lamp(kind, 0)}, text, "lamp.to_world")


def ellipsoids(kind: str) -> dict:
    data = np.array([[0, 0, 0, 0.3, 0.2, 0.1, 0, 0, 0, 1]], np.float32)
    return {"type": kind, "data": mi.TensorXf(data)}


def second_sensor(kind: str, moves: str = "") -> Message:
    def things(folder: Path) -> dict:
        film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
        sensor = {"type": kind, "id": "second", "film": film}
        if kind == "irradiancemeter":
            return {"thing": {"type": "rectangle", "sensor": sensor}}
        return {"thing": {"type": "cube"}, "second": sensor}

    return Message(things, SENSOR, moves or "second.to_world")


#: By row, what is said when it moves, and when it is passed.
#: By row, or by row and column where the columns differ.
MESSAGES = {
    "`linearcurve`": [
        Message(
            lambda folder: {"thing": curve("linearcurve", folder, np.zeros(3))}, SILHOUETTES, "thing.control_points"
        ),
    ],
    "`ellipsoids`, `ellipsoidsmesh`": [
        still(lambda: ellipsoids("ellipsoids"), "thing.data"),
        still(lambda: ellipsoids("ellipsoidsmesh"), "thing.data"),
    ],
    "`instance` of other shapes; what is in a `shapegroup`": [
        Message(lambda folder: grouped({"type": "sphere"}), SILHOUETTES, "thing.to_world"),
        Message(lambda folder: grouped(cases.smooth_cube()), SILHOUETTES, "group.part.vertex_positions"),
    ],
    "`irradiancemeter`": [second_sensor("irradiancemeter", "thing.to_world")],
    "`radiancemeter`, `distant`": [second_sensor("radiancemeter"), second_sensor("distant")],
    ("`ellipsoids`, `ellipsoidsmesh`", "passed"): [
        still(lambda: ellipsoids("ellipsoids"), "", "lacks the shadows and reflections of"),
        still(lambda: ellipsoids("ellipsoidsmesh"), "", "lacks the shadows and reflections of"),
    ],
    "`sunsky`": [in_lamp("sunsky", "border of the sun")],
    "`timed_sunsky`": [in_lamp("timed", TIMED)],
    "`volume` that shows a `gridvolume`, `nearest`": [material(lambda: volume("nearest"), "jumps of the textures")],
}
#: By row, what changes, and is warned about.
CHANGES = {
    "`roughplastic`": (material(bsdf("roughplastic"), "part of what"), ["thing.bsdf.alpha", "thing.bsdf.eta"]),
    "`blendbsdf` with a mirror": (material(blend_mirror, "part of what"), ["thing.bsdf.brdf_0.weight.value"]),
    "`sunsky` without its sun": (in_lamp("sky", "part of what"), ["lamp.turbidity"]),
    "`sunsky`": (in_lamp("sunsky", "part of what"), ["lamp.turbidity", "lamp.sun_direction"]),
}
#: By row, cases of `test_derivatives.py`, or tests of this file, of what is exact.
ELSEWHERE = {
    "`ply`, `obj`, `serialized`": [test_files_equal_meshes_in_memory],
    "`rectangle`": ["room_floor_turns", "room_cube"],
    "`cube`": ["cube_depth"],
    "`sdfgrid`": [
        "grid_slides", "grid_slides_gaussian", "grid_grows", "grid_lamp", "grid_along_axis", "grid_of_flat_normals",
        "grid_that_ends",
    ],
    "`bsplinecurve`": [
        "wires_slide", "wires_swell", "wires_bend", "wires_camera", "wires_lamp", "wires_indirect",
    ],
    "`merge`": [test_merged_shapes_equal_their_parts],
    "`instance` of meshes": ["chair_slides", "chair_turns", "stretched_ball", test_something_passes_an_instance],
    "`instance` of other shapes; what is in a `shapegroup`": [test_something_passes_an_instance],
    "`perspective`, `thinlens`, `orthographic`": [
        "camera_translation", "camera_rotation", "field_of_view", "principal_point", "cube_depth",
        "thin_lens_camera", "thin_lens_focus", "thin_lens_cube", "orthographic_camera", "orthographic_cube",
    ],
    "`sphere`, `disk`, `cylinder`": [
        "sphere_sun", "sphere_soft", "sphere_camera", "disk_sun_turn", "disk_soft", "cylinder_sun_turn",
        "cylinder_camera",
    ],
    "`fisheye`": ["fisheye_cube", "fisheye_camera", "fisheye_camera_rotation", "fisheye_field_of_view"],
    "`batch` of the above": ["batch_cube", "batch_camera"],
    "`mask` in `prb_edge`": [
        "veil_glow", "veil_cube", "veil_camera", "veil_opacity", "leaf_moves", "behind_veil_point",
        "behind_veil_checkers", "leaf_shadow", "leaf_turns", "veil_turns",
    ],
    "`null` in `prb_edge`": ["null_glow"],
    "`polarizer`, `retarder`, `circular` in `prb_edge`": [test_what_is_seen_through_polarisers],
    "`thindielectric`": [test_thin_glass_changes],
    "`glass`": ["glass_index"],  # otherwise as `dielectric`: see test_glass.py
    "`merl`": [test_measured_material],
    "`hair`": [test_hair_changes],
    "`volume` that shows a `gridvolume`, `trilinear`": [test_colours_in_space],
    "`volume` that shows a `gridvolume`, `nearest`": [test_voxels_that_jump_change],
    "`ggx_dictionary`": [test_dictionary_of_lobes],
    "`area` on meshes": ["shadow_light", "room_light"],
    "`area` on `sphere`, `disk`, `cylinder`": ["sphere_light"],
    "`point`": ["lit_room_light", "lit_room_cube"],
    "`spot`": ["spot_light", "spot_light_turn", "spot_cube", "beam_turns", "beam_widens", "picture_of_spot"],
    "`projector`": [
        "projector_turns", "projector_cube", "picture_turns", "beam_on_cube", "beam_on_floor", "beam_camera",
    ],
    "`led`": ["led_cube", "led_moves"],
    "`directional`": ["sun_turns", "sun_cube"],
    "`distant_lights`": ["distant_lights", "discs_lights", "discs_radius", "distant_cube", "discs_cube"],
}  # fmt: skip

SAID = [
    pytest.param(message, column, id=f"{row} {column} {i}")
    for (row, column), text in ROWS.items()
    if text.startswith(("warned", "refused")) and column != "changes"
    for i, message in enumerate(MESSAGES.get((row, column), MESSAGES.get(row, ())))
]


@pytest.mark.parametrize(("message", "column"), SAID)
def test_warned_or_refused(message, column, log, tmp_path):
    scene = message.scene(tmp_path)
    sensor = len(scene.sensors()) - 1
    key = message.moves if column == "moves" else "plate.vertex_positions"
    if message.text in REFUSALS:
        whole = key.endswith(("to_world", "vertex_positions"))
        motion = Motion(scene, key, direction=[1, 0, 0] if whole else [1])
        with pytest.raises(RuntimeError, match=message.text):
            derivative_image(scene, message.integrator(), motion, sensor=sensor, spp=1)
    else:
        enable(scene, key)
        message.integrator().find_boundaries(scene, sensor)
        assert "".join(log).count(message.text) == 1


@pytest.mark.parametrize("row", CHANGES)
def test_parameters_that_are_warned_about(row, log, tmp_path):
    message, keys = CHANGES[row]
    for key in keys:
        scene = message.scene(tmp_path)
        enable(scene, key)
        message.integrator().find_boundaries(scene)
        assert f'{message.text} "{key}"' in "".join(log)


@pytest.mark.parametrize(
    ("integrator", "make", "text"),
    [
        ({"type": "prb_edge", "max_depth": 3}, bsdf("conductor"), ""),
        ({"type": "prb_edge", "max_depth": 2}, bsdf("conductor"), ""),
        ({"type": "rig"}, bsdf("conductor"), "what perfect mirrors and glass show"),
        ({"type": "rig"}, lambda: textured({"type": "checkerboard"}), "jumps of the textures"),
        ({"type": "direct_edge"}, lambda: textured({"type": "checkerboard"}), ""),
    ],
)
def test_what_is_said_of_mirrors_and_textures(integrator, make, text, log):
    scene = stage({"thing": sheet("thing", np.array([0, 0, 1]), make()), "lamp": lamp("point", 0)})
    enable(scene, "thing.vertex_positions")
    mi.load_dict(integrator).find_boundaries(scene)
    assert text in "".join(log)
    assert text or not log


def is_checked(row: str, column: str, text: str) -> bool:
    if text.startswith("exact"):
        on_charts = all((n, column) in ON_CHARTS for n in names(row))
        return on_charts or (row, column) in IN_LIGHT or row in ELSEWHERE
    return row in (CHANGES if column == "changes" else MESSAGES)


def test_every_row_is_checked():
    assert {column for _, column in ROWS} == {"moves", "changes", "passed"}
    assert all(text.startswith(WORDS) for text in ROWS.values())
    asserted = {row: text for row, text in ROWS.items() if text.startswith(("exact", "warned", "refused"))}
    assert not [row for row, text in asserted.items() if not is_checked(*row, text)]
    assert {row for row, column in ROWS if column == "changes" and "warned" in ROWS[row, column]} == set(CHANGES)
    known = {case.name for case in cases.CASES}
    assert not [c for checks in ELSEWHERE.values() for c in checks if isinstance(c, str) and c not in known]


# ---------------------- Edges and jumps ----------------------


def two_squares(colours=None, uv=None, shift: float = 0.0) -> mi.Mesh:
    """Side by side in one plane, with vertices of their own."""
    p = np.array([[-1, -1, 0], [0, -1, 0], [-1, 1, 0], [0, 1, 0], [0, -1, 0], [1, -1, 0], [0, 1, 0], [1, 1, 0]])
    bsdf = attribute("vertex_color") if colours is not None else cases.diffuse(0.5)
    return cases.mesh(
        "thing", 0.7 * p + [shift, 0.3, 0], [[0, 2, 1], [1, 2, 3], [4, 6, 5], [5, 6, 7]], True, uv, colours, bsdf=bsdf
    )


def kinds(mesh: mi.Mesh) -> np.ndarray:
    return find_edges(Geometry((mesh,), ())).kind


def test_attributes_that_differ_on_the_sides_of_an_edge_are_a_seam():
    same, differ = [[0.5] * 3] * 8, [[0.9, 0.1, 0.1]] * 4 + [[0.1, 0.1, 0.9]] * 4
    assert (kinds(two_squares(differ)) == EdgeKind.JUMP).sum() == (kinds(two_squares(same)) == EdgeKind.JUMP).sum() + 1


def test_a_seam_of_colours_moves():
    colours = [[0.9, 0.1, 0.1]] * 4 + [[0.1, 0.1, 0.9]] * 4
    assert_exact("seam", beside_plate(two_squares(colours, shift=0.13)), "thing.vertex_positions")


@pytest.mark.parametrize("options", [{}, {"face_normals": True}], ids=str)
def test_flipped_normals_move(options):
    bsdf = cases.diffuse(0.5, 0.4, 0.3, two_sided=True)
    thing = {"type": "cube", "to_world": at([0.1, 0, 0.2], 0.6), "flip_normals": True, "bsdf": bsdf, **options}
    assert_exact("_".join(["flipped", *options]), beside_plate(thing), "thing.vertex_positions")


@pytest.mark.parametrize(
    ("bsdf", "uv", "everywhere"),
    [
        (lambda: cases.conductor(0.2), True, False),
        (lambda: {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.3}, True, True),
        (lambda: {"type": "normalmap", "normalmap": slopes(), "bsdf": cases.diffuse(0.5)}, True, True),
        (lambda: textured(bitmap()), True, False),
        (lambda: textured(bitmap()), False, True),
    ],
    ids=["isotropic", "anisotropic", "normal map", "texture", "texture without coordinates"],
)
def test_materials_that_jump_at_every_edge(bsdf, uv, everywhere):
    found = kinds(sheet("thing", np.zeros(3), bsdf(), uv=uv, smooth=True))
    assert (found == EdgeKind.JUMP).all() == everywhere


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("filter_type", ["bilinear", "nearest"])
def test_only_nearest_bitmaps_jump_however_they_are_wrapped(wrap, filter_type):
    make = lambda: textured(bitmap(wrap_mode=wrap, filter_type=filter_type))
    far = sheet("thing", np.zeros(3), make())
    assert bool(jumping_textures(beside_plate(far))) == (filter_type == "nearest")


# ---------------------- Images ----------------------

IMAGES = ["`mask` in `direct_edge`", "`null` in `direct_edge`", "`hair`", "`principledthin`", "`roughdielectric`"]


@pytest.mark.parametrize("environment", [True, False])
@pytest.mark.parametrize("depth", [1, 2, 4])
def test_images_equal_those_of_path(depth, environment, tmp_path):
    """In alpha, too; without an environment, `path` loses light that goes through a mask: then in alpha only."""
    things = {
        f"thing{k}": sheet(f"thing{k}", np.array([k - 2, 0, 0]) * 0.8, CELLS[n].make()) for k, n in enumerate(IMAGES)
    }
    if environment:
        things["environment"] = cases.constant(0.5)
    film = cases.film(width=16, height=16, pixel_format="rgba")
    scene = cases.scene(
        sensor=cases.camera((0, 0, -4), film=film),
        lamp={"type": "point", "position": [0, 3, -4], "intensity": 10.0},
        back=cases.quad([-1, -1, 2], [0, 2, 0], [1, 0, 0], "back", bsdf=cases.diffuse(0.5, two_sided=True)),
        **things,
    )
    integrators = ({"type": "prb_edge", "max_depth": depth}, {"type": "path", "max_depth": depth})
    images = [
        np.array(
            [mi.render(scene, integrator=mi.load_dict(it), spp=64, seed=100 * k + i) for i in range(12)], np.float64
        )
        for k, it in enumerate(integrators)
    ]
    z = z_scores(*mean_and_error(images[0]), *mean_and_error(images[1]))
    z = z if environment else z[..., 3]
    assert np.abs(z).max() < 6
    assert np.mean(z**2) < 1.2


@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
def test_a_single_texel_jumps(filter_type):
    """Of which random places know nothing."""
    texels = np.full((64, 64, 3), 0.5, np.float32)
    texels[13, 40] = 0.1
    to_uv = mi.ScalarTransform4f().translate([0.3, 0.1, 0]).scale([2, -3, 1])
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": filter_type, "to_uv": to_uv}
    scene = stage({"thing": sheet("thing", np.array([0, 0, 1]), {"type": "diffuse", "reflectance": texture})})
    assert bool(jumping_textures(scene)) == (filter_type == "nearest")


@pytest.mark.parametrize("filter_type", ["nearest", "trilinear"])
@pytest.mark.parametrize("other", [0.1, 0.5], ids=["one voxel differs", "all are alike"])
def test_a_single_voxel_jumps(filter_type, other):
    """Random segments know nothing of it; and rounding is no jump."""
    voxels = np.full((16, 16, 16, 3), 0.5)
    voxels[3, 9, 12] = other
    scene = stage({"thing": sheet("thing", np.array([0, 0, 1]), volume(filter_type, voxels))})
    assert bool(jumping_textures(scene)) == (filter_type == "nearest" and other != 0.5)


def test_each_texture_is_looked_at_once(monkeypatch):
    """Though eight shapes have it, and several parts of the search ask."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32)), "filter_type": "nearest"}
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": texture})
    shapes = {f"{i}": cases.quad((i, 0, 0), (1, 0, 0), (0, 1, 0), f"{i}", bsdf=bsdf) for i in range(8)}
    scene = cases.scene(sensor=cases.camera(), sky=cases.constant(), **shapes)
    looks, bisected = [], texture_lines._bisected
    monkeypatch.setattr(texture_lines, "_bisected", lambda *args: looks.append(args) or bisected(*args))
    rimlight.plan(scene, ["0.vertex_positions"], integrator=mi.load_dict({"type": "prb_edge"}))
    assert len(looks) == 1
