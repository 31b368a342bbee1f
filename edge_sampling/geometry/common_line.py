"""The piece of a line that two triangles have in common, and points that stay on two surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .beside import rounding

#: Triangles whose planes have a smaller sine between them do not cut each other: they lie in one plane.
IN_ONE_PLANE = 1e-4


def common_line(first: list[mi.Point3f], second: list[mi.Point3f]) -> tuple[mi.Point3f, mi.Point3f, mi.Bool]:
    """Lower and upper end of the piece of a line that two triangles have in common; do they cut each other? Detached.

    The same for the triangles in another order, but for rounding. What is in a plane, within rounding, counts as above
    it: so triangles that only touch may be said to cut each other.
    """
    normals = normal_of(first), normal_of(second)
    along = dr.cross(*normals)
    cut = dr.norm(along) > IN_ONE_PLANE
    # Of two opposite directions, that whose largest coordinate is positive.
    size = dr.abs(along)
    largest = dr.select(size.x >= dr.maximum(size.y, size.z), along.x, dr.select(size.y >= size.z, along.y, along.z))
    along = dr.mulsign(dr.normalize(along), largest)
    slack, ends = slack_of(first, second), []
    for triangle, n, other in ((first, normals[1], second), (second, normals[0], first)):
        heights = [dr.dot(n, p - other[0]) for p in triangle]
        above = dr.smallest(mi.Float)
        a, b, crosses = cut_by_plane(triangle, [dr.select(dr.abs(h) <= slack, above, h) for h in heights])
        cut &= crosses
        swap = dr.dot(along, a - b) > 0
        ends.append((dr.select(swap, b, a), dr.select(swap, a, b)))
    (a, b), (c, d) = ends
    lower, upper = dr.select(dr.dot(along, a - c) > 0, a, c), dr.select(dr.dot(along, b - d) > 0, d, b)
    return lower, upper, cut & (dr.dot(along, upper - lower) > slack)


def slack_of(first: list[mi.Point3f], second: list[mi.Point3f]) -> mi.Float:
    """How far from a plane of one of two triangles a corner of the other may seem to lie that is in it."""
    return dr.maximum(rounding(first[0], second[0]), dr.maximum(rounding(*first[1:]), rounding(*second[1:])))


def cut_by_plane(corners: list[mi.Point3f], height: list[mi.Float]) -> tuple[mi.Point3f, mi.Point3f, mi.Bool]:
    """Where a plane cuts through a triangle: two points of its sides; and does it? height : of the corners over it."""
    corners, height = list(corners), list(height)
    above = [h > 0 for h in height]
    below = [h < 0 for h in height]
    crosses = (above[0] | above[1] | above[2]) & (below[0] | below[1] | below[2])
    # The corner that has the plane between itself and the two others, first.
    for k in (1, 2):
        alone = (above[k] != above[0]) & (above[k] != above[3 - k])
        corners[0], corners[k] = dr.select(alone, corners[k], corners[0]), dr.select(alone, corners[0], corners[k])
        height[0], height[k] = dr.select(alone, height[k], height[0]), dr.select(alone, height[0], height[k])
    points = []
    for k in (1, 2):
        t = height[0] / dr.select(crosses, height[0] - height[k], 1)
        points.append(dr.lerp(corners[0], corners[k], dr.clip(t, 0, 1)))
    return points[0], points[1], crosses


def normal_of(triangle: list[mi.Point3f]) -> mi.Vector3f:
    a, b, c = triangle
    return dr.normalize(dr.cross(b - a, c - a))


def follow(p: mi.Point3f, first: list[mi.Point3f], second: list[mi.Point3f], active: mi.Bool) -> mi.Point3f:
    """The point p of the line, attached to both triangles."""
    normals, heights = [], []
    for triangle in (first, second):
        n = normal_of(triangle)
        g = dr.dot(n, p - triangle[0])
        normals.append(dr.detach(n))
        heights.append(dr.select(active, g - dr.detach(g), 0))
    return stay_on(p, normals, heights, active)


def stay_on(p: mi.Point3f, normals: Sequence, heights: Sequence, active: mi.Bool) -> mi.Point3f:
    """The point p of two surfaces, attached: it moves in the plane of their normals, so that it stays on both.

    normals : of unit length, detached. heights : over both surfaces, zero, with the gradient for a fixed p.
    """
    (n, m), (g, h) = normals, heights
    cosine = dr.dot(n, m)
    determinant = dr.select(active, 1 - dr.square(cosine), 1)
    α, β = (cosine * h - g) / determinant, (cosine * g - h) / determinant
    return mi.Point3f(p + dr.select(active, n * α + m * β, 0))
