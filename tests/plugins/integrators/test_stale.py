"""What an integrator keeps belongs to what it was derived from: if that changes, it does as a fresh integrator does."""

from __future__ import annotations

import gc
import sys

import beams
import cases
import drjit as dr
import mirrors
import mitsuba as mi
import numpy as np
import pytest
from other_textures import TEXTURES

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling import find_welded_edges

KINDS = {"direct_edge": {"type": "direct_edge"}, "prb_edge": cases.prb_edge(3), "rig": {"type": "rig"}}


def direct_edge():
    return mi.load_dict(KINDS["direct_edge"])


@pytest.fixture(params=KINDS, ids=str)
def make(request):
    """Makes an integrator."""
    return lambda: mi.load_dict(KINDS[request.param])


@pytest.fixture
def searches(monkeypatch):
    """Grows with each search for edges."""
    found = []

    def search(geometry):
        found.append(geometry)
        return find_welded_edges(geometry)

    # Not by the name of the module: each variant has one of its own.
    searching = type(direct_edge().search).prepare.__globals__
    monkeypatch.setitem(searching, "find_welded_edges", search)
    return found


def derivative(scene, integrator, key, **motion) -> np.ndarray:
    motion = motion or {"direction": [0.3, 1, 0]}
    return np.array(derivative_image(scene, integrator, Motion(scene, key, **motion), spp=16, seed=3), np.float64)


def assert_as_fresh(scene, used, make, key, **motion) -> np.ndarray:
    """Equal but for the order of additions."""
    expected, found = (derivative(scene, it, key, **motion) for it in (make(), used))
    assert np.abs(expected).sum() > 0
    assert np.abs(found - expected).sum() < 1e-4 * np.abs(expected).sum()
    return expected


def move(scene, key, *offset) -> None:
    params = mi.traverse(scene)
    p = dr.unravel(mi.Point3f, params[key])
    params[key] = dr.ravel(p + mi.Vector3f(*offset))
    params.update()


def two_quads(gap: float = 0.0):
    """Two sheets beside each other, in front of a lamp and a wall."""
    side = lambda name, x, *colour: cases.quad([x, -1, 0], [0.8, 0, 0], [0, 2, 0], name, bsdf=cases.diffuse(*colour))
    return cases.scene(
        sensor=cases.camera((0, 0, -5)),
        left=side("left", -0.8, 0.8, 0.3, 0.2),
        right=side("right", gap, 0.2, 0.6, 0.3),
        wall=cases.quad([-3, -3, 2], [6, 0, 0], [0, 6, 0], "wall", bsdf=cases.diffuse(0.5, two_sided=True)),
        lamp={"type": "point", "position": [1, 2, -4], "intensity": 20.0},
    )


# ---------------------- Contacts ----------------------


def test_meshes_that_part(make):
    scene, used = two_quads(), make()
    together = derivative(scene, used, "right.vertex_positions")
    move(scene, "right.vertex_positions", 0.57, 0, 0)
    apart = assert_as_fresh(scene, used, make, "right.vertex_positions")
    assert np.abs(apart - together).sum() > 0.1 * np.abs(together).sum()


def test_meshes_that_part_agree_with_a_scene_in_which_they_never_met():
    """Whoever finds the edges: `find_edges` itself is no part of this."""
    scene, used = two_quads(), direct_edge()
    derivative(scene, used, "right.vertex_positions")
    move(scene, "right.vertex_positions", 0.57, 0, 0)
    found = derivative(scene, used, "right.vertex_positions")
    expected = derivative(two_quads(0.57), direct_edge(), "right.vertex_positions")
    assert np.abs(found - expected).sum() < 1e-3 * np.abs(expected).sum()


def test_meshes_that_meet():
    scene, used = two_quads(0.6), direct_edge()
    derivative(scene, used, "sensor.to_world")
    move(scene, "right.vertex_positions", -0.6, 0, 0)
    exact = np.array(mi.traverse(scene)["left.vertex_positions"]).reshape(-1, 3)
    params = mi.traverse(scene)
    right = np.array(params["right.vertex_positions"]).reshape(-1, 3)
    right[:, 0] = np.where(np.abs(right[:, 0]) < 1e-5, exact[:, 0].max(), right[:, 0])
    params["right.vertex_positions"] = mi.Float(right.ravel().tolist())
    params.update()
    assert_as_fresh(scene, used, direct_edge, "sensor.to_world")


