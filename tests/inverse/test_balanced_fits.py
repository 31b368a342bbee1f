"""Fits that divide their samples among the parts of the derivative, by their noise."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from rimlight import scenes
from rimlight.inverse import balancing
from rimlight.inverse.fitting import Fit
from rimlight.inverse.problem import Free, Problem, Stage, Target
from rimlight.inverse.renderer import Task
from rimlight.loading import InputError

BLOCKER = "blocker.vertex_positions"

#: A shadow moves: all of the derivative is that of its border.
SHADOW = Problem(
    scene=scenes.path("shadow_blocker"),
    define={"res": "16"},
    target=(Target(spp=64),),
    free=(Free(key=(BLOCKER,), kind="pose", move="xz", turn="", rate=0.05, start=(0.2, 0, 0.1, 0, 0, 0)),),
    stage=(Stage(iterations=4, spp=16),),
    integrator={"type": "direct_edge"},
)


def test_samples_follow_the_noise_after_the_first_step():
    plain, balanced = Fit(SHADOW), Fit(replace(SHADOW, balance=True))
    results = [fit.run(progress=False) for fit in (plain, balanced)]
    assert plain.progress.shares == {}
    shares = balanced.progress.shares
    assert shares["shadows from lights"] == max(shares.values()) > 1 > min(shares.values())
    # Pictures have as many samples as before, and so has the first gradient: only later steps differ.
    first, second = (result.losses for result in results)
    np.testing.assert_array_equal(first[:2], second[:2])
    assert first[2] != second[2]


def test_divided_samples_give_the_same_gradient():
    fit = Fit(replace(SHADOW, balance=True))
    fit.step()
    shares = tuple(fit.progress.shares.items())
    assert shares
    values = fit.values()

    def gradients(shares) -> np.ndarray:
        of_seeds = [fit.renderer.gradient(values, [Task(0, None, 64, seed, shares=shares)]) for seed in range(12)]
        return np.array([found.gradients[BLOCKER].reshape(-1, 3).sum(0)[[0, 2]] for found in of_seeds])

    ours, theirs = gradients(shares), gradients(())
    error = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / len(ours))
    assert (np.abs(ours.mean(0) - theirs.mean(0)) < 4 * error).all()
    assert (np.abs(theirs.mean(0)) > 10 * error).all()


def test_each_stage_is_measured_anew(monkeypatch):
    stages = Stage(iterations=2, spp=16), Stage(iterations=2, resolution=8, spp=32)
    fit = Fit(replace(SHADOW, balance=True, stage=stages))
    measured, tasks = [], []
    fit.on_step(lambda _: measured.append(fit.progress.balanced))
    monkeypatch.setattr(balancing, "_shares", lambda renderer, task, *_: tasks.append(task) or (("interior", 1.0),))
    fit.run(progress=False)
    assert measured == [0, 0, 1, 1]
    assert [(task.stage, task.width, task.spp) for task in tasks] == [(0, None, 16), (1, 8, 32)]


def test_workers_divide_alike(machines):
    machines.add()
    problem = replace(SHADOW, balance=True, stage=(Stage(iterations=2, spp=16),))
    fits = [Fit(problem)]
    fits[0].run(progress=False)
    with machines.cluster(problem, 1) as cluster:
        fits.append(Fit(problem, executor=cluster))
        fits[1].run(progress=False)
    here, there = (fit.progress.shares for fit in fits)
    assert here and there == pytest.approx(here, rel=1e-3)


@pytest.mark.parametrize("type_", ["prb_edge", "bdpt_edge"])
def test_integrators_of_interreflections_divide(type_):
    fit = Fit(replace(SHADOW, balance=True, integrator={"type": type_, "max_depth": 3}, stage=(Stage(iterations=2),)))
    fit.run(progress=False)
    shares = fit.progress.shares
    assert shares["shadows from lights"] == max(shares.values()) > 1 > min(shares.values())


def test_what_has_no_influence_divides_nothing(caplog):
    hidden = Free(key=("light.emitter.radiance.value",), kind="light", rate=1e-12)
    problem = replace(SHADOW, balance=True, free=(hidden,), optimiser="sgd", stage=(Stage(iterations=2),))
    fit = Fit(problem)
    with caplog.at_level(logging.WARNING):
        fit.run(progress=False)
    assert fit.status == "finished"
    assert fit.progress.shares == {} and "the samples are not divided anew" in caplog.text


def test_integrators_that_do_not_divide_are_refused():
    with pytest.raises(InputError, match="balance: prb does not divide its samples; use direct_edge"):
        Fit(replace(SHADOW, balance=True, integrator={"type": "prb"}))
