"""Rays that start on surfaces: how far above them.

A ray that starts where another one met a surface would meet it again, by rounding. Mitsuba's rays start

    RayEpsilon · (1 + |p|),        RayEpsilon = 9 · 10⁻⁵, |p| the largest coordinate of the point p

above it, however small the scene. Where it measures a thousandth of a unit, a tenth of it lies below that: shadows fall
beside where they belong, and rays through a thin glass start behind it. So in scenes that are smaller than 1 + |p|,
rays start closer to surfaces. In all others, they start where Mitsuba's do.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

#: Largest offset in small scenes, relative to their diagonal, in RayEpsilon.
PART = 0.25

#: Least offset relative to the largest coordinate, in RayEpsilon: 64 units in the last place.
LEAST = 64 / 1500

#: How far above a surface rays start that go through it as if nothing was there, relative to the largest coordinate or
#: the size of the scene, in RayEpsilon: 16 units in the last place. And least cosine by which that is divided.
THROUGH, STEEPEST = 16 / 1500, 0.01

#: A ray that meets something within this part of the offset of rays starts in the face that it meets.
AT_START = 0.5


def spawn_ray(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, d: mi.Vector3f, through: mi.Bool | bool = False
) -> mi.Ray3f:
    """The ray that leaves `si` in the direction d, as Mitsuba's `spawn_ray`.

    through : does it go through the surface as if nothing was there? Then it starts on the line of the ray that met the
        surface, and closer to it: Mitsuba's starts beside that line, and shows edges where they are not on the film.
    """
    ray = si.spawn_ray(d)
    if _size_if_small(scene) is not None:
        ray.o = _start(scene, si, d)
    if through is not False:
        with dr.suspend_grad():
            along = lift_beyond(scene, si.p) / dr.maximum(dr.abs_dot(si.n, d), STEEPEST)
        ray.o = dr.select(through, dr.fma(d, along, si.p), ray.o)
    return ray


def spawn_ray_to(scene: mi.Scene, si: mi.SurfaceInteraction3f, p: mi.Point3f) -> mi.Ray3f:
    """The ray from `si` to just before the point p, as Mitsuba's `spawn_ray_to`."""
    ray = si.spawn_ray_to(p)
    if _size_if_small(scene) is not None:
        ray.o = _start(scene, si, p - si.p)
        d = p - ray.o
        distance = dr.norm(d)
        ray.d, ray.maxt = d / distance, distance * (1 - mi.math.ShadowEpsilon)
    return ray


def spawn_ray_to_light(scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f) -> mi.Ray3f:
    """The ray from `si` to just before the sampled point of a light; it has no end if the light is at infinity.

    Mitsuba lets rays to an environment end behind the scene. In a frozen function that changes parameters, a replay may
    read another radius of the scene there than the one that was recorded (Dr.Jit 1.5): it does not write into the data
    of virtual functions what was made from a constant during the recording. So that length is not used.
    """
    far = [bool(e.flags() & mi.EmitterFlags.Infinite) for e in scene.emitters()]
    if not any(far):
        return spawn_ray_to(scene, si, ds.p)
    endless = spawn_ray(scene, si, ds.d)
    if all(far):
        return endless
    return dr.select(mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite), endless, spawn_ray_to(scene, si, ds.p))


def lift(scene: mi.Scene, p: mi.Point3f) -> mi.Float:
    """How far above a surface rays start at its point p: mi.Float, (N,), scene units."""
    reach = dr.max(dr.abs(p))
    usual = mi.Float(1 + reach)
    size = _size_if_small(scene)
    if size is not None:
        usual = dr.maximum(dr.minimum(usual, PART * size), LEAST * reach)
    return usual * mi.math.RayEpsilon


def starts_in(scene: mi.Scene, ray: mi.Ray3f, t: mi.Float) -> mi.Bool:
    """Does a ray start in what it meets at the distance t? So it does close to the edge of an acute corner, where it
    starts about as far above one face as the other one is."""
    return t < AT_START * lift(scene, ray.o)


def lift_beyond(scene: mi.Scene, p: mi.Point3f) -> mi.Float:
    """`lift` of rays that go through the surface as if nothing was there."""
    reach = dr.maximum(dr.max(dr.abs(p)), _power_of_two(extent(scene)[0]))
    return dr.minimum(lift(scene, p), THROUGH * mi.math.RayEpsilon * reach)


def _start(scene, si, d) -> mi.Point3f:
    with dr.suspend_grad():
        above = dr.mulsign(lift(scene, si.p), dr.dot(si.n, d))
    return mi.Point3f(dr.fma(dr.detach(si.n), above, si.p))


def extent(scene: mi.Scene) -> tuple[float, float]:
    """Diagonal of the box around a scene, and its largest coordinate: infinity and zero, if there is no such box."""
    box = scene.bbox()
    lower, upper = list(box.min), list(box.max)
    reach = max(map(abs, lower + upper))
    return (math.dist(lower, upper), reach) if box.valid() and math.isfinite(reach) else (math.inf, 0.0)


def rough_size(scene: mi.Scene) -> float:
    """Diagonal of the scene, up to the next power of two, so that a scene that changes keeps its kernels."""
    return _power_of_two(extent(scene)[0])


def _size_if_small(scene: mi.Scene) -> float | None:
    """See `rough_size`. None: nowhere is the usual offset too large."""
    size, reach = rough_size(scene), extent(scene)[1]
    return size if 0 < size < 1 + reach else None


def _power_of_two(size: float) -> float:
    """The next one, from `size` on."""
    return 2.0 ** math.ceil(math.log2(size)) if 0 < size < math.inf else size
