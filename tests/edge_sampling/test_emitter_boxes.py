"""Cones around lights: none of their directions may be missing."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling import EdgeTree, Geometry, View, find_edges
from rimlight.edge_sampling.choice.emitter_boxes import EmitterBoxes
from rimlight.edge_sampling.choice.importance import importance

LIGHTS = {
    "quad": lambda: cases.horizontal((0.3, 2, 0.1), 0.4, "light", down=True, emitter=cases.light(1, 1, 1)),
    "tiny": lambda: cases.horizontal((0.3, 2, 0.1), 1e-4, "light", down=True, emitter=cases.light(1, 1, 1)),
    "sphere": lambda: {"type": "sphere", "center": [0.3, 2, 0.1], "radius": 0.5, "emitter": cases.light(1, 1, 1)},
    "sky": lambda: {"type": "constant"},
}


def scene_with(light) -> mi.Scene:
    # Another light before it, so that it is not the first.
    other = {"type": "point", "position": [5, 5, 5]}
    return cases.scene(sensor=cases.camera(), floor=cases.horizontal((0, 0, 0), 1, "floor"), a=other, light=light)


def boxes_of(scene: mi.Scene) -> EmitterBoxes:
    geometry = Geometry.of(scene)
    boxes = EmitterBoxes(scene, geometry)
    boxes.refit(geometry.positions())
    return boxes


def inside(scene: mi.Scene, x: list[float], count: int = 10000) -> tuple[np.ndarray, np.ndarray]:
    """Which of the directions from x to points of the light are in its cone, and the sine of the cone."""
    index = next(i for i, e in enumerate(scene.emitters()) if not e.flags() & mi.EmitterFlags.Delta)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    x = mi.Point3f(x)
    cone = boxes_of(scene).cone(mi.UInt32(index), x)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = x
    d = scene.emitters()[index].sample_direction(si, sampler.next_2d())[0].d
    in_cone = (dr.dot(d, cone.axis) > 0) & (dr.norm(dr.cross(d, cone.axis)) <= cone.sin)
    return np.array(in_cone | cone.everything), np.array(cone.sin)


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("x", [[0, 0, 0], [0.3, 1.9, 0.1], [0.35, 2, 0.1], [-40, 1, 3], [900, -700, 400]])
def test_no_direction_to_a_light_is_missing(light, x):
    found, _ = inside(scene_with(LIGHTS[light]()), x)
    assert found.all()


def test_cones_are_tight():
    _, sin = inside(scene_with(LIGHTS["tiny"]()), [0.3, 0, 0.1])
    assert sin == pytest.approx(1e-4 * np.sqrt(2) / 2, rel=0.05)


def test_edges_on_the_axis_of_a_cone_count():
    """The box around the edges of a lamp is its own: from nowhere it may seem to lie beside its cone."""
    scene = scene_with(LIGHTS["quad"]())
    geometry = Geometry((next(s for s in scene.shapes() if s.is_emitter()),))
    tree = EdgeTree(geometry, find_edges(geometry), [np.arange(5)])
    tree.refit(geometry.positions())
    x, z = dr.meshgrid(dr.linspace(mi.Float, -2, 2, 64), dr.linspace(mi.Float, -2, 2, 64))
    p = mi.Point3f(x, 0, z)
    cone = boxes_of(scene).cone(mi.UInt32(next(i for i, e in enumerate(scene.emitters()) if e.get_shape())), p)
    view = View(mi.Vector3f(p - tree.centre), mi.Vector3f(0), mi.Float(1), [], cone)
    assert dr.all(importance(tree.node(tree.roots[0]), view) > 0)


def test_cones_follow_the_vertices():
    scene = scene_with(LIGHTS["quad"]())
    params = mi.traverse(scene)
    p = np.array(params["light.vertex_positions"]).reshape(-1, 3)
    params["light.vertex_positions"] = mi.Float(np.ravel(p + np.float32([3, 0, 1])))
    params.update()
    found, sin = inside(scene, [0, 0, 0])
    assert found.all()
    assert sin < 0.3


def test_cones_follow_a_sphere_between_derivatives():
    """It is no mesh: its box is found anew before each derivative, though the edges are not."""
    scene = cases.scene(
        sensor=cases.camera(), thing=cases.horizontal((0, 1, 0), 0.5, "thing"), light=LIGHTS["sphere"]()
    )
    integrator = mi.load_dict({"type": "prb_edge", "max_depth": 3})
    params = mi.traverse(scene)
    dr.enable_grad(params["thing.vertex_positions"])
    for centre in ([0.3, 2, 0.1], [4, 3, 2]):
        params["light.to_world"] = mi.Transform4f().translate(centre).scale(0.5)
        params.update()
        boxes = integrator.find_boundaries(scene).shading.boxes
        assert np.array(boxes.lower) == pytest.approx(np.array(centre) - 0.5, abs=1e-5)
        assert np.array(boxes.upper) == pytest.approx(np.array(centre) + 0.5, abs=1e-5)


def test_lights_that_mitsuba_does_not_sample_count():
    """A light of sampling weight 0 is met by rays, and what occludes it has a derivative, seen in a mirror."""

    def derivative(weight: float) -> np.ndarray:
        emitter = {**cases.light(1, 1, 1), "sampling_weight": weight}
        scene = cases.scene(
            sensor=cases.camera((0, 2, -4), (0, -2, 0), film=cases.film(width=8, height=8)),
            floor=cases.horizontal((0, 0, 0), 4, "floor", bsdf=cases.conductor(0.1)),
            blocker=cases.quad([-0.5, 1, 1], [0, 1.5, 0], [1, 0, 0], "blocker", bsdf=cases.diffuse(0.0)),
            light=cases.quad([-2, 0, 4], [0, 12, 0], [4, 0, 0], "light", bsdf=cases.diffuse(0.0), emitter=emitter),
            other={"type": "point", "position": [0, 9, 0], "intensity": {"type": "rgb", "value": 1e-6}},
        )
        motion = Motion(scene, "blocker.vertex_positions", direction=[0, 1, 0])
        integrator = mi.load_dict({"type": "direct_edge", "sppc": 0, "sppp": 0})
        return np.mean([np.array(derivative_image(scene, integrator, motion, spp=256, seed=i)) for i in range(8)], 0)

    sampled, unsampled = derivative(1), derivative(0)
    assert np.abs(sampled).sum() > 0.1
    assert np.abs(unsampled - sampled).sum() < 0.1 * np.abs(sampled).sum()
