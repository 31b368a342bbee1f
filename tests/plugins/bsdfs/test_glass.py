"""`glass`: all but the derivative with respect to its index is that of Mitsuba's `dielectric`."""

from __future__ import annotations

import drjit as dr
import mirrors
import mitsuba as mi
import numpy as np
import pytest
from frozen import assert_frozen_is_unfrozen

from rimlight.checks import Motion, derivative_image

GLASS, DIELECTRIC = {"type": "glass", "eta": 1.4}, {"type": "dielectric", "int_ior": 1.4, "ext_ior": 1.0}


@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("component", [None, 0, 1])
def test_samples_are_those_of_dielectric(mode, component):
    rng, context = np.random.default_rng(0), mi.BSDFContext(getattr(mi.TransportMode, mode))
    if component is not None:
        context.component = component
    wi = rng.normal(size=(3, 1000))
    si = dr.zeros(mi.SurfaceInteraction3f, 1000)
    si.wi = mi.Vector3f((wi / np.linalg.norm(wi, axis=0)).astype(np.float32))
    number = mi.Float(rng.random(1000).astype(np.float32))
    (a, weight), (b, expected) = (
        mi.load_dict(bsdf).sample(context, si, number, mi.Point2f(0.5)) for bsdf in (GLASS, DIELECTRIC)
    )
    np.testing.assert_allclose(*(np.array(w) + 0 * np.array(number) for w in (weight, expected)), rtol=1e-5)
    for name in ("wo", "eta", "pdf", "sampled_type", "sampled_component"):
        np.testing.assert_allclose(*(np.array(getattr(s, name)) + 0 * np.array(number) for s in (a, b)), atol=1e-6)


def test_its_motion_is_that_of_dielectric():
    images = []
    for bsdf in (GLASS, DIELECTRIC):
        scene, it = mirrors.glass_ball(bsdf), mi.load_dict({"type": "prb_edge", "max_depth": 4})
        images.append(np.array(derivative_image(scene, it, Motion(scene, **mirrors.BALL), spp=4, seed=1)))
    assert np.abs(images[1]).sum() > 0
    assert np.abs(images[0] - images[1]).sum() < 1e-3 * np.abs(images[1]).sum()


@pytest.mark.parametrize("eta", [1, 0.1, 6.0])
def test_indices_that_are_refused(eta):
    with pytest.raises(RuntimeError, match=r'glass: "eta" must be from 0.2 to 5, but not 1, got'):
        mi.load_dict({"type": "glass", "eta": eta})


def test_frozen_is_unfrozen():
    scene, it = mirrors.glass_ball(GLASS), mi.load_dict({"type": "prb_edge", "max_depth": 4})
    assert_frozen_is_unfrozen(scene, it, "ball.bsdf.eta")
