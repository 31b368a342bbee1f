"""A jump in what chains of mirrors show, or textures: where it is along a short segment of a plane, and how it moves.

The plane is the film, or that of the directions at a point (`transport/chain_rays.py`).
"""

from __future__ import annotations

import operator
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.shown_shadows import Border
from rimlight.edge_sampling.boundaries.touch import Touch, touch_outline
from rimlight.edge_sampling.geometry.beside import clear_of_overhang, rounding
from rimlight.edge_sampling.geometry.device_edges import BEHIND
from rimlight.edge_sampling.geometry.instances import surface_met
from rimlight.edge_sampling.geometry.texture_lines import Line, TextureLines
from rimlight.edge_sampling.rays import lift
from rimlight.transport.film_chains import Chains, Parting, Seen, Segment
from rimlight.transport.paths import Vertex
from rimlight.transport.ray_derivatives import change_of
from rimlight.transport.replay import MovingVertex

from .term import Job

#: Segments of the film among which one is chosen whose ends differ.
CANDIDATES = 8

#: Length of the segments, pixels; and to which they are bisected, in units in the last place of the film's size.
LONGEST, SHORTEST = 1.0, 16

#: One in so many candidates is looked at for jumps of which both ends know nothing; and how often those are halved at
#: most before. All numbers are equally likely: near corners, the variance is the sum of their reciprocal probabilities.
HIDDEN, HALVINGS = 4, 7

#: Two surfaces meet if what both rays meet is at most so many times as far apart as the rays are, over the cosine at
#: which they meet it, but at least the second number; besides rounding.
NEXT, STEEPEST = 4, 0.02

#: How far beside lines of textures to look, in units in the last place of the coordinates in which they are whole.
BESIDE_TEXTURE = 64


def jump_and_motion(
    job: Job,
    chains: Chains,
    segment: Segment,
    at: Parting,
    first_ray: mi.Ray3f,
    moving: MovingVertex | None,
    sampler: mi.Sampler,
) -> tuple[mi.Spectrum, mi.Float, mi.Float, mi.Float]:
    """The difference of radiance and alpha between both sides of where two chains part, detached; and how that moves,
    see `_motion`.

    first_ray, moving : the first ray of the chain, and the vertex before the parting where that is another one, as they
    move.
    """
    outline = _at_outline(job.tracer.scene, at, segment) if chains.mirrors else None
    border = _at_shadow(chains, at, segment) if chains.shown is not None else None
    jump, alpha = _jump(job, chains, _beside(chains, at, segment, outline), border, sampler)
    factor, g = _motion(job, at, segment, first_ray, moving, outline, border)
    dr.eval(jump, alpha, factor)
    return jump, alpha, factor, g


def _jump(
    job: Job, chains: Chains, at: Parting, border: Border | None, sampler: mi.Sampler
) -> tuple[mi.Spectrum, mi.Float]:
    """Difference of radiance and alpha between the first chain and the second. Detached."""
    jump, alpha = mi.Spectrum(0), mi.Float(0)
    for sign, vertex, other in ((1, at.a, at.b), (-1, at.b, at.a)):
        inside = ~at.on_texture & ~at.grazes & (vertex.pi.t <= other.pi.t)
        numbered = replace(vertex, depth=vertex.depth + chains.rays.before)
        L, stopped = job.tracer.arriving(numbered, sampler.clone(), at.found & ~at.on_shadow, inside)
        jump += sign * L
        alpha += sign * dr.select(stopped & (vertex.depth == 1), mi.Float(1), 0)
    if border is not None:
        jump = dr.select(border.found, border.jump, jump)
    return jump * at.a.β, alpha


