"""What the benchmarks share: measuring derivative images, one process for each case, tables and plots.

A benchmark names its cases, how to measure each, and how to report them:

    if __name__ == "__main__":
        main(Benchmark(name="soft_shadow", cases={...}, report=..., plot=...))
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import rimlight  # first: it chooses the LLVM library

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

import building  # noqa: E402
import cases  # noqa: E402
import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402

from rimlight.checks import FiniteDifferences, Motion, derivative_image  # noqa: E402
from rimlight.checks.finite_differences import render_stratified  # noqa: E402

DIFFERENCES = "finite differences"

#: Where two methods are compared at equal time: samples per pixel of the peer.
EQUAL_TIME_SPP = 4


@dataclass(frozen=True)
class Settings:
    """How long to measure.

    quick : only to see that it works.
    calls : at most and at least so many timed calls of a method, each with a seed of its own.
    seconds : no further call of a method after so long, but for the least.
    trials : of the comparison at equal time.
    values : of pixels, at least so many, from which outliers are known.
    """

    quick: bool = False
    calls: tuple[int, int] = (32, 2)
    seconds: float = 4.0
    trials: int = 4
    values: int = 1_000_000

    def pick(self, values: Iterable[Any], quick: int = 1) -> tuple[Any, ...]:
        """All values, or the first ones of them in a quick run."""
        return tuple(values)[:quick] if self.quick else tuple(values)


QUICK = Settings(quick=True, calls=(2, 2), seconds=1.0, trials=1, values=20_000)


@dataclass(frozen=True)
class Row:
    """One method at one sample count.

    spp : samples per pixel. For finite differences, of both images together.
    first_seconds : time of the first call, compilation included.
    seconds : median time of the calls after it.
    calls : how many these were; each had a seed of its own.
    peak_bytes : most memory that Dr.Jit held during the first call, caches emptied before it.
    relative_l1 : Σ|g − ref| / Σ|ref| of single derivatives, mean over the calls.
    relative_l1_of_mean : the same of the mean of all calls: what is left is bias, and noise / √calls.
    variance : of a value between calls, mean over pixels and channels, (radiance / unit)².
    efficiency : 1 / (mean squared error · seconds).
    """

    scene: str
    parameter: str
    method: str
    spp: int
    first_seconds: float
    seconds: float
    calls: int
    peak_bytes: int
    relative_l1: float
    relative_l1_of_mean: float
    variance: float
    efficiency: float


@dataclass(frozen=True)
class EqualTime:
    """One of our methods against a peer.

    time_ratio : time of the peer / time of `method`, both at `EQUAL_TIME_SPP`.
    peer_seconds, peer_relative_l1 : of the peer at that sample count.
    spp, renders : of `method`: the mean of so many renders takes about as long.
    seconds, relative_l1 : of that mean.
    efficiency_ratio : (MSE · s) of the peer / (MSE · s) of `method`, so spent; nan in old results.
    """

    scene: str
    peer: str
    time_ratio: float
    peer_seconds: float
    peer_relative_l1: float
    spp: int
    renders: int
    seconds: float
    relative_l1: float
    method: str = "direct_edge"
    efficiency_ratio: float = float("nan")


@dataclass(frozen=True)
class Outliers:
    """Absolute pixel values of derivative images of one sample per pixel, in units of their mean.

    values : how many, of pixels, channels, and renders.
    high : the 99.99th percentile.
    largest : of them all.
    reference : the largest of the reference, in units of its own mean.
    """

    scene: str
    method: str
    values: int
    high: float
    largest: float
    reference: float


# ---------------------- Measuring (in a process for each case) ----------------------


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Result, evaluated, and seconds."""
    dr.sync_thread()
    start = time.perf_counter()
    result = function()
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def median_seconds(function: Callable[[int], Any], calls: int) -> float:
    """Median time of `function(seed)`, after a call that is not counted."""
    return float(np.median([timed(lambda seed=seed: function(seed))[1] for seed in range(calls + 1)][1:]))


def at_resolution(build: Callable[[], mi.Scene], res: int) -> mi.Scene:
    """A scene of the test cases with res × res pixels."""
    before, building.RES = building.RES, res
    try:
        scene = build()
    finally:
        building.RES = before
    assert tuple(scene.sensors()[0].film().size()) == (res, res), "the scene has a film of its own"
    return scene