def test_copies_of_a_vertex_that_part():
    """One face of a cube with split vertices is lifted off: its crack is a pair of open edges."""
    scene, used = cases.cube(shape=cases.split_cube)(), direct_edge()
    derivative(scene, used, "cube.vertex_positions")
    params = mi.traverse(scene)
    p = np.array(params["cube.vertex_positions"]).reshape(-1, 3)
    p[:3] += 0.3 * np.cross(p[1] - p[0], p[2] - p[0]) / np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0]))
    params["cube.vertex_positions"] = p.ravel()
    params.update()
    assert_as_fresh(scene, used, direct_edge, "cube.vertex_positions")


def test_faces_that_had_no_area():
    """A folded triangle is ignored; not so when it unfolds."""
    flat = [[-1, -1, 0], [1, -1, 0], [1, -1, 0]]
    triangle = cases.mesh("triangle", flat, [[0, 1, 2]], bsdf=cases.diffuse(0.5, two_sided=True))
    scene = cases.scene(sensor=cases.camera((0, 0, -5)), triangle=triangle, sky=cases.constant())
    used = direct_edge()
    derivative(scene, used, "triangle.vertex_positions")
    move(scene, "triangle.vertex_positions", [0, 0, 0], [0, 0, 1.5], [0, 0, 0])
    assert_as_fresh(scene, used, direct_edge, "triangle.vertex_positions")


# ---------------------- What else edges are derived from ----------------------


def test_faces_of_equal_number():
    p = [[-1, -1, 0], [1, -1, 0], [1, 1, 0.6], [-1, 1, 0]]
    sheet = cases.mesh("sheet", p, [[0, 1, 2], [0, 2, 3]], bsdf=cases.diffuse(0.5, two_sided=True))
    scene = cases.scene(sensor=cases.camera((0, 0, -5)), sheet=sheet, lamp={"type": "point", "position": [1, 2, -4]})
    used = direct_edge()
    derivative(scene, used, "sheet.vertex_positions")
    params = mi.traverse(scene)
    params["sheet.faces"] = mi.UInt32([0, 1, 2, 0, 2, 1])
    params.update()
    assert_as_fresh(scene, used, direct_edge, "sheet.vertex_positions")


