"""Noise of the derivatives of test cases, of each term by itself:

python tests/noise_of_terms.py cornell_box bunny_box --spp 256 --runs 12
"""

from __future__ import annotations

import argparse
import time

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import cases  # noqa: E402

from rimlight.checks import FiniteDifferences, Motion, derivative_image  # noqa: E402
from rimlight.terms.order import TERMS  # noqa: E402


def derivatives(case: cases.Case, term: str | None, spp: int, runs: int, shares=None) -> tuple[np.ndarray, float]:
    """Images of one term, or of all, (runs, H, W, C), and seconds of processors for each."""
    scene = case.scene()
    # Without interior samples, the film still knows the weights of pixels.
    integrator = _integrator(case, **({} if term in (None, "interior") else {"sppc": 0}))
    integrator.shares = shares or {}
    if term is not None:
        integrator.TERMS = tuple(t for t in TERMS if t.name in ("interior", term))
    motion = Motion(scene, **case.motion)
    render = lambda seed: np.array(derivative_image(scene, integrator, motion, spp=spp, seed=seed), np.float64)
    render(0)
    began = time.process_time()
    return np.array([render(1 + i) for i in range(runs)]), (time.process_time() - began) / runs


def balance(case: cases.Case, spp: int) -> dict[str, float]:
    """The shares of the terms, measured with so many samples per pixel, and printed."""
    scene, integrator = case.scene(), _integrator(case)
    motion, theta = Motion(scene, **case.motion), mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    dr.forward(theta, dr.ADFlag.ClearEdges)
    found = integrator.balance(scene, motion.params, spp=spp)
    print(found)
    return found.shares


def _integrator(case: cases.Case, **more) -> mi.Integrator:
    return mi.load_dict({k: v for k, v in case.integrator.items() if not k.startswith("spp")} | more)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=[c.name for c in cases.CASES], metavar="NAME")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--all", action="store_true", help="only all terms together")
    parser.add_argument("--balanced", action="store_true", help="and all with the shares that `balance` finds")
    parser.add_argument("--pilot", type=int, default=16, help="samples per pixel with which these are measured")
    args = parser.parse_args()
    if args.runs < 2:
        parser.error("noise shows from two runs on")
    print("In parts of the L1 norm of the finite differences; largest: of any pixel in any run, over the mean pixel.")
    for name in args.names:
        case = cases.case(name)
        norm = np.abs(FiniteDifferences.read(case.reference).mean).sum()
        rows = [(term, None) for term in (None, *(() if args.all else (t.name for t in TERMS)))]
        for term, shares in rows + ([(None, balance(case, args.pilot))] if args.balanced else []):
            images, seconds = derivatives(case, term, args.spp, args.runs, shares)
            mean = images.mean(0)
            noise = np.abs(images - mean).sum() / args.runs * np.sqrt(args.runs / (args.runs - 1)) / norm
            largest = np.abs(images).max() * mean.size / norm
            share = np.abs(mean).sum() / norm
            what = term or ("balanced" if shares else "all terms")
            print(
                f"{name:20} {what:26} share {share:.3f}  noise of one run {noise:.4f}  "
                f"largest {largest:6.1f}  {seconds:.3f} s of processors",
                flush=True,
            )


if __name__ == "__main__":
    main()