def bumpy_ball(rings: int, name: str, normals: bool = False, **props: Any) -> mi.Mesh:
    """About 6 · rings² edges, closed, radius about 1."""
    columns = 2 * rings
    θ, φ = np.meshgrid(np.arange(1, rings) * np.pi / rings, np.arange(columns) * np.pi / rings, indexing="ij")
    d = np.stack([np.sin(θ) * np.cos(φ), np.cos(θ), np.sin(θ) * np.sin(φ)], -1).reshape(-1, 3)
    d = np.concatenate([d, [[0, 1, 0], [0, -1, 0]]])
    p = d * (1 + 0.12 * np.sin(7 * d[:, :1] + 1) * np.sin(6 * d[:, 1:2]) * np.sin(8 * d[:, 2:]))
    i = np.arange((rings - 1) * columns).reshape(rings - 1, columns)
    a, b, c, e = i[:-1], np.roll(i, -1, 1)[:-1], i[1:], np.roll(i, -1, 1)[1:]
    top, bottom = np.full(columns, len(d) - 2), np.full(columns, len(d) - 1)
    faces = [(a, b, c), (b, e, c), (top, np.roll(i[0], -1), i[0]), (bottom, i[-1], np.roll(i[-1], -1))]
    return cases.mesh(name, p, np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in faces]), normals, **props)


