"""Lamps that are close to what they light: which they are, and derivatives of their light."""

from __future__ import annotations

from dataclasses import replace

import cases
import mitsuba as mi
import numpy as np
import pytest
import touching_lamps
from both_modes import assert_backward_is_forward
from building import diffuse, horizontal, light, scene
from one_derivative import assert_same_derivative
from random_scenes import ball

from rimlight.checks import FiniteDifferences, Motion, compare, derivative_image
from rimlight.edge_sampling import close_lamps
from rimlight.edge_sampling.boundaries import shading_boundary, shadow_boundary
from rimlight.edge_sampling.close_lamps import CloseLamps
from rimlight.terms.order import TERMS


@pytest.mark.parametrize("make", [touching_lamps.strip, touching_lamps.window])
def test_lamps_that_touch_what_they_light_are_close(make):
    room = make()
    lamps, (emitter,) = CloseLamps.of(room), room.emitters()
    area = emitter.get_shape().surface_area()
    radius = lamps.vicinity(mi.EmitterPtr(emitter)).radius[0]
    assert radius == pytest.approx(close_lamps.RADIUS * float(np.ravel(area)[0]) ** 0.5, rel=1e-5)


@pytest.mark.parametrize("name", ["cornell_box", "room_cube", "lit_room_light", "corner_dolly", "ball_on_floor"])
def test_lamps_in_the_middle_of_rooms_are_not(name):
    """Whose derivatives are thus what they were."""
    assert CloseLamps.of(cases.case(name).scene()) is None


def test_textured_and_smooth_lamps_are_not():
    """Their light changes as a point slides over them."""
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32)), "raw": True}
    p, _, _, f = ball(8)
    floor = {"floor": horizontal((0, -1, 0), 4, "floor", bsdf=diffuse(0.5))}
    textured = {"type": "sphere", "emitter": {"type": "area", "radiance": picture}}
    smooth = cases.mesh("lamp", np.asarray(p), f, normals=True, emitter=light(1, 1, 1))
    plain = {"type": "sphere", "emitter": light(1, 1, 1)}
    assert CloseLamps.of(scene(**floor, lamp=plain)) is not None
    assert CloseLamps.of(scene(**floor, lamp=textured)) is None
    assert CloseLamps.of(scene(**floor, lamp=smooth)) is None


@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        ("strip_wall", {"type": "direct_edge"}),
        ("window_moves", {"type": "prb_edge", "max_depth": 4}),
        ("window_camera", {"type": "bdpt_edge", "max_depth": 4}),
    ],
)
def test_backward_is_forward(name, integrator):
    case = cases.case(name)
    room = case.scene()
    assert_backward_is_forward(room, mi.load_dict(integrator), Motion(room, **case.motion))


def test_paths_from_both_ends():
    """They hold the same fixed as paths from the camera."""
    case = replace(cases.case("window_camera"), integrator=cases.bdpt_edge(4), seeds=8)
    assert not compare(case.derivatives(), FiniteDifferences.read(case.reference)).faults()


@pytest.mark.parametrize(
    ("make", "motion", "radii"),
    [
        (touching_lamps.strip, touching_lamps.LEFT_ASIDE, (1.0, 100.0)),
        (touching_lamps.window, touching_lamps.PANE_IN, (1.0, 100.0)),
        (touching_lamps.bulb, touching_lamps.BALL_ALONG, (0.3, 3.0)),
        (touching_lamps.bulb, touching_lamps.BOARD_ALONG, (0.3, 3.0)),
    ],
    ids=["strip", "window", "bulb", "board"],
)
def test_any_radius_gives_the_same_derivative(make, motion, radii, monkeypatch):
    """Points of the lamp held far from it, or nowhere."""
    assert_same_derivative(make, motion, monkeypatch, "rimlight.edge_sampling.close_lamps.RADIUS", radii)


@pytest.mark.parametrize("motion", [touching_lamps.BALL_ALONG, touching_lamps.CAMERA_ALONG], ids=["lamp", "camera"])
def test_shadows_are_the_same_from_lamps_and_from_points(motion, monkeypatch):
    """Though the light of the lamp is mostly held in its direction. What else points find is subtracted."""
    monkeypatch.setattr(close_lamps, "RADIUS", 3.0)
    room = touching_lamps.bulb()
    moves, integrator = Motion(room, **motion), mi.load_dict({"type": "direct_edge", "sppc": 0, "sppp": 0})

    def images(term, part):
        for module in (shading_boundary, shadow_boundary):
            monkeypatch.setattr(module, "share_at_first", lambda *_: mi.Float(part))
        integrator.TERMS = tuple(t for t in TERMS if t.name in ("interior", term))
        return np.array([derivative_image(room, integrator, moves, spp=256, seed=i) for i in range(12)], float)

    from_lamps = images("shadows from lights", 1.0)
    from_points = images("edges from points", 0.0) - images("edges from points", 1.0)
    both = (from_lamps.mean(0) + from_points.mean(0)) / 2
    scales = [(i * both).sum((1, 2, 3)) / (both**2).sum() for i in (from_lamps, from_points)]
    error = sum(s.var(ddof=1) / len(s) for s in scales) ** 0.5
    assert error < 0.05
    assert abs(scales[0].mean() - scales[1].mean()) < 4 * error
