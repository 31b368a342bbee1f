"""What is black may become brighter: derivatives with respect to reflectances that are 0."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from building import camera, diffuse, film, horizontal, light, mesh, quad, scene

RES = 16

#: So little reflects as good as nothing, but is not black.
LITTLE = 1e-6


def rough(value: float) -> dict:
    colour = {"type": "rgb", "value": value}
    return {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.2, "specular_reflectance": colour}}


def mirror(value: float) -> dict:
    return {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": value}}


def chequered(value: float) -> dict:
    """Every other texel is black."""
    texels = np.full((4, 4, 3), 0.6, np.float32)
    texels[::2, ::2] = texels[1::2, 1::2] = value
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "filter_type": "nearest", "raw": True}
    return {"type": "diffuse", "reflectance": bitmap}


def red(value: float) -> dict:
    return diffuse(0.6, value, value)


def of_vertices(_: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}


#: Of each material: of it when it reflects so little, and the parameter that changes.
MATERIALS = {
    "matt": (diffuse, "bsdf.reflectance.value"),
    "polished": (rough, "bsdf.brdf_0.specular_reflectance.value"),
    "mirror": (mirror, "bsdf.specular_reflectance.value"),
    "chequered": (chequered, "bsdf.reflectance.data"),
    "red": (red, "bsdf.reflectance.value"),
    "colours of vertices": (of_vertices, "vertex_color"),
}


def room(material: str, value: float) -> tuple[mi.Scene, str]:
    """A corner in front of which a lamp hangs; floor and wall are of one material, of which only the wall changes."""
    of, key = MATERIALS[material]
    corners = [[-1, 0, 1], [1, 0, 1], [-1, 2, 1], [1, 2, 1]]
    uv, colours = [[0, 0], [1, 0], [0, 1], [1, 1]], [[value] * 3] * 4 if of is of_vertices else None
    wall = mesh("wall", corners, [[0, 2, 1], [1, 2, 3]], uv=uv, colours=colours, bsdf=of(value))
    found = scene(
        sensor=camera((0.4, 1.2, -2.5), (0, 0.7, 0.5), film={**film(), "width": RES, "height": RES}),
        wall=wall,
        floor=horizontal((0, 0, 0), 1, "floor", bsdf=diffuse(0.0, 0.6, 0.0)),
        side=quad((-1, 0, -1), (0, 2, 0), (0, 0, 2), "side", bsdf=diffuse(0.5, 0.4, 0.6)),
        lamp=horizontal((0, 1.9, 0), 0.3, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(8, 7, 6)),
    )
    return found, f"wall.{key}"


def derivatives(integrator: str, material: str, value: float, rr_depth: int = 1000, seed: int = 3):
    """The derivative image along a change of the parameter; the gradient of a weighted sum of the image along the same
    change; and that sum of the derivative image."""
    there, key = room(material, max(value, 0))  # Mitsuba loads nothing else
    params = mi.traverse(there)
    parameter = params[key] if value >= 0 else type(params[key])(value)
    along = np.random.default_rng(0).uniform(0.5, 1, np.array(parameter).shape).astype(np.float32)
    depth = {} if integrator == "direct_edge" else {"max_depth": 5, "rr_depth": rr_depth}
    it = mi.load_dict({"type": integrator, **depth})
    options = {"sensor": 0, "seed": seed, "spp": 64}

    dr.enable_grad(parameter)
    dr.set_grad(parameter, type(parameter)(along))
    params[key] = parameter
    params.update()
    forward = np.array(it.render_forward(there, params, **options), float)
    weights = np.random.default_rng(1).uniform(-1, 1, forward.shape)

    params = mi.traverse(there)
    parameter = dr.detach(params[key])
    dr.enable_grad(parameter)
    params[key] = parameter
    params.update()
    it.render_backward(there, params, mi.TensorXf(weights.astype(np.float32)), **options)
    backward = float((np.array(dr.grad(params[key])) * along).sum())
    return forward, backward, float((forward * weights).sum())


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("integrator", ["direct_edge", "prb_edge"])
def test_as_what_is_nearly_black(integrator, material):
    """Paths are the same, as long as none ends at random."""
    black, backward, total = derivatives(integrator, material, 0.0)
    nearly, _, _ = derivatives(integrator, material, LITTLE)
    assert np.abs(black).sum() > 10
    np.testing.assert_allclose(black, nearly, rtol=2e-3, atol=1e-4 * np.abs(nearly).max())
    assert backward == pytest.approx(total, rel=2e-3, abs=1e-4 * np.abs(black).sum())


def test_what_a_fit_has_made_negative():
    """Steps of an optimiser lead there, if nothing keeps values positive: gradients must lead back."""
    forward, backward, total = derivatives("prb_edge", "matt", -0.3)
    assert np.abs(forward).sum() > 10
    assert backward == pytest.approx(total, rel=2e-3, abs=1e-4 * np.abs(forward).sum())


def test_paths_that_end_at_random():
    """Those that go on stand for the others, black or not."""
    found = [[derivatives("prb_edge", "matt", 0.0, rr_depth=r, seed=s) for s in range(8)] for r in (2, 1000)]
    (some, gradients), (all_, _) = ((np.array([f[0].sum() for f in runs]), [f[1:] for f in runs]) for runs in found)
    error = np.hypot(some.std(ddof=1), all_.std(ddof=1)) / np.sqrt(len(some))
    assert abs(some.mean() - all_.mean()) < 4 * error and error < 0.02 * all_.mean()
    for backward, total in gradients:
        assert backward == pytest.approx(total, rel=2e-3, abs=1e-2)
