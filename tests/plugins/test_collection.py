"""The guard against the garbage collector, `rimlight.no_collection`, and what Dr.Jit does without it."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import weakref

import cases
import drjit as dr
import garbage
import mitsuba as mi
import numpy as np
import pytest

import rimlight
from rimlight import _collection
from rimlight.checks import Motion, derivative_image, finite_differences

KEY = "cube0.vertex_positions"


@pytest.fixture(autouse=True)
def collector():
    """As Python has it at its start, before and after each test."""
    thresholds = gc.get_threshold()
    yield
    gc.set_threshold(*thresholds)
    gc.enable()
    gc.unfreeze()
    assert not _collection._collector.guards


# ---------------------- The guard by itself ----------------------


def test_off_within_and_as_before_after():
    with rimlight.no_collection():
        assert not gc.isenabled()
        with rimlight.no_collection():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    with rimlight.no_collection():
        pass
    assert not gc.isenabled()


def test_on_again_after_an_exception():
    with pytest.raises(KeyError), rimlight.no_collection(), rimlight.no_collection():
        raise KeyError
    assert gc.isenabled()


def test_as_a_decorator():
    @rimlight.no_collection()
    def function(value, *, again):
        """Text."""
        return gc.isenabled(), value, function(value, again=False) if again else None

    assert function(1, again=True) == (False, 1, (False, 1, None))
    assert function.__doc__ == "Text."
    assert gc.isenabled()


def test_off_until_the_last_thread_has_left():
    inside, leave = threading.Event(), threading.Event()

    def other():
        with rimlight.no_collection():
            inside.set()
            leave.wait(60)

    thread = threading.Thread(target=other)
    with rimlight.no_collection():
        thread.start()
        inside.wait(60)
    assert not gc.isenabled()
    leave.set()
    thread.join(60)
    assert gc.isenabled()


def test_threads_that_mix_are_told_once(monkeypatch):
    """Dr.Jit mixes what they differentiate."""
    monkeypatch.setattr(_collection._collector, "told", False)

    def guarded():
        with rimlight.no_collection():
            pass

    with cases.messages() as said, rimlight.no_collection():
        guarded()
        assert not said
        for _ in range(2):
            thread = threading.Thread(target=guarded)
            thread.start()
            thread.join(60)
    assert len(said) == 1 and "two threads differentiate at the same time" in said[0]


def test_garbage_of_a_loop_is_collected_between_its_steps():
    """Without a call of the collector, and if nothing happens between the steps."""
    found, most = [], 0
    gc.set_threshold(100, 5, 5)
    for _ in range(2000):
        with rimlight.no_collection():
            found.append(weakref.ref(garbage.Garbage()))
            found = [r for r in found if r() is not None]
            most = max(most, len(found))
    assert most < 500


def test_nothing_pending_is_carried_in_or_out():
    """Neither what was scheduled, nor side effects."""
    target, scheduled = dr.zeros(mi.Float, 3), mi.Float(1, 2, 3) + 1
    dr.scatter_add(target, mi.Float(1, 1, 1), dr.arange(mi.UInt32, 3))
    dr.schedule(scheduled)
    with rimlight.no_collection():
        assert scheduled.state == dr.VarState.Evaluated and target.state == dr.VarState.Evaluated
        inside = mi.Float(1, 2, 3) + 2
        dr.schedule(inside)
    assert inside.state == dr.VarState.Evaluated


def test_within_a_recorded_loop():
    """Where nothing can be evaluated."""

    @rimlight.no_collection()
    def body(i):
        return (i + 1,)

    assert np.all(np.array(dr.while_loop((dr.opaque(mi.UInt32, 0, 3),), lambda i: i < 5, body)[0]) == 5)


@pytest.mark.parametrize(("variant", "stays"), [("cuda_ad_rgb", False), ("llvm_ad_rgb", True), (None, True)])
def test_no_program_for_a_gpu_spills_to_shared_memory(monkeypatch, variant, stays):
    """NVIDIA's assembler refuses that in programs with function calls, and Dr.Jit ends the process."""
    spills = lambda: dr.flag(dr.JitFlag.SpillToSharedMemory)
    assert spills()
    monkeypatch.setattr(mi, "variant", lambda: variant)
    with rimlight.no_collection():
        assert spills() == stays
    assert spills()


def test_costs_microseconds():
    """The collection that it replaces takes tens of milliseconds."""
    import timeit

    guarded = rimlight.no_collection()(lambda: None)
    assert min(timeit.repeat(guarded, number=1000, repeat=5)) / 1000 < 100e-6


