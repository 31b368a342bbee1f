"""Paths beyond their first vertex: the light that arrives along them, its derivative by path replay, and the choice of
one vertex."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.parametrisation import look_from, material_point

from .scattering import Next, Scattering


@dataclass
class Vertex:
    """A vertex of a path on a surface.

    ray, pi : the ray to it, and what that meets.
    depth : mi.UInt32, its number along the path; 1 is what the camera sees.
    β : mi.Spectrum, throughput up to it.
    η : mi.Float, product of the relative indices of refraction up to it.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    depth: mi.UInt32
    β: mi.Spectrum
    η: mi.Float


@dataclass(frozen=True)
class Depths:
    """max_depth : of paths, in segments, as in Mitsuba's `path`; rr_depth : from which on paths end at random."""

    max_depth: int
    rr_depth: int

    def scatters(self, depth: mi.UInt32 | int) -> mi.Bool | bool:
        """May a vertex of this number still reflect direct light?"""
        return depth < self.max_depth


def scattered_light(
    scene: mi.Scene, sampler: mi.Sampler, vertex: Vertex, depths: Depths, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Bool]:
    """Light that arrives by way of a vertex.

    Returns
    -------
    L : mi.Spectrum, (N,), without what the vertex emits; times its β; detached.
    stopped : mi.Bool, (N,), does the path meet, there or farther on, a surface that it does not go through as if
        nothing was there?
    """
    scattering = Scattering(scene, attached=False)

    def bounce(L, stopped, vertex, active, sampler):
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        direct, onwards = scattering.scatter(si, si.bsdf(vertex.ray), sampler, active)
        L += dr.select(active, vertex.β * direct, 0)
        last = active & onwards.through & ~depths.scatters(vertex.depth + 1)
        stopped |= (active & ~onwards.through) | scattering.stops(onwards.ray, onwards.pi, sampler, last)
        vertex, active = step(vertex, onwards, sampler, depths, active)
        return L, stopped, vertex, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    state = (dr.zeros(mi.Spectrum, dr.width(vertex.depth)), mi.Bool(False), vertex, active, sampler)
    return dr.while_loop(state, lambda L, stopped, v, active, s: active, bounce, label="scattered light")[:2]


