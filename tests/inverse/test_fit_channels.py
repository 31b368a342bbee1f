"""Fits to depth maps, masks and normals: channels of `aov_edge`."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rimlight import inverse, scenes
from rimlight.exr import write_exr
from rimlight.inverse.problem import Free, Loss, Problem, Stage, Target
from rimlight.inverse.renderer import Renderer, Task

pytestmark = pytest.mark.usefixtures("no_derivative_image")

AOVS = "d:depth, m:mask:cube, n:sh_normal, u:uv"
POSE = Free(key=("cube.vertex_positions",), kind="pose", rate=0.04, start=(0.2, -0.15, 0.1, 5, -8, 6))


def cube(channel: str | None, aovs: str = AOVS, steps: int = 120, **options) -> Problem:
    options = {"integrator": {"type": "aov_edge", "aovs": aovs}, "target": (Target(spp=256),)} | options
    return Problem(
        scene=scenes.path("cube"),
        define={"res": "32"},
        free=(POSE,),
        loss=Loss(channel=channel),
        stage=(Stage(iterations=steps, decay=0.02),),
        **options,
    )


@pytest.mark.parametrize(
    ("channel", "distance", "angle"), [("d:depth", 0.01, 0.6), ("m:mask:cube", 0.01, 0.6)], ids=["depth", "mask"]
)
def test_a_pose_is_fitted_to_one_channel_alone(channel, distance, angle):
    found = inverse.fit(cube(channel[0], channel), progress=False)
    errors = [found.errors[f"cube: {what}"] for what in ("distance (scene units)", "angle (degrees)")]
    assert errors[0][0] > 0.25 and errors[1][0] > 10
    assert errors[0][-1] < distance and errors[1][-1] < angle
    assert found.views[0].result.shape == (32, 32, 1)
    assert list(found.measures[0]) == ["root mean square error"]


def test_the_gradient_is_that_of_the_channel_alone():
    """Whichever else is rendered."""
    values = None
    for channel, alone in (("d", "d:depth"), ("u", "u:uv")):
        gradients, losses = [], []
        for aovs in (AOVS, alone):
            renderer = Renderer(cube(channel, aovs))
            values = {k: np.array(renderer.params[k], np.float32) + np.float32(0.05) for k in POSE.key}
            found = renderer.gradient(values, [Task(0, None, 16, 3, show=True)])
            gradients.append(found.gradients[POSE.key[0]])
            losses.append(found.loss)
        size = np.abs(gradients[1]).sum()
        assert size > 0 and np.abs(gradients[0] - gradients[1]).sum() < 0.02 * size
        assert losses[0] == pytest.approx(losses[1], rel=0.02)


def test_a_file_is_the_target(tmp_path):
    """Its numbers are compared as they are, though depths exceed 1."""
    posed = cube("d", steps=1)
    truth = Renderer(posed).views[0].picture()[0]
    assert truth.max() > 2 and truth.shape == (32, 32, 1)
    write_exr(tmp_path / "depth.exr", {"": truth})
    (view,) = Renderer(dataclasses.replace(posed, target=(Target(file=tmp_path / "depth.exr"),))).views
    np.testing.assert_array_equal(view.picture()[0], truth)


def test_texture_coordinates_have_a_third_channel():
    (view,) = Renderer(cube("u", "u:uv")).views
    picture = view.picture()[0]
    assert picture.shape == (32, 32, 3) and not picture[..., 2].any() and picture[..., :2].any()


@pytest.mark.parametrize(
    ("channel", "integrator", "says"),
    [
        ("d", {"type": "prb_edge"}, 'loss.channel is "d", but the integrator renders light alone; use aov_edge'),
        (None, {"type": "aov_edge", "aovs": AOVS}, "loss.channel is missing: the integrator has d, m, n, u"),
        ("x", {"type": "aov_edge", "aovs": AOVS}, 'loss.channel cannot be "x": the integrator has d, m, n, u'),
    ],
)
def test_channels_that_are_refused(channel, integrator, says):
    with pytest.raises(ValueError, match=says):
        Renderer(cube(channel, integrator=integrator))
