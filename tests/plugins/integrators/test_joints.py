"""Rims that coincide, and rims that lie on other surfaces. References are in `test_derivatives.py`."""

from __future__ import annotations

import joints
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen
from invariance import Together, difference

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling import Geometry, Rims
from rimlight.edge_sampling.geometry.curves import CurveKind

INTEGRATORS = {
    "direct_edge": {"type": "direct_edge"},
    "prb_edge": {"type": "prb_edge", "max_depth": 3},
}


def found(scene: mi.Scene) -> list[set[tuple[str, str]]]:
    """Rims that coincide: kinds and names of shapes."""
    geometry = Geometry.of(scene)
    rims = Rims(geometry)
    rims.find()
    return [{(kind.name, geometry.analytic[i].id()) for kind, i in joint} for joint in rims.joints]


def test_a_can_has_two():
    joined = found(joints.can())
    assert len(joined) == 2
    assert {("BOTTOM", "wall"), ("RIM", "bottom")} in joined and {("TOP", "wall"), ("RIM", "top")} in joined


def test_of_several_two_walls_are_the_sides():
    geometry = Geometry.of(joints.stack())
    rims = Rims(geometry)
    assert rims.find()
    several = next(joint for joint in rims.joints if len(joint) == 3)
    assert [kind == CurveKind.RIM for kind, _ in several] == [False, False, True]
    assert not rims.find()  # as before


@pytest.mark.parametrize(("gap", "radius", "joined"), [(0, 0.45, 1), (1e-4, 0.45, 0), (0, 0.4501, 0), (3e-7, 0.45, 1)])
@pytest.mark.parametrize("turn", [0, 33])
def test_a_gap_is_none(gap, radius, joined, turn):
    T = mi.ScalarTransform4f
    place = T().translate([0.3, -0.2, 0.7]).rotate([0.5, 1, 0.2], turn)
    wall = {"type": "cylinder", "to_world": place @ T().scale([0.45, 0.45, 0.8])}
    lid = {"type": "disk", "to_world": place @ T().translate([0, 0, 0.8 + gap]).rotate([1, 0, 0], 180).scale(radius)}
    assert len(found(mi.load_dict({"type": "scene", "wall": wall, "lid": lid}))) == joined


def image(scene: mi.Scene, kind: str, moves: list[dict], seed: int, spp: int = 64) -> np.ndarray:
    made = mi.load_dict(INTEGRATORS[kind])
    return np.array(derivative_image(scene, made, Together.of(scene, moves), seed=seed, spp=spp), np.float64)


@pytest.mark.parametrize(("kind", "of"), [("direct_edge", "sphere"), ("prb_edge", "can")])
def test_what_nobody_sees_has_no_derivative(kind, of):
    """The rim of the disk lies on the inside of what it is shut in. (On the outline of that, by rounding, rays pass
    between both.)"""
    move = joints.slide("plate", direction=(0, 1, 0))
    assert np.abs(image(joints.shut_in(of), kind, move, 1, spp=32)).mean() < 1e-5  # 0.01, if it is not told apart


def test_what_moves_looks_as_if_all_else_did():
    scene, back = joints.can(), (-1, -0.4, -0.3)
    others = [{"key": f"{name}.vertex_positions", "direction": back} for name in ("floor", "lamp")]
    others.append({"key": "sensor.to_world", "direction": back})
    a, b = (
        np.array([image(scene, "direct_edge", moves, seed) for seed in range(first, first + 6)])
        for first, moves in ((0, joints.CAN), (6, others))
    )
    assert not difference(a, b, tolerance=0.01).faults()


@pytest.mark.parametrize("key", ["top.to_world", "sensor.to_world"])
def test_gradients_are_those_of_forward_mode(key):
    scene, made = joints.can(), mi.load_dict(INTEGRATORS["direct_edge"])
    assert_backward_is_forward(scene, made, Motion(scene, key, direction=[1, 0.4, 0.2]))


def test_frozen_functions():
    assert_frozen_is_unfrozen(joints.can(), mi.load_dict(INTEGRATORS["direct_edge"]), "sensor.to_world")


def test_rims_are_found_again_when_shapes_move():
    scene, used = joints.can(), mi.load_dict(INTEGRATORS["direct_edge"])
    params, key = mi.traverse(scene), "top.to_world"
    closed = mi.Transform4f(params[key])
    for height in (0, 0.5):
        params[key] = mi.Transform4f().translate([0, height, 0]) @ closed
        params.update()
        motion, new = Together.of(scene, joints.CAN), mi.load_dict(INTEGRATORS["direct_edge"])
        a, b = (np.array(derivative_image(scene, made, motion, spp=16, seed=1), float) for made in (used, new))
        assert len(used.search.geometry.joints) == (1 if height else 2)
        np.testing.assert_allclose(a, b, atol=1e-4 * np.abs(b).max())
