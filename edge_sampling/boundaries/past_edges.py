"""What is seen past an edge, and how its direction turns."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.silhouettes import OutlinePoint
from rimlight.edge_sampling.geometry.beside import clear_of
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


def look_aside(scene, si, x, outline, across, distance, side, aside, active, slack=1):
    """See `look`: from x beside `outline`, on a side of it, ±1 along `across`, as far aside as this. slack : how far
    from the edge a surface may be on which it lies, in units of that."""
    p = dr.detach(outline.p)
    return look(scene, si, x, p, outline, side * aside * across, slack * aside, distance, active)


def look_clear(scene, outline, ω, seen, aside, active, see):
    """What is `seen` past an edge, from how far aside: farther where that is a surface on which the edge lies, and over
    which it leans. ω : from the viewer. see : looks so far aside, where active."""
    clear = dr.select(active & seen[-1], clear_of_overhangs(scene, outline, seen[2], ω), 0)
    farther, aside = clear > aside, dr.maximum(clear, aside)
    return dr.select(farther, see(aside, active & farther), seen), aside


def turning(n_dl: mi.Vector3f, d: mi.Vector3f, valid: mi.Bool) -> mi.Float:
    """Zero, with the gradient of the direction of d, along `n_dl`."""
    ω = dr.normalize(dr.select(valid, d, mi.Vector3f(0, 0, 1)))
    return dr.select(valid, dr.dot(n_dl, ω - dr.detach(ω)), 0)


def clear_of_overhangs(scene: mi.Scene, outline: OutlinePoint, y: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Float:
    """How far beside an edge to look at a surface on which it lies, such as the foot of a wall that leans outward:
    closer, rays from there start below the faces of the edge. Scene units; see `clear_of_overhang`.

    d : from the viewer to the edge.
    """
    towards_viewer = lambda n: dr.normalize(dr.mulsign(n, -dr.dot(n, d)))
    flags = [y.bsdf().flags()]
    first, second = (clear_of(scene, outline.p, towards_viewer(y.n), towards_viewer(n), flags) for n in outline.normals)
    return dr.maximum(first, second)


def density_from_points(
    density: mi.Float, cos_z: mi.Float, cos_x: mi.Float, cos_y: mi.Float, r_x: mi.Float, r_y: mi.Float
) -> mi.Float:
    """Density with which y is found from points x, relative to that with which it is found as a vertex of a light
    subpath: by area; but each way is left less of the edges that are close to where it starts, of which both choose too
    few.

    What slides over a surface that is seen edge-on moves as 1 / `cos_z`: more of it is found from points than the
    densities alone would have it.

    density : by area, with which x is found from the vertex before. cos_z : of the angle between the normal at x and
    the direction to that. cos_x, cos_y : between the line past the edge and the normals. r_x, r_y : distances of the
    edge.
    """
    return density / dr.square(cos_z) * cos_x / cos_y * dr.square(r_x / r_y)
