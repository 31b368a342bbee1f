"""Which curved shapes are so polished that their points are better held on them: see `first_points.py`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .fine_textures import look
from .geometry.meshes import has_normal_map, inner, is_smooth
from .geometry.surfaces import Surfaces

#: Lobes without width, and with some.
SMOOTH = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
GLOSSY = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.GlossyTransmission

#: Over such a part of a pixel, it is looked how the reflected light changes.
STEP = 0.25

#: A shape is held where that is more than so many times the light, for a whole pixel.
RATE = 0.6


def is_curved(shape: Any) -> bool:
    """Do the normals of a shape turn along its surface: by themselves, or, of perfect mirrors and glass, by a map?"""
    curved = is_smooth(shape) if shape.is_mesh() else shape.class_name() in ("Sphere", "Cylinder")
    return curved or (bool(shape.bsdf().flags() & SMOOTH) and has_normal_map(shape))


def turning_lobes(scene: mi.Scene, sensor: mi.Sensor, shapes: list[Any]) -> list[Any]:
    """Those among some curved shapes that reflect and refract light in a lobe which turns away over a pixel, or in one
    of no width, as perfect mirrors do. Looks at some thousand rays."""
    found = [s for s in shapes if s.bsdf().flags() & SMOOTH]
    others = [s for s in shapes if not s.bsdf().flags() & SMOOTH and s.bsdf().flags() & GLOSSY]
    if not others:
        return found
    with dr.suspend_grad():
        change, light, of = (np.array(x) for x in _changes(scene, sensor, others))
    for shape in others:
        own = of == int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(inner(shape)))[0])
        moved, there = (np.square(x[own], dtype=np.float64).sum() for x in (change, light))
        if moved > RATE**2 * there:
            found.append(shape)
    return found


def _changes(scene: mi.Scene, sensor: mi.Sensor, shapes: list[Any]) -> tuple[mi.Float, mi.Float, mi.UInt32]:
    """Of samples of the light that some shapes reflect, how much they change per pixel, as the normal does, where the
    shape is seen from its front; their values; and the number of the shape."""
    sampler, direction, ray, along_x = look(sensor)
    si = Surfaces(scene).met(ray, scene.ray_intersect_preliminary(ray), mi.Bool(True))
    si.compute_uv_partials(ray)
    pixel = dr.select(along_x, si.duv_dx, si.duv_dy) * dr.abs(dr.dot(si.n, ray.d))
    turned = mi.SurfaceInteraction3f(si)
    turned.sh_frame = mi.Frame3f(dr.normalize(si.sh_frame.n + STEP * (si.dn_du * pixel.x + si.dn_dv * pixel.y)))
    turned.wi = turned.to_local(-ray.d)
    by_lobe, lobe, inside = sampler.next_1d() < 0.5, sampler.next_1d(), sampler.next_2d()
    cosine = mi.warp.square_to_cosine_hemisphere(direction)
    cosine.z = dr.mulsign(cosine.z, si.wi.z)
    change, light, context = mi.Float(0), mi.Float(0), mi.BSDFContext()
    # Not by virtual function calls, which would ask all materials that there are, those of other scenes included.
    for bsdf in dict.fromkeys(s.bsdf() for s in shapes):
        own = si.is_valid() & (si.bsdf() == mi.BSDFPtr(bsdf))
        wo = dr.select(by_lobe, bsdf.sample(context, si, lobe, inside, own)[0].wo, cosine)
        towards, values, density = si.to_world(wo), [], mi.Float(0)
        for s in (si, turned):
            wo = s.to_local(towards)
            values.append(dr.mean(mi.unpolarized_spectrum(bsdf.eval(context, s, wo, own))))
            density += 0.25 * (bsdf.pdf(context, s, wo, own) + dr.inv_pi * dr.abs(wo.z))
        usable = own & (density > 0) & dr.isfinite(values[0]) & dr.isfinite(values[1])
        change += dr.select(usable, dr.abs(values[1] - values[0]) / (STEP * density), 0)
        light += dr.select(usable, values[0] / density, 0)
    return change, light, dr.select(si.is_valid(), dr.reinterpret_array(mi.UInt32, si.shape), 0)
