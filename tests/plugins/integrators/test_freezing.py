"""Optimisation steps as frozen functions (`dr.freeze`): recorded once, replayed with new values, equal to unfrozen."""

from __future__ import annotations

import beams
import cases
import coarse
import drjit as dr
import fine_textures
import mitsuba as mi
import numpy as np
import polished
import pytest
import random_scenes
import touching_lamps
import wires
from frozen import (
    Step,
    assert_frozen_is_unfrozen,
    assert_same,
    first_cause,
    loss_of,
    losses_and_gradients,
    moved,
    numbers,
    one_thread,
    spoil_free_memory,
)

VALUES = [
    ("two_triangles", "green.vertex_positions"),
    ("two_triangles", "red.bsdf.reflectance.value"),
    ("room", "cube.vertex_positions"),
    ("room", "light.to_world"),
    ("room", "sensor.to_world"),
    ("room", "light.emitter.radiance.value"),
    ("fisheye", "sensor.to_world"),
    ("fisheye", "sensor.fov"),
    ("batch", "sensor.left.to_world"),
    ("cube", "cube.vertex_positions"),  # with normals, under a sky: no light has a surface
    ("spot", "cube.vertex_positions"),
    ("spot", "lamp.to_world"),
    ("picture", "lamp.to_world"),
    ("picture", "sensor.to_world"),
    ("sphere", "thing.to_world"),
    ("torus", "torus.vertex_positions"),
    ("strip", "left.vertex_positions"),
    ("window", "sensor.to_world"),
    ("bulb", "ball.to_world"),
    ("polished", "floor.vertex_positions"),
    ("wires", "wires.control_points"),
    ("wires", "sensor.to_world"),
    ("fine", "sensor.to_world"),
    ("fine", "back.vertex_positions"),
]
SCENES = {
    "two_triangles": cases.two_triangles,
    "room": cases.room(),
    "cube": cases.cube(),
    "spot": cases.hard_shadow(lambda: {**cases.spot(), "intensity": 100.0}),
    "picture": beams.on_cube(lambda: {**beams.picture(), "scale": 100.0}),
    "sphere": cases.sphere_over(cases.sun, cases.ceiling_light),
    "torus": cases.torus_in_the_sun,
    "strip": touching_lamps.strip,
    "window": touching_lamps.window,
    "bulb": touching_lamps.bulb,
    "polished": polished.floor,
    "wires": wires.before_wall(wires.sun),
    "fine": fine_textures.stage(back=fine_textures.fine, film=fine_textures.gaussian),
    "fisheye": cases.room(cases.fisheye),
    "batch": cases.room(cases.batch),
}


@pytest.mark.parametrize(
    ("kind", "scene", "key"),
    [(kind, *value) for kind in ("direct_edge", "prb_edge") for value in VALUES],
    ids=lambda text: text,
)
def test_replay_sees_new_values(kind, scene, key):
    scene, integrator = SCENES[scene](), mi.load_dict({"type": kind})
    assert_frozen_is_unfrozen(scene, integrator, key)


def balls(light):
    """There is no mesh, so that no list of edges has anything in it. (Dr.Jit ends the process at an empty one.)"""
    ball = {"type": "sphere", "id": "ball", "radius": 0.7, "bsdf": cases.diffuse(0.5)}
    floor = {"type": "sphere", "center": [0, -4, 0], "radius": 3.0, "bsdf": cases.diffuse(0.5)}
    return cases.scene(sensor=cases.camera((0, 1, -4), (0, 0, 0)), ball=ball, floor=floor, light=light)


@pytest.mark.parametrize("key", ["ball.to_world", "sensor.to_world", "light.position"])
@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "bdpt_edge"])
def test_without_meshes(kind, key):
    point = {"type": "point", "position": [2, 3, -1], "intensity": 9.0}
    scene = balls(point if "light" in key else cases.constant())
    assert_frozen_is_unfrozen(scene, mi.load_dict({"type": kind}), key)


@pytest.mark.parametrize("key", ["ball.vertex_normals", "ball.vertex_positions"])
def test_horizons_from_points(key):
    assert_frozen_is_unfrozen(coarse.beside_wall()(), mi.load_dict({"type": "prb_edge", "max_depth": 3}), key)