def _motion(
    job: Job,
    at: Parting,
    segment: Segment,
    camera_ray: mi.Ray3f,
    moving: MovingVertex | None,
    outline: tuple[Touch, mi.Float, mi.Float] | None,
    border: Border | None,
) -> tuple[mi.Float, mi.Float]:
    """The factor by which the gradient of a function g makes the part of the velocity of a jump that segments of
    this axis count, times the weight of the segment; and g, attached to the scene.

    g depends on film position and scene, and vanishes at the jump. With its gradient ∇g over the film, the jump
    moves by -∇g·(∂g/∂θ) / |∇g|². Segments along both axes find it, and count what is along them.
    """
    textures, line = job.boundaries.textures, None
    touch, along, across = outline if outline is not None else (None, mi.Float(0), mi.Float(0))
    if outline is not None and moving is not None:
        of_plane = (dr.dot(dr.detach(moving.n), way.d) for way in (at.along, at.across))
        along, across = (dr.select(at.grazes, new, old) for new, old in zip(of_plane, (along, across), strict=True))
    if textures is not None:
        line, *of_line = _at_line(job.tracer.scene, textures, at)
        along, across = (dr.select(at.on_texture, new, old) for new, old in zip(of_line, (along, across), strict=True))
    if border is not None:
        of_border = partial(job.boundaries.shown.across, job.tracer.scene, border)
        changes = (
            change_of(job.tracer.scene, of_border, at.a.ray, at.a.pi, way, border.found)
            for way in (at.along, at.across)
        )
        along, across = (
            dr.select(at.on_cast_shadow, new, old) for new, old in zip(changes, (along, across), strict=True)
        )
    total = dr.square(along) + dr.square(across)
    usable = at.found & (total > 0) & dr.isfinite(total)
    g, ray = mi.Float(0), mi.Ray3f(at.a.ray)
    with dr.resume_grad():
        o, d = camera_ray.o, camera_ray.d
        if moving is not None:
            behind = at.a.depth > 1
            o, d = dr.select(behind, moving.p, o), dr.select(behind, moving.d, d)
        # Where something is not finite, its derivative must not even be multiplied by 0.
        ray.o, ray.d = (
            dr.select(usable, dr.replace_grad(v, new), v)
            for v, new in ((ray.o, mi.Point3f(o)), (ray.d, mi.Vector3f(d)))
        )
        if touch is not None:
            g = touch.moved - dr.dot(touch.n, ray.o + touch.t * ray.d)
            g = dr.select(at.grazes, dr.select(usable & at.grazes, dr.dot(moving.n, ray.d), 0), g)
        if line is not None:
            on_line = usable & at.on_texture
            si = surface_met(job.tracer.scene, ray, at.a.pi, mi.RayFlags.All, on_line)
            if job.tracer.held is not None:
                # What is held there moves with the line, but for the motion of this over the surface.
                first = job.tracer.held.are(at.a.ray, at.a.pi, on_line & (at.a.depth == 1))
                si = dr.select(first, job.tracer.held.seen(job.tracer.scene, ray, at.a.pi, first), si)
            g = dr.select(at.on_texture, dr.select(on_line, textures.across(line, si), 0), g)
        if border is not None:
            there = usable & border.found & at.on_cast_shadow
            si = surface_met(job.tracer.scene, ray, at.a.pi, mi.RayFlags.All, there)
            g = dr.select(at.on_cast_shadow, dr.select(there, of_border(si), 0), g)
    return dr.select(usable, -segment.weight * along / total, 0), g


def _at_outline(scene: mi.Scene, at: Parting, segment: Segment) -> tuple[Touch, mi.Float, mi.Float]:
    """Where the rays touch an outline, and the derivatives of g along and across the segment."""
    a, b = (at.a.ray, at.a.pi), (at.b.ray, at.b.pi)
    a_is_near = at.a.pi.t <= at.b.pi.t
    near, far = (tuple(dr.select(a_is_near, x, y) for x, y in zip(p, q, strict=True)) for p, q in ((a, b), (b, a)))
    active = at.found & ~at.on_texture & ~at.on_cast_shadow & near[1].is_valid()
    reach = segment.length * dr.norm(at.along.o + near[1].t * at.along.d)
    touch = touch_outline(scene, at.a.ray, near, far, reach, active)
    return touch, *(-dr.dot(touch.n, way.o + touch.t * way.d) for way in (at.along, at.across))


