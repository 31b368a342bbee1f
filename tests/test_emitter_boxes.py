"""Cones around lights: none of their directions may be missing."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.edge_sampling import Geometry
from rimlight.edge_sampling.emitter_boxes import EmitterBoxes

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


def test_cones_follow_the_vertices():
    scene = scene_with(LIGHTS["quad"]())
    params = mi.traverse(scene)
    p = np.array(params["light.vertex_positions"]).reshape(-1, 3)
    params["light.vertex_positions"] = mi.Float(np.ravel(p + np.float32([3, 0, 1])))
    params.update()
    found, sin = inside(scene, [0, 0, 0])
    assert found.all()
    assert sin < 0.3
