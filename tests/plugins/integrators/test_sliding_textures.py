"""Derivatives by jumps of textures in the light that other surfaces receive. Their references are in
`test_derivatives.py`."""

from __future__ import annotations

import mitsuba as mi
import pytest
import sliding_textures
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion


@pytest.mark.parametrize("case", ["checkers_throw", "checkers_beside", "leaf_turns", "lamp_slides"])
def test_gradients_are_those_of_forward_mode(case: str) -> None:
    make, motion, _, depth = sliding_textures.SLIDING[case]
    scene = make()
    assert_backward_is_forward(scene, mi.load_dict({"type": "prb_edge", "max_depth": depth}), Motion(scene, **motion))


@pytest.mark.parametrize("key", ["floor.vertex_texcoords", "shade.vertex_positions"])
def test_frozen_functions(key: str) -> None:
    make = sliding_textures.SLIDING["checkers_throw"][0]
    assert_frozen_is_unfrozen(make(), mi.load_dict({"type": "prb_edge", "max_depth": 3}), key)
