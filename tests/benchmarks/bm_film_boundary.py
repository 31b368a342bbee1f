"""Speed against error of derivative images:  python tests/benchmarks/bm_film_boundary.py [--quick] [--out FOLDER]

Compares `direct_edge` with Mitsuba's projective integrators and with finite differences, on two scenes of 32 × 32
pixels, in forward mode. The truth is the stored reference of the test case. Every case runs in a process of its own,
with an empty kernel cache on disk; in it, all methods run in turn. Writes film_boundary.json, film_boundary.md
(tables) and film_boundary.png (plot). About ten minutes; with --quick about one.
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
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import rimlight  # first: it chooses the LLVM library

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402

from rimlight.edge_sampling import FiniteDifferences, Motion, derivative_image  # noqa: E402
from rimlight.edge_sampling.finite_differences import render_stratified  # noqa: E402

CASES = ("two_triangles_green", "cube_depth")
METHODS = ("direct_edge", "direct_projective", "prb_projective", "finite differences")
PEERS = METHODS[1:3]
SPP = (1, 4, 16, 64, 256)

#: Where both are compared at equal time: samples per pixel of the peer.
EQUAL_TIME_SPP = 4

NOTES = {
    "two_triangles_green": "One vertex of a triangle moves before another triangle, under an area light: besides the "
    "outlines, a soft shadow moves.",
    "cube_depth": "A cube moves away from the camera under a constant environment: the film boundary is the only one.",
}


@dataclass(frozen=True)
class Settings:
    """How long to measure.

    spp : samples per pixel of a derivative.
    calls : at most and at least so many timed calls of a method, each with a seed of its own.
    seconds : no further call of a method after so long, but for the least.
    trials : of the comparison at equal time.
    """

    spp: tuple[int, ...] = SPP
    calls: tuple[int, int] = (32, 6)
    seconds: float = 10.0
    trials: int = 4


QUICK = Settings(spp=(4, 16), calls=(3, 2), seconds=1.0, trials=1)


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
    """`direct_edge` against a peer.

    time_ratio : time of the peer / time of `direct_edge`, both at `EQUAL_TIME_SPP`.
    peer_seconds, peer_relative_l1 : of the peer at that sample count.
    spp, renders : of `direct_edge`: the mean of so many renders takes about as long.
    seconds, relative_l1 : of that mean.
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


# ---------------------- Measuring (in a process for each case) ----------------------