class Replay:
    """Derivative of `scattered_light` at its fixed samples, by path replay (Vicini et al. 2021). All vertices follow
    their surfaces, but for the first, which the camera sees.

    sampler : in the state in which `scattered_light` found it.
    before, vertex : the first two of the path.
    first : mi.Point3f, position of the first; attached.
    L : what `scattered_light` returned.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        before: Vertex,
        vertex: Vertex,
        depths: Depths,
        active: mi.Bool,
        first: mi.Point3f,
        L: mi.Spectrum,
    ):
        self.scattering = Scattering(scene, attached=True)
        self.sampler, self.before, self.vertex = sampler, before, vertex
        self.depths, self.active, self.L = depths, active, L
        # Only a surface that is not diffuse notices from where it is looked at.
        self.first = first if self.scattering.directional else mi.Point3f(0)

    def forward(self, first: mi.Point3f) -> mi.Spectrum:
        """Derivative of `scattered_light`, detached; with the derivative of the first vertex."""
        return self._run(first, None)[0]

    def backward(self, δL: mi.Spectrum) -> mi.Point3f:
        """Propagate the gradient of a loss with respect to `scattered_light` to the parameters; returns the gradient
        with respect to the first vertex."""
        return self._run(None, δL)[1]

    def _run(self, first: mi.Point3f | None, δL: mi.Spectrum | None) -> tuple[mi.Spectrum, mi.Point3f]:
        scattering, depths, width = self.scattering, self.depths, dr.width(self.active)
        # Inside of the loop, only memory can carry a gradient in or out.
        with dr.resume_grad():
            moves = scattering.directional and dr.grad_enabled(self.first)
            if moves:
                memory = dr.ravel(dr.detach(self.first))
                dr.enable_grad(memory)
                if first is not None:
                    dr.set_grad(memory, dr.ravel(first))
                dr.eval(memory, dr.grad(memory))

        def bounce(L, tangent, before, vertex, active, sampler):
            with dr.resume_grad():
                si = material_point(vertex.ray, vertex.pi, active, mi.RayFlags.All)
                if scattering.directional:
                    x = material_point(before.ray, before.pi, active).p
                    if moves:
                        seen = dr.gather(mi.Point3f, memory, dr.arange(mi.UInt32, width), active & (vertex.depth == 2))
                        x = dr.select(vertex.depth == 2, seen, x)
                    look_from(si, x)
            direct, onwards = scattering.scatter(si, si.bsdf(vertex.ray), sampler, active)
            L -= dr.select(active, vertex.β * dr.detach(direct), 0)
            with dr.resume_grad():
                # What comes from farther on, relative to its value.
                weight = onwards.weight
                rest = dr.select(dr.detach(weight) != 0, L * weight / dr.detach(weight), 0)
                Lo = dr.select(active, vertex.β * direct + rest, 0)
                if δL is None:
                    tangent += mi.Spectrum(dr.forward_to(Lo, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad))
                else:
                    dr.backward_from(δL * Lo, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            before = vertex
            vertex, active = step(vertex, onwards, sampler, depths, active)
            return L, tangent, before, vertex, active, sampler

        vertex = self.vertex
        active = self.active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
        tangent = dr.zeros(mi.Spectrum, width)
        tangent = dr.while_loop(
            (mi.Spectrum(self.L), tangent, self.before, vertex, active, self.sampler.clone()),
            lambda L, t, b, v, active, s: active,
            bounce,
            label="path replay",
        )[1]
        with dr.resume_grad():
            return tangent, dr.unravel(mi.Point3f, dr.grad(memory)) if moves else None


def choose_vertex(
    scene: mi.Scene, sampler: mi.Sampler, vertex: Vertex, depths: Depths, active: mi.Bool
) -> tuple[Vertex, mi.Bool]:
    """Follow paths from their first vertex, and keep one vertex of each, in proportion to its throughput (a reservoir
    of one); its β is divided by its probability.

    Returns
    -------
    vertex : with a ray that is detached.
    chosen : mi.Bool, is there one?
    """

    def bounce(total, kept, vertex, active, sampler):
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        bsdf = si.bsdf(vertex.ray)
        w = dr.select(active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth), dr.max(vertex.β), 0)
        total += w
        taken = sampler.next_1d(active) * total < w
        kept = dr.select(taken, vertex, kept)
        bs, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active)
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, active=active & depths.scatters(vertex.depth + 1))
        vertex, active = step(vertex, Next(ray, pi, weight, bs.eta, mi.Bool(False)), sampler, depths, active)
        return total, kept, vertex, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    total = dr.zeros(mi.Float, dr.width(vertex.depth))
    total, kept, *_ = dr.while_loop(
        (total, vertex, vertex, active, sampler), lambda t, k, v, active, s: active, bounce, label="choice of a vertex"
    )
    kept.β *= dr.select(total > 0, total / dr.max(kept.β), 0)
    return kept, total > 0


def step(vertex, onwards, sampler, depths, active):
    """The next vertex, and whether the path goes on there. Paths end at random as in Mitsuba's `path`."""
    β = vertex.β * dr.detach(onwards.weight)
    η = vertex.η * onwards.η
    depth = vertex.depth + 1
    p = dr.minimum(dr.max(β) * dr.square(η), 0.95)
    ends = (depth >= depths.rr_depth) & (sampler.next_1d(active) >= p)
    β = dr.select(depth >= depths.rr_depth, β * dr.rcp(p), β)
    active = active & onwards.pi.is_valid() & depths.scatters(depth) & dr.any(β != 0) & ~ends
    return Vertex(mi.Ray3f(onwards.ray), onwards.pi, depth, β, η), active
