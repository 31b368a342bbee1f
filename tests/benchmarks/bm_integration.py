"""Solvers for depth from normals:  python tests/benchmarks/bm_integration.py [--quick] [--only ...]

The same equations, of a wavy surface that fills the picture, and of the bear of DiLiGenT, are solved by ours, by the
factorisation of SciPy, by cholespy, and by PyAMG, where that is installed. Seconds of the processor, so that what else
the machine does counts less.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
import scipy.sparse as sp
from _bench import ROOT, Benchmark, Settings, duration, main, say, table
from scipy.sparse.linalg import splu

from rimlight.inverse.photometric_stereo import integration, laplacian

BEAR = ROOT.parent / "shared" / "data" / "diligent" / "bear_depth"
SIZES = (128, 256, 512, 1024, 2048)

#: Most unknowns for which a peer is measured, so that the benchmark takes minutes.
MOST = {"factorised": 5_000_000, "cholespy": 1_100_000, "ruge_stuben": 5_000_000}

#: Most unknowns for which bilateral weights are iterated to the end.
MOST_BILATERAL = 300_000


def waves(size: int) -> tuple[np.ndarray, np.ndarray, None]:
    v, u = np.mgrid[:size, :size] / size
    x_slope = 0.6 * np.cos(3 * u) * np.cos(2 * v) + 0.3 * np.cos(50 * u)
    normals = np.stack([-x_slope, 0.4 * np.sin(3 * u) * np.sin(2 * v), np.ones_like(u)], 2)
    return normals, np.ones((size, size), bool), None


def bear() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    read = lambda name: np.array(mi.Bitmap(str(BEAR / name)))
    mask = read("mask.png").reshape(512, 612, -1)[..., 0] > 0
    return read("normal_map.png")[..., :3] / 65535.0 * 2 - 1, mask, np.loadtxt(BEAR / "K.txt")


def equations(normals, mask, camera) -> tuple[sp.csr_matrix, np.ndarray]:
    """What `integrate` asks `laplacian.solve` to solve."""
    kept: list[Any] = []
    solve = laplacian.solve
    laplacian.solve = lambda A, b, start: (kept.extend((A, b)), start)[1]
    try:
        integration.integrate(normals, mask, camera=camera)
    finally:
        laplacian.solve = solve
    return tuple(kept)


def factorised(A, b):
    symmetric = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0, "options": {"SymmetricMode": True}}
    return splu(A.tocsc(), **symmetric).solve(b)


def cholespy(A, b):
    from cholespy import CholeskySolverD, MatrixType

    x = np.zeros_like(b)
    CholeskySolverD(len(b), A.indptr, A.indices, A.data, MatrixType.CSR).solve(b, x)
    return x


def ruge_stuben(A, b):
    from pyamg import ruge_stuben_solver

    return ruge_stuben_solver(A, max_coarse=500).solve(b, tol=1e-8, accel="cg")


def seconds(function: Callable[[], Any], calls: int) -> float:
    """Least processor time of some calls."""
    found = []
    for _ in range(calls):
        start = time.process_time()
        function()
        found.append(time.process_time() - start)
    return min(found)


def measure(make: Callable[[], tuple], settings: Settings, _: Path) -> dict[str, Any]:
    normals, mask, camera = make()
    A, b = equations(normals, mask, camera)
    calls = 1 if settings.quick or len(b) > 300_000 else 3
    row: dict[str, Any] = {"pixels": len(b)}
    row["ours"] = seconds(lambda: laplacian.solve(A, b, 0 * b), calls)
    row["mebibytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    row["integrate"] = seconds(lambda: integration.integrate(normals, mask, camera=camera), calls)
    if len(b) <= MOST_BILATERAL and not settings.quick:
        row["bilateral"] = seconds(lambda: integration.integrate(normals, mask, camera=camera, bilateral=2), 1)
    for peer in (ruge_stuben, cholespy, factorised):
        if len(b) <= MOST[peer.__name__]:
            try:
                row[peer.__name__] = seconds(partial(peer, A, b), calls)
            except ImportError:
                say(f"{peer.__name__} is not installed")
    row["mebibytes_factorised"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    say(str(row))
    return {"row": row}


def report(found: dict[str, Any]) -> list[str]:
    time_of = lambda key: lambda r: duration(r[key]) if key in r else ""
    columns = {
        "<surface": lambda r: r["name"],
        "pixels": lambda r: f"{r['pixels']:,}",
        "ours": time_of("ours"),
        "factorisation": time_of("factorised"),
        "cholespy": time_of("cholespy"),
        "Ruge-Stüben": time_of("ruge_stuben"),
        "`integrate`": time_of("integrate"),
        "bilateral": time_of("bilateral"),
        "memory, ours": lambda r: f"{r['mebibytes']} MiB",
        "memory, factorisation": lambda r: f"{r['mebibytes_factorised']} MiB",
    }
    return table(columns, [{"name": name, **case["row"]} for name, case in found.items()])


if __name__ == "__main__":
    main(
        Benchmark(
            name="integration",
            cases={
                **{f"{s} × {s}": partial(measure, partial(waves, s)) for s in SIZES[:3]},
                "bear": partial(measure, bear),
                **{f"{s} × {s}": partial(measure, partial(waves, s)) for s in SIZES[3:]},
            },
            report=report,
            needs={"bear": BEAR},
        )
    )
