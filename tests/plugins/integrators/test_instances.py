"""Derivatives of instances. Their references are in `test_derivatives.py`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import building
import drjit as dr
import instances
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.geometry.instances import Instances
from rimlight.edge_sampling.geometry.instances import _first_met as found_by_first_shape
from rimlight.edge_sampling.geometry.instances import _named as found_by_name
from rimlight.edge_sampling.geometry.mesh_numbers import numbers_in_groups
from rimlight.edge_sampling.geometry.meshes import number_of

INTEGRATORS = {"direct_edge": {"type": "direct_edge"}, "prb_edge": {"type": "prb_edge", "max_depth": 3}}


def forward(scene: mi.Scene, made: mi.Integrator, spp: int = 32, **motion) -> np.ndarray:
    return np.array(derivative_image(scene, made, Motion(scene, **motion), spp=spp, seed=3), float)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_gradients_are_those_of_forward_mode(name):
    scene, made = instances.stretched_ball(), mi.load_dict(INTEGRATORS[name])
    assert_backward_is_forward(scene, made, Motion(scene, "thing.to_world", rotate=[0.3, 1, 0.2]))


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize("key", ["thing.to_world", "floor.vertex_positions"])
def test_frozen_functions(name, key):
    assert_frozen_is_unfrozen(instances.stretched_ball(), mi.load_dict(INTEGRATORS[name]), key)


def assert_equal(key: str, motion: dict, *others: str, make: Callable = instances.boxes) -> None:
    """The derivative of instances is the sum of those of meshes, but for other random numbers."""
    made = mi.load_dict(INTEGRATORS["direct_edge"])
    a = forward(make(), made, 128, key=key, **motion)
    assert not made.search.geometry.others
    apart = make(apart=True)
    b = sum(forward(apart, mi.load_dict(INTEGRATORS["direct_edge"]), 128, key=k, **motion) for k in others or (key,))
    assert (a * b).sum() / (b * b).sum() == pytest.approx(1, abs=0.02)
    assert np.abs(a - b).sum() < 0.15 * np.abs(b).sum()  # noise: 0.05 to 0.12


@pytest.mark.parametrize("key", ["board.vertex_positions", "sensor.to_world", "lamp.vertex_positions"])
def test_instances_that_stand_still_equal_meshes(key):
    """In what the camera sees, and in the shadows; of reflected and stretched ones, too."""
    assert_equal(key, {"direction": [1, 0.3, 0.2]})


@pytest.mark.parametrize("key", ["sensor.to_world", "lamp.vertex_positions"])
def test_reflected_instances_with_interpolated_normals(key):
    """Their outlines are where these normals turn away: a reflection does not turn them round."""
    assert_equal(key, {"direction": [1, 0.3, 0.2]}, make=instances.reflected_ball)


@pytest.mark.parametrize("k", [1, 2])
def test_instances_that_move_equal_meshes(k):
    motion = {"rotate": [0.3, 1, 0.2], "pivot": [k - 1, 0.45, 0.3 * k]}
    assert_equal(f"box{k}.to_world", motion, *(f"box{k}{name}.vertex_positions" for name in "ab"))


@pytest.mark.parametrize("kind", ["checkerboard", "nearest", "bumpmap", "mask"])
def test_pictures_that_jump_on_instances_that_move(kind):
    """Their lines move with the instance, which stretches them."""
    motion = {"rotate": [1, 0.4, 0.7], "pivot": [0.1, 0.7, 0]}
    assert_equal("thing.to_world", motion, "thing.vertex_positions", make=partial(instances.stretched_ball, kind, 12))


def test_the_plan_names_the_instance_that_moves():
    scene = instances.boxes()
    params = mi.traverse(scene)
    place = mi.AffineTransform4f(params["box1.to_world"])
    dr.enable_grad(place)
    params["box1.to_world"] = place
    params.update()
    plan = mi.load_dict(INTEGRATORS["direct_edge"]).plan(scene)
    assert set(plan.moving) == {'"box1"'}
    assert not plan.limits


def test_lines_in_which_an_instance_cuts_through_a_mesh():
    """Of the second mesh in a group, too."""
    found = []
    for apart in (False, True):
        scene, made = instances.boxes(apart=apart), mi.load_dict(INTEGRATORS["direct_edge"])
        params = mi.traverse(scene)
        params["board.vertex_positions"] = params["board.vertex_positions"] + mi.Float([-1.1, 0.3, 1.1] * 8)
        params.update()
        forward(scene, made, 1, key="board.vertex_positions", direction=[1, 0, 0])
        found.append((made.search._lines, made.search.geometry))
    lengths = []
    for lines, geometry in found:
        lower, upper, *_ = lines.points([geometry.positions()])
        lengths.append(dr.sum(dr.norm(upper - lower))[0])
    assert found[0][0].count == found[1][0].count > 8
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-3)


@pytest.mark.parametrize("bsdf", [{"type": "conductor"}, {"type": "dielectric"}], ids=lambda b: b["type"])
def test_mirrors_that_move_are_refused(bsdf):
    group = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": bsdf}}
    thing = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = building.scene(sensor=building.camera(), group=group, thing=thing, **instances.room())
    with pytest.raises(RuntimeError, match='instances "thing" move, and are mirrors'):
        forward(scene, mi.load_dict(INTEGRATORS["direct_edge"]), 1, key="thing.to_world", direction=[1, 0, 0])


@pytest.mark.parametrize("thickness", [0, 1e-6, 1e-3])
def test_flat_instances_that_move_are_refused(thickness):
    place = mi.ScalarTransform4f().rotate([0, 1, 0.3], 40).scale([1, 1, thickness])
    group = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": building.diffuse(0.5)}}
    thing = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place}
    scene = building.scene(sensor=building.camera(), group=group, thing=thing, **instances.room())
    render = lambda: forward(
        scene, mi.load_dict(INTEGRATORS["direct_edge"]), 1, key="thing.to_world", direction=[1, 0, 0]
    )
    if thickness > 1e-4:
        assert np.abs(np.array(render())).sum() > 0
    else:
        with pytest.raises(RuntimeError, match='instances "thing" move, and are flat: their "to_world" has no inverse'):
            render()


# ---------------------- On GPUs ----------------------


def two_groups() -> mi.Scene:
    """Instances of two groups, in turn."""
    cube = lambda name: building.mesh(name, 0.2 * building.cube_vertices(), building.CUBE_FACES)
    shapes = {g: {"type": "shapegroup", f"in_{g}": cube(f"in_{g}")} for g in ("left", "right")}
    for k in range(4):
        shapes[f"box{k}"] = {"type": "instance", "group": {"type": "ref", "id": ("left", "right")[k % 2]}}
    return building.scene(sensor=building.camera(), sky=building.constant(), **shapes)


@pytest.mark.parametrize("make", [instances.boxes, two_groups])
def test_names_of_groups_tell_their_shapes(make):
    """Where Mitsuba does not tell the first shape of an instance, its description tells the group."""
    if "llvm" not in mi.variant():
        pytest.skip("on a GPU, Mitsuba does not tell the first shape")
    scene = make()
    shown = [s for s in scene.shapes() if s.class_name() == "Instance"]
    ids = lambda found: [[s.id() for s in shapes] for shapes in found]
    assert ids(found_by_name(scene, shown)) == ids(found_by_first_shape(scene, shown))
    assert all(found_by_name(scene, shown))


def test_number_of_a_shape_in_its_group():
    geometry = Instances().geometry(instances.boxes())
    numbers = numbers_in_groups(geometry).numpy()
    assert [numbers[number_of(m.inner)] for m in geometry.meshes if hasattr(m, "inner")] == [0, 1] * 3
