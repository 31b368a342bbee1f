"""Faces of coarse meshes hide light from themselves, where interpolated normals or normal maps go on being lit."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from coarse import COARSE
from random_scenes import ball

from rimlight.checks import Motion, compare, derivative_image
from rimlight.edge_sampling.geometry.meshes import is_smooth

#: The largest noise of a derivative, relative to its L1 norm.
NOISE = 0.1

DIRECT, INDIRECT = {"type": "direct_edge"}, {"type": "prb_edge", "max_depth": 3, "rr_depth": 100}


def coarse_ball(*, smooth: bool = True, bumpy: bool = False, lamp: str = "disk", wall: bool = False) -> mi.Scene:
    points, _, uv, faces = ball(6)
    turned = np.array(mi.ScalarTransform4f().rotate([1, 2, 3], 37).matrix)[:3, :3]
    bsdf = cases.diffuse(0.5)
    if bumpy:
        slopes = np.full((4, 4, 3), 0.5)
        slopes[..., 0], slopes[..., 2] = np.random.default_rng(1).uniform(0.2, 0.8, (4, 4)), 0.9
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(slopes.astype(np.float32)), "raw": True}
        bsdf = {"type": "normalmap", "normalmap": bitmap, "bsdf": bsdf, "use_shadowing_function": False}
    lamps = {
        "disk": {
            "to_world": mi.ScalarTransform4f().look_at([3, 3, -0.5], [0, 0, 0], [0, 1, 0]),
            "emitter": cases.light(20, 20, 20),
        },
        "constant": {},
    }
    things = {"ball": cases.mesh("ball", points @ turned.T, faces, normals=smooth, uv=uv, bsdf=bsdf)}
    things["lamp"] = {"type": lamp, **lamps[lamp]}
    if wall:
        things["wall"] = cases.quad(
            (-3, -1.2, -2), (6, 0, 0), (0, 0, 4), "wall", bsdf=cases.diffuse(0.8, two_sided=True)
        )
    film = cases.film(width=16, height=16, pixel_format="luminance")
    return cases.scene(sensor=cases.camera((0, 0, -5), fov=30, film=film), **things)


TURN = {"key": "ball.vertex_positions", "rotate": [3, 5, 8]}
SCENES = {
    "turns": (coarse_ball, TURN, DIRECT),
    "camera": (coarse_ball, {"key": "sensor.to_world", "direction": [1, 0, 0]}, DIRECT),
    "lamp moves": (coarse_ball, {"key": "lamp.to_world", "direction": [1, 0, 0]}, DIRECT),
    "sky": (lambda: coarse_ball(lamp="constant"), TURN, DIRECT),
    "normal map": (lambda: coarse_ball(smooth=False, bumpy=True), TURN, DIRECT),
    "indirect": (lambda: coarse_ball(wall=True), TURN, INDIRECT),
}


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_finite_differences(name):
    make, motion, integrator = SCENES[name]
    scene, integrator = make(), mi.load_dict(integrator)
    motion = Motion(scene, **motion)
    path = mi.load_dict({"type": "path", "max_depth": 3 if name == "indirect" else 2, "rr_depth": 100})
    name = f"coarse_ball_{name.replace(' ', '_')}"
    reference = cases.stored_differences(
        name, [str(motion)], scene, motion, step=4e-3, runs=16, spp=4096, integrator=path
    )
    images = [derivative_image(scene, integrator, motion, spp=192, seed=i) for i in range(16)]
    agreement = compare(np.array(images, np.float64), reference)
    print(agreement)
    assert not agreement.faults(noise=NOISE)


def test_rig_says_that_it_lacks_this():
    scene = coarse_ball()
    params = mi.traverse(scene)
    dr.enable_grad(params["ball.vertex_positions"])
    params.update()
    found = [limit for limit in mi.load_dict({"type": "rig"}).plan(scene).limits if '"ball"' in limit]
    assert len(found) == 1 and "face normals" in found[0]


@pytest.mark.parametrize("name", ["turns", "lamp moves", "indirect"])
def test_backward(name):
    """As forward."""
    make, motion, integrator = SCENES[name]
    scene, integrator = make(), mi.load_dict(integrator)
    motion = Motion(scene, **motion)
    weight = np.random.default_rng(2).uniform(size=(16, 16, 1)).astype(np.float32)
    forward = (np.array(derivative_image(scene, integrator, motion, spp=64, seed=1), np.float64) * weight).sum()
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.apply(θ)
    image = mi.render(scene, motion.params, integrator=integrator, spp=64, seed=2, seed_grad=1)
    dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
    assert np.array(dr.grad(θ))[0] == pytest.approx(forward, rel=2e-3)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("coarse_normals", "prb_edge"), ("coarse_slides", "prb_edge"), ("coarse_camera", "bdpt_edge")],
)
def test_horizons_backward(name, kind):
    """As forward; they are most of what the light that a coarse ball throws on a wall gains."""
    make, motion, *_ = COARSE[name]
    scene = make()
    integrator = mi.load_dict({"type": kind, "max_depth": 3, "sppc": 0, "sppp": 0})
    integrator.TERMS = tuple(t for t in integrator.TERMS if t.name in ("interior", "horizons from points"))
    motion, θ = Motion(scene, **motion), mi.Float(0)
    weight = np.random.default_rng(2).uniform(size=(16, 16, 3)).astype(np.float32)
    forward = (np.array(derivative_image(scene, integrator, motion, spp=16, seed=1), np.float64) * weight).sum()
    dr.enable_grad(θ)
    motion.apply(θ)
    integrator.render_backward(scene, motion.params, mi.TensorXf(weight), seed=1, spp=16)
    assert abs(forward) > 0.1
    assert np.array(dr.grad(θ))[0] == pytest.approx(forward, rel=2e-3)


@pytest.mark.parametrize("length", [1e-4, 1e4])
def test_normals_of_any_length_are_interpolated(length):
    (ball,) = (s for s in coarse_ball().shapes() if s.is_mesh())
    params = mi.traverse(ball)
    params["vertex_normals"] = length * params["vertex_normals"]
    params.update()
    assert is_smooth(ball)
