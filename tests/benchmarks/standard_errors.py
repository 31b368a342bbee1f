"""Root mean square errors of normals beside their standard errors, of simulated surfaces, degrees, as a table:

python tests/benchmarks/standard_errors.py
"""

from __future__ import annotations

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import simulation

MATTE = "diffuse:0.5,0.5,0.5"
SETS = (
    ("sphere", MATTE, 0.01),
    ("sphere", MATTE, 0.03),
    ("bowl", "gray-plastic", 0.03),
    ("folds", "glaze:0.6,0.5,0.4", 0.03),
)


def row(shape: str, bsdf: str, noise: float, lights: int) -> str:
    scene = simulation.Options(
        shape=shape, bsdf=bsdf, noise=noise, lights=lights, size=24, spp=512, max_depth=2, seed=5
    )
    data, _ = simulation.simulate(scene, progress=False)
    options = ps.Options(resolutions=(1.0,), iterations=(4,), max_depth=2, brightness=0.0)
    found = ps.reconstruct(data, options, progress=False)
    name = f"| {shape}, {bsdf} | {100 * noise:g} % | {lights}"
    if found.uncertainty is None:
        return f"{name} | the start was kept | |"
    error, said = (np.sqrt(np.nanmean(np.square(x))) for x in (data.off(found.guess.normals), found.uncertainty))
    return f"{name} | {error:.2f} | {said:.2f} |"


def main() -> None:
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print("| surface | noise | lights | error | standard error |\n|---|---:|---:|---:|---:|")
    for scene in SETS:
        for lights in (12, 32):
            print(row(*scene, lights), flush=True)


if __name__ == "__main__":
    main()
