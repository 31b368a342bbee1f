"""In which directions both sides of a crease look for light: `boundaries/crease.py`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from building import camera, diffuse, horizontal, mesh, scene
from random_scenes import ball

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.boundaries.crease import Crease, LuneOrCrease, is_matt
from rimlight.edge_sampling.boundaries.lune import Lune

COUNT = 2**16


def crease(active: bool = True) -> Crease:
    first, second = (dr.normalize(mi.Vector3f(*v)) for v in ([0.2, 1, 0.1], [-0.1, 1, 0.3]))
    return Crease((first, second), mi.Bool(active))


def numbers() -> tuple[mi.Float, mi.Point2f]:
    rng = np.random.default_rng(0)
    return mi.Float(rng.random(COUNT)), mi.Point2f(rng.random((2, COUNT)))


def test_directions_have_the_density_that_is_told():
    c, (side, u) = crease(), numbers()
    ω, pdf = c.sample(side, u)
    assert dr.allclose(pdf, c.pdf(ω)) and dr.all(pdf > 0)
    # What each side reflects of light from everywhere is its albedo.
    for n in c.normals:
        reflected = dr.maximum(dr.dot(n, ω), 0) * dr.inv_pi / pdf
        assert abs(dr.mean(reflected) - 1)[0] < 0.01
    everywhere = mi.warp.square_to_uniform_sphere(u)
    assert abs(dr.mean(c.pdf(everywhere) * 4 * dr.pi) - 1)[0] < 0.01


def test_a_lune_goes_first():
    side, u = numbers()
    axis, normals = mi.Vector3f(1, 0, 0), (mi.Vector3f(0, 1, 0), mi.Vector3f(0, 1, 0.2))
    for by_lune in (True, False):
        both = LuneOrCrease(Lune.between(axis, normals, mi.Bool(by_lune)), crease())
        expected = both.lune if by_lune else both.crease
        for found, one in zip(both.sample(side, u), expected.sample(side, u), strict=True):
            assert dr.allclose(found, one)
        assert dr.allclose(both.pdf(both.sample(side, u)[0]), expected.pdf(both.sample(side, u)[0]))
        assert dr.all(both.active) and not dr.any(both.where(mi.Bool(False)).active)


def test_which_surfaces_are_matt():
    matt, gloss = {"type": "diffuse"}, {"type": "roughplastic"}
    is_so = lambda bsdf: is_matt(mi.load_dict(bsdf))
    assert is_so(matt) and is_so({"type": "twosided", "bsdf": matt})
    assert not is_so(gloss) and not is_so({"type": "twosided", "front": matt, "back": gloss})
    assert not is_so({"type": "bumpmap", "bsdf": matt, "texture": {"type": "checkerboard"}})


def flat_ball(split: bool):
    """A ball of 480 flat faces in a sky of many colours; or of smooth faces, with as many normals as corners."""
    p, _, _, f = ball(16)
    if split:
        p, f = p[f].reshape(-1, 3), np.arange(3 * len(f)).reshape(-1, 3)
    sky = mi.Bitmap(np.random.default_rng(0).uniform(0, 1.2, (6, 12, 3)).astype(np.float32))
    b = mesh("ball", 0.8 * p, f, normals=split, bsdf=diffuse(0.6, 0.5, 0.4))
    floor = horizontal((0, -1, 0), 3, "floor", bsdf=diffuse(0.5))
    return scene(sensor=camera(), ball=b, floor=floor, sky={"type": "envmap", "bitmap": sky})


def test_same_jump_with_less_noise(monkeypatch):
    """With directions of their own on both sides, the film boundary has the same mean, and more noise."""

    def images(count: int, split: bool) -> np.ndarray:
        s = flat_ball(split)
        motion = Motion(s, key="ball.vertex_positions", direction=[1, 0.3, 0.2])
        integrator = mi.load_dict({"type": "prb_edge", "max_depth": 3, "sppc": 0, "sppi": 0})
        return np.array([derivative_image(s, integrator, motion, spp=64, seed=i) for i in range(count)], float)

    new, split = images(16, False), images(16, True)
    monkeypatch.setattr("rimlight.transport.tracer.PathTracer.shares_directions", False)
    old = images(32, False)
    for runs in (new, split):
        assert runs.var(0).sum() < 0.4 * old.var(0).sum()
        weight = runs.mean(0)
        p = (old * weight).sum((1, 2, 3)) / (weight**2).sum()
        q = (runs * weight).sum((1, 2, 3)) / (weight**2).sum()
        # The mean of the same runs as weight makes q one: its noise is that of the other.
        assert abs(p.mean() - q.mean()) < 4 * np.hypot(p.std() / len(p) ** 0.5, q.std() / len(q) ** 0.5)
        sums = [i.sum((1, 2, 3)) for i in (old, runs)]
        error = sum(s.var() / len(s) for s in sums) ** 0.5
        assert abs(sums[0].mean() - sums[1].mean()) < 4 * error
