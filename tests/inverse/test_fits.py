"""The loop of a fit: that it converges, and how it ends; checkpoints; other processes; the command line."""

from __future__ import annotations

import dataclasses
import itertools
import json
import logging
import os
import signal
import threading
import time
from collections.abc import Iterator

import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes
from rimlight.inverse import batches, executors, fitting, result
from rimlight.inverse.problem import Free, Problem, Stage, Starts, Target
from rimlight.inverse.renderer import Gradient
from rimlight.inverse.result import Result

pytestmark = pytest.mark.usefixtures("no_derivative_image")

GREEN, RED, COLOUR = "green.vertex_positions", "red.vertex_positions", "green.bsdf.reflectance.value"
SHAPE = Free(key=(GREEN,), kind="shape", move="xy", rate=0.05, start=(0.2, -0.1, 0))
MATERIAL = Free(key=(COLOUR,), kind="material", rate=0.02)


def triangles(*free: Free, steps: int = 12, **options) -> Problem:
    options = {"stage": (Stage(iterations=steps),), "integrator": {"type": "direct_edge"}} | options
    options = {"target": (Target(spp=256),), "define": {"res": "32"}} | options
    return Problem(scene=scenes.path("two_triangles"), free=free or (SHAPE,), **options)


def fit(problem: Problem, executor: Valley | None = None, **options) -> Result:
    run = fitting.Fit(problem, **options)
    if executor is not None:
        executor.here, run.executor = run.executor, executor
    return run.run(progress=False)


class Valley:
    """An executor that renders nothing in steps: a function of the colour of the green triangle and its derivative, and
    what happens at some steps."""

    def __init__(self, at: dict | None = None, slope=lambda c: (np.sum((c - 0.6) ** 2), 2 * (c - 0.6))):
        self.at, self.slope, self.calls, self.seen = at or {}, slope, 0, []

    def gradient(self, values, tasks):
        self.calls += 1
        self.seen.append(values[COLOUR].copy())
        happens = self.at.get(self.calls, lambda loss, gradient: (loss, gradient))
        loss, gradient = happens(*self.slope(values[COLOUR]))
        of_tasks = lambda value: {task.key: value for task in tasks}
        return Gradient({COLOUR: np.float32(gradient)}, of_tasks(float(loss)), of_tasks({}))

    def map(self, function, shared, calls):
        return self.here.map(function, shared, calls)


def error_of(found: Result, label: str) -> np.ndarray:
    (errors,) = (errors for name, errors in found.errors.items() if label in name)
    return errors


# ------------------------------------------------------------------ the loop


def test_a_fit_converges(capfd):
    found = fit(triangles(stage=(Stage(iterations=60, decay=0.05),)))
    assert found.status == "finished" and found.silent == [] and found.skipped == 0
    assert len(found.losses) == len(found.segments) == 60 and len(error_of(found, "farthest")) == 61
    assert error_of(found, "farthest")[0] == pytest.approx(np.hypot(0.2, 0.1), rel=1e-5)
    assert error_of(found, "farthest")[-1] < 0.02
    assert found.losses[-10:].mean() < 0.1 * found.losses[0]
    (view,), (measures,) = found.views, found.measures
    assert view.start.shape == view.result.shape == view.target.shape == (32, 32, 3)
    difference = lambda image: np.sqrt(np.mean((image - view.target) ** 2))
    before, after = measures["root mean square error"]
    assert (before, after) == pytest.approx((difference(view.start), difference(view.result)), rel=1e-4)
    assert after < 0.4 * before
    np.testing.assert_array_equal(found.values[GREEN].reshape(-1, 3)[:, 2], 0)
    steps = [step for step, _ in found.frames]
    assert steps[0] == 0 and steps[-1] == 60 and steps == sorted(set(steps)) and len(steps) <= fitting.FRAMES + 1
    assert json.loads(result.summary(found))["steps"] == 60
    assert capfd.readouterr().err == ""  # no bar


