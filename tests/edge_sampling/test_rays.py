"""Rays that start on surfaces: `rays.py`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, diffuse, horizontal, mesh, scene

from rimlight.edge_sampling.rays import extent, lift, spawn_ray, spawn_ray_to


def cube_on_a_table(size: float = 1.0, place: tuple[float, float, float] = (0, 0, 0)) -> mi.Scene:
    upright = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (0.1, 1.1) for x in (-0.5, 0.5)])
    cube = mesh("cube", size * upright + place, CUBE_FACES, bsdf=diffuse(0.5))
    return scene(cube=cube, table=horizontal(place, 2 * size, "table", bsdf=diffuse(0.5)))


def interaction(scene: mi.Scene, size: float = 1.0, place=(0, 0, 0)) -> mi.SurfaceInteraction3f:
    """Points on the cube and on the table, seen from above."""
    x = np.linspace(-1.47, 1.47, 64)
    o = mi.Point3f(*(np.stack([x, 0 * x + 3, 0.1 + 0 * x]) * size + np.asarray(place)[:, None]).astype(np.float32))
    return scene.ray_intersect(mi.Ray3f(o, mi.Vector3f(0, -1, 0)))


def test_rays_start_where_those_of_mitsuba_do():
    there = cube_on_a_table()
    si = interaction(there)
    target, d = mi.Point3f(0.3, 2, 0.4), dr.normalize(mi.Vector3f(0.2, 1, -0.3))
    for mine, theirs in (
        (spawn_ray(there, si, d), si.spawn_ray(d)),
        (spawn_ray_to(there, si, target), si.spawn_ray_to(target)),
    ):
        assert dr.all(mine.o == theirs.o, axis=None)
        assert dr.all(mine.d == theirs.d, axis=None)
        assert dr.all(mine.maxt == theirs.maxt)


@pytest.mark.parametrize(("size", "distance"), [(1e-3, 0), (1e-3, 0.02), (1e-6, 0), (1, 100), (1, 500)])
def test_rays_start_close_to_surfaces_of_small_and_distant_scenes(size, distance):
    place = np.array([0.6, -0.5, 0.7]) * distance
    there = cube_on_a_table(size, place)
    si = interaction(there, size, place)
    assert dr.all(si.is_valid())
    d = dr.normalize(mi.Vector3f(0.2, 1, -0.3))
    ray = spawn_ray(there, si, d)
    above = dr.norm(ray.o - si.p).numpy()
    assert dr.all(dr.dot(ray.o - si.p, si.n) * dr.dot(d, si.n) > 0)
    assert above.max() < 2e-4 * size + 1e-5 * distance
    assert np.allclose(above, lift(there, si.p).numpy(), rtol=0.05, atol=1e-7 * distance)
    # They meet neither the surface that they leave, nor miss one that they should meet.
    assert not dr.any(there.ray_intersect(spawn_ray(there, si, si.n)).is_valid())
    below = there.ray_intersect(spawn_ray(there, si, -si.n))
    assert dr.all(below.is_valid() == (si.shape == mi.ShapePtr(there.shapes()[0])))
    target = si.p + mi.Vector3f(0, 2, 0.02) * size
    to_target = spawn_ray_to(there, si, target)
    assert not dr.any(there.ray_test(to_target))
    gap = dr.norm(target - to_target(to_target.maxt)).numpy()
    assert gap.max() < 4e-3 * size + 1e-6 * distance


def test_extent_of_nothing():
    assert extent(mi.load_dict({"type": "scene"})) == (np.inf, 0)
