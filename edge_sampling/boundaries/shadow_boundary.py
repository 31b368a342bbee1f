"""Shadows on the film: what edges do to the image by the shadows that they throw on what the camera sees.

A shadow is found from its light. From a point on the light, an edge that is a silhouette is projected on to what lies
behind it, and from there to the film. Of this one point of the light, the shadow is a boundary of the image as any
other:

    ∮ k(u) · (L⁻ − L⁺) · (n · du/dθ) dl,        L on the lit side: what that point alone contributes, on the other: 0.

The derivative for the whole light is the mean over its points. Where the light *is* a point, or a direction, this is
all there is (Li et al. 2018 leave such lights out); where it has a size, the same boundary can be found from the
shading points (`shading_boundary.py`), and what both find is divided between them.

The point of the light is a *material point*, as it is for the interior derivative: it moves with the light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import power_heuristic
from rimlight.edge_sampling.choice.silhouettes import Silhouettes
from rimlight.edge_sampling.choice.views import View
from rimlight.edge_sampling.geometry.device_edges import beside_edge, rounding
from rimlight.edge_sampling.lights import Lights
from rimlight.edge_sampling.parametrisation import material_point
from rimlight.edge_sampling.projection.sensors import Projection, inside_frame
from rimlight.edge_sampling.smooth_lamps import SmoothLamps

from .tracer import Tracer


def throws_shadows(emitter: mi.Emitter) -> bool:
    """Are the shadows that edges throw in the light of this emitter found from the emitter? Not so those of
    environments. (A `directionalarea` lights nothing in `path`.)"""
    flags = emitter.flags()
    if flags & mi.EmitterFlags.Surface:
        return not flags & mi.EmitterFlags.Delta
    return bool(flags & mi.EmitterFlags.Delta) or hasattr(emitter, "light_count")


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

    DRJIT_STRUCT = dict.fromkeys(
        ("silhouettes", "lights", "smooth_lamps", "chosen", "any_surface", "any_other")
    )  # for `dr.freeze`

    def __init__(self, scene: mi.Scene, silhouettes: Silhouettes):
        self.silhouettes = silhouettes
        self.lights, self.smooth_lamps = Lights(scene), SmoothLamps(scene)
        emitters = scene.emitters()
        #: Numbers of the lights whose shadows are sampled.
        self.chosen = mi.UInt32([k for k, i in enumerate(self.lights.emitter) if throws_shadows(emitters[i])])
        on_surface = {bool(e.flags() & mi.EmitterFlags.Surface) for e in emitters if throws_shadows(e)}
        self.any_surface, self.any_other = True in on_surface, False in on_surface

    def __len__(self) -> int:
        """Number of lights."""
        return dr.width(self.chosen)

    def sample(
        self,
        tracer: Tracer,
        sensor: mi.Sensor,
        sampler: mi.Sampler,
        *,
        share: bool,
    ) -> ShadowSamples:
        """Choose points on lights, edges as seen from there, and points on them; one of each for every lane.

        The lanes are spread evenly over the lights and, for each, over the edges.

        share : are shadows of surfaces sampled from shading points as well?
        """
        scene, silhouettes, count = tracer.scene, self.silhouettes, sampler.wavefront_size()
        with dr.resume_grad():
            projection = Projection(sensor)
            placement = silhouettes.placement()
        with dr.suspend_grad():
            # ---------------------- A point on a light ----------------------

            choice = (dr.arange(mi.Float, count) + sampler.next_1d()) * (len(self) / count)
            which = dr.minimum(mi.UInt32(choice), len(self) - 1)
            choice = dr.clip(choice - which, 0, dr.one_minus_epsilon(mi.Float))
            light = dr.gather(mi.UInt32, self.chosen, which)
            emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.lights.emitter, light))
            time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
            numbers = sampler.next_2d()
            on_surface = mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
            far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) if self.any_other else mi.Bool(False)
            # At infinity, the place of the point is taken by the direction towards it.
            it = dr.zeros(mi.SurfaceInteraction3f, count)
            it.p = mi.Point3f(silhouettes.centre)
            y, density = mi.Point3f(0), mi.Float(1)
            n = mi.Vector3f(0)
            if self.any_other:
                y = self._off_surface(scene, light, it, far, numbers, ~on_surface)
            if self.any_surface:
                ps, _ = emitter.sample_position(time, numbers, on_surface)
                y, n = dr.select(on_surface, ps.p, y), dr.select(on_surface, mi.Vector3f(ps.n), 0)
                density = dr.select(on_surface, ps.pdf, 1)
            active = (density > 0) & dr.isfinite(density)

            # ---------------------- An edge as seen from there ----------------------

            eye = dr.select(far, mi.Vector3f(y), mi.Vector3f(y - silhouettes.centre))
            view = View(eye, n, dr.full(mi.Float, 1, count), [], far=far if self.any_other else None)
            # Shadows of edges that stand still matter only on what moves.
            use = [1, 0.2][: silhouettes.groups]
            e = silhouettes.sample(placement, view, sampler, use, choice=choice, from_light=True, active=active)
            active &= e.density > 0
            outline = silhouettes.point(placement, e, y, far)
            p = outline.p
            d = dr.select(far, -mi.Vector3f(y), p - y)
            ω = dr.normalize(d)
            cos_y = dr.select(on_surface, dr.dot(n, ω), 1)
            across = dr.normalize(dr.cross(ω, outline.tangent))
            lit = across * outline.outward(across)
            active &= (cos_y > 0) & dr.any(lit != 0)

            # ---------------------- Where its shadow falls ----------------------

            aside = lit * beside_edge(p, dr.select(far, p, y))
            shadow = mi.Ray3f(p + aside, ω)
            shadow.time = time
            fallen = scene.ray_intersect_preliminary(shadow, active=active)
            active &= fallen.is_valid()
            # A ray towards the light will start above the surface: from where it starts, it must meet the edge.
            hit = fallen.compute_surface_interaction(shadow, mi.RayFlags.Minimal, active)
            facing = hit.n * -dr.sign(dr.dot(hit.n, ω))
            lift = dr.dot(hit.spawn_ray(-ω).o - hit.p, facing)
            cos_x = -dr.dot(facing, ω)
            along = (lift + dr.dot(aside, facing)) / dr.maximum(cos_x, 0.05)
            x = mi.Point3f(hit.p - aside - ω * along - facing * lift)

            # ---------------------- Does the sensor see it? ----------------------

            aperture_sample = sampler.next_2d() if sensor.needs_aperture_sample() else None
            film_point = projection.film(x, aperture_sample)
            u = dr.detach(film_point.position())
            active &= (
                inside_frame(u, sensor.film()) & (film_point.z > projection.near) & (film_point.z < projection.far)
            )
            ray, ray_weight = sensor.sample_ray_differential(
                time,
                sampler.next_1d() if mi.is_spectral else 0.0,
                (u - projection.crop_offset) / projection.crop_size,
                mi.Point2f(0.5) if aperture_sample is None else aperture_sample,
                active,
            )
            ray = dr.detach(ray)
            seen = tracer.first_hit(ray, active)
            active &= seen.is_valid() & (seen.shape == fallen.shape)
            si = seen.compute_surface_interaction(ray, mi.RayFlags.All, active)
            # It sees this place, and nothing that lies before it: where the surface is curved, x was moved a little off
            # it, but less than the ray will start above it.
            active &= dr.abs_dot(si.n, x - si.p) <= lift + rounding(x, ray.o)

            # ---------------------- What arrives from the light ----------------------

            # From x to the edge, nothing is in the way: that has been seen already.
            onwards = mi.Ray3f(p + aside, dr.select(far, -ω, dr.normalize(y - p - aside)), time, ray.wavelengths)
            distance = dr.norm(y - onwards.o)
            onwards.maxt = dr.select(on_surface | far, dr.largest(mi.Float), distance)
            met = scene.ray_intersect_preliminary(onwards, active=active)
            reached = met.is_valid() & (met.shape.emitter() == emitter)
            reached &= dr.abs_dot(n, onwards(met.t) - y) <= rounding(y, onwards.o)
            active &= dr.select(on_surface, reached, ~met.is_valid())
            ω_x, L = mi.Vector3f(0, 0, 1), mi.Spectrum(0)
            if self.any_other:
                ds, L = self.lights.sample_direction(scene, light, si, numbers, active & ~on_surface)
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
                    mis = power_heuristic(light_pdf, pdf)
                if len(self.smooth_lamps) and not share:
                    cos, mis = self.smooth_lamps.cosine(on_light, ω_x, mis), 1
                Le = emitter.eval(on_light, emitting) * (cos / dr.squared_norm(to_light))
                L = dr.select(on_surface, Le * mis, L)
            jump = dr.select(active, f * L * ray_weight, 0)

            # ---------------------- The boundary on the film ----------------------

            def on_receiver(v):
                """How the shadow moves on the film if p does by v."""
                s = dr.select(far, 1, dr.dot(facing, x + facing * lift - y) / dr.dot(facing, d))
                v = s * (v - d * (dr.dot(facing, v) / dr.dot(facing, d)))
                return dr.detach(projection.tangent(x, mi.Point3f(x + v), mi.Float(0), aperture_sample))

            T, towards_light = on_receiver(outline.tangent), on_receiver(lit)
            n_dl = mi.Vector2f(-T.y, T.x) / (e.density * density * (count / len(self)))
            n_dl = dr.mulsign(n_dl, -dr.dot(n_dl, towards_light))
            active &= dr.isfinite(dr.squared_norm(n_dl)) & dr.any(jump != 0)
            n_dl = dr.select(active, n_dl, 0)
            u = dr.select(active, u, 0)  # what is not finite would spoil pixels, even with the value 0
            if projection.attached:
                # The gradient of each number of the sensor is a kernel of its own: let none of them trace rays again.
                dr.eval(jump, n_dl, active, seen, ray, met, onwards, light, numbers, e, y, far, facing, lift, u)

        with dr.resume_grad():
            p = silhouettes.point(placement, e, y, far).p
            q = mi.Point3f(0)
            if self.any_other:
                q = self._off_surface(scene, light, it, far, numbers, active & ~on_surface)
            if self.any_surface:
                q = dr.select(on_surface, material_point(onwards, met, active & on_surface).p, q)
            m = material_point(ray, seen, active).p
            # From the light past the edge to the plane in which the shadow falls. (Its turning is of second order.)
            d = dr.select(far, -mi.Vector3f(q), p - q)
            origin = dr.select(far, p, q)
            s = (dr.dot(facing, m - origin) + lift) / dr.dot(facing, d)
            x = mi.Point3f(origin + dr.select(active, s, 1) * d - facing * lift)
            moved = projection.film(x, aperture_sample).position()
            value = jump * dr.dot(n_dl, dr.select(active, moved - dr.detach(moved), 0))
            return ShadowSamples(u, value, ray.wavelengths, light)

    def _off_surface(self, scene, light, it, far, numbers, active) -> mi.Point3f:
        """Where lights are that are no surfaces; at infinity, in which direction."""
        ds, _ = self.lights.sample_direction(scene, light, it, numbers, active)
        return dr.select(far, mi.Point3f(ds.d), ds.p)
