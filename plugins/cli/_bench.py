"""`rimlight bench`: speed against error on this machine, beside Mitsuba's own integrators."""

from __future__ import annotations

import datetime
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight import scenes
from rimlight.checks import FiniteDifferences, Motion, derivative_image, finite_differences
from rimlight.exr import replacing
from rimlight.loading import InputError, use_variant
from rimlight.sys_info import sys_info

from . import _loading
from ._loading import at_least
from ._shared import progress, writing

#: Width and height of all images, pixels.
RES = 32

#: Runs and samples per pixel of the finite differences.
RUNS, REFERENCE_SPP = 8, 8192

#: Fewest and most calls of a method after the first.
CALLS = 3, 64

#: Rows of ours: at its defaults, and with `integrator.balance` before the first call, outside of the clock.
OURS, BALANCED = "direct_edge", "direct_edge, balanced"

#: Normal quantile of a confidence interval of 95 %.
CONFIDENCE = 1.96


@dataclass(frozen=True)
class Case:
    """A derivative of a shipped scene.

    motion, step : of the finite differences. tuned : options of Mitsuba's integrator that help it in this scene.
    """

    scene: str
    motion: dict[str, Any]
    step: float
    tuned: dict[str, Any]

    def methods(self) -> dict[str, dict[str, Any]]:
        """Integrators by the names of their rows: ours and Mitsuba's, at their defaults and tuned."""
        return {
            OURS: {"type": "direct_edge"},
            BALANCED: {"type": "direct_edge"},
            "direct_projective": {"type": "direct_projective"},
            "direct_projective, tuned": {"type": "direct_projective", **self.tuned},
        }


CASES = (
    Case("cube", {"key": "cube.vertex_positions", "direction": [0, 0, 1]}, 5e-3, {"sppi": 0}),
    Case(
        "two_triangles",
        {"key": "green.vertex_positions", "direction": [1, 0, 0], "vertices": [0]},
        2e-3,
        {"guiding": "none"},
    ),
    Case("shadow_blocker", {"key": "blocker.vertex_positions", "direction": [1, 0, 0]}, 2e-3, {"guiding": "grid"}),
    Case("objects", {"key": "torus.vertex_positions", "rotate": [0, 1, 0]}, 2e-3, {"guiding": "none"}),
)


