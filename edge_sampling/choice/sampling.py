"""Choosing an edge, and a point on it, as a point of the scene sees them: a random descent of an `EdgeTree`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .edge_tree import EdgeTree
from .importance import edge_importance, importance
from .on_edge import sample_point
from .views import View


@dataclass
class EdgeSample:
    """An edge, and a point on it.

    edge : mi.UInt32, index of the edge.
    t : mi.Float, the point is (1 - t) a + t b.
    density : mi.Float, probability of the edge times density of t; 0 where no boundary was found.
    """

    edge: mi.UInt32
    t: mi.Float
    density: mi.Float


def sample_edge(
    tree: EdgeTree,
    view: View,
    sampler: mi.Sampler,
    use: list[mi.Float | float],
    *,
    choice: mi.Float,
    active: mi.Bool,
) -> EdgeSample:
    """Descend the tree at random, in proportion to the importance of the children of each node; test the edges of the
    leaf one by one; choose a point on one.

    use : for each group of edges of the tree, how much to prefer it; 0: do not choose from it.
    choice : uniform in [0, 1); makes the first choices, so it pays to stratify it.

    Returns
    -------
    EdgeSample, (N,)
    """
    descent = _choose_group(tree, view, use, mi.Float(choice), mi.Bool(active))
    if tree.is_deep:
        descent = _down_to_a_leaf(tree, view, descent, sampler)
    return _edge_of_the_leaf(tree, view, descent, sampler)


@dataclass
class _Descent:
    """A way down a tree. (A Dr.Jit structure: the state of a loop.)

    node : its number. density : probability of the choices so far.
    choice : uniform in [0, 1); what is left of a random number after each choice is uniform again.
    alive : does anything down there count?
    """

    node: mi.UInt32
    density: mi.Float
    choice: mi.Float
    alive: mi.Bool


def _choose_group(tree: EdgeTree, view: View, use, choice: mi.Float, active: mi.Bool) -> _Descent:
    """The root of one of the trees."""
    density, total, node = mi.Float(1), mi.Float(0), mi.UInt32(0)
    for root, preference in zip(tree.roots, use, strict=True):
        weight = mi.Float(preference)
        # A few edges are tested faster than their node.
        if len(use) > 1 and tree.is_deep:
            weight *= importance(tree.node(root), view)
        total += weight
        p = dr.select(total > 0, weight / total, 0)
        taken = choice < p
        choice = dr.select(taken, choice / p, (choice - p) / (1 - p))
        density = dr.select(taken, p, density * (1 - p))
        node = dr.select(taken, root, node)
    node += dr.zeros(mi.UInt32, dr.width(view.p))
    return _Descent(node, density, choice, active & (total > 0))


def _down_to_a_leaf(tree: EdgeTree, view: View, at: _Descent, sampler: mi.Sampler) -> _Descent:
    def down(node, density, choice, alive, sampler):
        children = tree.children(node, alive)
        weights = [importance(tree.node(child, alive), view) for child in children]
        total = weights[0] + weights[1]
        alive &= total > 0
        choice = _renewed(choice, density, sampler, alive)
        p = weights[0] / total
        left = choice < p
        choice = dr.select(left, choice / p, (choice - p) / (1 - p))
        density = dr.select(alive, density * dr.select(left, p, 1 - p), 0)
        node = dr.select(alive, dr.select(left, *children), node)
        return node, density, choice, alive, sampler

    node, density, choice, alive, _ = dr.while_loop(
        (at.node, at.density, at.choice, at.alive, sampler),
        lambda n, d, c, a, s: a & (n < tree.inner),
        down,
        label="edge tree",
    )
    return replace(at, node=node, density=density, choice=choice, alive=alive)


def _edge_of_the_leaf(tree: EdgeTree, view: View, at: _Descent, sampler: mi.Sampler) -> EdgeSample:
    width, alive = dr.width(view.p), at.alive
    choice = _renewed(at.choice, at.density, sampler, alive)
    first, count = tree.slots_of(at.node, alive)

    def test(k, total, chosen, weight, choice):
        slot = tree.slot(first + k, alive)
        w = edge_importance(slot, view)
        total += w
        p = dr.select(total > 0, w / total, 0)
        taken = choice < p
        choice = dr.select(taken, choice / p, (choice - p) / (1 - p))
        return k + 1, total, dr.select(taken, k, chosen), dr.select(taken, w, weight), choice

    state = (dr.zeros(mi.UInt32, width), dr.zeros(mi.Float, width), dr.zeros(mi.UInt32, width))
    _, total, chosen, weight, choice = dr.while_loop(
        (*state, dr.zeros(mi.Float, width), choice),
        lambda k, *_: alive & (k < count),
        test,
        label="edges of a leaf",
    )
    alive &= total > 0
    slot = first + chosen
    which = sampler.next_1d(alive) if view.lobes else mi.Float(0)
    t, pdf = sample_point(tree.slot(slot, alive), view, which, choice)
    start, end = tree.part(slot, alive)
    density = dr.select(alive, at.density * weight / total * pdf / (end - start), 0)
    edge, t = dr.gather(mi.UInt32, tree.slot_edge, slot, alive), dr.lerp(start, end, t)
    return EdgeSample(edge, t, dr.select(dr.isfinite(density), density, 0))


@dataclass
class Reservoir:
    """Of several samples one, in proportion to a target over density (Talbot et al. 2005, "Importance Resampling for
    Global Illumination"). (A Dr.Jit structure: the state of a loop; empty if zero.)

    edge, t : of the one that is kept. target : its own. total : of all, target over density.
    """

    edge: mi.UInt32
    t: mi.Float
    target: mi.Float
    total: mi.Float

    def take(self, e: EdgeSample, target: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> tuple[Reservoir, mi.Bool]:
        """With one sample more; and is it this that is kept?"""
        weight = dr.select(e.density > 0, target / e.density, 0)
        weight = dr.select(active & dr.isfinite(weight), weight, 0)
        total = self.total + weight
        taken = sampler.next_1d(active) * total < weight
        choose = lambda a, b: dr.select(taken, a, b)
        return Reservoir(choose(e.edge, self.edge), choose(e.t, self.t), choose(target, self.target), total), taken

    def kept(self, count: mi.Float | int) -> EdgeSample:
        """The one that is kept, of so many. Its `density` is what an unbiased estimate divides by, though no
        density."""
        return EdgeSample(self.edge, self.t, dr.select(self.total > 0, self.target * count / self.total, 0))


def _renewed(choice: mi.Float, density: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> mi.Float:
    """A random number has 24 bits. Where choices have used up eight, a fresh one takes its place."""
    return dr.select(density < 2**-8, sampler.next_1d(active), choice)


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a strategy with density a against one with density b (Veach 1997, Eq. 9.13, with β = 2). Detached."""
    a2, b2 = dr.square(dr.detach(a)), dr.square(dr.detach(b))
    weight = a2 / (a2 + b2)
    return dr.select(dr.isfinite(weight), weight, 0)


def stratified(sampler: mi.Sampler, seed: mi.UInt32 | int) -> mi.Float:
    """Uniform numbers, of which each 64 that follow one another are stratified, and each 2, 4, … of these as well:
    the van der Corput sequence, jittered, and shifted for each 64 by another random number, so that each number by
    itself is uniform."""
    i = dr.arange(mi.UInt32, sampler.wavefront_size())
    if not isinstance(seed, mi.UInt32):
        seed = dr.opaque(mi.UInt32, int(seed))
    shift = mi.sample_tea_float32(i >> 6, seed)
    x = (mi.Float(dr.brev(i << 26)) + sampler.next_1d()) / 64 + shift
    return dr.minimum(x - dr.floor(x), dr.one_minus_epsilon(mi.Float))
