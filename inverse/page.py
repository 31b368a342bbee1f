"""Pages that need nothing but themselves: one HTML file with style, script and pictures inside; all text is escaped.

Functions make pieces of HTML of numbers and pictures, and others put them together. A template would hold only what is
around them: a head, and a few headings.
"""

from __future__ import annotations

import base64
import html
import io
import math
import re
from collections.abc import Iterable, Sequence

import matplotlib
import matplotlib.image
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from rimlight import pictures

from .targets import resample

#: Size to which small pictures are enlarged, pixels of the screen.
ENLARGED = 480

#: Largest width of a picture in a page, pixels. Larger ones are resampled.
WIDEST = 960

STYLE = """
:root { color-scheme: light dark; --back: #ffffff; --ink: #1c2530; --quiet: #5b6672; --line: #d5dae0; --box: #f4f6f8;
  --accent: #2468c4; --good: #1c7a46; --bad: #9a5b00; --alarm: #fff4dc; }
@media (prefers-color-scheme: dark) { :root { --back: #14181d; --ink: #dde3ea; --quiet: #98a4b1; --line: #343c46;
  --box: #1d232a; --accent: #7db2ff; --good: #58c98a; --bad: #f0b154; --alarm: #33290f; } }
* { box-sizing: border-box; }
body { max-width: 76rem; margin: 2rem auto; padding: 0 1.5rem; font: 16px/1.5 system-ui, sans-serif;
  background: var(--back); color: var(--ink); overflow-wrap: anywhere; }
h1 { font-size: 1.8rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .6rem; padding-top: .6rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.6rem 0 .5rem; }
.plots h3, .row > :not(.side) > h3:first-child { margin-top: 0; }
p { max-width: 46rem; margin: .4rem 0 .8rem; }
img, video, svg { max-width: 100%; height: auto; display: block; }
figure { margin: 0; min-width: 0; max-width: 100%; }
figcaption { color: var(--quiet); font-size: .85rem; margin: .3rem 0; }
.thumbs { display: flex; gap: 2px; }
.thumbs img { width: 6rem; }
.pixels { image-rendering: pixelated; }
.verdict { max-width: none; font-size: 1.05rem; }
.status { color: var(--good); font-weight: 600; }
.status.bad { color: var(--bad); }
.warnings { list-style: none; margin: 1rem 0; padding: .6rem 1rem; border-left: 4px solid var(--bad);
  background: var(--alarm); max-width: 60rem; }
.row { display: flex; flex-wrap: wrap; gap: 1.5rem 2.5rem; align-items: flex-start; }
.row > * { min-width: 0; max-width: 100%; }
.row > .side { flex: 1 1 20rem; }
.pair { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1rem; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: 1.5rem 2.5rem; }
.plots figure > svg { width: 100%; max-width: 40rem; }
.plots text { font-family: inherit !important; }
.legend { list-style: none; margin: .2rem 0; padding: 0; font-size: .85rem; }
.legend line { stroke-width: 2.5; }
.legend svg { display: inline; vertical-align: middle; margin-right: .5rem; }
.scale { height: .8rem; border: 1px solid var(--line); margin-top: .7rem; }
.ends { display: flex; justify-content: space-between; font-size: .8rem; color: var(--quiet); }
.scroll { overflow: auto; max-height: 24rem; border: 1px solid var(--line); border-radius: 4px; width: max-content;
  max-width: 100%; }
table { border-collapse: collapse; font-size: .9rem; }
th, td { padding: .3rem .7rem; text-align: right; white-space: pre; vertical-align: top;
  font-variant-numeric: tabular-nums; border-bottom: 1px solid var(--line); overflow-wrap: normal; }
th:first-child, td:first-child { text-align: left; white-space: normal; overflow-wrap: anywhere; min-width: 9rem; }
tr:last-child td { border-bottom: 0; }
thead th { position: sticky; top: 0; background: var(--box); font-weight: 600; }
pre { overflow: auto; padding: .8rem 1rem; background: var(--box); border: 1px solid var(--line); font-size: .85rem; }
summary { cursor: pointer; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
.compare { --cut: 50%; }
.compare .stack { position: relative; overflow: hidden; cursor: ew-resize; touch-action: pan-y; user-select: none;
  -webkit-user-select: none; }
.compare img { width: 100%; pointer-events: none; }
.compare .left { position: absolute; inset: 0; height: 100%; clip-path: inset(0 calc(100% - var(--cut)) 0 0); }
.compare .left[hidden] { display: none; }
.compare .bar { position: absolute; top: 0; bottom: 0; left: var(--cut); width: 2px; margin-left: -1px;
  background: #fff; box-shadow: 0 0 0 1px #0008; }
.compare .bar::after { content: ""; position: absolute; top: 50%; left: 50%; width: 1.5rem; height: 1.5rem;
  margin: -.75rem; border-radius: 50%; background: #fff; border: 2px solid #222; }
.compare .tag { position: absolute; top: .4rem; padding: 0 .5rem; border-radius: 3px; background: #000a; color: #fff;
  font-size: .8rem; }
.compare .tag.right { right: .4rem; }
.compare .tag:not(.right) { left: .4rem; }
.compare input[type=range] { width: 100%; margin: .6rem 0 .3rem; accent-color: var(--accent); display: block; }
.compare fieldset { border: 0; margin: 0; padding: 0; font-size: .9rem; }
.compare label { margin-right: 1rem; white-space: nowrap; }
footer { margin-top: 3rem; color: var(--quiet); font-size: .85rem; }
@media (max-width: 40rem) { body { margin: 1rem auto; padding: 0 1rem; } th, td { padding: .3rem .5rem; } }
"""

