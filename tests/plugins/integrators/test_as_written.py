"""What went wrong in scenes as users write them, besides the cases of `as_written.py`."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from as_written import SLIDE, behind_hidden_lamps, checkered_board
from random_scenes import ball

from rimlight.checks import Motion, derivative_image


def ball_behind_hidden_lamps(thing: dict | mi.Mesh) -> mi.Scene:
    """Of which the camera sees no lamp, but lamps are before it, one behind the other."""
    lamp = {"emitter": cases.light(3, 2, 1)}
    return cases.scene(
        sensor=cases.camera((0, 0, -5)),
        thing=thing,
        plate=cases.quad((-0.8, -1.2, -2), (0, 1.5, 0), (1, 0, 0.2), "plate", bsdf=cases.diffuse(0.0), **lamp),
        bulb={"type": "sphere", "center": [0.3, 0.4, -1.5], "radius": 0.4, **lamp},
    )


def test_spheres_behind_hidden_lamps_look_like_meshes():
    """Mitsuba's `path` takes their points at the distance from the last of these lamps."""
    p, _, uv, faces = ball(64)
    bsdf = cases.diffuse(0.5)
    things = {"type": "sphere", "bsdf": bsdf}, cases.mesh("thing", p, faces, normals=True, uv=uv, bsdf=bsdf)
    integrator = mi.load_dict({"type": "direct_edge", "hide_emitters": True})
    scenes = [ball_behind_hidden_lamps(thing) for thing in things]
    sphere, mesh = (np.array(mi.render(s, integrator=integrator, spp=256)) for s in scenes)
    assert np.abs(sphere - mesh).mean() < 0.01 * mesh.mean()


@pytest.mark.parametrize("key", ["vertex_texcoords", "vertex_normals"])
def test_what_meshes_interpolate_changes_while_others_move(key):
    """In forward mode, Dr.Jit refused this in indirect light."""
    p, _, uv, faces = ball(6)
    scene = cases.scene(
        sensor=cases.camera(),
        thing=cases.mesh("thing", p, faces, normals=True, uv=uv, bsdf=cases.diffuse(0.5)),
        floor=cases.horizontal((0, -1, 0), 3, "floor", bsdf=cases.diffuse(0.5)),
        sky=cases.constant(),
    )
    params, integrator = mi.traverse(scene), mi.load_dict(cases.prb_edge(3))
    θ = mi.Float(0)
    dr.enable_grad(θ)
    for changing in (f"thing.{key}", "floor.vertex_positions"):
        params[changing] = params[changing] + θ
    params.update()
    dr.forward(θ, dr.ADFlag.ClearEdges)
    image = np.array(integrator.render_forward(scene, params, spp=4))
    assert np.isfinite(image).all() and image.any()


def test_texture_coordinates_in_both_modes():
    scene, integrator = checkered_board(), mi.load_dict({"type": "direct_edge"})
    motion = Motion(scene, **SLIDE)
    forward = derivative_image(scene, integrator, motion, spp=64, seed=1)
    params = motion.params
    dr.enable_grad(params[motion.key])
    params.update()
    one = dr.full(mi.TensorXf, 1, forward.shape)
    integrator.render_backward(scene, params, one, seed=1, spp=64)
    backward = np.dot(np.array(dr.grad(params[motion.key])), SLIDE["direction"])
    assert abs(backward - np.sum(forward)) < 1e-4 * np.abs(forward).sum()


def test_hidden_lamps_that_move_in_front_are_not_seen():
    """They have no outlines on the film."""
    scene = behind_hidden_lamps()
    motion = Motion(scene, "ball.to_world", direction=[1, 0, 0])
    of = lambda hides: mi.load_dict({"type": "direct_edge", "hide_emitters": hides, "sppc": 0, "sppi": 0})
    shown, hidden = (np.abs(derivative_image(scene, of(h), motion, spp=64, seed=0)).sum() for h in (False, True))
    assert hidden < 1e-4 * shown
