"""The surface of a grid of values, divided into triangles: on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Corners of a voxel: the bits of their numbers are x, y, z. Faces, as seen from outside, counter-clockwise.
CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
FACES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))

#: Edges of a voxel: their corners, in the sense of their axis.
EDGES = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]


def _axis_across(first: int, second: int) -> int:
    (a, b), (c, d) = EDGES[first], EDGES[second]
    same = [k for k in range(3) if len({(corner >> k) & 1 for corner in (a, b, c, d)}) == 1]
    return same[0] if same and first != second else -1


#: The axis across the face of a voxel in which two of its edges lie; −1 where they lie in none.
AXIS_OF_EDGE = np.repeat(np.arange(3), 4)
ACROSS = np.array([[_axis_across(e, f) for f in range(12)] for e in range(12)])

#: Steps of Newton's method from the mean of a loop to the surface.
STEPS = 4

#: Points of a line in the face of a voxel at which it is compared with the surface.
PLACES = np.arange(1, 8) / 8


@dataclass(frozen=True)
class Triangles:
    """The surface of a grid, on the host. Vertices on edges of voxels come first.

    ends : (V₁, 2), int64; the grid values between which they lie. axis : (V₁,); along which axis.
    corners : (V₂, 8), int64; of the voxels in which the others are. middle : (V₂, 3); where there, from 0 to 1.
    faces : (F, 3), uint32; counter-clockwise, as seen from where values are positive.
    slack : (V,); how far about each vertex the triangles are from the surface, in voxels.
    bend : (V,); by how much the gradient of the values turns across the voxels about each vertex, in radians.
    lines : (L, 2), int64; the vertices of the lines on faces of voxels, the lower one first; in order.
    across : (L,); the axis across that face. sag : (L,); how far from the line the surface is in the face, in voxels.
    """

    ends: np.ndarray
    axis: np.ndarray
    corners: np.ndarray
    middle: np.ndarray
    faces: np.ndarray
    slack: np.ndarray
    bend: np.ndarray
    lines: np.ndarray
    across: np.ndarray
    sag: np.ndarray


def _next_edges(f: np.ndarray) -> np.ndarray:
    """Of each edge of voxels on which the surface lies, the next one around the loop: (N, 12); -1 where it does not.
    f : values at the corners, (N, 8)."""
    number = {frozenset(e): k for k, e in enumerate(EDGES)}
    inside, following = f < 0, np.full((len(f), 12), -1, np.int8)
    for face in FACES:
        c = list(face)
        edge = [number[frozenset((c[k], c[k - 3]))] for k in range(4)]
        s = inside[:, c]
        enters, leaves = ~s & np.roll(s, -1, 1), s & ~np.roll(s, -1, 1)
        # Where the signs alternate, the saddle of the bilinear values tells which corners are joined.
        twice, even = enters.sum(1) == 2, s[:, 0]
        g = f[:, c]
        first, second = g[:, 0] * g[:, 2], g[:, 1] * g[:, 3]
        apart = np.where(even, first < second, second < first)
        for k in range(4):
            rows = np.flatnonzero(enters[:, k])
            end = np.where(twice, np.where(apart, (k + 1) % 4, (k - 1) % 4), leaves.argmax(1))
            following[rows, edge[k]] = np.array(edge)[end[rows]]
    return following


def _trilinear(f: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value (N,) and gradient (N, 3), by voxels, at places u (N, 3) in voxels with the corners f (N, 8)."""
    weight = np.where(CORNERS, u[:, None], 1 - u[:, None])  # (N, 8, 3)
    value = (f * weight.prod(2)).sum(1)
    sign = np.where(CORNERS, 1, -1)
    others = np.stack([np.delete(weight, k, 2).prod(2) for k in range(3)], 2)
    return value, (f[..., None] * sign * others).sum(1)