def test_colours_that_come_to_differ(searches):
    """At a seam of two split vertices in a flat sheet: something jumps there only from then on."""
    p = [[-1, -1, 0], [0, -1, 0], [0, 1, 0], [-1, 1, 0], [0, -1, 0], [1, -1, 0], [1, 1, 0], [0, 1, 0]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    colour = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    two_sided = {"type": "twosided", "bsdf": colour}
    sheet = cases.mesh("sheet", p, faces, colours=np.full((8, 3), 0.4), bsdf=two_sided)
    scene = cases.scene(sensor=cases.camera((0, 0, -5)), sheet=sheet, sky=cases.constant())
    used = direct_edge()
    derivative(scene, used, "sheet.vertex_positions")
    params = mi.traverse(scene)
    for value in (0.5, 0.6):  # of all: nothing jumps
        params["sheet.vertex_color"] = dr.full(mi.Float, value, 24)
        params.update()
        derivative(scene, used, "sheet.vertex_positions")
    assert len(searches) == 1
    params["sheet.vertex_color"] = np.repeat([0.2, 0.8], 12).astype(np.float32)
    params.update()
    assert_as_fresh(scene, used, direct_edge, "sheet.vertex_positions")


def test_material_is_exchanged(make):
    """Light in a glossy floor is sought from where the camera sees it; not so for a diffuse floor."""
    scene, used = cases.glossy_receiver(0.2)(), make()
    floor = next(s for s in scene.shapes() if s.bsdf().flags() & mi.BSDFFlags.Glossy)
    glossy = floor.bsdf()
    floor.set_bsdf(mi.load_dict(cases.diffuse(0.5)))
    key = next(k for k in ("blocker.vertex_positions", "plate.vertex_positions") if k in mi.traverse(scene))
    derivative(scene, used, key)
    floor.set_bsdf(glossy)
    assert_as_fresh(scene, used, make, key)


def test_a_beam_that_comes_to_end_with_a_jump(make):
    """The border of a projector's picture is black at first, then white; a spot comes to have no falloff."""
    black, white = np.zeros((4, 4, 3), np.float32), np.ones((4, 4, 3), np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(black), "raw": True, "wrap_mode": "clamp"}
    picture = {"type": "projector", "to_world": beams.at(), "irradiance": bitmap, "fov": 25.0}
    for lamp, key, value in (
        (picture, "lamp.irradiance.data", mi.TensorXf(white)),
        ({**beams.hard_spot(), "beam_width": 4.0}, "lamp.beam_width", mi.Float(18.0)),
    ):
        scene, used = beams.on_cube(lambda lamp=lamp: lamp)(), make()
        derivative(scene, used, "sensor.to_world")
        params = mi.traverse(scene)
        params[key] = value
        params.update()
        assert_as_fresh(scene, used, make, "sensor.to_world")


@pytest.mark.parametrize("kind", ["nearest", "checkerboard"])
def test_a_texture_that_comes_to_jump(kind):
    """It has one colour at first, as at the start of a fit."""
    even, other = np.full((4, 4, 3), 0.5, np.float32), np.random.default_rng(0).uniform(0, 1, (4, 4, 3))
    texture, key, value = {
        "nearest": (
            {"type": "bitmap", "bitmap": mi.Bitmap(even), "raw": True, "filter_type": "nearest"},
            "board.bsdf.reflectance.data",
            mi.TensorXf(other.astype(np.float32)),
        ),
        "checkerboard": (
            {"type": "checkerboard", "color0": 0.5, "color1": 0.5},
            "board.bsdf.reflectance.color1.value",
            mi.Float(0.1),
        ),
    }[kind]
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    board = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": texture}}
    scene, used = cases.scene(sensor=cases.camera(), board=board, sky=cases.constant()), direct_edge()
    before = derivative(scene, used, "board.to_world")
    params = mi.traverse(scene)
    params[key] = value
    params.update()
    after = assert_as_fresh(scene, used, direct_edge, "board.to_world")
    assert np.abs(after - before).sum() > 0.2 * np.abs(before).sum()


def test_a_picture_that_comes_to_jump_at_the_seam_of_a_globe():
    """Its first column and its last are equal at first."""
    first = np.tile(np.float32([0.5, 0.2, 0.5])[None, :, None], (2, 1, 3))
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(first), "raw": True, "wrap_mode": "clamp"}
    place = mi.ScalarTransform4f().rotate([0, 1, 0], 90)
    globe = {"type": "sphere", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": picture}}
    scene, used = cases.scene(sensor=cases.camera(), globe=globe, sky=cases.constant()), direct_edge()
    before = derivative(scene, used, "globe.to_world")
    params = mi.traverse(scene)
    params["globe.bsdf.reflectance.data"] = mi.TensorXf(first * np.float32([1.9, 1, 0.1])[None, :, None])
    params.update()
    after = assert_as_fresh(scene, used, direct_edge, "globe.to_world")
    assert np.abs(after - before).sum() > 0.2 * np.abs(before).sum()


@pytest.mark.parametrize("what", TEXTURES)
def test_textures_jump_at_other_places(monkeypatch, what):
    """(Whether their points are held is decided once, and changes the noise.)"""
    monkeypatch.setattr("rimlight.integrators._search.fine_textures", lambda *_: [])
    make_scene, key, value = TEXTURES[what]
    scene, used = make_scene(), direct_edge()
    params = mi.traverse(scene)
    moves = "board.vertex_positions" if "board.vertex_positions" in params else "cube.vertex_positions"
    before = derivative(scene, used, moves)
    params[key] = value(params[key])
    params.update()
    after = assert_as_fresh(scene, used, direct_edge, moves)
    assert np.abs(after - before).sum() > 0.2 * np.abs(before).sum()


@pytest.mark.parametrize("kind", ["prb_edge", "bdpt_edge", "rig"])
def test_depths_are_set_between_two_steps(kind):
    """As scripts do, so that paths become longer in the course of an optimisation."""
    lamp = {"type": "point", "position": [1, 4, -2], "intensity": 20.0}
    scene, used = lit(shared_meshes(), lamp), mi.load_dict({"type": kind, "max_depth": 2})
    before = derivative(scene, used, "cube.vertex_positions")
    used.max_depth = 3
    after = assert_as_fresh(scene, used, lambda: mi.load_dict({"type": kind, "max_depth": 3}), "cube.vertex_positions")
    assert np.abs(after - before).sum() > 0.05 * np.abs(before).sum()
    image = lambda it: np.array(mi.render(scene, integrator=it, spp=4), np.float64)
    np.testing.assert_allclose(image(used), image(mi.load_dict({"type": kind, "max_depth": 3})), atol=1e-5)


# ---------------------- Several scenes ----------------------


def lit(shapes: dict, *lamps: dict):
    return cases.scene(sensor=cases.camera((0, 2, -5)), **shapes, **{f"lamp{i}": lamp for i, lamp in enumerate(lamps)})


def shared_meshes() -> dict:
    floor = cases.horizontal((0, -1.5, 0), 3, "floor", bsdf=cases.diffuse(0.6))
    return {"cube": cases.welded_cube(), "floor": floor}


def test_meshes_in_several_scenes(make):
    """The meshes are the same objects, but the lights are not."""
    meshes = shared_meshes()
    point = {"type": "point", "position": [1, 4, -2], "intensity": 20.0}
    ceiling = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 4, 0]).rotate([1, 0, 0], 90)}
    scenes = [lit(meshes, point), lit(meshes, {**ceiling, "emitter": cases.light(5, 5, 5)}), lit(meshes, point, point)]
    used = make()
    for scene in scenes * 2:
        assert_as_fresh(scene, used, make, "cube.vertex_positions")


