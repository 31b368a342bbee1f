"""Rays that touch the outline of what they meet, wherever they come from.

A ray o + t·d touches the outline of a shape at its point q. With the unit vector n across the ray and the outline,

    g = n · (q − o − t·d)

vanishes where it touches. As anything moves, g follows the material point q and the ray, with n and t held; so the
position on the film, or whatever else the ray depends on, must change so that g stays 0. For the contour of a curved
surface n is its normal, and q may be any material point close by: the contour slides over the surface, but across n it
moves as the material does. Where two surfaces cut each other, n is divided between their normals, n = α·n₁ + β·n₂, and
each part follows its own surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.beside import rounding
from rimlight.edge_sampling.parametrisation import material_point

#: Barycentric coordinate from which on a point is taken to lie inside of a triangle.
INSIDE = 1e-3

#: How far two points of the surface of a grid may be apart that lie on both sides of a bend, in units of the distance
#: of the rays that meet them.
BENT = 64


@dataclass
class Touch:
    """Where rays touch outlines.

    n : mi.Vector3f, across ray and outline. t : mi.Float, distance along the ray. Detached.
    moved : mi.Float, n · q, attached to the shapes.
    cut : mi.Bool, is it a line in which two surfaces cut each other?
    """

    n: mi.Vector3f
    t: mi.Float
    moved: mi.Float
    cut: mi.Bool


def touch_outline(
    scene: mi.Scene,
    ray: mi.Ray3f,
    near: tuple[mi.Ray3f, mi.PreliminaryIntersection3f],
    far: tuple[mi.Ray3f, mi.PreliminaryIntersection3f],
    reach: mi.Float,
    active: mi.Bool,
) -> Touch:
    """The outline between two rays that are next to each other, of which one meets it, and the other does not.

    ray : one of both. near : the one that meets it, and what that is. far : the other one.
    reach : about how far the two are apart there, scene units.
    """
    is_mesh = near[1].shape.is_mesh() | (near[1].instance != None)  # noqa: E711
    outline = _of_mesh(ray, near, far, active & is_mesh)
    if not all(s.is_mesh() for s in scene.shapes()):
        on_curved = _of_curved(scene, ray, near, far, reach, active & ~is_mesh)
        with dr.resume_grad():
            outline = dr.select(is_mesh, outline, on_curved)
    of_cut = _of_cut(ray, near, far, outline.cut)
    with dr.resume_grad():
        return dr.select(outline.cut, of_cut, outline)


def _of_mesh(ray, near, far, active) -> Touch:
    """At the edge of a triangle beyond which the far ray passes, or where another surface cuts through the triangle."""
    near_ray, pi = near
    corners = []
    with dr.resume_grad():
        for u, v in ((0, 0), (1, 0), (0, 1)):
            corner = mi.PreliminaryIntersection3f(pi)
            corner.prim_uv = mi.Point2f(u, v)
            corners.append(material_point(near_ray, corner, active).p)
    p = [dr.detach(c) for c in corners]
    n = dr.cross(p[1] - p[0], p[2] - p[0])
    at = far[0](dr.dot(n, p[0] - far[0].o) / dr.dot(n, far[0].d))
    opposite = [dr.dot(n, dr.cross(p[i - 1] - p[i - 2], at - p[i - 2])) for i in range(3)]
    least = dr.minimum(opposite[0], dr.minimum(opposite[1], opposite[2]))

    def of_edge(corners, k):
        """The first or the second end of the edge."""
        of_others = dr.select(opposite[1] == least, corners[k - 2], corners[k - 1])
        return dr.select(opposite[0] == least, corners[k], of_others)

    start, end = of_edge(p, 1), of_edge(p, 2)
    e = end - start
    across = _unit(dr.cross(e, ray.d))
    aside = dr.cross(ray.d, across)
    length = dr.dot(aside, e)
    λ = dr.select(length != 0, dr.clip(dr.dot(aside, ray.o - start) / length, 0, 1), 0)
    t = dr.dot(dr.lerp(start, end, λ) - ray.o, ray.d)
    with dr.resume_grad():
        moved = dr.dot(across, dr.lerp(of_edge(corners, 1), of_edge(corners, 2), λ))
    cut = active & far[1].is_valid() & (least > INSIDE * dr.squared_norm(n))
    return Touch(across, t, moved, cut)


def _of_cut(ray, near, far, active) -> Touch:
    with dr.resume_grad():
        a, b = (material_point(*side, active) for side in (near, far))
    n, m = mi.Vector3f(dr.detach(a.n)), mi.Vector3f(dr.detach(b.n))
    across = _unit(dr.cross(dr.cross(n, m), ray.d))
    c, along_n, along_m = dr.dot(n, m), dr.dot(across, n), dr.dot(across, m)
    parallel = 1 - c * c <= 0
    α, β = ((x - c * y) / dr.select(parallel, 1, 1 - c * c) for x, y in ((along_n, along_m), (along_m, along_n)))
    with dr.resume_grad():
        moved = α * dr.dot(n, a.p) + β * dr.dot(m, b.p)
        return Touch(across, dr.dot(dr.detach(a.p) - ray.o, ray.d), moved, active)


def _of_curved(scene, ray, near, far, reach, active) -> Touch:
    """At the contour or a rim of a shape that is no mesh, at a bend of it, or where another surface cuts it: that is
    then met in its tangent plane."""
    near_ray, pi = near
    with dr.resume_grad():
        si = material_point(near_ray, pi, active, mi.RayFlags.All)
    at = dr.detach(si)
    other = far[1].compute_surface_interaction(far[0], mi.RayFlags.Minimal, active)
    in_plane = dr.abs_dot(at.n, other.p - at.p) <= 4 * reach + rounding(at.p, ray.o)
    cut = active & other.is_valid() & (other.shape != at.shape) & in_plane
    # Along the contour, what turns away from the viewer ends; a rim has a tangent of its own.
    tangent = dr.cross(at.n, ray.d)
    for shape in scene.shapes():
        kind = shape.class_name()
        if kind == "Disk":
            tangent = dr.select(pi.shape == mi.ShapePtr(shape), at.dp_dv, tangent)
        elif kind == "Cylinder":
            from_rim = dr.minimum(at.uv.y, 1 - at.uv.y) * dr.norm(at.dp_dv)
            rim = (pi.shape == mi.ShapePtr(shape)) & (from_rim < 2 * reach)
            tangent = dr.select(rim, at.dp_du, tangent)
        elif kind == "SDFGrid":
            # Where its voxels meet, its surface is bent, as where two surfaces cut each other.
            bent = dr.norm(other.p - at.p) <= BENT * reach + rounding(at.p, ray.o)
            cut |= active & other.is_valid() & bent & (other.shape == at.shape) & (pi.shape == mi.ShapePtr(shape))
    across = _unit(dr.cross(tangent, ray.d))
    with dr.resume_grad():
        return Touch(across, dr.dot(at.p - ray.o, ray.d), dr.dot(across, si.p), cut)


def _unit(v: mi.Vector3f) -> mi.Vector3f:
    """Of length 1, or 0 where v is that."""
    return v * dr.select(dr.squared_norm(v) > 0, dr.rsqrt(dr.squared_norm(v)), 0)