def _beside(chains: Chains, at: Parting, segment: Segment, outline: tuple[Touch, mi.Float, mi.Float] | None) -> Parting:
    """What is seen on both sides of a jump, a little farther aside than it is known.

    Close to the edges of glass, to inner edges of acute corners, and to lines in which surfaces cut each other, rays
    start beyond the other surface. Close to a line of a texture, few numbers are left in single
    precision, and often one of both rays meets the line itself, which may belong to either side: to Mitsuba's
    `checkerboard`, to the other one. This looks past that, unless other faces, or other parts of the texture, are
    there.
    """
    aside = dr.zeros(mi.Float, dr.width(at.found))
    if outline is not None:
        touch, along, _ = outline
        scene, p = chains.tracer.scene, at.a.ray(touch.t)
        of_glass = _goes_in(at.a) | _goes_in(at.b)
        away = dr.select(of_glass, BEHIND * lift(scene, p), _beside_line(scene, at, segment, p))
        aside = dr.select(~at.on_texture & ~at.on_shadow & ~at.grazes, away / dr.abs(along), 0)
    if chains.textures is not None:
        line, along, _ = _at_line(chains.tracer.scene, chains.textures, at)
        si = at.a.pi.compute_surface_interaction(at.a.ray, mi.RayFlags.All, at.found & at.on_texture)
        texels = dr.maximum(BESIDE_TEXTURE * chains.textures.rounding(line, si), chains.textures.step(line))
        aside = dr.select(at.on_texture, texels / dr.abs(along), aside)
    wanted = at.found & (aside > 0) & (aside < LONGEST)
    aside = dr.select(wanted, aside, 0)
    wide = segment.widened(aside)
    other = chains.part((chains.first(wide.start, wanted), chains.first(wide.end, wanted)), wide, wanted, None)
    usable = wanted & other.found
    for v, w in ((at.a, other.a), (at.b, other.b)):
        same = v.pi.prim_index == w.pi.prim_index
        if chains.textures is not None:
            cells = (chains.textures.cell(chains.surfaces.met(x.ray, x.pi, wanted), mi.Bool(False)) for x in (v, w))
            same = dr.select(at.on_texture, operator.eq(*cells), same)
        usable &= (v.pi.shape == w.pi.shape) & (v.pi.instance == w.pi.instance) & same & (v.depth == w.depth)
    a, b = (dr.select(usable, new, old) for new, old in ((other.a, at.a), (other.b, at.b)))
    return replace(at, a=a, b=b)


def _at_shadow(chains: Chains, at: Parting, segment: Segment) -> Border:
    active = at.found & at.on_shadow
    a, b = (v.pi.compute_surface_interaction(v.ray, mi.RayFlags.All, active) for v in (at.a, at.b))
    return chains.shown.border(chains.tracer.scene, a, b, segment.choice, active, at.on_cast_shadow)


def _beside_line(scene: mi.Scene, at: Parting, segment: Segment, p: mi.Point3f) -> mi.Float:
    """Where both rays meet surfaces that touch each other, at about p: how far beside that line rays start that, closer
    to it, would start below the other one. Scene units; see `DeviceEdges.farther`."""
    a, b = (v.pi.compute_surface_interaction(v.ray, mi.RayFlags.Minimal, at.found) for v in (at.a, at.b))
    apart = segment.length * dr.norm(at.along.o + a.t * at.along.d)
    # Where they are met at a grazing angle, close rays meet points that are far apart.
    cosine = dr.maximum(dr.minimum(dr.abs_dot(a.n, at.a.ray.d), dr.abs_dot(b.n, at.b.ray.d)), STEEPEST)
    near = dr.norm(a.p - b.p) <= NEXT * apart / cosine + rounding(a.p, at.a.ray.o)
    meet = a.is_valid() & b.is_valid() & near
    return dr.select(meet, clear_of_overhang(scene, p, (at.a.ray, at.b.ray), (a, b)), 0)


