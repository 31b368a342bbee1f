"""What a fit found, for people: one page that needs nothing but itself, an animation, and files for other programs."""

from __future__ import annotations

import datetime
import html
import io
import logging
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

import rimlight
from rimlight import pictures
from rimlight.exr import replacing, write_exr
from rimlight.sys_info import processor

from . import fitting, page
from . import problem as problems
from .fitting import WINDOW, Fit
from .page import number
from .targets import resample

log = logging.getLogger(__name__)

#: Parameters of so few numbers are shown number by number.
FEW = 16

#: Curves of one plot.
CURVES = 12

#: What a loss is: name, unit.
NORMS = {
    "l1": ("mean absolute difference", "radiance"),
    "l2": ("mean squared difference", "radiance²"),
    "relative": ("mean squared relative difference", ""),
    "classifier": ("log p of what shall fall − of what shall rise", ""),
}


def write(folder: Path, fit: Fit, *, title: str) -> None:
    """Write all of a result into a folder, which is made if need be.

    ``report.html``; ``convergence.mp4`` or ``.gif``; ``result.json``, the summary; ``result.npz``, key -> value;
    ``problem.toml``; and of each view i ``start_i``, ``result_i``, ``target_i``, as EXR and as PNG.

    Raises
    ------
    OSError : something cannot be written. Nothing of a file is there before it is complete.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / "result.json") as temporary:
        temporary.write_text(fitting.summary(fit) + "\n", "utf-8")
    with replacing(folder / "result.npz") as temporary:
        np.savez(temporary, **fit.values)  # type: ignore[arg-type]
    problems.write(folder / "problem.toml", fit.problem)
    for i, view in enumerate(fit.views):
        for name, image in (("start", view.start), ("result", view.result), ("target", view.target)):
            write_exr(folder / f"{name}_{i}.exr", {"": image})
            pictures.write_image(folder / f"{name}_{i}.png", image)
    animation = write_animation(folder, fit)
    _write_page(folder / "report.html", fit, animation, title, "")


def write_report(path: Path, fit: Fit, *, title: str, text: str = "") -> None:
    """Write one HTML file with everything inside.

    title, text : plain text; empty lines separate paragraphs.

    Raises
    ------
    OSError : it cannot be written.
    """
    with tempfile.TemporaryDirectory() as folder:
        _write_page(Path(path), fit, write_animation(Path(folder), fit), title, text)


def _write_page(path: Path, fit: Fit, animation: Path, title: str, text: str) -> None:
    sections = [
        f"<header>\n<h1>{html.escape(title)}</h1>\n{_verdict(fit)}\n{page.paragraphs(text)}\n</header>",
        _views(fit),
        _curves(fit),
        _parameters(fit),
        _animation(animation, fit),
        _settings(fit),
    ]
    with replacing(path) as temporary:
        temporary.write_text(page.page(title, "\n".join(sections)), "utf-8")


# ------------------------------------------------------------------ sections of the page


def _verdict(fit: Fit) -> str:
    """One line that says how it went, and what one should know before one trusts it."""
    stages = fit.problem.stage
    planned = sum(stage.iterations for stage in stages) + (fit.problem.starts.count - 1) * stages[0].iterations
    finished = fit.status == "finished"
    steps = f"{len(fit.losses)} steps" if finished else f"{len(fit.losses)} of {planned} steps"
    facts = [f"{steps} in {fit.seconds:.3g} s"]
    if len(fit.losses):
        first, last = _loss_before_and_after(fit)
        facts.append(f"loss {number(first)} → {number(last)}")
    measures = fit.measures[0].items()
    for label, (before, after) in ((label, pair) for label, pair in measures if label.startswith("probability")):
        facts.append(f"{label} {number(before)} → {number(after)}")
    for unit, labels in _by_unit(fit.errors).items():
        worst = max(labels, key=lambda label: fit.errors[label][-1])
        before, after = fit.errors[worst][[0, -1]]
        facts.append(f"{_without_unit(worst)} {number(before)} → {number(after)} {unit}".rstrip())
    status, rest = html.escape(fit.status.partition(":")[0]), html.escape("; ".join(facts))
    kind = "status" if finished else "status bad"
    line = f'<p class="verdict"><span class="{kind}">{status}</span>: {rest}</p>'
    if found := _warnings(fit):
        items = "\n".join(f"<li>{html.escape(text)}</li>" for text in found)
        line += f'\n<ul class="warnings" aria-label="Warnings">\n{items}\n</ul>'
    return line


def _warnings(fit: Fit) -> list[str]:
    found = []
    if fit.status != "finished":
        found.append(f"The fit did not finish: {fit.status}. The result is the best that it had seen by then.")
    if fit.silent:
        names = ", ".join(f"“{name}”" for name in fit.silent)
        found.append(f"Without influence on the pictures, and so not fitted: {names}. The gradient was always 0.")
    if fit.skipped:
        steps = "1 step was" if fit.skipped == 1 else f"{fit.skipped} steps were"
        found.append(f"{steps} skipped because the gradient was not finite.")
    for i, measures in enumerate(fit.measures):
        before, after = measures["root mean square error"]
        if not np.isfinite(after):
            found.append(f"{_name(fit, i)} has pixels that are not finite.")
        elif _compares(fit) and after > 1.02 * before:  # not by noise alone
            found.append(f"{_name(fit, i)} is farther from its target than at the start.")
    return found


def _compares(fit: Fit) -> bool:
    return fit.problem.loss.norm != "classifier"


def _goal(fit: Fit) -> str:
    """What the target shows. What a classifier looks at has none, and is shown beside its beginning."""
    return "target" if _compares(fit) else "scene as it was"


def _loss_before_and_after(fit: Fit) -> tuple[float, float]:
    """The first loss, and the mean of the last ones."""
    last = fit.losses[fit.segments == fit.segments[-1]][-WINDOW:]
    last = last[np.isfinite(last)]
    return float(fit.losses[0]), float(last.mean()) if last.size else float("nan")


def _name(fit: Fit, view: int) -> str:
    return "The picture" if len(fit.views) == 1 else f"View {view}"


def _views(fit: Fit) -> str:
    goal = _goal(fit)
    sections = [f"<section>\n<h2>Result and {goal}</h2>"]
    for i, (view, measures) in enumerate(zip(fit.views, fit.measures, strict=True)):
        if len(fit.views) > 1:
            sections.append(f"<h3>View {i}</h3>")
        counts = (view.weight > 0)[..., None]
        panels = [
            (f"{label} − {goal}", np.where(counts, image - view.target, np.float32(0)))
            for label, image in (("before", view.start), ("result", view.result))[not _compares(fit) :]
        ]
        if i == 0 and fit.derivative is not None:
            panels.append(("derivative on the way from before to result", fit.derivative))
        rows = [(label, number(before, 4), number(after, 4)) for label, (before, after) in measures.items()]
        sections.append(
            f'<div class="row">\n{page.compare(view.start, view.result, view.target, _name(fit, i), goal)}\n'
            f'<div class="side">\n{page.table(("", "before", "result"), rows, f"Likeness to the {goal}")}\n'
            f"<h3>Differences</h3>\n{page.differences(panels)}\n</div>\n</div>"
        )
    return "\n".join([*sections, "</section>"])


def _parameters(fit: Fit) -> str:
    sections = ['<section>\n<h2>Parameters</h2>\n<div class="row">']
    if fit.errors:
        ratio = lambda e: number(e[-1] / e[0], 2) if e[0] else "–"
        errors = [(label, number(e[0]), number(e[-1]), ratio(e)) for label, e in fit.errors.items()]
        shown = page.table(("error", "start", "result", "ratio"), errors, "Distance from the truth")
        sections.append(f"<div>\n<h3>Distance from the truth</h3>\n{shown}\n</div>")
    rows = [(_latent_name(fit, name), *_numbers(fit, name)) for name in fit.latents]
    shown = page.table(("parameter", "start", "result"), rows, "Values of the parameters")
    return "\n".join([*sections, f"<div>\n<h3>Values</h3>\n{shown}\n</div>\n</div>\n</section>"])


def _angle(fit: Fit, name: str) -> bool:
    """Is this latent the rotation vector of a rigid body?"""
    return name.endswith(".turn") and not any(name in free.key for free in fit.problem.free)


def _latent_name(fit: Fit, name: str) -> str:
    if any(name in free.key for free in fit.problem.free):
        return name
    return f"{name} ({'degrees' if _angle(fit, name) else 'scene units'})"


def _numbers(fit: Fit, name: str) -> tuple[str, str]:
    """Start and result: few numbers one by one, points and colours on lines of their own; else their mean."""
    smoothed = any(free.smoothing and name in free.key for free in fit.problem.free)
    found = []
    for latent in (fit.start[name], fit.latents[name]):
        flat = np.degrees(latent.ravel()) if _angle(fit, name) else latent.ravel()
        if smoothed:  # these are no positions
            found.append(f"{flat.size} numbers")
        elif flat.size > FEW:
            found.append(f"{flat.size} numbers, mean {number(float(flat.mean()), 4)}")
        else:
            found.append(_grid(flat, 3 if flat.size % 3 == 0 else 4))
    return found[0], found[1]


def _grid(numbers: np.ndarray, per_line: int) -> str:
    """Numbers below each other."""
    size = float(np.abs(numbers).max())
    plain = size == 0 or 1e-3 <= size < 1e5  # else with exponents
    decimals = 4 if size < 10 else 2
    texts = [f"{x:.{decimals}f}".replace("-", "−") if plain else number(float(x), 4) for x in numbers]
    width = max(map(len, texts))
    padded = [text.rjust(width, "\u2007") for text in texts]  # the space is as wide as a digit
    return "\n".join("  ".join(padded[i : i + per_line]) for i in range(0, len(padded), per_line))


def _animation(file: Path, fit: Fit) -> str:
    data, last = file.read_bytes(), fit.frames[-1][0]
    text = f"From step 0 to step {last}, beside the {_goal(fit)}"
    if file.suffix == ".mp4":
        uri = page.data_uri(data, "video/mp4")
        shown = f'<video src="{uri}" aria-label="{text}" autoplay loop muted playsinline controls></video>'
    else:
        shown = f'<img alt="{text}" src="{page.data_uri(data, "image/gif")}">'
    return f"<section>\n<h2>Convergence</h2>\n<figure>{shown}\n<figcaption>{text}.</figcaption></figure>\n</section>"


def _settings(fit: Fit) -> str:
    facts = {
        "Rimlight": rimlight.__version__,
        "Mitsuba": mi.__version__,
        "Dr.Jit": dr.__version__,
        "NumPy": np.__version__,
        "Python": platform.python_version(),
        "threads": str(dr.thread_count()),
        "processor": processor(),
        "date": datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "time taken": f"{fit.seconds:.1f} s, without the start and the pictures of this page",
    }
    return (
        f"<section>\n<h2>Settings</h2>\n<details>\n<summary>problem.toml: the fit as it was asked for</summary>\n"
        f"<pre>{html.escape(problems.text(fit.problem))}</pre>\n</details>\n"
        f"<details>\n<summary>Versions and machine</summary>\n{page.table(('', ''), facts.items(), 'Versions')}\n"
        "</details>\n</section>"
    )


# ------------------------------------------------------------------ curves


def _curves(fit: Fit) -> str:
    """Loss and errors over the steps. Errors of different units are in different plots."""
    plots = []
    if len(fit.losses):
        name, unit = NORMS[fit.problem.loss.norm]
        label = f"loss: {name}" + (f" ({unit})" if unit else "")
        note = f"Each step, and the mean of {2 * (WINDOW // 2) + 1} around it."
        plots.append(_plot(fit, {"": fit.losses}, "Loss", label, note))
    if fit.scores:
        note = "At the noisy picture of each step."
        plots.append(_plot(fit, fit.scores, "Classes", "probability", note, linear=True))
    for unit, labels in _by_unit(fit.errors).items():
        shown = sorted(labels, key=lambda label: -fit.errors[label][-1])[:CURVES]
        note = f"The {CURVES} largest at the end, of {len(labels)}." if len(labels) > CURVES else ""
        curves = {_without_unit(label): fit.errors[label] for label in labels if label in shown}
        plots.append(_plot(fit, curves, "Distance from the truth", unit or "relative error", note))
    return "<section>\n<h2>Progress</h2>\n" + f'<div class="plots">\n{"".join(plots)}</div>\n</section>'


def _by_unit(errors: Mapping[str, np.ndarray]) -> dict[str, list[str]]:
    """Labels of errors, by the unit in their brackets."""
    found: dict[str, list[str]] = {}
    for label in errors:
        bracket = re.search(r" \(([^()]*)\)$", label)
        found.setdefault(bracket[1] if bracket else "", []).append(label)
    return found


def _without_unit(label: str) -> str:
    return re.sub(r" \([^()]*\)$", "", label)


def _plot(fit: Fit, curves: Mapping[str, np.ndarray], title: str, y: str, note: str, *, linear: bool = False) -> str:
    """A figure of HTML. curves : label -> values before each step; of one without a label, the running mean is added.
    linear : no logarithms, which negative values rule out anyway.

    Names are in the legend only, which is HTML: what matplotlib draws is ours.
    """
    figure = Figure(figsize=(5.4, 3.2), layout="constrained")
    axes = figure.add_subplot()
    negative = any((values < 0).any() for values in curves.values())
    logarithmic = not (linear or negative) and any((values > 0).any() for values in curves.values())
    legend = []
    for i, (label, values) in enumerate(curves.items()):
        if logarithmic:
            values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
        colour, dashes = page.COLOURS[i % len(page.COLOURS)], ("", "5 2")[i // len(page.COLOURS) % 2]
        style = (0, tuple(map(float, dashes.split()))) if dashes else "-"
        if label:
            axes.plot(values, color=colour, linestyle=style, linewidth=1.4)
            sample = f'<line x1="0" y1="4" x2="28" y2="4" stroke="{colour}" stroke-dasharray="{dashes}"/>'
            legend.append(f'<li><svg width="28" height="8" aria-hidden="true">{sample}</svg>{html.escape(label)}</li>')
        else:
            axes.plot(values, color=colour, linewidth=0.7, alpha=0.45)
            axes.plot(_running_mean(values, fit.segments), color=colour, linewidth=1.6)
    if logarithmic:
        axes.set_yscale("log")
    axes.set(xlabel="step", ylabel=y)
    axes.margins(x=0.02)
    _mark_segments(axes, fit)
    page.paint(axes)
    items = f'<ul class="legend">\n{"".join(legend)}\n</ul>' if legend else ""
    caption = f"<figcaption>{html.escape(note)}</figcaption>" if note else ""
    return f"<figure>\n<h3>{title}</h3>\n{page.svg(figure, f'{title}: {y}')}\n{items}{caption}</figure>\n"


def _running_mean(values: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Mean of about `WINDOW` values around each that are of the same segment, and finite: (N,)."""
    finite = np.isfinite(values)
    found = np.full(len(values), np.nan)
    for segment in np.unique(segments):
        chosen = segments == segment
        window = np.ones(min(2 * (WINDOW // 2) + 1, 2 * ((chosen.sum() + 1) // 2) - 1))
        total, count = (np.convolve(a[chosen], window, "same") for a in (np.where(finite, values, 0), finite))
        found[chosen] = np.where(count > 0.5, total / np.maximum(count, 1), np.nan)
    return found


def _mark_segments(axes: Axes, fit: Fit) -> None:
    """Thin lines where a stage or another start begins, with what begins there if there is room."""
    begins = [0, *(np.flatnonzero(np.diff(fit.segments)) + 1)] if len(fit.segments) else []
    starts = fit.problem.starts.count
    for step in begins if len(begins) > 1 else []:
        segment = int(fit.segments[step])
        if step:
            axes.axvline(step, color=page.INK, linewidth=0.6, alpha=0.6)
        if len(begins) <= 6:
            explored = starts > 1 and segment < starts
            label = f"start {segment + 1}" if explored else f"stage {segment + 2 - starts}"
            axes.text(step, 1.01, label, transform=axes.get_xaxis_transform(), fontsize=7.5, color=page.INK)


# ------------------------------------------------------------------ animation

#: Frames per second, and frames for which the last one stays.
FPS, HOLD = 10, 15

#: Size to which small pictures of the animation are enlarged, and of larger ones; pixels.
ENLARGED, LARGEST = 320, 400

#: Largest size of an animation, bytes. Longer ones lose every second picture.
MOST = 4_000_000

#: Around the pictures, and height of the text below them; pixels.
MARGIN, TEXT = 8, 26


def write_animation(folder: Path, fit: Fit) -> Path:
    """Write how the first view changed: ``convergence.mp4`` if ffmpeg is there, else ``convergence.gif``.

    Returns
    -------
    The file. Its pictures are `fit.frames`, with the target, or the scene as it was, to their right.

    Raises
    ------
    OSError : it cannot be written.
    """
    frames = [_beside_target(step, image, fit.views[0].target, _goal(fit)) for step, image in fit.frames]
    if program := shutil.which("ffmpeg"):
        try:
            return _write_video(folder / "convergence.mp4", frames, program)
        except (OSError, subprocess.SubprocessError) as error:
            log.info("ffmpeg makes no video (%s), a GIF is written instead", error)
    return _write_gif(folder / "convergence.gif", frames)


def _beside_target(step: int, image: np.ndarray, target: np.ndarray, goal: str) -> Image.Image:
    image = page.shrunk(image, LARGEST, LARGEST)
    height, width = image.shape[:2]
    factor = max(ENLARGED // max(height, width), 1)
    size = width * factor, height * factor
    panel = max(size[0], 100)  # wide enough for the text
    even = lambda n: n + n % 2  # as videos want it
    canvas = Image.new("RGB", (even(2 * panel + 3 * MARGIN), even(size[1] + MARGIN + TEXT)), "#16191d")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), 13)
    for i, (shown, label) in enumerate(
        ((image, f"step {step}"), (resample(np.nan_to_num(target), (height, width)), goal))
    ):
        left = MARGIN + i * (panel + MARGIN)
        pixels = Image.fromarray(pictures.to_srgb(shown)).resize(size, Image.Resampling.NEAREST)
        canvas.paste(pixels, (left + (panel - size[0]) // 2, MARGIN))
        draw.text((left, MARGIN + size[1] + 5), label, fill="#dde3ea", font=font)
    return canvas


def _write_video(path: Path, frames: Sequence[Image.Image], program: str) -> Path:
    width, height = frames[0].size
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(FPS), "-i", "-"]
    coding = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    data = b"".join(frame.tobytes() for frame in [*frames, *[frames[-1]] * HOLD])
    with replacing(path) as temporary:
        command = [program, "-y", "-loglevel", "error", *source, *coding, str(temporary)]
        subprocess.run(command, input=data, capture_output=True, check=True, timeout=120)
    return path


def _write_gif(path: Path, frames: Sequence[Image.Image]) -> Path:
    """All frames share the colours of the first, the middle and the last one, undithered: smaller, and no flicker."""
    chosen = [frames[i] for i in (0, len(frames) // 2, -1)]
    width, height = frames[0].size
    together = Image.new("RGB", (width, height * len(chosen)))
    for i, frame in enumerate(chosen):
        together.paste(frame, (0, i * height))
    palette = together.quantize(255)
    shown = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    while True:
        file = io.BytesIO()
        durations = [1000 // FPS] * (len(shown) - 1) + [1000 * HOLD // FPS]
        shown[0].save(file, "GIF", save_all=True, append_images=shown[1:], duration=durations, loop=0)
        if file.tell() <= MOST or len(shown) < 8:
            break
        shown = [*shown[:-1:2], shown[-1]]
    with replacing(path) as temporary:
        temporary.write_bytes(file.getvalue())
    return path
