"""`bdpt_edge`: its interior term is that of `prb_edge`, whichever way paths are made; both modes; refusals, warnings.

Finite differences are in `test_derivatives.py` (cases of `hidden_lights.py`).
"""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import polished
import pytest
import rooms
import touching_lamps
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling.boundaries import deep_shadows, past_edges, shading_boundary
from rimlight.transport.vertex_table import VertexTable

RUNS = 6


def derivatives(case: cases.Case, kind: str, first: int, spp: int, **options) -> np.ndarray:
    """(RUNS, H, W, C). Only the interior, unless `options` say so."""
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    it = mi.load_dict({"type": kind, "max_depth": case.max_depth, "sppp": 0, "sppi": 0, **options})
    return np.array([derivative_image(scene, it, motion, spp=spp, seed=first + i) for i in range(RUNS)], np.float64)


def assert_equal(found: np.ndarray, expected: np.ndarray) -> None:
    """Means over the film, halves and quarters of it differ by noise alone, and each by little."""
    for parts in (1, 2, 4):
        h, w = (n // parts for n in found.shape[1:3])
        pooled = [
            a[:, : parts * h, : parts * w].reshape(RUNS, parts, h, parts, w, -1).mean((2, 4)) for a in (found, expected)
        ]
        means, errors = [a.mean(0) for a in pooled], [a.std(0, ddof=1) / np.sqrt(RUNS) for a in pooled]
        error = np.sqrt(errors[0] ** 2 + errors[1] ** 2)
        scale = np.abs(means[1]).max()
        assert (np.abs(means[0] - means[1]) <= 6 * error + 1e-6 * scale).all()
        if parts == 1:
            assert error.max() <= 0.1 * np.abs(expected.mean(0)).mean()


@pytest.mark.parametrize(
    ("name", "spp"),
    [
        ("cornell_box_camera", 64),  # a camera that turns: vertices slide close to corners
        ("ball_on_floor", 256),  # contact, in light that is scattered several times
        ("glass_index", 64),  # smooth glass that bends light
        ("rough_panes", 64),  # what rough glass shows is held in its direction
        ("veil_and_mirror", 256),  # rays go through, or not; perfect mirrors
        ("spot_behind_screen", 256),  # a light without size
        ("mirrored_sphere", 256),
    ],
)
def test_interior_is_that_of_path_replay(name, spp):
    """Both hold the same fixed, so that not only the sum with the boundaries, but each term has the same mean."""
    case = cases.case(name)
    assert_equal(derivatives(case, "bdpt_edge", 0, spp), derivatives(case, "prb_edge", 100, spp))


@pytest.mark.parametrize("light_paths", [0.1, 2.0])
def test_any_number_of_light_paths(light_paths):
    case = cases.case("cornell_box_camera")
    few = derivatives(case, "bdpt_edge", 0, 64, light_paths=light_paths)
    assert_equal(few, derivatives(case, "prb_edge", 100, 64))


@pytest.mark.parametrize("name", ["cornell_box_camera", "glass_index", "veil_and_mirror", "caustic_lamp", "door"])
def test_both_modes(name):
    """⟨w, J v⟩ = ⟨Jᵀ w, v⟩ with all terms."""
    case = cases.case(name)
    scene = case.scene()
    motion, it = Motion(scene, **case.motion), mi.load_dict({"type": "bdpt_edge", "max_depth": case.max_depth})
    forward = np.array(derivative_image(scene, it, motion, spp=4, seed=3), np.float64)
    w = np.random.default_rng(0).normal(size=forward.shape)
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    it.render_backward(scene, motion.params, mi.TensorXf(w.astype(np.float32)), seed=3, spp=4)
    dr.enqueue(dr.ADMode.Backward, motion.params[motion.key])
    dr.traverse(dr.ADMode.Backward)
    assert dr.grad(theta)[0] == pytest.approx((w * forward).sum(), abs=1e-4 * np.abs(w * forward).sum())


def boundaries(
    case: cases.Case, first: int, spp: int, terms: tuple[str, ...], kind: str = "bdpt_edge", runs: int = RUNS
) -> np.ndarray:
    """Only some terms, (runs, H, W, C)."""
    scene = case.scene()
    motion = Motion(scene, **case.motion)
    it = mi.load_dict({"type": kind, "max_depth": case.max_depth, "sppc": 0})
    it.TERMS = tuple(t for t in it.TERMS if t.name in ("interior", *terms))
    return np.array([derivative_image(scene, it, motion, spp=spp, seed=first + i) for i in range(runs)], np.float64)


def assert_pooled_equal(found: np.ndarray, expected: np.ndarray, least: float) -> None:
    """Quarters of the film differ by noise alone, and their mean by little."""
    h, w = (n // 2 for n in found.shape[1:3])
    quarters = [a[:, : 2 * h, : 2 * w].reshape(len(a), 2, h, 2, w, -1).mean((2, 4)) for a in (found, expected)]
    means, errors = [a.mean(0) for a in quarters], [a.std(0, ddof=1) / np.sqrt(len(a)) for a in quarters]
    error = np.hypot(*errors)
    assert (np.abs(means[0] - means[1]) <= 6 * error + 1e-9).all()
    assert error.mean() <= least * np.abs(means[1]).mean()


def test_shadows_continued_from_the_light():
    """A hard shadow on a floor that lights walls: as `prb_edge` has it, of which a few runs miss what is rare."""
    indirect = "shadows in indirect light"
    found = boundaries(cases.case("door"), 0, 256, (indirect, f"{indirect}, continued"))
    assert_pooled_equal(found, boundaries(cases.case("door"), 100, 256, (indirect,), "prb_edge", runs=48), 0.1)
    continued = boundaries(cases.case("door"), 0, 16, (f"{indirect}, continued",))
    assert np.abs(continued.mean()) > 0.1 * np.abs(found.mean())


def test_shadows_in_light_from_surfaces(monkeypatch):
    """Whatever is found from points, and what from surfaces: the sum has the same mean."""
    terms = "edges from points", "shadows in light from surfaces"
    density, found = past_edges.density_from_points, []
    for scale in (0.01, 1e4):
        for module in (shading_boundary, deep_shadows):
            monkeypatch.setattr(module, "density_from_points", lambda *a, scale=scale: scale * density(*a))
        found.append(boundaries(cases.case("spot_behind_screen"), 0 if scale < 1 else 100, 256, terms))
        share = np.abs(boundaries(cases.case("spot_behind_screen"), 0, 16, terms[1:])).mean() / np.abs(found[-1]).mean()
        assert (share > 0.1) == (scale < 1)
    assert_pooled_equal(*found, 0.4)


def test_image_is_that_of_bdpt():
    scene = cases.case("caustic_lamp").scene()
    a, b = (
        mi.render(scene, integrator=mi.load_dict({"type": k, "max_depth": 4}), spp=4) for k in ("bdpt", "bdpt_edge")
    )
    assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("scene", "key"),
    [
        (cases.room(), "light.to_world"),
        (cases.cube(), "cube.vertex_positions"),
        (touching_lamps.window, "sensor.to_world"),
        (polished.wall, "wall.vertex_positions"),
    ],
)
def test_frozen(scene, key):
    """Where the scene grows with what moves, too."""
    assert_frozen_is_unfrozen(scene(), mi.load_dict({"type": "bdpt_edge", "max_depth": 4}), key)


def test_memory_of_vertices(variant):
    """At 256 × 256 pixels, 16 samples of each, and `max_depth` 8, with half as many light paths: below 0.4 GiB."""
    count = 256 * 256 * 16
    scene = room()
    tables = [VertexTable(scene, n, 7) for n in (count, count // 2)]
    arrays = lambda t: [t._p, t._uv, *t._whole.values()]
    assert 4 * sum(dr.width(a) for t in tables for a in arrays(t)) < 0.4 * 2**30


# ---------------------- Limits ----------------------


def room(**objects) -> mi.Scene:
    lamp = {} if any(name.startswith("lamp") for name in objects) else {"lamp": rooms.lamp()}
    sensor = cases.camera(*rooms.LOOK, film=cases.film(width=8, height=8))
    return cases.scene(**{"sensor": sensor, **rooms.walls(), **lamp, **objects})


def differentiate(scene: mi.Scene, key: str, **options) -> list[str]:
    """Warnings of a derivative."""
    it = mi.load_dict({"type": "bdpt_edge", "max_depth": 3, **options})
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    with cases.messages() as found:
        it.render_backward(scene, params, mi.TensorXf(np.ones((8, 8, 3), np.float32)), spp=1)
    return found


@pytest.mark.parametrize(
    ("objects", "says"),
    [
        ({"lamps": {"type": "distant_lights", "directions": "0 -1 0, 0.6 -0.8 0"}}, "no derivative in the light of"),
        ({"fog": {"type": "cube", "interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}}, "participating"),
    ],
)
def test_is_refused(variant, objects, says):
    with pytest.raises(RuntimeError, match=f"bdpt_edge: .*{says}"):
        differentiate(room(**objects), "floor.bsdf.brdf_0.reflectance.value")


@pytest.mark.parametrize("max_depth", [-1, 33])
def test_depth_is_limited(variant, max_depth):
    with pytest.raises(RuntimeError, match='"max_depth" must be at most 32'):
        mi.load_dict({"type": "bdpt_edge", "max_depth": max_depth})


def test_black_is_told(variant):
    dark = room(ball={"type": "sphere", "id": "ball", "radius": 0.2, "bsdf": cases.diffuse(0.0)})
    assert any(
        'where "ball.bsdf.reflectance.value" is 0' in m for m in differentiate(dark, "ball.bsdf.reflectance.value")
    )
    grey = room(ball={"type": "sphere", "id": "ball", "radius": 0.2, "bsdf": cases.diffuse(0.5)})
    assert not differentiate(grey, "ball.bsdf.reflectance.value")


def test_caustics_of_lights_without_size_are_told(variant):
    objects = {"ball": {"type": "sphere", "radius": 0.2, "bsdf": {"type": "dielectric"}}}
    lamp = {"lamp": {"type": "point", "id": "lamp", "position": [0, 1, 0], "intensity": 1.0}}
    found = differentiate(room(**objects, **lamp), "floor.bsdf.brdf_0.reflectance.value")
    assert any('lacks the caustics that perfect mirrors and glass throw in the light of "lamp"' in m for m in found)
