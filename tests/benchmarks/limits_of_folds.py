"""What limits figures with folds under a glaze, as a table of the documentation:

python tests/benchmarks/limits_of_folds.py [--size 48] [--seed 21]

Results of images with and without interreflections; the interreflections that are path traced from the true normals,
beside those of the images; results with these held; and the errors of many alternations.
"""

from __future__ import annotations

import argparse
from unittest import mock

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

from rimlight import ggx
from rimlight.inverse.photometric_stereo import alternation, reconstruction, rendering, simulation, start
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


def result(data: Dataset, depth: int, coat: bool, **changed) -> tuple[float, reconstruction.Result]:
    """Error of the start, degrees, and what is found with several materials."""
    given = {"resolutions": (0.5, 1.0), "iterations": (6, 4)} | changed
    options = reconstruction.Options(brightness=0, max_depth=depth, materials="several", coat=coat, **given)
    found = reconstruction.reconstruct(data, options, progress=False)
    begun = start.guess(data, found.lobes, start.counts(data, data, 1.0, options.dark), options)
    return float(angles(begun.normals, data.truth).mean()), found


def indirect(data: Dataset, lobes: ggx.Lobes, weights: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Interreflections from the true normals, (P, K, 3). base : diffuse colours under the glaze, (P, 3)."""
    P, K, _ = data.values.shape
    eta = simulation.GLAZE[1]
    guess = Guess(data.truth.copy(), np.ones(P), np.ones(K), weights, base, eta)
    scene = rendering.Rendering(data, lobes, max_depth=5, several=True, base_eta=eta)
    scene.update(guess, scene.domain.integrate(data.truth))
    return scene.indirect(spp=SPP, seed=3)


def with_held(data: Dataset, light: np.ndarray) -> float:
    """Error of the result under a coat, if these are the interreflections of all its states, degrees."""
    half = data.blocks(2)[1](light)

    def held(self: rendering.Rendering, *, spp: int, seed: int) -> np.ndarray:
        return (light if len(self.data.values) == len(light) else half).astype(np.float32)

    with mock.patch.object(rendering.Rendering, "indirect", held):
        return result(data, 4, True, smoothing=0.0)[1].error


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
    true, noisy = whole.values - without.values, figure(args.size, args.seed, 5)
    print(f"interreflections of the images, held: {with_held(noisy, true):.2f} degrees", flush=True)
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
        light = indirect(whole, *of_glaze, base)
        of_truth, of_images = light @ LUMINANCE, true @ LUMINANCE
        alike, part = np.corrcoef(of_truth.ravel(), of_images.ravel())[0, 1], of_truth.sum() / of_images.sum()
        error = with_held(noisy, light)
        print(f"{words}: {part:.2f} of the interreflections, correlation {alike:.3f}; held: {error:.2f}", flush=True)
    with mock.patch.object(alternation, "PATIENCE", 99):
        _, many = result(noisy, 4, True, iterations=(12, 12))
    errors = [f"{entry['error']:.2f}" for entry in many.history if entry["size"] == 1]
    print(f"twelve alternations at full size: {' '.join(errors)}; kept: {many.error:.2f} degrees")


if __name__ == "__main__":
    main()
