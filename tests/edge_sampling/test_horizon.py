"""Curves in which interpolated normals turn away from a viewer."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import mesh
from skimage.measure import find_contours

from rimlight.edge_sampling import Geometry
from rimlight.edge_sampling.boundaries.horizon import Horizons

CORNERS = np.array([[-0.9, 0.3, 0.1], [0.6, 0.35, 0.4], [0.5, 1.4, 0.1]])

#: As of a leaf of few triangles.
NORMALS = np.array([[-0.3, -0.5, 0.8], [0.6, -0.2, 0.8], [0.3, 0.7, 0.6]])


def length_by_contours(eye: np.ndarray, n: int = 1200) -> float:
    """On a grid of points of the triangle."""
    b, c = np.meshgrid(*[np.linspace(0, 1, n)] * 2, indexing="ij")
    at = lambda of: (1 - b - c)[..., None] * of[0] + b[..., None] * of[1] + c[..., None] * of[2]
    normals = NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)
    total = 0.0
    for line in find_contours((at(normals) * (eye - at(CORNERS))).sum(-1), 0):
        s, t = line.T / (n - 1)
        p = (1 - s - t)[:, None] * CORNERS[0] + s[:, None] * CORNERS[1] + t[:, None] * CORNERS[2]
        inside = s + t <= 1
        total += np.linalg.norm(np.diff(p, axis=0), axis=1)[inside[1:] & inside[:-1]].sum()
    return total


def length_by_samples(eye: np.ndarray, count: int = 40000) -> float:
    face = mesh("leaf", CORNERS, [[0, 1, 2]], normals=True)
    params = mi.traverse(face)
    params["vertex_normals"] = np.float32(NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)).ravel()
    params.update()
    geometry = Geometry((face,), ())
    horizons = Horizons(geometry, np.array([True]))
    # Stratified. (The last digits choose where a line meets the curve twice.)
    u = (dr.arange(mi.Float, count) + mi.Float(np.random.default_rng(0).uniform(size=count))) / count
    at = geometry.positions(), geometry.normals(), dr.zeros(mi.UInt32, count), u, mi.Point3f(*eye.tolist())
    found = horizons.point(*at, False)
    return float(dr.mean(dr.select(found.valid, dr.norm(found.tangent), 0))[0])


#: Through how many sides the curve enters and leaves, without parting corners.
EYES = {
    "parts the corners": (0.2, -0.5, 0.9),
    "through one side": (-0.2, 0.05, 0.28),
    "through two sides": (-0.55, 0.02, 0.1),
    "nowhere": (0.1, 0.6, 5.0),
}


@pytest.mark.parametrize("eye", EYES.values(), ids=EYES)
def test_all_of_a_curve_is_sampled(eye):
    truth = length_by_contours(np.array(eye))
    assert length_by_samples(np.array(eye)) == pytest.approx(truth, rel=0.02, abs=1e-3)


def test_all_of_curves_close_to_a_face():
    """From everywhere, whatever sides they go through."""
    rng = np.random.default_rng(0)
    lengths = []
    for _ in range(60):
        middle = rng.dirichlet(np.ones(3)) @ CORNERS
        eye = middle + rng.normal(size=3) * [0.5, 0.5, 0.1]
        lengths.append((length_by_samples(eye), length_by_contours(eye, 600)))
    found, truth = np.array(lengths).T
    assert (truth > 0).sum() > 20
    np.testing.assert_allclose(found, truth, rtol=0.05, atol=0.01)
