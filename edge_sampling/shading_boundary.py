"""Boundaries at shading points: what edges add to the derivative of reflected light as they move past what is seen
from the point.

At a point x, the integrand of L = ∫ f |cos θ| Lᵢ(ω) dω jumps at the great-circle arcs that the edges subtend. The
derivative of L gains

    ∮ f |cos θ| · Σ_sides ± L_side · n · (ω̇_edge − ω̇_side) dl,        n dl = (ω × dω/dt) dt = (ω × e′(t)) / r dt

with ω = (e(t) − x) / r. ω̇_side is the velocity of what the interior derivative holds fixed on that side: the *material
point* that is seen there. A face that ends at the edge moves as the edge does, and contributes nothing: so neither do
creases, nor the outlines of lights by their own motion. What is left is what is seen past a silhouette, on the side
where its faces are not.

Edges are found in two ways. *From points*: at a shading point of a path, by a descent of the edge tree, for emitted
light within the cone of directions to one light; of a few edges one is kept. *From lights*: from a point on a light, by
the same descent; the shading point is then where the shadow of the edge falls, if the sensor sees it. Only the second
finds the shadows that small lights cast. Emitted light that both find is divided as between the sampling of lights and
of the BSDF in path tracing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .edge_importance import EdgeSample, Lobe, View, resample, sample_edge
from .edge_tree import EdgeTree
from .edges import Edges
from .emitter_boxes import EmitterBoxes
from .meshes import Geometry
from .projection import Projection, inside_frame, tangent

#: Directions that are sampled from a BSDF, to find its peak.
DIRECTIONS = 8

#: Part of the samples that are for emitted light, where scattered light counts, too.
EMISSION = 2 / 3

#: Edges from which one is kept, in proportion to what it contributes if nothing hides it.
CANDIDATES = 4

#: Scattered radiance of a point that a ray meets: called with the ray, what it meets, a sampler, a mask.
Scattered = Callable[[Any, Any, Any, Any], Any]


@dataclass
class LightSamples:
    """Samples of the shadows that edges cast. The contribution to the image is `value` at `position`.

    position : mi.Point2f, (N,), film position in pixels. Detached.
    value : mi.Spectrum, (N,), zero, with the gradient of the radiance integrated over the film, in pixels², divided by
        the number of samples; attached.
    wavelengths : mi.Spectrum, (N,), nm.
    """

    position: mi.Point2f
    value: mi.Spectrum
    wavelengths: mi.Spectrum


class ShadingBoundary:
    """Samples the edges of a scene as shading points see them.

    Parameters
    ----------
    scene : mi.Scene
    geometry : its meshes.
    edges : all their edges, on the host.
    moving : for every mesh, does it move?
    everything : do all edges matter at all points, since the camera or a light moves? Otherwise at points that stand
        still only moving edges do.
    """

    _NUMBERS = ("everything", "from_lights_possible", "transmits", "glossy", "emission_from_points")
    DRJIT_STRUCT = dict.fromkeys(
        ("tree", "boxes", "moving_shapes", "surface_lights", "lights", *_NUMBERS)
    )  # for `dr.freeze`

    def __init__(
        self,
        scene: mi.Scene,
        geometry: Geometry,
        edges: Edges,
        moving: tuple[bool, ...],
        *,
        everything: bool,
    ):
        self.geometry = geometry
        self.moving_shapes = [mi.ShapePtr(m) for m, moves in zip(geometry.meshes, moving, strict=True) if moves]
        self.everything = everything
        moves = np.array(moving)[edges.mesh].any(axis=1) if not everything else np.ones(len(edges), bool)
        self.groups = [np.flatnonzero(m) for m in (moves, ~moves) if m.any()]
        self.tree = EdgeTree(geometry, edges, self.groups)
        self.boxes = EmitterBoxes(scene, geometry)
        emitters = scene.emitters()
        surface = [i for i, e in enumerate(emitters) if e.flags() & mi.EmitterFlags.Surface]
        self.surface_lights = mi.UInt32(surface or [0])  # Dr.Jit 1.5 cannot freeze empty arrays
        #: All that are no points or directions, whether Mitsuba samples them or not ("sampling_weight" may be 0).
        self.lights = mi.UInt32([i for i, e in enumerate(emitters) if not e.flags() & mi.EmitterFlags.Delta] or [0])
        self.from_lights_possible = bool(surface)
        flags = [s.bsdf().flags() if s.bsdf() is not None else mi.BSDFFlags.All for s in scene.shapes()]
        self.transmits = any(f & mi.BSDFFlags.Transmission for f in flags)
        self.glossy = any(f & mi.BSDFFlags.Glossy for f in flags)
        others = any(not e.flags() & (mi.EmitterFlags.Delta | mi.EmitterFlags.Surface) for e in emitters)
        #: Is emitted light sampled from points, too? Diffuse surfaces find the lights themselves, from the lights.
        self.emission_from_points = self.glossy or others

    def refit(self) -> None:
        """Follow the vertices. To be called before sampling."""
        positions = dr.detach(self.geometry.positions())
        self.tree.refit(positions)
        self.boxes.refit(positions)

    # ---------------------- From points ----------------------

    def from_points(
        self,
        scene: mi.Scene,
        positions: mi.Float,
        si: mi.SurfaceInteraction3f,
        sampler: mi.Sampler,
        choice: mi.Float,
        active: mi.Bool,
        *,
        share_emission: mi.Bool | bool,
        emission: mi.Bool | bool = True,
        scattering: mi.Bool | bool = True,
        scattered: Scattered | None = None,
    ) -> mi.Spectrum:
        """One sample of the boundary integral at each of `si`: of the light that a light emits, or of light that is
        scattered.

        positions : of the vertices, from `Geometry.positions`; attached. Made before `si`: in backward mode, their
            gradients are then complete before they are passed on, which takes one kernel, and not two.
        si : attached to whatever moves it.
        choice : see `sample_edge`.
        share_emission : where lights of finite size are sampled from the lights, too.
        emission : where emitted light counts at all.
        scattering, scattered : where scattered light counts, and what it is; None: nowhere.

        Returns
        -------
        mi.Spectrum, (N,): zero, with the gradient of the reflected radiance.
        """
        with dr.suspend_grad():
            bsdf = si.bsdf()
            moves = mi.Bool(self.everything)
            for shape in self.moving_shapes:
                moves |= si.shape == shape
            active = active & si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

            # ---------------------- Emitted light, or scattered ----------------------

            emission, scattering = mi.Bool(emission), mi.Bool(scattering) & (scattered is not None)
            active &= emission | scattering
            # Emitted light is sought in the directions of one light, scattered light everywhere.
            p = dr.select(emission, dr.select(scattering, EMISSION, 1), 0)
            emission = sampler.next_1d(active) < p
            light, lights = self._choose(self.lights, sampler, active)
            cone = self.boxes.cone(light, si.p)
            cone.cos = dr.select(emission, cone.cos, -1)
            light = dr.gather(mi.EmitterPtr, scene.emitters_dr(), light, active)

            # ---------------------- An edge ----------------------

            facing = mi.Vector3f(0) if self.transmits else si.n * dr.sign(dr.dot(si.n, si.to_world(si.wi)))
            view = View(
                mi.Vector3f(si.p - self.tree.centre),
                facing,
                dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse), dr.inv_pi, 0.1 * dr.inv_pi),
                [self._lobe(si, bsdf, sampler, active)] if self.glossy else [],
                cone,
            )
            use = [1, dr.select(moves, 1, 0)] if len(self.groups) == 2 else [1]

            def draw(k, sampler):
                part = (choice + k) / CANDIDATES
                return sample_edge(self.tree, view, sampler, use, choice=part, from_light=False, active=active)

            def unshadowed(e):
                a, b = self.tree.device_edges.end_points(positions, e.edge)
                d = dr.lerp(a, b, e.t) - si.p
                f = bsdf.eval(mi.BSDFContext(), si, si.to_local(dr.normalize(d)), active)
                return dr.max(f) * dr.norm(dr.cross(d, b - a)) * dr.rcp(dr.squared_norm(d))

            e = resample(draw, unshadowed, sampler, CANDIDATES, active)
            e.density *= dr.select(emission, p / lights, 1 - p)
        share = (lambda a, b: dr.select(share_emission, _share(b, a), 1)) if self.from_lights_possible else None
        return self._evaluate(
            scene, positions, si, e, sampler, active, light, share, emission=emission, scattered=scattered
        )

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

    # ---------------------- From lights ----------------------

    def from_lights(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        sampler: mi.Sampler,
        first_hit: Callable[[mi.Scene, mi.Ray3f, mi.Bool], mi.PreliminaryIntersection3f],
        attach: Callable[[mi.RayDifferential3f], mi.RayDifferential3f] = lambda ray: ray,
    ) -> LightSamples:
        """Sample points on lights, edges as seen from them, and the points on which their shadows fall.

        first_hit : what a camera ray meets.
        attach : applied to the camera rays.
        """
        count = sampler.wavefront_size()
        with dr.resume_grad():
            projection = Projection(sensor)
            positions = self.geometry.positions()
        with dr.suspend_grad():
            # ---------------------- A point on a light ----------------------

            light, lights = self._choose(self.surface_lights, sampler, True)
            emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), light)
            time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
            y, _ = emitter.sample_position(time, sampler.next_2d())
            active = (y.pdf > 0) & dr.isfinite(y.pdf)

            # ---------------------- An edge as seen from there ----------------------

            view = View(mi.Vector3f(y.p - self.tree.centre), y.n, dr.full(mi.Float, 1, count), [])
            # Shadows of edges that stand still matter only on what moves.
            use = [1, 0.2][: len(self.groups)]
            choice = (dr.arange(mi.Float, count) + sampler.next_1d()) / count
            choice = dr.minimum(choice, dr.one_minus_epsilon(mi.Float))
            e = sample_edge(self.tree, view, sampler, use, choice=choice, from_light=True, active=active)
            active &= e.density > 0
            a, b = self.tree.device_edges.end_points(positions, e.edge)
            p = dr.lerp(a, b, e.t)
            ω = dr.normalize(p - y.p)
            cos_y = dr.dot(y.n, ω)
            across = dr.normalize(dr.cross(ω, b - a))
            outward = self.tree.device_edges.outward(positions, e.edge, p, across)
            active &= (cos_y > 0) & (outward != 0)

            # ---------------------- Where its shadow falls ----------------------

            offset = _offset(p, y.p)
            shadow = mi.Ray3f(mi.Point3f(p + outward * offset * across), ω)
            shadow.time = time
            pi = scene.ray_intersect_preliminary(shadow, active=active)
            active &= pi.is_valid()
            # A ray towards the light will start above the surface: from where it starts, it must meet the edge.
            hit = pi.compute_surface_interaction(shadow, mi.RayFlags.Minimal, active)
            facing = hit.n * -dr.sign(dr.dot(hit.n, ω))
            lift = dr.dot(hit.spawn_ray(-ω).o - hit.p, facing)
            cos_x = -dr.dot(facing, ω)
            aside = outward * offset * across
            along = (lift + dr.dot(aside, facing)) / dr.maximum(cos_x, 0.05)
            start = mi.Point3f(hit.p - aside - ω * along)
            x = mi.Point3f(start - facing * lift)

            # ---------------------- Does the sensor see it? ----------------------

            aperture_sample = sampler.next_2d() if sensor.needs_aperture_sample() else None
            film_point = projection.film(x, aperture_sample)
            u = dr.detach(film_point.position())
            active &= (
                inside_frame(u, sensor.film()) & (film_point.z > projection.near) & (film_point.z < projection.far)
            )
            wavelength_sample = sampler.next_1d() if mi.is_spectral else 0.0
            with dr.resume_grad():
                ray, ray_weight = sensor.sample_ray_differential(
                    time,
                    wavelength_sample,
                    (u - projection.crop_offset) / projection.crop_size,
                    mi.Point2f(0.5) if aperture_sample is None else aperture_sample,
                    active,
                )
            ray = attach(ray)
            seen = first_hit(scene, ray, active)
            active &= seen.is_valid() & (seen.shape == pi.shape)
            with dr.resume_grad():
                si = seen.compute_surface_interaction(ray, mi.RayFlags.All, active)
            active &= dr.norm(si.p - x) <= 1e-3 * seen.t

            # ---------------------- Density ----------------------

            # Of the edge point, and of the film position: dA(y) cos θ_y / r_y² = dA(x) cos θ_x / r_x².
            area = dr.squared_norm(y.p - p) * cos_x / (dr.squared_norm(start - p) * cos_y)
            s, t = mi.coordinate_system(si.n)
            along = [
                tangent(projection, dr.detach(si.p), mi.Point3f(dr.detach(si.p) + v), mi.Float(0), aperture_sample)
                for v in (s, t)
            ]
            pixels = dr.abs(along[0].x * along[1].y - along[0].y * along[1].x)
            e.density *= y.pdf / lights * area / dr.detach(pixels) * count
            active &= dr.isfinite(e.density) & (e.density > 0)

        share = _share if self.emission_from_points else None
        value = self._evaluate(scene, positions, si, e, sampler, active, emitter, share, target=y)
        with dr.resume_grad():
            return LightSamples(u, value * ray_weight, ray.wavelengths)

    # ---------------------- Both ----------------------

    @staticmethod
    def _choose(lights: mi.UInt32, sampler: mi.Sampler, active: mi.Bool | bool) -> tuple[mi.UInt32, int]:
        """One of the lights, and how many there are."""
        count = dr.width(lights)
        which = dr.minimum(mi.UInt32(sampler.next_1d(active) * count), count - 1) if count > 1 else mi.UInt32(0)
        return dr.gather(mi.UInt32, lights, which), count

    def _evaluate(
        self,
        scene: mi.Scene,
        positions: mi.Float,
        si: mi.SurfaceInteraction3f,
        sample: EdgeSample,
        sampler: mi.Sampler,
        active: mi.Bool,
        light: mi.EmitterPtr,
        share: Callable[[mi.Float, mi.Float], mi.Float] | None,
        *,
        emission: mi.Bool | bool = True,
        scattered: Scattered | None = None,
        target: mi.PositionSample3f | None = None,
    ) -> mi.Spectrum:
        """What a point on an edge does to the light that is reflected at `si`.

        light : the only one whose emission counts.
        share : weight of emitted light, of the densities of its direction by light and by BSDF sampling.
        emission : does emitted light count, or scattered light?
        target : only this point of the light counts.
        """
        edges = self.tree.device_edges
        with dr.suspend_grad():
            a, b = edges.end_points(positions, sample.edge)
            p = dr.lerp(a, b, sample.t)
            # Mitsuba's rays start above the surface: look from there.
            lift = si.spawn_ray(p - si.p).o - si.p
            x = mi.Point3f(si.p + lift)
            distance = dr.norm(p - x)
            ω = (p - x) / distance
            n_dl = dr.cross(ω, b - a) / (distance * sample.density)
            seen = ω
            if target is not None:
                # `path` reckons the geometry of light samples from the surface itself.
                d, lifted = target.p - si.p, target.p - x
                seen, n = dr.normalize(d), target.n
                ratio = dr.squared_norm(lifted) / dr.squared_norm(d)
                n_dl *= ratio * dr.sqrt(ratio) * dr.dot(n, d) / dr.dot(n, lifted)
            f, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(seen), active)
            active = active & (sample.density > 0) & dr.any(f != 0) & dr.isfinite(dr.squared_norm(n_dl))
            across = dr.normalize(n_dl)
            side = edges.outward(positions, sample.edge, p, across)
            active &= side != 0
            n_dl = dr.select(active, n_dl, 0)
            beside = mi.Point3f(p + side * _offset(p, x) * across)
            if target is None:
                ray = si.spawn_ray(dr.normalize(beside - x))
            else:
                # From x to the edge, nothing is in the way: that has been seen already.
                ray = mi.Ray3f(beside, dr.normalize(target.p - beside), si.time, si.wavelengths)
            pi = scene.ray_intersect_preliminary(ray, active=active)
            if target is None:
                # Something before the edge hides it. (A surface on which it lies may be met just before it.)
                active &= ~pi.is_valid() | (pi.t >= distance * (1 - 1e-3))
            y = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            emitter = y.emitter(scene, active)
            lit = active & emission & (emitter == light)
            if target is not None:
                lit &= dr.norm(y.p - target.p) <= 1e-3 * pi.t
            L = emitter.eval(y, lit)
            if share is not None:
                on_surface = lit & mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
                light_pdf = scene.pdf_emitter_direction(si, mi.DirectionSample3f(scene, y, si), on_surface)
                L *= dr.select(on_surface, share(light_pdf, pdf), 1)
            valid = active & y.is_valid()
            if scattered is not None:
                reflected = valid & ~emission
                L += dr.select(reflected, scattered(ray, pi, sampler, reflected), 0)
            L = dr.select(active, f * L, 0)
            n_dl = dr.select(active, n_dl, 0)

        with dr.resume_grad():
            a, b = edges.end_points(positions, sample.edge)
            y = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal | mi.RayFlags.FollowShape, valid).p
            x = si.p + lift
            velocity = _turning(n_dl, dr.lerp(a, b, sample.t) - x, active) - _turning(n_dl, y - x, valid)
            return -side * L * velocity


def _share(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a strategy with density a against one with density b: the power heuristic."""
    a2, b2 = dr.square(a), dr.square(b)
    return dr.select(a2 > 0, a2 / (a2 + b2), 0)


def _turning(n_dl: mi.Vector3f, d: mi.Vector3f, valid: mi.Bool) -> mi.Float:
    """Zero, with the gradient of the direction of d, along `n_dl`."""
    ω = dr.normalize(dr.select(valid, d, mi.Vector3f(0, 0, 1)))
    return dr.select(valid, dr.dot(n_dl, ω - dr.detach(ω)), 0)


def _offset(p: mi.Point3f, q: mi.Point3f) -> mi.Float:
    """How far beside an edge at p to look, from q or from p: just beyond what single precision can tell apart."""
    scale = dr.max(dr.maximum(dr.abs(mi.Vector3f(p)), dr.abs(mi.Vector3f(q))))
    return 32 * dr.epsilon(mi.Float) * scale + 1e-5 * dr.norm(p - q)
