"""Shapes that lie in the place of another one, or in one plane with it: the sentences that say so."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from rimlight._plan import listed, names
from rimlight.edge_sampling import Geometry
from rimlight.edge_sampling.geometry.boxes import box_of
from rimlight.edge_sampling.geometry.coplanar import coplanar_meshes


def copies(scene: mi.Scene) -> list[str]:
    """What is off where two shapes of a scene, of the same kind, are in the same place."""
    alike: dict[tuple, list[mi.Shape]] = {}
    for s in scene.shapes():
        box = box_of(s)
        alike.setdefault((s.class_name(), *box.min, *box.max), []).append(s)
    pairs = [
        " and ".join(names([t, s]))
        for shapes in alike.values()
        for i, s in enumerate(shapes)
        for t in shapes[:i]
        if np.array_equal(_place(s), _place(t))
    ]
    if not pairs:
        return []
    return [
        "the derivative is off at the outlines or in the shadows of shapes that lie in the same place: "
        f"{listed(pairs)}. Delete one of both."
    ]


def fights(geometry: Geometry) -> list[str]:
    """What is off where faces of different materials overlap in one plane."""
    pairs = [" and ".join(names(pair)) for pair in coplanar_meshes(geometry)]
    if not pairs:
        return []
    return [
        "which of two surfaces is seen where their faces overlap in one plane is up to rounding, and so is the "
        f"derivative there: {listed(pairs)}. Move them apart, or cut one of both out."
    ]


def _place(shape: mi.Shape) -> np.ndarray:
    """Its vertices, in an order that depends on where they are alone, or its transformation. NaN, which equals nothing,
    where it has neither."""
    params = mi.traverse(shape)
    if "vertex_positions" in params:
        return np.array(sorted(map(tuple, np.array(params["vertex_positions"]).reshape(-1, 3))))
    return np.array(params["to_world"].matrix) if "to_world" in params else np.array(np.nan)