class Bench:
    """The derivative of one test case, by every method."""

    def __init__(self, name: str):
        import cases

        self.case = cases.case(name)
        self.reference = FiniteDifferences.read(self.case.reference)
        self.scene = self.case.scene()
        self.motion = Motion(self.scene, **self.case.motion)
        options = {"direct_edge": {}, "direct_projective": {}, "prb_projective": {"max_depth": 2}}
        self.integrators = {name: mi.load_dict({"type": name, **more}) for name, more in options.items()}
        self.path = mi.load_dict({"type": "path", "max_depth": 2})

    def derivative(self, method: str, spp: int, seed: int) -> mi.TensorXf:
        """One derivative image, (H, W, C), evaluated."""
        if method == "finite differences":
            image = self._difference(max(spp // 2, 1), seed)
        else:
            image = derivative_image(self.scene, self.integrators[method], self.motion, spp=spp, seed=seed)
        dr.eval(image)
        dr.sync_thread()
        return image

    def _difference(self, spp: int, seed: int) -> mi.TensorXf:
        """As the references are made (they keep the half step), but from one run."""
        images, step = [], self.case.step / 2
        for theta in (step, -step):
            self.motion.apply(theta)
            images.append(render_stratified(self.scene, self.path, self.scene.sensors()[0], seed, spp))
        self.motion.apply(0.0)
        return (images[0] - images[1]) / (2 * step)

    def timed(self, method: str, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """Derivative, and seconds."""
        start = time.perf_counter()
        image = self.derivative(method, spp, seed)
        seconds = time.perf_counter() - start
        return np.array(image, np.float64), seconds

    def first(self, method: str, spp: int) -> tuple[float, int]:
        """Seconds of a first call, and peak of the memory allocated in it, in bytes."""
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        _, seconds = self.timed(method, spp, seed=0)
        return seconds, dr.detail.malloc_watermark(dr.JitBackend.LLVM)

    def relative_l1(self, image: np.ndarray) -> float:
        return float(np.abs(image - self.reference.mean).sum() / np.abs(self.reference.mean).sum())


def run_case(name: str, settings: Settings) -> dict[str, Any]:
    """Measure all methods on one case."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    bench = Bench(name)
    rows = [row for spp in settings.spp for row in _rows(bench, spp, settings)]
    equal_time = (
        [_equal_time(bench, peer, rows, settings.trials) for peer in PEERS] if EQUAL_TIME_SPP in settings.spp else []
    )
    reference = bench.reference
    return {
        "rows": [asdict(r) for r in rows],
        "equal_time": [asdict(e) for e in equal_time],
        "reference": {
            "noise": float(np.sqrt(2 / np.pi) * reference.standard_error.sum() / np.abs(reference.mean).sum()),
            **{k: reference.settings.get(k) for k in ("step", "runs", "spp")},
        },
    }


def _rows(bench: Bench, spp: int, settings: Settings) -> list[Row]:
    dr.flush_kernel_cache()
    first = {method: bench.first(method, spp) for method in METHODS}
    images: dict[str, list[np.ndarray]] = {m: [] for m in METHODS}
    seconds: dict[str, list[float]] = {m: [] for m in METHODS}
    most, least = settings.calls
    for seed in range(1, most + 1):
        for method in METHODS:
            if len(images[method]) < least or sum(seconds[method]) < settings.seconds:
                image, t = bench.timed(method, spp, seed)
                images[method].append(image)
                seconds[method].append(t)
    return [_row(bench, m, spp, *first[m], images[m], seconds[m]) for m in METHODS]


def _row(bench: Bench, method: str, spp: int, first: float, peak: int, images: list, seconds: list) -> Row:
    stack = np.array(images)
    median = float(np.median(seconds))
    mse = float(((stack - bench.reference.mean) ** 2).mean())
    print(f"  {bench.case.name}, {method}, {spp} spp: {median:.4f} s, {len(images)} calls", file=sys.stderr)
    return Row(
        scene=bench.case.name,
        parameter=str(bench.motion),
        method=method,
        spp=max(spp, 2) if method == "finite differences" else spp,
        first_seconds=first,
        seconds=median,
        calls=len(images),
        peak_bytes=peak,
        relative_l1=float(np.mean([bench.relative_l1(image) for image in images])),
        relative_l1_of_mean=bench.relative_l1(stack.mean(0)),
        variance=float(stack.var(0, ddof=1).mean()),
        efficiency=1 / (mse * median),
    )


def _equal_time(bench: Bench, peer: str, rows: list[Row], trials: int) -> EqualTime:
    """Double the samples of `direct_edge` up to 1024, and then its renders, until it takes as long as the peer."""
    row = {r.method: r for r in rows if r.spp == EQUAL_TIME_SPP}
    budget, spp = row[peer].seconds, EQUAL_TIME_SPP
    median = lambda: float(np.median([bench.timed("direct_edge", spp, seed)[1] for seed in range(6)][1:]))
    seconds = median()
    while 2 * seconds < budget and spp < 1024:
        spp *= 2
        seconds = median()
    renders = max(1, round(budget / seconds))
    times, errors = [], []
    for trial in range(trials):
        images, each = zip(*(bench.timed("direct_edge", spp, trial * renders + i) for i in range(renders)), strict=True)
        times.append(sum(each))
        errors.append(bench.relative_l1(np.mean(images, axis=0)))
    return EqualTime(
        scene=bench.case.name,
        peer=peer,
        time_ratio=budget / row["direct_edge"].seconds,
        peer_seconds=budget,
        peer_relative_l1=row[peer].relative_l1,
        spp=spp,
        renders=renders,
        seconds=float(np.median(times)),
        relative_l1=float(np.mean(errors)),
    )


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


def table(columns: dict[str, Callable[[Any], Any]], rows: list[Any]) -> list[str]:
    """Lines of a Markdown table. columns : heading -> value of a row. Headings that start with "<" are left-aligned."""
    lines = [
        "| " + " | ".join(c.lstrip("<") for c in columns) + " |",
        "|" + "|".join("---" if c[0] == "<" else "---:" for c in columns) + "|",
    ]
    return lines + ["| " + " | ".join(str(f(r)) for f in columns.values()) + " |" for r in rows]


def _time(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def markdown(result: dict[str, Any]) -> str:
    h = result["header"]
    machine = f"{h['processor']}, {h['threads']} threads; LLVM {h['llvm']}, Mitsuba {h['mitsuba']}, Dr.Jit {h['drjit']}"
    lines = [
        f"{machine}; Rimlight {h['rimlight']}, commit {h['commit']}; {h['date']}."
        + (" **A quick run: its numbers are rough.**" if h["quick"] else ""),
        "",
        f"At {EQUAL_TIME_SPP} samples per pixel, and at the time that the peer needs for them:",
        "",
        *table(
            {
                "<scene": lambda e: e.scene,
                "<peer": lambda e: f"`{e.peer}`",
                "time ratio": lambda e: f"{e.time_ratio:.0f}",
                "peer: time": lambda e: _time(e.peer_seconds),
                "peer: rel. L1": lambda e: f"{e.peer_relative_l1:.2%}",
                "`direct_edge`: samples": lambda e: f"{e.renders} × {e.spp} spp" if e.renders > 1 else f"{e.spp} spp",
                "time": lambda e: _time(e.seconds),
                "rel. L1": lambda e: f"{e.relative_l1:.2%}",
            },
            [EqualTime(**e) for c in result["cases"].values() for e in c["equal_time"]],
        ),
    ]
    for name, case in result["cases"].items():
        rows, reference = [Row(**r) for r in case["rows"]], case["reference"]
        lines += [
            "",
            f"**{name}** ({rows[0].parameter}). {NOTES[name]}",
            f"Reference: finite differences, half of step {reference['step']}, {reference['runs']} runs of "
            f"{reference['spp']} spp; its own noise is {reference['noise']:.2%}.",
            "",
            *table(
                {
                    "<method": lambda r: r.method if " " in r.method else f"`{r.method}`",
                    "spp": lambda r: r.spp,
                    "first call": lambda r: _time(r.first_seconds),
                    "median": lambda r: _time(r.seconds),
                    "calls": lambda r: r.calls,
                    "memory": lambda r: f"{r.peak_bytes / 2**20:.1f} MiB",
                    "rel. L1": lambda r: f"{r.relative_l1:.2%}",
                    "of the mean": lambda r: f"{r.relative_l1_of_mean:.2%}",
                    "variance": lambda r: f"{r.variance:.2e}",
                    "efficiency": lambda r: f"{r.efficiency:.3g}",
                },
                sorted(rows, key=lambda r: METHODS.index(r.method)),
            ),
        ]
    return "\n".join(lines) + "\n"


def plot(result: dict[str, Any], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), dpi=130, layout="constrained")
    row = figure.subplots(1, len(result["cases"]), squeeze=False)[0]
    for axes, (name, case) in zip(row, result["cases"].items(), strict=True):
        for method, marker in zip(METHODS, "osD^", strict=True):
            rows = [r for r in case["rows"] if r["method"] == method]
            axes.loglog(
                [r["seconds"] for r in rows],
                [r["relative_l1"] for r in rows],
                marker=marker,
                markersize=5,
                linewidth=1.3,
                label=method,
            )
        axes.axhline(
            case["reference"]["noise"], color="0.6", linewidth=1, linestyle=":", label="noise of the reference"
        )
        axes.set(title=name, xlabel="median time of a derivative image (s)", ylabel="relative L1 error")
        axes.grid(alpha=0.25, which="both")
        axes.spines[["top", "right"]].set_visible(False)
    row[0].legend(fontsize=8)
    spp = sorted({r["spp"] for c in result["cases"].values() for r in c["rows"] if r["method"] == METHODS[0]})
    figure.suptitle(
        f"32 × 32 pixels, {', '.join(map(str, spp))} samples per pixel along each curve; lower left is better",
        fontsize=9,
    )
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("--quick", action="store_true", help="few calls, to see that it works")
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "docs" / "performance",
        help="folder of the results (default: docs/performance)",
    )
    parser.add_argument("--case", choices=CASES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.case:
        print(json.dumps(run_case(args.case, QUICK if args.quick else Settings())))
        return
    args.out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"header": header(args.quick), "cases": {}}
    for name in CASES:
        with tempfile.TemporaryDirectory() as cache:
            command = [sys.executable, __file__, "--case", name, *(["--quick"] if args.quick else [])]
            output = subprocess.run(
                command, env={**os.environ, "DRJIT_CACHE_DIR": cache}, stdout=subprocess.PIPE, text=True, check=True
            ).stdout
        result["cases"][name] = json.loads(output.splitlines()[-1])
    (args.out / "film_boundary.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (args.out / "film_boundary.md").write_text(markdown(result), encoding="utf-8")
    plot(result, args.out / "film_boundary.png")
    print(f"Written to {args.out}")


if __name__ == "__main__":
    main()
