"""Light in narrow lobes: which they are, and derivatives of what they show."""

from __future__ import annotations

from dataclasses import replace

import cases
import mitsuba as mi
import numpy as np
import polished
import pytest
from both_modes import assert_backward_is_forward
from building import constant, diffuse, horizontal, light, scene
from one_derivative import assert_same_derivative

from rimlight.checks import FiniteDifferences, Motion, compare
from rimlight.edge_sampling import divided_light
from rimlight.edge_sampling.divided_light import DividedLight, NarrowLobes


def first_hit(room: mi.Scene) -> mi.SurfaceInteraction3f:
    """What the middle of the picture shows."""
    ray, _ = room.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(0.5, 0.5), mi.Point2f(0.5))
    return room.ray_intersect(ray)


@pytest.mark.parametrize("make", [polished.floor, polished.table, polished.sky])
def test_polished_surfaces_have_narrow_lobes(make):
    room = make()
    lobes, si = NarrowLobes.of(room), first_hit(room)
    turning = lobes.at(si, si.bsdf(), mi.Bool(True))
    assert 0 < turning.width[0] < divided_light.NARROW
    v, n, axis = (np.array(a).ravel() for a in (si.to_world(si.wi), si.sh_frame.n, turning.axis))
    np.testing.assert_allclose(axis, 2 * (n @ v) * n - v, atol=1e-5)


def test_width_is_twice_the_roughness():
    for alpha in (0.01, 0.1):
        room = polished.floor(polished.metal(alpha))
        si = first_hit(room)
        # It is narrower across the plane of reflection than in it.
        cosine = si.wi.z[0]
        width = NarrowLobes.of(room).at(si, si.bsdf(), mi.Bool(True)).width[0]
        assert 2 * alpha * cosine < width < 2.05 * alpha


def test_matt_surfaces_have_none():
    assert DividedLight.of(polished.floor(diffuse(0.5))) is None
    assert DividedLight.of(polished.floor(polished.metal(0.4))) is None


def test_nothing_turns_where_only_an_occluder_moves():
    """Points on lamps are as good there, and their shadows are found from the lamps, too."""
    room = polished.floor()
    floor, cube = (next(s for s in room.shapes() if s.id() == name) for name in ("floor", "cube"))
    assert DividedLight.of(room, [cube]) is None
    assert DividedLight.of(room, [floor, cube]).lobes is not None


def test_lamps_with_textures_are_held_at_their_points():
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32)), "raw": True}
    floor = horizontal((0, 0, 0), 1.5, "floor", bsdf=polished.metal(0.03))
    lamps = {
        "textured": {"type": "sphere", "emitter": {"type": "area", "radiance": picture}},
        "plain": {"type": "sphere", "emitter": light(1, 1, 1), "radius": 0.5},
    }
    room = scene(floor=floor, sky=constant(), **lamps)
    sizes = NarrowLobes.of(room).sizes
    found = {}
    for emitter in room.emitters():
        shape = emitter.get_shape()
        found["sky" if shape is None else shape.id()] = sizes.of(mi.EmitterPtr(emitter))[0]
    assert found == {"textured": 0, "plain": pytest.approx(np.pi**0.5), "sky": np.inf}
    assert NarrowLobes.of(scene(floor=floor, textured=lamps["textured"])) is None


@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        ("polished_camera", {"type": "direct_edge"}),
        ("polished_floor", {"type": "prb_edge", "max_depth": 4}),
        ("polished_wall", {"type": "bdpt_edge", "max_depth": 3}),
        ("polished_sky", {"type": "prb_edge", "max_depth": 3}),
    ],
)
def test_backward_is_forward(name, integrator):
    case = cases.case(name)
    room = case.scene()
    assert_backward_is_forward(room, mi.load_dict(integrator), Motion(room, **case.motion))


def test_paths_from_both_ends():
    """They hold the same fixed as paths from the camera."""
    case = replace(cases.case("polished_camera"), integrator=cases.bdpt_edge(2), seeds=8)
    assert not compare(case.derivatives(), FiniteDifferences.read(case.reference)).faults()


def blurred() -> mi.Scene:
    """With less noise if nothing turns."""
    return polished.floor(polished.metal(0.08))


@pytest.mark.parametrize(
    ("make", "motion", "widths"),
    [
        (blurred, polished.FLOOR_TILTS, (0.3, 1e-3)),
        (polished.table, polished.LAMP_ALONG, (0.3, 1e-3)),
        (polished.wall, polished.CAMERA_ALONG, (0.3, 1e-3)),
        (polished.environment, polished.CAMERA_TURNS, (0.3, 1e-3)),
    ],
    ids=["floor", "table", "wall", "environment"],
)
def test_any_width_gives_the_same_derivative(make, motion, widths, monkeypatch):
    assert_same_derivative(make, motion, monkeypatch, "rimlight.edge_sampling.divided_light.NARROW", widths, runs=16)
