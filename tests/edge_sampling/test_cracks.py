"""Open edges that lie on one another are joined: T-junctions, and cracks that are narrower than a tolerance."""

from __future__ import annotations

import cases
import cuts
import mitsuba as mi
import numpy as np
import pytest
import tidy

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling import EdgeKind, Geometry, close_cracks, find_welded_edges


def joined(*meshes):
    """The edges of meshes after and before, and where they were joined."""
    geometry = Geometry(tuple(meshes))
    edges, weld = find_welded_edges(geometry)
    return *close_cracks(geometry, edges, weld), edges


def strip(name: str, *points, **more):
    """Triangles beside each other."""
    return cases.mesh(name, points, [[k, k + 1, k + 2] for k in range(len(points) - 2)], **more)


LONG = ([0, 0, 0], [0, 2, 0], [-1, 1, 0])


def test_a_cube_of_faces_that_are_divided_differently_is_closed():
    cube = next(s for s in cuts.patchwork().shapes() if s.id() == "cube")
    edges, cracks, before = joined(cube)
    assert before.open.sum() == 48 and not edges.open.any() and edges.joined.any()
    assert (edges.kind == EdgeKind.FLAT).all() and not cracks.widest()
    ends = Geometry((cube,)).host_positions()[edges.vertices.astype(int)]
    a, b = ends[:, :, 0, None], ends[:, :, 1, None]
    sides = a + edges.part[..., None] * (b - a)
    np.testing.assert_allclose(sides[:, 0], sides[:, 1], atol=1e-6)
    # Both faces of an edge are faces of the cube: at right angles, or in one plane.
    along = sides[:, 0, 1] - sides[:, 0, 0]
    away = Geometry((cube,)).host_positions()[edges.opposite.astype(int)] - sides[:, 0, :1]
    normals = np.cross(along[:, None], away)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    cosine = -np.einsum("ij,ij->i", normals[:, 0], normals[:, 1])
    assert ((np.abs(cosine) < 1e-5) | (np.abs(cosine - 1) < 1e-5)).all()


def test_the_part_of_a_long_edge_on_which_nothing_lies_stays_open():
    edges, cracks, _ = joined(strip("long", *LONG), strip("partly", [0, 1, 0], [0, 3, 0], [1, 2, 0]))
    new = edges.take(edges.joined)
    assert sorted(new.count) == [1, 1, 2] and len(cracks) == 2 and (new.kind == EdgeKind.JUMP).all()
    parts = {tuple(p) for p in new.part[:, 0].tolist()}
    assert parts == {(0.0, 0.5), (0.5, 1.0)}


def test_where_things_stand_side_by_side_their_edges_are_one():
    """Of two boxes that are flush at the front and the back, one twice as high: an edge has four faces as far as both
    have it, and the rest of the higher one is as before."""
    low, high = tidy.block("low", (-1, 0, 0), (0, 0.5, 1), 0.5), tidy.block("high", (0, 0, 0), (1, 1, 1), 0.5)
    edges, cracks, before = joined(low, high)
    folds = lambda e: e.take(e.kind != EdgeKind.SMOOTH)
    assert not before.open.any() and len(cracks) == 2
    new = edges.take(edges.joined)
    assert sorted(new.count) == [2, 2, 4, 4] and len(edges) == len(before)
    assert (new.kind[new.count == 4] == EdgeKind.JUMP).all() and (new.kind[new.count == 2] == EdgeKind.FLAT).all()
    ends = Geometry((low, high)).host_positions()[new.vertices.astype(int)]
    a, b = ends[:, :, 0], ends[:, :, 1]
    heights = (a + new.part[..., :1] * (b - a))[..., 1], (a + new.part[..., 1:] * (b - a))[..., 1]
    np.testing.assert_allclose(np.sort(np.minimum(*heights)[:, 0]), [0, 0, 0.5, 0.5], atol=1e-6)
    assert len(folds(edges)) == len(folds(before))


