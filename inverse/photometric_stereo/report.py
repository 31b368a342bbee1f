"""What a reconstruction found, for people: one page that needs nothing but itself."""

from __future__ import annotations

import dataclasses
import html
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from rimlight import pictures
from rimlight.exr import replacing
from rimlight.inverse import page
from rimlight.inverse.page import number
from rimlight.sys_info import processor

from . import nearness, output
from .dataset import Dataset, image_of
from .direct import Guess
from .full_size import FullSize
from .integration import normals_of
from .reconstruction import Options, Result
from .rendering import Rendering
from .vectors import unit

#: Largest width and height of pictures in the page, pixels; and of that of full images.
SHOWN, WIDEST = 320, 960

#: Photographs that are shown, and samples per pixel of what is rendered for the page.
PHOTOGRAPHS, SPP = 4, 16

#: Lights of the slider, and their angle to the direction to the camera, degrees.
LIGHTS, ELEVATION = 24, 45.0

#: Direction from which the light comes in which depth is shown.
SHADING = np.array([-0.4, 0.5, 0.77])

STYLE = """
.maps { display: grid; grid-template-columns: repeat(3, minmax(0, 1fr)); gap: .5rem 1.5rem; margin-top: 1rem; }
.relit { width: 24rem; max-width: 100%; } .relit .stack img { width: 100%; } .relit img[hidden] { display: none; }
.relit .control { display: flex; gap: 1rem; align-items: center; margin: .5rem 0; }
.relit input { flex: 1; min-width: 0; accent-color: var(--accent); }
"""

SCRIPT = """
for (const relit of document.querySelectorAll(".relit")) {
  const slider = relit.querySelector("input");
  const images = relit.querySelectorAll("img");
  const move = () => {
    images.forEach((image, i) => { image.hidden = i !== slider.valueAsNumber; });
    const angle = 2 * Math.PI * slider.valueAsNumber / images.length;
    const dot = relit.querySelector(".dot");
    dot.setAttribute("cx", 20 + 14 * Math.cos(angle));
    dot.setAttribute("cy", 20 - 14 * Math.sin(angle));
  };
  slider.addEventListener("input", move);
  move();
}
"""


