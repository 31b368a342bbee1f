"""An optimiser of one's own, with a schedule: Lion (Chen et al. 2023), whose steps are signs, and a cosine."""

from rimlight import inverse, scenes  # before mitsuba
import math

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")


class Lion:
    """As in Optax: latents, gradients and changes are dictionaries, name -> array; a state is whatever it needs."""

    def init(self, latents):
        return {name: np.zeros_like(x) for name, x in latents.items()}

    def update(self, gradients, momentum, latents):
        changes = {name: -np.sign(0.8 * momentum[name] + 0.2 * g) for name, g in gradients.items()}
        return changes, {name: 0.9 * momentum[name] + 0.1 * g for name, g in gradients.items()}


steps = 60
fit = inverse.Fit(
    scene=scenes.path("two_triangles"),
    define={"res": "32"},
    integrator={"type": "direct_edge"},
    free=[inverse.Free(key="green.bsdf.reflectance.value", kind="material", rate=0.03, start=(0.2, 0.2, 0.2))],
    optimiser=Lion(),
    stage=[inverse.Stage(iterations=steps, rate=lambda i: 0.5 * (1 + math.cos(math.pi * i / steps)))],
)
rates = []
fit.on_step(lambda step: rates.append(step.rate))
found = fit.run(progress=False)
before, after = found.errors["green.bsdf.reflectance.value: relative error"][[0, -1]]
print(f"relative error {before:.2f} -> {after:.4f}, rates {rates[0]:.2f} -> {rates[-1]:.5f}")
assert after < 0.05 * before
