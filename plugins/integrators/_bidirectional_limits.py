"""What derivatives of paths from both ends lack, and of what there are none."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import listed, names
from rimlight.edge_sampling.boundaries.fine_mirrors import fringe
from rimlight.edge_sampling.geometry.parameters import parameters
from rimlight.edge_sampling.refusals import Refusal

from ._limits import Media, is_mirror

#: Last words of the names of parameters to which light is proportional.
COLOURS = ("reflectance", "radiance", "intensity", "irradiance", "specular_reflectance", "diffuse_reflectance")

#: Cosines that differ from 1 by less are those of equal normals, up to rounding.
SAME = 1e-6


class BidirectionalLimits:
    """What derivatives lack. Values of parameters are looked at once for each set of those that carry gradients."""

    #: Nothing, for `dr.freeze`.
    DRJIT_STRUCT = dict.fromkeys(())

    def __init__(self) -> None:
        self._known: dict[tuple[str, ...], list[str]] = {}
        self._lamps: dict[tuple[int, ...], list[str]] = {}

    def refuse(self, scene: mi.Scene, who: str) -> None:
        """Refuse derivatives in the light of emitters of which light subpaths have none.

        Raises
        ------
        RuntimeError : there is one, or a participating medium.
        """
        emitters = scene.emitters()
        several = [e for e in emitters if hasattr(e, "light_count")]
        beam = lambda flags: flags & mi.EmitterFlags.Surface and flags & mi.EmitterFlags.DeltaDirection
        found = [f"{n} ({e.class_name()})" for e in emitters if e in several or beam(e.flags()) for n in names([e])]
        lamps = [e.get_shape() for e in emitters if e.get_shape() is not None]
        key = tuple(map(id, lamps))
        if key not in self._lamps and not dr.flag(dr.JitFlag.FreezingScope):
            self._lamps[key] = [f"{names([s])[0]}, whose normals are not those of its faces" for s in lamps if bent(s)]
        found += self._lamps.get(key, [])
        if found:
            raise Refusal(f"{who}: there is no derivative in the light of {'; '.join(found)}: use prb_edge")
        if Media(scene).found:
            raise Refusal(f"{who}: participating media are not supported: remove them")

    def of(self, scene: mi.Scene) -> list[str]:
        """With respect to the parameters that carry a gradient now."""
        delta = [e for e in scene.emitters() if e.flags() & mi.EmitterFlags.Delta]
        limits = []
        if delta and any(is_mirror(s) for s in scene.shapes()):
            limits.append(
                f"the derivative lacks the caustics that perfect mirrors and glass throw in the light of "
                f"{listed(names(delta))}, though the image has them; give the mirrors a roughness, or the light a "
                "size."
            )
        with dr.resume_grad():
            changing = [p for p in parameters(scene) if dr.grad_enabled(p.value)]
        colours = [p for p in changing if any(word in COLOURS for word in p.name.split("."))]
        key = tuple(p.name for p in colours)
        if key not in self._known and not dr.flag(dr.JitFlag.FreezingScope):
            self._known[key] = [
                f'where "{p.name}" is 0, so is the derivative with respect to it, since no light takes these paths; '
                "start from a small positive number, or use prb_edge."
                for p in colours
                if dr.any(dr.ravel(dr.detach(p.value)) == 0)
            ]
        return limits + self._known.get(key, [])


def bent(lamp: mi.Shape) -> bool:
    """Do normals of vertices and of faces differ by more than rounding?"""
    return fringe(lamp) > SAME
