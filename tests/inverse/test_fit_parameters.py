"""Free parameters of a fit, and how an optimiser changes them."""

from __future__ import annotations

import sys
from pathlib import Path

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rimlight.inverse import free_parameters
from rimlight.inverse.optimisers import Optimiser
from rimlight.inverse.problem import Free, Problem

BOX, FLOOR, LIGHT = "box.vertex_positions", "floor.bsdf.reflectance.value", "light.emitter.radiance.value"
CAMERA = "sensor.to_world"

# ------------------------------------------------------------------ rigid motions


def motion(rotation, shift, centre) -> np.ndarray:
    T = free_parameters.rotate_and_shift(mi.Vector3f(*rotation), mi.Vector3f(*shift), mi.Point3f(*centre))
    return free_parameters.to_numpy(T).astype(np.float64)


ROTATIONS = [(0, 0, 0), (1e-7, 0, 0), (0.005, -0.004, 0.003), (0.0099, 0, 0), (0.0101, 0, 0), (0.3, 1, -2), (0, 9, 2)]


@pytest.mark.parametrize("rotation", ROTATIONS, ids=str)
def test_rigid_motion_is_a_rotation_about_its_centre(rotation):
    shift, centre = (0.5, -2, 1), (1, 2, -3)
    found = motion(rotation, shift, centre)
    R = found[:3, :3]
    np.testing.assert_allclose(R, Rotation.from_rotvec(rotation).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(R @ centre + found[:3, 3], np.add(centre, shift), atol=1e-5)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


def test_bodies_in_one_place_have_the_size_of_one():
    """A lamp in the middle of its bulb: their frames are no extended body."""
    frame = mi.Transform4f().translate([1, 2, 3])
    body = free_parameters.RigidBody("lamp", Free(key="lamp", kind="pose", rate=0.1), {"lamp": frame, "bulb": frame})
    assert body.rates() == pytest.approx({"lamp.move": 0.1, "lamp.turn": 0.1})


@pytest.mark.parametrize("rotation", ROTATIONS, ids=str)
def test_gradient_of_rigid_motions(rotation):
    weights = np.random.default_rng(0).standard_normal((3, 4))
    shift, centre = (0.5, -2, 1), (1, 2, -3)
    r, s = mi.Vector3f(*rotation), mi.Vector3f(*shift)
    dr.enable_grad(r, s)
    M = free_parameters.rotate_and_shift(r, s, mi.Point3f(*centre)).matrix
    dr.backward(sum(M[i, j] * float(weights[i, j]) for i in range(3) for j in range(4)))

    def value(r):
        R = Rotation.from_rotvec(r).as_matrix()
        return np.sum(weights * np.column_stack([R, np.add(centre, shift) - R @ centre]))

    h = 1e-5
    expected = [(value(rotation + h * e) - value(rotation - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(dr.grad(r).numpy().ravel(), expected, atol=2e-4)
    np.testing.assert_allclose(dr.grad(s).numpy().ravel(), weights[:, 3], atol=1e-6)


# ------------------------------------------------------------------ free parameters


@pytest.fixture
def params() -> mi.SceneParameters:
    T = mi.ScalarTransform4f
    return mi.traverse(
        cases.scene(
            sensor=cases.camera(),
            floor={"type": "rectangle", "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90)}
            | {"bsdf": cases.diffuse(0.8, 0.6, 0.4)},
            box={"type": "cube", "to_world": T().rotate([0, 1, 0], 30), "bsdf": cases.conductor(0.3)},
            torus=cases.torus(bsdf=cases.texture()),
            light={"type": "rectangle", "to_world": T().translate([0, 5, 0]), "emitter": cases.light(3, 2, 1)},
        )
    )


def found(params, *keys: str, kind: str = "shape", **options) -> free_parameters.Parameter:
    (parameter,) = free_parameters.find([Free(key=keys, kind=kind, **options)], params)
    return parameter


def values(parameter, latents) -> dict[str, np.ndarray]:
    held = {name: mi.Float(np.float32(latent)) for name, latent in latents.items()}
    return {key: free_parameters.to_numpy(value) for key, value in parameter.values(held).items()}


def points(params, key: str = BOX) -> np.ndarray:
    return np.array(params[key]).reshape(-1, 3)


def walk(parameter, steps: int = 8, slope: float | None = None, **options) -> dict[str, np.ndarray]:
    """Latents after steps down a slope, or along random gradients."""
    optimiser = Optimiser([parameter], Problem(scene=Path("a.xml"), free=(parameter.free,), **options))
    rng = np.random.default_rng(0)
    for _ in range(steps):
        attached = optimiser.values()
        sizes = {key: free_parameters.to_numpy(value).size for key, value in attached.items()}
        along = lambda size: rng.standard_normal(size) if slope is None else np.full(size, slope)
        optimiser.step(attached, {key: along(size).astype(np.float32) for key, size in sizes.items()}, 1)
    return optimiser.latents()


def test_rigid_bodies_of_several_parts_move_as_one(params):
    keys = BOX, "torus.vertex_positions", "floor.to_world"
    body = found(params, *keys, kind="pose", start=(0.1, -0.2, 0.3, 10, -50, 130))
    before = {key: free_parameters.to_numpy(params[key]) for key in keys}
    after = values(body, body.start)
    origin = before["floor.to_world"][None, :3, 3]
    centre = np.concatenate([points(params, keys[0]), points(params, keys[1]), origin]).mean(0)
    R = Rotation.from_rotvec(np.radians([10, -50, 130])).as_matrix()
    move = lambda p: (p - centre) @ R.T + centre + [0.1, -0.2, 0.3]
    for key in keys[:2]:
        np.testing.assert_allclose(after[key].reshape(-1, 3), move(before[key].reshape(-1, 3)), atol=1e-5)
    np.testing.assert_allclose(after["floor.to_world"][:3, 3], move(origin)[0], atol=1e-5)
    np.testing.assert_allclose(after["floor.to_world"][:3, :3], R @ before["floor.to_world"][:3, :3], atol=1e-5)
    for key, at_rest in values(body, body.truth).items():
        np.testing.assert_allclose(at_rest, before[key], atol=1e-6)


def test_cameras_turn_about_themselves(params):
    camera = found(params, CAMERA, kind="pose", turn="y", start=(0, 0, 0, 0, 90, 0))
    before, after = free_parameters.to_numpy(params[CAMERA]), values(camera, camera.start)[CAMERA]
    np.testing.assert_allclose(after[:, 3], before[:, 3], atol=1e-5)
    turned = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix() @ before[:3, :3]
    np.testing.assert_allclose(after[:3, :3], turned, atol=1e-5)
    assert camera.rates() == {"sensor.move": 0.01, "sensor.turn": 0.01}


def test_vertices_of_one_place_stay_together(params):
    """Mitsuba's cube has 24 vertices at 8 places."""
    assert len(points(params)) == 24
    box = found(params, BOX, rate=0.1)
    after = values(box, walk(box))[BOX].reshape(-1, 3)
    assert len(np.unique(points(params), axis=0)) == len(np.unique(after, axis=0)) == 8
    assert (np.linalg.norm(after - points(params), axis=1) > 0.01).all()


@pytest.mark.parametrize("vertex", [0, 23])
def test_a_chosen_vertex_takes_those_of_its_place_along(params, vertex):
    box = found(params, BOX, vertices=(vertex,), rate=0.1)
    moved = np.any(values(box, walk(box))[BOX].reshape(-1, 3) != points(params), axis=1)
    np.testing.assert_array_equal(moved, (points(params) == points(params)[vertex]).all(axis=1))


HOW = [{}, {"clip": 2.0}, {"optimiser": "sgd", "momentum": 0.5}]


@pytest.mark.parametrize("how", HOW, ids=str)
def test_what_is_not_free_is_held_exactly(params, how):
    box = found(params, BOX, move="xz", vertices=(0, 5), start=(0.5, 0.5, 0.5))
    corners = (points(params)[:, None] == points(params)[[0, 5]]).all(axis=2).any(axis=1)
    for latents in (box.start, walk(box, **how), box.scatter(np.random.default_rng(0), 0, 0, 1)):
        change = values(box, latents)[BOX].reshape(-1, 3) != points(params)
        assert change[corners][:, [0, 2]].all()
        assert not change[~corners].any() and not change[:, 1].any()
    body = found(params, BOX, kind="pose", move="y", turn="z", start=(0.3, 0, 0, 0, 7, 0))
    for latents in (walk(body, **how), body.scatter(np.random.default_rng(0), 1, 90, 0)):
        move, turn = latents["box.move"], latents["box.turn"]
        assert move[1] != 0 and turn[2] != 0
        np.testing.assert_array_equal(move[[0, 2]], np.float32([0.3, 0]))
        np.testing.assert_array_equal(turn[:2], np.float32([0, np.radians(7)]))


RANGES = [
    (FLOOR, 0, 1, {}),
    ("torus.bsdf.reflectance.data", 0, 1, {}),
    ("box.bsdf.alpha.value", 1e-3, 1, {}),
    (LIGHT, 0, np.inf, {}),
    ("sensor.x_fov", 1, 170, {}),
    (FLOOR, 0.25, 3, {"lower": 0.25, "upper": 3.0}),
    ("torus.vertex_normals", -np.inf, np.inf, {}),
]


@pytest.mark.parametrize(("key", "low", "high", "options"), RANGES, ids=str)
def test_legal_ranges(params, key, low, high, options):
    parameter = found(params, key, kind="material", rate=50.0, **options)
    np.testing.assert_array_equal(parameter.truth[key], np.array(params[key]).ravel())
    for slope, end in ((1, low), (-1, high)):
        latent = walk(parameter, slope=slope)[key]
        assert latent.shape == parameter.truth[key].shape
        if np.isfinite(end):
            np.testing.assert_array_equal(latent, np.float32(end))
        else:
            assert (np.abs(latent) > 100).all()
    wide = parameter.scatter(np.random.default_rng(0), 0, 0, 300)[key]
    assert wide.min() >= np.float32(low) and wide.max() <= np.float32(high)
    shown = values(parameter, {key: wide})[key]
    assert shown.shape == free_parameters.to_numpy(params[key]).shape
    np.testing.assert_array_equal(shown.ravel(), wide)


@pytest.mark.parametrize(
    ("key", "high"),
    [
        ("weight.emitter.radiance.value", np.inf),
        ("scale.bsdf.reflectance.color0.value", 1),
        ("lamp.weight.intensity.value", np.inf),
    ],
)
def test_names_of_objects_say_nothing_about_ranges(key, high):
    parameter = free_parameters.Values(key, Free(key=(key,), kind="light"), key, mi.Color3f(0.5))
    assert (parameter.low, parameter.high) == (0, high)


def test_directions_stay_of_unit_length(params):
    key = "torus.vertex_normals"
    normals = found(params, key, rate=0.2, unit_length=True, start=(3.0,))
    for latents in (normals.start, walk(normals), normals.scatter(np.random.default_rng(0), 0, 0, 1)):
        lengths = np.linalg.norm(values(normals, latents)[key].reshape(-1, 3), axis=1)
        np.testing.assert_allclose(lengths, 1, atol=1e-6)
    with pytest.raises(ValueError, match="length 0"):
        found(params, key, unit_length=True, start=(0.0,))


def test_vertices_that_also_move_as_a_body(params):
    """The body moves what the vertices have become. Gradients against differences of the motion, written anew."""
    entries = [Free(key=(BOX,), kind="shape"), Free(key=(BOX,), kind="pose", start=(0.1, -0.2, 0.3, 10, -50, 130))]
    box, body = free_parameters.find(entries, params)
    assert (box.name, body.name) == ("box", "box (whole)")
    rng = np.random.default_rng(0)
    latents = {
        name: np.float32(x + 0.1 * rng.standard_normal(x.size)) for p in (box, body) for name, x in p.start.items()
    }
    weights = rng.standard_normal(points(params).shape)
    weld, centre = np.array(box.weld), points(params).mean(0)

    def place(at) -> np.ndarray:
        R = Rotation.from_rotvec(at["box (whole).turn"]).as_matrix()
        return (at[BOX].reshape(-1, 3)[weld] - centre) @ R.T + centre + at["box (whole).move"]

    held = {name: mi.Float(latent) for name, latent in latents.items()}
    dr.enable_grad(held)
    moved = free_parameters.values([box, body], held)
    assert list(moved) == [BOX]
    np.testing.assert_allclose(np.array(moved[BOX]).reshape(-1, 3), place(latents), atol=1e-5)
    dr.backward(dr.sum(moved[BOX] * mi.Float(weights.astype(np.float32).ravel())))
    h = 1e-5
    for name, latent in latents.items():
        change = lambda i, name=name, latent=latent: (
            latents | {name: latent.astype(np.float64) + h * np.eye(latent.size)[i]}
        )
        at_rest = latents | {name: latent.astype(np.float64)}
        expected = [np.sum(weights * (place(change(i)) - place(at_rest))) / h for i in range(latent.size)]
        np.testing.assert_allclose(np.array(dr.grad(held[name])), expected, rtol=1e-3, atol=1e-3)


def test_starts_of_every_kind(params):
    shift = np.array([0.5, -1, 2])
    for start, expected in ((shift, shift), (np.tile(shift, 24), shift)):
        box = found(params, BOX, start=tuple(start))
        np.testing.assert_allclose(values(box, box.start)[BOX].reshape(-1, 3), points(params) + expected, atol=1e-6)
        np.testing.assert_array_equal(values(box, box.truth)[BOX], np.array(params[BOX]))
    for start, expected in (((0.2,), (0.2, 0.2, 0.2)), ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3)), ((), (0.8, 0.6, 0.4))):
        floor = found(params, FLOOR, start=start)
        np.testing.assert_array_equal(values(floor, floor.start)[FLOOR], np.float32(expected))
    body = found(params, BOX, kind="pose", rate=0.02, start=(1, 2, 3, 180, 0, -90))
    np.testing.assert_allclose(body.start["box.move"], [1, 2, 3])
    np.testing.assert_allclose(body.start["box.turn"], [np.pi, 0, -np.pi / 2], rtol=1e-6)
    assert body.rates() == pytest.approx({"box.move": 0.02, "box.turn": 0.02 / np.sqrt(3)})
    assert found(params, BOX, kind="pose", turn_rate=0.7).rates()["box.turn"] == 0.7


@pytest.mark.parametrize("smoothing", [1.0, 20.0])
def test_large_steps(params, smoothing):
    pytest.importorskip("cholespy")
    key = "torus.vertex_positions"
    torus = found(params, key, smoothing=smoothing, start=(0.1, 0.2, -0.3), rate=0.01)
    np.testing.assert_allclose(values(torus, torus.truth)[key], np.array(params[key]), atol=1e-5)
    np.testing.assert_allclose(
        values(torus, torus.start)[key].reshape(-1, 3), points(params, key) + np.array([0.1, 0.2, -0.3]), atol=1e-5
    )
    assert set(torus.errors(torus.truth).values()) == {0}
    # One vertex is pulled; its neighbours come along.
    optimiser = Optimiser([torus], Problem(scene=Path("a.xml"), free=(torus.free,)))
    attached, pull = optimiser.values(), np.zeros(points(params, key).size, np.float32)
    pull[0] = -1
    optimiser.step(attached, {key: pull}, 1)
    change = np.abs(values(torus, optimiser.latents())[key] - values(torus, torus.start)[key]).reshape(-1, 3)[:, 0]
    assert change[0] == change.max() > 1e-5 and change[1] > 0.3 * change[0]


def test_errors_are_distances_from_the_truth(params):
    body, camera = found(params, BOX, kind="pose"), found(params, CAMERA, kind="pose", move="")
    box, floor = found(params, BOX, start=(3, 0, 4)), found(params, FLOOR, start=(0,))
    for parameter in (body, camera, box, floor):
        assert set(parameter.errors(parameter.truth).values()) == {0}
    turn, move = np.float32([0, 0.5, 0]), np.float32([0, 3, 4])
    assert body.errors({"box.move": move, "box.turn": turn}) == pytest.approx(
        {"box: distance (scene units)": 5, "box: angle (degrees)": np.degrees(0.5)}, rel=1e-5
    )
    assert camera.errors({"sensor.move": move, "sensor.turn": 2 * np.pi + turn}).keys() == {"sensor: angle (degrees)"}
    assert list(box.errors(box.start).values()) == pytest.approx([5, 5])
    assert list(floor.errors(floor.start).values()) == pytest.approx([1])


@pytest.mark.parametrize(
    ("entries", "culprits"),
    [
        ([{"key": ("boks.vertex_positions",)}], ['"boks.vertex_positions"', "did you mean", BOX]),
        ([{"key": ("box.faces",)}], ['"box.faces"', "UInt"]),
        ([{"key": (BOX, BOX)}], [BOX, "free twice"]),
        ([{"key": (BOX,)}, {"key": (FLOOR, BOX)}], [BOX, "free twice"]),
        ([{"key": (BOX,), "kind": "pose"}, {"key": (BOX,)}], [BOX, "free twice"]),
        ([{"key": (BOX,), "kind": "pose"}] * 2, [BOX, "free twice"]),
        ([{"key": (BOX,)}, {"key": (BOX,), "kind": "pose"}, {"key": (BOX,), "kind": "pose"}], [BOX, "free twice"]),
        ([{"key": (BOX,)}, {"key": (BOX, BOX), "kind": "pose"}], [BOX, "free twice"]),
        ([{"key": (BOX,), "start": (1, 2)}], ['"box"', "3 or 72 numbers, got 2"]),
        ([{"key": (BOX,), "kind": "pose", "start": (1, 2, 3)}], ['"box"', "6 numbers, got 3"]),
        ([{"key": (FLOOR,), "start": (0.1, 0.2)}], [FLOOR, "1 or 3 numbers, got 2"]),
        ([{"key": (FLOOR,), "start": (1.5,)}], [FLOOR, "legal range 0 … 1"]),
        ([{"key": (BOX,), "vertices": (3, 24)}], ['"box"', "0 … 23", "24"]),
        ([{"key": (BOX,), "vertices": (-1,)}], ['"box"', "-1"]),
        ([{"key": (BOX,), "smoothing": 1.0, "move": "xy"}], ['"box"', "smoothing"]),
    ],
)
def test_parameters_that_cannot_be_free(params, entries, culprits):
    with pytest.raises(ValueError) as error:
        free_parameters.find([Free(**{"kind": "shape", **entry}) for entry in entries], params)
    assert "\n" not in str(error.value)
    for culprit in culprits:
        assert culprit in str(error.value)


def test_smoothing_names_the_package_that_it_needs(params, monkeypatch):
    monkeypatch.setitem(sys.modules, "cholespy", None)
    with pytest.raises(ValueError, match="pip install cholespy"):
        found(params, BOX, smoothing=1.0)
