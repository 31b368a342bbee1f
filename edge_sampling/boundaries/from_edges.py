"""Points that are found from edges: where edges are close to other surfaces, and light is scattered past them.

Below a box that stands a little above a floor, the light that a point x receives changes the faster with the box, the
closer an edge is: as 1 / r. Paths from the camera find such points by their area, so that few samples have large
values. Here, a point p of an edge comes first, then a direction, uniform over the sphere. A ray from p in this
direction meets x, which is connected with a vertex z of a path, as in `indirect_shadows.py`. By the area of x and the
length along the edge, the density of this is

    cos θ_x / (4π r²) · 1 / (n l)

for one of n edges, with the length l. From z, x is found with the density d by area, and then p with about 1 / (π r),
as if no other edge was near. The two ways share all points of edges by the power heuristic (Veach 1997), with these
numbers; the parts of the two add up to one, so that it does not matter that the second is a guess.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import EdgeSample
from rimlight.edge_sampling.choice.silhouettes import Placement, Silhouettes
from rimlight.edge_sampling.geometry.beside import rounding
from rimlight.edge_sampling.parametrisation import material_point

from .indirect_shadows import Join, held_point
from .tracer import ShadingPoint, Tracer

#: Part of the samples at points whose point is found from an edge.
PART = 1 / 16

#: Most edges of which one is taken, each as likely as any other. Of meshes of many faces, hardly any edge is close to
#: another surface, and the tree finds those that are.
MOST = 256


@dataclass(frozen=True)
class FromEdge:
    """Points of which some are found from edges.

    of : what has found them. point : all of them. found : mi.Bool, which are found so?
    sample : from which point of an edge. weight : mi.Spectrum, what the vertex reflects of it, over its density.
    """

    of: FromEdges
    point: ShadingPoint
    found: mi.Bool
    sample: EdgeSample
    weight: mi.Spectrum

    def part(self, placement: Placement, sample: EdgeSample, emission: mi.Bool) -> mi.Spectrum:
        """With which weight the light counts at a point that passes a point of an edge.

        emission : is it emitted light? This is not looked for from edges.
        """
        ours = dr.select(self.is_shared(sample, emission), self.share(placement, sample), 0)
        return self.weight * dr.select(self.found, ours / PART, (1 - ours) / (1 - PART))

    def is_shared(self, sample: EdgeSample, emission: mi.Bool) -> mi.Bool:
        """May it be found in both ways?"""
        both = ~emission & (self.point.depth > 1) & dr.isfinite(self.point.density)
        return both & self.of.silhouettes.is_moving_edge(sample)

    def share(self, placement: Placement, sample: EdgeSample) -> mi.Float:
        """Part of what may be found in both ways that is found from edges."""
        x, n = self.point.si, dr.width(self.of.edges)
        outline = self.of.silhouettes.point(placement, sample, x.p)
        d = x.p - outline.p
        r2 = dr.squared_norm(d)
        from_edge = dr.abs_dot(x.n, d) * dr.rsqrt(r2) / (4 * dr.pi * r2 * n * dr.norm(outline.tangent))
        from_vertex = self.point.density * dr.inv_pi * dr.rsqrt(r2)
        share = dr.detach(dr.square(from_edge) / (dr.square(from_edge) + dr.square(from_vertex)))
        return dr.select(dr.isfinite(share), share, 0)


class FromEdges:
    """Finds points from the edges of shapes that move.

    edges : numbers of these among the edges of `silhouettes`.
    """

    DRJIT_STRUCT = dict.fromkeys(("silhouettes", "edges"))  # for `dr.freeze`

    def __init__(self, silhouettes: Silhouettes, edges: mi.UInt32):
        self.silhouettes, self.edges = silhouettes, edges

    @staticmethod
    def of(silhouettes: Silhouettes) -> FromEdges | None:
        """None: there are no edges, or too many."""
        moving = silhouettes.moving_edges
        return FromEdges(silhouettes, mi.UInt32(moving)) if 0 < len(moving) <= MOST else None

    def replaced(self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler) -> FromEdge:
        """Find some points from edges, each for a vertex of a path, in place of that vertex.

        placement : see `ShadingBoundary.sample`. point : the vertices.
        """
        scene, z, n = tracer.scene, point.si, dr.width(self.edges)
        with dr.suspend_grad():
            found = sampler.next_1d() < PART
            active = found & point.active & tracer.scatters(point.depth + 2)
            number = dr.minimum(mi.UInt32(sampler.next_1d() * n), n - 1)
            sample = EdgeSample(dr.gather(mi.UInt32, self.edges, number), sampler.next_1d(), mi.Float(1 / n))
            p = self.silhouettes.point(placement, sample, z.p).p
            d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
            ray = mi.Ray3f(p + d * rounding(p, p), d, z.time, z.wavelengths)
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            x = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            join = Join.of(scene, z, x, active & pi.is_valid())
            x.wi, x.wavelengths = x.to_local(-join.ω), z.wavelengths
            density = dr.abs_dot(x.n, d) / (4 * dr.pi * dr.squared_norm(x.p - p))
            active = join.active & (density > 0)
            weight = dr.select(active, join.weight / density, 0)
            far = point.vicinity.around(z.bsdf()).far(join.r2)
        with dr.resume_grad():
            m = material_point(ray, pi, active)
            x.p = dr.replace_grad(x.p, held_point(z.p, m.p, dr.detach(x.n), join.ω, far, active))
            si = dr.select(found, x, z)
        depth = dr.select(found, point.depth + 1, point.depth)
        density = dr.select(found, join.pdf, point.density)
        active = dr.select(found, active, point.active)
        moved = replace(point, si=si, depth=depth, active=active, density=density)
        return FromEdge(self, moved, found, sample, dr.select(found, weight, 1))
