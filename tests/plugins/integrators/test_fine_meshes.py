"""Meshes so fine that jumps lie closer to each other on the film than the rays look beside them. Each counts once."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from random_scenes import ball

from rimlight.checks import Motion, compare, derivative_image

#: The largest noise of a derivative, relative to its L1 norm.
NOISE = 0.1


def bumps() -> dict:
    """A material that depends on the tangents of each face: every edge jumps."""
    slopes = np.random.default_rng(1).uniform(0.4, 0.6, (8, 8, 3))
    slopes[..., 2] = 0.9
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(slopes.astype(np.float32)), "raw": True}
    return {"type": "normalmap", "normalmap": picture, "bsdf": cases.diffuse(0)}


def glowing_ball(rings: int, kind: str, bsdf: dict, flipped: bool = False) -> mi.Scene:
    """flipped : all faces look inwards, and Mitsuba is told to turn their normals round."""
    points, _, uv, faces = ball(rings)
    turned = np.array(mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 37).matrix)[:3, :3]
    p = 0.45 * points @ turned.T + [0.1, 0.05, 0]
    faces = faces[:, ::-1] if flipped else faces
    lamp = cases.mesh(
        "lamp", p, faces, normals=True, uv=uv, flip_normals=flipped, bsdf=bsdf, emitter=cases.light(1, 1, 1)
    )
    lens = {"aperture_radius": 0.1, "focus_distance": 5.4} if kind == "thinlens" else {}
    lens |= {} if kind == "orthographic" else {"fov": 16}
    film = cases.film(width=16, height=16, pixel_format="luminance")
    sensor = cases.camera((0, 2, -5), kind=kind, film=film, **lens)
    if kind == "orthographic":
        sensor["to_world"] = sensor["to_world"] @ mi.ScalarTransform4f().scale([0.3, 0.3, 1])
    return cases.scene(sensor=sensor, lamp=lamp)


@pytest.mark.parametrize(
    ("rings", "kind", "bumpy"),
    [
        (140, "perspective", False),
        (70, "thinlens", False),
        (98, "orthographic", True),
    ],
)
def test_outlines_count_once(rings, kind, bumpy):
    """The horizon of the normals is 10⁻⁴ of the ball from its outline, often less than the rays look aside."""
    assert_exact(f"fine_ball_{kind}", glowing_ball(rings, kind, bumps() if bumpy else cases.diffuse(0)))


@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside a smooth mesh that moves, too"])
def test_glass(beside):
    """Close to the edges of a tetrahedron of rough glass, Mitsuba's rays through it start beyond its other face."""
    corners = 0.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) + [-0.8, 0, 0]
    glass = {"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.3}
    lamp = cases.mesh("lamp", corners, [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], bsdf=glass)
    points, _, _, faces = ball(12)
    smooth = cases.mesh("ball", 0.5 * points + [0.9, 0, 0], faces, normals=True, bsdf=cases.diffuse(0.5))
    sensor = cases.camera((0, 1, -5), fov=35, film=cases.film(width=16, height=16, pixel_format="luminance"))
    assert_exact("rough_glass", cases.scene(sensor=sensor, lamp=lamp, ball=smooth, sky=cases.constant()), beside)


def rough_ball() -> mi.Scene:
    """A ball of 40,000 triangles, rough by a thousandth of its radius, above the frame: only its shadow is seen."""
    points, _, _, faces = ball(100)
    place = np.unique(np.round(points, 6), axis=0, return_inverse=True)[1].ravel()
    radius = 0.5 + 5e-4 * np.random.default_rng(1).normal(size=place.max() + 1)[place]
    return cases.scene(
        sensor=cases.camera((0, 2, -5), fov=26, film=cases.film(width=16, height=16, pixel_format="luminance")),
        ball=cases.mesh("ball", points * radius[:, None] + [0, 2, 0], faces, bsdf=cases.diffuse(0)),
        floor=cases.horizontal((0, 0, 0), 4, "floor", bsdf=cases.diffuse(0.5)),
        light=cases.horizontal(
            (0.3, 6, -0.2), 0.2, "light", down=True, bsdf=cases.diffuse(0), emitter=cases.light(50, 50, 50)
        ),
    )


def test_shadows_count_once():
    """Many silhouettes of a rough mesh are hidden by others that are closer than rays need to look aside."""
    assert_exact("rough_ball_shadow", rough_ball(), key="ball.vertex_positions")


def test_lines_that_something_hides():
    """A board passes through the side of a box, which the camera does not see, just behind its outline."""
    corners = [[-1, -1, 0], [-1, 1, 0], [0, -1, 0], [0, 1, 0], [-2e-4, -1, 1], [-2e-4, 1, 1]]
    box = cases.mesh(
        "box",
        corners,
        [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]],
        bsdf=cases.diffuse(0),
        emitter=cases.light(1, 1, 1),
    )
    board = cases.quad(
        (-0.5, -0.6, 0.2), (0, 1.2, 0.6), (1.2, 0, 0), "board", bsdf=cases.diffuse(0), emitter=cases.light(3, 3, 3)
    )
    film = cases.film(width=16, height=16, pixel_format="luminance")
    scene = cases.scene(sensor=cases.camera((0, 0, -5), (0.05, 0, 0), fov=30, film=film), box=box, board=board)
    assert_exact("hidden_line", scene, key="box.vertex_positions")


def test_flipped_normals():
    """Of a coarse ball, whose horizon is well inside of its outline."""
    assert_exact("flipped_normals", glowing_ball(6, "perspective", cases.diffuse(0), flipped=True))


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge"])
def test_light_of_coarse_lamps_backward(kind):
    """As forward: the weights of importance sampling carry the gradient both ways."""
    scene, integrator = cases.coarse_lamp(), mi.load_dict({"type": kind})
    motion = Motion(scene, **cases.LIGHT_SIDE)
    forward = np.array(derivative_image(scene, integrator, motion, spp=16, seed=1), np.float64).sum()
    params, key = mi.traverse(scene), cases.LIGHT_SIDE["key"]
    dr.enable_grad(params[key])
    params.update()
    ones = dr.full(mi.TensorXf, 1, (cases.RES, cases.RES, 3))
    integrator.render_backward(scene, params, ones, seed=1, spp=16)
    gradient = np.array(dr.grad(params[key]), np.float64).reshape(-1, 3)
    backward = (gradient * cases.LIGHT_SIDE["direction"]).sum()
    assert np.isfinite(gradient).all()
    assert backward == pytest.approx(forward, rel=2e-3)


def assert_exact(name: str, scene: mi.Scene, ball_too: bool = False, key: str = "lamp.vertex_positions") -> None:
    """Does the derivative agree with finite differences, where vertices are shifted?

    ball_too : let the vertices of the ball carry a gradient, but stand still.
    """
    if ball_too:
        params = mi.traverse(scene)
        dr.enable_grad(params["ball.vertex_positions"])
        params.update()
    motion = Motion(scene, key, direction=[1, 0.3, 0.2])
    path = mi.load_dict({"type": "path", "max_depth": 2})
    reference = cases.stored_differences(
        name, [str(motion)], scene, motion, step=2e-3, runs=16, spp=4096, integrator=path
    )
    integrator = mi.load_dict({"type": "direct_edge"})
    images = [derivative_image(scene, integrator, motion, spp=512, seed=i) for i in range(16)]
    agreement = compare(np.array(images, np.float64), reference)
    print(agreement)
    assert not agreement.faults(noise=NOISE)