def test_stages_have_resolutions_and_rates():
    seen = []
    posed = triangles(
        stage=(Stage(iterations=5, resolution=8, rate=2), Stage(iterations=4, spp=2, rate=0.5, decay=0.01))
    )
    run = fitting.Fit(posed)

    class Seen(executors.Here):
        def gradient(self, values, tasks):
            seen.append((tasks[0].width, tasks[0].spp, tasks[0].seed, values[GREEN].copy()))
            return super().gradient(values, tasks)

    run.executor = Seen(run.renderer)
    found = run.run(progress=False)
    assert [s[:2] for s in seen] == 5 * [(8, 4)] + 4 * [(None, 2)]
    assert len({s[2] for s in seen}) == 9
    moved = [np.abs(b[3] - a[3]).max() for a, b in itertools.pairwise(seen)]
    assert moved[0] == pytest.approx(2 * 0.05, rel=1e-3)  # the first steps of adam are as long as its rate
    assert max(moved[5:]) < 0.5 * 0.05 * 1.5 and moved[7] < 0.2 * moved[5]
    np.testing.assert_array_equal(found.segments, 5 * [0] + 4 * [1])
    assert found.views[0].result.shape == (32, 32, 3)


def test_steps_of_a_few_views():
    """Drawn at random, one of each group of neighbours; the same when they are drawn again."""
    posed = triangles(MATERIAL, target=tuple(Target(spp=4) for _ in range(10)), views_per_step=4, steps=3)
    drawn = np.array([batches.views(posed, step) for step in range(4000)])
    assert (np.diff(drawn, axis=1) >= 0).all()
    shares = np.bincount(drawn.ravel(), minlength=10) / drawn.size
    np.testing.assert_allclose(shares, 0.1, atol=0.005)  # of 16,000 draws, 0.0024 is one standard error
    assert batches.views(posed, 7) == batches.views(posed, 7) and len({tuple(row) for row in drawn}) > 50
    found = fit(posed)
    assert found.status == "finished" and len(found.views) == 10
    np.testing.assert_array_equal(fit(posed).losses.round(6), found.losses.round(6))
    with pytest.raises(ValueError, match="views_per_step is 11, but there are only 10 targets"):
        dataclasses.replace(posed, views_per_step=11)


def test_the_scene_is_left_at_the_result():
    run = fitting.Fit(triangles(SHAPE, dataclasses.replace(MATERIAL, start=(0.2,))))
    found = run.run(progress=False)
    params = mi.traverse(run.renderer.views[0].scene)
    np.testing.assert_array_equal(np.array(params[GREEN]), found.values[GREEN])
    np.testing.assert_array_equal(np.array(params[COLOUR]).ravel(), found.values[COLOUR])
    np.testing.assert_array_equal(found.latents[COLOUR], found.values[COLOUR])
    np.testing.assert_array_equal(found.start[COLOUR], np.float32([0.2, 0.2, 0.2]))


@pytest.mark.parametrize("stages", [1, 2])
def test_several_starts_find_what_one_does_not(stages):
    """A triangle that is turned by half a circle is stuck."""
    turned = Free(key=(GREEN,), kind="pose", move="", turn="z", turn_rate=0.1, start=(0, 0, 0, 0, 0, 180))
    posed = triangles(turned, stage=stages * (Stage(iterations=25, decay=0.3),), target=(Target(spp=64),))
    alone = fit(posed)
    several = fit(dataclasses.replace(posed, starts=Starts(count=5, turn=90)))
    assert error_of(alone, "angle")[-1] > 45
    assert error_of(several, "angle")[-1] < 5
    assert len(several.losses) == 25 * (5 + stages - 1)


def test_a_start_without_a_loss_is_not_the_best():
    starts = Starts(count=3, value=0.2)
    nan = lambda loss, gradient: (np.nan, gradient)
    posed = triangles(MATERIAL, stage=(Stage(iterations=3), Stage(iterations=2)), starts=starts)
    executor = Valley({3: nan})
    fit(posed, executor=executor)
    best = min(executor.seen[5], executor.seen[8], key=lambda c: executor.slope(c)[0])  # before the last steps
    assert np.abs(executor.seen[9] - best).max() < 0.05
    assert np.abs(executor.seen[9] - executor.seen[2]).max() > 0.05


