"""The demonstration behind ``make demo``: derivative images beside references, a fit, and a page that shows them."""

from __future__ import annotations

import gc
import html
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

import rimlight
from rimlight import no_collection, pictures, scenes
from rimlight.checks import Motion, derivative_image, finite_differences
from rimlight.exr import replacing

from . import page
from .fitting import fit
from .reproduce import problem_of

SPP = 256  # samples per pixel of one derivative
RENDERS = 4  # derivatives to average; the first one pays for the compiler and is not timed


@dataclass(frozen=True)
class Study:
    """Derivative images of one motion, by several methods."""

    name: str  # of the PNG file
    scene: str
    title: str
    text: str
    motion: dict[str, Any]  # arguments of `Motion`
    step: float  # of the finite differences: a few hundredths of a pixel
    methods: tuple[str, ...] = ("direct_edge", "direct_projective")


STUDIES = (
    Study(
        "green_vertex",
        "two_triangles",
        "The right vertex of the green triangle moves left",
        "Only the edge that ends in this vertex sweeps over the picture. Blue pixels lose light: what they show of the "
        "triangle gives way to the dark behind it.",
        {"key": "green.vertex_positions", "direction": (1, 0, 0), "vertices": [0]},
        2e-3,
    ),
    Study(
        "red_vertex",
        "two_triangles",
        "The right vertex of the red triangle moves left",
        "The red triangle lies behind the green one. Where green covers its edge, the derivative is zero.",
        {"key": "red.vertex_positions", "direction": (1, 0, 0), "vertices": [0]},
        2e-3,
    ),
    Study(
        "cube_depth",
        "cube",
        "A cube under a white sky comes closer",
        "All faces have the same brightness, so that only the outline says that the cube grows: grey replaces white. "
        "Mitsuba's projective sampling, at its default settings, overestimates it.",
        {"key": "cube.vertex_positions", "direction": (0, 0, 1)},
        5e-3,
    ),
    Study(
        "camera",
        "coloured_cube",
        "The camera moves upwards before a shining cube",
        "Every edge moves over the picture, the creases between the colours too. Mitsuba's projective sampling does "
        "not follow the camera: its derivative is zero.",
        {"key": "camera.to_world", "direction": (0, 1, 0)},
        2e-3,
    ),
)


@dataclass(frozen=True)
class Section:
    """A part of the page: a heading, a text, and the pictures below it."""

    title: str
    text: str
    files: tuple[str, ...]


