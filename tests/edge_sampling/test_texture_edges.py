"""Pieces of the lines at which textures jump: where they are, and that each counts once."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.edge_sampling import Geometry
from rimlight.edge_sampling.geometry import texture_edges
from rimlight.edge_sampling.geometry.texture_edges import TextureEdges


def checkers(columns: float = 1.0) -> dict:
    to_uv = mi.ScalarTransform3f().scale([columns, 0.0])
    return {"type": "checkerboard", "to_uv": to_uv}


def board(reflectance: dict | None = None, width: float = 0.9, seam: float = 0.0, parts: int = 1, **more) -> mi.Mesh:
    """A sheet of 2 × 1 units in so many columns, each as wide; u runs from 0 to `width`, and is `seam` larger from
    each column to the next."""
    p, uv, faces = [], [], []
    for k in range(parts):
        first = len(p) if seam or not k else len(p) - 2
        for x in (k, k + 1)[0 if first == len(p) else 1 :]:
            p += [[2 * x / parts, 0, 0], [2 * x / parts, 1, 0]]
            uv += [[width * x / parts + seam * k, 0.1]] * 2
        faces += [[first, first + 2, first + 1], [first + 1, first + 2, first + 3]]
    bsdf = more or {"type": "diffuse", "reflectance": reflectance or checkers()}
    return cases.mesh("board", p, faces, uv=uv, bsdf=bsdf)


def length(mesh: mi.Mesh) -> float:
    """Of all pieces together."""
    edges = TextureEdges(Geometry((mesh,)), every=False)
    assert edges.find()
    assert not edges.find()
    a, b, *_ = edges.points([dr.detach(mesh.vertex_positions_buffer())])
    return float(dr.sum(dr.norm(b - a))[0])


@pytest.mark.parametrize(
    ("mesh", "lines"),
    [
        (lambda: board(), 1),
        (lambda: board(checkers(3)), 5),
        # A line on an edge inside of the mesh: once. At its border, or where coordinates do not go on: the edge has it.
        (lambda: board(width=1, parts=2), 1),
        (lambda: board(width=0.5), 0),
        (lambda: board(width=1, seam=1, parts=2), 0),
        # Of two textures, the lines may coincide.
        (
            lambda: board(
                type="blendbsdf",
                weight={**checkers(2), "color0": 0.2},
                first={"type": "diffuse", "reflectance": checkers()},
                second={"type": "diffuse", "reflectance": checkers(2)},
            ),
            3,
        ),
    ],
)
def test_each_line_counts_once(mesh, lines):
    assert length(mesh()) == pytest.approx(lines, abs=1e-5)


def test_they_follow_texture_coordinates():
    """A line u = 1/2 at x = 2 · 0.5 / 0.9 moves by −2 / 0.9 times the change of u."""
    mesh = board()
    edges, params = TextureEdges(Geometry((mesh,)), every=False), mi.traverse(mesh)
    edges.find()
    θ = mi.Float(0)
    dr.enable_grad(θ)
    params["vertex_texcoords"] = params["vertex_texcoords"] + θ
    params.update()
    ends = edges.points([mesh.vertex_positions_buffer()])[:2]
    dr.forward(θ)
    for p in ends:
        np.testing.assert_allclose(np.array(p)[0], 2 * 0.5 / 0.9, rtol=1e-5)
        np.testing.assert_allclose(np.array(dr.grad(p))[0], -2 / 0.9, rtol=1e-5)


def test_more_of_them_need_more_space():
    mesh = board()
    edges, params = TextureEdges(Geometry((mesh,)), every=True), mi.traverse(mesh)
    edges.find()
    for scale, more in ((1.05, False), (8, True), (0.1, False)):
        params["vertex_texcoords"] = mi.Float(np.ravel([[0.9 * scale * x / 2, 0.1] for x, *_ in corners_of(mesh)]))
        params.update()
        assert edges.find() == more
    assert len(edges.as_edges(0)) == edges.capacity


def corners_of(mesh):
    return np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)


def test_what_is_too_fine_is_left_out(monkeypatch):
    monkeypatch.setattr(texture_edges, "MOST", 5)
    mesh = board(checkers(3))
    edges = TextureEdges(Geometry((mesh,)), every=False)
    assert not edges.find()
    assert not edges.shapes([])


@pytest.mark.parametrize(("columns", "fine"), [(4.5, False), (9.0, True)])
def test_fine_textures_count_where_they_move_over_their_surface(columns, fine):
    mesh = board(checkers(columns))
    for every in (False, True):
        edges = TextureEdges(Geometry((mesh,)), every=every)
        edges.find()
        assert (edges.fine == (fine and not every)).all() and len(edges.fine) == edges.capacity > 0
        assert edges.shapes([mesh]) == [mesh] and edges.shapes([]) == [mesh] * (every or not fine)


def test_textures_that_are_no_longer_fine_are_found_anew():
    mesh = board(checkers(9.0))
    edges, params = TextureEdges(Geometry((mesh,)), every=False), mi.traverse(mesh)
    assert edges.find() and edges.fine.all() and not edges.find()
    params["vertex_texcoords"] *= 0.5
    params.update()
    assert edges.find() and not edges.fine.any()
