"""Shadows in the light that surfaces send on, found from these surfaces.

What an edge hides from a point x of light from a point y of a surface, `shading_boundary.py` finds from x: by an edge
that is chosen there, and the path that goes on from y. Here y is a vertex of a light subpath. An edge is chosen as seen
from y, the line past it falls on x, and x is connected with a vertex z of a path from the camera. This finds what lies
close to bright surfaces, such as the inside of a shade, or a wall that a beam meets.

Lines that touch edges are a space of three dimensions, of which both ways are coordinates: with the distances r_x, r_y
of the edge from x and y, and the angles dψ along it as seen from there,

    |cos θ_x| dA_x dψ_x / r_x = |cos θ_y| dA_y dψ_y / r_y

(both times the motion of the edge across the line). The two share all such lines by the power heuristic, together with
all ways to find y itself, see `BidirectionalTracer`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.silhouettes import Placement, Silhouettes
from rimlight.edge_sampling.parametrisation import in_plane, material_point
from rimlight.edge_sampling.rays import spawn_ray, spawn_ray_to

from .fallen_shadow import LightPoint, LitEdge, fall
from .past_edges import density_from_points, look, turning
from .shadow_boundary import ShadowBoundary
from .tracer import LightTracer, ShadingPoint

#: How far from the vertex of the light subpath the line past an edge may end, in units of what both ways
#: to draw it may differ by.
CLOSE = 4


class DeepShadows(ShadowBoundary):
    """Samples the shadows that points of paths see, in light from surfaces."""

    def __init__(self, scene: mi.Scene, silhouettes: Silhouettes):
        super().__init__(scene, silhouettes)
        #: All light subpaths as one light, which is on surfaces.
        self.chosen, self.spots = dr.opaque(mi.UInt32, 0), {}
        self.any_surface, self.any_other = True, False

    def at(
        self, tracer: LightTracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> mi.Spectrum:
        """One sample of what each point reflects of shadows: mi.Spectrum, (N,), zero, with its gradient.

        placement : of the shapes, attached. choice : uniform in [0, 1).
        """
        scene, z = tracer.scene, point.si
        with dr.suspend_grad():
            sender = tracer.sender(dr.width(choice), point.depth + 1, point.active)
            light, edge = self._edge_from(placement, sender, choice, z.time, sampler)
            shadow = fall(scene, light, edge)
            active = shadow.active & point.active & sender.active

            # ---------------------- From the point to the shadow ----------------------

            x = shadow.fallen.compute_surface_interaction(shadow.ray, mi.RayFlags.All, active)
            d = x.p - z.p
            r2 = dr.squared_norm(d)
            active &= r2 > 0
            ω_z = d * dr.rsqrt(dr.select(active, r2, 1))
            x.wi, x.wavelengths = x.to_local(-ω_z), z.wavelengths
            f_z, pdf_z = z.bsdf().eval_pdf(mi.BSDFContext(), z, z.to_local(ω_z), active)
            active &= dr.any(f_z != 0)
            active &= ~scene.ray_test(spawn_ray_to(scene, z, x.p), active)

            # ---------------------- From the shadow past the edge ----------------------

            start = x.p + spawn_ray(scene, x, edge.p - x.p).o - x.p
            distance = dr.norm(edge.p - start)
            active &= ~in_plane(x, edge.p)
            aside = self.silhouettes.beside(scene, placement, edge.sample, edge.p, start)
            ray, pi, y, *_ = look(scene, x, start, edge.p, edge.outline, aside * edge.lit, aside, distance, active)
            active &= pi.is_valid() & (pi.shape == sender.si.shape)
            cos_y = dr.abs_dot(y.n, ray.d)
            # The line from y ends at x, rays start above it.
            off = (aside + dr.norm(start - x.p)) * pi.t / (distance * cos_y)
            active &= dr.norm(y.p - sender.si.p) <= CLOSE * off
            ω = dr.normalize(edge.p - start)
            f_x = x.bsdf().eval(mi.BSDFContext(), x, x.to_local(ω), active)
            r_y = dr.norm(edge.p - y.p)
            cos_z, cos_x, r_x = dr.abs_dot(x.n, ω_z), dr.abs_dot(x.n, ω), dr.norm(edge.p - x.p)
            found = density_from_points(pdf_z * cos_z / r2, cos_z, cos_x, cos_y, r_x, r_y)
            sent = tracer.sent(sender, -ω, found, active)
            dl = dr.norm(dr.cross(ω, edge.tangent)) * distance / (dr.square(r_y) * edge.sample.density)
            L = f_z * f_x * sent * (dl * cos_z / (r2 * cos_x))
            active &= dr.all(dr.isfinite(L)) & dr.any(L != 0)
            L = dr.select(active, L, 0)
            far = point.vicinity.around(z.bsdf()).far(r2)
            beyond = point.vicinity.around(x.bsdf()).far(dr.square(pi.t))

        with dr.resume_grad():
            m = material_point(shadow.ray, shadow.fallen, active).p
            slid = z.p + ω_z * (dr.dot(m - z.p, x.n) / dr.select(active, dr.dot(ω_z, x.n), 1))
            held = start + dr.lerp(slid, m, far) - dr.detach(m)
            p = self.silhouettes.point(placement, edge.sample, light.y, is_light=True).p
            of_edge = turning(edge.lit, p - held, active)
            of_y = turning(edge.lit, material_point(ray, pi, active).p - held, active)
            return -edge.sign * L * (of_edge - beyond * of_y)

    def _edge_from(self, placement, sender, choice, time, sampler) -> tuple[LightPoint, LitEdge]:
        """An edge as the sender of the light sees it."""
        yes, no, one = mi.Bool(True), mi.Bool(False), mi.Float(1)
        nothing = dr.zeros(mi.EmitterPtr, dr.width(choice))
        y, n = sender.si.p, sender.facing
        light = LightPoint(mi.UInt32(0), nothing, choice, time, mi.Point2f(0.5), yes, no, y, n, one)
        edge = self._edge(placement, light, sampler)
        # A surface that lets light through sends it to both sides.
        seen = (edge.sample.density > 0) & dr.any(edge.lit != 0)
        edge.active = dr.select(sender.through, seen, edge.active)
        return light, edge