@dataclass(frozen=True)
class Row:
    """What was measured of one method in one scene.

    calls : after the first. first, seconds : time of the first call, and the median of the others.
    error, interval : relative L1 error of single derivatives, mean and half of its interval of 95 % confidence.
    of_mean : relative L1 error of the mean of all calls: bias, and the rest of the noise.
    noise : relative L1 error that the noise of the reference alone would cause.
    efficiency : 1 / (MSE · s), with the mean squared error MSE as variance and squared bias of a derivative.
    """

    scene: str
    method: str
    options: dict[str, Any]
    calls: int
    first: float
    seconds: float
    error: float
    interval: float
    of_mean: float
    noise: float
    efficiency: float


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Compare speed and error with Mitsuba's own integrators on this machine. Takes about five minutes."""

    out: Path = Path("bench.json")
    """JSON file to write, to share or to compare. The table is printed."""
    spp: int = 16
    """Samples per pixel of a derivative."""
    seconds: float = 6
    """Time for the calls of one method in one scene."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""

    def run(self) -> int:
        at_least(1, spp=self.spp)
        if not self.seconds > 0:
            raise InputError(f"--seconds must be > 0, got {self.seconds:g}")
        _loading.check_output(self.out, folder=False)
        use_variant(self.variant)
        level = mi.log_level()
        mi.set_log_level(mi.LogLevel.Error)  # the warnings of the peers are not about this table
        try:
            rows = [row for case in CASES for row in self._measure(case)]
        finally:
            mi.set_log_level(level)
        print("\n".join(table(rows)))
        facts = {
            "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
            "machine": sys_info(),
            "settings": {
                "variant": self.variant,
                "spp": self.spp,
                "res": RES,
                "runs": RUNS,
                "reference_spp": REFERENCE_SPP,
            },
            "rows": [asdict(row) for row in rows],
        }
        _loading.make_folder(self.out.parent)
        with writing(), replacing(self.out) as temporary:
            temporary.write_text(json.dumps(facts, indent=1) + "\n", "utf-8")
        return 0

    def _measure(self, case: Case) -> list[Row]:
        scene = mi.load_file(str(scenes.path(case.scene)), res=RES)
        motion = Motion(scene, **case.motion)
        reference = finite_differences(
            scene, motion, step=case.step, runs=RUNS, spp=REFERENCE_SPP, progress=sys.stderr.isatty()
        )
        rows = []
        with progress(list(case.methods().items()), case.scene) as bar:
            for name, options in bar:
                integrator = mi.load_dict(options)
                if name == BALANCED:
                    balance(integrator, scene, motion, self.spp)
                images, times = [], []
                while len(times) < 1 + CALLS[0] or (sum(times[1:]) < self.seconds and len(times) <= CALLS[1]):
                    start = time.perf_counter()
                    image = derivative_image(scene, integrator, motion, spp=self.spp, seed=len(times))
                    images.append(np.array(image, np.float64))
                    times.append(time.perf_counter() - start)
                rows.append(row(case.scene, name, options, np.array(images), times, reference))
        return rows


def balance(integrator: Any, scene: mi.Scene, motion: Motion, spp: int) -> None:
    """Divide the samples among the terms of a derivative along this motion."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    dr.forward(theta, dr.ADFlag.ClearEdges)
    integrator.balance(scene, motion.params, spp=spp)
    motion.restore()


def row(
    scene: str,
    method: str,
    options: dict[str, Any],
    images: np.ndarray,
    times: list[float],
    reference: FiniteDifferences,
) -> Row:
    """images : derivatives of all calls, (N, H, W, C). times : of each, seconds."""
    size = np.abs(reference.mean).sum()
    errors = np.abs(images - reference.mean).sum((1, 2, 3)) / size
    variance, mean = images.var(0, ddof=1).mean(), images.mean(0)
    # What the noise of both sides adds to the square of the bias is known on average
    noise = np.square(reference.standard_error).mean() + variance / len(images)
    squared = variance + max(np.square(mean - reference.mean).mean() - noise, 0)
    seconds = float(np.median(times[1:]))
    return Row(
        scene=scene,
        method=method,
        options=options,
        calls=len(times) - 1,
        first=times[0],
        seconds=seconds,
        error=float(errors.mean()),
        interval=float(CONFIDENCE * errors.std(ddof=1) / np.sqrt(len(errors))),
        of_mean=float(np.abs(mean - reference.mean).sum() / size),
        noise=float(np.sqrt(2 / np.pi) * reference.standard_error.sum() / size),
        efficiency=float(1 / (squared * seconds)),
    )


def table(rows: list[Row]) -> list[str]:
    """Lines of Markdown."""
    columns = (
        "scene",
        "method",
        "first call, s",
        "median, s",
        "rel. L1",
        "of the mean",
        "of the reference",
        "efficiency",
    )
    lines = [f"| {' | '.join(columns)} |", f"|---|---|{'---:|' * (len(columns) - 2)}"]
    ours = {r.scene: r.efficiency for r in rows if r.method == OURS}
    for r in rows:
        tuned = ", ".join(f"{k} {v}" for k, v in r.options.items() if k != "type")
        name = r.method + (f" ({tuned})" if tuned else "")
        error, gain = f"{r.error:.1%} ± {r.interval:.1%}", r.efficiency / ours[r.scene]
        cells = (
            r.scene,
            name,
            f"{r.first:.2f}",
            f"{r.seconds:.4f}",
            error,
            f"{r.of_mean:.1%}",
            f"{r.noise:.1%}",
            f"{gain:.2g}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines
