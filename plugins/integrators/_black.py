"""Parameters of what is black, for integrators whose paths do not go on from there."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.parameters import may_brighten, parameters

#: Last words of the names of parameters to which light is proportional.
COLOURS = ("reflectance", "radiance", "intensity", "irradiance", "specular_reflectance", "diffuse_reflectance")


class BlackParameters:
    """Values of parameters are looked at once for each set of those that carry gradients.

    missing : what the derivative with respect to them is. remedy : instead of which integrator to use another one.
    emitters : do parameters of emitters count, too?
    """

    #: Nothing, for `dr.freeze`.
    DRJIT_STRUCT = dict.fromkeys(())

    def __init__(self, missing: str, remedy: str, *, emitters: bool):
        self._missing, self._remedy, self._emitters = missing, remedy, emitters
        self._known: dict[tuple[str, ...], list[str]] = {}

    def of(self, scene: mi.Scene) -> list[str]:
        """A warning for each that carries a gradient now."""
        with dr.resume_grad():
            changing = [p for p in parameters(scene) if dr.grad_enabled(p.value)]
        colours = [p for p in changing if any(word in COLOURS for word in p.name.split("."))]
        if not self._emitters:
            colours = [p for p in colours if may_brighten(p) and "emitter" not in p.name.split(".")]
        key = tuple(p.name for p in colours)
        if key not in self._known and not dr.flag(dr.JitFlag.FreezingScope):
            self._known[key] = [
                f'where "{p.name}" is 0, {self._missing}; start from a small positive number, or use {self._remedy}.'
                for p in colours
                if dr.any(dr.ravel(dr.detach(p.value)) == 0)
            ]
        return self._known.get(key, [])
