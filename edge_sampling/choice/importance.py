"""How much the boundaries among the edges of a node, or a single edge, contribute about, as a viewer sees them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.beside import EDGE_ON

from .edge_tree import Node, Slot
from .on_edge import MARGIN, along_and_off, falloff, is_silhouette, narrow, part_in_view
from .views import View

#: Part of the length of a node that counts even where its moments promise no silhouette.
FLOOR = 0.01

#: Square of the sine of the angle from the axis of a cone below which rounding decides on which side a node is.
ON_AXIS = 1e-8


def importance(node: Node, view: View) -> mi.Float:
    """About what the boundaries among the edges of a node contribute; 0 only where they certainly contribute nothing.

    Under an angle of length / r, an edge is seen; and the closer it is, the faster its direction turns, by 1 / r again.

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
    length = dr.select(possible, node.always + node.silhouettes * (silhouettes + FLOOR), 0)

    lower, upper = mi.Vector3f(node.lower), mi.Vector3f(node.upper)
    half = 0.5 * view.w * (upper - lower)
    d = 0.5 * view.w * (upper + lower) - view.p
    if view.vicinity is not None:
        outside = dr.maximum(dr.abs(d) - half, 0)
        length += node.creases * (1 - view.vicinity.far(dr.squared_norm(outside)))
    size2 = dr.squared_norm(half)
    r2 = dr.squared_norm(d) + size2
    above = dr.dot(view.n, d) + dr.dot(dr.abs(view.n), half)
    possible = (above > 0) | dr.all(view.n == 0)
    cosine = dr.select(dr.all(view.n == 0), 1, dr.clip(above * dr.rsqrt(r2), 0, 1))
    weight = view.wide * cosine
    for lobe in view.lobes:
        # What the lobe is on average over the directions of the node: one that is wider, by the extent of the node.
        along, off2 = along_and_off(lobe.axis, d)
        narrow2 = dr.square(lobe.width) * r2
        wide2 = narrow2 + size2 / 3
        weight += lobe.peak * narrow2 / wide2 * falloff(dr.select(along > 0, off2, r2) / wide2)
    if view.cone is not None:
        cone = view.cone
        # About the part of the node that is inside: of its extent across the plane that touches the cone on the side of
        # the node, and of its extent along this plane. 0 only if it is certainly outside.
        along, off2 = along_and_off(cone.axis, d)
        outwards = (d - cone.axis * along) * (cone.cos * dr.rsqrt(off2)) - cone.axis * cone.sin
        middle, extent = dr.dot(outwards, d), dr.dot(dr.abs(outwards), half)
        inside = dr.clip(0.5 - 0.5 * middle / extent, 0, 1)
        narrow2 = dr.square(cone.sin) * r2
        # Where the node is on the axis, up to rounding, or has no extent, it is as good as inside.
        certain = cone.everything | (off2 <= ON_AXIS * dr.squared_norm(d)) | (extent == 0)
        weight *= dr.select(certain, 1, inside * narrow2 / (narrow2 + size2 / 3))
    result = length * weight * dr.rcp(r2)
    return dr.select(possible & (length > 0) & dr.isfinite(result), result, 0)


def edge_importance(slot: Slot, view: View) -> mi.Float:
    """What `importance` is for a node, for a single edge. Zero where that is no boundary."""
    a, b, start, end = part_in_view(slot, view)
    length_a, length_b = dr.norm(a), dr.norm(b)
    boundary = is_silhouette(slot, view)
    near = mi.Float(1)
    if view.vicinity is not None:
        # As near as the part in view comes.
        e = b - a
        t = dr.clip(-dr.dot(a, e) / dr.squared_norm(e), 0, 1)
        near = dr.select(boundary, 1, slot.crease * (1 - view.vicinity.far(dr.squared_norm(a + t * e))))
        boundary |= near > 0
    above = [dr.dot(view.n, v) for v in (a, b)]
    everywhere = dr.all(view.n == 0)
    boundary &= (above[0] > EDGE_ON * length_a) | (above[1] > EDGE_ON * length_b) | everywhere
    product = length_a * length_b
    across = dr.norm(dr.cross(a, b))
    # Twice the tangent of half the angle under which the edge is seen: near enough to the angle, but for large ones.
    angle = dr.minimum(2 * across / dr.maximum(product + dr.dot(a, b), 0), dr.pi)
    cosine = dr.clip(0.5 * (above[0] / length_a + above[1] / length_b), 0, 1) + MARGIN
    result = view.wide * angle * dr.select(everywhere, 1, cosine)
    e = b - a
    length = dr.norm(e)
    h = across / length
    for lobe in view.lobes:
        result += narrow(lobe, a, e / length, length, h).total
    # The mean of 1 / r over the angle, which is ∫ cos φ dφ / h: where rounding spoils it, within its bounds.
    mean = (dr.dot(b, e) / length_b - dr.dot(a, e) / length_a) / (across * angle)
    result *= dr.clip(mean, dr.rcp(dr.maximum(length_a, length_b)), dr.rcp(h))
    if view.far is not None:
        # Not the angle, but the extent across the direction of view.
        across = dr.select(view.far, dr.norm(dr.cross(slot.b - slot.a, view.p)), across)
        result = dr.select(view.far, view.wide * across, result)
    boundary &= (across > 0) & (start < end)
    result *= near
    return dr.select(boundary & dr.isfinite(result), result, 0)


def _quadratic(y):
    products = [(1 if i == j else 2) * y[i] * y[j] for i in range(4) for j in range(i, 4)]
    return lambda m: sum(a * b for a, b in zip(m, products, strict=True))
