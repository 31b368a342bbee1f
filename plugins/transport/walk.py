"""Paths from the camera, written down once for all those who look from vertices of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.first_points import FirstPoints
from rimlight.edge_sampling.parametrisation import Slides, Vicinity

from .log import Log
from .paths import Choice, Depths, Vertex, choose_vertices
from .replay import Chain, MovingVertex, written

#: Where more shapes than these move, all vertices are taken to do so.
FEW = 8


class Walk:
    """Paths from the camera, and vertices of each, chosen in proportion to its throughput.

    sampler : of the paths.
    first : the vertices that camera rays meet.
    slides : see `Vicinity`.
    beyond : one vertex is chosen for each of these numbers; at least so many more may follow it.
    held : what is held where the camera sees it.
    moving : see `choose_vertices`.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        first: Vertex,
        depths: Depths,
        slides: Slides,
        beyond: Sequence[int],
        held: FirstPoints | None = None,
        moving: Sequence[mi.ShapePtr] | None = None,
    ):
        # What is met first is used in the kernels of all, which are not to trace it again.
        dr.eval(first.ray, first.pi)
        self.beyond, self.first, vicinity = beyond, first, Vicinity.of(first.pi, slides)
        self._chain = chain = Chain(scene, vicinity, held=held)
        # The direction that a mirror shows turns with its normal, even if its points stand still.
        known = moving is not None and len(moving) <= FEW and not chain.scattering.any_mirror
        moving = moving if known else None

        def follow(log: Log | None) -> list[Choice]:
            def note(vertex, numbers, onwards, active):
                if log is not None:
                    if chain.scattering.any_mirror:
                        log.leave(vertex.depth, vertex.β, numbers, active)
                    log.arrive(vertex.depth + 1, onwards, active)

            begun = sampler.clone(), first, depths, vicinity, first.pi.is_valid()
            return choose_vertices(scene, *begun, beyond, note, moving)

        longest = lambda choices: reduce(dr.maximum, [c.depth for c in choices])
        self._log, self._choices = written(scene, first.ray, 1, depths, follow, longest)

    def choice(self, beyond: int) -> Choice:
        """The vertex of each path that at least so many may follow."""
        return self._choices[self.beyond.index(beyond)]

    def vertex(self, choice: Choice, ray: mi.Ray3f, mode: dr.ADMode, lamps: DividedLight | None) -> MovingVertex:
        """A vertex, as it moves. ray : camera rays, attached to the camera. lamps : see `MovingVertex`."""
        at_first = choice.depth == 1
        vertex = dr.select(at_first, self.first, self._log.vertex(choice.depth, choice.active & ~at_first))
        moves = vertex, choice.active, choice.since, mode
        return MovingVertex(self._chain, ray, self.first, self._log, *moves, lamps=lamps, before=choice.before)
