"""Paths beyond their first vertex: the light that arrives along them, and the choice of vertices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.crease import Directions
from rimlight.edge_sampling.boundaries.fine_mirrors import FineMirrors
from rimlight.edge_sampling.boundaries.horizon import Horizon, turn_to_side, turn_to_viewer
from rimlight.edge_sampling.boundaries.veils import Before
from rimlight.edge_sampling.choice.light_choice import LightChoice
from rimlight.edge_sampling.geometry.meshes import is_met
from rimlight.edge_sampling.parametrisation import Vicinity

from .scattering import Next, Numbers, Scattering, next_vertex


@dataclass
class Vertex:
    """A vertex of a path on a surface.

    ray, pi : the ray to it, and what that meets.
    depth : mi.UInt32, its number along the path; 1 is what the camera sees.
    β : mi.Spectrum, throughput up to it.
    η : mi.Float, product of the relative indices of refraction up to it.
    mirrored : mi.Bool, is it what a perfect mirror or a smooth glass shows?
    slides : mi.Bool, does it slide over its surface, however far it is from the vertex before?
    lit : mi.Spectrum, β as if the first surface along the path that is black were white, for a derivative in which it
        may become brighter; None: β itself.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    depth: mi.UInt32
    β: mi.Spectrum
    η: mi.Float
    mirrored: mi.Bool
    slides: mi.Bool
    lit: mi.Spectrum | None = None


@dataclass(frozen=True)
class Depths:
    """max_depth : of paths, in segments, as in Mitsuba's `path`; rr_depth : from which on paths end at random."""

    max_depth: int
    rr_depth: int

    def scatters(self, depth: mi.UInt32 | int) -> mi.Bool | bool:
        """May a vertex of this number still reflect direct light?"""
        return depth < self.max_depth


def scattered_light(
    scene: mi.Scene,
    sampler: mi.Sampler,
    vertex: Vertex,
    depths: Depths,
    active: mi.Bool,
    beside_outline: mi.Bool | None = None,
    directions: Directions | None = None,
    lights: LightChoice | None = None,
    fine_mirrors: FineMirrors | None = None,
    horizon: Horizon | None = None,
    before: Before | None = None,
) -> tuple[mi.Spectrum, mi.Bool]:
    """Light that arrives by way of a vertex.

    beside_outline : is this vertex, or what is seen through it, just inside of an outline? Then interpolated normals
        that face away are turned.
    directions : see `Scattering.scatter`, for this vertex.
    lights : see `Scattering`.
    fine_mirrors : of which the normals are turned at this vertex.
    horizon : on which side of the horizon of interpolated normals this vertex is; None: as it is.
    before : what veils scatter is left out, if this vertex, or what is seen through it, is one before that.

    Returns
    -------
    L : mi.Spectrum, (N,), without what the vertex emits; times its β; detached.
    stopped : mi.Bool, (N,), does the path meet, there or farther on, a surface that it does not go through as if
        nothing was there?
    """
    scattering = Scattering(scene, attached=False, lights=lights)

    def bounce(L, stopped, vertex, first, active, sampler):
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        if beside_outline is not None:
            turn_to_viewer(si, vertex.ray, active & beside_outline & (vertex.depth == first))
        if horizon is not None:
            turn_to_side(si, vertex.ray, horizon, vertex.depth == first)
        if fine_mirrors is not None:
            fine_mirrors.turn(si, vertex.ray, active & (vertex.depth == first))
        veiled = (vertex.depth == first) & before.veils(si, vertex.ray) if before is not None else mi.Bool(False)
        there = directions.where(active & (vertex.depth == first) & ~veiled) if directions is not None else None
        numbers = scattering.draw(sampler, active)
        direct, onwards = scattering.scatter(si, si.bsdf(vertex.ray), numbers, active, directions=there)
        if before is not None:
            lost = veiled & ~onwards.through
            direct, onwards.weight = (dr.select(lost, 0, v) for v in (direct, onwards.weight))
        L += dr.select(active, vertex.β * direct, 0)
        last = active & onwards.through & ~depths.scatters(vertex.depth + 1)
        stopped |= (active & ~onwards.through) | scattering.stops(onwards.ray, onwards.pi, sampler, last)
        first += dr.select(onwards.through & (vertex.depth == first), mi.UInt32(1), 0)
        vertex, active, _ = step(vertex, onwards, sampler, depths, active)
        return L, stopped, vertex, first, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    first = mi.UInt32(vertex.depth)
    state = (dr.zeros(mi.Spectrum, dr.width(vertex.depth)), mi.Bool(False), vertex, first, active, sampler)
    return dr.while_loop(state, lambda *state: state[-2], bounce, label="scattered light")[:2]