def main(out: Path | str = "demo") -> None:
    """Make the page and its pictures in the folder `out`, and print where they are.

    Raises
    ------
    OSError : the folder cannot be written to. Nothing of a file is there before it is complete.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # the peer's warnings are not about what this page shows
    start = time.perf_counter()
    try:
        sections = []
        for study in (bar := tqdm(STUDIES, desc="derivatives", disable=None)):
            bar.set_postfix_str(study.name)
            sections.append(show_derivatives(study, out))
        sections.append(show_fit(out))
    finally:
        mi.set_log_level(level)
        _free()
    write_page(out, sections, time.perf_counter() - start)
    print(f"Rimlight: open {out / 'index.html'} in a browser; the pictures are beside it.")


# ------------------------------------------------------------------ derivatives


def show_derivatives(study: Study, out: Path) -> Section:
    """Compare methods with finite differences, and write one row of pictures."""
    _free()
    scene = mi.load_file(str(scenes.path(study.scene)))
    motion = Motion(scene, **study.motion)
    with no_collection():
        panels = [pictures.Panel(np.array(mi.render(scene, spp=SPP)), "image")]
    reference, seconds = _timed(lambda: finite_differences(scene, motion, step=study.step, runs=16, spp=1024))
    noise = np.sqrt(2 / np.pi) * reference.standard_error.sum() / np.abs(reference.mean).sum()
    results = []
    for method in study.methods:
        derivative, seconds_each = _derivative(scene, method, motion)
        error = np.abs(derivative - reference.mean).sum() / np.abs(reference.mean).sum()
        label = f"Rimlight: {method}" if method == "direct_edge" else f"Mitsuba: {method}"
        caption = f"{label}\nrel. L1 error {error:.1%}, {seconds_each:.2f} s"
        panels.append(pictures.Panel(derivative, caption, "derivative"))
        results.append(f"{method} {error:.1%}")
    caption = f"finite differences\nrel. L1 noise {noise:.1%}, {seconds:.1f} s"
    panels.append(pictures.Panel(reference.mean, caption, "derivative"))
    limit = pictures.symmetric_limit([reference.mean])
    pictures.write_panels(out / f"{study.name}.png", panels, unit=motion.unit, limit=limit)
    numbers = f"Errors against finite differences (themselves uncertain by {noise:.1%}): {', '.join(results)}."
    return Section(study.title, f"{study.text} {numbers}", (f"{study.name}.png",))


def _derivative(scene: Any, method: str, motion: Motion) -> tuple[np.ndarray, float]:
    """Mean of `RENDERS` derivatives, (H, W, C), and the median time of one in seconds."""
    integrator = mi.load_dict({"type": method})
    render = lambda seed: np.array(derivative_image(scene, integrator, motion, spp=SPP, seed=seed))
    images, seconds = zip(*(_timed(lambda seed=seed: render(seed)) for seed in range(RENDERS)), strict=True)
    return np.mean(images, axis=0), float(np.median(seconds[1:]))


def _timed(work: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    return work(), time.perf_counter() - start


# ------------------------------------------------------------------ fit


def show_fit(out: Path) -> Section:
    """Fit the six vertices of two triangles to a picture, and write what became of them."""
    _free()
    found = fit(problem_of("fig6a"))
    view, steps = found.views[0], len(found.losses)
    errors = np.max([e for label, e in found.errors.items() if "farthest" in label], axis=0)
    rmse = found.measures[0]["root mean square error"]
    panels = [
        pictures.Panel(view.start, f"start\nfarthest vertex {errors[0]:.2f} units off"),
        pictures.Panel(view.result, f"after {steps} steps\nfarthest vertex {errors[-1]:.4f} units off"),
        pictures.Panel(view.target, "target"),
        pictures.Panel(view.result - view.target, "result - target", "derivative"),
    ]
    pictures.write_panels(out / "fit.png", panels)
    curves = {"error of the farthest vertex (scene units)": errors, "loss (mean squared difference)": found.losses}
    pictures.write_curves(out / "fit_curves.png", curves, x="step", y="")
    text = (
        f"Two triangles are pulled from a wrong start into the pose that a picture shows, in {steps} steps of "
        f"Adam at 4 samples per pixel ({found.seconds:.0f} s). At the start the right vertex of the red triangle is "
        "hidden behind the green one; the parts of its edges that can be seen bring it out. The error of the farthest "
        f"vertex falls from {errors[0]:.2f} to {errors[-1]:.4f} scene units, of which the picture shows about 4, the "
        f"root mean square difference of the pictures from {rmse[0]:.4f} to {rmse[1]:.4f}. The loss levels off at the "
        "noise of 4 samples. Depth is held: one picture tells next to nothing about it."
    )
    return Section("Six vertices fitted to a picture", text, ("fit.png", "fit_curves.png"))


def _free() -> None:
    """Give back the memory of the scene before."""
    gc.collect()
    dr.flush_malloc_cache()


# ------------------------------------------------------------------ page

INTRODUCTION = (
    "What happens to a picture when an object moves? At its outline a pixel jumps from one colour to another, and "
    "automatic differentiation sees nothing there. Rimlight adds the missing term to Mitsuba 3 by sampling the edges "
    "themselves. Below, red pixels get brighter and blue ones darker; finite differences, slow but impartial, are the "
    "reference."
)


def write_page(out: Path, sections: list[Section], seconds: float) -> None:
    """Write index.html, with all pictures inside."""
    parts = []
    for section in sections:
        images = "\n".join(_image(out / file, section.title) for file in section.files)
        parts.append(
            f"<section>\n<h2>{html.escape(section.title)}</h2>\n<p>{html.escape(section.text)}</p>\n{images}\n</section>"
        )
    footer = (
        f"Rimlight {rimlight.__version__}, Mitsuba {mi.__version__}, Dr.Jit {dr.__version__}, "
        f"{dr.thread_count()} threads; made in {seconds:.0f} s. Times are those of one derivative at {SPP} samples per "
        f"pixel, compiled; errors are those of the mean of {RENDERS}."
    )
    head = f"<h1>Rimlight</h1>\n<p>{INTRODUCTION}</p>"
    body = "\n".join([head, *parts, f"<footer>{html.escape(footer)}</footer>"])
    with replacing(out / "index.html") as temporary:
        temporary.write_text(page.page("Rimlight: derivatives of pictures", body), encoding="utf-8")


def _image(file: Path, text: str) -> str:
    return f'<img alt="{html.escape(text)}" src="{page.data_uri(file.read_bytes(), "image/png")}">'