SCRIPT = """
for (const compare of document.querySelectorAll(".compare")) {
  const stack = compare.querySelector(".stack");
  const slider = compare.querySelector("input[type=range]");
  const move = () => compare.style.setProperty("--cut", slider.value + "%");
  const follow = (event) => {
    const box = stack.getBoundingClientRect();
    slider.value = 100 * (event.clientX - box.left) / box.width;
    move();
  };
  const choose = () => {
    const chosen = compare.querySelector("input[type=radio]:checked").value;
    for (const image of compare.querySelectorAll(".left")) image.hidden = image.dataset.name !== chosen;
    compare.querySelector(".tag").textContent = chosen;
  };
  slider.addEventListener("input", move);
  stack.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    event.preventDefault();
    stack.setPointerCapture(event.pointerId);
    slider.focus({ preventScroll: true });
    follow(event);
  });
  stack.addEventListener("pointermove", (event) => {
    if (stack.hasPointerCapture(event.pointerId)) follow(event);
  });
  for (const radio of compare.querySelectorAll("input[type=radio]")) radio.addEventListener("change", choose);
  move();
  choose();
}
if (matchMedia("(prefers-reduced-motion: reduce)").matches)
  for (const video of document.querySelectorAll("video")) video.pause();
"""

#: Forbids the page to load anything.
POLICY = (
    "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'"
)


def page(title: str, body: str) -> str:
    """A whole page. title : plain text. body : HTML."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def paragraphs(text: str) -> str:
    """Plain text, with empty lines between the paragraphs."""
    return "\n".join(f"<p>{html.escape(part.strip())}</p>" for part in text.split("\n\n") if part.strip())


def table(head: Sequence[str], rows: Iterable[Sequence[str]], label: str) -> str:
    """A table in a box that scrolls where it is too large. head, rows, label : plain text, of any lines."""
    row = lambda cells, tag: "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"
    body = "\n".join(row(cells, "td") for cells in rows)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{html.escape(label)}">\n<table>\n'
        f"<thead>{row(head, 'th')}</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n</div>"
    )


def number(x: float, digits: int = 3) -> str:
    """A number for people: 0.0123, 1.23 × 10⁻⁵."""
    if not math.isfinite(x):
        return "not finite"
    if x == 0:
        return "0"
    exponent = int(f"{x:.{digits - 1}e}".partition("e")[2])  # after rounding
    if -4 < exponent < 5:
        return f"{x:.{max(digits - 1 - exponent, 0)}f}".replace("-", "−")
    mantissa = f"{x / 10.0**exponent:.{digits - 1}f}"
    return f"{mantissa} × 10{str(exponent).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}".replace("-", "−")


# ------------------------------------------------------------------ pictures


def data_uri(data: bytes, kind: str) -> str:
    """Data inside a page. kind : MIME type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def shown_width(image: np.ndarray) -> int:
    """Width of a picture on the screen: (H, W, ...) is enlarged by a whole factor, to about `ENLARGED`."""
    height, width = image.shape[:2]
    return min(width * max(round(ENLARGED / max(height, width)), 1), WIDEST)


