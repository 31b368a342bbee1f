"""What a coat, and lights at a finite distance, do to the normals of an object of DiLiGenT, as a table:

    python tests/benchmarks/coat_and_rig.py pmsData/ballPNG --camera K.txt [--size 0.25]

Of one material, with and without a coat, lights at infinity and in a plane. "leans" is by how much normals lean away
from the direction to the camera, mean over those that truly lean by 40 to 50 degrees: what all halves of the lights
have in common, which `halves` cannot see.
"""

from __future__ import annotations

import argparse
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

from diligent import with_rig

from rimlight.inverse.photometric_stereo import dataset, reconstruction
from rimlight.inverse.photometric_stereo.dataset import Dataset

#: True angles to the direction to the camera of what leans, degrees.
LEANING = 40.0, 50.0


def row(name: str, data: Dataset, coat: bool) -> str:
    options = reconstruction.Options(materials="one", coat=coat, resolutions=(1.0,), iterations=(8,))
    found = reconstruction.reconstruct(data, options, progress=False)
    off = lambda normals: np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1)))
    true = off(data.truth)
    chosen = (true >= LEANING[0]) & (true < LEANING[1])
    leans = (off(found.guess.normals) - true)[chosen].mean()
    numbers = f"{found.error:.2f} | {leans:+.1f} | {100 * found.left_out['result']:.2f} | {found.halves['result']:.2f}"
    return f"| {name} | {'yes' if coat else 'no'} | {numbers} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--camera", type=Path, required=True, help="intrinsic matrix, 3 x 3, of the whole frame")
    parser.add_argument("--rig", type=float, default=1490.0, help="distance of camera and lights, mm")
    parser.add_argument("--size", type=float, default=0.25, help="of the images: 1, or 1 over a whole number")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    far = dataset.read(args.folder)
    near = with_rig(args.folder, far, np.loadtxt(args.camera), args.rig)
    print("| lights | coat | error | leans | left out | halves |\n|---|---|" + "---:|" * 4)
    for name, data in {"at infinity": far, "in the plane": near}.items():
        for coat in (False, True):
            print(row(name, data.at(args.size), coat), flush=True)


if __name__ == "__main__":
    main()
