"""What a data set is like, for people: one page that needs nothing but itself."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rimlight import pictures
from rimlight.exr import replacing
from rimlight.inverse import page

from .inspection import Inspection, table, warnings
from .vectors import LUMINANCE

#: Of lights that are fewer, each has its number in the picture; of more, every fifth.
NUMBERED = 32

#: Between the circles of that picture, degrees.
STEP = 15.0

#: Brightness of what is not in the mask.
OUTSIDE = 0.3

STYLE = """
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(6.5rem, 1fr)); gap: .5rem .8rem; }
.sheet img { width: 100%; } .sheet figcaption { font-size: .75rem; }
.mean img { width: 26rem; max-width: 100%; }
"""


def write(path: Path, found: Inspection, *, title: str) -> None:
    """Write a page, with its folder.

    Raises
    ------
    OSError
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    sections = [
        f"<style>{STYLE}</style>\n<header>\n<h1>{html.escape(title)}</h1>\n{_verdict(warnings(found))}\n</header>",
        _overview(found),
        _lights(found),
        _images(found),
        _sheet(found),
    ]
    with replacing(path) as temporary:
        temporary.write_text(page.page(title, "\n".join(sections)), "utf-8")


def _verdict(said: Sequence[str]) -> str:
    if not said:
        return '<p class="verdict"><span class="status">nothing conspicuous</span></p>'
    count = "one thing" if len(said) == 1 else f"{len(said)} things"
    items = "\n".join(f"<li>{html.escape(text)}</li>" for text in said)
    return (
        f'<p class="verdict"><span class="status bad">{count} to look at</span></p>\n<ul class="warnings">{items}</ul>'
    )


def _overview(found: Inspection) -> str:
    mean = found.mean / max(float(np.percentile(found.mean[found.mask], 99)), 1e-12)
    mean = np.where(found.mask[..., None], mean, OUTSIDE * mean)
    picture = page.picture(pictures.to_srgb(page.shrunk(mean, page.WIDEST, page.WIDEST)), "Mean of all images")
    return f"""<section>\n<h2>Overview</h2>\n<div class="row">
<div>{page.table(("", ""), table(found), "Overview")}</div>
<figure class="mean">{picture}
<figcaption>Mean of all images. What is not in the mask is darkened.</figcaption></figure>
</div>\n</section>"""


def _lights(found: Inspection) -> str:
    """Directions on the sphere, as the camera sees it; and how bright they are."""
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    around = np.arctan2(found.directions[:, 1], found.directions[:, 0])
    axes.scatter(around, found.angles, s=18, color=page.COLOURS[0])
    every = 1 if found.images <= NUMBERED else 5
    for k in [k for k in range(found.images) if every == 1 or (k + 1) % every == 0]:
        text = {"fontsize": 7, "color": page.INK, "xytext": (4, 3), "textcoords": "offset points"}
        axes.annotate(str(k + 1), (around[k], found.angles[k]), **text)
    rings = np.arange(STEP, found.angles.max() + STEP, STEP)
    axes.set_ylim(0, rings[-1])
    axes.set_yticks(rings, [f"{ring:.0f}°" for ring in rings])
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["right", "up", "left", "down"])
    axes.tick_params(colors=page.INK, labelsize=8)
    axes.grid(alpha=0.35, color=page.INK, linewidth=0.5)
    axes.set_facecolor("none")
    axes.spines["polar"].set(color=page.INK, linewidth=0.6, alpha=0.35)
    sphere = page.svg(figure, "Directions of the lights")
    intensities = found.sample.intensities @ LUMINANCE
    curves = {"stated, over their median": intensities / np.median(intensities), "correction": found.exposures}
    return f"""<section>\n<h2>Lights</h2>\n<div class="plots">
<figure>\n<h3>Directions</h3>\n{sphere}
<figcaption>As the camera sees them: in the middle, a light shines along its axis, further out more from the side.
The numbers are those of the images.</figcaption></figure>
{_plot("Intensities", curves, "")}
</div>
<p>The correction is the factor by which images are brighter than their light explains, estimated by a robust fit of a
diffuse surface. With fewer than 20 images, it is not estimated.</p>
</section>"""


def _images(found: Inspection) -> str:
    curves = {"saturated": found.saturated, "black": found.black, "in shadow, estimated": found.shadowed}
    plot = _plot("Values that tell little", {name: 100 * part for name, part in curves.items()}, "% of the mask")
    return f"""<section>\n<h2>Images</h2>\n<div class="plots">\n{plot}</div>
<p>Saturated values are as large as the largest one of all images; black ones are 0 in all channels. Shadows are
estimated: values below a quarter of what a diffuse surface would show, so dark metal may look like shadow.</p>
</section>"""


def _sheet(found: Inspection) -> str:
    """All images, with one exposure."""
    bright = np.concatenate([small.reshape(-1, 3).max(1) for small in found.small])
    gain = 1 / max(float(np.percentile(bright, 99.5)), 1e-12)
    names = found.sample.names
    figures = [
        f"<figure>{page.picture(pictures.to_srgb(small * gain), name)}"
        f"<figcaption>{k + 1}: {html.escape(name)}</figcaption></figure>"
        for k, (small, name) in enumerate(zip(found.small, names, strict=True))
    ]
    return (
        f"<section>\n<h2>All images</h2>\n<p>Over the intensity of their light, all with one exposure.</p>\n"
        f'<div class="sheet">{"".join(figures)}</div>\n</section>'
    )


def _plot(title: str, curves: dict[str, np.ndarray], label: str) -> str:
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, values) in enumerate(curves.items()):
        x = np.arange(1, len(values) + 1)
        axes.plot(x, values, color=page.COLOURS[i], linewidth=1.2, marker=".", markersize=4, label=name)
    axes.set(xlabel="image", ylabel=label, ylim=(0, None))
    axes.legend(fontsize=8, labelcolor=page.INK, framealpha=0, edgecolor="none")
    page.paint(axes)
    return f"<figure>\n<h3>{title}</h3>\n{page.svg(figure, title)}\n</figure>"
