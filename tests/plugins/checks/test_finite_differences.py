"""Finite differences to one side tell whether an image has a derivative."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from building import mesh

from rimlight.checks import FiniteDifferences, Motion, finite_differences, two_sides

#: Pixels along a side of the film, and how many of them a lamp and a card before it are wide.
SIZE, WIDTH = 16, 8

#: By how many pixels the card moves.
STEP = 0.1


def scene(hides: float) -> mi.Scene:
    """A lamp behind a black card, which is so many times as large."""
    T = mi.ScalarTransform4f
    half = WIDTH / SIZE
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "orthographic",
                "to_world": T().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": T().scale([half, half, 1]),
                "bsdf": black,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1}},
            },
            "card": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 1]).scale([half * hides, half, 1]),
                "bsdf": black,
            },
        }
    )


@pytest.mark.parametrize(("hides", "left", "right"), [(1.0, WIDTH, WIDTH), (1.2, 0, 0), (0.8, 0, 0)])
def test_sides_of_what_comes_into_view(hides, left, right):
    """A card that just hides a lamp uncovers it, whichever way it goes: at its one border, or at the other."""
    it = scene(hides)
    motion = Motion(it, "card.to_world", direction=[2 / SIZE, 0, 0])
    before, after, central = (
        finite_differences(it, motion, step=STEP, runs=4, spp=256, side=side) for side in (-1, 1, 0)
    )
    # Light that comes into view, per pixel of the motion.
    assert float(before.mean[..., 0].sum()) == pytest.approx(-left, abs=0.1 * WIDTH)
    assert float(after.mean[..., 0].sum()) == pytest.approx(right, abs=0.1 * WIDTH)
    np.testing.assert_allclose((before.mean + after.mean) / 2, central.mean, atol=0.05)
    apart, noise = two_sides(before, after)
    if left:
        assert apart == pytest.approx(2, abs=0.1)
    else:
        assert apart < 0.1 + 2 * noise


def test_sides_that_cancel_are_apart():
    up = FiniteDifferences(np.ones((2, 2, 3)), np.full((2, 2, 3), 0.1), np.zeros((2, 2, 3)), {})
    down = replace(up, mean=-up.mean)
    apart, noise = two_sides(down, up)
    assert apart == 2 and noise < 0.2
    assert two_sides(up, up)[0] == 0


def test_a_direction_has_a_number_for_each_element_of_an_array():
    corners, coordinates = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0], [1, 0], [0, 1]]
    it = mi.load_dict({"type": "scene", "card": mesh("card", corners, [[0, 1, 2]], uv=coordinates)})
    motion = Motion(it, "card.vertex_texcoords", direction=range(6))
    motion.apply(2.0)
    assert np.allclose(np.array(motion.params["card.vertex_texcoords"]), np.ravel(coordinates) + 2 * np.arange(6))


def test_the_text_of_a_motion_stays_short():
    corners = np.random.default_rng(0).normal(size=(999, 3))
    it = mi.load_dict({"type": "scene", "soup": mesh("soup", corners, np.arange(999).reshape(-1, 3))})
    some = Motion(it, "soup.vertex_positions", direction=[1, 0, 0], vertices=range(500))
    assert str(some).startswith("soup.vertex_positions along (1, 0, 0), vertices 0, 1, 2")
    assert str(some).endswith("31, ... of 500") and len(str(some)) < 300
