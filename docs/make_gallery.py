"""Make the gallery of the documentation:  python docs/make_gallery.py [NAME ...]

Writes docs/gallery.md, and for each of ENTRIES a picture in docs/images/gallery: the image, its derivative by Rimlight,
and the same derivative by finite differences. About twelve minutes on two cores. Numbers and settings are kept in
docs/images/gallery/gallery.json: entries that it has are not made again, unless their names are given.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

import matplotlib
from PIL import Image

from rimlight import pictures, scenes
from rimlight.checks import Motion, derivative_image, finite_differences, mean_and_error
from rimlight.exr import replacing
from rimlight.scenes import room, traffic_sign

DOCS = Path(__file__).parent
FOLDER = DOCS / "images" / "gallery"
NUMBERS = FOLDER / "gallery.json"

#: Pixels along a side of an image, pixels of the picture for each of them, and the gap between images.
RES, SCALE, GAP = 64, 3, 8

#: Samples per pixel of one derivative, and derivatives; runs and samples per pixel of the finite differences.
SPP, SEEDS, RUNS, REFERENCE_SPP = 64, 8, 6, 400

PATH = {"type": "prb_edge", "max_depth": 4}


@dataclass(frozen=True)
class Entry:
    """A derivative of a shipped scene.

    scene : name. title, text : what moves, and what to look at. motion : arguments of `Motion`. step : of the finite
    differences.
    """

    name: str
    scene: str
    title: str
    text: str
    motion: dict[str, Any]
    step: float = 2e-3
    integrator: dict[str, Any] = field(default_factory=lambda: {"type": "direct_edge"})


def moves(key: str, *direction: float, **more: Any) -> dict[str, Any]:
    return {"key": key, "direction": list(direction), **more}


def turns(key: str, *axis: float) -> dict[str, Any]:
    return {"key": key, "rotate": list(axis)}


ENTRIES = [
    Entry(
        "cube_closer",
        "cube",
        "The cube comes closer",
        "All faces have the same brightness. Only the outline has a derivative.",
        moves("cube.vertex_positions", 0, 0, 1),
        5e-3,
    ),
    Entry(
        "cube_turns",
        "cube",
        "The cube turns about the vertical axis",
        "Some parts of the outline move outwards, others inwards.",
        turns("cube.vertex_positions", 0, 1, 0),
    ),
    Entry(
        "coloured_cube_camera",
        "coloured_cube",
        "The camera moves upwards",
        "The creases between the colours move as well as the outline.",
        moves("camera.to_world", 0, 1, 0),
    ),
    Entry(
        "coloured_cube_turns",
        "coloured_cube",
        "The camera turns about its axis of sight",
        "Edges far from the centre of the image move fastest.",
        turns("camera.to_world", 0, 0, 1),
    ),
    Entry(
        "two_triangles_green",
        "two_triangles",
        "The right vertex of the green triangle moves left",
        "Only one edge sweeps over the image: the upper edge slides along itself.",
        moves("green.vertex_positions", 1, 0, 0, vertices=[0]),
    ),
    Entry(
        "two_triangles_red",
        "two_triangles",
        "The red triangle moves upwards",
        "Where the green triangle hides an edge of the red one, the derivative is zero.",
        moves("red.vertex_positions", 0, 1, 0),
    ),
    Entry(
        "two_triangles_light",
        "two_triangles",
        "The light moves to the side",
        "The brightness changes smoothly, and the shadow of the green triangle slides over the red one.",
        moves("light.to_world", 1, 0, 0),
        5e-3,
    ),
    Entry(
        "shadow_blocker",
        "shadow_blocker",
        "A square that is out of sight moves to the side",
        "Only its shadow on the floor shows it.",
        moves("blocker.vertex_positions", 1, 0, 0),
    ),
    Entry(
        "shadow_blocker_vertex",
        "shadow_blocker",
        "One vertex of that square moves",
        "One corner of the shadow follows it.",
        moves("blocker.vertex_positions", 0, 0, 1, vertices=[0]),
    ),
    Entry(
        "shadow_light",
        "shadow_blocker",
        "The light moves to the side",
        "The shadow moves the other way.",
        moves("light.to_world", 1, 0, 0),
    ),
    Entry(
        "textured_gloss_box",
        "textured_gloss",
        "The box moves to the side",
        "Its outline, its shadows and its reflection in the glossy table move with it.",
        moves("box.vertex_positions", 1, 0, 0),
    ),
    Entry(
        "textured_gloss_camera",
        "textured_gloss",
        "The camera moves to the side",
        "The texture moves smoothly, and the outlines of the box jump.",
        moves("camera.to_world", 1, 0, 0),
    ),
    Entry(
        "glossy_receiver",
        "glossy_receiver",
        "The square before the light moves upwards",
        "The shiny floor shows the square and the light as blurred reflections.",
        moves("blocker.vertex_positions", 0, 1, 0),
    ),
    Entry(
        "glossy_receiver_rough",
        "glossy_receiver",
        "The light moves to the side",
        "The reflection of the light moves in the floor. Inside of it, our derivative is noisy.",
        moves("light.to_world", 1, 0, 0),
    ),
    Entry(
        "mirrored_plane",
        "mirrored_plane",
        "A square behind the camera moves to the side",
        "The camera sees it in an almost perfect mirror.",
        moves("plane.vertex_positions", 1, 0, 0),
    ),
    Entry(
        "objects_camera",
        "objects",
        "The camera moves to the right",
        "Smooth silhouettes of the torus, edges of the cube, the texture of the floor, and soft shadows.",
        moves("camera.to_world", 1, 0, 0),
    ),
    Entry(
        "objects_torus",
        "objects",
        "The torus turns about the vertical axis",
        "Its shadow on the floor changes too.",
        turns("torus.vertex_positions", 0, 1, 0),
    ),
    Entry(
        "objects_cube",
        "objects",
        "The cube moves upwards",
        "It uncovers the floor below it, and its shadow slides.",
        moves("cube.vertex_positions", 0, 1, 0),
    ),
    Entry(
        "objects_light",
        "objects",
        "The light moves to the side",
        "The borders of the soft shadows slide.",
        moves("light.to_world", 1, 0, 0),
    ),
    Entry(
        "objects_colour",
        "objects",
        "The cube gets brighter",
        "A material moves no edges. The interior term alone is the derivative.",
        moves("cube.bsdf.reflectance.value", 1, 1, 1),
        0.02,
    ),
    Entry(
        "lit_room_camera",
        "lit_room",
        "The camera moves to the side",
        "A room with interreflections: four bounces of light.",
        moves("camera.to_world", 1, 0, 0),
        integrator=PATH,
    ),
    Entry(
        "lit_room_table",
        "lit_room",
        "The table moves upwards",
        "The light that it reflects, and its shadow, change all over the room.",
        moves("table.vertex_positions", 0, 1, 0),
        integrator=PATH,
    ),
    Entry(
        "lit_room_lamp",
        "lit_room",
        "The lamp moves to the side",
        "All soft shadows slide.",
        moves("lamp.to_world", 1, 0, 0),
        integrator=PATH,
    ),
    Entry(
        "room_camera",
        "room",
        "The fisheye camera turns about the vertical axis",
        "Forty-two objects in a room, of which thirteen are shiny. The scene is that of figure 1 of Li et al. 2018.",
        turns("camera.to_world", 0, 1, 0),
        1e-3,
    ),
    Entry(
        "traffic_sign",
        "traffic_sign",
        "The stop sign turns about the vertical axis",
        "The scene of figure 10 of Li et al. 2018, before the fit.",
        turns("sign.vertex_positions", 0, 1, 0),
    ),
]


def load(name: str) -> mi.Scene:
    """A shipped scene, with a film of RES × RES pixels."""
    if name in scenes.names():
        return mi.load_file(str(scenes.path(name)), res=RES)
    with tempfile.TemporaryDirectory() as folder:
        {"room": room, "traffic_sign": traffic_sign}[name].write(Path(folder))
        return mi.load_file(str(Path(folder) / f"{name}.xml"), res=RES)


def make(entry: Entry) -> dict[str, Any]:
    """Write the picture of an entry; return its numbers."""
    scene, start = load(entry.scene), time.perf_counter()
    motion, integrator = Motion(scene, **entry.motion), mi.load_dict(entry.integrator)
    depth = entry.integrator.get("max_depth", 2)
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": depth}), spp=256))
    runs = [np.array(derivative_image(scene, integrator, motion, spp=SPP, seed=i)) for i in range(SEEDS)]
    derivative, own_error = mean_and_error(np.array(runs, np.float64))
    reference = finite_differences(
        scene, motion, step=entry.step, runs=RUNS, spp=REFERENCE_SPP, max_depth=depth, progress=False
    )
    size = np.abs(reference.mean).sum()
    noise = np.sqrt(2 / np.pi) * np.sqrt(own_error**2 + reference.standard_error**2).sum() / size
    limit = pictures.symmetric_limit([reference.mean], percentile=97)
    coloured = [
        matplotlib.colormaps[pictures.COLOUR_MAP](pictures.signed(d) / (2 * limit) + 0.5, bytes=True)[:, :, :3]
        for d in (derivative, reference.mean)
    ]
    panels = [np.kron(p, np.ones((SCALE, SCALE, 1), np.uint8)) for p in (pictures.to_srgb(image), *coloured)]
    gap = np.full((panels[0].shape[0], GAP, 3), 255, np.uint8)
    with replacing(FOLDER / f"{entry.name}.webp") as temporary:
        row = np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1)
        Image.fromarray(row).save(temporary, "WEBP", quality=88, method=6)
    found = {
        "error": float(np.abs(derivative - reference.mean).sum() / size),
        "noise": float(noise),
        "unit": motion.unit,
        "motion": str(motion),
        "integrator": entry.integrator["type"],
        "seconds": round(time.perf_counter() - start, 1),
        "commit": commit(),
    }
    print(f"{entry.name}: {found}", flush=True)
    return found


def commit() -> str:
    command = ["git", "-C", str(DOCS), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def text(numbers: dict[str, dict[str, Any]]) -> str:
    """The page."""
    commits = sorted({n["commit"] for n in numbers.values()})
    lines = [
        "# Gallery",
        "",
        "<!-- Written by docs/make_gallery.py: change that instead. -->",
        "",
        "*What do correct derivatives look like?* Each row shows a scene that is shipped with Rimlight, its derivative "
        "by Rimlight, and the same derivative by finite differences. Red pixels get brighter, and blue pixels get "
        "darker. Both derivatives share one scale. {doc}`papers` has films of fits, and the figures of the papers "
        "beside ours.",
        "",
        "The **error** is the {term}`relative L1 error` against the finite differences. The **noise** is the error "
        "that an exact derivative would show, since both sides are Monte Carlo estimates. Where both are equal, "
        "no error is seen. "
        f"Films have {RES} × {RES} pixels. A derivative is the mean of {SEEDS} renders of {SPP} samples per pixel. "
        f"Finite differences are the mean of {RUNS} runs of {REFERENCE_SPP} samples per pixel. "
        f"`python docs/make_gallery.py` made them at commit {', '.join(commits)}.",
    ]
    last = None
    for entry in ENTRIES:
        if entry.scene != last:
            lines += ["", f"## `{entry.scene}`"]
            last = entry.scene
        n = numbers[entry.name]
        alt = f"{entry.title}: image, derivative by Rimlight, and finite differences"
        lines += [
            "",
            f"**{entry.title}.** {entry.text}",
            "",
            f"![{alt}](images/gallery/{entry.name}.webp)",
            "",
            f"`{n['motion']}`, `{n['integrator']}`: error {n['error']:.0%}, noise {n['noise']:.0%}.",
        ]
    return "\n".join(lines) + "\n"


def main(names: list[str]) -> None:
    unknown = set(names) - {e.name for e in ENTRIES}
    if unknown:
        raise SystemExit(f"there is no entry {', '.join(unknown)}")
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    FOLDER.mkdir(parents=True, exist_ok=True)
    numbers = json.loads(NUMBERS.read_text("utf-8")) if NUMBERS.exists() else {}
    for entry in ENTRIES:
        if entry.name in names or (not names and entry.name not in numbers):
            numbers[entry.name] = make(entry)
            with replacing(NUMBERS) as temporary:
                temporary.write_text(json.dumps(numbers, indent=1) + "\n", "utf-8")
    if all(e.name in numbers for e in ENTRIES):
        (DOCS / "gallery.md").write_text(text(numbers), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
