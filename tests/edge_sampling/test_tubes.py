"""Outlines of b-spline curves: `geometry/tubes.py`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from wires import BEND, SLIDE, SWELL, before_wall, sun, wires

from rimlight.edge_sampling.geometry.instances import surface_met
from rimlight.edge_sampling.geometry.tubes import TUBE, Tubes


def points(count: int, far: bool):
    """Points on the outlines of the wires, each as seen from a place of its own."""
    scene = mi.load_dict({"type": "scene", "wires": wires()})
    tubes = Tubes(tuple(scene.shapes()))
    rng = np.random.default_rng(3)
    o = rng.normal(size=(3, count))
    eye = mi.Point3f(o * (rng.uniform(3, 6, count) / np.linalg.norm(o, axis=0)))
    curve, v = mi.UInt32(rng.integers(0, tubes.count, count)), mi.Float(rng.uniform(0.02, 0.98, count))
    return scene, eye, lambda dv=0.0: tubes.point(tubes.control_points(), curve, v + dv, eye, far, False)


@pytest.mark.parametrize("far", [False, True])
def test_rays_miss_tubes_just_outside_of_their_outlines_and_meet_them_just_inside(variant, far):
    scene, eye, at = points(20_000, far)
    q = at()
    d = -mi.Vector3f(eye) if far else q.p - eye
    aside = dr.normalize(dr.cross(d, q.tangent))
    aside *= 2 * q.slack * -dr.sign(dr.dot(aside, q.inwards))
    met = []
    for side in (-1, 1):
        o = q.p + side * aside - d if far else eye
        ray = mi.Ray3f(mi.Point3f(o), dr.normalize(q.p + side * aside - o))
        pi = scene.ray_intersect_preliminary(ray)
        before, there = pi.t < dr.norm(d) - 0.15, dr.abs(pi.t - dr.norm(d)) < 0.1
        met.append((np.array(before), np.array(there)))
    seen = np.array(q.valid) & ~met[0][0] & ~met[1][0]
    assert seen.sum() > 10_000
    assert met[0][1][seen].mean() > 0.97
    assert met[1][1][seen].mean() < 0.005  # rays almost along a tube meet it farther on


@pytest.mark.parametrize("far", [False, True])
def test_tangents_are_those_of_finite_differences(variant, far):
    _, _, at = points(5_000, far)
    middle, before, after = at(), at(-1e-3), at(1e-3)
    valid = np.array(middle.valid & before.valid & after.valid)
    difference, tangent = (np.array(v)[:, valid] for v in ((after.p - before.p) / 2e-3, middle.tangent))
    assert np.median(np.linalg.norm(difference - tangent, axis=0) / np.linalg.norm(tangent, axis=0)) < 1e-3


@pytest.mark.parametrize("motion", [SLIDE, SWELL, BEND])
def test_normals_and_texture_coordinates_slide_with_fixed_rays(variant, motion):
    """Mitsuba's own are 19 % off where these wires slide."""
    scene, step = before_wall(sun)(), 5e-4
    params = mi.traverse(scene)
    control, direction = mi.Float(params[motion["key"]]), mi.Float(motion["direction"])
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(np.random.default_rng(0).uniform(size=(2, 30_000))), 0.5)

    def at(θ):
        params[motion["key"]] = control + θ * direction
        params.update()
        pi = scene.ray_intersect_preliminary(ray)
        si = surface_met(scene, ray, pi, mi.RayFlags.All, pi.is_valid())
        dr.eval(si, pi)
        on_wire = np.array([s.class_name() == TUBE for s in scene.shapes()])
        wire = mi.ShapePtr(scene.shapes()[int(on_wire.argmax())])
        return si, np.array(pi.shape == wire)

    θ = mi.Float(0)
    dr.enable_grad(θ)
    (before, a), (after, b), (middle, c) = at(-step), at(step), at(θ)
    dr.forward(θ, dr.ADFlag.ClearEdges)
    on = a & b & c & (np.array(dr.detach(middle.wi.z)) > 0.2)
    for of in (lambda si: si.n, lambda si: si.sh_frame.n, lambda si: si.sh_frame.s, lambda si: mi.Point2f(0, si.uv.y)):
        difference = (np.array(of(after)) - np.array(of(before)))[:, on] / (2 * step)
        derivative = np.array(dr.grad(of(middle)))[:, on]
        close = np.abs(difference).max(0) < 50  # no jump of the segment, or of another wire
        error = np.abs(derivative - difference)[:, close].sum()
        assert error < 0.01 * np.abs(difference)[:, close].sum()
    assert on.sum() > 1000
