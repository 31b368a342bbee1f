"""How close rays pass to an edge, and what is near it up to rounding."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import reduce

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.rays import lift, lift_beyond

#: Faces are seen edge-on if the sine of the angle between them and the line of sight is at most so large.
EDGE_ON = 1e-6

#: How far to look beside lines in which shapes cut through each other, and beside inner edges of acute corners, where
#: the other surface overhangs, in units of the offset of rays that start there: the cotangent of the angle between
#: both, beyond which rays start below it, but at most the second number.
BESIDE_LINE = 1.25, 8

#: And beside the edges of meshes that rays go through as if nothing was there, and lines in which such cut others, in
#: units of the offset of such rays. (At these lines, over the sine of the angle between both.)
BESIDE_MASK = 2


def are_edge_on(n: mi.Vector3f, d: mi.Vector3f, least: float = EDGE_ON) -> mi.Bool:
    """Are faces with normals n seen along d edge-on, up to rounding? least : sine of the angle from which on not."""
    return dr.abs_dot(n, d) <= least * dr.norm(n) * dr.norm(d)


def compare_depth(
    p: mi.Point3f, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, slack: mi.Float
) -> tuple[mi.Bool, mi.Bool]:
    """Of what a ray close by p meets: does p lie in its plane, up to `slack`, scene units; and if not, is it nearer?"""
    beside = dr.norm(dr.cross(p - ray.o, ray.d))
    at_p = si.is_valid() & (dr.abs_dot(si.n, si.p - p) <= slack + beside)
    return at_p, si.is_valid() & ~at_p & (dr.dot(si.p - p, ray.d) < 0)


def overhang(first: mi.Vector3f, second: mi.Vector3f) -> mi.Float:
    """How far beside a line in which two surfaces meet rays start below the other one, in units of the offset of rays:
    see `BESIDE_LINE`. first, second : their normals, on the side of the viewer."""
    cotangent = -dr.dot(first, second) / dr.norm(dr.cross(first, second))
    margin, most = BESIDE_LINE
    return dr.clip(margin * cotangent, 0, most)


def clear_of_overhang(
    scene: mi.Scene, p: mi.Point3f, rays: Sequence[mi.Ray3f], met: Sequence[mi.SurfaceInteraction3f]
) -> mi.Float:
    """How far beside a line in which two surfaces meet, at its point p, rays from one of them do not start below the
    other one, as they would closer to it: scene units.

    rays, met : on both sides of the line, and the surfaces.
    """
    n, m = (dr.mulsign(si.n, -dr.dot(si.n, ray.d)) for si, ray in zip(met, rays, strict=True))
    return clear_of(scene, p, n, m, [si.bsdf().flags() for si in met])


def clear_of(scene: mi.Scene, p: mi.Point3f, n: mi.Vector3f, m: mi.Vector3f, flags: Sequence[mi.UInt32]) -> mi.Float:
    """`clear_of_overhang` of surfaces with the normals n and m, on the side of the viewer, and such BSDFs."""
    either = lambda kind: reduce(operator.or_, (mi.has_flag(f, kind) for f in flags))
    ways_in = mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.GlossyTransmission, mi.BSDFFlags.DiffuseTransmission
    goes_in = reduce(operator.or_, map(either, ways_in))
    below = dr.maximum(overhang(n, m), dr.select(goes_in, overhang(n, -m), 0))
    through = BESIDE_MASK / dr.maximum(dr.norm(dr.cross(n, m)), 1 / BESIDE_LINE[1])
    beyond = dr.select(either(mi.BSDFFlags.Null), through * lift_beyond(scene, p), 0)
    return below * lift(scene, p) + beyond


def line_of_sight(p: mi.Point3f, rays: tuple[mi.Ray3f, mi.Ray3f]) -> mi.Vector3f:
    """To a point p, half-way between the rays that pass it: faces may be closer to it than these are."""
    return p - dr.lerp(rays[0].o, rays[1].o, 0.5)


def passes(ray: mi.Ray3f, p: mi.Point3f, corners: list[mi.Point3f]) -> mi.Bool:
    """Does the line of a ray, which passes close by a point p, pass through a triangle around p?

    Seen from the ray's origin, the corners of a fine triangle are all in one direction, up to rounding.
    """
    nearest = dr.fma(ray.d, dr.dot(ray.d, p - ray.o), ray.o)
    corners = [c - nearest for c in corners]
    turns = [dr.dot(ray.d, dr.cross(corners[i], corners[i - 1])) for i in range(3)]
    front = (dr.minimum(*turns[:2]) > 0) & (turns[2] > 0)
    return front | ((dr.maximum(*turns[:2]) < 0) & (turns[2] < 0))


def beside_edge(p: mi.Point3f, q: mi.Point3f) -> mi.Float:
    """How far beside an edge at p to look, from q or from p: just beyond what single precision can tell apart.

    No farther: on fine meshes, silhouettes hidden by others are closer to these than one would think (the mesh's length
    of edges times the angle between faces), and their shadows would count twice.
    """
    return 0.25 * rounding(p, q)


def rounding(p: mi.Point3f, q: mi.Point3f) -> mi.Float:
    """How far from p or q a point may seem to lie that is computed from both, in single precision."""
    scale = dr.max(dr.maximum(dr.abs(mi.Vector3f(p)), dr.abs(mi.Vector3f(q))))
    return 32 * dr.epsilon(mi.Float) * scale
