"""The fit of vertices: it finds them, and says what is wrong with its input."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes
from rimlight.inverse.demo import START, vertex_errors
from rimlight.inverse.triangles import fit_vertices

RESOLUTION = 32


@pytest.fixture
def scene():
    return mi.load_file(str(scenes.path("two_triangles")), res=RESOLUTION)


@pytest.fixture
def target(scene) -> np.ndarray:
    return np.array(mi.render(scene, spp=256, seed=1000))


def test_fit_finds_the_vertices(scene, target):
    params = mi.traverse(scene)
    truth = {key: np.array(params[key]).reshape(-1, 3) for key in START}
    for key, vertices in START.items():
        params[key] = mi.Float(np.ravel(vertices).astype(np.float32))
    params.update()
    before = np.array(mi.render(scene, spp=256, seed=1001))
    fit = fit_vertices(scene, list(START), target, iterations=120, axes="xy", progress=False)

    errors = vertex_errors(fit, truth, RESOLUTION)
    assert errors[0] > 4.5  # pixels
    assert errors[-1] < 0.1
    assert fit.losses.shape == (120,)
    assert fit.losses[-10:].mean() < 0.1 * fit.losses[0]
    assert np.square(fit.image - target).mean() < 3e-3 * np.square(before - target).mean()  # noise of 256 spp
    for key in START:
        assert fit.history[key].shape == (121, 3, 3)
        np.testing.assert_array_equal(fit.history[key][0], np.float32(START[key]))
        np.testing.assert_array_equal(fit.history[key][:, :, 2], truth[key][None, :, 2].repeat(121, 0))  # depth is held
        np.testing.assert_array_equal(
            np.array(params[key]).reshape(-1, 3), fit.positions[key]
        )  # the scene keeps the result


def test_fit_repeats_itself(scene, target):
    start = mi.Float(mi.traverse(scene)["red.vertex_positions"])
    results = []
    for _ in range(2):
        params = mi.traverse(scene)
        params["red.vertex_positions"] = start + 0.1
        params.update()
        fit = fit_vertices(scene, ["red.vertex_positions"], target, iterations=3, seed=5, progress=False)
        results.append(fit.positions["red.vertex_positions"])
    np.testing.assert_allclose(*results, atol=1e-5)


@pytest.mark.parametrize(
    ("keys", "options", "message"),
    [
        (
            ["gren.vertex_positions"],
            {},
            r'unknown parameter "gren.vertex_positions", did you mean green.vertex_positions',
        ),
        (["light.emitter.radiance.value"], {}, r"holds no vertex positions"),
        ("green.vertex_positions", {}, r'"keys" must be a list'),
        ([], {}, r'"keys" must be a list'),
        (["green.vertex_positions"], {"iterations": 0}, r'"iterations" must be >= 1, got 0'),
        (["green.vertex_positions"], {"spp": 0}, r'"spp" must be >= 1'),
        (["green.vertex_positions"], {"learning_rate": float("nan")}, r'"learning_rate" must be > 0, got nan'),
        (["green.vertex_positions"], {"axes": "xw"}, r'"axes" must consist of'),
    ],
)
def test_bad_options_are_refused(scene, target, keys, options, message):
    with pytest.raises(ValueError, match=message):
        fit_vertices(scene, keys, target, progress=False, **options)


def test_bad_targets_are_refused(scene, target):
    with pytest.raises(ValueError, match=r"must be of shape \(32, 32, C\), got \(16, 32, 3\)"):
        fit_vertices(scene, ["green.vertex_positions"], target[:16], progress=False)
    with pytest.raises(ValueError, match=r"not finite"):
        fit_vertices(scene, ["green.vertex_positions"], target * np.nan, progress=False)