def shrunk(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """A picture that is no larger than so: (H, W, C), linear. What is not a number becomes 0."""
    image = np.nan_to_num(image)
    factor = min(width / image.shape[1], height / image.shape[0], 1)
    return resample(image, tuple(max(round(n * factor), 1) for n in image.shape[:2]))


def picture(image: np.ndarray, text: str, attributes: str = "") -> str:
    """A picture: (H, W, C), linear, or (H, W, 3 or 4), uint8, as it is. text : for those who cannot see it."""
    height = image.shape[0]
    if image.dtype != np.uint8:
        image = pictures.to_srgb(shrunk(image, WIDEST, height))
    file = io.BytesIO()
    matplotlib.image.imsave(file, image, format="png")
    return (
        f'<img {attributes or _kind(image)} alt="{html.escape(text)}" width="{shown_width(image)}" '
        f'src="{data_uri(file.getvalue(), "image/png")}">'
    )


def _kind(image: np.ndarray, kind: str = "") -> str:
    """Attribute class. Enlarged pictures show their pixels."""
    names = [kind] * bool(kind) + ["pixels"] * (shown_width(image) > image.shape[1])
    return f'class="{" ".join(names)}"'


def compare(before: np.ndarray, result: np.ndarray, target: np.ndarray, name: str, goal: str = "target") -> str:
    """Two pictures over each other, and a bar between them that can be dragged: result or before, and target.

    before, result, target : (H, W, C), linear. name : plain text, unique within the page. goal : name of the target.
    """
    left = "\n".join(
        picture(image, f"{name}: {label}", f'{_kind(image, "left")} data-name="{label}"{hidden}')
        for label, image, hidden in (("result", result, ""), ("before", before, " hidden"))
    )
    group = html.escape(f"left of {name}")
    choices = "\n".join(
        f'<label><input type="radio" name="{group}" value="{label}" autocomplete="off"{checked}> {label}</label>'
        for label, checked in (("result", " checked"), ("before", ""))
    )
    return f"""<figure class="compare" style="width: {shown_width(target)}px">
<div class="stack">
{picture(target, f"{name}: {goal}")}
{left}
<div class="bar"></div><span class="tag">result</span><span class="tag right">{html.escape(goal)}</span>
</div>
<input type="range" min="0" max="100" step="any" value="50" autocomplete="off"
 aria-label="{html.escape(name)}: place of the bar between the pictures">
<fieldset aria-label="{group}">Left: {choices}</fieldset>
</figure>"""


def differences(panels: Sequence[tuple[str, np.ndarray]]) -> str:
    """Signed pictures side by side, with one symmetric scale. panels : caption, (H, W, C), linear."""
    limit = pictures.symmetric_limit([image for _, image in panels])
    colours = matplotlib.colormaps[pictures.COLOUR_MAP]
    figures = []
    for caption, image in panels:
        scaled = pictures.signed(shrunk(image, WIDEST, image.shape[0])) / (2 * limit) + 0.5
        coloured = colours(np.clip(scaled, 0, 1), bytes=True)[:, :, :3]
        figures.append(f"<figure>{picture(coloured, caption)}<figcaption>{html.escape(caption)}</figcaption></figure>")
    stops = ", ".join(matplotlib.colors.to_hex(colours(i / 10)) for i in range(11))
    return (
        f'<div class="pair">{"".join(figures)}</div>\n'
        f'<div class="scale" style="background: linear-gradient(to right, {stops})"></div>\n'
        f'<div class="ends"><span>{number(-limit, 2)}</span><span>radiance</span><span>+{number(limit, 2)}</span></div>'
    )


# ------------------------------------------------------------------ plots

#: Of curves.
COLOURS = ("#3b7dd8", "#d9772b", "#3a9e6b", "#c04f7d", "#8a6fd1", "#a08a2a", "#2fa3b5", "#b0574a")

#: Stands for the colour of the text around a plot, which CSS knows.
INK = "#010203"


def paint(axes: Axes) -> None:
    """Grid and axes in the colour of the text."""
    axes.grid(alpha=0.25, color=INK, linewidth=0.5)
    axes.set_facecolor("none")
    axes.tick_params(which="both", colors=INK, labelsize=8)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=INK, fontsize=8.5)
    for side, spine in axes.spines.items():
        spine.set(color=INK, linewidth=0.6, visible=side in ("left", "bottom"))
    low, high = axes.get_ylim()
    if axes.get_yscale() == "log" and high < 10 * low:
        # Within a decade, powers of ten are hard to read.
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")


def svg(figure: Figure, text: str) -> str:
    """A figure as SVG that may stand in a page beside others, in the colour of its text. text : what it shows."""
    figure.patch.set_alpha(0)
    file = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": text}):
        FigureCanvasSVG(figure).print_svg(file, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    drawing = re.sub(r'<g id="[^"]*">', "<g>", file.getvalue().partition("<svg")[2])
    drawing = re.sub(r'^[^>]*?viewBox="([^"]*)"[^>]*>', r' viewBox="\1">', drawing).replace(INK, "currentColor")
    return f'<svg role="img" aria-label="{html.escape(text)}"{drawing.strip()}'
