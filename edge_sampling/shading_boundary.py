"""Boundaries at shading points: what edges add to the derivative of reflected light as they move past a light, seen
from the point.

At a point x, the integrand of L = ∫ f |cos θ| Lᵢ(ω) dω jumps at the great-circle arcs that the edges subtend. The
derivative of L gains

    ∮ f |cos θ| · Σ_sides ± L_side · n · (ω̇_edge − ω̇_side) dl,        n dl = (ω × dω/dt) dt = (ω × e′(t)) / r dt

with ω = (e(t) − x) / r. A side's own velocity ω̇_side is that of its *material point*, since this is what the interior
derivative holds fixed; it is 0 for a side at infinity. So an emitter contributes nothing by its own outline, but all
that it loses behind another edge.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .device_edges import DeviceEdges
from .edges import Edges
from .meshes import Geometry


class ShadingBoundary:
    """Samples the edges of a scene as shading points see them. Edges are chosen in proportion to their length in
    space, wherever they are.

    Unbiased, but noisy where a mesh has many edges of which few matter at a point.

    Parameters
    ----------
    geometry : the meshes.
    edges : all their edges, on the host.
    moving : for every mesh, does it move?
    """

    def __init__(self, geometry: Geometry, edges: Edges, moving: tuple[bool, ...]):
        self.geometry = geometry
        self.moving_meshes = [m for m, moves in zip(geometry.meshes, moving, strict=True) if moves]
        # Static points that see static lights are concerned by moving edges only: put these first.
        moves = np.array(moving)[edges.mesh].any(axis=1)
        self.edges = DeviceEdges(edges.take(np.argsort(~moves, kind="stable")))
        self.moving_count = int(moves.sum())
        self.lights_move = any(m.is_emitter() for m in self.moving_meshes)

    def sample(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, sampler: mi.Sampler, camera_moves: bool
    ) -> mi.Spectrum:
        """One sample of the boundary integral at each of `si`, for emitted light only.

        si : attached to whatever moves it.

        Returns
        -------
        mi.Spectrum, (N,): zero, with the gradient of the reflected radiance.
        """
        edges = self.edges
        with dr.resume_grad():
            positions = self.geometry.positions()
        with dr.suspend_grad():
            bsdf = si.bsdf()
            everything = mi.Bool(camera_moves or self.lights_move)
            for mesh in self.moving_meshes:
                everything |= si.shape == mi.ShapePtr(mesh)
            edge, density = self._choose(positions, sampler.next_1d(), everything)
            t = sampler.next_1d()
            a, b = edges.end_points(positions, edge)
            x, p = si.p, dr.lerp(a, b, t)
            active = si.is_valid() & (density > 0) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            active &= edges.is_boundary(positions, edge, x)
            distance = dr.norm(p - x)
            ω = (p - x) / distance
            n_dl = dr.cross(ω, b - a) / (distance * density)
            f = bsdf.eval(mi.BSDFContext(), si, si.to_local(ω), active)
            active &= dr.any(f != 0) & dr.isfinite(dr.squared_norm(n_dl))
            # The two sides are looked at just beyond what single precision can tell apart.
            ulp = 2 * dr.epsilon(mi.Float)
            scale = dr.max(dr.maximum(dr.abs(mi.Vector3f(x)), dr.abs(mi.Vector3f(p))))
            offset = dr.normalize(n_dl) * (16 * ulp * scale + 1e-5 * distance)

        with dr.resume_grad():
            a, b = edges.end_points(positions, edge)
            ω_edge = dr.normalize(dr.lerp(a, b, t) - si.p)
            result = mi.Spectrum(0)
            for sign in (-1, 1):
                with dr.suspend_grad():
                    # Mitsuba lifts the origin off the surface by more than the offset: aim from there.
                    ray = si.spawn_ray_to(p + sign * offset)
                    ray.maxt = dr.largest(mi.Float)
                    pi = scene.ray_intersect_preliminary(ray, active=active)
                y = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
                ω_side = dr.normalize(y.p - si.p)
                velocity = ω_edge - dr.detach(ω_edge) - dr.select(y.is_valid(), ω_side - dr.detach(ω_side), 0)
                with dr.suspend_grad():
                    L = f * y.emitter(scene, active).eval(y, active)
                    L = dr.select(active, L, 0)
                result -= sign * L * dr.dot(dr.select(active, n_dl, 0), velocity)
        return result

    def _choose(self, positions: mi.Float, sample: mi.Float, everything: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
        """Choose from all edges, or from the moving ones only: edge, and its probability."""
        a, b = self.edges.end_points(positions, dr.arange(mi.UInt32, self.edges.count))
        length = dr.norm(b - a)
        length = dr.select(dr.isfinite(length), length, 0)
        cumulative = dr.cumsum(mi.Float64(length))
        last = dr.select(everything, self.edges.count, self.moving_count)
        total = dr.gather(mi.Float64, cumulative, last - 1, last > 0)
        x = mi.Float64(sample) * total
        edge = dr.binary_search(0, self.edges.count - 1, lambda i: dr.gather(mi.Float64, cumulative, i) <= x)
        return edge, dr.select(last > 0, mi.Float(dr.gather(mi.Float, length, edge) / total), 0)
