"""Fits go back to a better state, but not to one whose pictures have less noise."""

from __future__ import annotations

import numpy as np
import pytest

from rimlight import scenes
from rimlight.inverse import judging
from rimlight.inverse.fitting import Fit
from rimlight.inverse.problem import Free, Problem, Stage, Target
from rimlight.inverse.renderer import Task

LAMP = "light.emitter.radiance.value"

#: With one sample per pixel, the noise of the picture is about as large as the picture.
POWER = Problem(
    scene=scenes.path("shadow_blocker"),
    define={"res": "16"},
    target=(Target(spp=4096),),
    free=(Free(key=(LAMP,), kind="light", rate=0.05),),
    stage=(Stage(iterations=40, spp=1),),
    integrator={"type": "direct_edge"},
)


@pytest.fixture(scope="module")
def states() -> tuple[Fit, dict, dict]:
    """A fit, and latents with which the lamp is right, and too dark."""
    fit = Fit(POWER)
    bright = {LAMP: fit.parameters[0].truth[LAMP]}
    return fit, bright, {LAMP: np.float32(0.85) * bright[LAMP]}


def losses(fit: Fit, latents: dict) -> float:
    values = fit.values(latents)
    return np.mean([fit.renderer.gradient(values, [Task(0, None, 1, seed)]).loss for seed in range(20)])


def test_the_variance_of_pictures_is_no_reason_to_go_back(states):
    fit, bright, dark = states
    assert losses(fit, dark) < losses(fit, bright)
    fit.optimiser.restart(bright)
    assert not judging.is_better(fit, dark)
    fit.optimiser.restart({LAMP: np.float32(0.2) * bright[LAMP]})
    assert judging.is_better(fit, bright)


def test_what_is_left_of_the_loss_does_not_depend_on_the_samples(states):
    fit, bright, dark = states
    values = [fit.values(bright), fit.values(dark)]
    for state in (0, 1):
        found = [
            [judging._loss(fit.renderer, values, 0, Task(0, None, spp, seed), state) for seed in range(24)]
            for spp in (1, 16)
        ]
        few, many = (np.mean(f) for f in found)
        error = np.hypot(*(np.std(f, ddof=1) / np.sqrt(len(f)) for f in found))
        assert abs(few - many) < 4 * error
        plain = np.mean([fit.renderer.gradient(values[state], [Task(0, None, 1, seed)]).loss for seed in range(24)])
        assert plain - many > 8 * error
