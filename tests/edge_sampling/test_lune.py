"""The light that one of two faces alone sees: `boundaries/lune.py`."""

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.boundaries.film_outlines import FilmOutlines
from rimlight.edge_sampling.boundaries.lune import Lune

COUNT = 2**16


@pytest.mark.parametrize("angle", [1e-3, 0.3, -1.2, 3.0])
def test_directions_are_uniform_between_the_planes(angle):
    rng = np.random.default_rng(0)
    axis, first = (mi.Vector3f(rng.normal(size=3).tolist()) for _ in range(2))
    axis = dr.normalize(axis)
    first = dr.normalize(dr.cross(axis, first))
    second = first * np.cos(angle).item() + dr.cross(axis, first) * np.sin(angle).item()
    lune = Lune.between(2 * axis, (3 * first, 0.5 * second), mi.Bool(True))
    side, u = mi.Float(rng.random(COUNT)), mi.Point2f(rng.random((2, COUNT)))
    ω, pdf = lune.sample(side, u)
    assert dr.allclose(dr.norm(ω), 1, atol=1e-5)
    inside = (dr.dot(ω, first) > 0) != (dr.dot(ω, second) > 0)
    assert np.mean(inside.numpy()) > 0.999
    assert dr.allclose(pdf, 1 / (4 * abs(angle)), rtol=1e-3)
    # Uniform by solid angle: along the axis, in both of the lunes, and from one plane to the other.
    along = dr.dot(ω, axis).numpy()
    assert abs(along.mean()) < 0.01 and abs((along**2).mean() - 1 / 3) < 0.01
    assert abs(np.mean(dr.dot(ω, first).numpy() > 0) - 0.5) < 0.01
    turned = np.arctan2(np.abs(dr.dot(ω, first).numpy()), np.abs(dr.dot(ω, dr.cross(axis, first)).numpy()))
    assert abs(angle) > np.pi / 2 or abs(turned.mean() - abs(angle) / 2) < 0.01 * abs(angle)


def test_same_light_as_by_any_direction(monkeypatch):
    """A coarse ball in the light of a room: the film boundary has the same mean, and a fraction of the noise."""
    case = cases.case("ball_on_floor")

    def images(count: int) -> np.ndarray:
        scene, options = case.scene(), {"sppc": 0, "sppi": 0}
        motion, integrator = Motion(scene, **case.motion), mi.load_dict({**case.integrator, **options})
        return np.array([derivative_image(scene, integrator, motion, spp=64, seed=i) for i in range(count)], float)

    new = images(16)
    monkeypatch.setattr(FilmOutlines, "lune", lambda *_: None)
    old = images(32)
    assert new.std(0).sum() < 0.4 * old.std(0).sum()
    expected = new.mean(0)
    p = (old * expected).sum((1, 2, 3)) / (expected**2).sum()
    assert abs(p.mean() - 1) < 4 * p.std() / len(p) ** 0.5 + 0.005
    sums = [i.sum((1, 2, 3)) for i in (old, new)]
    error = sum(s.var() / len(s) for s in sums) ** 0.5
    assert abs(sums[0].mean() - sums[1].mean()) < 4 * error
