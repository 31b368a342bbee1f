"""What vertices of paths hold fixed, where they are close to each other: `parametrisation.py`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import diffuse, horizontal, scene

from rimlight.edge_sampling.parametrisation import look_from, sliding_point

#: Distance of the scene from the origin, where a unit in the last place is 0.002.
FAR = 30_000.0

#: Distances between two vertices: from thirty such units on. What is closer to a plane than 16 is taken to be in it.
DISTANCES = np.geomspace(0.06, 400, 64)


def turn(move, held=0.0):
    """The derivative of the direction in which points of a floor are looked at, along rays that come down at 45° from
    points in these distances, times the distance: (3, 64).

    move : (θ, x, parameters) -> the point that looks; it may change the parameters. held : see `sliding_point`.
    """
    there = scene(floor=horizontal((FAR, 0, FAR), 1000, "floor", bsdf=diffuse(0.5)))
    params, θ = mi.traverse(there), mi.Float(0)
    dr.enable_grad(θ)
    dr.set_grad(θ, 1)
    d = mi.Vector3f(dr.sqrt(0.5), -dr.sqrt(0.5), 0)
    x = mi.Point3f(mi.Float(FAR + 3.3 * np.arange(64)), mi.Float(DISTANCES * np.sqrt(0.5)), FAR)
    ray = mi.Ray3f(x, d)
    pi = there.ray_intersect_preliminary(ray)
    assert dr.all(pi.is_valid())
    ray.o = move(θ, x, params)
    si = sliding_point(there, ray, pi, mi.Float(held), mi.Bool(True))
    look_from(si, ray.o, ray, pi.t)
    assert np.allclose(np.array(dr.detach(si.to_world(si.wi))), -np.array(d), atol=1e-6)
    return np.array(dr.forward_to(si.to_world(si.wi))) * np.array(pi.t)


def test_what_slides_away_along_the_ray_does_not_turn():
    """The floor sinks as fast as the scene is far away: points that slide over it part from those that look at them.
    The difference of points that close is rounding to a part, which must not turn the direction (by 500, it did)."""

    def sink(θ, x, params):
        p = dr.unravel(mi.Point3f, params["floor.vertex_positions"])
        params["floor.vertex_positions"] = dr.ravel(p - mi.Vector3f(0, FAR, 0) * θ)
        params.update()
        return x

    assert np.abs(turn(sink)).max() < 1e-5 * FAR


@pytest.mark.parametrize("across", [(1, 1, 0), (0, 0, 1)])
def test_what_moves_across_the_ray_turns(across):
    """The point that looks moves across its ray. What slides goes along, and nothing turns; from a material point, that
    point is seen in another direction, the more so the closer it is."""
    moves = lambda θ, x, params: x + mi.Vector3f(across) * θ
    assert np.abs(turn(moves)).max() < 1e-4
    assert np.abs(turn(moves, held=1.0).T - across).max() < 1e-4


@pytest.mark.parametrize(("units", "slides"), [(8, False), (32, True)])
def test_rays_from_a_plane_do_not_slide_over_it(units, slides):
    """The point where a ray meets a floor slides by the height over it through the cosine. Both are rounding, where the
    ray starts in the floor's own plane: in the corner of a room, say, whose camera moves."""
    there = scene(floor=horizontal((0, 0, 0), 1, "floor", bsdf=diffuse(0.5)))
    height, θ = units * dr.epsilon(mi.Float), mi.Float(0)
    dr.enable_grad(θ)
    dr.set_grad(θ, 1)
    d = dr.normalize(mi.Vector3f(0.3, -height, 0))
    ray = mi.Ray3f(mi.Point3f(-0.9, height, 0), d)
    pi = there.ray_intersect_preliminary(ray)
    assert dr.all(pi.is_valid())
    ray.o = ray.o + mi.Vector3f(0, θ, 0)
    p = sliding_point(there, ray, pi, mi.Float(0), mi.Bool(True)).p
    speed = np.array(dr.forward_to(p)).ravel()
    assert np.allclose(speed, [slides * 0.3 / height, 0, 0], rtol=1e-3)
