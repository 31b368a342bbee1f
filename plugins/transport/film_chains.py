"""What perfect mirrors and glass show to the camera, or to a point, as a function of a position in the plane.

Behind a chain of mirrors there is no projection by which an edge could be found on the film. So its image is looked
for: along a short segment of the plane, what the chain ends at is compared at both ends, and where it differs, the
segment is bisected (`terms/jumps.py`). Here chains are followed, and two of them compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.found import Boundaries
from rimlight.edge_sampling.geometry.meshes import has_normal_map, surfaces
from rimlight.edge_sampling.geometry.surfaces import components
from rimlight.edge_sampling.rays import spawn_ray, starts_in

from .chain_rays import FilmRays, PointRays
from .log import Log
from .paths import Vertex
from .ray_derivatives import RayDerivative, change_of, normal_derivative
from .scattering import Next, Numbers
from .tracer import PathTracer

#: Two points close to each other on the film show one surface, if they are at most so many times as far apart as the
#: one of them that moves less has it; and their normals likewise.
APART = 3.0

#: What rounding may add to the distance of two points, in units in the last place of their coordinates; and to the
#: difference of two normals.
ROUNDING, BENT = 256, 1e-3


@dataclass
class Seen:
    """What a chain ends at, and how it comes there.

    way : mi.UInt32, equal for chains that take the same way.
    p, n : mi.Vector3f, the point and its shading normal; of rays that meet nothing, the direction, and 0.
    moved, turned : mi.Float, how much p and n change per pixel.
    cells : mi.UInt32, equal for chains that meet equal parts of textures.
    uv, drifted : mi.Vector2f and mi.Float, texture coordinates there, and how much they change per pixel.
    shown : mi.Bool, by a mirror, or by glass that bends rays?
    """

    way: mi.UInt32
    cells: mi.UInt32
    p: mi.Vector3f
    n: mi.Vector3f
    uv: mi.Vector2f
    moved: mi.Float
    turned: mi.Float
    drifted: mi.Float
    shown: mi.Bool

    @staticmethod
    def nothing(width: int) -> Seen:
        return dr.zeros(Seen, width)

    def differs(self, other: Seen, distance: mi.Float) -> mi.Bool:
        """Does something jump between two chains, so many pixels apart, that is no edge as the camera sees it?"""
        elsewhere, shown = self.way != other.way, self.shown | other.shown
        return (shown & (elsewhere | self.is_apart_from(other, distance))) | (~elsewhere & (self.cells != other.cells))

    def is_apart_from(self, other: Seen, distance: mi.Float) -> mi.Bool:
        """Is there a gap, a crease, or a seam of texture coordinates, between two points that are seen so many pixels
        apart?"""
        scale = dr.maximum(dr.max(dr.abs(self.p)), dr.max(dr.abs(other.p)))
        near = APART * distance * dr.minimum(self.moved, other.moved) + ROUNDING * dr.epsilon(mi.Float) * scale
        gap = dr.norm(self.p - other.p) > near
        # As far as that is in texture coordinates.
        per_unit = dr.maximum(self.drifted / self.moved, other.drifted / other.moved)
        rounding = ROUNDING * dr.epsilon(mi.Float) * dr.maximum(dr.norm(self.uv), dr.norm(other.uv))
        gap |= dr.norm(self.uv - other.uv) > near * per_unit + rounding
        return gap | (dr.norm(self.n - other.n) > APART * distance * dr.minimum(self.turned, other.turned) + BENT)


@dataclass
class Segment:
    """A segment of the film, at whose ends different things are seen.

    start : mi.Point2f, pixels. length : mi.Float, pixels, along `axis`.
    a, b : what is seen at both ends.
    choice : mi.UInt32, of the chains.
    weight : mi.Float, over the density with which one of its length starts here; 0: there is none.
    """

    start: mi.Point2f
    length: mi.Float
    axis: mi.Vector2f
    a: Seen
    b: Seen
    choice: mi.UInt32
    weight: mi.Float

    @property
    def end(self) -> mi.Point2f:
        return self.start + self.length * self.axis

    @property
    def middle(self) -> mi.Point2f:
        return self.start + 0.5 * self.length * self.axis

    def widened(self, aside: mi.Float) -> Segment:
        """Longer by so many pixels at both ends."""
        return replace(self, start=self.start - aside * self.axis, length=self.length + 2 * aside)

    def half(self, middle: Seen, sampler: mi.Sampler) -> Segment:
        """One of its halves in which something jumps: any of two, with twice the weight."""
        h = 0.5 * self.length
        left, right = self.a.differs(middle, h), middle.differs(self.b, h)
        both = left & right
        right &= ~left | (sampler.next_1d() < 0.5)
        return Segment(
            dr.select(right, self.middle, self.start),
            h,
            self.axis,
            dr.select(right, middle, self.a),
            dr.select(right, self.b, middle),
            self.choice,
            self.weight * dr.select(both, 2, dr.select(left | right, mi.Float(1), 0)),
        )


@dataclass
class Link:
    """A vertex of a chain, and how that goes on.

    seen : of this vertex alone; its way is the shape.
    onwards : the next ray, and what that meets.
    ways : derivatives of the next ray.
    lobe : mi.UInt32, 0 if there is no next vertex, 1 if the next ray has the same direction, 2 if it is reflected, 3
        if it is refracted; and 4 more, if interpolated normals send it to the wrong side of its face.
    numbers : random numbers.
    dark : mi.Bool, is it in the shadow of a light, as far as mirrors show it?
    """

    seen: Seen
    onwards: Next
    ways: tuple[RayDerivative, ...]
    lobe: mi.UInt32
    numbers: Numbers
    dark: mi.Bool


@dataclass
class Parting:
    """Where two chains part.

    a, b : the vertices at which they do: what the same ray of both meets.
    along, across : derivatives of the ray to a.
    on_texture : mi.Bool, is it at a line of a texture? on_shadow : at the border of a shadow?
    grazes : mi.Bool, is it where the ray passes from one side of the face from which it starts to the other?
    found : mi.Bool, do they, in a way that is no edge as the camera sees it?
    """

    a: Vertex
    b: Vertex
    along: RayDerivative
    across: RayDerivative
    on_texture: mi.Bool
    on_shadow: mi.Bool
    grazes: mi.Bool
    found: mi.Bool

    @property
    def on_cast_shadow(self) -> mi.Bool:
        """Is it at the border of a shadow inside of a face? At an edge, the shadow begins since one of both faces turns
        away from the light."""
        return self.on_shadow & (self.a.pi.prim_index == self.b.pi.prim_index)


class Chains:
    """Follows chains of mirrors from the camera, or from points.

    boundaries : with what is known of mirrors, of textures whose lines count, and of surfaces.
    """

    def __init__(self, tracer: PathTracer, rays: FilmRays | PointRays, boundaries: Boundaries):
        self.tracer, self.rays, self.surfaces = tracer, rays, boundaries.surfaces
        self.mirrors, self.textures, self.shown = boundaries.mirrors, boundaries.textures, boundaries.shown
        bsdfs = [s.bsdf().flags() for s in surfaces(tracer.scene) if s.bsdf() is not None]
        #: Mirrors and glass with normal maps or bump maps.
        self._mapped = [mi.BSDFPtr(s.bsdf()) for s in surfaces(tracer.scene) if self.mirrors and is_mapped_mirror(s)]
        self._any_mask = self.mirrors and any(f & mi.BSDFFlags.Null and f & mi.BSDFFlags.Smooth for f in bsdfs)
        #: Masks whose other part reflects perfectly, too, as one of plastic does.
        self._shiny_masks = [
            mi.BSDFPtr(s.bsdf()) for s in surfaces(tracer.scene) if self._any_mask and is_shiny_mask(s)
        ]

    def first(self, u: mi.Point2f, active: mi.Bool) -> Vertex:
        """What is seen at u."""
        return self.rays.first(self.tracer, u, active)

    def link(
        self, vertex: Vertex, ways: tuple[RayDerivative, ...], choice: mi.UInt32, shown: mi.Bool, active: mi.Bool
    ) -> Link:
        """A vertex of a chain.

        ways : derivatives of the ray to it, the first along the axis on which what is seen is compared.
        choice : by which the chain chooses between what is reflected and what is let through.
        shown : does a mirror or glass show it?
        """
        scene, ray, pi = self.tracer.scene, vertex.ray, vertex.pi
        met = active & pi.is_valid()
        si = self.surfaces.met(ray, pi, met)
        if self.tracer.fine_mirrors is not None:
            self.tracer.fine_mirrors.turn(si, ray, met)
        numbers = Numbers(mi.Point2f(0), mi.sample_tea_float32(choice, vertex.depth), mi.Point2f(0.5))
        goes_on = met & self._scatters(vertex) & self.mirrors
        bsdf = si.bsdf(ray)
        shiny = self._is_one_of(self._shiny_masks, bsdf) & goes_on
        mask = (self._is_mask(bsdf) | shiny) & goes_on
        enters, opaque = numbers.lobe < 0.5, mi.Float(0)
        if self._shiny_masks:
            # The mask samples what it covers by numbers below its opacity.
            opaque = dr.select(shiny, 1 - dr.mean(bsdf.eval_null_transmission(si, shiny)), 0)
        number = dr.select(enters, dr.one_minus_epsilon(mi.Float), (2 * numbers.lobe - 1) * opaque)
        numbers.lobe = dr.select(mask, number, numbers.lobe)
        bs, weight = bsdf.sample(mi.BSDFContext(), si, numbers.lobe, numbers.direction, goes_on)
        if self._any_mask:
            let_through, mirrored = (mi.UInt32(int(f)) for f in (mi.BSDFFlags.Null, mi.BSDFFlags.Delta))
            reflected = dr.select(opaque > 0, bs.sampled_type & mirrored, 0)
            bs.sampled_type = dr.select(mask, dr.select(enters, let_through, reflected), bs.sampled_type)
            straight = mask & (enters | ~shiny)
            bs.wo, bs.eta = dr.select(straight, -si.wi, bs.wo), dr.select(straight, 1, bs.eta)
            part = dr.select(enters, bsdf.eval_null_transmission(si, mask), opaque * weight)
            weight = dr.select(mask, 2 * part, weight)
        mirrored, through = (mi.has_flag(bs.sampled_type, f) for f in (mi.BSDFFlags.Delta, mi.BSDFFlags.Null))
        goes_on &= mirrored & (mask | dr.any(weight != 0))
        next_ray = spawn_ray(scene, si, si.to_world(bs.wo), through)
        next_pi = scene.ray_intersect_preliminary(next_ray, active=goes_on)
        onwards = Next(next_ray, next_pi, weight, bs.eta, goes_on, goes_on & through, mirrored, mirrored)
        reflected = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection)
        wrong = (dr.dot(ray.d, si.n) * dr.dot(next_ray.d, si.n) > 0) == reflected
        lobe = dr.select(reflected, mi.UInt32(2), 3) + dr.select(wrong, mi.UInt32(4), 0)
        lobe = dr.select(goes_on, dr.select(through, mi.UInt32(1), lobe), 0)
        at = ways[0].at(ray, si)
        beyond = tuple(
            dr.select(through, RayDerivative(w.at(ray, si), w.d), w.beyond(ray, si, next_ray.d, bs.eta)) for w in ways
        )
        if self._mapped:
            mapped = self._is_one_of(self._mapped, bsdf) & goes_on & ~through
            beyond = tuple(
                self._beyond_mapped(way, old, vertex, bsdf, numbers, mapped)
                for way, old in zip(ways, beyond, strict=True)
            )
        cells = dr.select(met, self.textures.cell(si, ~shown), 0) if self.textures is not None else mi.UInt32(0)
        textured = met & self.textures.has_own(si) if self.textures is not None else mi.Bool(False)
        seen = Seen(
            dr.select(met, _shape_of(pi), 0),
            cells,
            dr.select(met, mi.Vector3f(si.p), ray.d),
            dr.select(met, mi.Vector3f(si.sh_frame.n), 0),
            dr.select(textured, mi.Vector2f(si.uv), 0),
            dr.norm(dr.select(met, at, ways[0].d)),
            dr.norm(dr.select(met, normal_derivative(si, at), 0)),
            dr.select(textured, dr.norm(mi.Vector2f(*components(at, si.dp_du, si.dp_dv))), 0),
            mi.Bool(False),
        )
        return Link(seen, onwards, beyond, lobe, numbers, self._in_shadow(si, vertex, choice, met))

    @staticmethod
    def _is_one_of(some: list[mi.BSDFPtr], bsdf: mi.BSDFPtr) -> mi.Bool:
        found = mi.Bool(False)
        for one in some:
            found |= bsdf == one
        return found

    def _beyond_mapped(self, way, beyond, vertex: Vertex, bsdf, numbers: Numbers, active: mi.Bool) -> RayDerivative:
        """Of the ray beyond a mirror, where that is active: its mapped normals change as its samples tell."""

        def direction(si: mi.SurfaceInteraction3f) -> mi.Vector3f:
            bs, _ = bsdf.sample(mi.BSDFContext(), si, numbers.lobe, numbers.direction, active)
            return si.to_world(bs.wo)

        d = change_of(self.tracer.scene, direction, vertex.ray, vertex.pi, way, active)
        return RayDerivative(beyond.o, dr.select(active, d, beyond.d))

    def _scatters(self, vertex: Vertex) -> mi.Bool:
        return self.tracer.scatters(vertex.depth + self.rays.before)

    def _in_shadow(self, si: mi.SurfaceInteraction3f, vertex: Vertex, choice: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Is a point in the shadow of a light? (Shadows on what the camera sees itself are found from the light.)"""
        if self.shown is None:
            return mi.Bool(False)
        active = active & (vertex.depth > 1) & self._scatters(vertex)
        active &= mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        return active & self.shown.hidden(self.tracer.scene, si, choice, active)

    def _is_mask(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Does light go through it in part, while the rest is scattered?

        Every second chain goes through, whatever the opacity is: otherwise, chains on both sides of a line at which
        that jumps would take different ways, and not be compared.
        """
        if not self._any_mask:
            return mi.Bool(False)
        flags = bsdf.flags()
        has = lambda flag: mi.has_flag(flags, flag)
        mirror = has(mi.BSDFFlags.DeltaReflection) | has(mi.BSDFFlags.DeltaTransmission)
        return has(mi.BSDFFlags.Null) & has(mi.BSDFFlags.Smooth) & ~mirror

    def end(self, u: mi.Point2f, axis: mi.Vector2f, choice: mi.UInt32, active: mi.Bool) -> Seen:
        """What the chain from u ends at.

        axis : of the film, along which that is to be compared.
        """
        if not self.mirrors:
            return self._cell(u, active)

        def step(vertex, derivative, seen, active):
            link = self.link(vertex, (derivative,), choice, seen.shown, active)
            found = link.seen
            found.way = mi.sample_tea_32(seen.way, (found.way << 3) + link.lobe)[0]
            found.cells = mi.sample_tea_32(seen.cells, dr.select(link.dark, ~found.cells, found.cells))[0]
            found.cells = dr.select(seen.shown | self.rays.sees_all, found.cells, seen.cells)
            found.shown = mi.Bool(seen.shown)
            goes_on = active & (link.lobe > 0)
            found = dr.select(active, found, seen)
            found.shown |= active & (link.lobe >= 2)
            return after(vertex, link), link.ways[0], found, goes_on

        state = (self.first(u, active), self.rays.derivative(u, axis), Seen.nothing(dr.width(u)), active)
        return dr.while_loop(state, lambda v, δ, s, active: active, step, label="chain of mirrors")[2]

    def _cell(self, u: mi.Point2f, active: mi.Bool) -> Seen:
        """What the camera sees at u, as far as the lines of textures ask for it: the shape, and the cell."""
        vertex = self.first(u, active)
        met = active & vertex.pi.is_valid()
        seen = Seen.nothing(dr.width(u))
        seen.way = dr.select(met, _shape_of(vertex.pi), 0)
        si = self.surfaces.met(vertex.ray, vertex.pi, met)
        seen.cells = dr.select(met, self.textures.cell(si, mi.Bool(True)), 0)
        return seen

    def part(
        self,
        first: tuple[Vertex, Vertex],
        segment: Segment,
        active: mi.Bool,
        log: Log | None,
    ) -> Parting:
        """Where the two chains part that start at the ends of a segment.

        first : what the camera sees there.
        log : where the first chain is written down; None: nowhere.
        """
        rays, axis, choice = self.rays, segment.axis, segment.choice
        aside = mi.Vector2f(axis.y, axis.x)

        def step(a, b, of_a, of_b, shown, on_texture, on_shadow, grazes, found, active):
            here, there = (self.link(*of, choice, shown, active) for of in ((a, of_a), (b, of_b)))
            same_shape = here.seen.way == there.seen.way
            # Is one of both on the wrong side of its face? If that is another face, they part at the edge.
            turns, same_face = (here.lobe ^ there.lobe) == 4, a.pi.prim_index == b.pi.prim_index
            parts = ~same_shape | here.seen.is_apart_from(there.seen, segment.length) | (turns & ~same_face)
            differ = here.seen.cells != there.seen.cells
            if self.textures is not None:
                # Where the camera sees it, the edge itself counts.
                differ &= same_face | shown | ~self.textures.jump_at_edges(a.ray, a.pi, active)
            # So it does where a shadow begins at an edge, since one of both faces turns away from the light.
            dark = (here.dark != there.dark) & (same_face | shown)
            on_line = active & ~parts & ~grazes & (differ | dark) & (shown | self.rays.sees_all)
            on_texture |= on_line & differ
            on_shadow |= on_line & ~differ
            found |= (active & (parts | grazes) & shown & ~self._starts_beyond(a, b)) | on_line
            goes_on = active & ~parts & ~grazes & ~on_line & (here.lobe > 0) & ((here.lobe == there.lobe) | turns)
            grazes |= goes_on & turns
            if log is not None:
                log.leave(a.depth, a.β, here.numbers, goes_on)
                log.arrive(a.depth + 1, here.onwards, goes_on)
            a, b = (dr.select(goes_on, after(v, link), v) for v, link in ((a, here), (b, there)))
            of_a = tuple(dr.select(goes_on, new, old) for new, old in zip(here.ways, of_a, strict=True))
            of_b = tuple(dr.select(goes_on, new, old) for new, old in zip(there.ways, of_b, strict=True))
            shown |= goes_on & (here.lobe >= 2)
            return a, b, of_a, of_b, shown, on_texture, on_shadow, grazes, found, goes_on

        if log is not None:
            log.arrive(first[0].depth, first[0], active)
        no = dr.full(mi.Bool, False, dr.width(active))
        of_a = rays.derivative(segment.start, axis), rays.derivative(segment.start, aside)
        of_b = (rays.derivative(segment.end, axis),)
        state = (*first, of_a, of_b, no, *(mi.Bool(no) for _ in range(4)), mi.Bool(active))
        a, b, of_a, _, _, on_texture, on_shadow, grazes, found, _ = dr.while_loop(
            state, lambda *state: state[-1], step, label="chains of mirrors"
        )
        return Parting(a, b, *of_a, on_texture, on_shadow, grazes, found)

    def _starts_beyond(self, a: Vertex, b: Vertex) -> mi.Bool:
        """Do two rays part because one of them starts beyond the face that the other one meets?

        Rays start a little off the face that reflects or refracts them. So close to its edges, they may start beyond
        the next face, and show what is behind. The border of such a strip does not count: what looks at the edge looks
        past the strip, the film boundary (`DeviceEdges.farther`) as well as bisection, and has the whole jump.
        """
        return starts_in(self.tracer.scene, a.ray, dr.minimum(a.pi.t, b.pi.t))


def is_mapped_mirror(shape: mi.Shape) -> bool:
    """Is a shape a perfect mirror or smooth glass with a normal map or a bump map?"""
    return bool(shape.bsdf() and shape.bsdf().flags() & mi.BSDFFlags.Delta and has_normal_map(shape))


def is_shiny_mask(shape: mi.Shape) -> bool:
    """Does an opacity mask cover what scatters light, and reflects or refracts it perfectly besides?"""
    bsdf = shape.bsdf()
    smooth, mirrors = mi.BSDFFlags.Smooth, mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    return bool(bsdf and bsdf.class_name() == "MaskBSDF" and bsdf.flags() & smooth and bsdf.flags() & mirrors)


def _shape_of(pi: mi.PreliminaryIntersection3f) -> mi.UInt32:
    """A number for the shape that is met, or for one in an instance."""
    return dr.reinterpret_array(mi.UInt32, pi.shape) ^ (dr.reinterpret_array(mi.UInt32, pi.instance) << 16)


def after(vertex: Vertex, link: Link) -> Vertex:
    """The next vertex of a chain."""
    onwards = link.onwards
    β, η = vertex.β * onwards.weight, vertex.η * onwards.η
    return Vertex(mi.Ray3f(onwards.ray), onwards.pi, vertex.depth + 1, β, η, onwards.mirrored, onwards.slides)
