"""Edges: welding, adjacency, classification."""

import time

import cases
import mitsuba as mi
import numpy as np
import pytest

from rimlight.edge_sampling import EdgeKind, Geometry, find_edges
from rimlight.edge_sampling.geometry.beside import passes


def edges_of(*meshes):
    return find_edges(Geometry(tuple(meshes), ()))


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A wavy sheet of n × n vertices."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    vertices = np.stack([x, y, np.sin(3 * x) * np.cos(2 * y)], -1).reshape(-1, 3)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def test_cube_has_18_edges_however_it_is_stored():
    for shape in (cases.welded_cube(), cases.split_cube()):
        edges = edges_of(shape)
        assert len(edges) == 18
        assert (edges.kind == EdgeKind.FLAT).all()
        assert not edges.open.any()


def test_split_vertices_name_both_copies():
    edges = edges_of(cases.split_cube())
    assert (edges.vertices[:, 0] != edges.vertices[:, 1]).all()
    position = np.array(cases.split_cube().vertex_positions_buffer()).reshape(-1, 3)
    assert np.allclose(position[edges.vertices[:, 0]], position[edges.vertices[:, 1]])


def test_rectangle_has_four_open_edges():
    edges = edges_of(mi.load_dict({"type": "rectangle"}))
    assert edges.open.sum() == 4
    assert (edges.kind[edges.open] == EdgeKind.JUMP).all()
    assert len(edges) == 5


def test_sides_of_an_edge_share_its_end_points():
    vertices, faces = grid(8)
    edges = edges_of(cases.mesh("sheet", vertices, faces))
    assert (edges.vertices[:, 0] == edges.vertices[:, 1]).all()
    assert (edges.opposite[~edges.open, 0] != edges.opposite[~edges.open, 1]).all()
    assert len(edges) == 7 * 8 * 2 + 49  # Euler: V − E + F = 1
    assert edges.open.sum() == 28


def test_interpolated_normals_leave_silhouettes_only():
    edges = edges_of(cases.torus())
    assert (edges.kind == EdgeKind.SMOOTH).all()


def test_degenerate_and_repeated_triangles_are_ignored():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]]
    clean = edges_of(cases.mesh("clean", vertices, [[0, 1, 2], [1, 3, 2]]))
    messy = edges_of(cases.mesh("messy", vertices, [[0, 1, 2], [1, 3, 2], [2, 1, 0], [0, 1, 2], [1, 1, 2], [3, 3, 3]]))
    assert messy.summary() == clean.summary()


def test_fan_of_three_faces_jumps():
    vertices = [[0, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0.2], [0, 0, 1]]
    edges = edges_of(cases.mesh("fan", vertices, [[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert len(edges) == 7
    assert (edges.kind == EdgeKind.JUMP).all()


@pytest.mark.parametrize("smooth", [False, True])
def test_faces_that_look_to_different_sides_jump(smooth):
    """Of one of them, the back is seen."""
    vertices, faces = grid(4)
    faces = faces.copy()
    faces[3] = faces[3, ::-1]
    turned = edges_of(cases.mesh("sheet", vertices, faces, normals=smooth))
    around = np.sort(turned.vertices[turned.kind == EdgeKind.JUMP, 0][~turned.open[turned.kind == EdgeKind.JUMP]], 1)
    a, b, c = np.sort(faces[3])
    assert {tuple(e) for e in around.tolist()} <= {(a, b), (a, c), (b, c)} and len(around) >= 2


def test_edges_of_two_meshes_that_coincide_are_one():
    """Even if their coordinates differ by rounding, as after two transformations."""
    left = cases.mesh("left", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    shift = np.float32(1e-7)
    right = cases.mesh("right", [[1, 0, 0], [1 + shift, 1, 0], [shift, 1, 0]], [[0, 1, 2]])
    edges = edges_of(left, right)
    assert len(edges) == 5
    assert (edges.mesh[:, 0] != edges.mesh[:, 1]).sum() == 1
    assert (edges.kind == EdgeKind.JUMP).all()


def test_texture_seam_jumps():
    sphere = mi.load_dict({"type": "cube"})
    seams = edges_of(sphere)
    assert (seams.kind == EdgeKind.JUMP).sum() == 12


def test_vertices_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match='"bad": 1 vertices are not finite'):
        edges_of(cases.mesh("bad", [[0, 0, 0], [1, np.nan, 0], [0, 1, 0]], [[0, 1, 2]]))


def test_scene_without_meshes_has_no_edges():
    assert len(edges_of()) == 0


def test_a_million_triangles():
    vertices, faces = grid(708)
    sheet = cases.mesh("sheet", vertices, faces)
    start = time.perf_counter()
    edges = edges_of(sheet)
    print(f"{len(faces)} triangles: {time.perf_counter() - start:.2f} s")
    assert len(edges) == 3 * 707**2 + 2 * 707


@pytest.mark.parametrize("distance", [1.0, 100.0])
def test_rays_pass_through_fine_faces_or_past_them(distance):
    """However far away they start: single precision loses 10⁻⁷ of the distance, not of its square."""
    random = np.random.default_rng(1)
    n, size, aside = 1000, 5e-3 * distance, 4e-7 * distance
    a, b, c = (size * random.normal(size=(3, n)) for _ in range(3))
    d = random.normal(size=(3, n))
    d /= np.linalg.norm(d, axis=0)
    across = np.cross(b - a, d, axis=0)
    across *= np.sign(((c - a) * across).sum(0)) / np.linalg.norm(across, axis=0)
    p = a + random.uniform(0.1, 0.9, n) * (b - a)
    wide = ((c - p) * across).sum(0) > 20 * aside
    for sign in (1, -1):
        ray = mi.Ray3f(mi.Point3f(p + sign * aside * across - distance * d), mi.Vector3f(d))
        through = np.array(passes(ray, mi.Point3f(p), [mi.Point3f(x) for x in (a, b, c)]))
        assert wide.sum() > n / 2
        assert (through[wide] == (sign > 0)).all()
