"""The curves in which spheres, disks and cylinders cut through other shapes: `geometry/cut_curves.py`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import camera, constant, diffuse, horizontal, mesh, scene
from random_scenes import ball

from rimlight.edge_sampling import CutCurves, Geometry
from rimlight.edge_sampling.geometry.meshes import positions_of


def sphere(centre, radius) -> dict:
    return {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": diffuse(0.5)}


def cylinder(a, b, radius) -> dict:
    return {"type": "cylinder", "p0": list(a), "p1": list(b), "radius": radius, "bsdf": diffuse(0.5)}


def disk(centre, turn, radius) -> dict:
    to_world = mi.ScalarTransform4f().translate(centre).rotate([1, 0, 0], turn).scale(radius)
    return {"type": "disk", "to_world": to_world, "bsdf": diffuse(0.5)}


def flat_disk() -> dict:
    to_world = mi.ScalarTransform4f().translate([0.1, 0, 0.3]).rotate([1, 0, 0], 90).scale(0.5)
    return {"type": "disk", "to_world": to_world, "bsdf": diffuse(0.5)}


def curves(**shapes) -> tuple[float, float, int]:
    """Length of all curves; how far their points are from the surfaces; and how many ends they have."""
    geometry = Geometry.of(scene(**shapes))
    found = CutCurves(geometry)
    found.find(geometry)
    if not found.capacity:
        return 0.0, 0.0, 0
    positions = replace(geometry, lines=(found,)).positions()
    piece = dr.arange(mi.UInt32, found.capacity)
    _, a, b, *_ = (p.numpy().T for p in found.points([positions_of(m) for m in geometry.meshes]))
    used = (a != b).any(1)
    length, off = 0.0, mi.Float64(0)
    for k in range(8):
        p, tangent = found.point(positions, piece, mi.Float((k + 0.5) / 8))
        length += dr.norm(tangent).numpy()[used].sum() / 8
        for s in found._pairs.surfaces(positions):
            off = dr.maximum(off, dr.abs(s.distance(mi.Vector3d(p))[0]))
    ends = np.unique(np.round(np.concatenate([a[used], b[used]]), 4), axis=0, return_counts=True)[1]
    return float(length), float(off.numpy()[used].max(initial=0)), int((ends % 2).sum())


def floor() -> mi.Mesh:
    return horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5))


HALF_CHORD = np.sqrt(0.5**2 - 0.2**2)

#: Of each: shapes, length of their curves, and number of the ends of these.
CASES = {
    "a sphere in a floor": (lambda: {"a": sphere((0, 0.2, 0), 0.5), "b": floor()}, 2 * np.pi * HALF_CHORD, 0),
    "on it": (lambda: {"a": sphere((0, 0.5, 0), 0.5), "b": floor()}, 0, 0),
    "a pillar in it": (lambda: {"a": cylinder((0, -1, 0.1), (0, 1, 0.1), 0.3), "b": floor()}, 0.6 * np.pi, 0),
    "on it, upright": (lambda: {"a": cylinder((0, 0, 0), (0, 1, 0), 0.3), "b": floor()}, 0, 0),
    "lying in it": (lambda: {"a": cylinder((-0.7, 0.1, 0.2), (0.7, 0.1, 0.2), 0.3), "b": floor()}, 2.8, 4),
    "a disk in it": (lambda: {"a": disk((0.1, 0.2, 0.3), 40, 0.5), "b": floor()}, None, 2),
    "flat on it": (lambda: {"a": flat_disk(), "b": floor()}, 0, 0),
    "two spheres": (lambda: {"a": sphere((0, 0, 0), 0.5), "b": sphere((0.4, 0, 0), 0.5)}, np.pi * np.sqrt(0.84), 0),
    "on a huge one": (
        lambda: {"a": sphere((0, 0.2, 0), 0.5), "b": sphere((0, -1000, 0), 1000)},
        2 * np.pi * HALF_CHORD,
        0,
    ),
    "a disk in a sphere": (
        lambda: {"a": disk((0, 0, 0.2), 0, 1), "b": sphere((0, 0, 0), 0.5)},
        2 * np.pi * HALF_CHORD,
        0,
    ),
    "smaller than that": (lambda: {"a": disk((0.4, 0, 0.2), 0, 0.3), "b": sphere((0, 0, 0), 0.5)}, None, 2),
    "a capsule": (lambda: {"a": sphere((0, 0, 0), 0.5), "b": cylinder((0, 0, 0), (0, 1, 0), 0.5)}, 0, 0),
    "two pillars": (
        lambda: {"a": cylinder((0, -1, 0), (0, 1, 0), 0.3), "b": cylinder((-1, -0.5, 0), (1, 1, 0.2), 0.12)},
        None,
        0,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_length(name):
    shapes, expected, ends = CASES[name]
    length, off, odd = curves(**shapes())
    assert odd == ends
    assert off < 2e-5 * (20 if "huge" in name else 1)
    if expected is None:
        assert length > 0.2
    else:
        assert length == pytest.approx(expected, rel=1e-3)


def test_fine_meshes():
    """A ball of triangles has nearly the curve of a sphere."""
    vertices, _, _, faces = ball(24)
    thing = mesh("ball", 0.4 * vertices + [0.4, 0.1, 0.1], faces, bsdf=diffuse(0.5))
    length, off, odd = curves(a=sphere((0, 0.2, 0), 0.5), ball=thing)
    of_spheres, _, _ = curves(a=sphere((0, 0.2, 0), 0.5), b=sphere((0.4, 0.1, 0.1), 0.4))
    assert odd == 0
    assert off < 1e-6
    assert length == pytest.approx(of_spheres, rel=0.01)


def test_a_scene_without_meshes():
    """Two spheres that cut each other, and nothing else: their motion looks like the opposite one of the camera."""
    sphere = lambda x, r, colour: {"type": "sphere", "center": [x, 0.3 * x, 0], "radius": r, "bsdf": diffuse(colour)}
    integrator = mi.load_dict({"type": "direct_edge"})

    def runs(keys: list[str], step: float, first: int = 0) -> np.ndarray:
        s = scene(sensor=camera(), a=sphere(0, 0.6, 0.2), b=sphere(0.5, 0.5, 0.8), sky=constant())
        params, found = mi.traverse(s), []
        params.keep(keys)
        start = {k: mi.Transform4f(params[k]) for k in keys}
        for seed in range(first, first + 12):
            θ = dr.opaque(mi.Float, 0)
            dr.enable_grad(θ)
            for k in keys:
                params[k] = mi.Transform4f().translate(mi.Vector3f(step, 0, 0) * θ) @ start[k]
            params.update()
            dr.forward(θ, dr.ADFlag.ClearEdges)
            found.append(np.array(integrator.render_forward(s, params, seed=seed, spp=64), np.float64))
        return np.array(found)

    spheres, sensor = runs(["a.to_world", "b.to_world"], 1.0), runs(["sensor.to_world"], -1.0)
    weight = runs(["sensor.to_world"], -1.0, first=100).mean(0)
    p, q = ((r * weight).sum((1, 2, 3)) / (weight**2).sum() for r in (spheres, sensor))
    assert abs(p.mean() - q.mean()) < 0.01 + 4 * np.hypot(p.std(), q.std()) / len(p) ** 0.5
    assert q.mean() > 0.9