def _goes_in(vertex: Vertex) -> mi.Bool:
    """Does glass that may have edges refract the ray there? Spheres have none, and darken towards their outline: what
    is a little aside of that is not what is on it."""
    si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.Minimal)
    is_mesh = si.shape.is_mesh() | (si.instance != None)  # noqa: E711
    return is_mesh & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)


def _at_line(scene: mi.Scene, textures: TextureLines, at: Parting) -> tuple[Line, mi.Float, mi.Float]:
    """The line on a surface that the rays meet, and the derivatives of g along and across the segment."""
    active = at.found & at.on_texture
    here, there = (v.pi.compute_surface_interaction(v.ray, mi.RayFlags.All, active) for v in (at.a, at.b))
    line = textures.between(here, there)
    g = partial(textures.across, line)
    return line, *(change_of(scene, g, at.a.ray, at.a.pi, way, active) for way in (at.along, at.across))


def find_segment(
    chains: Chains, lower: mi.ScalarPoint2f, upper: mi.ScalarPoint2f, sampler: mi.Sampler, candidates: int = CANDIDATES
) -> Segment:
    """Half of a segment, in which something jumps: one of some candidates, in proportion to their weights.

    lower, upper : corners of the part of the plane in which they are.

    Most candidates have different ends. The others have equal ends, but something else in their middle: so what is
    smaller than a segment is found as well. Each jump is found in one of these ways only. With the segment halved again
    and again, it is a candidate of the last length at which both ends are equal, or else of the first kind.
    """
    start = lower - LONGEST
    size = upper - start
    width = sampler.wavefront_size()

    def candidate(k, kept, total, sampler):
        at = sampler.next_2d()
        axis = dr.select(sampler.next_1d() < 0.5, mi.Vector2f(1, 0), mi.Vector2f(0, 1))
        hidden, level = k % HIDDEN == 0, sampler.next_1d()
        choice = mi.UInt32(sampler.next_1d() * 0x1000000)
        halvings = dr.floor(level * (HALVINGS + 1))
        length = dr.select(hidden, LONGEST * dr.exp2(-halvings), LONGEST)
        density = length * dr.select(hidden, 1 / (HIDDEN * (HALVINGS + 1)), 1 - 1 / HIDDEN) / (2 * size.x * size.y)
        yes = mi.Bool(True)
        where = mi.Point2f(start + at * size)
        a = chains.end(where, axis, choice, yes)
        b = chains.end(where + length * axis, axis, choice, yes)
        # Few segments have different ends. So of most candidates, the middle is not looked at.
        wanted = a.differs(b, length) != hidden
        middle = chains.end(where + 0.5 * length * axis, axis, choice, wanted)
        whole = Segment(where, length, axis, a, b, choice, dr.select(wanted, dr.rcp(density), 0))
        found = whole.half(middle, sampler)
        total += found.weight
        taken = sampler.next_1d() * total < found.weight
        return k + 1, dr.select(taken, found, kept), total, sampler

    nothing = Segment(
        dr.zeros(mi.Point2f, width),
        dr.zeros(mi.Float, width),
        dr.zeros(mi.Vector2f, width),
        Seen.nothing(width),
        Seen.nothing(width),
        dr.zeros(mi.UInt32, width),
        dr.zeros(mi.Float, width),
    )
    _, kept, total, _ = dr.while_loop(
        (dr.zeros(mi.UInt32, width), nothing, dr.zeros(mi.Float, width), sampler),
        lambda k, *_: k < candidates,
        candidate,
        label="segments",
    )
    kept.weight = total / candidates
    return kept


def bisect(chains: Chains, segment: Segment, sampler: mi.Sampler) -> Segment:
    """The jump in a segment, to a small part of a pixel."""

    def step(segment, sampler):
        middle = chains.end(segment.middle, segment.axis, segment.choice, mi.Bool(True))
        return segment.half(middle, sampler), sampler

    shortest = SHORTEST * 2 * dr.epsilon(mi.Float) * max(chains.rays.offset + chains.rays.size)
    going = lambda segment, _: (segment.weight > 0) & (segment.length > shortest)
    return dr.while_loop((segment, sampler), going, step, label="bisection")[0]