def test_scenes_that_are_freed():
    """The addresses of their objects are those of others, later on."""
    used = direct_edge()
    for turn in range(6):
        point = {"type": "point", "position": [turn - 2, 4, -2], "intensity": 20.0}
        scene = lit(shared_meshes(), *[point] * (1 + turn % 2))
        assert_as_fresh(scene, used, direct_edge, "cube.vertex_positions")
        del scene


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge"])
def test_flat_square_is_folded(kind):
    """Only then are its faces shaded with other normals than their own."""
    square = cases.mesh(
        "square", [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 2, 1], [0, 3, 2]], normals=True
    )
    lamp = {
        "type": "disk",
        "to_world": mi.ScalarTransform4f().look_at([2, 2, -0.5], [0, 0, 0], [0, 0, 1]),
        "emitter": cases.light(20, 20, 20),
    }
    film = cases.film(width=16, height=16, pixel_format="luminance")
    scene = cases.scene(sensor=cases.camera((0, 0, -5), fov=30, film=film), square=square, lamp=lamp)
    make = lambda: mi.load_dict(KINDS[kind])
    used = make()
    flat = assert_as_fresh(scene, used, make, "square.vertex_positions", rotate=[30, 20, 10])
    params = mi.traverse(scene)
    params["square.vertex_positions"] = [-1, -1, -1, 1, -1, 0, 1, 1, -1, -1, 1, 0]
    params.update()
    folded = assert_as_fresh(scene, used, make, "square.vertex_positions", rotate=[30, 20, 10])
    assert np.abs(folded - flat).sum() > 0.1 * np.abs(flat).sum()


# ---------------------- What is not renewed ----------------------


