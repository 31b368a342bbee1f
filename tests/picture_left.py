"""What fits have left of the error of their first picture, without the noise of renders:

rimlight reproduce caustic_shape --out figures --seeds 5
python tests/picture_left.py figures/caustic_shape/ours_*
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from rimlight.inverse import free_parameters, problem  # noqa: E402

#: Samples per pixel of a render, and renders of each picture.
SPP, RENDERS = 512, 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="of fits of one problem, whose scene is the truth")
    folders = parser.parse_args().folders
    posed = problem.read(folders[0] / "problem.toml")
    scene = mi.load_file(str(posed.scene), **posed.define)
    integrator, params = mi.load_dict({**posed.integrator, "type": "bdpt"}), mi.traverse(scene)
    free = free_parameters.find(posed.free, params)
    begun = {key: value for p in free for key, value in p.values({k: mi.Float(v) for k, v in p.start.items()}).items()}
    truth = {key: np.array(params[key]) for key in begun}

    def picture(values: Mapping[str, Any], seed: int) -> np.ndarray:
        for key, value in values.items():
            params[key] = mi.Float(np.array(value, np.float32).ravel()) * dr.opaque(mi.Float, 1)
        params.update()
        renders = (mi.render(scene, integrator=integrator, spp=SPP, seed=seed + i) for i in range(RENDERS))
        return np.mean([np.array(image, np.float64) for image in renders], 0)

    target = picture(truth, 0)
    noise, start = (np.square(picture(v, s) - target).mean() for v, s in ((truth, RENDERS), (begun, 2 * RENDERS)))
    for folder in folders:
        found = np.load(folder / "result.npz")
        square = np.square(picture(found, 3 * RENDERS) - target).mean() - noise
        print(f"{folder}: {np.sqrt(max(square, 0) / (start - noise)):.2%} of {np.sqrt(start - noise):.4f}", flush=True)


if __name__ == "__main__":
    main()
