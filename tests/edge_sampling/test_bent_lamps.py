"""The choice of points on lamps that do not face one way: `choice/bent_lamps.py`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, camera, cube_vertices, diffuse, horizontal, light, mesh, scene
from random_scenes import ball

from rimlight.edge_sampling.choice.bent_lamps import ALIKE, CANDIDATES, FEW, BentLamps

CYLINDER = {"type": "cylinder", "p0": [-0.4, 1.1, 0.1], "p1": [0.5, 1.3, 0], "radius": 0.3, "id": "lamp"}


def lamp(kind: str) -> mi.Object | dict:
    props = {"bsdf": diffuse(0), "emitter": light(3, 5, 1)}
    if kind == "cylinder":
        return CYLINDER | props
    if kind == "square":
        return horizontal((0, 1, 0), 0.5, "lamp", down=True, **props)
    points, faces = (cube_vertices(), CUBE_FACES) if kind == "cube" else ball(6)[::3]
    return mesh("lamp", 0.4 * points + [0, 1.2, 0], faces, normals=kind == "smooth", **props)


def room(*kinds: str) -> mi.Scene:
    lamps = {f"lamp{i}": lamp(k) for i, k in enumerate(kinds)}
    return scene(sensor=camera(), floor=horizontal((0, -0.5, 0), 2, "floor", bsdf=diffuse(0.5)), **lamps)


def irradiance(of: mi.Scene, resampled: bool, count: int = 2**18) -> tuple[np.ndarray, np.ndarray]:
    """What light samples find at points of the floor, each with a weight as multiple importance sampling has one."""
    lamps, sampler = BentLamps(of), mi.load_dict({"type": "independent"})
    sampler.seed(5, count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p = mi.Point3f(2 * sampler.next_1d() - 1, -0.5, 2 * sampler.next_1d() - 1)
    si.n = mi.Normal3f(0, 1, 0)
    emitter = dr.gather(mi.EmitterPtr, of.emitters_dr(), dr.zeros(mi.UInt32, count))
    u, factor = sampler.next_2d(), mi.Float(1)
    if resampled:
        look = lambda u, active: emitter.sample_direction(si, u, active)[1]
        u, factor = lamps.resample(emitter, look, u, mi.Bool(True))
        assert dr.all(factor <= 1 / ALIKE) and dr.all(factor >= 1 / CANDIDATES)
    ds, light = emitter.sample_direction(si, u)
    weight = 1 / (1 + dr.square(0.1 / ds.pdf)) * dr.maximum(ds.d.y, 0)
    return (light * weight * factor).numpy(), factor.numpy()


@pytest.mark.parametrize("kind", ["cube", "ball", "smooth", "cylinder"])
def test_same_light_with_less_noise(kind):
    of = room(kind)
    (plain, _), (resampled, _) = irradiance(of, False), irradiance(of, True)
    error = lambda x: x.std(1) / np.sqrt(x.shape[1])
    z = (resampled.mean(1) - plain.mean(1)) / np.hypot(error(plain), error(resampled))
    assert np.abs(z).max() < 4
    assert (error(resampled) < 0.5 * error(plain)).all()


def test_only_lamps_that_may_be_bent():
    assert len(BentLamps(room("square"))) == 0
    of = room("square", "cube")
    lamps, emitters = BentLamps(of), of.emitters_dr()
    bent = [e.get_shape().is_mesh() and e.get_shape().face_count() > 2 for e in of.emitters()]
    assert lamps.are(emitters).numpy().tolist() == bent == [False, True]
    u = mi.Point2f([0.3, 0.3], [0.7, 0.7])
    kept, factor = lamps.resample(emitters, lambda u, active: mi.Spectrum(u.x), u, mi.Bool(True))
    assert factor[0] == 1 and kept.x[0] == u.x[0] and kept.y[0] == u.y[0]
    assert factor[1] != 1


def test_of_many_lamps_all_are_taken():
    of = room("square", *["cube"] * (FEW + 1))
    assert dr.all(BentLamps(of).are(of.emitters_dr()))
