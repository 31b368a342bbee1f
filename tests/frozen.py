"""Optimisation steps as frozen functions (`dr.freeze`), beside the same steps unfrozen."""

from __future__ import annotations

from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

STEPS = 4


def numbers(value):
    """A detached copy in Dr.Jit's own memory. The vertices of `cases.mesh` lie in NumPy's, see the documentation."""
    if isinstance(value, mi.Transform4f):
        return mi.Transform4f(value)
    value = type(value)(dr.detach(value)) * dr.opaque(mi.Float, 1)
    dr.eval(value)
    return value


def moved(initial, theta):
    """The parameter at a distance or, for colours, a relative change theta."""
    if isinstance(initial, mi.Transform4f):
        return mi.Transform4f().translate([theta, 0.5 * theta, 0]) @ initial
    return initial + theta


def spoil_free_memory():
    """Fill what Dr.Jit has freed, and gives to new arrays, with numbers that show in any result: a replay that reads
    what it has not written mostly finds its own values from last time there."""
    arrays = [dr.opaque(mi.Float, np.nan, 1 << k) for k in range(4, 16) for _ in range(100 if k < 10 else 8)]
    dr.eval(arrays)
    dr.sync_thread()


def loss_of(image):
    return dr.mean(dr.square(image - 0.2), axis=None)


class Step:
    """The step that is frozen: render, compare, differentiate. It counts how often Python executes it."""

    def __init__(self):
        self.calls = 0

    def __call__(self, scene, integrator, seed):
        self.calls += 1
        loss = loss_of(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=4, seed=seed))
        dr.backward(loss)
        return loss.array

    def frozen(self):
        def step(scene, integrator, seed):
            return self(scene, integrator, seed)

        return dr.freeze(step, state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))


def losses_and_gradients(step, scene, integrator, key, initial):
    """Loss and its derivative, for other values and random numbers each time: (STEPS, 2)."""
    params, result = mi.traverse(scene), []
    for i in range(STEPS):
        theta = dr.opaque(mi.Float, 0.02 * i)
        dr.enable_grad(theta)
        params[key] = moved(initial, theta)
        params.update()
        seed = dr.opaque(mi.UInt32, 7 * i)
        spoil_free_memory()
        loss = step(scene, integrator, seed)
        result.append((loss[0], dr.grad(theta)[0]))
    return np.array(result)


def assert_same(frozen, unfrozen):
    """Equal but for the order of additions."""
    scale = np.abs(unfrozen).max(axis=0)
    assert (scale > 0).all() and (np.abs(np.diff(unfrozen, axis=0)).max(axis=0) > 1e-3 * scale).all()
    np.testing.assert_allclose(frozen / scale, unfrozen / scale, rtol=0, atol=1e-5)


@contextmanager
def one_thread():
    """Mitsuba adds up vertex normals in any order. With other roundings, a sample may choose another edge."""
    count = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(count)


def assert_frozen_is_unfrozen(scene, integrator, key):
    """The same steps, frozen and not, as `key` changes; recorded once."""
    initial = numbers(mi.traverse(scene)[key])
    step = Step()
    frozen = step.frozen()
    with one_thread():
        unfrozen = losses_and_gradients(Step(), scene, integrator, key, initial)
        assert_same(losses_and_gradients(frozen, scene, integrator, key, initial), unfrozen)
    assert step.calls == frozen.n_recordings == 1


def first_cause(error: BaseException) -> str:
    """The text of the exception that started it."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error)