class Problem:
    """The derivative of one scene, by several methods.

    methods : name -> integrator, as a dictionary. `DIFFERENCES` is always known.
    reference : the truth; None where it is set later (`mean_of`).
    """

    def __init__(
        self,
        name: str,
        scene: mi.Scene,
        motion: dict[str, Any],
        methods: dict[str, dict],
        reference: FiniteDifferences | None = None,
        step: float | None = None,
    ):
        self.name, self.scene, self.step = name, scene, step
        self.motion = Motion(scene, **motion)
        self.integrators = {key: mi.load_dict(value) for key, value in methods.items()}
        self.path = mi.load_dict({"type": "path", "max_depth": 2})
        self.reference = reference
        self.truth = None if reference is None else reference.mean.astype(np.float64)

    @staticmethod
    def of_case(name: str, methods: dict[str, dict]) -> Problem:
        """A test case, with its stored reference."""
        case = cases.case(name)
        return Problem(name, case.scene(), case.motion, methods, FiniteDifferences.read(case.reference), case.step)

    def derivative(self, method: str, spp: int, seed: int) -> mi.TensorXf:
        """One derivative image, (H, W, C)."""
        if method == DIFFERENCES:
            return self._difference(max(spp // 2, 1), seed)
        return derivative_image(self.scene, self.integrators[method], self.motion, spp=spp, seed=seed)

    def _difference(self, spp: int, seed: int) -> mi.TensorXf:
        """As the references are made (they keep the half step), but from one run."""
        images, step = [], self.step / 2
        for theta in (step, -step):
            self.motion.apply(theta)
            images.append(render_stratified(self.scene, self.path, self.scene.sensors()[0], seed, spp))
        self.motion.apply(0.0)
        return (images[0] - images[1]) / (2 * step)

    def timed(self, method: str, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """Derivative, and seconds."""
        image, seconds = timed(lambda: self.derivative(method, spp, seed))
        return np.array(image, np.float64), seconds

    def mean_of(self, method: str, spp: int, seeds: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """Mean over seeds, and its standard error."""
        images = np.array([self.timed(method, spp, seed)[0] for seed in seeds])
        return images.mean(0), images.std(0, ddof=1) / np.sqrt(len(images))

    def first(self, method: str, spp: int) -> tuple[float, int]:
        """Seconds of a first call, and peak of the memory allocated in it, in bytes."""
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        _, seconds = self.timed(method, spp, seed=0)
        return seconds, dr.detail.malloc_watermark(dr.JitBackend.LLVM)

    def relative_l1(self, image: np.ndarray) -> float:
        return float(np.abs(image - self.truth).sum() / np.abs(self.truth).sum())

    def mse(self, image: np.ndarray) -> float:
        return float(((image - self.truth) ** 2).mean())

    def facts(self) -> dict[str, Any]:
        """What is to be said of a stored reference."""
        reference = self.reference
        noise = np.sqrt(2 / np.pi) * reference.standard_error.sum() / np.abs(reference.mean).sum()
        return {"noise": float(noise), **{k: reference.settings.get(k) for k in ("step", "runs", "spp")}}

    def rows(self, spp: int, methods: Iterable[str], settings: Settings) -> list[Row]:
        """Measure methods in turn, at one sample count."""
        methods = tuple(methods)
        dr.flush_kernel_cache()
        first = {method: self.first(method, spp) for method in methods}
        images: dict[str, list[np.ndarray]] = {m: [] for m in methods}
        seconds: dict[str, list[float]] = {m: [] for m in methods}
        most, least = settings.calls
        for seed in range(1, most + 1):
            for method in methods:
                if len(images[method]) < least or sum(seconds[method]) < settings.seconds:
                    image, t = self.timed(method, spp, seed)
                    images[method].append(image)
                    seconds[method].append(t)
        return [self._row(m, spp, *first[m], np.array(images[m]), seconds[m]) for m in methods]

    def _row(self, method: str, spp: int, first: float, peak: int, images: np.ndarray, seconds: list) -> Row:
        median = float(np.median(seconds))
        say(f"{self.name}, {method}, {spp} spp: {median:.4f} s, {len(images)} calls")
        return Row(
            scene=self.name,
            parameter=str(self.motion),
            method=method,
            spp=max(spp, 2) if method == DIFFERENCES else spp,
            first_seconds=first,
            seconds=median,
            calls=len(images),
            peak_bytes=peak,
            relative_l1=float(np.mean([self.relative_l1(image) for image in images])),
            relative_l1_of_mean=self.relative_l1(images.mean(0)),
            variance=float(images.var(0, ddof=1).mean()) if len(images) > 1 else float("nan"),
            efficiency=1 / (self.mse(images) * median),
        )

    def outliers(self, method: str, settings: Settings) -> Outliers:
        """One sample per pixel: a single bright or dark one is not hidden by others."""
        renders = -(-settings.values // self.truth.size)
        values = np.abs([self.timed(method, 1, seed)[0] for seed in range(renders)])
        high, largest = np.quantile(values, (0.9999, 1)) / values.mean()
        say(f"{self.name}, {method}, outliers: {high:.4g}, {largest:.4g}")
        truth = np.abs(self.truth)
        return Outliers(self.name, method, values.size, float(high), float(largest), float(truth.max() / truth.mean()))

    def equal_time(self, ours: str, peer: str, rows: list[Row], settings: Settings) -> EqualTime:
        """As many samples of `ours`, in as few renders, as take about as long as the peer."""
        row = {r.method: r for r in rows if r.spp == EQUAL_TIME_SPP}
        budget = row[peer].seconds
        spp, renders = self.spend(ours, budget, {r.spp: r.seconds for r in rows if r.method == ours})
        times, means = [], []
        for trial in range(max(1, min(settings.trials, int(20 / budget)))):
            seeds = range(trial * renders, (trial + 1) * renders)
            images, each = zip(*(self.timed(ours, spp, seed) for seed in seeds), strict=True)
            times.append(sum(each))
            means.append(np.mean(images, axis=0))
        seconds = float(np.median(times))
        return EqualTime(
            scene=self.name,
            peer=peer,
            time_ratio=budget / row[ours].seconds,
            peer_seconds=budget,
            peer_relative_l1=row[peer].relative_l1,
            spp=spp,
            renders=renders,
            seconds=seconds,
            relative_l1=float(np.mean([self.relative_l1(mean) for mean in means])),
            method=ours,
            efficiency_ratio=1 / (row[peer].efficiency * self.mse(np.array(means)) * seconds),
        )

    def spend(self, method: str, budget: float, known: dict[int, float] | None = None) -> tuple[int, int]:
        """Samples per pixel, at most 1024, and renders that take about `budget` seconds together.

        known : seconds of a render by samples per pixel. More are measured while they fit.
        """
        known = known or {EQUAL_TIME_SPP: median_seconds(lambda seed: self.derivative(method, EQUAL_TIME_SPP, seed), 3)}
        while 2 * known[max(known)] < budget and max(known) < 1024:
            spp = 4 * max(known)
            known[spp] = timed(lambda spp=spp: self.derivative(method, spp, 0))[1]
        spp = max((spp for spp, seconds in known.items() if seconds <= budget), default=min(known))
        return spp, max(1, round(budget / known[spp]))


def say(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


# ---------------------- Report (in the process that was started) ----------------------


def header(quick: bool) -> dict[str, Any]:
    from rimlight.sys_info import sys_info

    info = sys_info()
    git = lambda *args: subprocess.run(["git", *args], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    changed = bool(git("status", "--porcelain", "--", "edge_sampling", "plugins", "tests/cases.py"))
    return {
        "processor": info["processor"],
        "threads": info["threads"],
        "llvm": (info["llvm"] or {}).get("version"),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "rimlight": rimlight.__version__,
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + (" with changes" if changed else ""),
        "date": datetime.date.today().isoformat(),
        "quick": quick,
    }


def machine(headers: list[dict[str, Any]]) -> list[str]:
    """Where cases were measured, with the commits at which they were."""
    commits: dict[str, list[str]] = {}
    for h in headers:
        what = (
            f"{h['processor']}, {h['threads']} threads; LLVM {h['llvm']}, Mitsuba {h['mitsuba']}, Dr.Jit {h['drjit']}"
        )
        rough = " **A quick run: its numbers are rough.**" if h["quick"] else ""
        commits.setdefault(f"{what}; Rimlight {h['rimlight']}, {h['date']}.{rough}", []).append(h["commit"])
    return [f"{what} Commits: {', '.join(dict.fromkeys(found))}." for what, found in commits.items()]


def table(columns: dict[str, Callable[[Any], Any]], rows: list[Any]) -> list[str]:
    """Lines of a Markdown table. columns : heading -> value of a row. Headings that start with "<" are left-aligned."""
    lines = [
        "| " + " | ".join(c.lstrip("<") for c in columns) + " |",
        "|" + "|".join("---" if c[0] == "<" else "---:" for c in columns) + "|",
    ]
    return ["", *lines, *("| " + " | ".join(str(f(r)) for f in columns.values()) + " |" for r in rows), ""]


def duration(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def percent(x: float) -> str:
    return f"{100 * x:.3g} %"


def code(method: str) -> str:
    return method if " " in method else f"`{method}`"


def equal_time_table(found: list[dict[str, Any]]) -> list[str]:
    known = [EqualTime(**e) for e in found]
    columns: dict[str, Callable[[EqualTime], Any]] = {
        "<scene": lambda e: e.scene,
        "<peer": lambda e: code(e.peer),
        "time ratio": lambda e: f"{e.time_ratio:.0f}",
        "peer: time": lambda e: duration(e.peer_seconds),
        "peer: rel. L1": lambda e: percent(e.peer_relative_l1),
        "<ours": lambda e: code(e.method) + (f", {e.renders} × {e.spp} spp" if e.renders > 1 else f", {e.spp} spp"),
        "time": lambda e: duration(e.seconds),
        "rel. L1": lambda e: percent(e.relative_l1),
    }
    if all(np.isfinite(e.efficiency_ratio) for e in known):
        columns["efficiency ratio"] = lambda e: f"{e.efficiency_ratio:.3g}"
    return table(columns, known)


def outliers_text(found: Iterable[dict[str, Any]]) -> list[str]:
    """found : results of cases; those without outliers are left out."""
    known = [Outliers(**case["outliers"]) for case in found if "outliers" in case]
    if not known:
        return []
    return [
        "Rare bright and dark pixels: absolute values of derivative images at 1 sample per pixel, over their mean. "
        "Where few pixels have a derivative at all, these are large in the reference, too; beyond that, it is noise.",
        *table(
            {
                "<scene": lambda o: o.scene,
                "<method": lambda o: code(o.method),
                "pixel values": lambda o: f"{o.values:.2g}",
                "99.99th percentile / mean": lambda o: f"{o.high:.3g}",
                "largest / mean": lambda o: f"{o.largest:.3g}",
                "of the reference": lambda o: f"{o.reference:.3g}",
            },
            known,
        ),
    ]


def rows_table(found: list[dict[str, Any]]) -> list[str]:
    rows = [Row(**r) for r in found]
    order = list(dict.fromkeys(r.method for r in rows))
    return table(
        {
            "<method": lambda r: code(r.method),
            "spp": lambda r: r.spp,
            "first call": lambda r: duration(r.first_seconds),
            "median": lambda r: duration(r.seconds),
            "calls": lambda r: r.calls,
            "memory": lambda r: f"{r.peak_bytes / 2**20:.1f} MiB",
            "rel. L1": lambda r: percent(r.relative_l1),
            "of the mean": lambda r: percent(r.relative_l1_of_mean),
            "variance": lambda r: f"{r.variance:.2e}" if r.calls > 1 else "–",
            "efficiency": lambda r: f"{r.efficiency:.3g}",
        },
        sorted(rows, key=lambda r: order.index(r.method)),
    )


def case_text(name: str, case: dict[str, Any], note: str) -> list[str]:
    """A case with a stored reference: what it is, and all that was measured."""
    reference = case["reference"]
    return [
        f"**{name}** ({case['rows'][0]['parameter']}). {note}",
        f"Reference: finite differences, half of step {reference['step']}, {reference['runs']} runs of "
        f"{reference['spp']} spp; its own noise is {percent(reference['noise'])}.",
        *rows_table(case["rows"]),
    ]


def figure(columns: int, width: float = 4.0, height: float = 3.6) -> tuple[Any, list[Any]]:
    """A figure and its axes, in a row."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width * columns, height), dpi=120, layout="constrained")
    row = made.subplots(1, columns, squeeze=False)[0]
    for axes in row:
        axes.grid(alpha=0.25, which="both")
        axes.spines[["top", "right"]].set_visible(False)
    return made, list(row)


def plain_ticks(axes: Any) -> None:
    """Numbers at 1 and 3 of each power of ten of logarithmic axes, unless there are many of them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        if axis.get_scale() == "log" and high / low < 3e3:
            axis.set_major_locator(LogLocator(subs=(1, 3)))
            axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            axis.set_minor_formatter(NullFormatter())


def save(made: Any, path: Path) -> None:
    for axes in made.axes:
        plain_ticks(axes)
    made.savefig(path)


def plot_errors(found: dict[str, dict[str, Any]], path: Path) -> None:
    """Error over time, log-log, for cases with rows and a reference."""
    if not found:
        return
    made, row = figure(len(found))
    for axes, (name, case) in zip(row, found.items(), strict=True):
        methods = list(dict.fromkeys(r["method"] for r in case["rows"]))
        for method, marker in zip(methods, "osD^v", strict=False):
            rows = [r for r in case["rows"] if r["method"] == method]
            x, y = ([r[key] for r in rows] for key in ("seconds", "relative_l1"))
            axes.loglog(x, y, marker=marker, markersize=5, linewidth=1.3, label=method)
        noise = case["reference"]["noise"]
        axes.axhline(noise, color="0.6", linewidth=1, linestyle=":", label="noise of the reference")
        axes.set(title=name, xlabel="time of a derivative image (s)", ylabel="relative L1 error")
    labelled = {label: line for axes in row for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    made.legend(labelled.values(), labelled, loc="outside lower center", ncols=len(labelled), fontsize=8)
    spp = sorted({r["spp"] for c in found.values() for r in c["rows"]})
    made.suptitle(f"32 × 32 pixels, {spp[0]} to {spp[-1]} samples per pixel; lower left is better", fontsize=9)
    save(made, path)


@dataclass(frozen=True)
class Benchmark:
    """A benchmark.

    cases : name -> what measures it, in a process of its own: settings and output folder -> what JSON can hold.
    report : results by case -> lines of Markdown.
    plot : results by case, output folder -> None.
    needs : cases that need a file that not everybody has.
    """

    name: str
    cases: dict[str, Callable[[Settings, Path], dict[str, Any]]]
    report: Callable[[dict[str, Any]], list[str]]
    plot: Callable[[dict[str, Any], Path], None] = lambda found, folder: None
    needs: dict[str, Path] = field(default_factory=dict)
    settings: Settings = Settings()


def main(benchmark: Benchmark) -> None:
    """The command line of a benchmark. Writes NAME.json, NAME.md and pictures, anew after each case."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="few calls, to see that it works")
    parser.add_argument("--only", nargs="*", choices=benchmark.cases, help="measure these cases, and keep the others")
    parser.add_argument("--report", action="store_true", help="measure nothing, write the report again")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "performance", help="default: docs/performance")
    parser.add_argument("--case", choices=benchmark.cases, help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.case:
        mi.set_variant("llvm_ad_rgb")
        mi.set_log_level(mi.LogLevel.Error)
        settings = QUICK if args.quick else benchmark.settings
        print(json.dumps(benchmark.cases[args.case](settings, args.out), default=_plain))
        return
    file = args.out / f"{benchmark.name}.json"
    keep = file.exists() and (args.only is not None or args.report)
    found = json.loads(file.read_text())["cases"] if keep else {}
    for name in () if args.report else args.only or benchmark.cases:
        if name in benchmark.needs and not benchmark.needs[name].exists():
            print(f"Skipped {name}: {benchmark.needs[name].name} is not here", file=sys.stderr)
            continue
        found[name] = {"header": header(args.quick), **_in_a_process(name, args)}
        file.write_text(json.dumps({"cases": found}, indent=1) + "\n", encoding="utf-8")
    found = {name: found[name] for name in benchmark.cases if name in found}
    lines = "\n".join([*machine([case["header"] for case in found.values()]), "", *benchmark.report(found)])
    (args.out / f"{benchmark.name}.md").write_text(lines.rstrip() + "\n", encoding="utf-8")
    benchmark.plot(found, args.out)
    print(f"Written to {args.out}")


def _in_a_process(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Measure a case with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, sys.argv[0], "--case", name, "--out", str(args.out)]
        command += ["--quick"] if args.quick else []
        environment = {**os.environ, "DRJIT_CACHE_DIR": cache}
        output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    return json.loads(output.splitlines()[-1])


def _plain(value: Any) -> Any:
    return asdict(value) if hasattr(value, "__dataclass_fields__") else value.item()
