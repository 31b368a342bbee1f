"""Boundaries at shading points: what edges add to the derivative of reflected light as they move past what is seen
from the point.

At a point x, the integrand of L = ∫ f |cos θ| Lᵢ(ω) dω jumps at the great-circle arcs that the edges subtend. The
derivative of L gains

    ∮ f |cos θ| · Σ_sides ± L_side · n · (ω̇_edge − ω̇_side) dl,        n dl = (ω × dω/dt) dt = (ω × e′(t)) / r dt

with ω = (e(t) − x) / r. ω̇_side is the velocity of what the interior derivative holds fixed on that side: the *material
point* that is seen there. A face that ends at the edge moves as the edge does, and contributes nothing: so neither do
creases, nor the outlines of lights by their own motion. What is left is what is seen past a silhouette, on the side
where its faces are not. Only in the vicinity of x, and of `CloseLamps`, directions are held: there, both sides count.

Edges are found by a descent of the edge tree, for emitted light within the cone of directions to one light; of a few
edges one is kept. Emitted light whose shadows are found from the lights as well (`shadow_boundary.py`), which alone
finds the shadows of small lights, is divided as between the sampling of lights and of the BSDF in path tracing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.emitter_boxes import EmitterBoxes
from rimlight.edge_sampling.choice.sampling import EdgeSample, power_heuristic
from rimlight.edge_sampling.choice.silhouettes import Placement, Silhouettes
from rimlight.edge_sampling.choice.views import Cone, Lobe, View
from rimlight.edge_sampling.divided_light import division_of
from rimlight.edge_sampling.geometry.meshes import has_interpolated_normals, is_met, pointer
from rimlight.edge_sampling.parametrisation import Division, Vicinity, in_plane, material_point
from rimlight.edge_sampling.rays import spawn_ray
from rimlight.edge_sampling.smooth_lamps import SmoothLamps

from .either_light import chosen_edge, either
from .from_edges import FromEdge, FromEdges
from .horizons_at_points import HorizonsAtPoints, turned
from .indirect_shadows import is_bent, share
from .lune import Lune, spreads
from .near_lamps import share_at_first
from .past_edges import density_from_points, look_aside, look_clear, turning
from .tracer import ShadingPoint, Tracer
from .veiled_lamps import VeiledLamps
from .veils import has_veils, is_veil

#: Directions that are sampled from a BSDF, to find its peak.
DIRECTIONS = 8

#: How much to prefer edges that stand still, for scattered light at points that stand still: they count only where what
#: is seen past them moves.
STILL = 0.2

#: How much to prefer edges whose faces are both seen, where surfaces that let rays through may be before them.
VEILED = 0.2

#: Edges from which one is kept, in proportion to what it contributes if nothing hides it: where surfaces are matt; and
#: where any is glossy, or lets rays through, since much depends on the direction then. The more there are, the less is
#: left of the stratification of a single one.
CANDIDATES, MORE = 2, 4


class ShadingBoundary:
    """Samples the edges of a scene as shading points see them.

    Parameters
    ----------
    scene : mi.Scene
    silhouettes : of all shapes; refitted by the caller. horizons : see `Boundaries`.
    moving : the shapes that move. At points that stand still, only the first group of edges matters then; None: all
        edges matter at all points.
    sliding : those over which the lines of their textures move.
    """

    _NUMBERS = ("transmits", "glossy", "smooth", "soft", "veils", "emission", "emission_at_first", "several", "crossed")
    _PARTS = ("silhouettes", "boxes", "moving_shapes", "lights", "smooth_lamps", "bent_lamps", "from_edges")
    DRJIT_STRUCT = dict.fromkeys((*_PARTS, *_NUMBERS, "horizons", "veiled"))  # for `dr.freeze`

    def __init__(
        self,
        scene: mi.Scene,
        silhouettes: Silhouettes,
        moving: list[mi.Shape] | None,
        sliding: Sequence[mi.Shape] = (),
        horizons: HorizonsAtPoints | None = None,
    ):
        self.silhouettes, self.horizons = silhouettes, horizons
        self.geometry = geometry = silhouettes.geometry
        self.moving_shapes = None if moving is None else [pointer(s) for s in moving]
        self.boxes = EmitterBoxes(scene, geometry)
        #: What finds points from edges of shapes that move; None: nothing does.
        self.from_edges = FromEdges.of(silhouettes) if moving is not None else None
        self.smooth_lamps = SmoothLamps(scene)
        lamps = [e.get_shape() for e in scene.emitters() if e.flags() & mi.EmitterFlags.Surface]
        self.bent_lamps = [mi.ShapePtr(s) for s in lamps if is_bent(s)]
        emitters = scene.emitters()
        #: Do shapes cut through lamps? That is no shadow, which would be found from the lamp.
        shapes = geometry.known
        self.cut_lamps = any(shapes[i].is_emitter() for lines in geometry.lines for i in lines.shapes)
        #: Do lines of textures move over surfaces, and over lamps?
        self.crossed = silhouettes.textures is not None and bool(sliding)
        self.crossed_lamps = self.crossed and any(s.is_emitter() for s in sliding)
        #: All that are no points or directions, whether Mitsuba samples them or not ("sampling_weight" may be 0).
        lights = [i for i, e in enumerate(emitters) if not e.flags() & mi.EmitterFlags.Delta]
        self.veiled = VeiledLamps(scene, lights, self.boxes, moving)
        self.lights = mi.UInt32(lights or [0])  # Dr.Jit 1.5 cannot freeze empty arrays
        self.emission = bool(lights)
        flags = [s.bsdf().flags() if s.bsdf() is not None else mi.BSDFFlags.All for s in scene.shapes()]
        self.transmits = any(f & mi.BSDFFlags.Transmission for f in flags)
        self.glossy = any(f & mi.BSDFFlags.Glossy for f in flags)
        #: Are there surfaces that rays go through as if nothing was there?
        self.veils = has_veils(scene)
        #: Are there interpolated normals?
        self.smooth = any(has_interpolated_normals(m) for m in geometry.meshes)
        #: Have all lights a size? Then what the planes of faces hide has one, too.
        self.soft = len(lights) == len(emitters)
        #: Emitters of several lights (see `Lights`): only their background counts.
        self.several = [e for e in emitters if hasattr(e, "light_count")]
        #: Is emitted light sought at points that the camera sees, too? For diffuse surfaces `ShadowBoundary` is enough,
        #: except for the light of environments, and near `CloseLamps`.
        self.emission_at_first = any(self._counts_at_first(emitters[i]) for i in lights)

    def _counts_at_first(self, emitter: mi.Emitter) -> bool:
        if emitter.flags() & mi.EmitterFlags.Surface:
            return self.glossy or self.cut_lamps or self.crossed_lamps
        return not hasattr(emitter, "light_count") or emitter.background is not None

    def refit(self) -> None:
        """Follow the vertices. To be called before sampling, after the tree is refitted."""
        self.boxes.refit(dr.detach(self.geometry.positions()))

    # ---------------------- From points ----------------------

    def sample(
        self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> mi.Spectrum:
        """One sample of the boundary integral at each point: of the light that a light emits, or of light that is
        scattered.

        placement : of the shapes, from `Silhouettes.placement`; attached. Made before `point`: in backward mode, its
            gradients are then complete before they are passed on, which takes one kernel, and not two.
        choice : see `sample_edge`.

        Returns: mi.Spectrum, (N,), zero, with the gradient of the reflected radiance.
        """
        near = self._near(tracer, placement, point, sampler)
        point = point if near is None else near.point
        with dr.suspend_grad():
            e, emission, light, active, to_lamp = self._edge(tracer, placement, point, sampler, choice)
            if near is not None:
                e, emission = dr.select(near.found, near.sample, e), emission & ~near.found
                part = near.part(placement, e, emission)
            division = either(emission, to_lamp, Division(point.vicinity.around(point.si.bsdf())))
        L = self._evaluate(tracer, placement, point, e, sampler, active, light, emission, division)
        with dr.resume_grad():
            return L if near is None else L * part

    def _edge(
        self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> tuple[EdgeSample, mi.Bool, mi.EmitterPtr, mi.Bool, Division]:
        """An edge for each point; is it for emitted light, that of which light, is there one, and how is that light
        divided?"""
        scene, si = tracer.scene, point.si
        with dr.suspend_grad():
            bsdf = si.bsdf()
            moves = self._moves(si)
            active = point.active & si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

            # ---------------------- Emitted light, or scattered ----------------------

            at_first = self.emission_at_first or tracer.lamps is not None
            emission = active & ((point.depth != 1) | at_first) & self.emission
            scattering = active & tracer.scatters(point.depth + 1) & tracer.scatters(2)
            facing = mi.Vector3f(0) if self.transmits else si.n * dr.sign(dr.dot(si.n, si.to_world(si.wi)))
            number, p_light = self._choose(tracer, si.p, facing, sampler, emission)
            cone, aim = self.boxes.cone(number, si.p), self.veiled.aim(si.p, sampler)
            light = dr.gather(mi.EmitterPtr, scene.emitters_dr(), number, emission)
            to_lamp = division_of(tracer.lamps, point.turning, light)
            if not self.emission_at_first:
                emission &= (point.depth != 1) | (self.boxes.distance(number, si.p) < to_lamp.vicinity.radius)

            # ---------------------- An edge ----------------------

            view = View(
                mi.Vector3f(si.p - self.silhouettes.centre),
                facing,
                dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse), dr.inv_pi, 0.1 * dr.inv_pi),
                [self._lobe(si, bsdf, sampler, active)] if self.glossy else [],
            )
            to_surface = Division(point.vicinity.around(bsdf))

            def candidate(part, emitted, active, sampler):
                """An edge for emitted light, which is sought in the directions of one light; or for scattered light,
                which is sought everywhere, and where both sides of edges close by count. And about what it contributes
                if nothing hides it."""
                division = either(emitted, to_lamp, to_surface)
                # Of the edges whose faces are both seen, emitted light counts only those on the borders of lamps, which
                # the tree takes for open ones.
                radius = dr.select(emitted, 0, dr.inf if self.veils else division.vicinity.radius)
                ball = Vicinity(radius) if tracer.scatters(2) else None
                wide, aimed = Cone(cone.axis, mi.Float(-1), cone.sin), ~emitted & aim.taken
                towards = replace(view, cone=dr.select(emitted, cone, aim.cone(wide)), vicinity=ball)
                # What is seen past an edge that stands still may move. What emits does not: else all would be in one
                # group.
                still = dr.select(moves | point.slides | aimed, 1, dr.select(emitted, 0, STILL))
                use = [1, still][: self.silhouettes.groups]
                e = self.silhouettes.sample(placement, towards, sampler, use, choice=part, active=active)
                outline = self.silhouettes.point(placement, e, si.p)
                d = outline.p - si.p
                r2 = dr.squared_norm(d)
                ω = d * dr.rsqrt(r2)
                f = bsdf.eval(mi.BSDFContext(), si, si.to_local(ω), active)
                arc = dr.norm(dr.cross(d, outline.tangent)) * dr.rcp(r2)
                seen_past = outline.outward(dr.cross(d, outline.tangent), d) != 0
                near = 1 - division.held(r2, ω)
                near = dr.select(emitted, near, dr.maximum(near, VEILED)) if self.veils else near
                crease = self.silhouettes.crease(e, outline) * near
                # The closer an edge is, the faster its direction turns; but behind a veil, as fast as that is close.
                turn = dr.select(aimed, 1, dr.rsqrt(r2)) * self.silhouettes.preferred(e, use)
                jumps = dr.select((seen_past ^ outline.is_line) | outline.crosses, 1, crease)
                return e, dr.max(f) * arc * turn * dr.select(emitted | aim.counts(ω), jumps, 0)

            many = tracer.scatters(2) or tracer.lamps is not None
            number = MORE if self.glossy or self.veils else CANDIDATES if many else 1
            e, emission = chosen_edge(candidate, number, choice, emission, scattering, sampler)
            e.density *= dr.select(emission, p_light, aim.part)
            return e, emission, light, active, to_lamp

    def _near(self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler) -> FromEdge | None:
        """Points of which some are found from edges; None: this is not done."""
        if self.from_edges is None or not tracer.scatters(3):
            return None
        return self.from_edges.replaced(tracer, placement, point, sampler)

    def _moves(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Do edges matter there that stand still?"""
        moves = mi.Bool(self.moving_shapes is None)
        for shape in self.moving_shapes or ():
            moves |= is_met(si, shape)
        return moves

    @staticmethod
    def _lobe(si, bsdf, sampler, active) -> Lobe:
        """Around which direction the BSDF is most reflective: of a few directions that are sampled from it, that of the
        highest density.

        Since it only guides the choice, it may be as random as this; and nothing about a BSDF must be known but how to
        sample it.
        """

        def draw(k, axis, pdf, sampler):
            bs, _ = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active)
            better = active & (bs.pdf > pdf) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            return k + 1, dr.select(better, bs.wo, axis), dr.select(better, bs.pdf, pdf), sampler

        width = dr.width(si.p)
        axis = dr.zeros(mi.Vector3f, width)
        axis.z = 1
        state = (dr.zeros(mi.UInt32, width), axis, dr.zeros(mi.Float, width), sampler)
        _, axis, pdf, _ = dr.while_loop(state, lambda k, *_: active & (k < DIRECTIONS), draw, label="peak of a BSDF")
        # As wide as a lobe of that density.
        return Lobe(si.to_world(axis), pdf, dr.clip(dr.rsqrt(dr.pi * dr.maximum(pdf, 1e-3)), 1e-5, 1))

    def _choose(self, tracer: Tracer, x, facing, sampler: mi.Sampler, active) -> tuple[mi.UInt32, mi.Float | float]:
        """One of the lights with a size, by its number in the scene, and with which probability."""
        count = dr.width(self.lights)
        if tracer.lights is not None and tracer.lights.count == count:
            chosen = tracer.lights.choose(dr.detach(x), mi.Vector3f(facing), sampler.next_1d(active), active)
            return chosen.number, chosen.p
        which = dr.minimum(mi.UInt32(sampler.next_1d(active) * count), count - 1) if count > 1 else mi.UInt32(0)
        return dr.gather(mi.UInt32, self.lights, which), 1 / count

    def _evaluate(
        self,
        tracer: Tracer,
        placement: Placement,
        point: ShadingPoint,
        sample: EdgeSample,
        sampler: mi.Sampler,
        active: mi.Bool,
        light: mi.EmitterPtr,
        emission: mi.Bool,
        division: Division,
    ) -> mi.Spectrum:
        """What a point on an edge does to the light that is reflected.

        light : the only one whose emission counts. emission : does emitted light count, or scattered light?
        division : how this light is divided; attached.
        """
        scene, si = tracer.scene, point.si
        with dr.suspend_grad():
            # Mitsuba's rays start above the surface: look from there.
            towards = self.silhouettes.point(placement, sample, si.p).p - si.p
            lift = spawn_ray(scene, si, towards).o - si.p
            x = mi.Point3f(si.p + lift)
            outline = self.silhouettes.point(placement, sample, x)
            p, distance = outline.p, dr.norm(outline.p - x)
            ω = (p - x) / distance
            n_dl = dr.cross(ω, outline.tangent) / (distance * sample.density)
            f, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(ω), active)
            # Seen along its own face, an edge hides nothing, but rounding decides what a ray past it meets.
            active = active & (sample.density > 0) & ~in_plane(si, p, outline.slack)
            active &= dr.any(f != 0) & dr.isfinite(dr.squared_norm(n_dl))
            across = dr.normalize(n_dl)
            outward, n_dl = self._outward(outline, across, ω, n_dl, sampler, active)
            # Of a crease, both sides are faces of its own.
            near = dr.detach(1 - division.held(dr.square(distance), ω))
            near_or_crossed = (near > 0) | outline.crosses
            active &= (outward != 0) | near_or_crossed | (~emission & self.veils)
            aside = self.silhouettes.beside(scene, placement, sample, p, x)
            see = partial(look_aside, scene, si, x, outline, across, distance)
            past, side = outward != 0, dr.select(outward != 0, outward, 1)
            seen = see(side, aside, active)
            if tracer.scatters(2):
                seen, aside = look_clear(scene, outline, ω, seen, aside, active & ~emission, partial(see, side))
            ray, pi, y, hidden, own = seen
            veiled = hidden & ~emission & is_veil(y) if self.veils else mi.Bool(False)
            active &= veiled | (~hidden & (past | (own & near_or_crossed)))
            # Past all edges behind a veil, and past lines that move over their surface, both sides slide.
            slide, shines = veiled | outline.crosses, active & emission & (past | near_or_crossed)
            L, from_lamp = self._emitted(tracer, point, y, ω, pdf, distance, shines, light, past & ~outline.is_line)
            valid = active & y.is_valid()
            again, lune, faces = sampler.clone(), None, mi.Spectrum(0)
            if tracer.scatters(2):
                reflected = valid & ~emission
                beside, lune = self._on_faces(sample, outline, y, past, veiled) if self.smooth else (None, None)
                found = _found_from_points(point, p, y, ω, past & ~outline.is_line & ~veiled)
                scattered = tracer.scattered(ray, pi, point.depth, sampler, reflected, beside, lune, found)
                L += dr.select(reflected, scattered, 0)
            if tracer.scatters(2) or tracer.lamps is not None or self.crossed:
                # Just inside of the outline of a ball, p is as far from the ball's tangent plane as the ray is aside.
                other = see(-side, aside, active & (veiled | (near_or_crossed & ~outline.is_line)), slack=2)
                other_L, of_faces = self._shown_by_faces(tracer, point, *other, again, light, emission, lune, veiled)
                active &= of_faces | veiled | ~slide
                # Of lines in which shapes cut each other, each is one of two that are looked at.
                L = dr.select(slide, (L - other_L) * dr.select(outline.is_line, mi.Float(0.5), 1), L)
                # What its own faces show, held in its direction in the vicinity.
                of_faces &= active & ~slide
                faces = side * near * dr.select(of_faces, f * (other_L - dr.select(past, 0, L)), 0)
            L, from_lamp = (dr.select(active & (past | slide), f * light, 0) for light in (L, from_lamp))
            n_dl = dr.select(active, n_dl, 0)

        with dr.resume_grad():
            p, x = self.silhouettes.point(placement, sample, x).p, si.p + lift
            edge = turning(n_dl, p - x, active)
            d = material_point(ray, pi, valid).p - x
            held = division.held_beside(d, ω, valid)
            turned = dr.dot(n_dl, dr.select(active, division.turned(ω) - ω, 0))
            value = L * (edge - held * turning(n_dl, d, valid) - (1 - held) * turned)
            # From lamps, shadows are found as if directions did not turn, and none of the part of which they do.
            value += from_lamp * (dr.detach(division.turns(dr.squared_norm(d), ω)) * edge - (1 - held) * turned)
            return dr.select(past, outline.sign, 1) * (faces * (edge - turned) - side * value)

    def _on_faces(self, sample: EdgeSample, outline, y, past, veiled) -> tuple[mi.Bool, Lune]:
        """Where normals that face away are turned; and from where the light comes that only planes of faces hide."""
        soft = ~past & ~veiled & self.silhouettes.only_bends(sample, outline) & spreads(y.bsdf()) & self.soft
        return turned(self.horizons, y, ~past | veiled), Lune.between(outline.tangent, outline.normals, soft)

    def _shown_by_faces(
        self, tracer: Tracer, point: ShadingPoint, ray, pi, y, hidden, own, sampler, light, emission, lune, veiled
    ) -> tuple[mi.Spectrum, mi.Bool]:
        """What arrives along a ray that `look` has made, from a surface on which the edge lies, or from a veil before
        it; and does it?"""
        active = pi.is_valid() & (veiled | (~hidden & own))
        L = self._radiance(tracer.scene, y, light, active & emission)
        if tracer.scatters(2):
            reflected = active & ~emission
            beside = turned(self.horizons, y, reflected) if self.smooth else None
            scattered = tracer.scattered(ray, pi, point.depth, sampler, reflected, beside, lune)
            L += dr.select(reflected, scattered, 0)
        return L, active

    def _outward(self, outline, across, ω, n_dl, sampler, active) -> tuple[mi.Float, mi.Vector3f]:
        """The side of an edge where its faces are not, ±1 along `across`; 0: both. And `n_dl`, for one of two sides."""
        outward = outline.outward(across, ω)
        if not self.silhouettes.lines:
            return outward, n_dl
        # Beside a line in which meshes cut through each other, both sides slide past it. One of them is looked at, by
        # chance. Where it is an edge that is a silhouette, that counts in its place.
        one = dr.select(sampler.next_1d(active) < 0.5, mi.Float(1), -1)
        times = dr.select(outline.is_line, dr.select(outward == 0, mi.Float(2), 0), 1)
        return dr.select(outline.is_line, one, outward), times * n_dl

    def _emitted(
        self, tracer, point, y, ω, pdf, distance, active, light: mi.EmitterPtr, found_too: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Light that one light emits at y towards a point: the part of which shadows are found from the point; and the
        part of which they are found from the light, as far as nothing turns with lobes. pdf : density of ω among
        samples of the BSDF there. distance : of the edge. found_too : may the edge throw a shadow that is found from
        the light?"""
        if not self.emission:
            return mi.Spectrum(0), mi.Spectrum(0)
        scene, si, at_first = tracer.scene, point.si, point.depth == 1
        L, emitter = self._radiance(scene, y, light, active), y.emitter(scene, active)
        lit = active & (emitter == light)
        # Shadows that are found from the lights, too; all of those on what the sensor sees.
        shared = lit & found_too & mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        for lamp in self.bent_lamps:
            shared &= at_first | (y.shape != lamp)
        on_smooth = lit & ~shared & self.smooth_lamps.are(y.shape) if len(self.smooth_lamps) else mi.Bool(False)
        light_pdf = scene.pdf_emitter_direction(si, mi.DirectionSample3f(scene, y, si), shared | on_smooth)
        mis = power_heuristic(pdf, light_pdf)
        part = share(point.density, light_pdf, pdf, dr.abs_dot(si.n, ω), distance, y.t)
        first = share_at_first(tracer.lamps, light, distance, y.t, 1 - mis if self.emission_at_first else 1)
        theirs = dr.select(shared, dr.select(at_first, first, part), 0)
        ours = L * (1 - theirs)
        if len(self.smooth_lamps):
            ours *= dr.select(on_smooth, self.smooth_lamps.cosine(y, ω, 1 - mis) / dr.abs_dot(y.n, ω), 1)
        return ours, L * theirs

    def _radiance(self, scene: mi.Scene, y: mi.SurfaceInteraction3f, light: mi.EmitterPtr, active) -> mi.Spectrum:
        """What one light emits at y."""
        if not self.emission:
            return mi.Spectrum(0)
        emitter = y.emitter(scene, active)
        lit = active & (emitter == light)
        L = emitter.eval(y, lit)
        for several in self.several:
            mine = lit & (emitter == mi.EmitterPtr(several))
            L = dr.select(mine, several.eval_background(y, mine), L)
        return L


def _found_from_points(
    point: ShadingPoint, p: mi.Point3f, y: mi.SurfaceInteraction3f, ω: mi.Vector3f, active: mi.Bool
) -> mi.Float:
    """`density_from_points` of what is seen past the point p of an edge; infinite where `DeepShadows` does not find
    it."""
    si, (r_x, r_y) = point.si, (dr.norm(p - q) for q in (point.si.p, y.p))
    cos_z, cos_x, cos_y = dr.abs_dot(si.n, si.to_world(si.wi)), dr.abs_dot(si.n, ω), dr.abs_dot(y.n, y.to_world(y.wi))
    found = density_from_points(point.density, cos_z, cos_x, cos_y, r_x, r_y)
    return dr.select(active & (point.depth > 1), found, dr.inf)