@dataclass
class Choice:
    """One vertex of each path, chosen in proportion to its throughput. (A Dr.Jit structure: not frozen.)

    depth : mi.UInt32, its number along the path.
    β : mi.Spectrum, throughput up to it, over its probability.
    active : mi.Bool, is there one?
    since : mi.UInt32, number of the last vertex up to there that does not slide with those before; 1 if all do.
    before : mi.UInt32, the same of the vertex before.
    density : mi.Float, by area, with which it was found from the vertex before; infinite if that is a mirror.
    moved : mi.Bool, does it, or any vertex before it, lie on a shape that moves?
    """

    depth: mi.UInt32
    β: mi.Spectrum
    active: mi.Bool
    since: mi.UInt32
    before: mi.UInt32
    density: mi.Float
    moved: mi.Bool


def choose_vertices(
    scene: mi.Scene,
    sampler: mi.Sampler,
    vertex: Vertex,
    depths: Depths,
    vicinity: Vicinity,
    active: mi.Bool,
    beyond: Sequence[int],
    note: Callable[[Vertex, Numbers, Next, mi.Bool], None],
    moving: Sequence[mi.ShapePtr] | None = None,
) -> list[Choice]:
    """Follow paths from their first vertex, and keep vertices of each, in proportion to its throughput (reservoirs of
    one): one for each number in `beyond`, which at least so many vertices may follow.

    note : called with each vertex, its random numbers, and the next one. moving : the shapes that move; None: all are
    taken to do so.
    """

    def bounce(totals, kept, vertex, since, before, density, moved, active, sampler):
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        bsdf = si.bsdf(vertex.ray)
        scatters = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        for shape in moving or ():
            moved |= is_met(si, shape)
        cosine = dr.abs_dot(si.n, vertex.ray.d)
        here = Choice(vertex.depth, vertex.β, mi.Bool(True), since, before, density * cosine, moved)
        number = sampler.next_1d(active)
        totals, kept = list(totals), list(kept)
        for i, more in enumerate(beyond):
            w = dr.select(scatters & depths.scatters(vertex.depth + more), dr.max(vertex.β), 0)
            totals[i] = totals[i] + w
            kept[i] = dr.select(number * totals[i] < w, here, kept[i])
        numbers = Numbers(mi.Point2f(0), sampler.next_1d(active), sampler.next_2d(active))
        bs, onwards = next_vertex(scene, si, bsdf, numbers, active & depths.scatters(vertex.depth + 1), vicinity)
        note(vertex, numbers, onwards, active)
        r2 = dr.square(onwards.pi.t)
        slides = onwards.slides | (vicinity.far(r2) < 1)
        # What a mirror shows slides with what looks into it, though the mirror itself does not slide with that.
        longest = dr.select(onwards.mirrored, dr.minimum(since, before), since)
        before, since = since, dr.select(slides, longest, vertex.depth + 1)
        density = dr.select(onwards.mirrored, dr.inf, bs.pdf / r2)
        vertex, active, _ = step(vertex, onwards, sampler, depths, active)
        return totals, kept, vertex, since, before, density, moved, active, sampler

    active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)
    width = dr.width(vertex.depth)
    one, zero = dr.full(mi.UInt32, 1, width), dr.zeros(mi.Float, width)
    kept = [dr.zeros(Choice, width) for _ in beyond]
    for choice in kept:
        choice.depth = mi.UInt32(one)
    first = vertex, mi.UInt32(one), mi.UInt32(one), zero, dr.full(mi.Bool, moving is None, width)
    totals, kept, *_ = dr.while_loop(
        ([mi.Float(zero) for _ in beyond], kept, *first, active, sampler),
        lambda *state: state[-2],
        bounce,
        label="choice of vertices",
    )
    for total, choice in zip(totals, kept, strict=True):
        choice.β *= dr.select(choice.active, total / dr.max(choice.β), 0)
    return kept


def step(
    vertex: Vertex, onwards: Next, sampler: mi.Sampler, depths: Depths, active: mi.Bool
) -> tuple[Vertex, mi.Bool, mi.Float]:
    """The next vertex, whether the path goes on there, and by what its throughput is multiplied because others have
    ended. Paths end at random as in Mitsuba's `path`."""
    weight = dr.detach(onwards.weight)
    β, η, depth = vertex.β * weight, vertex.η * onwards.η, vertex.depth + 1
    lit = β if vertex.lit is None else as_if_lit(vertex, weight)
    p = dr.minimum(dr.max(lit) * dr.square(η), 0.95)
    may_end = depth >= depths.rr_depth
    ends = may_end & (sampler.next_1d(active) >= p)
    more = dr.select(may_end, dr.rcp(p), 1)
    active = active & onwards.pi.is_valid() & depths.scatters(depth) & dr.any(lit != 0) & ~ends
    there = mi.Ray3f(onwards.ray), onwards.pi, depth, β * more, η, onwards.mirrored, onwards.slides
    return Vertex(*there, None if vertex.lit is None else lit * more), active, more


def as_if_lit(vertex: Vertex, weight: mi.Spectrum) -> mi.Spectrum:
    """`Vertex.lit` of the next vertex, before others end."""
    return vertex.lit * dr.select(weight != 0, weight, dr.select(vertex.β != 0, mi.Spectrum(1), 0))
