"""What the camera sees first: fixed on the film, or held on its surface.

As a rule, the film position of a camera ray is held, and what it meets slides over its surface. Of a fine texture, or
fine bumps, it then meets something else at once: the derivative is large, of either sign, and means little to a pixel
that is wider than they are. And of a curved shape that is polished, it meets another normal: what a mirror or glass
shows moves many times as fast as the shape. So points x of such surfaces are held, and their film position u(x) moves.
With the film area J = |du/dA| of an element of the surface, the value of a pixel with the filter k is

    I = ∫ k(u(x)) L(x) J dA,      dI = ∫ k(u) (dL + L dJ/J) du  +  ∫ L ∇k · u̇ du.

In the first integral, the interior term, x is held: of a matt surface at rest, L does not change at all, whatever the
camera does. The second is what passes over the film with the velocity u̇ of x (`plugins/terms/passing.py`); for the
box filter, it is an integral over the borders of pixels. Beside an edge on the film, a side counts by the velocity of
the edge less that of what is seen there. Shapes begin and end at edges, so that each may be held or not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .geometry.instances import surface_met
from .geometry.meshes import inner, surfaces
from .parametrisation import FOLLOWS, Parametrisation, grazes, look_from, material_point
from .projection.sensors import SENSORS, Projection


def seen_by_camera(
    scene: mi.Scene,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    active: mi.Bool,
    *,
    attached: bool,
    held: FirstPoints | None = None,
) -> mi.SurfaceInteraction3f:
    """The surface that a camera ray meets. A surface that moves is met by a fixed ray; a ray that moves with the camera
    takes its hit along. With all its derivatives but where the surface is curved, and seen edge-on.

    held : what is held at its material point instead; None: nothing.
    """
    with dr.resume_grad(when=attached):
        si = surface_met(scene, ray, pi, mi.RayFlags.All, active)
        if attached and held is not None:
            there = held.are(ray, pi, active)
            si = dr.select(there, held.seen(scene, ray, pi, there), si)
        if attached:
            si = dr.select(grazes(si, ray.d, active), dr.detach(si), si)
        return si


class HeldShapes:
    """The shapes whose points are held."""

    DRJIT_STRUCT = dict.fromkeys(("_held", "_shown"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene, shapes: list[Any]):
        index = lambda s: int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(inner(s)))[0])
        #: By the number of a shape among all of Mitsuba's; the first is that of no shape.
        flags = [False] * (1 + max((index(s) for s in surfaces(scene)), default=0))
        for shape in shapes:
            flags[index(shape)] = True
        self.shapes, self._held = shapes, mi.Bool(flags)
        #: Do instances show some of them? Which shape is met on an instance, Mitsuba tells on GPUs only.
        self._shown = any(s not in scene.shapes() for s in shapes)

    def are(self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.Bool:
        """Is what a ray meets on one of them?"""
        met = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active) if self._shown else pi
        return active & pi.is_valid() & dr.gather(mi.Bool, self._held, dr.reinterpret_array(mi.UInt32, met.shape))


def can_hold(sensor: mi.Sensor) -> bool:
    """Can points be held as this sensor sees them? Not those of a `fisheye`, at the rim of its image circle."""
    return sensor.class_name() in (SENSORS[kind] for kind in ("perspective", "thinlens", "orthographic"))


def has_points(shape: Any) -> bool:
    """Can points of a shape be held? How those of grids, whose values may change, and of curves move is known in part
    only."""
    return shape.is_mesh() or shape.class_name() in ("Sphere", "Disk", "Cylinder", "Rectangle")


@dataclass(frozen=True)
class FirstPoints:
    """What a sensor sees of the shapes that are held. sensor : see `can_hold`."""

    shapes: HeldShapes
    sensor: mi.Sensor

    def are(self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.Bool:
        """Is what camera rays meet held?"""
        with dr.suspend_grad():
            return self.shapes.are(dr.detach(ray), pi, active)

    def seen(
        self, scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
    ) -> mi.SurfaceInteraction3f:
        """The material point that a camera ray meets, attached to its surface; the direction in which it is looked at,
        to the camera as well. ray : attached to the camera."""
        here = dr.detach(ray)
        si = surface_met(scene, here, pi, FOLLOWS, active)
        if not dr.grad_enabled(ray.o, ray.d, si.p, si.sh_frame.n):
            return si
        back = self._from_lens(ray)
        if back is None:
            si.wi = dr.select(active, dr.replace_grad(si.wi, si.to_local(-ray.d)), si.wi)
        else:
            look_from(si, mi.Point3f(ray.o - back * ray.d), here, pi.t + back)
        return si

    def stretch(self, scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.Float:
        """Film area of an element of the surface, relative to its present value: 1, attached to surface and camera."""
        projection, ray = Projection(self.sensor), dr.detach(ray)
        si, lens = surface_met(scene, ray, pi, FOLLOWS, active), self.lens(projection, ray)
        p, size = _before(projection, si.p, active), dr.select(active, pi.t, 1)
        frame = mi.Frame3f(mi.Vector3f(si.n))
        a, b = (projection.tangent(p, mi.Point3f(p + size * v), mi.Float(0), lens) for v in (frame.s, frame.t))
        area = (a.x * b.y - a.y * b.x) * Parametrisation(scene).area(pi, ray, si, active)
        now = dr.detach(area)
        usable = active & (now != 0) & dr.isfinite(now) & ~grazes(si, ray.d, active)
        return dr.replace_grad(mi.Float(1), dr.select(usable, area / dr.select(usable, now, 1), 1))

    def velocity(
        self,
        ray: mi.Ray3f,
        pi: mi.PreliminaryIntersection3f,
        active: mi.Bool,
        projection: Projection,
        aperture_sample: mi.Point2f | None,
    ) -> mi.Vector2f:
        """Of what is held, on the film: mi.Vector2f, (N,), pixels; zero, with the gradient of the position; and 0 where
        nothing is held."""
        active = self.are(ray, pi, active)
        p = material_point(dr.detach(ray), pi, active).p
        u = projection.film(_before(projection, p, active), aperture_sample).position()
        return dr.select(active, u - dr.detach(u), 0)

    def lens(self, projection: Projection, ray: mi.Ray3f) -> mi.Point2f | None:
        """What stands for the point of the lens that a camera ray comes from, as `Projection.film` has it."""
        if projection.aperture_radius is None:
            return None
        with dr.suspend_grad():
            at = projection.to_local @ mi.Point3f(ray.o - self._from_lens(ray) * ray.d)
            radius = projection.lens_radius()
            disk = mi.Point2f(at.x, at.y) / dr.select(radius > 0, radius, 1)
            return mi.warp.uniform_disk_to_square_concentric(disk)

    def _from_lens(self, ray: mi.Ray3f) -> mi.Float | None:
        """How far from the lens camera rays start: on the near clipping plane. Detached. None: they are parallel."""
        with dr.suspend_grad():
            projection = Projection(self.sensor)
            if projection.orthographic:
                return None
            to_local = dr.detach(projection.to_local)
            o, d = to_local @ dr.detach(ray.o), to_local @ dr.detach(ray.d)
            return o.z / d.z if projection.near > 0 else mi.Float(0)


def _before(projection: Projection, p: mi.Point3f, active: mi.Bool) -> mi.Point3f:
    """A point; where it is not active, any that has a place on the film."""
    return mi.Point3f(dr.select(active, p, mi.Point3f(projection.eye() + projection.view())))
