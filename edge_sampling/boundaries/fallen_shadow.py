"""The stations of a sample of a shadow: a point of a light, one of an edge, where its shadow falls, and how the sensor
sees that."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import EdgeSample
from rimlight.edge_sampling.choice.silhouettes import OutlinePoint
from rimlight.edge_sampling.geometry.beside import beside_edge, rounding
from rimlight.edge_sampling.geometry.surfaces import GOES_ON
from rimlight.edge_sampling.projection.sensors import Projection, inside_frame
from rimlight.edge_sampling.rays import rough_size, spawn_ray

from .tracer import Tracer

#: How far beside a shadow to look for what is in it, in units of what rounding may be: about as far as rays look beside
#: edges on the film, so that what lies between an edge and the shadow that it throws close by counts for both.
BESIDE = 1 / 4

#: A shadow that falls as close to its edge as this, in the same units, falls on the surface on which the edge lies.
FLUSH = 32


@dataclass
class LightPoint:
    """A point of a light; at infinity, y is the direction towards it.

    n : normal, 0 where the light is no surface. density : of y, by area. choice : what is left of a random number.
    """

    light: mi.UInt32
    emitter: mi.EmitterPtr
    choice: mi.Float
    time: mi.Float
    numbers: mi.Point2f
    on_surface: mi.Bool
    far: mi.Bool
    y: mi.Point3f
    n: mi.Vector3f
    density: mi.Float


@dataclass
class LitEdge:
    """A point p of an edge as the light sees it, with the tangent there.

    lit : unit vector across edge and light, towards the lit side. d, ω : from the light to p, ω of unit length.
    outline : all that is known of the point; None where it is on no edge. slack, sign : see `OutlinePoint`.
    """

    sample: EdgeSample
    p: mi.Point3f
    tangent: mi.Vector3f
    lit: mi.Vector3f
    d: mi.Vector3f
    ω: mi.Vector3f
    active: mi.Bool
    outline: OutlinePoint | None = None
    slack: mi.Float | float = 0.0
    sign: mi.Float | float = 1.0


@dataclass
class Shadow:
    """Where the shadow of that point falls.

    x : mi.Point3f, a little off the surface. facing : its normal, on the side of the light. lift : how high above it
    rays start. shape : of the surface. onwards : a ray past the edge to the light. ray, fallen : the one from there,
    and what it meets.
    """

    x: mi.Point3f
    facing: mi.Vector3f
    lift: mi.Float
    shape: mi.ShapePtr
    onwards: mi.Ray3f
    ray: mi.Ray3f
    fallen: mi.PreliminaryIntersection3f
    active: mi.Bool


@dataclass
class SeenShadow:
    """The shadow as the sensor sees it: at the position u of the film, in pixels.

    slid : part of the light that is held in its direction; None: nothing.
    """

    u: mi.Point2f
    ray: mi.RayDifferential3f
    weight: mi.Spectrum
    seen: mi.PreliminaryIntersection3f
    si: mi.SurfaceInteraction3f
    aperture_sample: mi.Point2f | None
    active: mi.Bool
    slid: mi.Float | None = None


def fall(scene: mi.Scene, light: LightPoint, edge: LitEdge) -> Shadow:
    p, ω, far = edge.p, edge.ω, light.far
    aside = edge.lit * (beside_edge(p, dr.select(far, p, light.y)) + edge.slack)
    ray = mi.Ray3f(p + aside, ω)
    ray.time = light.time
    fallen = scene.ray_intersect_preliminary(ray, active=edge.active)
    active = edge.active & fallen.is_valid()
    # A ray towards the light will start above the surface: from where it starts, it must meet the edge.
    hit = fallen.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
    if edge.outline is not None:
        slack = rounding(p, dr.select(far, p, light.y))
        on_edge = dr.abs_dot(hit.n, hit.p - p) <= slack
        # What lies in that surface at the point itself throws no shadow on it there: sides of boxes that stand flush,
        # and the foot of a wall.
        at_foot = dr.norm(hit.p - p) <= FLUSH * slack
        active &= ~(on_edge & (at_foot | edge.outline.is_behind(hit.n, ω)))
    facing = hit.n * -dr.sign(dr.dot(hit.n, ω))
    lift = dr.dot(spawn_ray(scene, hit, -ω).o - hit.p, facing)
    cos_x = -dr.dot(facing, ω)
    along = (lift + dr.dot(aside, facing)) / dr.maximum(cos_x, 0.05)
    x = mi.Point3f(hit.p - aside - ω * along - facing * lift)
    towards_light = dr.select(far, -ω, dr.normalize(light.y - p - aside))
    onwards = mi.Ray3f(p + aside, towards_light, light.time, ray.wavelengths)
    if edge.outline is not None:
        active &= ~_in_front(scene, light, edge, aside, active)
    return Shadow(x, facing, lift, fallen.shape, onwards, ray, fallen, active)


def _in_front(scene: mi.Scene, light: LightPoint, edge: LitEdge, aside: mi.Vector3f, active: mi.Bool) -> mi.Bool:
    """Of an edge with a face along which light shines: is something else in front of that face, which throws the same
    shadow? Several edges in one plane with the light do, of which the first counts."""
    first, second = edge.outline.are_lit_along(edge.d)
    grazes = first | second
    d = dr.select(light.far, -edge.ω, light.y - edge.p)
    along = dr.normalize(d)
    # As far as a ray may go below what is curved and touches the plane: beside it, that is as wide as the root of this.
    gap = dr.sqrt(dr.norm(aside) * rough_size(scene))
    ray = mi.Ray3f(edge.p - aside + gap * along, along)
    ray.time = light.time
    ray.maxt = dr.select(light.far, dr.largest(mi.Float), dr.norm(d) * (1 - mi.math.ShadowEpsilon) - gap)
    return grazes & scene.ray_test(ray, active=active & grazes)


def look(
    tracer: Tracer, projection: Projection, sensor: mi.Sensor, sampler: mi.Sampler, time: mi.Float, shadow: Shadow
) -> SeenShadow:
    """Does the sensor see it?"""
    x = shadow.x
    aperture_sample = sampler.next_2d() if sensor.needs_aperture_sample() else None
    film_point = projection.film(x, aperture_sample)
    u = dr.detach(film_point.position())
    in_depth = (film_point.z > projection.near) & (film_point.z < projection.far)
    active = shadow.active & inside_frame(u, sensor.film()) & in_depth
    ray, weight = sensor.sample_ray_differential(
        time,
        sampler.next_1d() if mi.is_spectral else 0.0,
        (u - projection.crop_offset) / projection.crop_size,
        mi.Point2f(0.5) if aperture_sample is None else aperture_sample,
        active,
    )
    ray = dr.detach(ray)
    seen = tracer.first_hit(ray, active)
    active &= seen.is_valid() & (seen.shape == shadow.shape)
    si = seen.compute_surface_interaction(ray, mi.RayFlags.All, active)
    # It sees this place, and nothing that lies before it: where the surface is curved, x was moved a little off it, but
    # less than the ray will start above it.
    active &= dr.abs_dot(si.n, x - si.p) <= shadow.lift + rounding(x, ray.o)
    return SeenShadow(u, ray, weight, seen, si, aperture_sample, active)


def thrown(v: mi.Vector3f, light: LightPoint, edge: LitEdge, shadow: Shadow) -> mi.Vector3f:
    """How the shadow moves over what it falls on if the point of the edge moves by v."""
    facing, d = shadow.facing, edge.d
    s = dr.select(light.far, 1, dr.dot(facing, shadow.x + facing * shadow.lift - light.y) / dr.dot(facing, d))
    return s * (v - d * (dr.dot(facing, v) / dr.dot(facing, d)))


def across_border(
    projection: Projection, light: LightPoint, edge: LitEdge, shadow: Shadow, view: SeenShadow
) -> mi.Vector2f:
    """The direction on the film across the border of a shadow, away from what is lit, as long as `edge.tangent` is on
    the film once it is thrown like the shadow: pixels. Detached."""
    on_film = lambda v: dr.detach(
        projection.tangent(shadow.x, mi.Point3f(shadow.x + v), mi.Float(0), view.aperture_sample)
    )
    tangent, towards_light = (on_film(thrown(v, light, edge, shadow)) for v in (edge.tangent, edge.lit))
    n = mi.Vector2f(-tangent.y, tangent.x)
    return dr.mulsign(n, -dr.dot(n, towards_light))


def on_both_sides(
    tracer: Tracer, projection: Projection, sensor: mi.Sensor, view: SeenShadow, shadow: Shadow, n, active
) -> mi.Bool:
    """Does the sensor see the surface on which the shadow falls in the shadow, too? Where light shines along a face,
    its shadow falls on the line in which that meets another surface, and the edge there has the jump already.

    n : on the film, towards the shadow.
    """
    per_unit = projection.pixels_per_unit(projection.film(shadow.x))
    slack = rounding(shadow.x, view.ray.o)
    aside = BESIDE * slack * per_unit + 2 * dr.epsilon(mi.Float) * max(projection.crop_size + projection.crop_offset)
    u = view.u + dr.detach(aside) * dr.normalize(n)
    lens = mi.Point2f(0.5) if view.aperture_sample is None else view.aperture_sample
    on_film = (u - projection.crop_offset) / projection.crop_size
    ray, _ = sensor.sample_ray_differential(view.ray.time, 0.5, on_film, lens, active)
    pi = tracer.first_hit(ray, active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
    goes_on = (pi.shape == shadow.shape) & (dr.abs_dot(si.n, shadow.facing) > GOES_ON)
    return goes_on & (dr.abs_dot(shadow.facing, si.p - shadow.x) <= shadow.lift + (1 + BESIDE) * slack)
