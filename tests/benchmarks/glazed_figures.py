"""Errors of figures of several colours under one glaze, as a table of the documentation:

python tests/benchmarks/glazed_figures.py [--size 64] [--only "bowl, gray-plastic"]
"""

from __future__ import annotations

import argparse

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
# isort: on

from rimlight.inverse.photometric_stereo import least_squares, reconstruction, simulation
from rimlight.inverse.photometric_stereo.dataset import angles

BLUE, WHITE, SKIN = "glaze:0.03,0.04,0.18", "glaze:0.75,0.72,0.68", "glaze:0.7,0.4,0.3"

#: Name -> options of the simulation.
FIGURES = {
    "folds, two colours": {"shape": "folds", "bsdf": f"{BLUE}|{WHITE}", "seed": 11},
    "folds, three colours": {"shape": "folds", "bsdf": f"{BLUE}|{WHITE}|{SKIN}", "seed": 12},
    "bowl, gray-plastic": {"shape": "bowl", "bsdf": "gray-plastic", "seed": 11},
}


def row(name: str, size: int) -> str:
    options = simulation.Options(**FIGURES[name], size=size, lights=32, spp=64, noise=0.01)
    data, _ = simulation.simulate(options, progress=False)
    starts = [least_squares.normals(data.luminance, data.lights, method) for method in least_squares.METHODS]
    errors = " | ".join(f"{angles(normals, data.truth).mean():.2f}" for normals in starts)
    chosen = reconstruction.Options(brightness=0, max_depth=4, resolutions=(0.5, 1.0), iterations=(6, 4))
    found = reconstruction.reconstruct(data, chosen, progress=False)
    off = " | ".join(f"{100 * found.left_out[which]:.1f}" for which in ("start", "result"))
    halves = " | ".join(f"{found.halves[which]:.1f}" for which in ("start", "result"))
    kind = ("several" if found.kind.several else "one") + (", under a coat" if found.kind.coat else "")
    kind = "the start" if found.verdict == "start" else kind
    return f"| {name} | {errors} | **{found.error:.2f}** | {off} | {halves} | {kind} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=64, help="width and height of the images")
    parser.add_argument("--only", nargs="*", default=list(FIGURES), choices=list(FIGURES))
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    columns = (
        *least_squares.METHODS,
        "result",
        "left out: start",
        "left out: result",
        "halves: start",
        "halves: result",
    )
    print(f"| | {' | '.join(columns)} | chosen |")
    print("|---|" + "---:|" * len(columns) + "---|")
    for name in args.only:
        print(row(name, args.size), flush=True)


if __name__ == "__main__":
    main()
