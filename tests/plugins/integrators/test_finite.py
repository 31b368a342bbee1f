"""The last guard: numbers that are not finite are counted and reported, never hidden."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes

KEY = "cube.vertex_positions"


@pytest.fixture
def moving():
    scene = mi.load_file(str(scenes.path("cube")))
    params = mi.traverse(scene)
    dr.enable_grad(params[KEY])
    params.update()
    return scene, params


def spoil(integrator, monkeypatch, spoiled):
    """Give the film samples of the derivative to `spoiled` before they are developed."""
    develop = type(integrator)._develop
    wrong = lambda film, terms, values, *rest: develop(integrator, film, terms, [spoiled(v) for v in values], *rest)
    monkeypatch.setattr(integrator, "_develop", wrong, raising=False)


def test_image(moving, monkeypatch):
    scene, params = moving
    integrator = mi.load_dict({"type": "direct_edge"})

    def spoiled(value):
        value.L = dr.select(dr.arange(mi.UInt32, dr.width(value.L)) == 0, dr.nan, value.L)
        return value

    with cases.messages() as clean:
        assert np.isfinite(np.array(integrator.render_forward(scene, params, spp=4))).all()
    assert not any("not finite" in m for m in clean)
    spoil(integrator, monkeypatch, spoiled)
    with cases.messages() as found:
        image = np.array(integrator.render_forward(scene, params, spp=4))
    count = int((~np.isfinite(image)).sum())
    assert count > 0
    (message,) = (m for m in found if "not finite" in m)
    assert f"direct_edge: {count} of {image.size} numbers of the derivative image" in message


def test_gradient(moving):
    scene, params = moving
    integrator = mi.load_dict({"type": "direct_edge"})
    weight = dr.ones(mi.TensorXf, mi.render(scene, spp=1).shape)
    with cases.messages() as clean:
        integrator.render_backward(scene, params, weight, spp=4)
    assert not any("not finite" in m for m in clean)
    dr.set_grad(params[KEY], dr.select(dr.arange(mi.UInt32, dr.width(params[KEY])) < 2, dr.inf, 0))
    with cases.messages() as found:
        integrator.render_backward(scene, params, weight, spp=4)
    (message,) = (m for m in found if "not finite" in m)
    assert f'direct_edge: 2 of {dr.width(params[KEY])} numbers of the gradient of "{KEY}"' in message