def triangulate(values: np.ndarray) -> Triangles:
    """Divide the surface of a grid of values, (Z, Y, X), into triangles."""
    size = np.array(values.shape[::-1])
    stride = np.array([1, size[0], size[0] * size[1]])
    offset, flat = CORNERS @ stride, values.ravel().astype(np.float64)
    z, y, x = (a.ravel() for a in np.meshgrid(*(np.arange(n - 1) for n in values.shape), indexing="ij"))
    base = np.stack([x, y, z], 1) @ stride
    negative = (flat < 0)[base[:, None] + offset].sum(1)
    base = base[(negative > 0) & (negative < 8)]
    corners = base[:, None] + offset
    f = flat[corners]
    following = _next_edges(f)
    voxel, edge = np.nonzero(following >= 0)
    after = following[voxel, edge]

    # ---------------------- Vertices on edges of voxels ----------------------

    a, b = np.array(EDGES).T
    key = corners[:, a] * 3 + AXIS_OF_EDGE
    used, place = np.unique(key[voxel, edge], return_inverse=True)
    ends = np.stack([used // 3, used // 3 + stride[used % 3]], 1)
    number = np.full((len(base), 12), -1)
    number[voxel, edge] = place.ravel()
    part = f[:, a] / np.where(following >= 0, f[:, a] - f[:, b], 1)
    at = CORNERS[a] + part[..., None] * (CORNERS[b] - CORNERS[a])  # (N, 12, 3)

    # ---------------------- And in the middle of loops ----------------------

    loop, current = np.broadcast_to(np.arange(12), following.shape).copy(), following
    for _ in range(11):
        loop = np.where(following >= 0, np.minimum(loop, np.maximum(current, 0)), loop)
        current = np.take_along_axis(following, np.maximum(current, 0).astype(np.int64), 1)
    which, middle_of = np.unique(voxel * 12 + loop[voxel, edge], return_inverse=True)
    middle_of, inside = middle_of.ravel(), which // 12
    count = np.bincount(middle_of)
    middle = np.stack([np.bincount(middle_of, at[voxel, edge, k]) / count for k in range(3)], 1)
    for _ in range(STEPS):
        value, gradient = _trilinear(f[inside], middle)
        middle = np.clip(middle - (value / np.maximum((gradient**2).sum(1), 1e-30))[:, None] * gradient, 0, 1)
    faces = np.stack([number[voxel, edge], number[voxel, after], len(used) + middle_of], 1)

    # ---------------------- How far they are from the surface ----------------------

    p, q, m = at[voxel, edge], at[voxel, after], middle[middle_of]
    slack = np.zeros(len(used) + len(which))
    for x in (0.5 * (p + q), 0.5 * (p + m), 0.5 * (q + m), (p + q + m) / 3):
        value, gradient = _trilinear(f[voxel], x)
        off = np.abs(value) / np.maximum(np.linalg.norm(gradient, axis=1), 1e-30)
        for k in range(3):
            np.maximum.at(slack, faces[:, k], np.minimum(off, 1))
    turn = _turn(values).ravel()[base[voxel]]
    bend = np.zeros(len(slack))
    for k in range(3):
        np.maximum.at(bend, faces[:, k], turn)
    for most in (slack, bend):
        around = most[faces].max(1)
        for k in range(3):
            np.maximum.at(most, faces[:, k], around)
    across = ACROSS[edge, after]
    lines, first = np.unique(np.sort(faces[:, :2], axis=1), axis=0, return_index=True)
    on_faces = lines, across[first], _sag(f[voxel[first]], p[first], q[first], across[first])
    return Triangles(ends, used % 3, corners[inside], middle, faces.astype(np.uint32), slack, bend, *on_faces)


def _sag(f: np.ndarray, p: np.ndarray, q: np.ndarray, across: np.ndarray) -> np.ndarray:
    """How far from the line between p and q, (N, 3), the surface is in the face of a voxel: (N,), at most 1. Across the
    line, values in the face are quadratic. f : values at the corners, (N, 8). across : the axis across the face."""
    along, most = q - p, np.zeros(len(p))
    length = np.linalg.norm(along, axis=1)
    aside = np.cross(along, np.eye(3)[across]) / np.where(length > 0, length, 1)[:, None]
    for t in PLACES:
        x = p + t * along
        before, here, behind = (_trilinear(f, x + s * aside)[0] for s in (-1, 0, 1))
        A, B = 0.5 * (before + behind) - here, 0.5 * (behind - before)
        root = -0.5 * (B + np.copysign(np.sqrt(np.maximum(B * B - 4 * A * here, 0)), B))
        most = np.maximum(most, np.abs(here) / np.maximum(np.abs(root), 1e-30))
    return np.minimum(most, 1)


def _turn(values: np.ndarray) -> np.ndarray:
    """By how much the gradient of the values turns across the voxel that begins at each: radians, at most 1. (Inside of
    a voxel, trilinear values do not tell: along an axis, they are straight.)"""
    gradient = np.stack(np.gradient(values.astype(np.float64)), 3)
    n = np.array(values.shape) - 1
    at = [gradient[z : z + n[0], y : y + n[1], x : x + n[2]] for x, y, z in CORNERS]
    mean = sum(at) / 8
    off = np.max([np.linalg.norm(g - mean, axis=3) for g in at], axis=0)
    turn = np.ones(values.shape)
    turn[:-1, :-1, :-1] = np.minimum(2 * off / np.maximum(np.linalg.norm(mean, axis=3), 1e-30), 1)
    return turn
