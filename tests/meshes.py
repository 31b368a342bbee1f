"""Meshes that several tests need."""

from __future__ import annotations

import cases
import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull


def bumpy_sphere(points: int, bumps: float = 0.15, normals: bool = True, centre=(0, 0, 0)) -> mi.Mesh:
    """A closed mesh of radius about 1, with 3 · `points` − 6 edges of about the same length."""
    i = np.arange(points) + 0.5
    height, longitude = 1 - 2 * i / points, np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - height**2)
    p = np.stack([radius * np.cos(longitude), height, radius * np.sin(longitude)], 1)
    faces = ConvexHull(p).simplices
    a, b, c = (p[faces[:, k]] for k in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    p *= 1 + bumps * np.sin(5 * p[:, :1] + 1) * np.cos(4 * p[:, 1:2]) * np.cos(6 * p[:, 2:])
    return cases.mesh("bumpy", p + np.array(centre), faces, normals)
