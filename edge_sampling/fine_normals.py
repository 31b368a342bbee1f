"""Which smooth-shaded meshes are so rough that their points are better held on them: see `first_points.py`.

Folds and bumps that are narrower than a pixel do what a fine texture does: as they slide past a ray of the camera, the
light that it finds changes fast, in either direction.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .fine_textures import RAYS, STEP
from .geometry.meshes import has_interpolated_normals

#: How much faster the normals of a rough mesh turn over a short step on the film than over a pixel.
RATIO = 2.0

#: A mesh of which fewer rays meet three places is not looked at.
FEWEST = 2**8


def fine_normals(scene: mi.Scene, sensor: mi.Sensor, shapes: list[Any]) -> list[Any]:
    """Those meshes among some shapes of which the interpolated normals turn fast between two positions on the film that
    are close to each other, relative to how they turn over a pixel. Looks at some thousand rays; on the host, so not in
    frozen functions. What only instances show is none of them."""
    listed = dict.fromkeys(scene.shapes())
    smooth = [s for s in shapes if s in listed and s.is_mesh() and has_interpolated_normals(s)]
    if not smooth:
        return []
    with dr.suspend_grad():
        near, far, of = (np.array(x) for x in _turns(scene, sensor))
    found = []
    for shape in smooth:
        own = of == int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])
        slope, change = (np.square(x[own], dtype=np.float64).sum() for x in (near, far))
        if own.sum() >= FEWEST and slope > RATIO**2 * change:
            found.append(shape)
    return found


def _turns(scene: mi.Scene, sensor: mi.Sensor) -> tuple[mi.Float, mi.Float, mi.UInt32]:
    """At many positions on the film, by how much normals turn per pixel, over a short step, and over a whole pixel; and
    the number of the shape, 0 where it is not the same at all three places."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, RAYS)
    time, wavelength, lens = sensor.shutter_open(), sampler.next_1d(), sampler.next_2d()
    u, across = sampler.next_2d(), sampler.next_1d() < 0.5
    pixel = dr.select(across, mi.Vector2f(1, 0), mi.Vector2f(0, 1)) / mi.Vector2f(sensor.film().crop_size())
    normals, shapes, valid = [], [], mi.Bool(True)
    for step in (0, STEP, 1):
        ray, _ = sensor.sample_ray_differential(time, wavelength, mi.Point2f(u + step * pixel), lens)
        si = scene.ray_intersect(ray, mi.RayFlags.All, True)
        normals.append(mi.Vector3f(si.sh_frame.n))
        shapes.append(dr.reinterpret_array(mi.UInt32, si.shape))
        valid &= si.is_valid() & (shapes[-1] == shapes[0])
    near, far = dr.norm(normals[1] - normals[0]) / STEP, dr.norm(normals[2] - normals[0])
    valid &= dr.isfinite(near) & dr.isfinite(far)
    return dr.select(valid, near, 0), dr.select(valid, far, 0), dr.select(valid, shapes[0], 0)
