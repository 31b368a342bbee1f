"""The lines in which meshes cut through each other: `geometry/intersections.py`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, cube_vertices, diffuse, horizontal, mesh, quad, scene
from random_scenes import ball, torus

from rimlight.edge_sampling import Geometry, Intersections, find_welded_edges
from rimlight.edge_sampling.geometry.beside import BESIDE_LINE, overhang
from rimlight.edge_sampling.geometry.device_edges import DeviceEdges
from rimlight.edge_sampling.geometry.rigid_motion import Shapes


def intersections(scene: mi.Scene) -> tuple[Intersections, Geometry]:
    geometry = Geometry.of(scene)
    lines = Intersections(scene, geometry, *find_welded_edges(geometry))
    lines.find(scene, geometry)
    return lines, geometry


def pieces(lines: Intersections, geometry: Geometry) -> np.ndarray:
    """Lower and upper ends of all lines: (N, 2, 3)."""
    if not lines.capacity:
        return np.zeros((0, 2, 3))
    a, b, *_ = lines.points([geometry.positions()])
    found = np.stack([np.array(a).T, np.array(b).T], 1)
    assert (found[lines.count :, 0] == found[lines.count :, 1]).all()  # space that is not needed
    return found[: lines.count]


def length(pieces: np.ndarray) -> float:
    return float(np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1).sum())


def by_all_pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Of triangles (F, 3, 3) and (G, 3, 3), the length of the line that each pair has in common: (F, G)."""
    found = np.zeros((len(first), len(second)))
    for i, p in enumerate(first):
        for j, q in enumerate(second):
            n, m = np.cross(p[1] - p[0], p[2] - p[0]), np.cross(q[1] - q[0], q[2] - q[0])
            along = np.cross(n, m)
            intervals = []
            for triangle, normal, origin in ((p, m, q[0]), (q, n, p[0])):
                h = (triangle - origin) @ normal
                cuts = [
                    triangle[k] + (triangle[k - 1] - triangle[k]) * h[k] / (h[k] - h[k - 1])
                    for k in range(3)
                    if h[k] * h[k - 1] < 0
                ]
                intervals.append(sorted(c @ along for c in cuts) if len(cuts) == 2 else (0, 0))
            lower, upper = max(i[0] for i in intervals), min(i[1] for i in intervals)
            found[i, j] = max(upper - lower, 0) / max(np.linalg.norm(along), 1e-30)
    return found


def corners(mesh: mi.Mesh) -> np.ndarray:
    vertices = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3).astype(float)
    return vertices[np.array(mesh.faces_buffer()).reshape(-1, 3)]


@pytest.mark.parametrize("seed", range(2))
def test_each_line_counts_once(seed):
    rng = np.random.default_rng(seed)
    shapes = []
    for k in range(3):
        vertices, _, _, faces = (ball, torus)[k % 2](3 + k)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        shapes.append(mesh(f"shape{k}", vertices @ turn * 0.8 + rng.uniform(-0.4, 0.4, 3), faces, bsdf=diffuse(0.5)))
    found = pieces(*intersections(scene(**{s.id(): s for s in shapes})))
    triangles = [corners(s) for s in shapes]
    expected = [by_all_pairs(triangles[i], triangles[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert length(found) == pytest.approx(sum(e.sum() for e in expected), rel=2e-4)
    assert len(found) == pytest.approx(sum((e > 1e-4).sum() for e in expected), abs=3)


def crossing(turn: float = 0.0) -> dict[str, mi.Mesh]:
    """Two squares of side 2 that cross in their middle."""
    c, s = np.cos(turn), np.sin(turn)
    return {
        "flat": horizontal((0, 0, 0), 1, "flat", bsdf=diffuse(0.5)),
        "upright": quad((-c, -1, -s), (2 * c, 0, 2 * s), (0, 2, 0), "upright", bsdf=diffuse(0.5)),
    }


@pytest.mark.parametrize("turn", [0.3, 1.0, 2.2])
def test_lines_end_where_one_of_the_meshes_does(turn):
    found = pieces(*intersections(scene(**crossing(turn))))
    assert length(found) == pytest.approx(2, rel=1e-5)
    assert np.abs(found[..., 1]).max() < 1e-6
    assert np.linalg.norm(found, axis=2).max() == pytest.approx(1, abs=1e-5)


def test_lines_that_end_where_the_edges_of_both_meshes_meet():
    """A wall as wide as the floor that it stands in."""
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5))
    wall = quad((-2, -0.5, 0.9), (4, 0, 0), (0, 2.5, 0), "wall", bsdf=diffuse(0.5))
    lines, geometry = intersections(scene(floor=floor, wall=wall))
    found = pieces(lines, geometry)
    assert len(found) == 3
    assert length(found) == pytest.approx(4, rel=1e-5)


def test_what_only_touches_does_not_cut():
    upright = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (0, 1) for x in (-0.5, 0.5)])
    box = mesh("box", upright, CUBE_FACES, bsdf=diffuse(0.5))
    beside = mesh("beside", np.add(upright, [1, 0, 0.2]), CUBE_FACES, bsdf=diffuse(0.5))
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5))
    lines, _ = intersections(scene(box=box, beside=beside, floor=floor))
    assert lines.shapes == (0, 1, 2)  # their boxes touch
    assert lines.capacity == lines.count == 0


