"""Views along an axis of symmetry, where edges that nobody sees lie on the film exactly where visible ones do.

There is no need for finite differences: turned by a thousandth of a radian, the view is an ordinary one, and its
derivative must be nearly the same.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, camera, constant, cube_vertices, diffuse, film, horizontal, mesh, scene
from random_scenes import ball

from rimlight.checks import Motion, derivative_image

#: By how much the ordinary view is turned: radians.
TURN = 1e-3

#: Where all objects lie, so that their edges lie on no border of pixels.
PLACE = np.array([0.013, 0.021, 0.0])

RUNS, SPP = 4, 128


def cube(name="cube", depth=0.0, angle=0.0, **options):
    c, s = np.cos(angle), np.sin(angle)
    turned = cube_vertices() @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    return mesh(name, turned + PLACE + [0, 0, depth], CUBE_FACES, bsdf=diffuse(0.7), **options)


def globe(coloured=False):
    """A ball of flat faces, whose pole is seen; or one whose faces have colours."""
    p, _, _, faces = ball(7)
    p = p + PLACE
    if not coloured:
        return mesh("ball", p, faces, bsdf=diffuse(0.7))
    colours = np.repeat(np.random.default_rng(0).uniform(0.1, 1, (len(faces), 3)), 3, 0)
    bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    return mesh("ball", p[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3), colours=colours, bsdf=bsdf)


VIEWS = {
    "cube": ("orthographic", lambda: [cube()]),
    "cube turned about an axis": ("orthographic", lambda: [cube(angle=0.35)]),
    "cubes in a row": ("orthographic", lambda: [cube(), cube("other", depth=-2)]),
    "ball": ("orthographic", lambda: [globe()]),
    "coloured ball": ("perspective", lambda: [globe(coloured=True)]),
}


def derivatives(objects, kind, turn):
    """Those with respect to a motion across the view: (RUNS, H, W, 3)."""
    eye = PLACE + 5 * np.array([np.sin(turn), np.sin(1.3 * turn), 1])
    objects = {o.id(): o for o in objects()}
    sun = {"type": "directional", "direction": [0.2, 0.3, -1], "irradiance": 3.0}
    view = camera(eye, PLACE, kind, film("gaussian"))
    there = scene(view=view, sky=constant(0.3), sun=sun, **objects)
    motions = [Motion(there, f"{name}.vertex_positions", direction=[1, 0.3, 0]) for name in objects]
    integrator = mi.load_dict({"type": "direct_edge"})
    each = [
        [np.array(derivative_image(there, integrator, motion, spp=SPP, seed=seed)) for seed in range(RUNS)]
        for motion in motions
    ]
    return np.sum(each, axis=0)


@pytest.mark.parametrize("name", VIEWS)
def test_hidden_edges_do_not_count(name):
    kind, objects = VIEWS[name]
    straight, turned = (derivatives(objects, kind, turn) for turn in (0, TURN))
    size = np.abs(turned.mean(0)).sum()
    noise = np.abs((turned[::2].mean(0) - turned[1::2].mean(0)) / 2).sum() / size
    assert noise < 0.03
    assert np.abs(straight.mean(0) - turned.mean(0)).sum() / size < 0.02 + 2 * noise


def test_box_in_the_sun_straight_above():
    """Four of its faces are seen edge-on by the sun: just one border of each throws a shadow."""

    def derivative(turn):
        lamp = {"type": "directional", "direction": [np.sin(turn), -1, np.sin(1.3 * turn)], "irradiance": 20.0}
        floor = horizontal(PLACE - [0, 1.2, 0], 3, "floor", bsdf=diffuse(0.5))
        there = scene(view=camera((1, 4, -5), film=film("gaussian")), sun=lamp, cube=cube(), floor=floor)
        motion = Motion(there, "cube.vertex_positions", direction=[1, 0, 0.3])
        # Without what the camera sees of the box itself.
        integrator = mi.load_dict({"type": "direct_edge", "sppc": 0, "sppp": 0})
        runs = [np.array(derivative_image(there, integrator, motion, spp=SPP, seed=s)) for s in range(RUNS)]
        return np.mean(runs, axis=0)

    straight, turned = derivative(0), derivative(TURN)
    assert np.abs(turned).sum() > 1
    assert np.abs(straight - turned).sum() / np.abs(turned).sum() < 0.03
