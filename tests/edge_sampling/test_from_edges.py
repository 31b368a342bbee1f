"""Points that are found from edges: they share what is found from paths, and take nothing else away."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import CUBE_FACES, cube_vertices, diffuse, mesh

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.boundaries import from_edges
from rimlight.edge_sampling.boundaries.from_edges import FromEdge, FromEdges
from rimlight.edge_sampling.boundaries.tracer import ShadingPoint
from rimlight.edge_sampling.choice.sampling import EdgeSample
from rimlight.edge_sampling.choice.silhouettes import Silhouettes
from rimlight.edge_sampling.geometry.edges import find_edges
from rimlight.edge_sampling.geometry.meshes import Geometry
from rimlight.edge_sampling.parametrisation import Vicinity
from rimlight.terms.order import TERMS


def silhouettes_of(scene: mi.Scene, moving: tuple[bool, ...] | None = None) -> Silhouettes:
    geometry = Geometry.of(scene)
    return Silhouettes(geometry, find_edges(geometry), moving)


def test_both_ways_find_all_together():
    """Of every point of an edge that moves, whatever their densities; of others, and of emitted light, nothing is found
    from edges."""
    found = FromEdges.of(silhouettes_of(cases.cornell_box()))
    n, count = dr.width(found.edges), 512
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p = mi.Point3f(sampler.next_1d(), -0.99, sampler.next_1d())
    si.n = mi.Normal3f(0, 1, 0)
    depth = 1 + dr.arange(mi.UInt32, count) % 3
    density = dr.power(10, 8 * sampler.next_1d() - 4)
    no = dr.zeros(mi.Bool, count)
    point = ShadingPoint(si, depth, mi.Spectrum(1), ~no, no, Vicinity(mi.Float(1)), density)
    edge = dr.gather(mi.UInt32, found.edges, mi.UInt32(sampler.next_1d() * n))
    sample, placement = EdgeSample(edge, sampler.next_1d(), mi.Float(1)), found.silhouettes.placement()
    parts = {}
    for emission in (no, ~no):
        for way, chance in ((~no, from_edges.PART), (no, 1 - from_edges.PART)):
            one = FromEdge(found, point, way, sample, mi.Spectrum(1))
            parts[way[0], emission[0]] = np.array(chance * one.part(placement, sample, emission))[0]
    assert parts[True, False] + parts[False, False] == pytest.approx(np.ones(count), abs=1e-5)
    assert (parts[True, False] > 0.01).sum() > count / 20
    assert (parts[False, False] > 0.01).sum() > count / 2
    assert (parts[True, False][np.array(depth) == 1] == 0).all()
    assert (parts[True, True] == 0).all()


def test_not_of_many_edges(monkeypatch):
    silhouettes = silhouettes_of(cases.cornell_box())
    monkeypatch.setattr(from_edges, "MOST", len(silhouettes.moving_edges) - 1)
    assert FromEdges.of(silhouettes) is None


def lifted_box() -> mi.Scene:
    """The small box of the Cornell box, well above the floor."""
    scene = cases.cornell_box()
    params = mi.traverse(scene)
    p = params["small-box.vertex_positions"]
    params["small-box.vertex_positions"] = dr.ravel(dr.unravel(mi.Point3f, p) + mi.Point3f(0, 0.2, 0))
    params.update()
    return scene


def box_on_tray() -> mi.Scene:
    """In its place a box above a plate, in one mesh: what moves lights what moves with it."""
    plate = np.array([[x, -0.8, z] for x in (-0.3, 0.9) for z in (-0.3, 0.9)])
    vertices = np.concatenate([0.2 * cube_vertices() + [0.3, -0.35, 0.3], plate])
    faces = [*CUBE_FACES, [8, 9, 10], [9, 11, 10]]
    box = mi.cornell_box()
    box["small-box"] = mesh("small-box", vertices, faces, bsdf=diffuse(0.7, two_sided=True))
    return mi.load_dict({**box, "sensor": {**box["sensor"], "film": cases.film()}}, optimize=False)


@pytest.mark.parametrize(("make", "runs"), [(lifted_box, 30), (box_on_tray, 200)], ids=["lifted", "on a tray"])
def test_edges_find_what_paths_find(make, runs, monkeypatch):
    """What both ways find, from edges alone and from paths alone: the same mean over quarters of the film."""
    part = FromEdge.part

    def shared(self, placement, sample, emission):
        return dr.select(self.is_shared(sample, emission), part(self, placement, sample, emission), 0)

    monkeypatch.setattr(FromEdge, "part", shared)
    monkeypatch.setattr(from_edges, "PART", 0.5)
    scene = make()
    motion = Motion(scene, **cases.case("cornell_box").motion)
    images = []
    for share in (0, 1):
        monkeypatch.setattr(FromEdge, "share", lambda *_, share=share: mi.Float(share))
        integrator = mi.load_dict({"type": "prb_edge", "max_depth": 4, "sppc": 0})
        integrator.TERMS = tuple(t for t in TERMS if t.name in ("interior", "edges from points"))
        made = [derivative_image(scene, integrator, motion, spp=128, seed=i + 1000 * share) for i in range(runs)]
        images.append(np.array(made, np.float64).reshape(runs, 2, 16, 2, 16, 3).mean((2, 4, 5)))
    (a, b), errors = (i.mean(0) for i in images), [i.std(0, ddof=1) / runs**0.5 for i in images]
    assert (np.abs(a - b) <= 4 * np.hypot(*errors)).all()
    assert np.hypot(*errors).mean() < 0.15 * np.abs(b).mean()
