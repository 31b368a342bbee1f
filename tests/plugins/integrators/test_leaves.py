"""Derivatives of what is seen through opacity masks. Their references are in `test_derivatives.py`."""

from __future__ import annotations

import leaves
import mitsuba as mi
import pytest
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion

PRB = {"type": "prb_edge", "max_depth": 4}


@pytest.mark.parametrize("case", ["veil_cube", "leaf_moves", "leaf_shadow", "behind_veil_checkers"])
def test_gradients_are_those_of_forward_mode(case: str) -> None:
    make, motion, *_ = leaves.LEAVES[case]
    scene = make()
    assert_backward_is_forward(scene, mi.load_dict(PRB), Motion(scene, **motion))


@pytest.mark.parametrize(("case", "key"), [("leaf_shadow", "cube.vertex_positions"), ("leaf_moves", "leaf.to_world")])
def test_frozen_functions(case: str, key: str) -> None:
    assert_frozen_is_unfrozen(leaves.LEAVES[case][0](), mi.load_dict(PRB), key)
