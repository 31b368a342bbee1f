"""Mitsuba makes one mesh of all those that share a material, and does not set its box: nothing may rely on that."""

from __future__ import annotations

from typing import Any

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from invariance import difference

import rimlight
from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.geometry.boxes import box_around, box_of


def room(merged: bool, **more) -> mi.Scene:
    """A cube that stands in the floor, which shares its material with a wall."""
    T = mi.ScalarTransform4f
    plane = lambda to_world: {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "ref", "id": "white"}}
    shapes = {
        "type": "scene",
        "white": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}},
        "sensor": cases.camera((0, 2.5, 5)),
        "floor": plane(T().rotate([1, 0, 0], -90).scale(4)),
        "wall": plane(T().translate([0, 0, -3]).scale(4)),
        "cube": {
            "type": "cube",
            "to_world": T().translate([0, 0.2, 0]).rotate([0.3, 1, 0.2], 30).scale(0.6),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": (0.1, 0.02, 0.02)}},
        },
    }
    return mi.load_dict(shapes | (more or {"sky": cases.constant()}), optimize=merged)


def test_boxes(variant):
    merged, apart = (room(m) for m in (True, False))
    assert len(merged.shapes()) == 2  # else, nothing is tested
    for which in (0, 1):
        sides = [(box_around(s).min, box_around(s).max)[which] for s in (merged, apart)]
        np.testing.assert_allclose(*sides, atol=1e-5)
    assert all(box_of(shape).valid() for shape in merged.shapes())


def sinking(merged: bool, runs: int) -> tuple[np.ndarray, Any]:
    """Derivatives of the cube's sinking, and the integrator. It has been used before the cube came to where it is."""
    scene, integrator = room(merged), mi.load_dict({"type": "direct_edge"})
    for height in (0, -0.02):
        Motion(scene, "cube.vertex_positions", direction=[0, 1, 0]).apply(height)
        motion = Motion(scene, "cube.vertex_positions", direction=[0, -1, 0])
        images = [derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(runs if height else 1)]
    return np.array(images, float), integrator


def test_lines_are_found_after_a_move(variant):
    """Where a rigid motion follows the first search, only what is in overlapping boxes is looked at again."""
    (merged, a), (apart, b) = (sinking(m, runs=8) for m in (True, False))
    assert a.search._lines.count == b.search._lines.count > 4
    assert not difference(merged, apart, tolerance=0.01).faults(noise=0.1)


def test_light_paths_reach_all(variant):
    """Those of `bdpt` start on a sphere around the scene, if the light is at infinity."""
    sun = {"type": "directional", "direction": [0.3, -1, -0.2], "irradiance": {"type": "rgb", "value": 3}}
    scene = room(True, sky=cases.constant(), sun=sun)
    render = lambda kind, seed: np.array(
        mi.render(scene, integrator=mi.load_dict({"type": kind, "max_depth": 3}), spp=256, seed=seed), float
    )
    ours, theirs = (np.array([render(kind, 10 * i + s) for s in range(4)]) for i, kind in enumerate(("bdpt", "path")))
    assert not difference(ours, theirs).faults(noise=0.1)


def test_light_paths_reach_all_in_frozen_functions(variant):
    """Also if the first thing that is done with a scene is recorded."""
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 3})
    render = lambda scene, seed: mi.render(scene, integrator=integrator, spp=16, seed=seed)
    scene = room(True)
    frozen = np.array(dr.freeze(render)(scene, mi.UInt32(1)))
    np.testing.assert_allclose(frozen, np.array(render(scene, 1)), rtol=1e-4)


def test_messages_tell_where_names_have_gone(variant):
    with pytest.raises(ValueError, match=r'no parameter "floor\.vertex_positions", .*did you mean .*optimize=False'):
        Motion(room(True), "floor.vertex_positions", direction=[1, 0, 0])
    with pytest.raises(ValueError, match=r'plan: .* "cubes\.vertex_positions", did you mean cube'):
        rimlight.plan(room(False), ["cubes.vertex_positions"])
