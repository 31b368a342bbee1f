"""Lines of textures that the camera sees directly: edges of the film boundary. Their references are in
`test_derivatives.py`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen
from mirrors import BOARD, checkerboard

from rimlight.checks import Motion, derivative_image


def test_gradients_are_those_of_forward_mode():
    scene = checkerboard()
    assert_backward_is_forward(scene, mi.load_dict({"type": "direct_edge"}), Motion(scene, **BOARD))


def test_frozen_functions():
    assert_frozen_is_unfrozen(checkerboard(), mi.load_dict({"type": "direct_edge"}), BOARD["key"])


def test_their_noise_is_that_of_edges():
    """The standard deviation of a run is 0.03 of the derivative. It was above 0.1 where lines were searched for."""
    scene, made = checkerboard(), mi.load_dict({"type": "direct_edge", "sppc": 0, "sppi": 0})
    motion = Motion(scene, **BOARD)
    runs = np.array([derivative_image(scene, made, motion, spp=64, seed=i) for i in range(4)], float)
    assert runs.std(0, ddof=1).sum() < 0.05 * np.abs(runs.mean(0)).sum()