@pytest.mark.parametrize("key", ["cube.vertex_positions", "cube.bsdf.reflectance.value", "sensor.to_world"])
@pytest.mark.parametrize("shape", [cases.welded_cube, cases.split_cube], ids=["welded", "split"])
def test_ordinary_steps_find_no_edges(searches, shape, key):
    scene, used = cases.cube(shape=shape)(), direct_edge()
    for i in range(5):
        if key == "cube.vertex_positions":
            move(scene, key, 1e-2 * i, 0.37, -3e-3)
        derivative(scene, used, key)
    assert len(searches) == 1


def test_meshes_in_contact_that_move_together_stay_welded(searches):
    scene, used = two_quads(), direct_edge()
    for i in range(5):
        for key in ("left.vertex_positions", "right.vertex_positions"):
            move(scene, key, 0.013 * i, 0.71, 1e-3)
        derivative(scene, used, "right.vertex_positions")
    assert len(searches) == 1


# ---------------------- Frozen functions ----------------------


def frozen_step(scene, integrator, seed):
    loss = dr.sum(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=4, seed=seed), axis=None)
    dr.backward(loss)
    return loss.array


def gradients(step, scene, integrator) -> np.ndarray:
    """Of the motion of the right one of two quads, first in contact, then apart."""
    result, initial = [], dr.unravel(mi.Point3f, mi.traverse(scene)["right.vertex_positions"])
    for offset in (0.0,) * 3 + (0.57,) * 3:
        params, theta = mi.traverse(scene), dr.opaque(mi.Float, 0)
        dr.enable_grad(theta)
        params["right.vertex_positions"] = dr.ravel(initial + mi.Vector3f(offset + theta, 0, 0))
        params.update()
        step(scene, integrator, dr.opaque(mi.UInt32, 3))
        result.append(dr.grad(theta)[0])
        params["right.vertex_positions"] = dr.ravel(initial)
    return np.array(result)


def in_own_memory(scene):
    """Vertices that do not lie in NumPy's memory, as frozen functions need them."""
    params = mi.traverse(scene)
    for key in params.keys():  # noqa: SIM118 (not a dictionary)
        if key.endswith("vertex_positions"):
            params[key] = mi.Float(params[key]) * dr.opaque(mi.Float, 1)
            dr.eval(params[key])
    params.update()
    return scene


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge"])
def test_replay_sees_that_meshes_have_parted(kind):
    scene = in_own_memory(two_quads())
    expected = gradients(lambda *args: frozen_step(args[0], mi.load_dict(KINDS[kind]), args[2]), scene, None)
    frozen = dr.freeze(frozen_step, state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))
    found = gradients(frozen, scene, mi.load_dict(KINDS[kind]))
    assert np.abs(expected).min() > 0
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert frozen.n_recordings <= 4  # of each state, the first call makes storage


def test_frozen_function_that_cannot_know_is_refused():
    scene, integrator = in_own_memory(two_quads()), direct_edge()
    gradients(frozen_step, scene, integrator)
    with pytest.raises(RuntimeError) as error:
        gradients(dr.freeze(frozen_step), scene, integrator)
    cause = error.value
    while cause.__cause__ is not None:
        cause = cause.__cause__
    assert "state_fn" in str(cause) and "find_boundaries" in str(cause)


# ---------------------- What is held ----------------------


def test_derivatives_do_not_hold_the_scene(make):
    """Nor does garbage that only Python's collector frees: Dr.Jit may abort if that frees a scene while it traces."""
    scene, used = two_quads(), make()
    gc.collect()
    gc.disable()
    try:
        before = sys.getrefcount(scene)
        derivative(scene, used, "right.vertex_positions")
        used.plan(scene)
        assert sys.getrefcount(scene) == before
    finally:
        gc.enable()


def test_a_bump_map_that_becomes_steeper():
    scene, used = mirrors.bumpy_ball(), direct_edge()
    before = derivative(scene, used, "ball.to_world")
    params = mi.traverse(scene)
    params["ball.bsdf.scale"] = 3.0
    params.update()
    after = assert_as_fresh(scene, used, direct_edge, "ball.to_world")
    assert np.abs(after - before).sum() > 0.1 * np.abs(before).sum()
