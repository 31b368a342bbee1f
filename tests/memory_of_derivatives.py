"""Peak of the memory that a derivative takes in backward mode, and its time, in one pass and in several:

python tests/memory_of_derivatives.py bdpt_edge glossy_caustic ring.to_world --res 256 --spp 16 --max-depth 8
"""

from __future__ import annotations

import argparse
import gc
import time

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

from rimlight import scenes  # noqa: E402


def measured(scene: mi.Scene, integrator: mi.Integrator, key: str, spp: int, runs: int) -> tuple[float, float]:
    """GiB that Dr.Jit holds at most, and the least seconds of processors of a derivative: others compile something."""
    params = mi.traverse(scene)
    backend, used = dr.backend_v(mi.Float), []
    for run in range(1 + runs):
        dr.enable_grad(params[key])
        params.update()
        width, height = scene.sensors()[0].film().crop_size()
        w = mi.TensorXf(dr.ones(mi.Float, width * height * 3), (height, width, 3))
        dr.eval(w)
        dr.sync_thread()
        gc.collect()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        began = time.process_time()
        integrator.render_backward(scene, params, w, seed=run, spp=spp)
        dr.eval(dr.grad(params[key]))
        dr.sync_thread()
        used.append((dr.detail.malloc_watermark(backend) / 2**30, time.process_time() - began))
        dr.disable_grad(params[key])
    return max(gib for gib, _ in used), min(seconds for _, seconds in used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("integrator", choices=["direct_edge", "prb_edge", "bdpt_edge"])
    parser.add_argument("scene", choices=sorted(scenes.names()), metavar="SCENE")
    parser.add_argument("key", help="a parameter that carries a gradient")
    parser.add_argument("--res", type=int, default=64)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--max-depth", type=int, default=8)
    parser.add_argument("--at-once", type=int, nargs="*", help="samples in memory at once; default: that of Rimlight")
    parser.add_argument("--runs", type=int, default=3)
    args = parser.parse_args()
    scene = mi.load_file(str(scenes.path(args.scene)), res=args.res)
    depth = {} if args.integrator == "direct_edge" else {"max_depth": args.max_depth}
    for at_once in args.at_once or (None,):
        integrator = mi.load_dict({"type": args.integrator, **depth})
        integrator.at_once = at_once or integrator.at_once
        passes = len(integrator.passes(integrator.job(scene, 0, spp=args.spp)))
        gib, seconds = measured(scene, integrator, args.key, args.spp, args.runs)
        print(f"{integrator.at_once}: {passes} passes, {gib:.3f} GiB, {seconds:.1f} s of processors", flush=True)


if __name__ == "__main__":
    main()
