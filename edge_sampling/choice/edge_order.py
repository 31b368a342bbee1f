"""In which order edges stand in the leaves of an `EdgeTree`, and how its nodes are linked: found on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Most edges of a leaf. They are tested one by one.
LEAF = 8

#: Edges longer than so many times the mean are cut into pieces. A node with an edge that reaches far out of it would
#: seem far away to points beside its other edges (Ernst and Greiner 2007, "Early Split Clipping for Bounding Volume
#: Hierarchies").
LONG = 8

#: Levels that trees may have beyond those of a balanced one.
SPARE = 8


@dataclass
class Order:
    """Trees, one for each of several groups of items. Nodes are numbered: inner ones first, level by level from the
    roots, then leaves, from left to right.

    items : (P,), those of each leaf follow one another.
    roots : (G,), the root of each group. children : (I, 2), of each inner node. levels : the number of inner nodes of
        each level. first : (L + 1,), where in `items` each leaf begins, and the last one ends.
    """

    items: np.ndarray
    roots: np.ndarray
    children: np.ndarray
    levels: list[int]
    first: np.ndarray

    @property
    def leaves(self) -> int:
        return len(self.first) - 1


def pieces(length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut edges that are `LONG`, which adds at most one piece for each so many edges: of each piece its edge, (P,), and
    from where to where on that it extends, (P, 2), float32.

    length : (E,), scene units; 0 for what is to stay whole.
    """
    longest = LONG * length.sum() / max(np.count_nonzero(length), 1)
    count = np.ones(len(length), int)
    if 0 < longest < np.inf:
        count = np.maximum(np.ceil(length / longest), 1).astype(int)
    edge = np.repeat(np.arange(len(length)), count)
    k = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    return edge, (np.stack([k, k + 1], 1) / count[edge, None]).astype(np.float32)


def order(centres: np.ndarray, groups: list[np.ndarray], apart: np.ndarray) -> Order:
    """Halve groups of items in the middle of the longest side of the box around their centres, so that what lies far
    from all others gets a node of its own early; or at the median, where a tree would get too deep.

    centres : (P, 3), finite. groups : indices into `centres`. apart : (P,), bool, which items have subtrees of their
        own.
    """
    items = np.concatenate(groups)
    size = np.array([len(g) for g in groups])
    start = np.cumsum(size) - size
    deepest = max(_levels(size).max() + SPARE, 1)
    children, levels, first = [], [], []
    number_of_leaf: list[np.ndarray] = []
    above = 0
    while len(size):
        inner = size > LEAF
        # Leaves are numbered from -1 downwards as long as it is not known how many inner nodes there are.
        number = np.cumsum(inner) - 1 + above
        number[~inner] = -1 - len(first) - np.arange((~inner).sum())
        first += start[~inner].tolist()
        number_of_leaf.append(number)
        levels.append(int(inner.sum()))
        above += levels[-1]
        start, size = start[inner], size[inner]
        if len(size):
            where = np.repeat(start - (np.cumsum(size) - size), size) + np.arange(size.sum())
            room = deepest - len(levels)
            items[where], left = _halved(items[where], centres, size, room, apart if len(levels) == 1 else None)
            start = np.stack([start, start + left], 1).ravel()
            size = np.stack([left, size - left], 1).ravel()
    # From left to right.
    rank = np.argsort(np.argsort(first))
    final = [np.where(n < 0, above + rank[-1 - np.minimum(n, -1)], n) for n in number_of_leaf]
    children = np.concatenate([n.reshape(-1, 2) for n in final[1:]]) if above else np.zeros((0, 2), int)
    return Order(items, final[0], children, [n for n in levels if n], np.append(np.sort(first), len(items)))


def _levels(size: np.ndarray) -> np.ndarray:
    """Of balanced trees over so many items, below the root."""
    return np.ceil(np.log2(np.maximum(size / LEAF, 1))).astype(int)


def _halved(
    items: np.ndarray, centres: np.ndarray, size: np.ndarray, room: int, apart: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Items in nodes of these sizes, such that those on the left come first, and how many these are: (nodes,).

    room : how many levels there may be below the halves.
    """
    begin = np.cumsum(size) - size
    node = np.repeat(np.arange(len(size)), size)
    c = centres[items]
    lower, upper = (f.reduceat(c, begin) for f in (np.minimum, np.maximum))
    axis = (upper - lower).argmax(1)
    key = c[np.arange(len(c)), axis[node]]
    middle = 0.5 * (lower + upper)[np.arange(len(size)), axis]
    right = key > middle[node]
    if apart is not None:
        right = np.where((np.bincount(node, apart[items]) % size > 0)[node], apart[items], right)
    left = size - np.bincount(node, right).astype(int)
    bad = (left == 0) | (left == size) | (_levels(np.maximum(left, size - left)) > room)
    if bad.any():
        of_bad = np.flatnonzero(bad[node])
        sorted_ = of_bad[np.lexsort((key[of_bad], node[of_bad]))]
        # Sorted by node, they take the same places.
        right[sorted_] = (np.arange(len(c)) - begin[node] >= (size // 2)[node])[of_bad]
        left = np.where(bad, size // 2, left)
    before = np.cumsum(right) - right
    before -= before[begin][node]
    i = np.arange(len(c)) - begin[node]
    place = begin[node] + np.where(right, left[node] + before, i - before)
    found = np.empty_like(items)
    found[place] = items
    return found, left
