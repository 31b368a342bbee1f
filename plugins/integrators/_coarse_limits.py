"""What derivatives lack of the light of coarse smooth-shaded meshes: the sentences that say so."""

from __future__ import annotations

import mitsuba as mi

from rimlight._plan import listed, names
from rimlight.edge_sampling.boundaries.fine_mirrors import fringe
from rimlight.edge_sampling.geometry.meshes import surfaces
from rimlight.transport.paths import Depths

#: How far the cosine between the normals of faces and vertices may be below 1, without a warning.
FRINGE = 0.005


def coarse_lamps(scene: mi.Scene, depths: Depths, *, planes: bool) -> list[str]:
    """What the derivative lacks of the light that smooth-shaded meshes throw: Mitsuba reckons it with interpolated
    normals, but faces turn away one after the other, each while its light is not yet 0.

    depths : of the paths. planes : is this sampled where the camera sees the light fall? (`LampPlanes`)
    """
    if planes and not depths.scatters(2):
        return []
    shapes = [e.get_shape() for e in scene.emitters() if e.get_shape() is not None]
    fringes = {s: fringe(s) for s in shapes if fringe(s) > FRINGE}
    if not fringes:
        return []
    largest = float(f"{100 * max(fringes.values()):.1g}")
    where = "in mirrors and in indirect light, " if planes else ""
    return [
        f"{where}where the light of {listed(names(fringes))} falls, the derivative is off by up to about {largest:g} "
        "%, since Mitsuba shades the faces of coarse meshes with interpolated normals. Give them finer meshes or face "
        "normals."
    ]


def coarse_meshes(scene: mi.Scene) -> list[str]:
    """What a derivative without `FacePlanes` lacks: the faces of smooth-shaded meshes hide light from themselves."""
    sized = [e for e in scene.emitters() if not e.flags() & mi.EmitterFlags.Delta and not hasattr(e, "light_count")]
    coarse = names(s for s in surfaces(scene) if fringe(s) > FRINGE) if sized else []
    if not coarse:
        return []
    return [
        f"the derivative lacks what the faces of {listed(coarse)} hide of lamps with a size, while interpolated "
        "normals go on being lit. Give them finer meshes or face normals, or use direct_edge or prb_edge."
    ]
