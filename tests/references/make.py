"""Make the references of the derivative tests:  python tests/references/make.py [--missing | --noise | NAME ...]

Central differences of `path` at 32 × 32, common random numbers, 12 runs of 16,384 stratified samples a pixel, or other
numbers (`Case.runs`, `Case.reference_spp`): about 20 s each on two cores, minutes for paths of many bounces.
`--noise` measures the noise of the derivatives themselves, which the tests do not let grow.
"""

from __future__ import annotations

import gc
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi

from rimlight.checks import FiniteDifferences, Motion, compare, finite_differences


def measure_noise() -> None:
    import cases

    noise = json.loads(cases.NOISE.read_text()) if cases.NOISE.exists() else {}
    for c in cases.CASES:
        if not (c.needs and not c.needs.exists()):
            noise[c.name] = round(compare(c.derivatives(), FiniteDifferences.read(c.reference)).own_noise, 5)
            gc.collect()
    cases.NOISE.write_text(json.dumps(noise, indent=1) + "\n")


def main(names: list[str]) -> None:
    mi.set_variant("llvm_ad_rgb")
    from cases import CASES

    if names == ["--noise"]:
        return measure_noise()
    wanted = [
        c
        for c in CASES
        if (c.name in names if names and names != ["--missing"] else names == [] or not c.reference.exists())
    ]
    for c in wanted:
        if c.needs and not c.needs.exists():
            print(f"{c.name}: not made, needs {c.needs}")
            continue
        start = time.time()
        scene = (c.reference_scene or c.scene)()
        # Without Russian roulette: its random choices would differ between the images of a run.
        images = {"type": c.reference_images, "max_depth": c.max_depth, "rr_depth": 1000}
        if "hide_emitters" in c.integrator:
            images["hide_emitters"] = c.integrator["hide_emitters"]
        reference = finite_differences(
            scene,
            Motion(scene, **c.motion),
            step=c.step,
            runs=c.runs,
            spp=c.reference_spp,
            integrator=mi.load_dict(images),
            progress=True,
        )
        command = f"python tests/references/make.py {c.name}"
        reference.write(c.reference, {"case": c.name, "command": command})
        noise = reference.standard_error.sum() / abs(reference.mean).sum()
        del scene
        gc.collect()
        dr.flush_malloc_cache()
        print(f"{c.name}: standard error {noise:.2%} of the L1 norm, {time.time() - start:.0f} s")


if __name__ == "__main__":
    main(sys.argv[1:])
