"""In which directions a derivative follows paths from matt surfaces: `transport/matt.py`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, cube_vertices, mesh

COUNT = 2**18


def square(bsdf: dict) -> mi.Scene:
    return mi.load_dict({"type": "scene", "square": {"type": "rectangle", "bsdf": bsdf}})


def seen(scene: mi.Scene, towards: float = 1.0) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr, mi.Sampler]:
    """A surface in the plane z = 0, looked at at a slant from above, or from below if `towards` is negative."""
    d = dr.normalize(mi.Vector3f(0.3, 0.1, -towards))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(-d) + dr.zeros(mi.Point3f, COUNT), d))
    assert dr.all(si.is_valid())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, COUNT)
    return si, si.bsdf(), sampler


DIFFUSE = {"type": "diffuse"}
TWOSIDED = {"type": "twosided", "bsdf": DIFFUSE}


@pytest.mark.parametrize(("bsdf", "towards"), [(DIFFUSE, 1.0), (TWOSIDED, 1.0), (TWOSIDED, -1.0)])
def test_directions_have_their_density_and_bound_what_a_turn_changes(variant, bsdf, towards):
    from rimlight.transport.matt import UNIFORM, MattDirections

    scene = square(bsdf)
    si, bsdf, sampler = seen(scene, towards)
    directions = MattDirections.above(si, bsdf, scene.shapes(), mi.Bool(True))
    assert dr.all(directions.active)
    ω, pdf = directions.sample(sampler.next_1d(), sampler.next_2d())
    # On the side from which the surface is looked at, which reflects it.
    assert dr.all(ω.z * towards > 0) and dr.all(bsdf.eval(mi.BSDFContext(), si, si.to_local(ω)).x > 0)
    # Moments of the hemisphere: 2 π, π, 2 π / 3.
    for power, expected in ((0, 2 * np.pi), (1, np.pi), (2, 2 * np.pi / 3)):
        values = np.array(dr.abs(ω.z) ** power / pdf, float)
        assert abs(values.mean() - expected) < 4 * values.std() / np.sqrt(COUNT)
    # As the normal turns, a direction changes by at most its length: samples are at most so large.
    assert float(dr.max(dr.rcp(pdf))[0]) <= 2 * np.pi / UNIFORM * (1 + 1e-5)


@pytest.mark.parametrize("bsdf", [{"type": "plastic"}, {"type": "roughconductor"}, {"type": "mask", "bsdf": DIFFUSE}])
def test_other_surfaces_keep_their_directions(variant, bsdf):
    from rimlight.transport.matt import MattDirections

    scene = square(bsdf)
    si, bsdf, _ = seen(scene)
    assert not dr.any(MattDirections.above(si, bsdf, scene.shapes(), mi.Bool(True)).active)


def test_flat_faces_that_stand_still_keep_their_directions_if_nothing_moves(variant):
    from rimlight.transport.matt import MattDirections, turning

    box = lambda name, x, normals: mesh(name, cube_vertices() + np.array([x, 0, 0]), CUBE_FACES, normals)
    shapes = {"flat": box("flat", 0, False), "smooth": box("smooth", 3, True), "cube": {"type": "cube"}}
    scene = mi.load_dict({"type": "scene", **shapes, "ball": {"type": "sphere", "center": [6, 0, 0]}})
    assert {s.id() for s in turning(scene)} == {"ball", "smooth"}
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f([0.1, 3.1, 6.1], 0.2, -9), mi.Vector3f(0, 0, 1)))
    directions = MattDirections.above(si, si.bsdf(), turning(scene), mi.Bool(True))
    assert directions.active.numpy().tolist() == [False, True, True]
    params = mi.traverse(scene)
    dr.enable_grad(params["flat.vertex_positions"])
    params.update()
    assert len(turning(scene)) == 4
