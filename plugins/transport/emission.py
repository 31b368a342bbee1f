"""Rays that start on lights, and the densities with which they arrive."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.boxes import box_around
from rimlight.edge_sampling.rays import spawn_ray

from .found_light import LightEnd
from .subpath_weights import Shorter

#: Rays by which the power of a light without size is estimated, for weights only.
PROBES = 256


@dataclass
class LightSample:
    """A light as a shading point sees it. (A Dr.Jit structure: not frozen.)

    ds : direction to it. weight : radiance, or irradiance, over the density.
    pdf : density of the direction by solid angle, or the probability of a light without size.
    arrival : density with which rays that start on the light arrive at the point, by area across them.
    """

    ds: mi.DirectionSample3f
    weight: mi.Spectrum
    pdf: mi.Float
    arrival: mi.Float


class Around:
    """A sphere around a scene, a little larger than the one around its box."""

    DRJIT_STRUCT = dict.fromkeys(("centre", "radius"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        box = box_around(scene)
        sphere = box.bounding_sphere() if box.valid() else None
        self.centre = mi.Point3f(sphere.center if sphere else 0)
        # Rays start outside of everything that they may meet.
        radius = sphere.radius * (1 + 2 * mi.math.RayEpsilon) if sphere else 0
        self.radius = mi.Float(max(radius, mi.math.RayEpsilon))
        dr.make_opaque(self.centre, self.radius)


class Emission:
    """The lights of a scene, as the first vertices of paths.

    around : the scene; None: it is looked at.

    Emitters at infinity shine through a disc that is as large as the scene's bounding sphere. (Rays are not sampled by
    Mitsuba's `Emitter.sample_ray`, which `envmap` of Mitsuba 3.9 gets wrong if it is turned.)
    """

    def __init__(self, scene: mi.Scene, around: Around | None = None):
        self.scene, around = scene, around or Around(scene)
        emitters = scene.emitters()
        flags = [e.flags() for e in emitters]
        self.any = bool(emitters)
        self.any_infinite = any(f & mi.EmitterFlags.Infinite for f in flags)
        self.any_area = any(self._shines_from_area(f) for f in flags)
        self.any_point = any(f & mi.EmitterFlags.DeltaPosition for f in flags)
        self.any_beam = any(f & mi.EmitterFlags.Surface and f & mi.EmitterFlags.DeltaDirection for f in flags)
        self.any_textured = any(f & mi.EmitterFlags.SpatiallyVarying and self._shines_from_area(f) for f in flags)
        total = sum(e.sampling_weight() for e in emitters)
        self.per_weight = 1 / total if total > 0 else 0.0
        self.centre, self.radius = around.centre, around.radius
        self.power = self._powers() if self.any_point else None

    @staticmethod
    def _shines_from_area(flags: int) -> bool:
        return bool(flags & mi.EmitterFlags.Surface) and not flags & mi.EmitterFlags.DeltaDirection

    def _powers(self) -> mi.Float:
        """Power of each light without size, of the strongest colour; 1 for all other emitters."""
        count = len(self.scene.emitters())
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, count * PROBES)
        emitter = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), dr.arange(mi.UInt32, count * PROBES) // PROBES)
        point = mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition)
        numbers = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
        _, weight = emitter.sample_ray(mi.Float(0), *numbers, point)
        power = dr.block_sum(dr.select(point, dr.max(weight), 0), PROBES) / PROBES
        return dr.select(power > 0, power, 1)

    # ---------------------- Seen from points ----------------------

    def sample(self, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool) -> LightSample:
        """A light as `si` sees it, chosen as by `Scene.sample_emitter_direction`. Visibility is not tested."""
        index, over_p, left = self.scene.sample_emitter(sample.x, active)
        emitter = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index, active)
        ds, value = emitter.sample_direction(si, mi.Point2f(left, sample.y), active)
        p = self.scene.pdf_emitter(index, active)
        return LightSample(ds, value * over_p, ds.pdf * p, self._arrival(ds, index, value, ds.pdf * p, p, active))

    def met(self, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Of a light that a ray from `si` meets: `LightSample.pdf` and `arrival`."""
        pdf = self.scene.pdf_emitter_direction(si, ds, active)
        p = ds.emitter.sampling_weight() * self.per_weight
        return pdf, self._arrival(ds, None, None, pdf, p, active)

    def _arrival(self, ds, index, value, pdf, p, active) -> mi.Float:
        """value : irradiance, of lights without size. p : probability of the emitter."""
        flags = ds.emitter.flags()
        arrival = mi.Float(0)
        if self.any_infinite:
            infinite = mi.has_flag(flags, mi.EmitterFlags.Infinite)
            arrival = dr.select(infinite, pdf / (dr.pi * dr.square(self.radius)), arrival)
        if self.any_area:
            area = active & mi.has_flag(flags, mi.EmitterFlags.Surface)
            arrival = dr.select(area, p * dr.inv_pi * self._density_on_area(ds, flags, area), arrival)
        if self.any_point and index is not None:
            point = active & mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
            power = dr.gather(mi.Float, self.power, index, point)
            arrival = dr.select(point, p * dr.max(value) / power, arrival)
        return arrival

    def _density_on_area(self, ds, flags, active) -> mi.Float:
        """By area, with which `Emitter.sample_position` finds the point of an emitter."""
        textured = mi.has_flag(flags, mi.EmitterFlags.SpatiallyVarying)
        # The same everywhere on a lamp without a texture. (`Shape.pdf_position` fails wherever there are instances.)
        density = ds.emitter.sample_position(mi.Float(0), mi.Point2f(0.5), active & ~textured)[0].pdf
        if self.any_textured:
            # From a unit in front of the point, the density by solid angle is that by area.
            at = dr.zeros(mi.Interaction3f, dr.width(ds.p))
            at.p = ds.p + ds.n
            seen = mi.DirectionSample3f(ds)
            seen.d, seen.dist = -mi.Vector3f(ds.n), mi.Float(1)
            density = dr.select(textured, ds.emitter.pdf_direction(at, seen, active & textured), density)
        return density

    # ---------------------- Where light subpaths start ----------------------

    def start(
        self, sampler: mi.Sampler, time: mi.Float, active: mi.Bool
    ) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f, mi.Spectrum, Shorter, LightEnd]:
        """Rays from the lights, what they meet, their power over its density, the weights of what they meet before it
        is known where that is, and where they start."""
        scene = self.scene
        index, over_p, left = scene.sample_emitter(sampler.next_1d(active), active)
        first, second = sampler.next_2d(active), sampler.next_2d(active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
        flags = emitter.flags()
        p = scene.pdf_emitter(index, active)
        n = dr.width(left)
        ray, β = dr.zeros(mi.Ray3f, n), dr.zeros(mi.Spectrum, n)
        ray.d = mi.Vector3f(0, 0, 1)
        ds, connects = dr.zeros(mi.DirectionSample3f, n), mi.Bool(False)
        end = LightEnd(dr.zeros(mi.Point3f, n), emitter)
        if self.any_infinite:
            mine = active & mi.has_flag(flags, mi.EmitterFlags.Infinite)
            at = dr.zeros(mi.Interaction3f, n)
            at.p, at.time = mi.Point3f(self.centre), time
            found, value = emitter.sample_direction(at, mi.Point2f(left, first.x), mine)
            across = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(first.y, second.x))
            across = mi.Frame3f(found.d).to_world(mi.Vector3f(across.x, across.y, 1))
            made = mi.Ray3f(mi.Point3f(self.centre + self.radius * across), -found.d)
            ray, ds = dr.select(mine, made, ray), dr.select(mine, found, ds)
            β = dr.select(mine, value * (dr.pi * dr.square(self.radius)), β)
            end.place = dr.select(mine, mi.Point3f(found.d), end.place)
            connects |= mine
        if self.any_area:
            surface = mi.has_flag(flags, mi.EmitterFlags.Surface)
            mine = active & surface & ~mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
            found, over_pdf = emitter.sample_position(time, first, mine)
            at = mi.SurfaceInteraction3f(found, dr.zeros(mi.Color0f))
            at.wi = mi.warp.square_to_cosine_hemisphere(second)
            made = spawn_ray(scene, at, at.to_world(at.wi))
            ray = dr.select(mine, mi.Ray3f(made.o, made.d), ray)
            end.place = dr.select(mine, found.p, end.place)
            found = mi.DirectionSample3f(found)
            found.d, found.dist, found.emitter = -made.d, mi.Float(0), emitter
            ds = dr.select(mine, found, ds)
            β = dr.select(mine, emitter.eval(at, mine) * (dr.pi * over_pdf), β)
            connects |= mine
        if self.any_point or self.any_beam:
            point = mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
            mine = active & (point | mi.has_flag(flags, mi.EmitterFlags.Surface))
            mine &= point | mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
            made, value = emitter.sample_ray(time, left, first, second, mine)
            ray, β = dr.select(mine, mi.Ray3f(made.o, made.d), ray), dr.select(mine, value, β)
            end.place = dr.select(mine, made.o, end.place)
            ds.delta |= mine & point
            connects |= mine & point
        ray.time = time
        β *= over_p
        active = active & dr.any(β != 0)
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        first = self._first(ray, pi, ds, emitter, index, p, active & connects)
        return ray, pi, dr.select(active, β, 0), first, end

    def _first(self, ray, pi, ds, emitter, index, p, active) -> Shorter:
        """Of the first vertex: 0 where neither a light sample nor a ray in the opposite direction finds the light."""
        active = active & pi.is_valid()
        flags = emitter.flags()
        infinite, point = (mi.has_flag(flags, f) for f in (mi.EmitterFlags.Infinite, mi.EmitterFlags.DeltaPosition))
        at = dr.zeros(mi.Interaction3f, dr.width(ray.o))
        at.p = ray(pi.t)
        ds.emitter, ds.d = emitter, -ray.d
        ds.dist = dr.select(infinite, ds.dist, pi.t)
        value, pdf = mi.Spectrum(0), ds.pdf
        if self.any_point:
            seen, value = emitter.sample_direction(at, mi.Point2f(0.5), active & point)
            pdf = dr.select(point, seen.pdf, pdf)
        # Of a light that can be met, the density is that from the first vertex.
        pdf = dr.select(ds.delta, pdf, emitter.pdf_direction(at, ds, active & ~ds.delta)) * p
        arrival = self._arrival(ds, index, value, pdf, p, active)
        there = active & (arrival > 0)
        one = dr.select(there, pdf / (arrival * dr.square(pi.t)), 0)
        return Shorter(one, dr.select(there & ~ds.delta, dr.rcp(arrival), 0))
