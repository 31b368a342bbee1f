"""Vertices that slide: what mirrors show, what is seen past edges that stand still, paths without a limit.

Finite differences are stored; ``RENEW_REFERENCES=1 python -m pytest tests/plugins/integrators/test_chains.py`` makes
them anew.
"""

import beams
import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import rooms
from building import camera, diffuse, film, horizontal, light, quad, scene

from rimlight.checks import Motion, compare, derivative_image
from rimlight.transport.log import Log

CAMERA_SIDE = {"key": "sensor.to_world", "direction": [1, 0.2, 0.3]}


def small(**options):
    return film(width=12, height=12, **options)


def derivatives(scene, motion, runs, spp, **integrator):
    it = mi.load_dict({"type": "prb_edge", **integrator})
    return np.array([derivative_image(scene, it, motion, spp=spp, seed=i) for i in range(runs)], np.float64)


def agreement(name, scene, motion, depth, *, step, runs=8, spp=64):
    path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
    expected = cases.stored_differences(
        f"chains_{name}", [str(motion)], scene, motion, step=step, runs=12, spp=4096, integrator=path
    )
    return compare(derivatives(scene, motion, runs, spp, max_depth=depth), expected)


def test_what_a_mirror_shows_slides():
    """A mirror fills the frame, and shows a wall that is lit by a lamp, and whose light is not its own."""
    texels = np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "bilinear"}
    s = scene(
        sensor=camera((0, 1.5, -3), (0, 0, 0), fov=25, film=small()),
        mirror=horizontal((0, 0, 0), 2, "mirror", bsdf={"type": "conductor"}),
        wall={
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 1, 3]).rotate([0, 1, 0], 180).scale(8),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": picture}},
        },
        lamp=horizontal((0, 6, 0), 1.5, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(20, 20, 20)),
    )
    found = agreement("mirror", s, Motion(s, **CAMERA_SIDE), 3, step=2e-2)
    print(found)
    assert not found.zero and not found.faults(noise=0.1), str(found)


def test_what_moves_past_an_edge_that_stands_still():
    """A floor is lit by a wall, past the edge of a screen. Only the wall moves, along itself: its own edges are far
    away, and its colour changes along it."""
    colours = mi.Bitmap(np.array([[[0.1] * 3, [0.9] * 3, [0.1] * 3, [0.9] * 3]], np.float32))
    picture = {"type": "bitmap", "bitmap": colours, "raw": True, "filter_type": "bilinear"}
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 2.5, 3]).scale([6, 2.5, 1]),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": picture}},
    }
    s = scene(
        sensor=camera((0, 2.5, -2.5), (0, 0, 0), fov=35, film=small()),
        floor=horizontal((0, 0, 0), 1.2, "floor", bsdf=diffuse(0.8)),
        screen=quad((-0.8, 0, 1.3), (1.6, 0, 0), (0, 1.2, 0), "screen", bsdf=diffuse(0.0)),
        wall=wall,
        lamp=quad((-2, 4, 2), (4, 0, 0), (0, 1, 0), "lamp", bsdf=diffuse(0.0), emitter=light(12, 12, 12)),
    )
    found = agreement("wall", s, Motion(s, key="wall.to_world", direction=[1, 0, 0]), 3, step=5e-2, spp=2048)
    print(found)
    assert not found.zero and not found.faults(noise=0.25), str(found)


@pytest.mark.parametrize("case", ["corner_dolly", "sun_through_window", "hidden_picture"])
def test_forward_equals_backward(case):
    build, motion, *_ = (rooms.ROOMS | beams.BEAMS)[case]
    s = build()
    motion = Motion(s, **motion)
    it = mi.load_dict({"type": "prb_edge", "max_depth": -1, "rr_depth": 3})
    forward = np.array(derivative_image(s, it, motion, spp=4, seed=3))
    weights = np.random.default_rng(0).normal(size=forward.shape).astype(np.float32)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.apply(θ)
    image = mi.render(s, motion.params, integrator=it, spp=4, seed=4, seed_grad=3)
    dr.backward(dr.sum((image * mi.TensorXf(weights)).array))
    assert abs(dr.grad(θ)[0] - (weights * forward).sum()) < 1e-5 * np.abs(weights * forward).sum()


def test_tables_that_are_too_large_are_refused():
    ray = dr.zeros(mi.Ray3f, 4)
    with pytest.raises(RuntimeError, match="use fewer samples per pixel"):
        Log(rooms.corner(), ray, 2, 2**30)


def test_a_ball_on_a_floor():
    """Just inside of its outline, its own light counts close by."""
    s = scene(
        sensor=camera((0.4, 1.0, -2.2), (0, 0.3, 0), fov=35, film=small()),
        floor=horizontal((0, 0, 0), 1.5, "floor", bsdf=diffuse(0.8)),
        thing={"type": "sphere", "center": [0, 0.4, 0], "radius": 0.4, "bsdf": diffuse(0.8, 0.4, 0.2)},
        lamp=horizontal((-1.2, 2, -1), 0.4, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(20, 20, 20)),
    )
    found = agreement("ball", s, Motion(s, key="thing.to_world", direction=[1, 0, 0.3]), 4, step=5e-3, spp=256)
    print(found)
    assert not found.zero and not found.faults(noise=0.1), str(found)
