"""What derivatives of paths from both ends lack, and of what there are none."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight._plan import listed, names
from rimlight.edge_sampling.boundaries.fine_mirrors import fringe
from rimlight.edge_sampling.refusals import Refusal

from ._black import BlackParameters
from ._limits import Media, is_mirror

#: Cosines that differ from 1 by less are those of equal normals, up to rounding.
SAME = 1e-6


class BidirectionalLimits:
    """What derivatives lack."""

    #: Nothing, for `dr.freeze`.
    DRJIT_STRUCT = dict.fromkeys(())

    def __init__(self) -> None:
        missing = "so is the derivative with respect to it, since no light takes these paths"
        self._black = BlackParameters(missing, "prb_edge", emitters=True)
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
        return limits + self._black.of(scene)


def bent(lamp: mi.Shape) -> bool:
    """Do normals of vertices and of faces differ by more than rounding?"""
    return fringe(lamp) > SAME
