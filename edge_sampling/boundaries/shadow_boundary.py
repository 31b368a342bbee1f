"""Shadows on the film: what edges do to the image by the shadows that they throw on what the camera sees.

A shadow is found from its light. From a point on the light, an edge that is a silhouette is projected on to what lies
behind it, and from there to the film. Of this one point of the light, the shadow is a boundary of the image as any
other:

    ∮ k(u) · (L⁻ − L⁺) · (n · du/dθ) dl,        L on the lit side: what that point alone contributes, on the other: 0.

The derivative for the whole light is the mean over its points. Where the light *is* a point, or a direction, this is
all there is (Li et al. 2018 leave such lights out); where it has a size, the same boundary can be found from the
shading points (`shading_boundary.py`), and what both find is divided between them.

The point of the light is a *material point*, as it is for the interior derivative: it moves with the light. Near
`CloseLamps`, it moves as far as the interior derivative has it: see `parametrisation.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.emitter_boxes import SLACK
from rimlight.edge_sampling.choice.sampling import EdgeSample, power_heuristic
from rimlight.edge_sampling.choice.silhouettes import Placement, Silhouettes
from rimlight.edge_sampling.choice.views import Cone, View
from rimlight.edge_sampling.geometry.beside import rounding
from rimlight.edge_sampling.lights import Lights
from rimlight.edge_sampling.parametrisation import material_point
from rimlight.edge_sampling.projection.sensors import Projection
from rimlight.edge_sampling.smooth_lamps import SmoothLamps

from .fallen_shadow import LightPoint, LitEdge, SeenShadow, Shadow, across_border, fall, look, on_both_sides
from .near_lamps import moved_with, share_at_first, still_on_film
from .tracer import Tracer

#: Of spots that are wider, degrees, edges are sought in all directions.
WIDEST = 85.0


def throws_shadows(emitter: mi.Emitter) -> bool:
    """Are the shadows that edges throw in the light of this emitter found from the emitter? Not so those of
    environments. (A `directionalarea` lights nothing in `path`.)"""
    flags = emitter.flags()
    if flags & mi.EmitterFlags.Surface:
        return not flags & mi.EmitterFlags.Delta
    return bool(flags & mi.EmitterFlags.Delta) or hasattr(emitter, "light_count")


def is_spot(emitter: mi.Emitter) -> bool:
    """Does an emitter shine into a cone of less than a half-space?"""
    return emitter.class_name() == "SpotLight" and bool(dr.all(mi.traverse(emitter)["cutoff_angle"] < WIDEST))


@dataclass
class ShadowSamples:
    """Samples of the boundaries of shadows, whose sum is the estimate.

    position : mi.Point2f, (N,), pixels, detached; where to splat.
    value : mi.Spectrum, (N,), zero, with the gradient of (L⁻ − L⁺) · (n · du/dθ) dl in pixels²; attached.
    wavelengths : mi.Spectrum or empty, nm.
    light : mi.UInt32, (N,), which light throws the shadow, by its number in `Lights`.
    """

    position: mi.Point2f
    value: mi.Spectrum
    wavelengths: mi.Spectrum
    light: mi.UInt32


class ShadowBoundary:
    """Samples the shadows that the edges of a scene throw, from its lights: points, directions, and surfaces.

    Parameters
    ----------
    scene : mi.Scene
    silhouettes : what throws shadows; refitted by the caller.
    """

    DRJIT_STRUCT = dict.fromkeys(  # for `dr.freeze`
        ("silhouettes", "lights", "smooth_lamps", "chosen", "any_surface", "any_other", "spots")
    )

    def __init__(self, scene: mi.Scene, silhouettes: Silhouettes):
        self.silhouettes = silhouettes
        self.lights, self.smooth_lamps = Lights(scene), SmoothLamps(scene)
        emitters = scene.emitters()
        #: Numbers of the lights whose shadows are sampled.
        self.chosen = mi.UInt32([k for k, i in enumerate(self.lights.emitter) if self.counts(emitters[i])])
        on_surface = {bool(e.flags() & mi.EmitterFlags.Surface) for e in emitters if self.counts(e)}
        self.any_surface, self.any_other = True in on_surface, False in on_surface
        far = any(e.flags() & mi.EmitterFlags.Infinite for e in emitters if self.counts(e))
        spots = [(k, emitters[i]) for k, i in enumerate(self.lights.emitter) if is_spot(emitters[i])]
        #: Spots by their numbers in `Lights`: edges outside of their beams throw no shadow in their light.
        self.spots = {} if far else dict(spots)

    def counts(self, emitter: mi.Emitter) -> bool:
        """Are the shadows in its light sampled?"""
        return throws_shadows(emitter)

    def __len__(self) -> int:
        """Number of lights."""
        return dr.width(self.chosen)

    def sample(self, tracer: Tracer, sensor: mi.Sensor, sampler: mi.Sampler, *, share: bool) -> ShadowSamples:
        """Choose points on lights, edges as seen from there, and points on them; one of each for every lane.

        The lanes are spread evenly over the lights and, for each, over the edges.

        share : are shadows of surfaces sampled from shading points as well?
        """
        silhouettes, count = self.silhouettes, sampler.wavefront_size()
        with dr.resume_grad():
            projection = Projection(sensor)
            placement = silhouettes.placement()
        with dr.suspend_grad():
            choice = (dr.arange(mi.Float, count) + sampler.next_1d()) * (len(self) / count)
            time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
            light = self._point_on_light(tracer.scene, choice, time, sampler.next_2d())
            edge = self._edge(placement, light, sampler)
            shadow = fall(tracer.scene, light, edge)
            view = look(tracer, projection, sensor, sampler, light.time, shadow)
            near, whole = dr.norm(edge.p - view.si.p), dr.norm(light.y - view.si.p)
            part = partial(share_at_first, tracer.lamps, light.emitter, near, whole)
            ours = (lambda *pdfs: part(power_heuristic(*pdfs))) if share else None
            met, jump, active = self._arriving(tracer, light, edge, shadow, view, ours)
            jump *= 1 if share else part(1)

            # ---------------------- The boundary on the film ----------------------

            across = across_border(projection, light, edge, shadow, view)
            n_dl = across * edge.sign / (edge.sample.density * light.density * (count / len(self)))
            active &= dr.isfinite(dr.squared_norm(n_dl)) & dr.any(jump != 0)
            active &= on_both_sides(tracer, projection, sensor, view, shadow, n_dl, active)
            n_dl = dr.select(active, n_dl, 0)
            view.active = active
            u = dr.select(active, view.u, 0)  # what is not finite would spoil pixels, even with the value 0
            if projection.attached:
                # The gradient of each number of the sensor is a kernel of its own: let none of them trace rays again.
                kept = (light.light, light.numbers, light.y, light.far, edge.sample, shadow.facing, shadow.lift)
                dr.eval(jump, n_dl, active, view.seen, view.ray, met, shadow.onwards, kept, view.slid, u)

        with dr.resume_grad():
            m = material_point(view.ray, view.seen, active).p
            held, stands = m, tracer.held and tracer.held.are(view.ray, view.seen, active)
            if view.slid is not None:
                held = still_on_film(projection, m, shadow.facing, view.aperture_sample, active)
                held = held if stands is None else dr.select(stands, m, held)
            x = self._moving(tracer.scene, placement, light, edge, shadow, view, m, held, met)
            moved = projection.film(x, view.aperture_sample).position()
            velocity = dr.select(active, moved - dr.detach(moved), 0)
            if tracer.held is not None:
                velocity -= tracer.held.velocity(view.ray, view.seen, active, projection, view.aperture_sample)
            value = jump * dr.dot(n_dl, velocity)
            return ShadowSamples(u, value, view.ray.wavelengths, light.light)

    def _moving(
        self, scene, placement: Placement, light, edge, shadow, view, m: mi.Point3f, held: mi.Point3f, met
    ) -> mi.Point3f:
        """Where the shadow falls, attached to the light, the edge, and the material point m of what it falls on.

        held : the point of that which is lit, as the interior term has it. met : what the ray from there to the light
        meets.
        """
        # To the plane in which the shadow falls. (Its turning is of second order.)
        origin, d = self._past(scene, placement, light, edge, shadow, met, view.active)
        if view.slid is not None:
            more = moved_with(held, origin, view.slid)
            origin, d = origin + more, d - more
        s = (dr.dot(shadow.facing, m - origin) + shadow.lift) / dr.dot(shadow.facing, d)
        return mi.Point3f(origin + dr.select(view.active, s, 1) * d - shadow.facing * shadow.lift)

    def _past(
        self, scene: mi.Scene, placement: Placement, light: LightPoint, edge: LitEdge, shadow: Shadow, met, active
    ) -> tuple[mi.Point3f, mi.Vector3f]:
        """The line from the light past the edge: a point of it, and its direction; attached to both."""
        p = self.silhouettes.point(placement, edge.sample, light.y, light.far, is_light=True).p
        q = self._follow(scene, light, shadow.onwards, met, active)
        return dr.select(light.far, p, q), dr.select(light.far, -mi.Vector3f(q), p - q)

    # ---------------------- From a light to an edge ----------------------

    def _point_on_light(self, scene: mi.Scene, choice: mi.Float, time: mi.Float, numbers: mi.Point2f) -> LightPoint:
        """choice : uniform from 0 to the number of lights. numbers : uniform, for the point."""
        which = dr.minimum(mi.UInt32(choice), len(self) - 1)
        choice = dr.clip(choice - which, 0, dr.one_minus_epsilon(mi.Float))
        light = dr.gather(mi.UInt32, self.chosen, which)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.lights.emitter, light))
        on_surface = mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) if self.any_other else mi.Bool(False)
        y, density = mi.Point3f(0), mi.Float(1)
        n = mi.Vector3f(0)
        if self.any_other:
            y = self._off_surface(scene, light, far, numbers, ~on_surface)
        if self.any_surface:
            ps, _ = emitter.sample_position(time, numbers, on_surface)
            y, n = dr.select(on_surface, ps.p, y), dr.select(on_surface, mi.Vector3f(ps.n), 0)
            density = dr.select(on_surface, ps.pdf, 1)
        return LightPoint(light, emitter, choice, time, numbers, on_surface, far, y, n, density)

    def _off_surface(self, scene: mi.Scene, light, far, numbers, active) -> mi.Point3f:
        """Where lights are that are no surfaces; at infinity, in which direction."""
        it = dr.zeros(mi.SurfaceInteraction3f, dr.width(numbers))
        it.p = mi.Point3f(self.silhouettes.centre)
        ds, _ = self.lights.sample_direction(scene, light, it, numbers, active)
        return dr.select(far, mi.Point3f(ds.d), ds.p)

    def _follow(self, scene: mi.Scene, light: LightPoint, onwards, met, active) -> mi.Point3f:
        """The point of the light, attached to its motion. onwards, met : a ray that meets it."""
        q = mi.Point3f(0)
        if self.any_other:
            q = self._off_surface(scene, light.light, light.far, light.numbers, active & ~light.on_surface)
        if self.any_surface:
            q = dr.select(light.on_surface, material_point(onwards, met, active & light.on_surface).p, q)
        return q

    def _edge(self, placement: Placement, light: LightPoint, sampler: mi.Sampler) -> LitEdge:
        """An edge as the light sees it."""
        silhouettes, far, y = self.silhouettes, light.far, light.y
        eye = dr.select(far, mi.Vector3f(y), mi.Vector3f(y - silhouettes.centre))
        one = dr.full(mi.Float, 1, dr.width(light.choice))
        view = View(eye, light.n, one, [], self._beam(light), far if self.any_other else None)
        active = (light.density > 0) & dr.isfinite(light.density)
        # Shadows of edges that stand still matter only on what moves.
        use = [1, 0.2][: silhouettes.groups]
        e = silhouettes.sample(placement, view, sampler, use, choice=light.choice, active=active)
        return self._edge_at(placement, light, e)

    def _beam(self, light: LightPoint) -> Cone | None:
        """The directions in which lights shine; None: all."""
        if not self.spots:
            return None
        cone = Cone(mi.Vector3f(0, 0, 1), mi.Float(-1), mi.Float(0))
        for number, emitter in self.spots.items():
            params = mi.traverse(emitter)
            sin, cos = dr.sincos(dr.detach(dr.deg2rad(params["cutoff_angle"])) * (1 + SLACK))
            axis = dr.normalize(dr.detach(params["to_world"]) @ mi.Vector3f(0, 0, 1))
            cone = dr.select(light.light == number, Cone(axis, cos, sin), cone)
        return cone

    def _edge_at(self, placement: Placement, light: LightPoint, e: EdgeSample) -> LitEdge:
        """The point of an edge that was sampled, as the light sees it."""
        far, y = light.far, light.y
        outline = self.silhouettes.point(placement, e, y, far, is_light=True)
        d = dr.select(far, -mi.Vector3f(y), outline.p - y)
        ω = dr.normalize(d)
        across = dr.normalize(dr.cross(ω, outline.tangent))
        lit = across * outline.outward(across, ω, either=True)
        emits = dr.select(light.on_surface, dr.dot(light.n, ω), 1) > 0
        active = (e.density > 0) & emits & dr.any(lit != 0)
        return LitEdge(e, outline.p, outline.tangent, lit, d, ω, active, outline, outline.slack, outline.sign)

    # ---------------------- What arrives where the shadow falls ----------------------

    def _arriving(
        self,
        tracer: Tracer,
        light: LightPoint,
        edge: LitEdge,
        shadow: Shadow,
        view: SeenShadow,
        share: Callable | None,
    ) -> tuple[mi.PreliminaryIntersection3f, mi.Spectrum, mi.Bool]:
        """What a ray to the light meets; the radiance that the sensor sees of this light beside the shadow, and is it
        there?

        share : given the densities of the direction to a lamp, among light samples and those of the BSDF: which part of
            its shadow is found so; None: all.
        """
        scene, si, y, n, on_surface = tracer.scene, view.si, light.y, light.n, light.on_surface
        # From x to the edge, nothing is in the way: that has been seen already.
        onwards = shadow.onwards
        onwards.wavelengths = view.ray.wavelengths
        # As far as rays from x go (`spawn_ray_to`), since lights may lie on surfaces.
        distance = dr.norm(y - onwards.o) - mi.math.ShadowEpsilon * dr.norm(y - si.p)
        onwards.maxt = dr.select(on_surface | light.far, dr.largest(mi.Float), distance)
        met = scene.ray_intersect_preliminary(onwards, active=view.active)
        reached = met.is_valid() & (met.shape.emitter() == light.emitter)
        reached &= dr.abs_dot(n, onwards(met.t) - y) <= rounding(y, onwards.o)
        active = view.active & dr.select(on_surface, reached, ~met.is_valid())
        ω_x, L = mi.Vector3f(0, 0, 1), mi.Spectrum(0)
        if self.any_other:
            ds, L = self.lights.sample_direction(scene, light.light, si, light.numbers, active & ~on_surface)
            ω_x = ds.d
        if self.any_surface:
            # `path` reckons the geometry of light samples from the surface itself.
            to_light = y - si.p
            ω_x = dr.select(on_surface, dr.normalize(to_light), ω_x)
            emitting = active & on_surface
            on_light = met.compute_surface_interaction(onwards, mi.RayFlags.All, emitting)
        f, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(ω_x), active)
        if self.any_surface:
            cos, mis = dr.abs_dot(n, ω_x), mi.Float(1)
            if share or len(self.smooth_lamps):
                ds = mi.DirectionSample3f(scene, on_light, si)
                light_pdf = scene.pdf_emitter_direction(si, ds, emitting)
                mis = (share or power_heuristic)(light_pdf, pdf)
            if len(self.smooth_lamps) and not share:
                cos, mis = self.smooth_lamps.cosine(on_light, ω_x, mis), 1
            r2 = dr.squared_norm(to_light)
            Le = light.emitter.eval(on_light, emitting) * (cos / r2)
            if tracer.lamps is not None:
                division = tracer.lamps.at(tracer.lamps.turning(si, si.bsdf(), active), light.emitter)
                view.slid = 1 - division.vicinity.far(r2)
                # What turns with lobes is found from what is lit.
                Le *= 1 - division.turns(r2, ω_x)
            L = dr.select(on_surface, Le * mis, L)
        return met, dr.select(active, f * L * view.weight, 0), active
