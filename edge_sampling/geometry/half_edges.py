"""The sides of triangles, sorted by the edges of welded meshes; and over which of them a surface goes on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Of faces that go on from each other at an edge that has more than two, directions away from it are opposite but for
#: this, a sine.
STRAIGHT_ON = 1e-4


@dataclass(frozen=True)
class HalfEdges:
    """Side k of face f, from its corner k to k + 1, has the number 3 f + k.

    side : (H,), int64; the numbers of all sides, those of one edge behind one another.
    first : (E,), int64; where in `side` those of each edge begin.
    count : (E,), int64; how many it has.
    """

    side: np.ndarray
    first: np.ndarray
    count: np.ndarray

    @staticmethod
    def of(place: np.ndarray, face: np.ndarray, *, repeated: bool = False) -> HalfEdges:
        """Those of faces with an area. place : (V,), of vertices. face : (F, 3), vertices. repeated : also of further
        faces in one place?"""
        w = place[face]
        alive = np.flatnonzero((w[:, 0] != w[:, 1]) & (w[:, 1] != w[:, 2]) & (w[:, 2] != w[:, 0]))
        n = int(place.max()) + 1 if len(place) else 1
        if not repeated:
            # Of triangles over the same three points, keep one.
            s = np.sort(w[alive], axis=1)
            order = np.argsort(mix(s))
            s = s[order]
            again = np.zeros(len(s), bool)
            again[1:] = (s[1:] == s[:-1]).all(1)
            alive = np.sort(alive[order[~again]])
        key = edge_key(w[alive].reshape(-1), np.roll(w[alive], -1, axis=1).reshape(-1), n)
        order = np.argsort(key, kind="stable")
        key = key[order]
        first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]])) if len(key) else np.zeros(0, np.int64)
        side = 3 * alive[order // 3] + order % 3
        return HalfEdges(side, first, np.diff(np.append(first, len(key))))

    def beyond(self, face: np.ndarray, point: np.ndarray) -> np.ndarray:
        """The side over which the surface goes on from each side, by number; −1 where it does not, (3 F,), int64.

        Of two faces, that is the other one. Of more, the one that lies in a plane with it, if one does.

        face : (F, 3), vertices. point : (V, 3), their positions.
        """
        found = np.full(face.size, -1)
        pair = self.first[self.count == 2]
        found[self.side[pair]], found[self.side[pair + 1]] = self.side[pair + 1], self.side[pair]
        several = np.flatnonzero(self.count > 2)
        if not len(several):
            return found
        first, count = self.first[several], self.count[several]
        edge = np.repeat(np.arange(len(several)), count)
        here = _count_up(first, count)
        f, k = np.divmod(self.side[here], 3)
        a, b, c = (point[face[f, (k + i) % 3]].astype(np.float64) for i in range(3))
        along = b - a
        away = (c - a) - along * (np.einsum("ij,ij->i", c - a, along) / np.square(along).sum(1))[:, None]
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), np.finfo(float).tiny)
        # Each side against all those of its edge, among which its own never fits.
        start = np.cumsum(count) - count
        one, other = np.repeat(np.arange(len(here)), count[edge]), _count_up(start[edge], count[edge])
        bend = np.linalg.norm(away[one] + away[other], axis=1)
        order = np.lexsort((bend, one))
        best = order[np.searchsorted(one[order], np.arange(len(here)))]
        straight = bend[best] <= STRAIGHT_ON
        found[self.side[here[straight]]] = self.side[here[other[best[straight]]]]
        return found


def edge_key(a: np.ndarray, b: np.ndarray, n: int) -> np.ndarray:
    """A number for each pair of numbers below n, in any order."""
    return np.minimum(a, b) * n + np.maximum(a, b)


def mix(rows: np.ndarray) -> np.ndarray:
    """Hash the columns of `rows`, four at most, into one: uint64."""
    odd = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x27D4EB2F165667C5)
    columns = rows.astype(np.uint64).T
    return np.bitwise_xor.reduce([c * np.uint64(o) for c, o in zip(columns, odd, strict=False)])


def _count_up(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """first[0], first[0] + 1, …, of `count` numbers each."""
    start = np.cumsum(count) - count
    return np.repeat(first - start, count) + np.arange(int(count.sum()))
