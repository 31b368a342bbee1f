"""Noise of the derivatives of test cases, of each term by itself:

python tests/noise_of_terms.py cornell_box bunny_box --spp 256 --runs 12
"""

from __future__ import annotations

import argparse
import time

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import cases  # noqa: E402

from rimlight.checks import FiniteDifferences, Motion, derivative_image  # noqa: E402
from rimlight.terms.order import TERMS  # noqa: E402


def derivatives(case: cases.Case, term: str | None, spp: int, runs: int) -> tuple[np.ndarray, float]:
    """Images of one term, or of all, (runs, H, W, C), and seconds of processors for each."""
    scene = case.scene()
    settings = {k: v for k, v in case.integrator.items() if not k.startswith("spp")}
    # Without interior samples, the film still knows the weights of pixels.
    integrator = mi.load_dict(settings if term in (None, "interior") else {**settings, "sppc": 0})
    if term is not None:
        integrator.TERMS = tuple(t for t in TERMS if t.name in ("interior", term))
    motion = Motion(scene, **case.motion)
    render = lambda seed: np.array(derivative_image(scene, integrator, motion, spp=spp, seed=seed), np.float64)
    render(0)
    began = time.process_time()
    return np.array([render(1 + i) for i in range(runs)]), (time.process_time() - began) / runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=[c.name for c in cases.CASES], metavar="NAME")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--all", action="store_true", help="only all terms together")
    args = parser.parse_args()
    if args.runs < 2:
        parser.error("noise shows from two runs on")
    print("In parts of the L1 norm of the finite differences; largest: of any pixel in any run, over the mean pixel.")
    for name in args.names:
        case = cases.case(name)
        norm = np.abs(FiniteDifferences.read(case.reference).mean).sum()
        for term in (None, *(() if args.all else (t.name for t in TERMS))):
            images, seconds = derivatives(case, term, args.spp, args.runs)
            mean = images.mean(0)
            noise = np.abs(images - mean).sum() / args.runs * np.sqrt(args.runs / (args.runs - 1)) / norm
            largest = np.abs(images).max() * mean.size / norm
            share = np.abs(mean).sum() / norm
            print(
                f"{name:20} {term or 'all terms':26} share {share:.3f}  noise of one run {noise:.4f}  "
                f"largest {largest:6.1f}  {seconds:.3f} s of processors",
                flush=True,
            )


if __name__ == "__main__":
    main()
