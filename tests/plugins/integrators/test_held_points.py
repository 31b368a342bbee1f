"""Points of fine textures are held where the camera sees them."""

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from building import camera, mesh, scene
from cases import CAMERA_X, case, diffuse
from fine_textures import TEXELS, bitmap, fine, stage
from frozen import Step, assert_same, losses_and_gradients, numbers, one_thread
from instances import stretched_ball
from mirrors import checkered, rippled_mirror
from polished import lacquer, metal
from random_scenes import ball

import rimlight
from rimlight.checks import FiniteDifferences, Motion, compare, derivative_image
from rimlight.edge_sampling.fine_textures import Looks
from rimlight.edge_sampling.geometry.parameters import parameters
from rimlight.edge_sampling.turning_lobes import turning_lobes


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
        si, pi = scene.ray_intersect(ray), scene.ray_intersect_preliminary(ray)
        met = [(s, (si.shape == mi.ShapePtr(s)) | (si.instance == mi.ShapePtr(s))) for s in scene.shapes()]
        return [s.id() for s, there in met if dr.any(found.are(ray, pi, there))]


@pytest.mark.parametrize(
    "key, shapes",
    [("sensor.to_world", ["floor"]), ("floor.vertex_positions", ["floor"]), ("cube.vertex_positions", [])],
)
def test_fine_textures_that_move_are_held(variant, key, shapes):
    assert held(stage()(), mi.load_dict({"type": "direct_edge"}), key) == shapes


@pytest.mark.parametrize("texels, is_held", [(8, False), (512, True)])
def test_textures_that_jump_are_held_if_they_are_fine(variant, texels, is_held):
    nearest = {"type": "diffuse", "reflectance": bitmap(0, texels, filter_type="nearest")}
    scene, integrator = stage(floor=lambda: nearest)(), mi.load_dict({"type": "direct_edge"})
    assert held(scene, integrator) == ["floor"] * is_held
    (boundaries,) = integrator.search._boundaries.values()
    assert (boundaries.film.outlines.textures is None) == is_held


def test_fine_textures_of_instances_are_held(variant, monkeypatch):
    """With as much noise as on an equal mesh; the derivative is the same if nothing is held."""
    monkeypatch.setattr("instances.pictured", lambda kind: {"type": "diffuse", "reflectance": bitmap(3, 96)})
    made = []
    for apart in (False, True):
        scene, integrator = stretched_ball(apart=apart), mi.load_dict({"type": "direct_edge"})
        key = "thing.vertex_positions" if apart else "thing.to_world"
        assert held(scene, integrator, key) == ["thing"]
        motion = Motion(scene, key, rotate=[1, 0.4, 0.7], pivot=[0.1, 0.7, 0])
        made.append(np.array([derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(8)], float))
    assert_equal(*made, noise=0.1)


def assert_equal(a, b, noise):
    """Are two derivatives the same, up to noise?"""
    error = a.std(0, ddof=1) / np.sqrt(len(a))
    agreement = compare(b, FiniteDifferences(a.mean(0), error, np.zeros_like(error), {}))
    assert not agreement.faults(noise=noise), str(agreement)


@pytest.mark.parametrize("kind", ["checkerboard", "bumpmap"])
def test_derivatives_are_the_same_if_nothing_is_held(variant, monkeypatch, kind):
    """Lines of these textures lie on edges of the mesh; and at edges, the normals of bump maps jump by themselves."""
    make = partial(stretched_ball, kind, 12, apart=True)
    made = []
    for held_shapes in (lambda _scene, _sensor, shapes, _as_edges: shapes, lambda *_: []):
        monkeypatch.setattr("rimlight.integrators._search.fine_textures", held_shapes)
        scene = make()
        motion = Motion(scene, "thing.vertex_positions", rotate=[1, 0.4, 0.7], pivot=[0.1, 0.7, 0])
        integrator = mi.load_dict({"type": "direct_edge"})
        made.append(np.array([derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(8)], float))
    assert_equal(*made, noise=0.1)


@pytest.mark.parametrize(
    "make",
    [
        partial(checkered, "mirror"),
        partial(checkered, "mirror", mesh_=False),
        partial(checkered, "lacquer"),
        partial(checkered, "lacquer", mesh_=False),
        rippled_mirror,
    ],
    ids=["mirror", "mirrored sphere", "lacquer", "lacquered sphere", "map"],
)
def test_derivatives_of_mirrors_are_the_same_if_nothing_is_held(variant, monkeypatch, make):
    """Lines of their textures lie on edges of the mesh, and on the seam of the sphere; and maps jump in what they
    show."""
    made = []
    for held_shapes in (lambda _scene, _sensor, shapes: shapes, lambda *_: []):
        monkeypatch.setattr("rimlight.integrators._search.turning_lobes", held_shapes)
        scene, integrator = make(), mi.load_dict({"type": "direct_edge"})
        thing = next(s for s in scene.shapes() if s.id() in ("ball", "mirror"))
        key = f"{thing.id()}.{'vertex_positions' if thing.id() == 'ball' and thing.is_mesh() else 'to_world'}"
        motion = Motion(scene, key, direction=[1, 0.3, 0.4])
        made.append(np.array([derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(8)], float))
    assert_equal(*made, noise=0.15)