@pytest.mark.parametrize("seed", [941643, 941650, 941656, 941662])
def test_random_scenes(seed):
    """Of sensors, Mitsuba 3.9 freezes `perspective` alone: seeds were taken that have one."""
    made = random_scenes.make(seed)
    integrator, step = mi.load_dict(made.integrator), Step()
    results = []
    with one_thread():
        for function in (step.frozen(), step):
            results.append([])
            for i in range(3):
                theta, number = dr.opaque(mi.Float, 2e-3 * i), dr.opaque(mi.UInt32, i)
                dr.enable_grad(theta)
                made.move(theta)
                spoil_free_memory()
                loss = function(made.scene, integrator, number)
                results[-1].append((loss[0], dr.grad(theta)[0]))
    frozen, unfrozen = np.array(results)
    scale = np.abs(unfrozen).max(axis=0)
    assert np.all(scale > 0) and step.calls <= 2 + len(unfrozen)
    np.testing.assert_allclose(frozen / scale, unfrozen / scale, rtol=0, atol=1e-4)


def test_first_call_may_be_frozen():
    """Nothing has been rendered before: `state_fn` finds the edges."""
    scene, integrator = cases.two_triangles(), mi.load_dict({"type": "direct_edge"})
    initial = numbers(mi.traverse(scene)["green.vertex_positions"])
    arguments = scene, integrator, "green.vertex_positions", initial
    frozen = losses_and_gradients(Step().frozen(), *arguments)
    assert_same(frozen, losses_and_gradients(Step(), *arguments))


def test_integrator_of_the_scene():
    """Arrays that the integrator holds are found through the scene, too."""
    scene = cases.scene(
        sensor=cases.camera(), cube=cases.smooth_cube(), sky=cases.constant(), integrator={"type": "direct_edge"}
    )
    key = "cube.vertex_positions"
    initial = numbers(mi.traverse(scene)[key])

    def step(scene, seed):
        loss = loss_of(mi.render(scene, mi.traverse(scene), spp=4, seed=seed))
        dr.backward(loss)
        return loss.array

    frozen = dr.freeze(step, state_fn=lambda scene, *_: scene.integrator().find_boundaries(scene))
    results = []
    for function in (frozen, step):
        adapted = lambda scene, _, seed, function=function: function(scene, seed)
        results.append(losses_and_gradients(adapted, scene, None, key, initial))
    assert_same(*results)
    assert frozen.n_recordings <= 2  # the first call makes the film's storage


def test_whole_step_of_a_material():
    """All inside: update, rendering, gradient, optimiser."""
    scene, integrator = cases.two_triangles(), mi.load_dict({"type": "direct_edge"})
    key = "red.bsdf.reflectance.value"

    def step(scene, integrator, optimiser, seed):
        params = mi.traverse(scene)
        params.update(optimiser)
        dr.backward(loss_of(mi.render(scene, params, integrator=integrator, spp=4, seed=seed)))
        optimiser.step()

    def fit(step):
        optimiser = mi.ad.Adam(lr=0.05)
        optimiser[key] = mi.Color3f(0.7, 0.3, 0.4)
        for i in range(8):
            step(scene, integrator, optimiser, dr.opaque(mi.UInt32, i))
        return dr.detach(optimiser[key]).numpy()

    expected, frozen = fit(step), dr.freeze(step)
    np.testing.assert_allclose(fit(frozen), expected, rtol=1e-5)
    assert frozen.n_recordings <= 2
    assert np.abs(expected.ravel() - [0.7, 0.3, 0.4]).max() > 0.05


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "bdpt"])
@pytest.mark.parametrize("sky", [cases.constant, cases.surroundings], ids=["constant", "envmap"])
def test_update_under_a_sky(kind, sky):
    """An update inside tells the sky how large the scene is. That number is lost in replays (Dr.Jit 1.5)."""
    floor = cases.horizontal((0, -1, 0), 3, "floor", bsdf=cases.diffuse(0.5, two_sided=True))
    scene = cases.scene(sensor=cases.camera(), floor=floor, ball={"type": "sphere", "radius": 0.6}, sky=sky())
    integrator, key = mi.load_dict({"type": kind}), "floor.bsdf.brdf_0.reflectance.value"

    def step(scene, value, seed):
        params = mi.traverse(scene)
        params[key] = value * mi.Color3f(1, 0.5, 0.8)
        params.update()
        return mi.render(scene, integrator=integrator, spp=4, seed=seed)

    frozen = dr.freeze(step)
    for i in range(4):
        arguments = scene, dr.opaque(mi.Float, 0.2 * (i + 1)), dr.opaque(mi.UInt32, 1)
        expected = np.array(step(*arguments))
        spoil_free_memory()
        np.testing.assert_allclose(np.array(frozen(*arguments)), expected, rtol=1e-4, atol=1e-5)
    assert frozen.n_recordings <= 2 and expected.std() > 0.05


