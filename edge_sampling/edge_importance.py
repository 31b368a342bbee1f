"""Choosing an edge, and a point on it, as a point of the scene sees them: a random descent of an `EdgeTree`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .edge_tree import EDGE_ON, LEAF, EdgeTree, Node, Slot

#: Part of the length of a node that counts even where its moments promise no silhouette.
FLOOR = 0.01


@dataclass
class Lobe:
    """Weight of directions near to an axis: peak · (1 + (tan θ / width)²)^(-3/2). Integrated along a line, this has a
    closed form."""

    axis: mi.Vector3f
    peak: mi.Float
    width: mi.Float


@dataclass
class Cone:
    """Directions that matter: those within an angle α < 90° of an axis; or all of them, where its cosine is -1.

    axis : mi.Vector3f, unit length.
    cos, sin : mi.Float, of α.
    """

    axis: mi.Vector3f
    cos: mi.Float
    sin: mi.Float

    @property
    def everything(self) -> mi.Bool:
        return self.cos < 0


@dataclass
class View:
    """From where the edges are looked at, and what is wanted of them: a sum of weights of directions.

    p : mi.Vector3f, relative to the centre of the tree; for a viewer at infinity, the direction towards it.
    n : mi.Vector3f, unit normal: directions below its plane are of no use. Zero where all are.
    wide : mi.Float, weight of all directions above the plane, by their cosine.
    lobes : around which there is more.
    cone : outside of which there is nothing; None: all directions count.
    far : mi.Bool, is the viewer at infinity? None: nowhere. Not with lobes or cones.
    """

    p: mi.Vector3f
    n: mi.Vector3f
    wide: mi.Float
    lobes: list[Lobe]
    cone: Cone | None = None
    far: mi.Bool | None = None

    @property
    def w(self) -> mi.Float | float:
        """Homogeneous coordinate that goes with p: 1, or 0 at infinity. A point x is seen in the direction w x - p."""
        return 1.0 if self.far is None else dr.select(self.far, mi.Float(0), 1)


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
    from_light: bool,
    active: mi.Bool,
) -> EdgeSample:
    """Descend the tree at random, in proportion to the importance of the children of each node; test the edges of the
    leaf one by one; choose a point on one.

    use : for each group of edges of the tree, how much to prefer it; 0: do not choose from it.
    choice : uniform in [0, 1); makes the first choices, so it pays to stratify it.
    from_light : the importance of an edge falls off with the square of its distance, not with the distance itself.

    Returns
    -------
    EdgeSample, (N,)
    """
    width = dr.width(view.p)
    density = mi.Float(1)
    bottom, node_offset, leaf_offset = mi.UInt32(1), mi.UInt32(0), mi.UInt32(0)

    # ---------------------- Which group ----------------------

    # What is left of a random number after each choice is uniform again.
    total, choice = mi.Float(0), mi.Float(choice)
    for k, preference in enumerate(use):
        weight = mi.Float(preference)
        # A few edges are tested faster than their node.
        if len(use) > 1 and max(tree.depths) > 0:
            weight *= importance(tree.node(tree.device_node_offsets[k] + 1), view, from_light)
        total += weight
        p = dr.select(total > 0, weight / total, 0)
        taken = choice < p
        choice = dr.select(taken, choice / p, (choice - p) / (1 - p))
        density = dr.select(taken, p, density * (1 - p))
        bottom = dr.select(taken, tree.bottoms[k], bottom)
        node_offset = dr.select(taken, tree.device_node_offsets[k], node_offset)
        leaf_offset = dr.select(taken, tree.device_leaf_offsets[k], leaf_offset)
    node = dr.full(mi.UInt32, 1, width)
    alive = mi.Bool(active) & (total > 0)

    # ---------------------- Down to a leaf ----------------------

    if max(tree.depths) > 0:

        def down(node, density, choice, alive, sampler):
            child = 2 * node
            weights = [importance(tree.node(child + k + node_offset, alive), view, from_light) for k in (0, 1)]
            total = weights[0] + weights[1]
            alive &= total > 0
            choice = _renewed(choice, density, sampler, alive)
            p = weights[0] / total
            left = choice < p
            choice = dr.select(left, choice / p, (choice - p) / (1 - p))
            density = dr.select(alive, density * dr.select(left, p, 1 - p), 0)
            node = dr.select(alive, child + dr.select(left, mi.UInt32(0), mi.UInt32(1)), node)
            return node, density, choice, alive, sampler

        node, density, choice, alive, sampler = dr.while_loop(
            (node, density, choice, alive, sampler),
            lambda n, d, c, a, s: a & (n < bottom),
            down,
            label="edge tree",
        )

    # ---------------------- The edges of the leaf ----------------------

    choice = _renewed(choice, density, sampler, alive)
    first = (node - bottom + leaf_offset) * LEAF

    def test(k, total, chosen, weight, choice):
        slot = tree.slot(first + k, alive)
        w = edge_importance(slot, view, from_light)
        total += w
        p = dr.select(total > 0, w / total, 0)
        taken = choice < p
        choice = dr.select(taken, choice / p, (choice - p) / (1 - p))
        return k + 1, total, dr.select(taken, k, chosen), dr.select(taken, w, weight), choice

    state = (dr.zeros(mi.UInt32, width), dr.zeros(mi.Float, width), dr.zeros(mi.UInt32, width))
    _, total, chosen, weight, choice = dr.while_loop(
        (*state, dr.zeros(mi.Float, width), choice),
        lambda k, *_: alive & (k < tree.leaf_size),
        test,
        label="edges of a leaf",
    )
    alive &= total > 0
    slot = first + chosen
    which = sampler.next_1d(alive) if view.lobes else mi.Float(0)
    t, pdf = _sample_point(tree.slot(slot, alive), view, which, choice)
    density = dr.select(alive, density * weight / total * pdf, 0)
    return EdgeSample(dr.gather(mi.UInt32, tree.slot_edge, slot, alive), t, dr.select(dr.isfinite(density), density, 0))


def resample(
    draw: Callable[[mi.Float, mi.Sampler], EdgeSample],
    target: Callable[[EdgeSample], mi.Float],
    sampler: mi.Sampler,
    count: int,
    active: mi.Bool,
) -> EdgeSample:
    """Of a few samples keep one, in proportion to `target` over density (Talbot et al. 2005, "Importance Resampling for
    Global Illumination"): the more there are, the closer the density comes to `target`.

    draw : makes the k-th sample.
    target : of the density with respect to t; 0 only where the integrand is.

    Returns
    -------
    EdgeSample, (N,). Its `density` is what an unbiased estimate divides by, though no density.
    """

    def step(k, kept, t, value, total, sampler):
        e = draw(k, sampler)
        new = target(e)
        weight = dr.select(e.density > 0, new / e.density, 0)
        weight = dr.select(active & dr.isfinite(weight), weight, 0)
        total += weight
        taken = sampler.next_1d(active) * total < weight
        choose = lambda a, b: dr.select(taken, a, b)
        return k + 1, choose(e.edge, kept), choose(e.t, t), choose(new, value), total, sampler

    width = dr.width(active)
    zero = dr.zeros(mi.Float, width)
    _, edge, t, value, total, _ = dr.while_loop(
        (mi.Float(zero), dr.zeros(mi.UInt32, width), mi.Float(zero), mi.Float(zero), mi.Float(zero), sampler),
        lambda k, *_: active & (k < count),
        step,
        label="candidates",
    )
    return EdgeSample(edge, t, dr.select(total > 0, value * count / total, 0))


def _renewed(choice: mi.Float, density: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> mi.Float:
    """A random number has 24 bits. Where choices have used up eight, a fresh one takes its place."""
    return dr.select(density < 2**-8, sampler.next_1d(active), choice)


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a strategy with density a against one with density b (Veach 1997, Eq. 9.13, with β = 2)."""
    a2, b2 = dr.square(a), dr.square(b)
    return dr.select(a2 > 0, a2 / (a2 + b2), 0)


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


# ---------------------- Importance ----------------------


def importance(node: Node, view: View, from_light: bool) -> mi.Float:
    """About what the boundaries among the edges of a node contribute; 0 only where they certainly contribute nothing.

    The number of sign changes of q·y among pairs of planes with mean μ, variance V, and a difference of second moment
    D is, for normally distributed planes, √(D/V) / π · exp(−μ² / 2V), where μ, V, D stand for μ·y, yᵀVy and yᵀDy.
    """
    y = [*view.p, -view.w]
    lower, upper = mi.Float(0), mi.Float(0)
    for i in range(4):
        s, t = node.plane_lower[i] * y[i], node.plane_upper[i] * y[i]
        lower += dr.minimum(s, t)
        upper += dr.maximum(s, t)
    possible = (lower <= 0) & (upper >= 0)

    quadratic = _quadratic(y)
    variance = dr.maximum(quadratic(node.variance), dr.smallest(mi.Float))
    difference = dr.maximum(quadratic(node.difference), 0)
    mean = sum(m * x for m, x in zip(node.mean, y, strict=True))
    # Planes are not normally distributed: this falls off like the exponential at first, but has a heavier tail.
    tail = dr.rcp(dr.square(dr.square(1 + 0.125 * mean * mean / variance)))
    silhouettes = dr.minimum(dr.sqrt(difference / variance) * dr.inv_pi * tail, 1)
    length = node.always + node.silhouettes * (silhouettes + FLOOR)

    lower, upper = mi.Vector3f(node.lower), mi.Vector3f(node.upper)
    half = 0.5 * view.w * (upper - lower)
    d = 0.5 * view.w * (upper + lower) - view.p
    size2 = dr.squared_norm(half)
    r2 = dr.squared_norm(d) + size2
    above = dr.dot(view.n, d) + dr.dot(dr.abs(view.n), half)
    possible &= (above > 0) | dr.all(view.n == 0)
    cosine = dr.select(dr.all(view.n == 0), 1, dr.clip(above * dr.rsqrt(r2), 0, 1))
    weight = view.wide * cosine
    for lobe in view.lobes:
        # What the lobe is on average over the directions of the node: one that is wider, by the extent of the node.
        along, off2 = _along_and_off(lobe.axis, d)
        narrow2 = dr.square(lobe.width) * r2
        wide2 = narrow2 + size2 / 3
        weight += lobe.peak * narrow2 / wide2 * _falloff(dr.select(along > 0, off2, r2) / wide2)
    if view.cone is not None:
        cone = view.cone
        # About the part of the node that is inside: of its extent across the plane that touches the cone on the side of
        # the node, and of its extent along this plane. 0 only if it is certainly outside.
        along, off2 = _along_and_off(cone.axis, d)
        outwards = (d - cone.axis * along) * (cone.cos * dr.rsqrt(off2)) - cone.axis * cone.sin
        middle, extent = dr.dot(outwards, d), dr.dot(dr.abs(outwards), half)
        inside = dr.clip(0.5 - 0.5 * middle / extent, 0, 1)
        narrow2 = dr.square(cone.sin) * r2
        # Where the cone has no axis at the node, or the node no extent, it is as good as inside.
        certain = cone.everything | (off2 == 0) | (extent == 0)
        weight *= dr.select(certain, 1, inside * narrow2 / (narrow2 + size2 / 3))
    result = length * weight * (dr.rcp(r2) if from_light else dr.rsqrt(r2))
    return dr.select(possible & (length > 0) & dr.isfinite(result), result, 0)


def edge_importance(slot: Slot, view: View, from_light: bool) -> mi.Float:
    """What `importance` is for a node, for a single edge. Zero where that is no boundary."""
    y = mi.Vector4f(view.p.x, view.p.y, view.p.z, -view.w)
    signs = [dr.dot(q, y) for q in slot.planes]
    edge_on = EDGE_ON * dr.norm(view.w * slot.a - view.p)
    a, b, start, end = _in_cone(slot, view)
    length_a, length_b = dr.norm(a), dr.norm(b)
    boundary = (signs[0] * signs[1] <= 0) | (dr.abs(signs[0]) <= edge_on) | (dr.abs(signs[1]) <= edge_on)
    above = [dr.dot(view.n, v) for v in (a, b)]
    everywhere = dr.all(view.n == 0)
    boundary &= (above[0] > EDGE_ON * length_a) | (above[1] > EDGE_ON * length_b) | everywhere
    product = length_a * length_b
    across = dr.norm(dr.cross(a, b))
    # Twice the tangent of half the angle under which the edge is seen: near enough to the angle, but for large ones.
    angle = dr.minimum(2 * across / (product + dr.dot(a, b)), dr.pi)
    cosine = dr.clip(0.5 * (above[0] / length_a + above[1] / length_b), 0, 1) + _MARGIN[from_light]
    result = view.wide * angle * dr.select(everywhere, 1, cosine)
    for lobe in view.lobes:
        e = b - a
        length = dr.norm(e)
        result += _narrow(lobe, a, e / length, length, across / length).total
    if from_light:
        result *= dr.rsqrt(product)
    if view.far is not None:
        # Not the angle, but the extent across the direction of view.
        across = dr.select(view.far, dr.norm(dr.cross(slot.b - slot.a, view.p)), across)
        result = dr.select(view.far, view.wide * across, result)
    boundary &= (across > 0) & (start < end)
    return dr.select(boundary & dr.isfinite(result), result, 0)


#: Added to the cosine of an edge, by whether a light looks: it stands for all of the edge, and the normal at a shading
#: point may be that of the face, not of the shading.
_MARGIN = {False: 0.05, True: 0.02}


def _quadratic(y):
    products = [(1 if i == j else 2) * y[i] * y[j] for i in range(4) for j in range(i, 4)]
    return lambda m: sum(a * b for a, b in zip(m, products, strict=True))


def _along_and_off(axis: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Part of d along an axis, and the square of its distance from the axis."""
    along = dr.dot(axis, d)
    return along, dr.squared_norm(d - axis * along)


def _in_cone(slot: Slot, view: View) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Float]:
    """The part of an edge that is in the cone of the view: its ends, seen from the viewer, and its interval of t. Where
    there is none, the ends are equal."""
    a, b = view.w * slot.a - view.p, view.w * slot.b - view.p
    if view.cone is None:
        return a, b, mi.Float(0), mi.Float(1)
    cone = view.cone
    e = b - a
    # In the cone, off² cos² - along² sin² <= 0 and along > 0. As a function of t, that is A t² + 2 B t + C.
    a_along, e_along = dr.dot(cone.axis, a), dr.dot(cone.axis, e)
    a_off, e_off = a - cone.axis * a_along, e - cone.axis * e_along
    cos2, sin2 = dr.square(cone.cos), dr.square(cone.sin)
    A = cos2 * dr.squared_norm(e_off) - sin2 * dr.square(e_along)
    B = cos2 * dr.dot(a_off, e_off) - sin2 * a_along * e_along
    C = cos2 * dr.squared_norm(a_off) - sin2 * dr.square(a_along)
    discriminant = B * B - A * C
    q = -(B + dr.mulsign(dr.safe_sqrt(discriminant), B))
    roots = q / A, dr.select(q != 0, C / q, 0)
    first, last = dr.minimum(*roots), dr.maximum(*roots)
    # A line that is less steep than the cone is inside between the roots; a steeper one beyond one of them.
    between = A > 0
    start = dr.select(between, first, dr.select(e_along > 0, last, -dr.inf))
    end = dr.select(between, last, dr.select(e_along > 0, dr.inf, first))
    before = -a_along / e_along
    start = dr.select(between & (e_along > 0), dr.maximum(start, before), start)
    end = dr.select(between & (e_along < 0), dr.minimum(end, before), end)
    nothing = between & ((discriminant < 0) | ((e_along == 0) & (a_along < 0)))
    start, end = dr.clip(start, 0, 1), dr.clip(end, 0, 1)
    end = dr.select(nothing, start, dr.maximum(start, end))
    start, end = dr.select(cone.everything, 0, start), dr.select(cone.everything, 1, end)
    return a + start * e, a + end * e, start, end


def _falloff(x: mi.Float) -> mi.Float:
    """(1 + x)^(-3/2)"""
    r = dr.rsqrt(1 + x)
    return r * r * r


# ---------------------- The point on the edge ----------------------


@dataclass
class _Wide:
    """Density of a point on an edge in proportion to the angle under which it is seen.

    With s along the line from the foot of the perpendicular from the viewer, of length h: s = h tan φ.
    """

    foot: mi.Float
    h: mi.Float
    start: mi.Float
    angle: mi.Float
    total: mi.Float

    def sample(self, u: mi.Float) -> mi.Float:
        return self.foot + self.h * dr.tan(self.start + u * self.angle)

    def pdf(self, s: mi.Float) -> mi.Float:
        return self.h / (self.angle * (dr.square(self.h) + dr.square(s - self.foot)))


@dataclass
class _Narrow:
    """Density in proportion to (a² + s²)^(-3/2), with s along the line from where it comes closest to an axis. Its
    integral is s / (a² √(a² + s²)), in units of a."""

    closest: mi.Float
    a: mi.Float
    start: mi.Float
    extent: mi.Float
    total: mi.Float

    def sample(self, u: mi.Float) -> mi.Float:
        v = self.start + u * self.extent
        return self.closest + self.a * v * dr.rsqrt(dr.maximum(1 - v * v, 1e-7))

    def pdf(self, s: mi.Float) -> mi.Float:
        x = (s - self.closest) / self.a
        return _falloff(x * x) / (self.a * self.extent)


def _on_line(a: mi.Vector3f, b: mi.Vector3f, view: View) -> list[_Wide | _Narrow]:
    """Densities on an edge from a to b, as seen from the viewer, by length along it, with their weights: that of all
    directions, and of each lobe."""
    e = b - a
    length = dr.norm(e)
    e = e / length
    foot = -dr.dot(a, e)
    nearest = dr.maximum(dr.norm(a), dr.norm(a + e * length))
    h = dr.maximum(dr.norm(a + foot * e), 1e-6 * nearest)
    start = dr.atan2(-foot, h)
    angle = dr.maximum(dr.atan2(length - foot, h) - start, 1e-7)
    middle = dr.normalize(a + 0.5 * length * e)
    cosine = dr.select(dr.all(view.n == 0), 1, dr.clip(dr.dot(view.n, middle), 0, 1) + _MARGIN[False])
    wide = _Wide(foot, h, start, angle, view.wide * cosine * angle)
    return [wide, *(_narrow(lobe, a, e, length, h) for lobe in view.lobes)]


def _narrow(lobe: Lobe, a: mi.Vector3f, e: mi.Vector3f, length: mi.Float, h: mi.Float) -> _Narrow:
    """a : one end, seen from the viewer; e : direction of the edge; h : distance of its line."""
    across = lambda v: v - lobe.axis * dr.dot(lobe.axis, v)
    a_across, e_across = across(a), across(e)
    g2 = dr.maximum(dr.squared_norm(e_across), 1e-6)
    closest = dr.clip(-dr.dot(a_across, e_across) / g2, 0, length)
    c = a + closest * e
    r2 = dr.squared_norm(c)
    behind = dr.dot(lobe.axis, c) <= 0
    off2 = dr.select(behind, r2, dr.squared_norm(a_across + closest * e_across))
    A2 = dr.square(lobe.width) * r2
    k = dr.sqrt((A2 + off2) / g2)
    at = lambda s: (s - closest) / k * dr.rsqrt(1 + dr.square((s - closest) / k))
    start = at(mi.Float(0))
    extent = dr.maximum(at(length) - start, 1e-7)
    total = lobe.peak * A2 * dr.sqrt(A2) / (g2 * dr.sqrt(g2) * k * k) * extent * h / r2
    return _Narrow(closest, k, start, extent, dr.select(dr.isfinite(total), total, 0))


def _sample_point(slot: Slot, view: View, choice: mi.Float, u: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Parameter t of a point on the edge, and its density."""
    a, b, start, end = _in_cone(slot, view)
    length = dr.norm(b - a)
    densities = _on_line(a, b, view)
    total = sum(d.total for d in densities)
    s, below = densities[0].sample(u), densities[0].total
    for d in densities[1:]:
        s = dr.select(choice * total < below, s, d.sample(u))
        below = below + d.total  # not in place: it is the total of a density
    s = dr.clip(s, 0, length)
    pdf = sum(d.total * d.pdf(s) for d in densities) / total
    t, pdf = dr.lerp(start, end, s / length), pdf * length / (end - start)
    return (t, pdf) if view.far is None else (dr.select(view.far, u, t), dr.select(view.far, 1, pdf))