@pytest.mark.parametrize(
    "other",
    [
        strip,
        lambda name: strip(name, [0, 1, 0], [1, 1, 0], [1, 2, 0]),  # a corner on it
        lambda name: strip(name, [0, 2.1, 0], [0, 3, 0], [1, 2, 0]),  # beyond its end
        lambda name: strip(name, [1e-3, 1, 0], [1e-3, 2, 0], [1, 2, 0]),  # beside it
    ],
    ids=["nothing", "corner", "beyond", "beside"],
)
def test_what_does_not_lie_on_one_another_stays_as_it_is(other):
    name = "other"
    others = () if other is strip else (other(name),)
    edges, cracks, before = joined(strip("long", *LONG), *others)
    assert len(cracks) == 0 and edges is before


@pytest.mark.parametrize("inside", [True, False], ids=["inside", "at the ends"])
def test_narrow_cracks_are_closed_and_known(inside):
    ends = [[8e-6, 0, 0], [8e-6, 1, 0], [8e-6, 2, 0], [1, 1, 0]]
    p, faces = (ends, [[0, 3, 1], [1, 3, 2]]) if inside else (ends[::2] + ends[3:], [[0, 2, 1]])
    edges, cracks, _ = joined(strip("long", *LONG), cases.mesh("other", p, faces))
    assert edges.open.sum() == 4 and cracks.widest() == {(0, 1): pytest.approx(8e-6)}


def test_many_open_edges_take_seconds():
    """A soup of 100,000 triangles: 300,000 open edges."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (100_000, 1, 3)) + rng.uniform(-0.01, 0.01, (100_000, 3, 3))
    edges, cracks, _ = joined(cases.mesh("soup", p.reshape(-1, 3), np.arange(300_000).reshape(-1, 3)))
    assert len(edges) == 300_000 and len(cracks) == 0


# ---------------------- Faces without area ----------------------

BOARD = [[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]
HALVES = [[0, 2, 1], [1, 2, 3]]


def board(faces, *points):
    return cases.mesh("board", [*BOARD, *points], [*HALVES, *faces], bsdf=cases.diffuse(0.5, two_sided=True))


def open_sides(edges, mesh) -> set:
    ends = Geometry((mesh,)).host_positions()[edges.vertices[edges.open, 0].astype(int)]
    return {frozenset(map(tuple, pair)) for pair in ends.tolist()}


@pytest.mark.parametrize("faces", [[[2, 4, 3]], [[2, 4, 3], [2, 5, 4]]])
def test_faces_without_area_along_open_borders_are_left_out(faces):
    """One of them, or two, one beside the other."""
    bare, mesh = board([]), board(faces, [0.5, 1, 0], [0, 1, 0])
    edges, cracks, _ = joined(mesh)
    assert open_sides(edges, mesh) == open_sides(joined(bare)[0], bare)
    assert len(edges) == 5 and len(cracks) == len(faces) and not cracks.widest()
    np.testing.assert_allclose(cracks.at, [0.25, 1 / 3][: len(faces)])


def test_a_face_without_area_stays_where_there_are_others_beyond_it():
    edges, cracks, _ = joined(board([[2, 4, 3], [2, 5, 4], [4, 5, 3]], [0.5, 1, 0], [0, 2, 0]))
    assert len(edges) == 10 and not len(cracks)


def test_a_face_without_area_along_an_open_border_does_not_count():
    """The border counted twice there. A vertex that leaves it makes a border of its own."""
    scenes = [
        cases.scene(sensor=cases.camera(), board=b, sky=cases.constant())
        for b in (board([]), board([[2, 4, 3]], [0.5, 1, 0]))
    ]
    integrator = mi.load_dict({"type": "direct_edge"})
    motion = {"key": "board.vertex_positions", "direction": [0.3, 1, 0.2]}
    images = [np.array(derivative_image(s, integrator, Motion(s, **motion), spp=16)) for s in scenes]
    assert np.abs(images[0]).max() > 0.1
    np.testing.assert_allclose(images[1], images[0], atol=1e-4 * np.abs(images[0]).max())
    assert len(integrator.search.edges) == 5
    params = mi.traverse(scenes[1])
    p = np.array(params["board.vertex_positions"]).reshape(-1, 3)
    p[4, 1] += 0.2
    params["board.vertex_positions"] = p.ravel()
    params.update()
    derivative_image(scenes[1], integrator, Motion(scenes[1], **motion), spp=1)
    assert len(integrator.search.edges) == 7
