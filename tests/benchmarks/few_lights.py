"""Errors of the start and of the result under three to seven lights.

python tests/benchmarks/few_lights.py [--lights 4 5 7] [--seed 77] [--only 0 1]
"""

from __future__ import annotations

import argparse

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
# isort: on

from rimlight import ggx
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import simulation, start
from rimlight.inverse.photometric_stereo.dataset import angles

#: Name, shape, material, longest path.
SETS = (
    ("folds, two glazes", {"shape": "folds", "bsdf": "glaze:0.1,0.2,0.5|glaze:0.6,0.5,0.4", "max_depth": 3}),
    ("bright bowl", {"shape": "bowl", "bsdf": "diffuse:0.7,0.6,0.5", "hollow": 0.4, "max_depth": 5}),
    ("folds, two matte", {"shape": "folds", "bsdf": "diffuse:0.5,0.4,0.3|diffuse:0.2,0.3,0.5", "max_depth": 4}),
    ("sphere, gray-plastic", {"shape": "sphere", "bsdf": "gray-plastic", "max_depth": 3}),
    ("folds, brass", {"shape": "folds", "bsdf": "brass", "max_depth": 3}),
    ("mould, dark-blue-paint", {"shape": "folds", "concave": True, "bsdf": "dark-blue-paint", "max_depth": 4}),
)


def cell(number: int, lights: int, seed: int) -> str:
    scene = simulation.Options(**SETS[number][1], size=32, lights=lights, spread=45, spp=32, noise=0.005, seed=seed)
    data, _ = simulation.simulate(scene, progress=False)
    options = ps.Options(brightness=0, resolutions=(0.5, 1.0), iterations=(3, 2))
    counts = start.counts(data, data, 1.0, options.dark)
    begun = start.guess(data, ggx.read_dictionary()[0], counts, options).normals
    found = ps.reconstruct(data, options, progress=False)
    return f"{angles(begun, data.truth).mean():.1f} to {found.error:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lights", type=int, nargs="*", default=[4, 5, 7])
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--only", type=int, nargs="*", default=range(len(SETS)), help="numbers of sets")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print("| set |" + "".join(f" {lights} lights |" for lights in args.lights))
    print("|---|" + "---:|" * len(args.lights))
    for number in args.only:
        cells = " | ".join(cell(number, lights, args.seed) for lights in args.lights)
        print(f"| {SETS[number][0]} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