def test_interrupted_among_several_starts():
    """The best start so far is the result."""
    starts = Starts(count=3, value=0.3)
    interrupt = lambda *result: (os.kill(os.getpid(), signal.SIGINT), result)[1]
    posed = triangles(MATERIAL, stage=(Stage(iterations=12),), starts=starts)
    executor = Valley({30: interrupt})
    found = fit(posed, executor=executor)
    assert found.status == "interrupted"
    now = executor.slope(found.values[COLOUR])[0]
    assert now <= 1.01 * min(executor.slope(executor.seen[i])[0] for i in (11, 23, 29))


def test_the_best_state_is_restored():
    """After half of the steps, the gradients lead astray."""
    uphill = lambda loss, gradient: (loss, np.full(3, 1.0))
    executor = Valley({i: uphill for i in range(41, 81)})
    found = fit(triangles(MATERIAL, steps=80), executor=executor)
    means = [found.losses[i - 9 : i + 1].mean() for i in range(9, 80)]
    best = 9 + int(np.argmin(means))
    assert 30 < best < 60
    np.testing.assert_array_equal(found.values[COLOUR], executor.seen[best])


def test_a_fit_that_is_stopped_at_its_last_step_is_finished_but_for_its_status():
    found = []
    for stops in (False, True):
        run = fitting.Fit(triangles(MATERIAL, steps=30))
        executor = Valley({i: lambda loss, gradient: (loss, np.full(3, 1.0)) for i in range(16, 31)})
        executor.here, run.executor = run.executor, executor
        run.on_step(lambda step, run=run, stops=stops: run.stop() if stops and step.number == 29 else None)
        found.append(run.run(progress=False))
    assert [result.status for result in found] == ["finished", "stopped"]
    assert all(len(result.losses) == 30 for result in found)
    np.testing.assert_array_equal(*(result.values[COLOUR] for result in found))


def test_noise_of_the_loss_does_not_choose_the_result():
    rng = np.random.default_rng(4)
    noisy = lambda loss, gradient: (loss + 1 + 0.1 * rng.standard_normal(), gradient)
    executor = Valley({i: noisy for i in range(1, 81)})
    found = fit(triangles(MATERIAL, steps=80), executor=executor)
    means = [found.losses[i - 9 : i + 1].mean() for i in range(9, 80)]
    assert np.argmin(means) < 70
    assert np.abs(found.values[COLOUR] - executor.seen[-1]).max() < 0.021  # a step from there


def test_log_for_tensorboard(tmp_path):
    pytest.importorskip("tensorboardX")
    fit(triangles(MATERIAL, steps=3), executor=Valley(), out=tmp_path, tensorboard=True)
    (file,) = tmp_path.glob("events.out.tfevents.*")
    assert b"loss" in file.read_bytes()
    with pytest.raises(ValueError, match="name a folder"):
        fit(triangles(MATERIAL), executor=Valley(), tensorboard=True)


def test_patience_ends_a_stage():
    flat = lambda c: (1.0, np.full(3, 1e-3))
    stage = Stage(iterations=500)
    found = fit(triangles(MATERIAL, patience=7, stage=(stage, stage)), executor=Valley(slope=flat))
    assert found.status == "finished" and set(found.segments) == {0, 1}
    assert 2 * (7 + fitting.WINDOW) <= len(found.losses) <= 2 * (7 + 2 * fitting.WINDOW)
    downhill = lambda c: (float(10 * np.sum(c)), np.full(3, 10.0))
    falls = fit(triangles(MATERIAL, patience=7, steps=30), executor=Valley(slope=downhill))
    assert len(falls.losses) == 30


def test_a_fit_ends_in_time():
    pause = {i: lambda *result: (threading.Event().wait(0.1), result)[1] for i in range(1, 1000)}
    found = fit(triangles(MATERIAL, steps=1000, seconds=0.5), executor=Valley(pause))
    assert found.status == "out of time"
    assert len(found.losses) <= 6 and found.seconds >= 0.5