# ---------------------- Where it is ----------------------


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "rig"])
def test_integrators_trace_and_evaluate_within(kind, monkeypatch):
    """Whoever calls them, and although Mitsuba takes the image unevaluated."""
    scene, integrator = garbage.scene(1), mi.load_dict({"type": kind, "max_depth": 2})
    # Not by its name: each variant has one of its own.
    base = next(c for c in type(integrator).__mro__ if c.__name__ == "ADIntegrator")
    seen, sample_rays = [], base.sample_rays
    monkeypatch.setattr(base, "sample_rays", lambda *a: (seen.append(gc.isenabled()), sample_rays(*a))[1])
    for forward in (True, False):
        garbage.derivative(scene, integrator, forward, seed=0)
    derivative_image(scene, integrator, Motion(scene, KEY, direction=[1, 0, 0]), spp=1)
    assert len(seen) >= 4 and not any(seen)
    assert gc.isenabled()


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "rig"])
def test_integrators_leave_no_virtual_calls_behind(kind):
    """What is left of an image or a derivative has no more than the division by the weights of the filter."""
    scene, integrator = garbage.scene(1), mi.load_dict({"type": kind, "max_depth": 2})
    params = mi.traverse(scene)
    values = mi.Float(np.array(params[KEY]).tolist())
    dr.enable_grad(values)
    params[KEY] = values
    params.update()
    grad_in = dr.full(mi.TensorXf, 1, np.array(integrator.render(scene, spp=1)).shape)

    def kernels(work):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            left = work()
            dr.kernel_history_clear()
            dr.eval(left, dr.grad(values))
            return [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]

    def forward():
        dr.set_grad(values, 1.0)
        return integrator.render_forward(scene, params, spp=1)

    for work in (
        lambda: integrator.render(scene, spp=1),
        forward,
        lambda: integrator.render_backward(scene, params, grad_in, spp=1),
    ):
        assert all(k["operation_count"] < 50 for k in kernels(work))


def test_references_trace_within(monkeypatch):
    seen = []
    scene = garbage.scene(1)
    film = type(scene.sensors()[0].film())
    develop = film.develop
    monkeypatch.setattr(film, "develop", lambda *a: (seen.append(gc.isenabled()), develop(*a))[1])
    finite_differences(scene, Motion(scene, KEY, direction=[1, 0, 0]), step=0.01, runs=2, spp=1)
    assert len(seen) == 8 and not any(seen)


# ---------------------- Frozen functions ----------------------


def frozen(integrator, between):
    """A step as in the documentation, in which other things happen, too."""

    def step(scene, integrator, seed):
        image = mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1, seed=seed)
        between()
        dr.backward(dr.mean(dr.square(image), axis=None))
        between()

    return dr.freeze(step, state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))


@pytest.mark.parametrize("froze", [False, True])
def test_scenes_outlive_the_recording_of_a_function(froze):
    """Of the user's, who has no guard around it, and may have frozen the collector's objects before. Dr.Jit ends the
    process where a scene is freed there."""
    gc.unfreeze()
    if froze:
        gc.freeze()
    scene, integrator = garbage.scene(1), mi.load_dict({"type": "direct_edge", "sppi": 0})
    params = mi.traverse(scene)
    values = mi.Float(np.array(params[KEY]).tolist())
    dr.enable_grad(values)
    params[KEY] = values
    params.update()
    integrator.find_boundaries(scene)
    old = garbage.Garbage(garbage.scene(2))
    dr.eval(mi.traverse(old.content[0])[KEY])
    reference = weakref.ref(old)
    gc.disable()  # only so that it is garbage when the recording begins, and not before
    del old
    state = []

    def between():
        gc.collect()
        state.append((reference() is not None, gc.isenabled()))

    step = frozen(integrator, between)
    gc.enable()
    gc.set_threshold(1_000_000)
    for i in range(3):
        step(scene, integrator, dr.opaque(mi.UInt32, i))
    assert step.n_recordings >= 1 and state[0] == (True, True)
    gc.collect()
    assert reference() is None and not gc.get_freeze_count()


def test_old_scenes_are_collected_before_a_new_one_is_examined():
    integrator = mi.load_dict({"type": "direct_edge"})
    integrator.find_boundaries(garbage.scene(1))
    gc.set_threshold(1_000_000)
    old = garbage.Garbage(garbage.scene(2))
    reference = weakref.ref(old)
    del old
    scene = garbage.scene(1)
    integrator.find_boundaries(scene)
    assert reference() is None
    # But not within a guard of the user's, and not where they have turned the collector off
    for within in (True, False):
        reference = weakref.ref(garbage.Garbage())
        if within:
            with rimlight.no_collection():
                integrator.find_boundaries(garbage.scene(2))
                assert reference() is not None
        else:
            gc.disable()
            integrator.find_boundaries(garbage.scene(1))
            assert reference() is not None


# ---------------------- All together ----------------------


def test_two_hundred_derivatives_of_fifty_scenes(tmp_path):
    """In one process, with garbage made on purpose, without kernels in the cache, and without forgetting any."""
    process = subprocess.run(
        [sys.executable, garbage.__file__],
        env={**os.environ, "HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert process.returncode == 0, process.stderr[-2000:]
    assert "200 derivatives of 50 scenes" in process.stdout
