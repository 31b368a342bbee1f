"""Camera paths whose vertices are all lit by every light of a scene, one after the other.

A path is traced once. At each of its vertices a loop runs over the lights, in which the surface, the throughput and
the footprint on the film stay as they are. What becomes of the light differs: it is added to the layers (`Splat`),
compared with gradients that the layers hold (`Measure`), or differentiated in either mode (`Forward`, `Backward`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling import Horizon, Lights
from rimlight.edge_sampling.boundaries.horizon import turn_to_side
from rimlight.edge_sampling.first_points import seen_by_camera
from rimlight.edge_sampling.geometry.instances import surface_met
from rimlight.edge_sampling.parametrisation import FOLLOWS, look_from
from rimlight.transport.paths import Vertex, step
from rimlight.transport.scattering import Numbers, Scattering
from rimlight.transport.tracer import PathTracer

from ._sinks import wide

#: Light samples of one vertex differ by these, modulo 1 (Roberts 2018, "The unreasonable effectiveness of quasirandom
#: sequences", R2). By itself, each is uniform.
TURN = (0.7548776662466927, 0.5698402909980532)


class LightByLight(Scattering):
    """What surfaces scatter of one light.

    lights : their number is K.
    per_path : how many of them are evaluated at each vertex, 0 for all.
    """

    def __init__(self, scene: mi.Scene, lights: Lights, per_path: int, *, attached: bool):
        super().__init__(scene, attached=attached)
        self.lights, self.count = lights, per_path or len(lights)
        self.several = list(lights.several.values())

    def direct(self, si, bsdf, light: mi.UInt32, sample: mi.Point2f | None, active) -> mi.Spectrum:
        """Radiance of a light that `si` reflects without detours: mi.Spectrum, (N,). If not all lights are evaluated,
        it stands for the others, too."""
        point = mi.Point2f(0.5)  # lights without an extent do not look at it
        if sample is not None:
            turned = sample + mi.Point2f(TURN) * mi.Float(light)
            point = dr.minimum(turned - dr.floor(turned), dr.one_minus_epsilon(mi.Float))
        towards_light = lambda active: self.lights.sample_direction(self.scene, light, si, point, active)
        L = self.reflect(si, bsdf, towards_light, active, self.directions_of(si, bsdf, active))
        with dr.resume_grad(when=self.attached):
            return L if self.count == len(self.lights) else L * (len(self.lights) / self.count)

    def pdf_direction(self, si, ds, active, chosen) -> mi.Float:
        return ds.emitter.pdf_direction(si, ds, active)

    def number(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """Number of the light that rays hit."""
        light, first = mi.UInt32(0), 0
        for e in self.scene.emitters():
            if not e.flags() & mi.EmitterFlags.Delta:
                light = dr.select(emitter == mi.EmitterPtr(e), first, light)
            first += getattr(e, "light_count", 1)
        return light

    def each(self, step: Callable, state: tuple, choice: mi.Float | None, active: mi.Bool) -> tuple:
        """Loop over the lights: `state = step(light, *state)`. All of them, or those that `choice` makes of as many
        equal parts of their list, one of each."""
        count, total = self.count, len(self.lights)

        def body(j, *state):
            light = j if choice is None else dr.minimum(mi.UInt32((mi.Float(j) + choice) * (total / count)), total - 1)
            return (j + 1, *step(light, *state))

        return dr.while_loop((mi.UInt32(0), *state), lambda j, *_: active & (j < count), body, label="lights")[1:]


@dataclass(frozen=True)
class Place:
    """A vertex of each path, as the loop over the lights needs it.

    number : along the path; 1 is what the camera sees.
    ray, pi : the ray to it and what that meets; the first ray is attached to the camera.
    before : ray and intersection of the vertex before, None for the first.
    throughput : mi.Spectrum, detached.
    scale : mi.Spectrum, what the radiance of the path is multiplied by.
    u : mi.Point2f, position on the film, pixels.
    sample : mi.Point2f, random numbers for lights with an extent, or None.
    choice : mi.Float, which lights are evaluated; None for all.
    horizon : on which side of the horizon of interpolated normals the first vertex is; None: as it is.
    """

    number: int
    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    before: tuple[mi.Ray3f, mi.PreliminaryIntersection3f] | None
    throughput: mi.Spectrum
    scale: mi.Spectrum
    u: mi.Point2f
    sample: mi.Point2f | None
    choice: mi.Float | None
    horizon: Horizon | None

    @property
    def β(self) -> mi.Spectrum:
        """What light at this vertex is multiplied by."""
        return self.throughput * self.scale

    def surface(self, scattering: Scattering, active) -> mi.SurfaceInteraction3f:
        """The surface there; attached, if `scattering` is, to a ray that is fixed on the film, and from the second
        vertex on to the material point."""

        def surface(number, ray, pi):
            if number == 1:
                return seen_by_camera(scattering.scene, ray, pi, active, attached=scattering.attached)
            with dr.resume_grad(when=scattering.attached):
                return surface_met(scattering.scene, ray, pi, FOLLOWS, active)

        si = surface(self.number, self.ray, self.pi)
        with dr.resume_grad(when=scattering.attached):
            if scattering.attached and self.before is not None and scattering.directional:
                look_from(si, surface(self.number - 1, *self.before).p, self.ray, self.pi.t)
        if self.horizon is not None and self.number == 1:
            turn_to_side(si, self.ray, self.horizon)
        return si

    def in_front(self, active: mi.Bool) -> tuple[Place, mi.Bool, mi.UInt32]:
        """The active paths moved together, in their order: packets without one skip the loop over the lights. Measured
        with 96 lights, 10 % faster where most paths are active, and in proportion to their number where few are.

        Returns
        -------
        place : zero where there is none.
        active : mi.Bool, (N,)
        index : mi.UInt32, (N,), where each comes from.
        """
        n = dr.width(active)
        order = dr.cumsum(dr.select(active, mi.UInt32(1), 0))
        index, lane = dr.zeros(mi.UInt32, n), dr.arange(mi.UInt32, n)
        dr.scatter(index, lane, order - 1, active)
        there = lane < dr.gather(mi.UInt32, order, n - 1)
        at = lambda value: None if value is None else dr.gather(type(value), value, index, there)
        with dr.resume_grad():
            before = None if self.before is None else tuple(at(v) for v in self.before)
            moved = {
                k: at(getattr(self, k))
                for k in ("ray", "pi", "throughput", "scale", "u", "sample", "choice", "horizon")
            }
        return replace(self, before=before, **moved), there, index


class LightPaths:
    """Camera paths, and the loops over the lights at their vertices.

    tracer : tells what camera rays meet, and how long paths are.
    per_path : see `LightByLight`.
    min_depth : paths of fewer segments are left out.
    """

    def __init__(self, tracer: PathTracer, lights: Lights, per_path: int, min_depth: int = 0):
        self.tracer, self.lights, self.per_path, self.min_depth = tracer, lights, per_path, min_depth
        self.scene, self.depths = tracer.scene, tracer.depths

    def counts(self, depth: int) -> bool:
        """Do paths of so many segments?"""
        return depth >= self.min_depth

    def trace(
        self,
        to: Any,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        u: mi.Point2f,
        scale: mi.Spectrum,
        choice: mi.Float | None = None,
        active: mi.Bool | bool = True,
        horizon: Horizon | None = None,
        pi: mi.PreliminaryIntersection3f | None = None,
    ) -> None:
        """Trace paths, and hand the light at their vertices over. Call it with gradients suspended.

        to : `Splat`, `Measure`, `Forward` or `Backward`.
        ray : camera rays, attached if the camera is.
        u : their positions on the film, pixels.
        scale : mi.Spectrum, (N,), what their radiance is multiplied by. Detached.
        choice : mi.Float, (N,), uniform; which lights are evaluated. None if all of them are.
        horizon : on which side of the horizon of interpolated normals the first vertices are; None: as they are.
        pi : what the rays meet, if that is known.
        """
        scattering = LightByLight(self.scene, self.lights, self.per_path, attached=to.attached)
        area = scattering.any_hit_by_rays
        active = mi.Bool(active) & (self.depths.max_depth > 0)
        with dr.resume_grad(when=to.attached):
            ray = wide(mi.Ray3f(ray), dr.full(mi.Bool, True, dr.width(u)))
        ray = to.start(ray)
        pi = self.tracer.first_hit(ray, active) if pi is None else pi
        one, zero = (dr.full(mi.Spectrum, value, dr.width(u)) for value in (1, 0))
        place = Place(1, ray, pi, None, one, scale + zero, u, None, choice, horizon)
        if area and not self.tracer.hide_emitters and self.counts(1):
            self._seen(to, scattering, place, active)
        active &= pi.is_valid()
        η = mi.Float(1)
        while self.depths.scatters(place.number):
            sample = sampler.next_2d(active) if area else None
            place = replace(place, throughput=wide(place.throughput, active), sample=sample)
            sampler.schedule_state()
            dr.eval(place, active)
            if self.counts(place.number + 1):
                to.direct(scattering, place, active)
            if not (area or self.depths.scatters(place.number + 1)):
                break
            place, η, active = self._onwards(to, scattering, place, η, sampler, active)
        dr.eval()

    # In functions of their own: forward mode must not meet what is left of earlier attached values.

    def _seen(self, to, scattering, place, active) -> None:
        """What the first vertex emits."""
        si = place.surface(scattering, active)
        emitter = si.emitter(self.scene)
        with dr.resume_grad(when=to.attached):
            value = emitter.eval(si, active)
        to.emission(scattering.number(emitter), value, place, active)

    def _onwards(self, to, scattering, place, η, sampler, active) -> tuple[Place, mi.Float, mi.Bool]:
        """The next vertex, and what it emits."""
        si = place.surface(scattering, active)
        numbers = Numbers(mi.Point2f(0), sampler.next_1d(active), sampler.next_2d(active))
        bsdf = si.bsdf(place.ray)
        directions = scattering.directions_of(si, bsdf, active)
        emitted, onwards = scattering.sample_bsdf(si, bsdf, numbers, active, directions=directions)
        light = None
        if scattering.any_hit_by_rays and self.counts(place.number + 1):
            y = onwards.pi.compute_surface_interaction(onwards.ray, mi.RayFlags.Minimal, active)
            light = scattering.number(y.emitter(self.scene))
        vertex = Vertex(place.ray, place.pi, place.number, place.throughput, η, mi.Bool(False), mi.Bool(False))
        after, goes_on, _ = step(vertex, onwards, sampler, self.depths, active)
        # What Russian roulette divides by belongs to the throughput.
        with dr.resume_grad(when=to.attached):
            now = place.throughput * dr.detach(onwards.weight)
            weight = onwards.weight * dr.select(goes_on & (now != 0), after.β / now, 0)
        to.bounce(light, emitted, weight, place, active)
        before = (place.ray, place.pi) if to.attached else None
        onto = {"ray": after.ray, "pi": after.pi, "before": before, "throughput": after.β}
        place = replace(place, number=after.depth, **onto)
        return place, after.η, goes_on
