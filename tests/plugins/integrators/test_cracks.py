"""Derivatives at T-junctions and closed cracks. Their references are in `test_derivatives.py` (`patchwork`)."""

from __future__ import annotations

import cases
import cuts
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, derivative_image


def halves(gap: float = 0.0, aligned: bool = False):
    """A sheet with one long edge, and another with two short ones at the same place."""
    grey = lambda value: {"bsdf": cases.diffuse(value, two_sided=True)}
    left = cases.mesh("left", [[0, -1, 0], [0, 1, 0], [-1, 0, 0]], [[0, 1, 2]], **grey(0.8))
    p = [[gap, -1, 0], [gap, 0, 0], [gap, 1, 0], [1 + gap, 0, 0]]
    ends = (p[::2] + p[3:], [[0, 2, 1]]) if aligned else (p, [[0, 3, 1], [1, 3, 2]])
    right = cases.mesh("right", *ends, **grey(0.2))
    return cases.scene(sensor=cases.camera((0, 0, -5)), left=left, right=right, sky=cases.constant())


def moved(scene: mi.Scene, key: str = "sensor.to_world", integrator=None, seeds: int = 4) -> np.ndarray:
    """Derivative images of the middle of the film, where the sheets meet, as they move aside."""
    integrator = integrator or mi.load_dict({"type": "direct_edge", "sppc": 0})
    motion = Motion(scene, key, direction=[1, 0, 0])
    images = [derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(seeds)]
    return np.mean(images, axis=0, dtype=np.float64)[12:20, 14:18]


@pytest.mark.parametrize(("gap", "aligned"), [(0.0, False), (3e-6, False), (1e-5, False), (3e-6, True), (1e-5, True)])
def test_the_jump_counts_once(gap, aligned):
    found, expected = np.abs(moved(halves(gap, aligned))).sum(), np.abs(moved(halves(aligned=True))).sum()
    assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("gap", "said"), [(0.0, False), (1e-5, True), (1e-3, False)])
def test_closed_cracks_are_told(gap, said):
    scene, made = halves(gap), mi.load_dict({"type": "direct_edge"})
    params = mi.traverse(scene)
    dr.enable_grad(params["left.vertex_positions"])
    params.update()
    limits = made.plan(scene).limits
    assert len(limits) == said
    if said:
        assert 'closed, which are up to 1e-05 units wide: "left" and "right"' in limits[0]


def test_what_leaves_an_edge_is_open_again():
    """Both borders of the gap jump then, against the sky behind."""
    scene, used = halves(), mi.load_dict({"type": "direct_edge", "sppc": 0})
    params, key = mi.traverse(scene), "right.vertex_positions"
    still = dr.copy(params[key])
    for gap in (0, 1e-3, 0):
        params[key] = still + dr.tile(mi.Float(gap, 0, 0), dr.width(still) // 3)
        params.update()
        found = moved(scene, integrator=used)
        assert used.search.edges.open.sum() == (7 if gap else 4)
        np.testing.assert_allclose(found, moved(scene), rtol=1e-3, atol=1e-3 * np.abs(found).max())


@pytest.mark.parametrize("name", ["direct_edge", "prb_edge"])
def test_gradients_and_frozen_functions(name):
    scene, made = cuts.patchwork(), mi.load_dict({"type": name, **({} if name == "direct_edge" else {"max_depth": 3})})
    assert_backward_is_forward(scene, made, Motion(scene, "cube.vertex_positions", direction=[1, 0.4, 0.2]))
    assert_frozen_is_unfrozen(cuts.patchwork(), made, "cube.vertex_positions")
