"""Which integrator suits a derivative: what the measured numbers say, and the measurement itself."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes
from rimlight.checks import Motion, derivative_image
from rimlight.cli import main
from rimlight.inverse import Free, free_parameters
from rimlight.inverse.advice import PATTERNS, RUNS, Pilot, advice, compared, of_latents, random_picture

SHAPE = (PATTERNS, RUNS, 3)


def pilot(name: str, noise: float, seconds: float = 1.0, mean: float = 1.0, seed: int = 0) -> Pilot:
    """Of one parameter with three numbers."""
    random = np.random.default_rng((seed, *name.encode()))
    return Pilot(name, (mean + noise * random.standard_normal(SHAPE),), seconds)


def test_less_variance_in_the_same_time_is_advised():
    found = compared(("a",), [pilot("quick", 1.0), pilot("quiet", 0.5)])
    assert found.integrator == "quiet" and found.sure
    row = found.rows[1]
    assert row.low < 4 < row.high and row.effort == pytest.approx(4, rel=0.4)
    assert "quiet, which needs" in str(found) and "1 (1 to 1)" in str(found)


def test_time_counts():
    found = compared(("a",), [pilot("quick", 1.0, 1.0), pilot("quiet", 0.5, 16.0)])
    assert found.integrator == "quick" and found.sure
    assert found.rows[1].effort == pytest.approx(4, rel=0.4)


def test_what_noise_leaves_open_is_said():
    found = compared(("a",), [pilot("one", 1.0), pilot("other", 1.0)])
    assert not found.sure and "within the noise" in str(found)
    assert found.rows[1].low < 1


def test_units_do_not_matter():
    """A second parameter in other units, of which the other integrator has the noise."""
    both = [pilot("one", 1.0), pilot("other", 0.1)]
    more = [Pilot(p.integrator, (*p.gradients, 1e6 * q.gradients[0]), 1) for p, q in zip(both, both[::-1], strict=True)]
    assert not compared(("a", "b"), more).sure


def test_light_that_was_missed_is_no_merit():
    """One of two integrators finds, hardly ever, what makes most of the derivative."""
    found = compared(("a",), [pilot("blind", 0.01, mean=0.1), pilot("seeing", 0.5)])
    assert found.integrator == "seeing" and found.sure
    assert "misses light" in found.rows[1].lacks and "the others do not suit" in str(found)


def test_equal_means_are_not_taken_for_different():
    assert not any(
        row.lacks for seed in range(50) for row in compared(("a",), [pilot(n, 1.0, seed=seed) for n in "pq"]).rows
    )


def test_no_light_at_all_is_not_advised():
    dark = Pilot("dark", (np.zeros(SHAPE),), 1.0)
    found = compared(("a",), [dark, pilot("lit", 1.0)])
    assert found.integrator == "lit" and "its derivative is 0" in str(found.rows[1])
    with pytest.raises(RuntimeError, match="derivatives to be measured are zero"):
        compared(("a",), [dark])


@pytest.mark.parametrize("name", ["shadow_light", "shadow_camera"])
def test_gradients_of_bodies_are_those_of_motions(name):
    """Backward, with respect to a displacement and a turn, of vertices or a frame: as `derivative_image` has it."""
    case = cases.case(name)
    scene = case.scene()
    key = case.motion["key"]
    params = mi.traverse(scene)
    (parameter,) = free_parameters.find([Free(key=(key,), kind="pose", rate=1.0, turn_rate=1.0)], params)
    it = mi.load_dict(case.integrator)
    w = random_picture((cases.RES, cases.RES, 3), np.random.default_rng(0))
    expected = [
        float((w * np.array(derivative_image(scene, it, Motion(scene, key, **{how: axis}), spp=4, seed=1))).sum())
        for how in ("direction", "rotate")
        for axis in np.eye(3)
    ]
    dr.enable_grad(params[key])
    params.update()
    it.render_backward(scene, params, mi.TensorXf(w), seed=1, spp=4)
    found = of_latents(parameter, {key: free_parameters.to_numpy(dr.grad(params[key]))})
    assert found == pytest.approx(expected, abs=1e-3 * np.abs(expected).max())


def test_measured(variant):
    """A shadow in direct light, which all can differentiate; the scene stays as it was."""
    scene = cases.case("shadow_blocker").scene()
    key, size = "blocker.vertex_positions", list(scene.sensors()[0].film().size())
    before = np.array(mi.traverse(scene)[key])
    found = advice(scene, [key], max_depth=2, direct=True)
    assert {row.integrator for row in found.rows} == {"direct_edge", "prb_edge", "bdpt_edge"}
    assert not any(row.lacks for row in found.rows)
    assert all(row.seconds > 0 and np.isfinite(row.effort) for row in found.rows)
    assert np.array_equal(np.array(mi.traverse(scene)[key]), before)
    assert list(scene.sensors()[0].film().size()) == size


def test_plan_measures_what_it_is_asked_for(variant, capsys, monkeypatch):
    """With the depth of the integrator that is planned, and `direct_edge` where light is reflected once."""
    asked = []
    measure = lambda scene, keys, **options: asked.append((list(keys), options)) or "measured"
    monkeypatch.setattr("rimlight.inverse.advice.advice", measure)
    arguments = ["plan", str(scenes.path("shadow_blocker")), "--images", "-D", "res=16", "--integrator", "direct_edge"]
    assert main([*arguments, "--param", "blocker.vertex_positions", "--seed", "3"]) == 0
    said = capsys.readouterr().out
    assert "images: path" in said and said.endswith("measured\n") and "derivatives" not in said
    assert asked == [(["blocker.vertex_positions"], {"sensor": 0, "max_depth": 2, "direct": True, "seed": 3})]
