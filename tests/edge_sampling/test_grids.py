"""The surfaces of grids of signed distances: triangles, outlines, and what is said where these are not known."""

from __future__ import annotations

import cases
import drjit as dr
import frozen
import grids
import mitsuba as mi
import numpy as np
import pytest
from both_modes import assert_backward_is_forward

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.geometry.grid_triangles import triangulate
from rimlight.edge_sampling.geometry.grids import SurfaceOfGrid
from rimlight.edge_sampling.geometry.surfaces import Surfaces


def ball(n: int, radius: float = 0.7) -> np.ndarray:
    x = np.linspace(-1, 1, n)
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    return np.sqrt(x**2 + y**2 + z**2) - radius


def surface(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces, in the box from −1 to 1."""
    shape = mi.load_dict({"type": "sdfgrid", "grid": mi.TensorXf(values[..., None].astype(np.float32))})
    found = SurfaceOfGrid(shape)
    return 2 * np.array(found.vertex_positions_buffer()).reshape(-1, 3) - 1, triangulate(values).faces.astype(int)


@pytest.mark.parametrize("values", [ball(16), grids.distances(24), np.random.default_rng(0).normal(size=(9, 9, 9))])
def test_triangles_close_the_surface(values):
    """Each side of a triangle has another one on its other side, which runs through it the other way, but at the border
    of the grid; with random values, too, where faces of voxels have four crossings."""
    values = np.pad(values, 1, constant_values=2.0)
    p, faces = surface(values)
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forth, back = (np.unique(s[:, 0] * len(p) + s[:, 1]) for s in (sides, sides[:, ::-1]))
    assert len(forth) == len(sides) and np.array_equal(forth, back)


def test_vertices_lie_on_the_surface():
    values = grids.distances(24)
    p, faces = surface(values)
    shape = mi.load_dict({"type": "sdfgrid", "grid": mi.TensorXf(values[..., None].astype(np.float32))})
    a, b, c = (p[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    big = np.linalg.norm(n, axis=1) > 1e-5
    vertex, n = faces[big, 2], n[big] / np.linalg.norm(n[big], axis=1, keepdims=True)
    o = 0.5 * (p[vertex] + 0.05 * n + 1)
    ray = mi.Ray3f(mi.Point3f(*o.T.astype(np.float32)), mi.Vector3f(*-n.T.astype(np.float32)))
    t = 2 * np.array(mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(ray).t)
    assert np.median(np.abs(t - 0.05)) < 1e-5 and np.mean(np.abs(t - 0.05) < 1e-3) > 0.99


def test_normals_change_as_within_a_voxel_however_close_to_a_crease():
    """Mirrors would otherwise take creases for curved surfaces."""
    scene = grids.in_the_sun(grids.ball)
    rng = np.random.default_rng(0)
    on_film = mi.Point2f(*rng.uniform(0.35, 0.65, (2, 20000)).astype(np.float32))
    ray = mi.Ray3f(scene.sensors()[0].sample_ray(0, 0, on_film, mi.Point2f(0.5))[0])
    pi = scene.ray_intersect_preliminary(ray)
    si = Surfaces(scene).met(ray, pi, pi.is_valid())
    valid, change = np.array(pi.is_valid()), np.array(dr.sqrt(dr.squared_norm(si.dn_du) + dr.squared_norm(si.dn_dv)))
    assert valid.sum() > 10000
    assert np.mean(change[valid] > 10 * np.median(change[valid])) < 1e-3  # (it was 0.046)


def small(**options) -> mi.Scene:
    return cases.scene(
        sensor=cases.camera(*grids.LOOK, film={**cases.film(), "width": 12, "height": 12}),
        thing=grids.grid(n=16, **options),
        floor=cases.horizontal((0, 0, 0), 2, "floor", bsdf=cases.diffuse(0.5)),
        **grids.lamp("point"),
    )


@pytest.mark.parametrize("motion", [grids.SLIDES, grids.GROWS], ids=["slides", "grows"])
@pytest.mark.parametrize(
    "kind", [{"type": "direct_edge"}, {"type": "prb_edge", "max_depth": 3}], ids=lambda k: k["type"]
)
def test_backward_is_forward(kind, motion):
    scene = small()
    assert_backward_is_forward(scene, mi.load_dict(kind), Motion(scene, **motion))


def test_values_of_any_scale():
    """Mitsuba takes the length of their gradient for 1 where rays are fixed: with values of half the size, which have
    the same surface, their derivative must be twice as large."""
    images = []
    for factor in (1.0, 0.5):
        scene = small()
        params = mi.traverse(scene)
        params["thing.grid"] = mi.TensorXf(params["thing.grid"] * factor)
        params.update()
        motion = Motion(scene, "thing.grid", direction=[-factor])
        images.append(np.array(derivative_image(scene, mi.load_dict({"type": "direct_edge"}), motion, spp=16)))
    assert np.allclose(*images, rtol=1e-2, atol=1e-2 * np.abs(images[0]).max())


def test_frozen_is_unfrozen():
    """While the grid moves."""
    step, scene = frozen.Step(), small()
    integrator, call = mi.load_dict({"type": "direct_edge"}), None
    params, found = mi.traverse(scene), {}
    initial = mi.Transform4f(params["thing.to_world"])
    for kind, call in (("frozen", step.frozen()), ("plain", step)):
        found[kind] = []
        for i in range(4):
            params["thing.to_world"] = mi.Transform4f().translate([0.01 * i, 0, 0]) @ initial
            dr.enable_grad(params["thing.to_world"].matrix)
            params.update()
            call(scene, integrator, mi.UInt32(i))
            found[kind].append(np.array(dr.grad(params["thing.to_world"].matrix)).ravel()[12:15].copy())
    assert np.allclose(found["frozen"], found["plain"], rtol=1e-3, atol=1e-3 * np.abs(found["plain"]).max())


def test_curves_in_which_it_cuts_other_shapes_are_warned_about():
    for height, told in ((-0.4, 0), (0.2, 1)):
        to_world = mi.ScalarTransform4f().translate([-0.5, height, -0.5])
        scene = small()
        params = mi.traverse(scene)
        params["thing.to_world"] = mi.Transform4f(to_world)
        dr.enable_grad(params["thing.to_world"].matrix)
        params.update()
        with cases.messages() as said:
            mi.load_dict({"type": "direct_edge"}).find_boundaries(scene)
        assert sum('"thing" and "floor"' in m for m in said) == (1 - told)


def test_grids_that_are_no_cubes_are_refused():
    scene = cases.cube(
        grid=lambda: {"type": "sdfgrid", "grid": mi.TensorXf(ball(8)[:, :6, :, None].astype(np.float32))}
    )()
    with pytest.raises(RuntimeError, match="its silhouettes cannot be sampled"):
        derivative_image(scene, mi.load_dict({"type": "direct_edge"}), Motion(scene, "grid.grid", direction=[1]), spp=1)
