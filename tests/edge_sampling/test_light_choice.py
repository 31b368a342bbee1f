"""The choice of one of many lights: `choice/light_choice.py`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, film, horizontal, light, mesh, scene
from frozen import Step, assert_same, losses_and_gradients, numbers

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.choice.light_choice import ALIKE, FEW, LightChoice


def many_lights(count: int, sky: bool = True) -> mi.Scene:
    """Lamps of many sizes and colours close over a table, spots and points among them."""
    rng = np.random.default_rng(3)
    lamps = {}
    for k in range(count):
        at = (rng.uniform(-1.5, 1.5), rng.uniform(0.6, 1.2), rng.uniform(-1.5, 1.5))
        colour = [x.item() for x in rng.uniform(0.2, 1, 3)]
        if k % 5 == 0:
            intensity = {"type": "rgb", "value": [0.1 * x for x in colour]}
            place = mi.ScalarTransform4f().look_at(list(at), [at[0], 0, at[2]], [0, 0, 1])
            lamps[f"lamp{k}"] = (
                {"type": "point", "position": list(at), "intensity": intensity}
                if k % 10
                else {"type": "spot", "to_world": place, "intensity": intensity}
            )
        else:
            lamps[f"lamp{k}"] = horizontal(
                at, 0.02 * (1 + k % 3), f"lamp{k}", down=True, bsdf=diffuse(0), emitter=light(*(40 * x for x in colour))
            )
    thing = mesh("cube", 0.2 * cube_vertices() + [0.1, 0.22, 0], CUBE_FACES, bsdf=diffuse(0.6, 0.5, 0.4))
    table = horizontal((0, 0, 0), 2, "table", bsdf=diffuse(0.6))
    view = camera((0, 1.6, -3), (0, 0, -0.2), film=film(width=16, height=16))
    return scene(sensor=view, table=table, cube=thing, **lamps, **({"sky": constant(0.05)} if sky else {}))


@pytest.mark.parametrize("sky", [True, False])
def test_lights_are_chosen_as_often_as_it_says(sky):
    lights = LightChoice.of(many_lights(20, sky))
    n, many = lights.count, 200_000
    x = mi.Point3f(0.7, 0, -0.6)
    u = mi.Float((np.arange(many) + 0.5) / many)
    points = mi.Point3f(*(dr.full(mi.Float, v[0], many) for v in x))
    chosen = lights.choose(points, mi.Vector3f(0, 1, 0), u, mi.Bool(True))
    often = np.bincount(chosen.number.numpy(), minlength=n) / many
    p = np.zeros(n)
    p[chosen.number.numpy()] = chosen.p.numpy()
    assert np.abs(often - p).max() < 2e-4
    assert abs(p.sum() - 1) < 1e-3
    assert p.min() >= 0.99 * ALIKE / n
    assert p.max() > 3 / n
    assert dr.allclose(lights.probability(chosen.emitter, chosen), chosen.p)
    # What is left of the random number is uniform for each light.
    left = chosen.left.numpy()
    for k in range(n):
        mine = left[chosen.number.numpy() == k]
        assert abs(mine.mean() - 0.5) < 0.05 and mine.min() >= 0 and mine.max() < 1


def test_few_lights_are_left_to_mitsuba():
    assert LightChoice.of(many_lights(FEW, sky=False)) is None
    lamp = lambda k: {"type": "point", "position": [k, 1, 0], "sampling_weight": 2.0 if k == 3 else 1.0}
    assert LightChoice.of(mi.load_dict({"type": "scene", **{f"lamp{k}": lamp(k) for k in range(12)}})) is None


@pytest.mark.parametrize("integrator", [{"type": "direct_edge"}, {"type": "prb_edge", "max_depth": 3}])
def test_same_derivative_with_less_noise(integrator, monkeypatch):
    room = many_lights(40)
    motion = Motion(room, "cube.vertex_positions", direction=[1, 0, 0.3])

    def images() -> np.ndarray:
        made = mi.load_dict(integrator)
        return np.array([derivative_image(room, made, motion, spp=64, seed=i) for i in range(12)], float)

    new = images()
    monkeypatch.setattr(LightChoice, "of", staticmethod(lambda scene: None))
    old = images()
    assert new.std(0).sum() < 0.9 * old.std(0).sum()
    expected = new[::2].mean(0)
    scales = [(i * expected).sum((1, 2, 3)) / (expected**2).sum() for i in (old, new[1::2])]
    error = sum(s.var(ddof=1) / len(s) for s in scales) ** 0.5
    assert error < 0.05
    assert abs(scales[0].mean() - scales[1].mean()) < 4 * error


def test_gradients_are_those_of_forward_mode():
    room = many_lights(16)
    motion = Motion(room, "cube.vertex_positions", direction=[1, 0, 0])
    made = mi.load_dict({"type": "prb_edge", "max_depth": 3})
    forward = np.array(derivative_image(room, made, motion, spp=16, seed=3), float).sum()
    θ = mi.Float(0)
    dr.enable_grad(θ)
    motion.apply(θ)
    made.render_backward(room, motion.params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=3, spp=16)
    dr.enqueue(dr.ADMode.Backward, θ)
    assert abs(dr.grad(θ)[0] - forward) < 2e-3 * abs(forward) + 2e-3


def test_frozen_functions():
    room, made, key = many_lights(16), mi.load_dict({"type": "prb_edge", "max_depth": 3}), "cube.vertex_positions"
    initial = numbers(mi.traverse(room)[key])
    results = [losses_and_gradients(step, room, made, key, initial) for step in (Step().frozen(), Step())]
    assert_same(*results)