@dataclass(frozen=True)
class View:
    """A result at the size of the page, with a few of its images only: `data` and `guess` have K' of these.

    step : side of a pixel of the page, in pixels of the result. mean : of what pixels of the result have, (P, ...),
    over those of the page, (P', ...). depth : (P',), as of `integrate`. chosen : (K',), numbers of these images.
    crop : of images.
    """

    data: Dataset
    guess: Guess
    step: int
    mean: Callable[[np.ndarray], np.ndarray]
    depth: np.ndarray
    chosen: np.ndarray
    crop: tuple[slice, slice]

    @staticmethod
    def of(result: Result) -> View:
        data, guess = result.data, result.guess
        chosen = np.unique(np.linspace(0, len(data.lights) - 1, PHOTOGRAPHS).round().astype(int))
        step = -(-max(np.ptp(np.nonzero(data.mask), axis=1) + 1) // SHOWN)
        few = _with_lights(data, data.values[:, chosen], [data.lights[k] for k in chosen])
        small = few.at(1 / step)
        if small is few:
            step, mean = 1, lambda x: x
        else:
            mean = data.blocks(step)[1]
        depth = mean(output.depth(result)) / (step if data.camera is None else 1)
        found = dataclasses.replace(
            guess,
            normals=unit(mean(guess.normals)),
            albedo=mean(guess.albedo),
            exposures=guess.exposures[chosen],
            base=None if guess.base is None else mean(guess.base),
        )
        rows, columns = np.nonzero(small.mask)
        crop = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        return View(small, found, step, mean, depth, chosen, crop)

    def image(self, pixels: np.ndarray, fill: float = 0) -> np.ndarray:
        return self.data.image(pixels, fill)[self.crop]


def write(
    folder: Path,
    result: Result,
    options: Options,
    *,
    title: str,
    status: str,
    truth: np.ndarray | None = None,
    full: FullSize | None = None,
) -> None:
    """Write ``report.html``. status : "finished", or "interrupted". truth : (H, W), of depth. full : of images that
    were reduced.

    Raises
    ------
    OSError
    """
    view = View.of(result)
    sections = [
        f"<style>{STYLE}</style>\n<header>\n<h1>{html.escape(title)}</h1>\n{_verdict(result, status)}\n</header>",
        _shape(view, result, truth),
        *([_full_size(full)] if full is not None else []),
        *_rendered(view, result, options),
        _progress(result),
        _reflectance(view, result),
        _settings(result, options),
        f"<script>{SCRIPT}</script>",
    ]
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(page.page(title, "\n".join(sections)), "utf-8")


# ------------------------------------------------------------------ sections


def _verdict(result: Result, status: str) -> str:
    facts = f"{len(result.history)} alternations in {result.seconds:.3g} s"
    if result.error is not None:
        facts += f"; mean angular error {result.error:.2f}° (start: {np.nanmean(result.data.off(result.start)):.2f}°)"
    kind = "status" if status == "finished" else "status bad"
    residual = number(100 * result.history[-1]["residual"], 2)
    said = [*output.judgement(result), f"The last alternation left a residual of {residual} % of the median value."]
    listed = lambda sentences: "".join(f"<li>{html.escape(text)}</li>" for text in sentences)
    verdict = (
        f'<p class="verdict"><span class="{kind}">{html.escape(status)}</span>: {html.escape(facts)}</p>\n'
        f"<ul>{listed(said)}</ul>"
    )
    if not result.doubts:
        return verdict
    return f'{verdict}\n<p>The data are doubtful:</p>\n<ul class="warnings">{listed(result.doubts)}</ul>'


def _shape(view: View, result: Result, truth: np.ndarray | None) -> str:
    data = view.data
    maps = {"start": unit(view.mean(result.start)), "result": view.guess.normals}
    maps |= {} if data.truth is None else {"truth": data.truth}
    figures = [_figure(_coloured_normals(view.image(n, np.nan)), f"Normals: {name}") for name, n in maps.items()]
    sections = [
        f'<section>\n<h2>Shape</h2>\n<div class="maps">{"".join(figures)}</div>\n<p>The more red, the further a normal '
        "points to the right; the more green, the further up; the more blue, the further towards the camera.</p>"
    ]
    if data.truth is not None:
        errors = {"start": result.data.off(result.start), "result": result.data.off(result.guess.normals)}
        sections.append(_with_scale({f"Error: {name}": e for name, e in errors.items()}, view, "degrees"))
    depth = view.image(view.depth, np.nan)
    inside = np.isfinite(depth)
    shaded = np.maximum(normals_of(depth, inside, camera=_camera(view)) @ SHADING, 0)[..., None].repeat(3, -1)
    figures = [_figure(_masked(pictures.to_srgb(shaded), inside), "Depth, shaded")]
    if data.camera is None:
        colours, ends, of_depth = "viridis", view.step * _ends(depth), "pixels towards the camera; mean 0"
    else:  # what is bright is near here, too
        colours, ends, of_depth = "viridis_r", _ends(depth), "distance along the axis of the camera, "
        of_depth += "geometric mean 1" if data.distance is None else "in the unit of distance.txt"
    figures.append(_figure(_coloured(depth, colours), "Depth"))
    plot = "" if truth is None else _cross_section(result, truth)
    both, scale = f'<div class="maps">{"".join(figures)}</div>', _scale(colours, *ends, of_depth)
    return "\n".join([*sections, both, scale, plot, "</section>"])


def _full_size(full: FullSize) -> str:
    """Normals of the full images, of every few pixels."""
    step = -(-max(full.mask.shape) // WIDEST)
    shown = image_of(full.mask, full.normals, np.nan)[::step, ::step]
    facts = f"{len(full.normals)} pixels" + ("" if full.error is None else f", mean angular error {full.error:.2f}°")
    every = "" if step == 1 else f" One in {step} is shown, in each direction."
    return (
        f"<section>\n<h2>Full images</h2>\n<p>{facts}, in the folder <code>full_size</code>.{every}</p>\n"
        f'<div class="maps">{_figure(_coloured_normals(shown), "Normals")}</div>\n</section>'
    )


def _rendered(view: View, result: Result, options: Options) -> list[str]:
    """Relit, and beside the photographs."""
    around = np.radians(np.arange(LIGHTS) * 360 / LIGHTS)
    sin, cos = np.sin(np.radians(ELEVATION)), np.cos(np.radians(ELEVATION))
    lights = np.stack([sin * np.cos(around), sin * np.sin(around), np.full(LIGHTS, cos)], 1)
    relit = _with_lights(view.data, np.zeros((len(view.data.values), LIGHTS, 3), np.float32), lights)
    guess = dataclasses.replace(view.guess, exposures=np.ones(LIGHTS))
    images = _render(result, options, relit, guess, view.depth)
    return [_relighting(view, images), _photographs(view, result, rendered_again(view, result, options))]


def rendered_again(view: View, result: Result, options: Options) -> np.ndarray:
    """What the photographs show, under their lights, near ones if the shading told so: (P, K, 3)."""
    data, depth, away = view.data, view.depth, result.away / view.step
    if np.isfinite(away):
        data, depth = nearness.around(data, away), nearness.as_near(depth, away)
    return _render(result, options, data, view.guess, depth)


def _render(result: Result, options: Options, data: Dataset, guess: Guess, depth: np.ndarray) -> np.ndarray:
    several = guess.base is not None
    rendering = Rendering(data, result.lobes, max_depth=options.max_depth, several=several, base_eta=guess.base_eta)
    rendering.update(guess, depth[rendering.domain.nearest])
    return rendering.image(spp=SPP, seed=options.seed)


def _relighting(view: View, images: np.ndarray) -> str:
    gain = _gain(images)
    shown = []
    for k in range(LIGHTS):
        file = io.BytesIO()
        Image.fromarray(pictures.to_srgb(view.image(images[:, k]) * gain)).save(file, "JPEG", quality=88)
        text = f"Rendered, with the light at {360 * k // LIGHTS} degrees"
        hidden = " hidden" if k else ""
        shown.append(f'<img alt="{text}"{hidden} src="{page.data_uri(file.getvalue(), "image/jpeg")}">')
    return f"""<section>\n<h2>Relighting</h2>
<figure class="relit">
<div class="stack">{"".join(shown)}</div>
<div class="control">
<input type="range" min="0" max="{LIGHTS - 1}" step="1" value="0" autocomplete="off" aria-label="Azimuth of the light">
<svg width="40" height="40" aria-hidden="true"><circle cx="20" cy="20" r="14" fill="none" stroke="currentColor"/>
<circle class="dot" cx="34" cy="20" r="5" fill="currentColor"/></svg>
</div>
<figcaption>The slider moves the light around, {ELEVATION:g} degrees from the direction to the camera.</figcaption>
</figure>\n</section>"""


def _photographs(view: View, result: Result, images: np.ndarray) -> str:
    data, gain = view.data, _gain(view.data.values)
    differences = [view.image(images[:, i] - data.values[:, i]) * gain for i in range(len(view.chosen))]
    limit = pictures.symmetric_limit(differences)
    figures = []
    for i, (k, difference) in enumerate(zip(view.chosen, differences, strict=True)):
        name = result.data.names[k] if result.data.names else f"image {k + 1}"
        for values, what in ((data.values, "photograph"), (images, "rendering")):
            figures.append(_figure(pictures.to_srgb(view.image(values[:, i]) * gain), f"{name}: {what}"))
        coloured = _coloured(pictures.signed(difference), pictures.COLOUR_MAP, -limit, limit)
        figures.append(_figure(coloured, "rendering − photograph"))
    of_difference = "rendering − photograph, if the brightest parts of the photographs are 1"
    scale = _scale(pictures.COLOUR_MAP, -limit, limit, of_difference)
    maps = f'<div class="maps">{"".join(figures)}</div>'
    return f"<section>\n<h2>Photographs and renderings</h2>\n{maps}\n{scale}\n</section>"


def _progress(result: Result) -> str:
    seconds = [entry["seconds"] for entry in result.history]
    curves = {"Residual": ("residual", "residual over the median value")}
    if "error" in result.history[-1]:
        curves["Error"] = ("error", "mean angular error, degrees")
    plots = []
    for title, (key, label) in curves.items():
        plots.append(_plot(title, seconds, [e[key] for e in result.history], "seconds", label, _sizes(result)))
    K = len(result.guess.exposures)
    plots.append(_plot("Exposures", np.arange(1, K + 1), result.guess.exposures, "image", "factor", linear=True))
    return f'<section>\n<h2>Progress and exposures</h2>\n<div class="plots">\n{"".join(plots)}</div>\n</section>'


def _reflectance(view: View, result: Result) -> str:
    plot = page.svg(output.bsdf_figure(result), "Reflectance in the plane of incidence")
    weights, factor = output.bsdf(result)
    rows = []
    order = np.argsort(-weights.max(1))
    for b in order[weights.max(1)[order] > 1e-4]:
        alpha, eta = result.lobes.alpha[b], result.lobes.eta[b]
        lobe = "glossy" if np.isfinite(alpha) else "diffuse, under a coat" if np.isfinite(eta) else "diffuse"
        of_lobe = ("" if np.isnan(x) else f"{x:.3g}" for x in (alpha, eta))
        rows.append((lobe, *of_lobe, *(f"{w:.4f}" for w in weights[b])))
    note = "" if factor == 1 else f" times {number(factor)}"
    if view.guess.base is None:
        albedo = _with_scale({"Albedo": result.guess.albedo}, view, f"factor of the BSDF{note}")
    else:
        colours = pictures.to_srgb(view.image(view.guess.base / max(float(view.guess.base.max()), 1e-12)))
        colours = _masked(colours, view.data.mask[view.crop])
        glaze = np.nan_to_num(view.image(view.guess.albedo, np.nan))[..., None].repeat(3, -1)
        glaze = _masked(pictures.to_srgb(glaze), view.data.mask[view.crop])
        of_glaze = f"Glaze: on {100 * result.guess.albedo.mean():.0f} % of the surface, which are white"
        figures = [_figure(colours, "Diffuse colours, the brightest is 1"), _figure(glaze, of_glaze)]
        albedo = f'<div class="maps">{"".join(figures)}</div>'
    table = page.table(
        ("lobe", "roughness (alpha)", "index of refraction", "red", "green", "blue"), rows, "Weights of the lobes"
    )
    caption = (
        "The BSDF times the cosine of the angle θₒ at which light leaves, in the plane of incidence; θₒ is that of the "
        "mirror direction where it equals the angle of incidence θᵢ."
    )
    figure = f"<figure>{plot}<figcaption>{caption}</figcaption></figure>"
    return f"<section>\n<h2>Reflectance</h2>\n{figure}\n{albedo}\n<h3>Weights</h3>\n{table}\n</section>"


def _settings(result: Result, options: Options) -> str:
    given = dataclasses.asdict(options)
    given |= {f"descent.{key}": value for key, value in given.pop("descent").items()}
    facts = {
        "images": f"{len(result.data.lights)} of {result.data.mask.shape[1]} x {result.data.mask.shape[0]} pixels",
        "pixels of the mask": str(len(result.data.values)),
        **{key: "not given" if value is None else str(value) for key, value in given.items()},
        **output.versions(),
        "processor": processor(),
    }
    return (
        f"<section>\n<h2>Settings</h2>\n<details>\n<summary>Options, versions and machine</summary>\n"
        f"{page.table(('', ''), facts.items(), 'Settings')}\n</details>\n</section>"
    )


# ------------------------------------------------------------------ parts


def _with_lights(data: Dataset, values: np.ndarray, lights: Sequence) -> Dataset:
    """Other images of the same pixels. lights : directions, or LEDs."""
    near = hasattr(lights[0], "position")
    intensities = np.ones((len(lights), 3))
    lights = tuple(lights) if near else np.array(lights)
    return dataclasses.replace(data, values=values, lights=lights, intensities=intensities, names=())


def _camera(view: View) -> np.ndarray | None:
    """Of the cropped images."""
    if view.data.camera is None:
        return None
    rows, columns = view.crop
    camera = view.data.camera.copy()
    camera[:2, 2] -= columns.start, rows.start
    return camera


def _gain(values: np.ndarray) -> float:
    """Makes the brightest parts white, but for highlights."""
    return 1 / max(float(np.percentile(values, 99)), 1e-12)


def _figure(image: np.ndarray, caption: str) -> str:
    """image : (H, W, 3), uint8; or (H, W, 4), where the last one is how opaque it is."""
    text = html.escape(caption)
    return f"<figure>{page.picture(image, caption)}<figcaption>{text}</figcaption></figure>"


def _coloured_normals(normals: np.ndarray) -> np.ndarray:
    colours = np.nan_to_num((normals + 1) / 2 * 255 + 0.5).astype(np.uint8)
    return _masked(colours, np.isfinite(normals[..., 0]))


def _coloured(values: np.ndarray, name: str, low: float | None = None, high: float | None = None) -> np.ndarray:
    """(H, W, 4), uint8; NaN is transparent."""
    ends = _ends(values)
    low, high = ends[0] if low is None else low, ends[1] if high is None else high
    colours = matplotlib.colormaps[name](np.nan_to_num((values - low) / (high - low or 1)), bytes=True)[..., :3]
    return _masked(colours, np.isfinite(values))


def _ends(values: np.ndarray) -> np.ndarray:
    """The smallest and the largest, but for NaN."""
    return np.array([np.nanmin(values), np.nanmax(values)])


def _masked(image: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """A picture, (H, W, 3), uint8, that is transparent outside: (H, W, 4)."""
    return np.concatenate([image, np.where(inside, 255, 0).astype(np.uint8)[..., None]], 2)


def _with_scale(maps: dict[str, np.ndarray], view: View, unit: str) -> str:
    """Maps of positive numbers of the pixels of the result, (P,), with one scale. NaN where they are not known."""
    limit = max(float(np.nanpercentile(np.concatenate(list(maps.values())), 98)), 1e-6)
    figures = []
    for name, values in maps.items():
        caption = f"{name}, mean {number(float(np.nanmean(values)))}"
        figures.append(_figure(_coloured(view.image(view.mean(values), np.nan), "inferno", 0, limit), caption))
    return f'<div class="maps">{"".join(figures)}</div>\n{_scale("inferno", 0, limit, unit)}'


def _scale(colours: str, low: float, high: float, unit: str) -> str:
    """A bar of the colours of a map."""
    stops = ", ".join(matplotlib.colors.to_hex(matplotlib.colormaps[colours](i / 10)) for i in range(11))
    return (
        f'<div class="scale" style="background: linear-gradient(to right, {stops})"></div>\n<div class="ends">'
        f"<span>{number(low, 2)}</span><span>{html.escape(unit)}</span><span>{number(high, 2)}</span></div>"
    )


def _sizes(result: Result) -> list[float]:
    """When the size of the images changed, seconds."""
    pairs = zip(result.history, result.history[1:], strict=False)
    return [before["seconds"] for before, after in pairs if after["size"] != before["size"]]


def _plot(title: str, x: Sequence, y: Sequence, x_label: str, y_label: str, marks: Sequence = (), linear=False) -> str:
    figure = Figure(figsize=(5.4, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(x, y, color=page.COLOURS[0], linewidth=1.4, marker=".", markersize=4)
    for mark in marks:
        axes.axvline(mark, color=page.INK, linewidth=0.6, alpha=0.6)
    axes.set(xlabel=x_label, ylabel=y_label)
    if not linear and min(y) > 0:
        axes.set_yscale("log")
    page.paint(axes)
    note = "<figcaption>Lines: from there on, larger images.</figcaption>" if marks else ""
    return f"<figure>\n<h3>{title}</h3>\n{page.svg(figure, f'{title}: {y_label}')}\n{note}</figure>\n"


def _cross_section(result: Result, truth: np.ndarray) -> str:
    """Along the row that has most pixels of the mask."""
    data = result.data
    if truth.shape != data.mask.shape or data.camera is not None:
        return ""
    row = int(data.mask.sum(1).argmax())
    x = np.flatnonzero(data.mask[row])
    found = data.image(output.depth(result))
    found += np.median((truth - found)[data.mask])
    figure = Figure(figsize=(5.4, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(x, truth[row, x], color=page.COLOURS[0], linewidth=1.4, label="truth")
    axes.plot(x, found[row, x], color=page.COLOURS[1], linewidth=1.4, label="result")
    axes.set(xlabel="column", ylabel="depth, pixels")
    axes.legend(fontsize=8, labelcolor=page.INK, framealpha=0, edgecolor="none")
    page.paint(axes)
    error = output.error_of_depth(result, truth)
    return (
        f'<div class="plots"><figure>\n<h3>Cross-section</h3>\n{page.svg(figure, "Cross-section of depth")}\n'
        f"<figcaption>Row {row}. Mean error of depth: {number(error)} pixels.</figcaption></figure></div>"
    )
