"""Which shapes have textures so fine that their points are better held on them: see `first_points.py`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .geometry.meshes import NO_ATTRIBUTES, inner, objects_below
from .geometry.parameters import Parameter

#: Rays by which textures are looked at.
RAYS = 2**14

#: Distance on the film of two positions close to each other, pixels.
STEP = 2**-6

#: Changes up to so many units in the last place are rounding: of a texture that is even, nothing else changes.
ROUNDING = 64

#: How much faster the light of a fine texture changes there than over a pixel; and if it jumps along lines that are
#: edges on the film.
RATIO, RATIO_OF_LINES = 4.0, 12.0


class Looks:
    """Counts how often textures are to be looked at: when their values are replaced for the first time, the second, the
    fourth, the eighth time. So a texture that is even at the start of a fit can come to be fine, and a look, which
    takes as long as a small step of a fit, is seldom."""

    def __init__(self) -> None:
        self.count = 0
        self._replaced = 0
        #: With the arrays, so that their numbers are not given to others.
        self._values: dict[str, Any] = {}

    def at(self, found: Sequence[Parameter]) -> None:
        """Look at the values of textures among all parameters. Reads nothing from the device."""
        before, self._values = self._values, {p.name: _array(p.value) for p in found if _is_of_texture(p)}
        if any(v.index != before[name].index for name, v in self._values.items() if name in before):
            self._replaced += 1
            self.count += self._replaced & (self._replaced - 1) == 0


def _is_of_texture(p: Parameter) -> bool:
    """Is a parameter an array of texels, or of values at vertices or faces?"""
    if isinstance(p.node, mi.Texture):
        return bool(dr.is_tensor_v(p.value))
    last = p.name.rsplit(".", 1)[-1]
    return isinstance(p.node, mi.Mesh) and last.startswith(("vertex_", "face_")) and last not in NO_ATTRIBUTES


def _array(value: Any) -> Any:
    value = dr.detach(value)
    return value.array if dr.is_tensor_v(value) else value


def fine_textures(scene: mi.Scene, sensor: mi.Sensor, shapes: list[Any], as_edges: Sequence[Any]) -> list[Any]:
    """Those among some shapes of which what they reflect, and emit, changes fast between two positions on the film that
    are close to each other, relative to what it changes over a pixel. Looks at some thousand rays.

    as_edges : shapes with lines that are edges on the film.
    """
    # Many shapes may share a material.
    varies = cache(has_texture)
    varying = [s for s in shapes if varies(s.bsdf()) or (s.is_emitter() and varies(s.emitter()))]
    if not varying:
        return []
    with dr.suspend_grad():
        near, far, of = (np.array(x) for x in _changes(scene, sensor, varying))
    found = []
    for shape in varying:
        own = of == int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(inner(shape)))[0])
        slope, change = (np.square(x[own], dtype=np.float64).sum() for x in (near, far))
        ratio = RATIO_OF_LINES if shape in as_edges else RATIO
        if slope > ratio**2 * change:
            found.append(shape)
    return found


def has_texture(owner: mi.Object) -> bool:
    """Does a material, or an emitter, have a texture? (Mitsuba 3.9 has no bump maps of other textures than bitmaps.)"""
    below = objects_below(owner).values()
    textures = [o for o in below if isinstance(o, mi.Texture) and o.is_spatially_varying()]
    bumpy = any(o.class_name() == "BumpMap" for o in below)
    return bool(textures) and not (bumpy and any(not o.class_name().startswith("Bitmap") for o in textures))


def look(sensor: mi.Sensor) -> tuple[mi.Sampler, mi.Point2f, mi.RayDifferential3f, mi.Bool]:
    """Random numbers, two of them for directions, rays through anywhere on the film, and for each along which of its
    axes to look on."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, RAYS)
    wavelength, along_x = sampler.next_1d(), sampler.next_1d() < 0.5
    lens, direction, position = sampler.next_2d(), sampler.next_2d(), sampler.next_2d()
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), wavelength, position, lens)
    return sampler, direction, ray, along_x


def _changes(scene: mi.Scene, sensor: mi.Sensor, shapes: list[Any]) -> tuple[mi.Float, mi.Float, mi.UInt32]:
    """At many positions on the film, how much what is seen of some shapes changes per pixel, over a short step, and
    over a whole pixel of its texture; and the number of the shape."""
    _, direction, ray, along_x = look(sensor)
    towards = mi.warp.square_to_cosine_hemisphere(direction)
    si = scene.ray_intersect(ray, mi.RayFlags.All, True)
    si.compute_uv_partials(ray)
    pixel = dr.select(along_x, si.duv_dx, si.duv_dy)
    n, uv = mi.Vector3f(si.n), mi.Point2f(si.uv)
    wo = si.to_local(mi.Frame3f(dr.mulsign(n, -dr.dot(n, ray.d))).to_world(towards))
    values = []
    for step in (0, STEP, 1):
        si.uv = uv + step * pixel
        seen = mi.Spectrum(0)
        # Not by virtual function calls, which would ask all materials that there are, those of other scenes included.
        for bsdf in dict.fromkeys(s.bsdf() for s in shapes):
            own = si.bsdf() == mi.BSDFPtr(bsdf)
            seen += dr.select(own, mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, wo, own)), 0)
        for emitter in dict.fromkeys(s.emitter() for s in shapes if s.is_emitter()):
            own = si.emitter(scene) == mi.EmitterPtr(emitter)
            seen += dr.select(own, mi.unpolarized_spectrum(emitter.eval(si, own)), 0)
        values.append(dr.mean(seen))
    # At the outline of what is round, a pixel is long: without these weights, it is chance what the sums are.
    near, far = (dr.abs((v - values[0]) * dr.dot(n, ray.d)) for v in values[1:])
    near = dr.select(near > ROUNDING * dr.epsilon(mi.Float) * dr.abs(values[0]), near, 0) / STEP
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    usable = si.is_valid() & dr.isfinite(near) & dr.isfinite(far)
    return dr.select(usable, near, 0), dr.select(usable, far, 0), dr.select(usable, shape, 0)
