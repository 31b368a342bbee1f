"""What a fit found, for people: one page that needs nothing but itself, an animation, and files for other programs."""

from __future__ import annotations

import datetime
import html
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import rimlight
from rimlight import pictures
from rimlight.exr import replacing, write_exr
from rimlight.sys_info import processor

from . import page
from . import problem as problems
from .animation import goal, write_animation
from .page import number
from .result import WINDOW, Result, ViewOfFit, summary

#: Parameters of so few numbers are shown number by number.
FEW = 16

#: Curves of one plot.
CURVES = 12

#: Of more views than so, the first one and the worst ones are shown in detail, so many in all; and all as thumbnails of
#: this width, pixels.
DETAILED, THUMBNAIL = 4, 96


def write(folder: Path, result: Result, *, title: str) -> None:
    """Write all of a result into a folder, which is made if need be.

    ``report.html``; ``convergence.mp4`` or ``.gif``; ``result.json``, the summary; ``result.npz``, key -> value;
    ``problem.toml``; and of each view i ``start_i``, ``result_i``, ``target_i``, as EXR and as PNG.

    Raises
    ------
    OSError : something cannot be written, while all else is. Nothing of a file is there before it is complete.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    failed: list[OSError] = []

    def attempt(job: Callable[[], object]) -> None:
        """One file that does not fit shall not keep the others from being written."""
        try:
            job()
        except OSError as error:
            failed.append(error)

    attempt(lambda: _write_text(folder / "result.json", summary(result) + "\n"))
    attempt(lambda: _write_values(folder / "result.npz", result.values))
    attempt(lambda: problems.write(folder / "problem.toml", result.problem))
    attempt(lambda: _write_page(folder / "report.html", result, write_animation(folder, result), title, beside=True))
    for i, view in enumerate(result.views):
        for name, image in (("start", view.start), ("result", view.result), ("target", view.target)):
            path = folder / f"{name}_{i}"
            attempt(partial(write_exr, path.with_suffix(".exr"), {"": image}))
            attempt(partial(pictures.write_image, path.with_suffix(".png"), image))
    if failed:
        more = f", and {len(failed) - 1} other files" if len(failed) > 1 else ""
        free = shutil.disk_usage(folder).free / 1e6
        raise OSError(f"{failed[0]}{more}; {free:.3g} MB are free there, what could be written is in {folder}")


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, "utf-8")


def _write_values(path: Path, values: Mapping[str, np.ndarray]) -> None:
    with replacing(path) as temporary:
        np.savez(temporary, **values)  # type: ignore[arg-type]


def live(result: Result, *, title: str) -> str:
    """A page about a fit that goes on."""
    sections = [f"<header>\n<h1>{html.escape(title)}</h1>\n{_verdict(result)}\n</header>", _views(result)]
    return page.page(title, "\n".join([*sections, _curves(result), _parameters(result)]))


def brief(result: Result) -> str:
    """How a fit went, in a piece of HTML: one line, and the pictures of the first view."""
    view = result.views[0]
    shown = (("before", view.start), ("result", view.result), (goal(result), view.target))
    figures = "".join(
        f'<figure style="margin: 0">{page.picture(image, name)}<figcaption>{name}</figcaption></figure>'
        for name, image in shown
    )
    return f'<div>{_verdict(result)}<div style="display: flex; flex-wrap: wrap; gap: 1em">{figures}</div></div>'


def write_report(path: Path, result: Result, *, title: str, text: str = "") -> None:
    """Write one HTML file with everything inside.

    title, text : plain text; empty lines separate paragraphs.

    Raises
    ------
    OSError : it cannot be written.
    """
    with tempfile.TemporaryDirectory() as folder:
        _write_page(Path(path), result, write_animation(Path(folder), result), title, text)


def _write_page(
    path: Path, result: Result, animation: Path, title: str, text: str = "", *, beside: bool = False
) -> None:
    """beside : are the pictures of the views in files beside the page, too?"""
    sections = [
        f"<header>\n<h1>{html.escape(title)}</h1>\n{_verdict(result)}\n{page.paragraphs(text)}\n</header>",
        _views(result, beside),
        _curves(result),
        _parameters(result),
        _animation(animation, result),
        _settings(result),
    ]
    _write_text(path, page.page(title, "\n".join(sections)))


# ------------------------------------------------------------------ sections of the page


def _verdict(result: Result) -> str:
    """One line that says how it went, and what one should know before one trusts it."""
    stages = result.problem.stage
    planned = sum(stage.iterations for stage in stages) + (result.problem.starts.count - 1) * stages[0].iterations
    finished = result.status == "finished"
    steps = f"{len(result.losses)} steps" if finished else f"{len(result.losses)} of {planned} steps"
    facts = [f"{steps} in {_duration(result.seconds)}"]
    if len(result.losses):
        first, last = _loss_before_and_after(result)
        facts.append(f"loss {number(first)} → {number(last)}")
    for label, (before, after) in result.measures[0].items():
        if label in result.scores:
            facts.append(f"{label} {number(before)} → {number(after)}")
    for unit, labels in _by_unit(result.errors).items():
        worst = max(labels, key=lambda label: result.errors[label][-1])
        before, after = result.errors[worst][[0, -1]]
        facts.append(f"{_without_unit(worst)} {number(before)} → {number(after)} {unit}".rstrip())
    status, rest = html.escape(result.status.partition(":")[0]), html.escape("; ".join(facts))
    kind = "status" if result.status in ("finished", "running") else "status bad"
    line = f'<p class="verdict"><span class="{kind}">{status}</span>: {rest}</p>'
    if found := _warnings(result):
        items = "\n".join(f"<li>{html.escape(text)}</li>" for text in found)
        line += f'\n<ul class="warnings" aria-label="Warnings">\n{items}\n</ul>'
    return line


def _duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds < 600 else f"{seconds / 60:.0f} min"


def _warnings(result: Result) -> list[str]:
    found = []
    if result.status not in ("finished", "running"):
        found.append(f"The fit did not finish: {result.status}. The result is the best that it had seen by then.")
    if result.silent:
        names = ", ".join(f"“{name}”" for name in result.silent)
        found.append(f"Without influence on the pictures, and so not fitted: {names}. The gradient was always 0.")
    if result.skipped:
        steps = "1 step was" if result.skipped == 1 else f"{result.skipped} steps were"
        found.append(f"{steps} skipped because a number was not finite.")
    found += result.doubts
    for i, measures in enumerate(result.measures):
        before, after = measures["root mean square error"]
        if not np.isfinite(after):
            found.append(f"{_name(result, i)} has pixels that are not finite.")
        elif result.problem.compares and after > 1.02 * before:  # not by noise alone
            found.append(f"{_name(result, i)} is farther from its target than at the start.")
    return found


def _loss_before_and_after(result: Result) -> tuple[float, float]:
    """The first loss, and the mean of the last ones."""
    last = result.losses[result.segments == result.segments[-1]][-WINDOW:]
    last = last[np.isfinite(last)]
    return float(result.losses[0]), float(last.mean()) if last.size else float("nan")


def _name(result: Result, view: int) -> str:
    return "The picture" if len(result.views) == 1 else f"View {view}"


def _views(result: Result, beside: bool = False) -> str:
    aim = goal(result)
    sections = [f"<section>\n<h2>Result and {aim}</h2>"]
    several = len(result.views) > DETAILED
    for i in _in_detail(result) if several else range(len(result.views)):
        view, measures = result.views[i], result.measures[i]
        if several:
            small = lambda image: page.shrunk(image, page.ENLARGED, page.ENLARGED)
            weight = small(view.weight[..., None])[..., 0]
            view = ViewOfFit(small(view.start), small(view.result), small(view.target), weight)
        if len(result.views) > 1:
            sections.append(f"<h3>View {i}</h3>")
        counts = (view.weight > 0)[..., None]
        panels = [
            (f"{label} − {aim}", np.where(counts, image - view.target, np.float32(0)))
            for label, image in (("before", view.start), ("result", view.result))[not result.problem.compares :]
        ]
        if i == 0 and result.derivative is not None:
            panels.append(("derivative on the way from before to result", result.derivative))
        rows = [(label, number(before, 4), number(after, 4)) for label, (before, after) in measures.items()]
        sections.append(
            f'<div class="row">\n{page.compare(view.start, view.result, view.target, _name(result, i), aim)}\n'
            f'<div class="side">\n{page.table(("", "before", "result"), rows, f"Likeness to the {aim}")}\n'
            f"<h3>Differences</h3>\n{page.differences(panels)}\n</div>\n</div>"
        )
    if several:
        sections.append(_overview(result, aim, beside))
    return "\n".join([*sections, "</section>"])


def _in_detail(result: Result) -> list[int]:
    """Numbers of the views that are shown in detail: the first one, and the worst ones."""
    after = [measures["root mean square error"][1] for measures in result.measures]
    worst = sorted(range(1, len(after)), key=lambda i: -np.nan_to_num(after[i], nan=np.inf))
    return [0, *sorted(worst[: DETAILED - 1])]


def _overview(result: Result, aim: str, beside: bool) -> str:
    """All views, small."""
    figures = []
    for i, (view, measures) in enumerate(zip(result.views, result.measures, strict=True)):
        before, after = (number(x, 2) for x in measures["root mean square error"])
        shown = "".join(
            page.picture(page.shrunk(image, THUMBNAIL, THUMBNAIL), f"View {i}: {name}")
            for name, image in (("result", view.result), (aim, view.target))
        )
        name = f'<a href="result_{i}.png">View {i}</a>' if beside else f"View {i}"
        caption = f"<figcaption>{name}: {before} → {after}</figcaption>"
        figures.append(f'<figure><div class="thumbs">{shown}</div>{caption}</figure>')
    return (
        f"<h3>All views</h3>\n<p>Result and {aim}, and the root mean square error before and after.</p>\n"
        f'<div class="row">{"".join(figures)}</div>'
    )


def _parameters(result: Result) -> str:
    sections = ['<section>\n<h2>Parameters</h2>\n<div class="row">']
    if result.errors:
        ratio = lambda e: number(e[-1] / e[0], 2) if e[0] else "–"
        errors = [(label, number(e[0]), number(e[-1]), ratio(e)) for label, e in result.errors.items()]
        shown = page.table(("error", "start", "result", "ratio"), errors, "Distance from the truth")
        sections.append(f"<div>\n<h3>Distance from the truth</h3>\n{shown}\n</div>")
    rows = [(_latent_name(result, name), *_numbers(result, name)) for name in result.latents]
    shown = page.table(("parameter", "start", "result"), rows, "Values of the parameters")
    return "\n".join([*sections, f"<div>\n<h3>Values</h3>\n{shown}\n</div>\n</div>\n</section>"])


def _angle(result: Result, name: str) -> bool:
    """Is this latent the rotation vector of a rigid body?"""
    return name.endswith(".turn") and not any(name in free.key for free in result.problem.free)


def _latent_name(result: Result, name: str) -> str:
    if any(name in free.key for free in result.problem.free):
        return name
    return f"{name} ({'degrees' if _angle(result, name) else 'scene units'})"


def _numbers(result: Result, name: str) -> tuple[str, str]:
    """Start and result: few numbers one by one, points and colours on lines of their own; else their mean."""
    smoothed = any(free.smoothing and name in free.key for free in result.problem.free)
    found = []
    for latent in (result.start[name], result.latents[name]):
        flat = np.degrees(latent.ravel()) if _angle(result, name) else latent.ravel()
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


def _animation(file: Path, result: Result) -> str:
    data, last = file.read_bytes(), result.frames[-1][0]
    text = f"From step 0 to step {last}, beside the {goal(result)}"
    if file.suffix == ".mp4":
        uri = page.data_uri(data, "video/mp4")
        shown = f'<video src="{uri}" aria-label="{text}" autoplay loop muted playsinline controls></video>'
    else:
        shown = f'<img alt="{text}" src="{page.data_uri(data, "image/gif")}">'
    return f"<section>\n<h2>Convergence</h2>\n<figure>{shown}\n<figcaption>{text}.</figcaption></figure>\n</section>"


def _settings(result: Result) -> str:
    facts = {
        "Rimlight": rimlight.__version__,
        "Mitsuba": mi.__version__,
        "Dr.Jit": dr.__version__,
        "NumPy": np.__version__,
        "Python": platform.python_version(),
        "threads": str(dr.thread_count()),
        "processor": processor(),
        "date": datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "time taken": f"{result.seconds:.1f} s, without the start and the pictures of this page",
    }
    return (
        f"<section>\n<h2>Settings</h2>\n<details>\n<summary>problem.toml: the fit as it was asked for</summary>\n"
        f"<pre>{html.escape(problems.text(result.problem))}</pre>\n</details>\n"
        f"<details>\n<summary>Versions and machine</summary>\n{page.table(('', ''), facts.items(), 'Versions')}\n"
        "</details>\n</section>"
    )


# ------------------------------------------------------------------ curves


def _curves(result: Result) -> str:
    """Loss and errors over the steps. Errors of different units are in different plots."""
    plots = []
    if len(result.losses):
        note = f"Each step, and the mean of {2 * (WINDOW // 2) + 1} around it."
        plots.append(_plot(result, {"": result.losses}, "Loss", f"loss: {result.loss}", note))
    if result.scores:
        note = "At the noisy picture of each step."
        plots.append(_plot(result, result.scores, "Metrics of the loss", "value", note, linear=True))
    for unit, labels in _by_unit(result.errors).items():
        shown = sorted(labels, key=lambda label: -result.errors[label][-1])[:CURVES]
        note = f"The {CURVES} largest at the end, of {len(labels)}." if len(labels) > CURVES else ""
        curves = {_without_unit(label): result.errors[label] for label in labels if label in shown}
        plots.append(_plot(result, curves, "Distance from the truth", unit or "relative error", note))
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


def _plot(
    result: Result, curves: Mapping[str, np.ndarray], title: str, y: str, note: str, *, linear: bool = False
) -> str:
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
            axes.plot(_running_mean(values, result.segments), color=colour, linewidth=1.6)
    if logarithmic:
        axes.set_yscale("log")
    axes.set(xlabel="step", ylabel=y)
    axes.margins(x=0.02)
    _mark_segments(axes, result)
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


def _mark_segments(axes: Axes, result: Result) -> None:
    """Thin lines where a stage or another start begins, with what begins there if there is room."""
    begins = [0, *(np.flatnonzero(np.diff(result.segments)) + 1)] if len(result.segments) else []
    starts = result.problem.starts.count
    for step in begins if len(begins) > 1 else []:
        segment = int(result.segments[step])
        if step:
            axes.axvline(step, color=page.INK, linewidth=0.6, alpha=0.6)
        if len(begins) <= 6:
            explored = starts > 1 and segment < starts
            label = f"start {segment + 1}" if explored else f"stage {segment + 2 - starts}"
            axes.text(step, 1.01, label, transform=axes.get_xaxis_transform(), fontsize=7.5, color=page.INK)
