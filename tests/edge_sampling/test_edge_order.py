"""In which order edges stand in the leaves of a tree: on the host, without a scene."""

from __future__ import annotations

import numpy as np
import pytest

from rimlight.edge_sampling.choice.edge_order import LEAF, LONG, SPARE, Order, order, pieces

RNG = np.random.default_rng(0)

#: Centres, and how many groups.
CENTRES = {
    "none of their own": (np.zeros((100, 3)), 1),
    "few": (RNG.normal(size=(LEAF, 3)), 1),
    "one more": (RNG.normal(size=(LEAF + 1, 3)), 1),
    "everywhere": (RNG.normal(size=(1000, 3)), 1),
    "in groups": (RNG.normal(size=(1000, 3)), 3),
    "ever closer": (0.5 ** np.arange(600.0)[:, None] * np.ones(3), 1),
    "in a line": (np.arange(500.0)[:, None] * [0, 0, 1], 2),
    "beside one far away": (np.concatenate([RNG.normal(size=(800, 3)), [[1e6, 0, 0]]]), 1),
}


def walk(tree: Order, node: int, depth: int = 0) -> list[tuple[int, list[int]]]:
    """Leaves below a node, from left to right: how deep, and their items."""
    inner = len(tree.children)
    if node >= inner:
        return [(depth, tree.items[tree.first[node - inner] : tree.first[node - inner + 1]].tolist())]
    assert (tree.children[node] > node).all()
    return [leaf for child in tree.children[node] for leaf in walk(tree, child, depth + 1)]


@pytest.mark.parametrize(("centres", "groups"), CENTRES.values(), ids=CENTRES)
def test_each_item_is_in_one_leaf_of_its_group(centres, groups):
    of_group = [np.arange(k, len(centres), groups) for k in range(groups)]
    tree = order(centres, of_group, np.zeros(len(centres), bool))
    assert len(tree.roots) == groups and sum(tree.levels) == len(tree.children)
    for root, group in zip(tree.roots, of_group, strict=True):
        leaves = walk(tree, root)
        assert sorted(i for _, items in leaves for i in items) == group.tolist()
        assert all(1 <= len(items) <= LEAF for _, items in leaves)
        assert max(depth for depth, _ in leaves) <= max(np.ceil(np.log2(len(group) / LEAF)), 0) + SPARE


def test_what_is_far_from_all_others_is_apart_at_once():
    centres, _ = CENTRES["beside one far away"]
    tree = order(centres, [np.arange(len(centres))], np.zeros(len(centres), bool))
    assert walk(tree, tree.children[0][1]) == [(0, [len(centres) - 1])]


def test_items_with_subtrees_of_their_own():
    centres = RNG.normal(size=(300, 3))
    apart = np.arange(300) % 7 == 0
    for groups in [np.arange(300)], [np.arange(0, 300, 2), np.arange(1, 300, 2)]:
        tree = order(centres, groups, apart)
        for root, group in zip(tree.roots, groups, strict=True):
            left, right = ({i for _, items in walk(tree, c) for i in items} for c in tree.children[root])
            assert right == set(group[apart[group]]) and left == set(group[~apart[group]])


def test_pieces_of_long_edges():
    length = np.ones(1000)
    length[[3, 17]] = 50, 0
    edge, part = pieces(length)
    assert set(edge) == set(range(1000)) and len(edge) <= 1000 * (1 + 1 / LONG)
    of_long = part[edge == 3]
    assert (of_long[0, 0], of_long[-1, 1]) == (0, 1) and (of_long[1:, 0] == of_long[:-1, 1]).all()
    assert len(of_long) == np.ceil(50 / (LONG * length.sum() / 999))
    assert (part[edge != 3] == (0, 1)).all()


@pytest.mark.parametrize("length", [[], [0, 0], [np.inf, 1], [1, 1e-30]])
def test_pieces_of_odd_edges(length):
    edge, part = pieces(np.array(length, float))
    assert (edge == np.arange(len(length))).all() and (part == (0, 1)).all()
