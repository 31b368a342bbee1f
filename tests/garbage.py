"""200 derivatives of 50 small scenes in one process, with garbage made on purpose. Run by `test_collection.py`.

Each scene ends in a reference cycle together with what refers to it, so that Python's garbage collector frees it at a
moment of its own choice, and the thresholds of the collector change at random, so that this is often. Dr.Jit ends the
process where that happens while a derivative is traced and changes the number of objects of a class from several to
one: see `docs/troubleshooting.md`.

    python tests/garbage.py [seed]
"""

from __future__ import annotations

# isort: off
import rimlight  # noqa: F401 (first: it chooses the LLVM library)

# isort: on

import gc
import sys

import drjit as dr
import mitsuba as mi
import numpy as np

SCENES = 50

#: Derivatives of each scene: integrator, and the mode.
DERIVATIVES = [(kind, forward) for kind in ("direct_edge", "prb_edge") for forward in (True, False)]

SPP = 1


class Garbage:
    """What only the garbage collector frees: it refers to itself."""

    def __init__(self, *content):
        self.content, self.itself = content, self


def scene(objects: int) -> mi.Scene:
    """One cube or two, each with a BSDF of its own, under a constant sky.

    The second one lies within the bounding box of the first, so that the sky is the same. What is alike in all scenes
    has the same functions, and few kernels must be compiled.
    """
    T = mi.ScalarTransform4f
    cubes = [T().rotate([0, 0, 1], 45).scale(0.5), T().translate([0.6, 0.6, 0]).scale(0.08)]
    description = {
        "type": "scene",
        "sky": {"type": "constant"},
        "sensor": {
            "type": "perspective",
            "to_world": T().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "rgb", "rfilter": {"type": "box"}},
        },
    }
    for i in range(objects):
        # Of different colours: Mitsuba makes one of objects that are equal.
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.3 + 0.1 * i}}
        description[f"cube{i}"] = {"type": "cube", "to_world": cubes[i], "bsdf": bsdf}
    return mi.load_dict(description)


def derivative(of: mi.Scene, integrator: mi.Integrator, forward: bool, seed: int) -> np.ndarray:
    """With respect to the place of the first cube: the image, or the gradient."""
    params, key = mi.traverse(of), "cube0.vertex_positions"
    values = mi.Float(dr.detach(params[key]))
    dr.enable_grad(values)
    params[key] = values
    params.update()
    if forward:
        dr.set_grad(values, 1.0)
        return np.array(integrator.render_forward(of, params, seed=seed, spp=SPP))
    image = mi.render(of, params, integrator=integrator, seed=seed, spp=SPP)
    dr.backward(dr.mean(dr.square(image), axis=None))
    return np.array(dr.grad(values))


def main(seed: int) -> None:
    mi.set_variant("llvm_ad_rgb")
    random = np.random.default_rng(seed)
    gc.freeze()  # what is there already: else the collector looks at old objects only when there are as many new ones
    count = 0
    for i in range(SCENES):
        of = scene(1 + i % 2)
        for kind, forward in DERIVATIVES:
            gc.set_threshold(int(random.integers(1, 100)), 1, 1)
            integrator = mi.load_dict({"type": kind, "max_depth": 2, "sppi": 0})
            found = derivative(of, integrator, forward, seed=count)
            assert np.isfinite(found).all()
            count += 1
            Garbage(integrator)
        Garbage(of, mi.traverse(of))
    print(count, "derivatives of", SCENES, "scenes")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