def tiles(n: int, y: float = 0.0, turn: int = 0) -> mi.Mesh:
    """n × n squares of side 1 around the origin, of two triangles each, looking up, or down if `turn` is −1."""
    at = np.arange(n + 1) - n / 2
    corners = np.array([[x, y, z] for z in at for x in at])
    first = [j * (n + 1) + i for j in range(n) for i in range(n)]
    faces = np.array([f for a in first for f in ([a, a + n + 1, a + 1], [a + 1, a + n + 1, a + n + 2])])
    return mesh("tiles", corners, faces[:, ::-1] if turn < 0 else faces, bsdf=diffuse(0.5))


def upright_box(low: tuple, high: tuple, rows: int = 1) -> mi.Mesh:
    """A box whose four sides are divided into rows."""
    round_ = [(low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2])]
    corners = [[x, y, z] for y in np.linspace(low[1], high[1], rows + 1) for x, z in round_]
    faces = [[0, 1, 2], [0, 2, 3], [4 * rows, 4 * rows + 2, 4 * rows + 1], [4 * rows, 4 * rows + 3, 4 * rows + 2]]
    for a, b in ((4 * r + k, 4 * r + (k + 1) % 4) for r in range(rows) for k in range(4)):
        faces += [[a, a + 4, b], [b, a + 4, b + 4]]
    return mesh("box", corners, faces, bsdf=diffuse(0.5))


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize(
    ("n", "low", "high"),
    [
        (1, (-0.3, -0.4, -0.3), (0.3, 0.4, 0.3)),  # corners on the diagonal of a square
        (4, (-1, -0.5, -1), (1, 0.5, 1)),  # along edges, with corners in common if there are two rows
        (4, (-1, -0.5, -0.7), (1, 0.5, 0.3)),
        (5, (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)),  # around one square
    ],
)
def test_a_box_in_the_edges_of_a_floor(n, low, high, rows, down):
    floor, box = tiles(n, turn=-down), upright_box(low, high, rows)
    lines, geometry = intersections(scene(floor=floor, box=box))
    expected = 2 * (high[0] - low[0] + high[2] - low[2])
    assert length(pieces(lines, geometry)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("above", [False, True])
def test_a_box_on_the_edges_of_a_floor_does_not_cut_it(above, rows, down):
    low, high = ((-1, 0, -1), (1, 1, 1)) if above else ((-1, -1, -1), (1, 0, 1))
    lines, _ = intersections(scene(floor=tiles(4, turn=-down), box=upright_box(low, high, rows)))
    assert lines.shapes
    assert lines.count == 0


def test_a_ball_in_a_floor_exactly_to_a_ring_of_its_edges():
    """The ring is a line, and its edges rest, which no other edges do."""
    points, _, _, faces = ball(8)
    floor = horizontal((0, 0, 0), 2, "floor", bsdf=diffuse(0.5))
    thing = mesh("ball", np.round(points[:, [1, 2, 0]], 6), faces, bsdf=diffuse(0.5))
    lines, geometry = intersections(scene(floor=floor, ball=thing))
    assert length(pieces(lines, geometry)) == pytest.approx(2 * 16 * np.sin(np.pi / 16), rel=1e-4)
    edges, _ = find_welded_edges(geometry)
    ring = (geometry.host_positions()[edges.vertices[:, 0], 1] == 0).all(1) & (edges.mesh == 1).all(1)
    assert ring.sum() == 16
    geometry = replace(geometry, lines=(lines,))
    all_edges = lines.as_edges(edges, sum(m.vertex_count() for m in geometry.meshes))
    rests = DeviceEdges(all_edges, geometry).rests(dr.arange(mi.UInt32, len(all_edges))).numpy()
    assert (rests == np.append(ring, np.zeros(lines.capacity, bool))).all()


@pytest.mark.parametrize("first", ["box", "floor"])
def test_whose_edges_a_box_has_that_stands_on_those_of_a_floor(first):
    shapes = {"floor": tiles(4), "box": upright_box((0, 0, 0), (1, 1, 1))}
    geometry = Geometry.of(scene(**dict(sorted(shapes.items(), key=lambda item: item[0] != first))))
    edges, _ = find_welded_edges(geometry)
    positions = geometry.host_positions()[edges.vertices[:, 0]]
    foot = (positions[..., 1] == 0).all(1) & (edges.count > 2)
    foot &= (positions[:, 0, 0] == positions[:, 1, 0]) | (positions[:, 0, 2] == positions[:, 1, 2])
    assert foot.sum() == 4
    assert {geometry.meshes[i].id() for i in edges.mesh[foot].ravel()} == {"box"}


def test_a_mesh_that_cuts_through_itself():
    vertices = np.concatenate([cube_vertices(), np.add(cube_vertices(), [0.5, 0.3, 0.2])])
    both = mesh("both", vertices, [*CUBE_FACES, *(np.array(CUBE_FACES) + 8)], bsdf=diffuse(0.5))
    lines, geometry = intersections(scene(both=both))
    one, other = np.split(corners(both), 2)
    assert length(pieces(lines, geometry)) == pytest.approx(by_all_pairs(one, other).sum(), rel=1e-4)


@pytest.mark.parametrize("turn", [0.0, 1.2, 2.5, 4.1])
@pytest.mark.parametrize("meshes", [1, 2])
def test_triangles_with_a_corner_in_common(turn, meshes):
    """Two triangles with a corner in the origin, of which the second goes through the first, from y > 0 to y < 0."""
    triangles = np.array([[[0, 0, 0], [1, 0, -0.5], [1, 0, 0.5]], [[0, 0, 0], [0.7, 0.4, 0.1], [0.6, -0.5, 0]]])
    (_, a, b), t = triangles[1], 0.4 / 0.9
    end = (1 - t) * a + t * b
    c, s = np.cos(turn), np.sin(turn)
    triangles = triangles @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    faces = np.arange(6 // meshes).reshape(-1, 3)
    shapes = [mesh(f"m{k}", p, faces, bsdf=diffuse(0.5)) for k, p in enumerate(triangles.reshape(meshes, -1, 3))]
    found = pieces(*intersections(scene(**{m.id(): m for m in shapes})))
    assert len(found) == 1
    assert length(found) == pytest.approx(np.linalg.norm(end), rel=1e-5)
    assert np.linalg.norm(found, axis=2).min() < 1e-6  # it begins in the corner


def test_a_mesh_that_comes_to_cut_through_itself():
    vertices = np.concatenate([cube_vertices(), np.add(cube_vertices(), [2.5, 0.3, 0.2])])
    there = scene(both=mesh("both", vertices, [*CUBE_FACES, *(np.array(CUBE_FACES) + 8)], bsdf=diffuse(0.5)))
    lines, geometry = intersections(there)
    assert lines.capacity == 0
    params = mi.traverse(there)
    for step, (shift, cuts) in enumerate(((2.0, True), (0.0, False), (2.0, True))):
        moved = vertices - np.repeat([[0, 0, 0], [shift, 0, 0]], 8, 0)
        params["both.vertex_positions"] = mi.Float(moved.astype(np.float32).ravel())
        params.update()
        # Frozen functions that find others are recorded again: not whenever a shape comes and goes.
        assert lines.find(there, geometry) == (step == 0)
        one, other = np.split(corners(geometry.meshes[0]), 2)
        assert length(pieces(lines, geometry)) == pytest.approx(by_all_pairs(one, other).sum(), rel=1e-4)
        assert (lines.count > 0) == cuts
        assert lines.shapes == (0,)


@pytest.mark.parametrize("flat", [False, True])
def test_which_meshes_change_their_shapes(flat):
    vertices, _, _, faces = ball(6)
    vertices = vertices * [1, 1, 0] if flat else vertices
    geometry = Geometry.of(scene(ball=mesh("ball", vertices, faces, bsdf=diffuse(0.5))))
    shapes = Shapes(geometry)
    array = lambda v: [mi.Float(v.astype(np.float32).ravel())]
    assert shapes.changed(array(vertices)) == {0}
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    for moved in (vertices, np.add(vertices, [10, 0, 3]), vertices @ turn, np.add(0.3 * vertices @ turn, [1, 2, 3])):
        assert shapes.changed(array(moved)) == set()
    for k in range(len(vertices)):
        bent = vertices.copy()
        bent[k, 2] += 1e-4
        assert shapes.changed(array(bent)) == {0}
        assert shapes.changed(array(vertices)) == {0}


def test_lines_follow_the_planes_of_both_meshes():
    """Finite differences of the ends, across the line: along it, they may slide."""
    there = scene(
        a=mesh("a", cube_vertices(), CUBE_FACES, bsdf=diffuse(0.5)),
        b=mesh("b", 0.8 * cube_vertices() @ np.diag([1, -1, -1]) + [0.7, 0.4, 0.1], CUBE_FACES, bsdf=diffuse(0.5)),
    )
    lines, geometry = intersections(there)
    rng = np.random.default_rng(1)
    start = np.array(geometry.positions(), float)
    velocity = rng.normal(size=len(start)) * 0.3

    def ends(θ: float) -> np.ndarray:
        a, b, *_ = lines.points([mi.Float((start + θ * velocity).astype(np.float32))])
        return np.stack([np.array(a).T, np.array(b).T], 1)[: lines.count].astype(float)

    θ = mi.Float(0)
    dr.enable_grad(θ)
    attached = lines.points([mi.Float(start.astype(np.float32)) + θ * mi.Float(velocity.astype(np.float32))])[:2]
    dr.forward(θ)
    moved = np.stack([np.array(dr.grad(p)).T for p in attached], 1)[: lines.count].astype(float)
    h = 1e-3
    differences = (ends(h) - ends(-h)) / (2 * h)
    at = ends(0)
    long = np.linalg.norm(at[:, 1] - at[:, 0], axis=1) > 0.05
    along = (at[:, 1] - at[:, 0]) / np.linalg.norm(at[:, 1] - at[:, 0], axis=1)[:, None]
    across = lambda v: v - (v * along[:, None]).sum(2, keepdims=True) * along[:, None]
    assert long.sum() > 5
    np.testing.assert_allclose(across(moved)[long], across(differences)[long], atol=5e-3)


def test_lines_are_found_again_when_meshes_move():
    there = scene(**crossing(1.0))
    lines, geometry = intersections(there)
    assert lines.count > 0
    params = mi.traverse(there)
    still = mi.Float(params["upright.vertex_positions"])
    assert not lines.find(there, geometry)
    params["upright.vertex_positions"] = still + mi.Float([0, 5, 0] * 4)
    params.update()
    assert not lines.find(there, geometry)  # there is space for those of before
    assert lines.count == 0
    params["upright.vertex_positions"] = still
    params.update()
    assert not lines.find(there, geometry)
    assert lines.count > 0


def test_lines_are_edges_after_all_others():
    there = scene(**crossing(0.3))
    lines, geometry = intersections(there)
    edges, _ = find_welded_edges(geometry)
    both = lines.as_edges(edges, 8)
    assert both.is_line.sum() == lines.capacity
    assert not both.is_line[: len(edges)].any()
    extended = replace(geometry, lines=(lines,))
    assert dr.width(extended.positions()) == 3 * (8 + lines.vertices)
    assert len(extended.host_positions()) == 8 + lines.vertices == both.vertices.max() + 1 + 2 * lines.capacity
    assert dr.width(extended.normals()) == 3 * (8 + lines.vertices)


@pytest.mark.parametrize(("angle", "expected"), [(0, np.sqrt(1 / 3)), (90, 0.0), (180, np.sqrt(1 / 3)), (270, 0.0)])
def test_how_far_rays_beside_a_line_start_below_the_other_surface(angle, expected):
    """Two sheets cut each other at 60°; the viewer stands between them, on one of four sides."""
    axis = lambda degrees: np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    sheet = lambda name, d: quad(-d - [0, 0, 0.9], 2 * d, [0, 0, 2], name, bsdf=diffuse(0.5))
    made = scene(first=sheet("first", axis(30)), second=sheet("second", axis(-30)))
    lines, geometry = intersections(made)
    geometry = replace(geometry, lines=(lines,))
    edges, _ = find_welded_edges(geometry)
    count = len(edges)
    edges = lines.as_edges(edges, sum(m.vertex_count() for m in geometry.meshes))
    device = DeviceEdges(edges, geometry)
    edge = count + dr.arange(mi.UInt32, lines.count)
    towards = mi.Vector3f(*map(float, 5 * axis(angle)))
    found = overhang(*device._normals_of_line(geometry.positions(), edge, mi.Point3f(0), towards)).numpy()
    np.testing.assert_allclose(found, BESIDE_LINE[0] * expected, atol=1e-5)
