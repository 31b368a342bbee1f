"""Derivatives in several passes: the same estimate as in one, with less memory."""

from __future__ import annotations

from dataclasses import replace

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import FiniteDifferences, Motion, compare, derivative_image
from rimlight.terms.sampling import Counts

KINDS = {
    "direct_edge": {"type": "direct_edge"},
    "prb_edge": {"type": "prb_edge", "max_depth": 3},
    "bdpt_edge": {"type": "bdpt_edge", "max_depth": 3},
    "aov_edge": {"type": "aov_edge", "aovs": "dd:depth", "image": {"type": "direct_edge"}},
}

PIXELS = cases.RES**2


def in_passes(kind: str, at_once: int) -> mi.Integrator:
    integrator = mi.load_dict(KINDS[kind])
    for one in (integrator, *getattr(integrator, "nested", {}).values()):
        one.at_once = at_once
    return integrator


def filtered() -> mi.Scene:
    """A room, through a filter that is wider than a pixel, and that reaches over the border."""
    return cases.room(cases.close_up_with_border)()


def attached(scene: mi.Scene, key: str) -> mi.SceneParameters:
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    return params


@pytest.mark.parametrize(
    ("counts", "at_once", "passes"),
    [
        (Counts(16, 16, 16, False), 16 * PIXELS, 1),
        (Counts(16, 16, 16, False), 16 * PIXELS - 1, 2),
        (Counts(16, 16, 16, False), 5 * PIXELS, 4),
        (Counts(12, 1, 3, False), 4 * PIXELS, 3),
        (Counts(2, 64, 2, True), 8 * PIXELS, 8),
        (Counts(7, 7, 7, False), 2 * PIXELS, 7),
        (Counts(4, 4, 4, False), 1, 4),
        (Counts(0, 0, 0, False), 1, 1),
    ],
)
def test_passes_are_equal(counts, at_once, passes):
    """They have as many samples each, and all together at least what was asked for; and other random numbers."""
    integrator, scene = mi.load_dict(KINDS["prb_edge"]), cases.cube()()
    attached(scene, "cube.vertex_positions")
    parts = replace(integrator.job(scene, 0, seed=5), counts=counts).divided(at_once)
    assert len(parts) == passes
    assert len({part.counts for part in parts}) == 1
    of_each = parts[0].counts
    for name in ("interior", "film", "shading"):
        whole, part = getattr(counts, name), getattr(of_each, name)
        assert part * passes >= whole and (part - 1) * passes < whole and (part > 0) == (whole > 0)
    if at_once >= PIXELS:
        assert max(of_each.interior, of_each.shading) * PIXELS <= at_once
        assert of_each.on_line(scene.sensors()[0].film()) <= at_once
    assert parts[0].seed == 5 and len({int(mi.UInt32(part.seed)[0]) for part in parts}) == passes


@pytest.mark.parametrize("kind", ["prb_edge", "bdpt_edge"])
def test_the_film_divides_by_the_weights_of_all_passes(kind):
    """The image is the sum of what the film adds up in each pass, over the sum of the weights of all."""
    scene, integrator = filtered(), in_passes(kind, 1)
    motion = Motion(scene, "cube.vertex_positions", direction=[0, 1, 0])
    found = np.array(derivative_image(scene, integrator, motion, spp=3, seed=4), np.float64)
    attached(scene, "cube.vertex_positions")
    job = integrator.job(scene, 0, seed=4, spp=3)
    alone, total, weights = mi.load_dict(KINDS[kind]), 0.0, 0.0
    motion = Motion(scene, "cube.vertex_positions", direction=[0, 1, 0])
    for part in integrator.passes(job):
        seed = int(mi.UInt32(part.seed)[0])
        image = np.array(derivative_image(scene, alone, motion, spp=1, seed=seed), np.float64)
        with dr.suspend_grad():
            block = integrator._weights([part])
        assert block.border_size() == 0
        weight = np.array(block.tensor(), np.float64)[..., -1:]
        assert weight.std() > 0.1 * weight.mean() > 0
        total, weights = total + weight * image, weights + weight
    expected = total / weights
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("kind", KINDS)
def test_backward_is_forward(kind):
    scene = filtered()
    motion = Motion(scene, "cube.vertex_positions", direction=[0, 1, 0])
    assert_backward_is_forward(scene, in_passes(kind, 4 * PIXELS), motion)


@pytest.mark.parametrize("name", ["shadow_blocker", "cornell_box_camera"])
def test_derivatives_stay_the_same(name):
    """Against finite differences, at two samples per pixel in a pass."""
    case = cases.case(name)
    scene, integrator = case.scene(), mi.load_dict(case.integrator)
    integrator.at_once = 8 * PIXELS
    motion = Motion(scene, **case.motion)
    images = [derivative_image(scene, integrator, motion, spp=case.spp, seed=i) for i in range(case.runs)]
    agreement = compare(np.array(images, np.float64), FiniteDifferences.read(case.reference))
    print(agreement)
    assert not agreement.faults(noise=0.1)


def test_frozen():
    """Passes are recorded, and replayed with other random numbers."""
    assert_frozen_is_unfrozen(cases.room()(), in_passes("bdpt_edge", PIXELS), "light.to_world")


def test_memory_is_bounded():
    """Passes of an eighth of the samples need less than a third of the memory."""
    scene, key, used = cases.cube()(), "cube.vertex_positions", {}
    for at_once in (64 * PIXELS, 8 * PIXELS):
        params, integrator = attached(scene, key), in_passes("prb_edge", at_once)
        w = dr.ones(mi.TensorXf, (cases.RES, cases.RES, 3))
        integrator.render_backward(scene, params, w, spp=1)  # the edges are found
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
        integrator.render_backward(scene, params, w, spp=64)
        used[at_once] = dr.detail.malloc_watermark(dr.backend_v(mi.Float)) - before
    assert used[8 * PIXELS] < used[64 * PIXELS] / 3


def test_balance_measures_in_passes():
    """And finds about the same shares."""
    shares = []
    for at_once in (16 * PIXELS, PIXELS):
        case = cases.case("shadow_blocker")
        scene, integrator = case.scene(), mi.load_dict(case.integrator)
        integrator.at_once = at_once
        motion, θ = Motion(scene, **case.motion), mi.Float(0)
        dr.enable_grad(θ)
        motion.apply(θ)
        dr.forward(θ, dr.ADFlag.ClearEdges)
        shares.append(integrator.balance(scene, motion.params, spp=16).shares)
    one, several = shares
    assert one.keys() == several.keys()
    for name, share in one.items():
        assert several[name] == pytest.approx(share, rel=0.2)
