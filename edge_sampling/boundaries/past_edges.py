"""What is seen past an edge, and how its direction turns."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.rays import spawn_ray


def look(scene, si, x, p, outline, beside, aside, distance, active):
    """What is seen from x at the point p of an edge and a little beside it: ray, intersections; whether something
    before the edge hides it; and whether it is a surface on which the edge lies.

    outline : what is known of the edge there. aside : how far from the edge such a surface may be. distance : from x
    to p.
    """
    ray = spawn_ray(scene, si, dr.normalize(mi.Point3f(p + beside) - x))
    pi = scene.ray_intersect_preliminary(ray, active=active)
    y = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    # Not a surface on which the edge lies: beside the edge, that may be met a little earlier.
    off = dr.abs_dot(y.n, p - y.p) > aside
    hidden = dr.select(off, pi.t < distance, outline.is_behind(y.n, ray.d))
    return ray, pi, y, pi.is_valid() & hidden, pi.is_valid() & ~off


def turning(n_dl: mi.Vector3f, d: mi.Vector3f, valid: mi.Bool) -> mi.Float:
    """Zero, with the gradient of the direction of d, along `n_dl`."""
    ω = dr.normalize(dr.select(valid, d, mi.Vector3f(0, 0, 1)))
    return dr.select(valid, dr.dot(n_dl, ω - dr.detach(ω)), 0)
