"""The search for what channels besides light jump at."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from rimlight.edge_sampling import Edges, FilmBoundary, jumping_textures
from rimlight.edge_sampling.boundaries.found import Boundaries
from rimlight.edge_sampling.first_points import HeldShapes
from rimlight.edge_sampling.geometry.edges import EdgeKind
from rimlight.edge_sampling.geometry.meshes import has_texcoords
from rimlight.transport.channels import LABELS, OF_TRIANGLES, Channel
from rimlight.transport.paths import Depths

from ._limits import Moving, outlines
from ._search import BoundarySearch


class NoLights:
    """Stands for the lights of a scene where nothing shines."""

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`

    def places(self, scene: mi.Scene) -> None:
        return None


class ChannelSearch(BoundarySearch):
    """Finds the boundaries of channels besides light: those on the film, and no others.

    Parameters
    ----------
    who : name of the integrator, for messages.
    channels : of it.
    """

    def __init__(self, who: str, channels: tuple[Channel, ...]):
        super().__init__(who, Depths(1, 1), planes=False, from_points=False, from_surfaces=False)
        self.channels = channels
        self.kinds = {c.kind for c in channels}

    def _held(self, scene: mi.Scene, sensor: mi.Sensor, moving: Moving) -> HeldShapes | None:
        """No shape is held: channels are differentiated at a film position that is held."""
        return None

    def _find(
        self, scene: mi.Scene, sensor: mi.Sensor, moving: Moving, sppi: int, held: HeldShapes | None
    ) -> Boundaries:
        on_film = np.array([m or moving.camera for m in moving.flags], bool)
        film = None
        if on_film.any():
            # Where normals of faces are shown, edges of smooth-shaded meshes count, in proportion to their bend.
            seams = bool(self.kinds & {"uv", "albedo"})
            which = {"soft": "geo_normal" in self.kinds, "seams": seams, "channels": True}
            edges = self._jumping(self._edges_of(self.geometry))
            film = FilmBoundary(self.geometry, edges, on_film, NoLights(), **which)
            film = film if any(film.outlines.counts) else None
        limits = (*outlines(scene, self.geometry, self._cracks, moving), *self._lasting_limits(scene))
        return Boundaries(film, None, None, None, None, moving.flags, moving.camera, moving.lights, limits)

    def _jumping(self, edges: Edges) -> Edges:
        """Edges, among which those count always at which only channels jump, not light: between all triangles if
        channels depend on their texture coordinates, and where the place in a triangle stands for those."""
        everywhere = np.array(
            [
                bool(self.kinds & OF_TRIANGLES) or ("uv" in self.kinds and not has_texcoords(m))
                for m in self.geometry.meshes
            ],
            bool,
        )
        if not everywhere.any():
            return edges
        return replace(edges, kind=np.where(everywhere[edges.mesh].any(1), EdgeKind.JUMP, edges.kind).astype(np.uint8))

    def _lasting_limits(self, scene: mi.Scene) -> list[str]:
        limits = []
        labels = ", ".join(f'"{c.name}:{c.kind}"' for c in self.channels if c.kind in LABELS)
        if labels:
            limits.append(
                f"the derivative of {labels} is taken to be 0, since numbers that name triangles and shapes have none. "
                'Differentiate a mask in their place, "<name>:mask:<id of a shape>".'
            )
        textures = jumping_textures(scene, seams=False) if "albedo" in self.kinds else []
        if textures:
            limits.append(
                f"the derivative of the albedo lacks the jumps of the textures {', '.join(textures)}; use bilinear "
                "bitmaps."
            )
        return limits