def of_floor(scene, texels):
    """Give the floor of `stage` these texels."""
    params = mi.traverse(scene)
    params["floor.bsdf.brdf_0.reflectance.data"] = mi.TensorXf(texels.astype(np.float32))
    params.update()


EVEN, FINE = np.full((TEXELS, TEXELS, 3), 0.5), np.random.default_rng(4).uniform(0.05, 0.95, (TEXELS, TEXELS, 3))


@pytest.mark.parametrize("filter_type, frozen", [("bilinear", False), ("bilinear", True), ("nearest", False)])
def test_textures_that_become_fine_come_to_be_held(filter_type, frozen):
    """As a fresh integrator finds them, at the first change and at the second. (That a texture with jumps has become
    even is not looked for.)"""
    floor = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap(0, filter_type=filter_type)}}
    scene, used = stage(floor=lambda: floor)(), mi.load_dict({"type": "direct_edge"})
    initial = numbers(mi.traverse(scene)["sensor.to_world"])
    step = Step().frozen() if frozen else Step()
    changes = [(EVEN, False), (FINE, True), (EVEN, False)]
    for texels, is_held in changes[: 2 if filter_type == "nearest" else 3]:
        of_floor(scene, texels)
        assert held(scene, used) == ["floor"] * is_held
        fresh = mi.load_dict({"type": "direct_edge"})
        with one_thread():
            of = lambda step, it: losses_and_gradients(step, scene, it, "sensor.to_world", initial)
            assert_same(of(step, used), of(Step(), fresh))


def test_textures_are_looked_at_ever_more_rarely():
    scene = stage()()
    looks, found = Looks(), []
    for k in range(20):
        of_floor(scene, FINE + 0.001 * k)
        before = looks.count
        looks.at(parameters(scene))
        if looks.count > before:
            found.append(k)
        looks.at(parameters(scene))  # nothing is replaced
    assert found == [1, 2, 4, 8, 16]


@pytest.mark.parametrize("what", ["no texture", "coarse texture", "mirror", "fisheye", "bdpt_edge", "rig"])
def test_what_is_not_held(variant, what):
    coarse = {"type": "bitmap", "bitmap": mi.Bitmap(np.float32([[0.1, 0.9], [0.7, 0.2]])), "raw": True}
    floors = {"no texture": lambda: diffuse(0.5), "coarse texture": lambda: {"type": "diffuse", "reflectance": coarse}}
    floors["mirror"] = lambda: {"type": "plastic", "diffuse_reflectance": fine()["bsdf"]["reflectance"]}
    view = {"kind": "fisheye", "fov": 120} if what == "fisheye" else {}
    integrator = {"type": what, "max_depth": 3} if what in ("bdpt_edge", "rig") else {"type": "direct_edge"}
    assert held(stage(floor=floors.get(what, fine), **view)(), mi.load_dict(integrator)) == []


def rounded(bsdf, flat=False):
    """A mesh of few faces with the normals of a ball; or with those of its faces."""
    vertices, _, _, faces = ball(8)
    return scene(sensor=camera((0, 0, -4)), thing=mesh("thing", vertices, faces, normals=not flat, bsdf=bsdf))


@pytest.mark.parametrize(
    "bsdf, flat, is_held",
    [
        ({"type": "conductor"}, False, True),
        ({"type": "dielectric"}, False, True),
        ({"type": "conductor"}, True, False),
        ({"type": "conductor", "specular_reflectance": {"type": "checkerboard"}}, False, True),
        (metal(0.05), False, True),
        (lacquer(0.05), False, True),
        (metal(0.05), True, False),
        (metal(0.5), False, False),
        (diffuse(0.5), False, False),
    ],
)
def test_curved_shapes_are_held_if_they_are_polished(variant, bsdf, flat, is_held):
    made, integrator = rounded(bsdf, flat), mi.load_dict({"type": "direct_edge"})
    assert held(made, integrator, "thing.vertex_positions") == ["thing"] * is_held


@pytest.mark.parametrize("name", ["glass_ball", "balls_camera"])
def test_polished_shapes_that_are_held_have_less_noise(variant, monkeypatch, name):
    c, noise = case(name), []
    motion = lambda scene: Motion(scene, **c.motion)
    for chosen in (turning_lobes, lambda *_: []):
        monkeypatch.setattr("rimlight.integrators._search.turning_lobes", chosen)
        made, integrator = c.scene(), mi.load_dict(c.integrator)
        images = [derivative_image(made, integrator, motion(made), spp=32, seed=i) for i in range(6)]
        noise.append(np.array(images, float).std(0, ddof=1).sum())
    assert noise[0] < 0.75 * noise[1]


@pytest.mark.parametrize(
    "name", ["fine_look", "fine_lens", "fine_wall", "fine_box", "glass_ball", "polished_figure", "balls_camera"]
)
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
    assert "fine textures" in rows[True].reason and rows[False].reason == "none does that"


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