def test_fit_of_a_shape():
    """The shape is updated, and the optimiser takes its steps, outside."""
    scene, integrator = cases.cube()(), mi.load_dict({"type": "direct_edge"})
    key = "cube.vertex_positions"
    initial = dr.unravel(mi.Point3f, numbers(mi.traverse(scene)[key]))

    def fit(step):
        params, optimiser = mi.traverse(scene), mi.ad.Adam(lr=0.02)
        optimiser["shift"] = mi.Vector3f(0.3, -0.2, 0.1)
        for i in range(8):
            params[key] = dr.ravel(initial + optimiser["shift"])
            params.update()
            step(scene, integrator, dr.opaque(mi.UInt32, i))
            optimiser.step()
        return dr.detach(optimiser["shift"]).numpy()

    expected, frozen = fit(Step()), Step().frozen()
    np.testing.assert_allclose(fit(frozen), expected, atol=1e-4)
    assert frozen.n_recordings == 1


def test_other_scenes_and_parameters():
    """With other scenes, or where other parameters move, the function is recorded again."""
    scenes, integrator = (cases.two_triangles(), cases.two_triangles()), mi.load_dict({"type": "direct_edge"})
    keys = "green.vertex_positions", "sensor.to_world", "red.bsdf.reflectance.value"
    initial = [{key: numbers(mi.traverse(scene)[key]) for key in keys} for scene in scenes]

    def sequence(step):
        result = []
        for i in range(6):
            which, params = i % 2, mi.traverse(scenes[i % 2])
            for k, key in enumerate(keys):
                theta = dr.opaque(mi.Float, 0.02 * i + 0.1 * which)
                if k == i // 2:
                    dr.enable_grad(theta)
                    wanted = theta
                params[key] = moved(initial[which][key], theta)
            params.update()
            loss = step(scenes[which], integrator, dr.opaque(mi.UInt32, i))
            result.append((loss[0], dr.grad(wanted)[0]))
        return np.array(result)

    expected, frozen = sequence(Step()), Step().frozen()
    np.testing.assert_allclose(sequence(frozen), expected, rtol=1e-4, atol=1e-9)
    assert frozen.n_recordings == 6


def test_all_that_is_read_is_known_to_frozen_functions():
    """Whoever adds an attribute names it in `DRJIT_STRUCT`, or here, if it is not read when sampling."""
    scene = cases.room(ball=lambda: {"type": "sphere", "radius": 0.2})()
    integrator = mi.load_dict({"type": "prb_edge"})
    dr.enable_grad(mi.traverse(scene)["cube.vertex_positions"])
    boundaries = integrator.find_boundaries(scene)
    shading, film = boundaries.shading, boundaries.film
    for part, unread in (
        (film, set()),
        (film.outlines, {"geometry", "first_vertices"}),
        (film.outlines.edges, set()),
        (boundaries.shadows, set()),
        (boundaries.shadows.lights, set()),
        (shading, {"geometry", "cut_lamps", "crossed_lamps"}),
        (shading.from_edges, set()),
        (shading.silhouettes, {"geometry"}),
        (shading.silhouettes.tree, {"geometry", "_recorded"}),
        (shading.silhouettes.curves, set()),
    ):
        assert vars(part).keys() - unread == type(part).DRJIT_STRUCT.keys(), type(part).__name__


def test_says_that_the_edges_must_be_found_before():
    scene, integrator = cases.two_triangles(), mi.load_dict({"type": "direct_edge"})
    params = mi.traverse(scene)
    key = "green.vertex_positions"
    params[key] = numbers(params[key])
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(RuntimeError) as error:
        dr.freeze(Step().__call__)(scene, integrator, dr.opaque(mi.UInt32, 0))
    cause = first_cause(error.value)
    assert "state_fn" in cause and "find_boundaries" in cause


def test_says_that_paths_need_a_limit():
    scene, integrator = cases.two_triangles(), mi.load_dict({"type": "prb_edge", "max_depth": -1})
    params = mi.traverse(scene)
    key = "green.vertex_positions"
    params[key] = numbers(params[key])
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(RuntimeError) as error:
        Step().frozen()(scene, integrator, dr.opaque(mi.UInt32, 0))
    assert 'set "max_depth" to at most' in first_cause(error.value)
