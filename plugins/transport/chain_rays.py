"""The rays with which chains of mirrors begin, as functions of a position in the plane: on the film, or of the
directions at a point."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.rays import spawn_ray

from .paths import Vertex
from .ray_derivatives import RayDerivative
from .tracer import PathTracer, camera_vertex

#: Part of a pixel by which positions differ of which derivatives are made.
STEP = 0.25

#: Length of the sides of the square of directions at a point, in units as long as segments.
SIDE = 16


class FilmRays:
    """Camera rays at positions of a film, all with the same random numbers.

    sensor : no `batch`. sampler : for these numbers, if there are any.
    """

    #: How many vertices of the path come before the chain's own first one.
    before = 0

    #: Does a jump count that no mirror shows, too?
    sees_all = True

    def __init__(self, sensor: mi.Sensor, sampler: mi.Sampler):
        film = sensor.film()
        self.sensor = sensor
        self.offset, self.size = mi.ScalarVector2f(film.crop_offset()), mi.ScalarVector2f(film.crop_size())
        self.time = mi.Float(sensor.shutter_open())
        if sensor.shutter_open_time() > 0:
            self.time += sampler.next_1d() * sensor.shutter_open_time()
        self.wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        self.lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)

    def at(self, u: mi.Point2f, active: mi.Bool | bool = True) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Rays and their weights. u : mi.Point2f, pixels."""
        on_film = (u - self.offset) / self.size
        return self.sensor.sample_ray_differential(self.time, self.wavelength, on_film, self.lens, active)

    def first(self, tracer: PathTracer, u: mi.Point2f, active: mi.Bool) -> Vertex:
        """What the camera sees at u."""
        ray = mi.Ray3f(self.at(u, active)[0])
        return camera_vertex(ray, tracer.first_hit(ray, active))

    def derivative(self, u: mi.Point2f, axis: mi.Vector2f) -> RayDerivative:
        """Along a unit vector of the film."""
        (a, _), (b, _) = (self.at(u + sign * STEP * axis) for sign in (-1, 1))
        return RayDerivative(mi.Vector3f(b.o - a.o) / (2 * STEP), mi.Vector3f(b.d - a.d) / (2 * STEP))


class PointRays:
    """Rays from points of surfaces, in all directions on one side of these.

    Positions are those of a square, as if it were a film: the stereographic projection of the hemisphere fills its
    inscribed circle, and goes on smoothly beyond that.

    si : mi.SurfaceInteraction3f, detached. before : mi.UInt32, vertices of the path before the points.
    like : mi.Ray3f, of the time and the wavelengths. below : mi.Bool, on the other side than that from which they are
    seen?
    """

    #: A jump that no mirror shows is found otherwise, as an edge.
    sees_all = False

    def __init__(self, scene: mi.Scene, si: mi.SurfaceInteraction3f, before: mi.UInt32, like: mi.Ray3f, below: mi.Bool):
        self.scene, self.si, self.before, self.like = scene, si, before, like
        #: Of the square, in lengths of a segment.
        self.offset, self.size = mi.ScalarVector2f(0), mi.ScalarVector2f(SIDE)
        facing = dr.mulsign(mi.Vector3f(si.n), dr.dot(si.n, si.to_world(si.wi)))
        self.frame = mi.Frame3f(mi.Normal3f(dr.select(below, -facing, facing)))

    def direction(self, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """World space; and the solid angle of a unit of area there."""
        v = 2 / SIDE * u - 1
        rest = dr.rcp(1 + dr.squared_norm(v))
        local = mi.Vector3f(2 * v.x * rest, 2 * v.y * rest, 2 * rest - 1)
        return self.frame.to_world(local), dr.square(4 / SIDE * rest)

    def at(self, u: mi.Point2f) -> mi.Ray3f:
        ray = spawn_ray(self.scene, self.si, self.direction(u)[0])
        return mi.Ray3f(ray.o, ray.d, self.like.time, self.like.wavelengths)

    def weight(self, u: mi.Point2f, active: mi.Bool) -> mi.Spectrum:
        """How much of the light from there is scattered to where the points are seen from, per unit of area."""
        d, angle = self.direction(u)
        value = self.si.bsdf().eval(mi.BSDFContext(), self.si, self.si.to_local(d), active)
        return dr.select(active, value * angle, 0)

    def first(self, tracer: PathTracer, u: mi.Point2f, active: mi.Bool) -> Vertex:
        """What the points see there. Its number is 2: they are the first vertices themselves."""
        ray = self.at(u)
        vertex = camera_vertex(ray, self.scene.ray_intersect_preliminary(ray, active=active))
        vertex.depth += 1
        return vertex

    def derivative(self, u: mi.Point2f, axis: mi.Vector2f) -> RayDerivative:
        """Along a unit vector of the square."""
        (a, _), (b, _) = (self.direction(u + sign * STEP * axis) for sign in (-1, 1))
        return RayDerivative(mi.Vector3f(0), (b - a) / (2 * STEP))
