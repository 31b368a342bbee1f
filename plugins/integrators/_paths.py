"""Paths beyond their first vertex: the light that arrives along them, its derivative by path replay, and the choice of
one vertex."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ._scattering import Next, Scattering


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
) -> mi.Spectrum:
    """Light that arrives by way of `vertex`, without what it emits: mi.Spectrum, (N,), detached; times its β."""
    scattering = Scattering(scene, attached=False, continues=True)

    def bounce(L, vertex, active, sampler):
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        direct, onwards = scattering.scatter(si, si.bsdf(vertex.ray), sampler, active)
        L += dr.select(active, vertex.β * direct, 0)
        vertex, active = _step(vertex, onwards, sampler, depths, active)
        return L, vertex, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    L = dr.zeros(mi.Spectrum, dr.width(vertex.depth))
    return dr.while_loop((L, vertex, active, sampler), lambda L, v, active, s: active, bounce, label="scattered light")[
        0
    ]


def replay(
    scene: mi.Scene,
    sampler: mi.Sampler,
    vertex: Vertex,
    depths: Depths,
    active: mi.Bool,
    L: mi.Spectrum,
    δL: mi.Spectrum | None,
) -> mi.Spectrum:
    """Derivative of `scattered_light` at its fixed samples, by path replay (Vicini et al. 2021).

    sampler : in the state in which `scattered_light` found it.
    L : what that returned.
    δL : gradient of the loss with respect to it: it is propagated to the parameters. None: forward mode.

    Returns
    -------
    In forward mode, the derivative of `scattered_light`: mi.Spectrum, (N,), detached.
    """
    scattering = Scattering(scene, attached=True, continues=True)

    def bounce(L, tangent, vertex, active, sampler):
        with dr.resume_grad():
            # A fixed ray meets the surface, wherever that moves.
            si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        bsdf = si.bsdf(vertex.ray)
        direct, onwards = scattering.scatter(si, bsdf, sampler, active)
        L -= dr.select(active, vertex.β * dr.detach(direct), 0)
        with dr.resume_grad():
            # What comes from farther on, relative to its value.
            weight = onwards.weight
            rest = dr.select(dr.detach(weight) != 0, L * weight / dr.detach(weight), 0)
            Lo = dr.select(active, vertex.β * direct + rest, 0)
            if δL is None:
                tangent += dr.forward_to(Lo, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            else:
                dr.backward_from(δL * Lo)
        vertex, active = _step(vertex, onwards, sampler, depths, active)
        return L, tangent, vertex, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    tangent = dr.zeros(mi.Spectrum, dr.width(vertex.depth))
    return dr.while_loop(
        (mi.Spectrum(L), tangent, vertex, active, sampler),
        lambda L, t, v, active, s: active,
        bounce,
        label="path replay",
    )[1]


def choose_vertex(
    scene: mi.Scene, sampler: mi.Sampler, vertex: Vertex, depths: Depths, active: mi.Bool
) -> tuple[Vertex, mi.Bool]:
    """Follow paths from their first vertex, and keep one vertex of each, in proportion to its throughput (a reservoir of
    one); its β is divided by its probability.

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
        vertex, active = _step(vertex, Next(ray, pi, weight, bs.eta), sampler, depths, active)
        return total, kept, vertex, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    total = dr.zeros(mi.Float, dr.width(vertex.depth))
    total, kept, *_ = dr.while_loop(
        (total, vertex, vertex, active, sampler), lambda t, k, v, active, s: active, bounce, label="choice of a vertex"
    )
    kept.β *= dr.select(total > 0, total / dr.max(kept.β), 0)
    return kept, total > 0


def _step(vertex, onwards, sampler, depths, active):
    """The next vertex, and whether the path goes on there. Paths end at random as in Mitsuba's `path`."""
    β = vertex.β * dr.detach(onwards.weight)
    η = vertex.η * onwards.η
    depth = vertex.depth + 1
    p = dr.minimum(dr.max(β) * dr.square(η), 0.95)
    ends = (depth >= depths.rr_depth) & (sampler.next_1d(active) >= p)
    β = dr.select(depth >= depths.rr_depth, β * dr.rcp(p), β)
    active = active & onwards.pi.is_valid() & depths.scatters(depth) & dr.any(β != 0) & ~ends
    return Vertex(mi.Ray3f(onwards.ray), onwards.pi, depth, β, η), active
