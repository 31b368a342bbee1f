"""Derivatives of what the camera sees in mirrors. Their references are in `test_derivatives.py`."""

from __future__ import annotations

import building
import drjit as dr
import mirrors
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from building import camera, diffuse, horizontal, quad
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, compare, derivative_image, finite_differences
from rimlight.transport.tracer import PathTracer

DEEP = {"type": "prb_edge", "max_depth": 4}
INTEGRATORS = {"direct_edge": {"type": "direct_edge"}, "prb_edge": DEEP}


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize(
    ("make", "key"),
    [
        (mirrors.over_mirror, "cube.vertex_positions"),
        (mirrors.over_mirror, "mirror.vertex_positions"),
        (mirrors.two_mirrors, "sensor.to_world"),
        (mirrors.glass_ball, "ball.to_world"),
        (mirrors.shadow_in_wall, "cube.vertex_positions"),
        (mirrors.shadows_of_ball, "ball.to_world"),
        (mirrors.mapped_ball, "ball.vertex_positions"),
        (mirrors.mapped_ball, "ball.bsdf.normalmap.data"),
        (mirrors.bumpy_ball, "ball.to_world"),
        (mirrors.rippled_mirror, "cube.vertex_positions"),
    ],
)
def test_gradients_are_those_of_forward_mode(name, make, key):
    scene, made = make(), mi.load_dict(INTEGRATORS[name])
    assert_backward_is_forward(
        scene, made, Motion(scene, key, direction=[1] if key.endswith("data") else [1, 0.4, 0.2])
    )


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize("make", [mirrors.over_mirror, mirrors.shadow_in_wall, mirrors.rippled_mirror])
def test_frozen_functions(name, make):
    assert_frozen_is_unfrozen(make(), mi.load_dict(INTEGRATORS[name]), "cube.vertex_positions")


@pytest.mark.parametrize("key", ["cube.vertex_positions", "mirror.vertex_positions", "sensor.to_world"])
def test_what_mirrors_throw_on_other_surfaces(key):
    """In both modes, and frozen."""
    scene, made = mirrors.mirror_throws(), mi.load_dict(INTEGRATORS["prb_edge"])
    assert_backward_is_forward(scene, made, Motion(scene, key, direction=[1, 0.4, 0.2]))
    assert_frozen_is_unfrozen(scene, made, key)


@pytest.mark.parametrize("key", ["ball.vertex_positions", "ball.bsdf.normalmap.data"])
def test_frozen_functions_with_normal_maps(key):
    assert_frozen_is_unfrozen(mirrors.mapped_ball(), mi.load_dict(INTEGRATORS["direct_edge"]), key)


@pytest.mark.parametrize(("textured", "flipped"), [(True, False), (False, True), (True, True)])
def test_texture_coordinates_and_flipped_normals_do_not_change_mirrors(textured, flipped):
    """Mitsuba's derivatives of interpolated normals know of neither."""
    derivatives = []
    for scene in (mirrors.smooth_mirror(), mirrors.smooth_mirror(textured, flipped)):
        motion = Motion(scene, "ball.vertex_positions", direction=[1, 0.3, 0.4])
        integrator = mi.load_dict({"type": "direct_edge"})
        derivatives.append(np.array(derivative_image(scene, integrator, motion, spp=64, seed=2), float))
    plain, other = derivatives
    # Without, they are 1.7 to 4 times as far apart as they are large; rounding makes up to 0.02.
    assert np.abs(other - plain).sum() < 0.05 * np.abs(plain).sum()


def test_two_textures_of_one_shape():
    """Lines of both count: finite differences of a checkerboard behind a mask of texels."""
    checkers = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": mirrors.checkers()}}
    scene = mirrors.board(type="mask", opacity=mirrors.texels(1, lowest=0.2), nested=checkers)
    motion, integrator = Motion(scene, **mirrors.BOARD), mi.load_dict(INTEGRATORS["direct_edge"])
    reference = finite_differences(scene, motion, step=2e-3, runs=8, spp=1024, max_depth=2)
    derivatives = [np.array(derivative_image(scene, integrator, motion, spp=64, seed=k), float) for k in range(8)]
    assert not compare(np.stack(derivatives), reference).faults()


def test_slopes_jump_for_texture_units_of_gpus_as_well(monkeypatch):
    """They take places within 1/256 of a texel for the other side of a line: slopes are compared farther beside it.
    (There, lines are searched for.)"""
    scene = mirrors.bumps()
    monkeypatch.setattr("rimlight.edge_sampling.geometry.texture_edges.TextureEdges.on_film", lambda *_: [])
    motion = Motion(scene, "board.to_world", rotate=[0.3, 1, 0.2])
    found = []
    for in_steps in (False, True):
        made = mi.load_dict({"type": "direct_edge", "sppi": 0, "sppc": 0})
        name = "rimlight.edge_sampling.geometry.texture_lines._in_steps"
        monkeypatch.setattr(name, lambda _, answer=in_steps: answer)
        found.append(np.array(derivative_image(scene, made, motion, spp=64, seed=1), float))
    exact, coarse = found
    # More than what sums of several threads differ by, 2e-8
    assert 1e-4 < np.abs(exact - coarse).sum() / np.abs(exact).sum() < 0.01


def test_what_a_mirror_shows_slides_with_what_looks_into_it():
    """A floor before an upright mirror, and a wall at its other end: of the points of the wall that floor points see in
    the mirror, by way of points that are held, each moves the other way as the camera goes along both."""
    mirror, wall = (
        quad((9, 0, z), (-18, 0, 0), (0, 9, 0), name, bsdf=bsdf)
        for z, name, bsdf in ((2, "mirror", {"type": "conductor"}), (-3, "wall", diffuse(0.5, two_sided=True)))
    )
    floor = horizontal((0, 0, 0), 9, "floor", bsdf=diffuse(0.5))
    scene = building.scene(sensor=camera((0, 0.5, 0), (0, 0, 0.02), fov=20), floor=floor, mirror=mirror, wall=wall)
    motion, tracer = Motion(scene, "sensor.to_world", direction=[1, 0, 0]), PathTracer(scene, mi.load_dict(DEEP))
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.apply(θ)
    sensor, sampler = scene.sensors()[0], mi.load_dict({"type": "independent"})
    sampler.seed(0, 4096)
    dr.forward(θ, dr.ADFlag.ClearEdges)
    ray, _ = sensor.sample_ray(0, 0.5, sampler.next_2d(), sampler.next_2d())
    with dr.suspend_grad():
        walk = tracer.walk(dr.detach(ray), sampler, [0])
        _, chosen = tracer.point(ray, walk, dr.ADMode.Forward)
    with dr.resume_grad():
        moved = np.array(dr.grad(chosen.leaves[0])).reshape(3, -1)
    third = np.array(chosen.active & (chosen.depth == 3))
    of = lambda v: np.array(dr.detach(v))[:, third]
    z, before = of(chosen.si.p)[2], of(chosen.log.vertex(chosen.depth, chosen.active).ray.o)[2]
    on_wall = (np.abs(z + 3) < 1e-2) & (np.abs(before - 2) < 1e-2)
    x = of(chosen.first.ray(chosen.first.pi.t))
    assert on_wall.sum() > 50
    np.testing.assert_allclose(moved[0][third][on_wall], (-5 / (2 - x[2]))[on_wall], rtol=1e-3)
