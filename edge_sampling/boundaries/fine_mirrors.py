"""Smooth-shaded mirrors and glass of small faces: their outline, and what is just inside of it, as one jump.

Where the interpolated normal n is almost at right angles to the ray, r = d − 2 (d·n) n goes to the wrong side of the
face with the normal f, and meets the mesh from inside: between the line where r·f = 0 and the outline, a mirror is
dark. On a fine mesh that fringe is far narrower than a pixel, and consists of a piece for each face, whose borders move
fast and in all directions, though together they do next to nothing. So on the sides of boundaries, n is turned to the
viewer until r just stays outside: there, the mesh shows what it does on the inner border of the fringe.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.meshes import BENT, faces, has_interpolated_normals, normals_of, vertices

#: How far the cosine between the normals of faces and vertices may be below 1.
FINE = 0.002

#: By which part of the least cosine to the viewer more is taken: the normals of face and vertices differ.
MARGIN = 0.01


class FineMirrors:
    """The smooth-shaded meshes of small faces among some shapes.

    shapes : perfect mirrors, and glass.
    """

    DRJIT_STRUCT = dict.fromkeys(())  # for `dr.freeze`

    def __init__(self, shapes: list[Any]):
        self.shapes = [s for s in shapes if 0 < fringe(s) <= FINE]

    def turn(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> None:
        """Turn the interpolated normals of these shapes to the viewer, until mirrored rays stay outside."""
        if not self.shapes:
            return
        mine = mi.Bool(False)
        for shape in self.shapes:
            mine |= si.shape == mi.ShapePtr(shape)
        to_viewer, n = -ray.d, mi.Normal3f(si.sh_frame.n)
        least = 0.5 * (1 + MARGIN) * dr.mulsign(dr.dot(si.n, to_viewer), dr.dot(si.n, n))
        cos = dr.dot(n, to_viewer)
        turn = active & mine & si.is_valid() & (dr.mulsign(cos, least) < dr.abs(least))
        si.sh_frame.n = dr.select(turn, dr.normalize(n + (least - cos) * to_viewer), n)
        si.initialize_sh_frame()
        si.wi = dr.select(turn, si.to_local(to_viewer), si.wi)


def fringe(shape: mi.Shape) -> float:
    """How far the cosine between the normals of faces and vertices is below 1, at most; 0 without interpolated ones."""
    off, _ = fringes(shape)
    return float(off.max(initial=0))


def mean_fringe(shape: mi.Shape) -> float:
    """The same, at most of each face, averaged over the area of the faces that are bent: flat ground around a coarse
    hill does not make it finer."""
    off, area = fringes(shape)
    area = np.where(off > BENT**2 / 2, area, 0)
    return float(off @ area / area.sum()) if area.any() else 0.0


def fringes(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """How far the cosine between the normals of a face and its vertices is below 1, at most, and twice the area of the
    face: (F,), float64, for the faces with an area and normals; empty without interpolated ones."""
    if not shape.is_mesh() or not has_interpolated_normals(shape):
        return np.zeros(0), np.zeros(0)
    corners, normals = faces(shape), np.array(dr.detach(normals_of(shape))).reshape(-1, 3)
    p = vertices(shape)[corners].astype(np.float64)
    flat = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    n, area = normals[corners], np.linalg.norm(flat, axis=1)
    size = area[:, None] * np.linalg.norm(n, axis=2)
    cos = np.abs((flat[:, None] * n).sum(2)) / np.where(size > 0, size, 1)
    off, there = np.where(size > 0, 1 - cos, 0).max(1), (size > 0).any(1)
    return off[there], area[there]
