"""What limits figures with folds under a glaze, as a table of the documentation:

python tests/benchmarks/limits_of_folds.py [--size 48] [--seed 21]

Results of images with and without interreflections; and the interreflections that are path traced from the true
normals, beside those of the images.
"""

from __future__ import annotations

import argparse

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

from rimlight import ggx
from rimlight.inverse.photometric_stereo import reconstruction, rendering, simulation, start
from rimlight.inverse.photometric_stereo.dataset import LUMINANCE, Dataset, angles
from rimlight.inverse.photometric_stereo.direct import Guess

#: Diffuse colours under the glaze.
DARK, LIGHT = (0.03, 0.04, 0.18), (0.75, 0.72, 0.68)

#: Samples per pixel of what is compared.
SPP = 256


def figure(size: int, seed: int, depth: int, **changed) -> Dataset:
    """depth : longest path."""
    glaze = "|".join("glaze:" + ",".join(map(str, colour)) for colour in (DARK, LIGHT))
    given = {"bsdf": glaze, "lights": 32, "spp": 64, "noise": 0.01} | changed
    options = simulation.Options(shape="folds", size=size, seed=seed, max_depth=depth, **given)
    return simulation.simulate(options, progress=False)[0]


def result(data: Dataset, depth: int, coat: bool) -> tuple[float, reconstruction.Result]:
    """Error of the start, degrees, and what is found with several materials."""
    options = reconstruction.Options(
        brightness=0, max_depth=depth, resolutions=(0.5, 1.0), iterations=(6, 4), materials="several", coat=coat
    )
    found = reconstruction.reconstruct(data, options, progress=False)
    begun = start.guess(data, found.lobes, start.counts(data, data, 1.0, options.dark), options)
    return float(angles(begun.normals, data.truth).mean()), found


def indirect(data: Dataset, lobes: ggx.Lobes, weights: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Luminances of interreflections from the true normals, (P, K). base : diffuse colours under the glaze, (P, 3)."""
    P, K, _ = data.values.shape
    eta = simulation.GLAZE[1]
    guess = Guess(data.truth.copy(), np.ones(P), np.ones(K), weights, base, eta)
    scene = rendering.Rendering(data, lobes, max_depth=5, several=True, base_eta=eta)
    scene.update(guess, scene.domain.integrate(data.truth))
    return scene.indirect(spp=SPP, seed=3) @ LUMINANCE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=48, help="width and height of the images")
    parser.add_argument("--seed", type=int, default=21)
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for words, of_images, depth in (("without interreflections", 2, 2), ("with interreflections", 5, 4)):
        for coat in (False, True):
            before, found = result(figure(args.size, args.seed, of_images), depth, coat)
            print(f"{words}, coat {coat}: {before:.2f} -> {found.error:.2f} degrees", flush=True)
            if coat and depth == 2:
                direct = found
    exact = {"spp": SPP, "noise": 0.0}
    whole, without = figure(args.size, args.seed, 5, **exact), figure(args.size, args.seed, 2, **exact)
    true = (whole.values - without.values) @ LUMINANCE
    light = direct.guess.base[:, 0] > (DARK[0] + LIGHT[0]) / 2
    colours = np.where(light[:, None], LIGHT, DARK)
    alpha, eta = simulation.GLAZE
    glaze = ggx.Lobes((alpha,), (eta,)), np.ones((1, 3))
    found_glaze = direct.lobes, direct.guess.weights
    for words, of_glaze, base in (
        ("true glaze and colours", glaze, colours),
        ("true glaze, colours found without interreflections", glaze, direct.guess.base),
        ("glaze found, true colours", found_glaze, colours),
        ("glaze and colours found", found_glaze, direct.guess.base),
        ("true colours, no gloss", (glaze[0], 0 * glaze[1]), colours),
    ):
        of_truth = indirect(whole, *of_glaze, base)
        alike = np.corrcoef(of_truth.ravel(), true.ravel())[0, 1]
        print(
            f"{words}: {of_truth.sum() / true.sum():.2f} of the interreflections, correlation {alike:.3f}", flush=True
        )


if __name__ == "__main__":
    main()
