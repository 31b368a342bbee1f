"""Points of fine textures are held where the camera sees them."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from cases import CAMERA_X, case, diffuse
from fine_textures import fine, stage

import rimlight
from rimlight.checks import Motion, derivative_image


def held(scene, integrator, key="sensor.to_world"):
    """Identifiers of the shapes that are held in a derivative with respect to a parameter."""
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    found = integrator.find_boundaries(scene)
    found = (found[0] if isinstance(found, tuple) else found).held
    if found is None:
        return []
    u = mi.Point2f(*dr.meshgrid(*2 * [dr.linspace(mi.Float, 0.01, 0.99, 40)]))
    with dr.suspend_grad():
        ray, _ = scene.sensors()[0].sample_ray(0, 0.5, u, mi.Point2f(0.5))
        pi = scene.ray_intersect_preliminary(ray)
        return [s.id() for s in scene.shapes() if dr.any(found.are(pi) & (pi.shape == mi.ShapePtr(s)))]


@pytest.mark.parametrize(
    "key, shapes",
    [("sensor.to_world", ["floor"]), ("floor.vertex_positions", ["floor"]), ("cube.vertex_positions", [])],
)
def test_fine_textures_that_move_are_held(variant, key, shapes):
    assert held(stage()(), mi.load_dict({"type": "direct_edge"}), key) == shapes


@pytest.mark.parametrize("what", ["no texture", "coarse texture", "mirror", "fisheye", "bdpt_edge", "rig"])
def test_what_is_not_held(variant, what):
    coarse = {"type": "bitmap", "bitmap": mi.Bitmap(np.float32([[0.1, 0.9], [0.7, 0.2]])), "raw": True}
    floors = {"no texture": lambda: diffuse(0.5), "coarse texture": lambda: {"type": "diffuse", "reflectance": coarse}}
    floors["mirror"] = lambda: {"type": "plastic", "diffuse_reflectance": fine()["bsdf"]["reflectance"]}
    view = {"kind": "fisheye", "fov": 120} if what == "fisheye" else {}
    integrator = {"type": what, "max_depth": 3} if what in ("bdpt_edge", "rig") else {"type": "direct_edge"}
    assert held(stage(floor=floors.get(what, fine), **view)(), mi.load_dict(integrator)) == []


@pytest.mark.parametrize("name", ["fine_look", "fine_lens", "fine_wall", "fine_box"])
def test_backward_is_forward(variant, name):
    c = case(name)
    scene = c.scene()
    assert_backward_is_forward(scene, mi.load_dict(c.integrator), Motion(scene, **c.motion))


@pytest.mark.parametrize("without", ["sppp", "sppc"])
def test_a_term_alone_is_what_it_is_without(variant, monkeypatch, without):
    """Interior and film boundary by themselves hold nothing: the one is what Mitsuba's `prb` makes."""
    scene = stage()()
    motion, integrator = Motion(scene, **CAMERA_X), {"type": "direct_edge", without: 0, "sppi": 0}
    alone = np.array(derivative_image(scene, mi.load_dict(integrator), motion, spp=4, seed=2))
    monkeypatch.setattr("rimlight.integrators._search.fine_textures", lambda *_: [])
    again = np.array(derivative_image(scene, mi.load_dict(integrator), motion, spp=4, seed=2))
    np.testing.assert_allclose(alone, again, rtol=1e-5, atol=1e-5 * np.abs(again).max())


def test_plans_tell(variant):
    rows = {}
    for floor in (fine, lambda: diffuse(0.5)):
        integrator = mi.load_dict({"type": "direct_edge"})
        plan = rimlight.plan(stage(floor=floor)(), ["sensor.to_world"], integrator=integrator)
        rows[floor is fine] = plan.term("passing surfaces")
    assert rows[True].samples > 0 and rows[False].samples == 0
    assert "fine textures move over the film" in rows[True].reason and "no fine texture" in rows[False].reason


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian", "mitchell", "lanczos"])
def test_places_where_filters_slope(variant, rfilter):
    """∫ ∂k/∂x · x du = −∫ k du, and the same times any function of y."""
    from rimlight.terms.passing import slope_sample

    rfilter = mi.load_dict({"type": rfilter})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 2**18)
    off, aside, slope = slope_sample(rfilter, sampler.next_1d(), sampler)
    r = rfilter.radius()
    x = (dr.arange(mi.Float, 4096) + 0.5) / 4096 * 2 * r - r
    k = np.array(rfilter.eval(x), np.float64) if not rfilter.is_box_filter() else np.ones(4096)
    step = 2 * r / 4096
    for g in (lambda y: 1 + 0 * y, np.cos):
        found = np.array(slope, np.float64) * 2 * np.array(off, np.float64) * g(np.array(aside, np.float64))
        expected = -k.sum() * step * (k * g(np.array(x))).sum() * step
        assert abs(found.mean() - expected) < 5 * found.std() / np.sqrt(len(found)) + 1e-3 * abs(expected)
