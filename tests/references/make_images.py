"""Make the reference images of the shipped scenes:  python tests/references/make_images.py

Mitsuba's `path` at depth 2, 32 × 32, 32 runs of 4096 samples a pixel with the `multijitter` sampler; mean and standard
error.
"""

from pathlib import Path

import rimlight.scenes  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np

from rimlight.checks.finite_differences import render_stratified
from rimlight.exr import write_exr

RES, RUNS, SPP = 32, 32, 4096


def main() -> None:
    mi.set_variant("llvm_ad_rgb")
    path = mi.load_dict({"type": "path", "max_depth": 2})
    for name in rimlight.scenes.names():
        scene = mi.load_file(str(rimlight.scenes.path(name)), res=RES)
        images = np.array([render_stratified(scene, path, scene.sensors()[0], i, SPP) for i in range(RUNS)], np.float64)
        layers = {"": images.mean(0), "standard_error": images.std(0, ddof=1) / np.sqrt(RUNS)}
        metadata = {
            "command": "python tests/references/make_images.py",
            "runs": RUNS,
            "spp": SPP,
            "mitsuba": mi.__version__,
        }
        target = Path(__file__).parent / "images" / f"{name}.exr"
        write_exr(target, {k: v.astype(np.float32) for k, v in layers.items()}, metadata)
        print(target)


if __name__ == "__main__":
    main()
