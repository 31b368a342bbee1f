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

from . import least_squares, output
from .dataset import LUMINANCE, Dataset
from .direct import Guess
from .integration import normals_of
from .reconstruction import Options, Result
from .rendering import Rendering
from .vectors import unit

#: Largest width and height of pictures in the page, pixels.
SHOWN = 240

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

    depth : (P',), as of `integrate`. chosen : (K',), numbers of these images. start : (P', 3), normals by the
    method of the start, or None. crop : of images.
    """

    data: Dataset
    guess: Guess
    depth: np.ndarray
    chosen: np.ndarray
    start: np.ndarray | None
    crop: tuple[slice, slice]

    @staticmethod
    def of(result: Result, options: Options) -> View:
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
        start = None
        if not data.near:
            values = np.stack([mean(data.values[:, k] @ LUMINANCE) for k in range(len(data.lights))], 1)
            start = least_squares.normals(values / guess.exposures, data.lights, options.start)
        found = dataclasses.replace(
            guess,
            normals=unit(mean(guess.normals)),
            albedo=mean(guess.albedo),
            exposures=guess.exposures[chosen],
            base=None if guess.base is None else mean(guess.base),
        )
        rows, columns = np.nonzero(small.mask)
        crop = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        return View(small, found, depth, chosen, start, crop)

    def image(self, pixels: np.ndarray, fill: float = 0) -> np.ndarray:
        return self.data.image(pixels, fill)[self.crop]


def write(
    folder: Path, result: Result, options: Options, *, title: str, status: str, truth: np.ndarray | None = None
) -> None:
    """Write ``report.html``. status : "finished", or "interrupted". truth : (H, W), of depth.

    Raises
    ------
    OSError
    """
    view = View.of(result, options)
    sections = [
        f"<style>{STYLE}</style>\n<header>\n<h1>{html.escape(title)}</h1>\n{_verdict(view, result, status)}\n</header>",
        _shape(view, result, truth),
        *_rendered(view, result, options),
        _progress(result),
        _reflectance(view, result),
        _settings(result, options),
        f"<script>{SCRIPT}</script>",
    ]
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(page.page(title, "\n".join(sections)), "utf-8")


# ------------------------------------------------------------------ sections


def _verdict(view: View, result: Result, status: str) -> str:
    facts = [f"{len(result.history)} alternations in {result.seconds:.3g} s"]
    if result.error is not None:
        facts.append(f"mean angular error {result.error:.2f}°")
        if view.start is not None:
            facts[-1] += f" (start: {np.nanmean(view.data.off(view.start)):.2f}°)"
    facts.append(f"residual {number(100 * result.history[-1]['residual'], 2)} % of the median value")
    facts += output.judgement(result)
    kind = "status" if status == "finished" else "status bad"
    verdict = (
        f'<p class="verdict"><span class="{kind}">{html.escape(status)}</span>: {html.escape("; ".join(facts))}</p>'
    )
    items = "".join(f"<li>{html.escape(text)}</li>" for text in result.doubts)
    return verdict + (f'\n<p>The data are doubtful:</p>\n<ul class="warnings">{items}</ul>' if items else "")


def _shape(view: View, result: Result, truth: np.ndarray | None) -> str:
    data = view.data
    maps = {"start": view.start, "result": view.guess.normals, "truth": data.truth}
    maps = {name: normals for name, normals in maps.items() if normals is not None}
    figures = [_figure(_coloured_normals(view.image(n, np.nan)), f"Normals: {name}") for name, n in maps.items()]
    sections = [f'<section>\n<h2>Shape</h2>\n<div class="maps">{"".join(figures)}</div>']
    if data.truth is not None:
        errors = {name: data.off(n) for name, n in maps.items() if name != "truth"}
        sections.append(_with_scale({f"Error: {name}": e for name, e in errors.items()}, view.image, "degrees"))
    depth = view.image(view.depth, np.nan)
    inside = np.isfinite(depth)
    from_depth = normals_of(depth, inside, camera=_camera(view))
    shaded = np.maximum(from_depth @ SHADING, 0)[..., None].repeat(3, -1)
    figures = [_figure(pictures.to_srgb(shaded), "Depth, shaded"), _figure(_coloured(depth, "viridis"), "Depth")]
    plot = "" if truth is None else _cross_section(result, truth)
    return "\n".join([*sections, f'<div class="maps">{"".join(figures)}</div>\n{plot}\n</section>'])


def _rendered(view: View, result: Result, options: Options) -> list[str]:
    """Relit, and beside the photographs."""
    around = np.radians(np.arange(LIGHTS) * 360 / LIGHTS)
    sin, cos = np.sin(np.radians(ELEVATION)), np.cos(np.radians(ELEVATION))
    lights = np.stack([sin * np.cos(around), sin * np.sin(around), np.full(LIGHTS, cos)], 1)
    render = lambda data, guess: _render(view, result, options, data, guess)
    relit = render(
        _with_lights(view.data, np.zeros((len(view.data.values), LIGHTS, 3), np.float32), lights),
        dataclasses.replace(view.guess, exposures=np.ones(LIGHTS)),
    )
    again = render(view.data, view.guess)
    return [_relighting(view, relit), _photographs(view, result, again)]


def _render(view: View, result: Result, options: Options, data: Dataset, guess: Guess) -> np.ndarray:
    several = guess.base is not None
    rendering = Rendering(data, result.lobes, max_depth=options.max_depth, several=several, base_eta=guess.base_eta)
    rendering.update(guess, view.depth[rendering.domain.nearest])
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
    scale = _scale(pictures.COLOUR_MAP, -limit, limit, "difference; the photographs reach up to about 1")
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
    plots.append(_plot("Exposures", np.arange(1, K + 1), result.guess.exposures, "image", "exposure", linear=True))
    return f'<section>\n<h2>Progress and exposures</h2>\n<div class="plots">\n{"".join(plots)}</div>\n</section>'


def _reflectance(view: View, result: Result) -> str:
    plot = page.svg(output.bsdf_figure(result), "Reflectance in the plane of incidence")
    weights, factor = output.bsdf(result)
    rows = []
    order = np.argsort(-weights.max(1))
    for b in order[weights.max(1)[order] > 1e-4]:
        lobe = "diffuse" if np.isnan(result.lobes.alpha[b]) else f"{result.lobes.alpha[b]:.3g}"
        rows.append((lobe, f"{result.lobes.eta[b]:.3g}", *(f"{w:.4f}" for w in weights[b])))
    note = "" if factor == 1 else f" times {number(factor)}"
    if view.guess.base is None:
        albedo = _with_scale({"Albedo": view.guess.albedo}, view.image, f"factor of the BSDF{note}")
    else:
        colours = pictures.to_srgb(view.image(view.guess.base / max(float(view.guess.base.max()), 1e-12)))
        albedo = f'<div class="maps">{_figure(colours, "Diffuse colours, the brightest is 1")}</div>'
    table = page.table(("alpha", "eta", "red", "green", "blue"), rows, "Weights of the lobes")
    return f"<section>\n<h2>Reflectance</h2>\n<figure>{plot}</figure>\n{albedo}\n<h3>Weights</h3>\n{table}\n</section>"


def _settings(result: Result, options: Options) -> str:
    facts = {
        "images": f"{len(result.data.lights)} of {result.data.mask.shape[1]} x {result.data.mask.shape[0]} pixels",
        "pixels of the mask": str(len(result.data.values)),
        **{key: str(value) for key, value in dataclasses.asdict(options).items()},
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
    """image : (H, W, 3), uint8."""
    text = html.escape(caption)
    return f"<figure>{page.picture(image, caption)}<figcaption>{text}</figcaption></figure>"


def _coloured_normals(normals: np.ndarray) -> np.ndarray:
    return np.nan_to_num((normals + 1) / 2 * 255 + 0.5).astype(np.uint8)


def _coloured(values: np.ndarray, name: str, low: float | None = None, high: float | None = None) -> np.ndarray:
    """(H, W, 3), uint8; NaN is black."""
    low = np.nanmin(values) if low is None else low
    high = np.nanmax(values) if high is None else high
    colours = matplotlib.colormaps[name](np.nan_to_num((values - low) / (high - low or 1)), bytes=True)[..., :3]
    return np.where(np.isfinite(values)[..., None], colours, 0).astype(np.uint8)


def _with_scale(maps: dict[str, np.ndarray], image: Callable, unit: str) -> str:
    """Maps of positive numbers, (P,), with one scale. NaN where they are not known."""
    limit = max(float(np.nanpercentile(np.concatenate(list(maps.values())), 98)), 1e-6)
    figures = []
    for name, values in maps.items():
        caption = f"{name}, mean {number(float(np.nanmean(values)))}"
        figures.append(_figure(_coloured(image(values, np.nan), "inferno", 0, limit), caption))
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
