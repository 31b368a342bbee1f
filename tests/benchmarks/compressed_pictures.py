"""What strong compression costs: errors of the start and of the result, of pictures that are JPEG files.

python tests/benchmarks/compressed_pictures.py [--quality 10] [--clipped 0.05] [--only 0 1]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
# isort: on

sys.path.insert(0, str(Path(__file__).parents[1]))
from photometric import write_jpeg

from rimlight import ggx
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import compression, simulation, start
from rimlight.inverse.photometric_stereo.dataset import angles

BLUE, WHITE, SKIN = "glaze:0.03,0.04,0.18", "glaze:0.75,0.72,0.68", "glaze:0.7,0.4,0.3"
OTHERS = "glaze:0.1,0.2,0.5|glaze:0.6,0.5,0.4"

#: Shape, material, seed, width, brightness.
SETS = (
    ("folds", f"{BLUE}|{WHITE}", 11, 64, 0.0),
    ("folds", OTHERS, 3, 64, 0.6),
    ("folds", "diffuse:0.5,0.4,0.3", 21, 64, 0.6),
    ("bowl", "gray-plastic", 11, 64, 0.6),
    ("sphere", "dark-blue-paint", 5, 64, 0.6),
    ("folds", f"{BLUE}|{WHITE}", 11, 48, 0.6),
    ("folds", OTHERS, 3, 48, 0.6),
    ("folds", f"{BLUE}|{WHITE}", 21, 48, 0.0),
    ("folds", f"{BLUE}|{WHITE}", 21, 48, 0.6),
    ("folds", f"{BLUE}|{WHITE}|{SKIN}", 44, 48, 0.0),
    ("folds", f"{BLUE}|{WHITE}", 22, 48, 0.0),
    ("folds", f"{BLUE}|{WHITE}|{SKIN}", 23, 48, 0.0),
    ("folds", f"{BLUE}|{WHITE}", 1, 64, 0.0),
    ("folds", f"{BLUE}|{WHITE}|{SKIN}", 12, 64, 0.0),
)


def row(number: int, quality: int, clipped: float, folder: Path) -> str:
    shape, bsdf, seed, size, brightness = SETS[number]
    scene = simulation.Options(shape=shape, bsdf=bsdf, seed=seed, size=size, lights=32, spp=48, noise=0.005)
    made, _ = simulation.simulate(scene, progress=False)
    data = ps.read(write_jpeg(folder, made, quality, clipped=clipped))
    off = compression.judged(folder, data.names, data.mask).deviation
    options = ps.Options(brightness=brightness, max_depth=4, resolutions=(0.5, 1.0), iterations=(6, 4))
    counts = start.counts(data, data, 1.0, options.dark)
    method = start.method(data, data, 1.0, options)
    begun = angles(start.guess(data, ggx.read_dictionary()[0], counts, options, method).normals, made.truth).mean()
    found = ps.reconstruct(data, options, progress=False)
    after = angles(found.guess.normals, made.truth).mean()
    return f"| {number} | {shape} | {100 * off:.0f} | {begun:.2f} | {after:.2f} | {found.verdict} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quality", type=int, default=10)
    parser.add_argument("--clipped", type=float, default=0.05, help="part of the values that are above white")
    parser.add_argument("--only", type=int, nargs="*", default=range(len(SETS)), help="numbers of sets")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print("| set | shape | off, % | start | result | verdict |")
    print("|---|---|---:|---:|---:|---|")
    for number in args.only:
        with tempfile.TemporaryDirectory() as folder:
            print(row(number, args.quality, args.clipped, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
