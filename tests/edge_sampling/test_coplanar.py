"""Faces of different materials that overlap in one plane."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from building import diffuse, mesh, scene
from random_rooms import box
from random_scenes import ball

from rimlight.edge_sampling import Geometry
from rimlight.edge_sampling.geometry.coplanar import coplanar_meshes

SHEET = np.array([[-1, 0, -1], [1, 0, -1], [-1, 0, 1], [1, 0, 1]], float)
FACES = np.array([[0, 2, 1], [1, 2, 3]])


def found(**shapes) -> list[tuple[str, str]]:
    made = {k: mesh(k, *v, bsdf=diffuse(0.1 * (i + 1))) for i, (k, v) in enumerate(shapes.items())}
    return [(a.id(), b.id()) for a, b in coplanar_meshes(Geometry.of(scene(**made)))]


def turned(points: np.ndarray) -> np.ndarray:
    return points @ np.array(mi.ScalarTransform4f().rotate([0.3, 1, 0.2], 37).matrix)[:3, :3].T


@pytest.mark.parametrize("place", [lambda p: p, turned, lambda p: 1000 * p, lambda p: 0.001 * turned(p)])
@pytest.mark.parametrize(
    ("shift", "faces", "fight"),
    [
        ([0.5, 0, 0.3], FACES, True),
        ([0, 0, 0], FACES, True),
        ([2, 0, 0.3], FACES, False),  # side by side
        ([0.5, 0.001, 0.3], FACES, False),  # above
        ([0.5, 0, 0.3], FACES[:, ::-1], False),  # looks down, as the bottom of a box
    ],
)
def test_sheets(place, shift, faces, fight):
    sheets = {"one": (place(SHEET), FACES), "other": (place(SHEET + shift), faces)}
    assert found(**sheets) == ([("one", "other")] if fight else [])


def test_a_small_sheet_on_one_of_many_squares():
    squares = [0.25 * SHEET + [0.5 * x, 0, 0.5 * z] for x in range(12) for z in range(12)]
    faces = np.concatenate([FACES + 4 * k for k in range(len(squares))])
    decal = turned(0.02 * SHEET + [3, 0, 3.1])
    assert found(floor=(turned(np.concatenate(squares)), faces), decal=(decal, FACES)) == [("floor", "decal")]


def test_what_stands_on_a_floor_or_cuts_it_does_not():
    points, _, _, faces = box((-0.5, 0, -0.5), (0.5, 1, 0.5))
    assert not found(floor=(SHEET, FACES), box=(points, faces))
    round_, _, _, many = ball(12)
    assert not found(floor=(SHEET, FACES), ball=(round_, many), other=(np.add(round_, [0.3, 0.1, 0]), many))


def test_one_material_does_not():
    bsdf = mi.load_dict(diffuse(0.5))
    sheets = {k: mesh(k, np.add(SHEET, [x, 0, 0]), FACES, bsdf=bsdf) for k, x in (("one", 0), ("other", 0.5))}
    assert not coplanar_meshes(Geometry.of(mi.load_dict({"type": "scene", **sheets}, optimize=False)))