@pytest.mark.parametrize(
    "broken",
    [lambda loss, g: (loss, np.nan * g), lambda loss, g: (np.inf, g), lambda loss, g: (np.nan, g * [1, np.nan, 1])],
    ids=["gradient", "loss", "both"],
)
def test_gradients_that_are_not_finite_are_left_out(broken):
    executor = Valley({4: broken, 7: broken, 8: broken})
    found = fit(triangles(MATERIAL, steps=12, max_bad=3), executor=executor)
    assert found.status == "finished" and found.skipped == 3 and len(found.losses) == 12
    assert [i for i in range(1, 12) if np.array_equal(executor.seen[i - 1], executor.seen[i])] == [4, 7, 8]
    assert np.isfinite(found.values[COLOUR]).all()
    gives_up = fit(triangles(MATERIAL, steps=40, max_bad=3), executor=Valley({i: broken for i in range(15, 40)}))
    assert gives_up.status == "gave up: 3 steps in a row led to numbers that are not finite"
    assert len(gives_up.losses) == 17 and gives_up.skipped == 3
    assert np.isfinite(gives_up.values[COLOUR]).all()


def test_parameters_without_influence_are_named(caplog):
    behind = Free(key=("light.bsdf.reflectance.value",), kind="material")
    with caplog.at_level(logging.WARNING, logger=fitting.__name__):
        found = fit(triangles(SHAPE, behind))
    assert found.silent == [behind.key[0]]
    (record,) = caplog.records
    assert f'"{behind.key[0]}" has no influence' in record.getMessage()
    np.testing.assert_array_equal(found.values[behind.key[0]], 0)


def test_clipped_gradients():
    """One gradient that is a thousand times too long."""
    spike = {12: lambda loss, gradient: (loss, 1000 * gradient)}
    slope = lambda c: (float(np.sum(c)), np.full(3, 1e-3))
    steps = {}
    for clip in (None, 2.0):
        posed = triangles(dataclasses.replace(MATERIAL, rate=1.0), steps=16, optimiser="sgd", momentum=0, clip=clip)
        executor = Valley(spike, slope)
        fit(posed, executor=executor)
        steps[clip] = -np.diff([c[1] for c in executor.seen])
    usual = np.delete(steps[None], 11)
    np.testing.assert_allclose(usual[:11], 1e-3, rtol=1e-3)
    assert steps[None][11] > 0.5
    np.testing.assert_allclose(steps[2.0], np.where(np.arange(15) == 11, 2e-3, 1e-3), rtol=1e-3)


def test_sgd_has_momentum():
    executor = Valley(slope=lambda c: (1.0, np.full(3, 0.01)))
    fit(triangles(dataclasses.replace(MATERIAL, rate=0.5), optimiser="sgd", momentum=0.5), executor=executor)
    moved = -np.diff([c[0] for c in executor.seen])[:4]
    np.testing.assert_allclose(moved, 0.005 * np.cumsum(0.5 ** np.arange(4)), rtol=1e-3)


@pytest.fixture
def ctrl_c_interrupts() -> Iterator[None]:
    """Shells start what they run in the background with this signal ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_interruption(caplog, ctrl_c_interrupts):
    interrupt = lambda *result: (os.kill(os.getpid(), signal.SIGINT), result)[1]
    before = signal.getsignal(signal.SIGINT)
    found = fit(triangles(MATERIAL, steps=1000), executor=Valley({15: interrupt}))
    assert found.status == "interrupted" and len(found.losses) == 15 and len(found.views) == 1
    assert signal.getsignal(signal.SIGINT) is before

    def twice(*result):
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.5)  # the signal may be delivered to another thread, and two at once count as one
        raise AssertionError("went on")

    with pytest.raises(KeyboardInterrupt):
        fit(triangles(MATERIAL), executor=Valley({3: twice}))
    assert signal.getsignal(signal.SIGINT) is before


def test_fits_in_other_threads(capfd):
    """Where Python does not allow to listen to signals."""
    found = []
    thread = threading.Thread(target=lambda: found.append(fit(triangles(MATERIAL, steps=3), executor=Valley())))
    thread.start()
    thread.join()
    assert found[0].status == "finished"
