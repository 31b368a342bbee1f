"""Faces of different meshes that lie in one plane and overlap: which of them a ray meets is up to rounding."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from .edges import distinct_rows
from .grids import is_grid
from .meshes import Geometry, faces, vertices

#: Planes are one if their normals, and their distances from the origin over the size of the scene, differ by less.
IN_PLANE = 1e-5

#: Most triangles of one mesh in one plane that are looked at.
MOST = 1000


def coplanar_meshes(geometry: Geometry) -> list[tuple[mi.Mesh, mi.Mesh]]:
    """Meshes of different materials, of which faces overlap in one plane, and look to the same side of it.

    (Where they look to different sides, as where a box stands on a floor, the one hides the other.)
    """
    meshes = [m for m in geometry.meshes if isinstance(m, mi.Mesh) and not is_grid(m) and m.face_count()]
    if len(meshes) < 2:
        return []
    corners = [vertices(m)[faces(m)].astype(float) for m in meshes]
    size = max(np.abs(c).max() for c in corners)
    lowest, highest = ([f(c, axis=1) for c in corners] for f in (np.min, np.max))
    low = np.array([x.min(0) for x in lowest]) - IN_PLANE * size
    high = np.array([x.max(0) for x in highest]) + IN_PLANE * size
    meet = (low[:, None] <= high).all(2)
    bsdfs = [m.bsdf() for m in meshes]  # held, so that none has the number of another one
    materials = np.array([id(b) for b in bsdfs])
    candidates = np.argwhere(np.triu(meet & meet.T & (materials[:, None] != materials)))
    found = []
    for i, j in candidates:
        lower, upper = np.maximum(low[i], low[j]), np.minimum(high[i], high[j])
        near = [corners[k][((lowest[k] <= upper) & (highest[k] >= lower)).all(1)] for k in (i, j)]
        if _overlap(*near, size):
            found.append((meshes[i], meshes[j]))
    return found


def _overlap(first: np.ndarray, second: np.ndarray, size: float) -> bool:
    """Do triangles (N, 3, 3) of one mesh overlap such of another one in a plane?"""
    (first, planes, of), (second, others, of_others) = (_planes(c, size) for c in (first, second))
    if not len(planes) or not len(others):
        return False
    tree, reach = cKDTree(others), 3 * IN_PLANE
    shared = np.flatnonzero(np.isfinite(tree.query(planes, distance_upper_bound=reach)[0]))
    for k, alike in zip(shared, tree.query_ball_point(planes[shared], reach), strict=True):
        axes = np.argsort(np.abs(planes[k, :3]))[:2]
        a = first[of == k][:MOST][..., axes]
        for m in alike:
            b = second[of_others == m][:MOST][..., axes]
            if _overlap_flat(a, b, IN_PLANE * size):
                return True
    return False


def _planes(corners: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those triangles that have an area; their different planes (P, 4), normals of unit length first; and in which of
    these each one is."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(n, axis=1)
    corners, n = corners[length > 0], n[length > 0] / length[length > 0, None]
    planes = np.column_stack([n, (n * corners[:, 0]).sum(1) / size])
    first, of = distinct_rows(np.round(planes / IN_PLANE).astype(np.int64))
    return corners, planes[first], of


def _overlap_flat(a: np.ndarray, b: np.ndarray, slack: float) -> bool:
    """Do triangles (A, 3, 2) and (B, 3, 2) of a plane overlap, by more than their borders?"""
    return bool((~_parted(a, b, slack) & ~_parted(b, a, slack).T).any())


def _parted(a: np.ndarray, b: np.ndarray, slack: float) -> np.ndarray:
    """Which triangles (A, 3, 2) have a side that parts them from which others (B, 3, 2)? (A, B), bool."""
    parted = np.zeros((len(a), len(b)), bool)
    for k in range(3):
        side = a[:, k - 1] - a[:, k]
        across = np.stack([-side[:, 1], side[:, 0]], 1) / np.maximum(np.linalg.norm(side, axis=1)[:, None], slack)
        own, other = np.einsum("akc,ac->ak", a, across)[:, None], np.einsum("bkc,ac->abk", b, across)
        parted |= (own.max(2) <= other.min(2) + slack) | (other.max(2) <= own.min(2) + slack)
    return parted
