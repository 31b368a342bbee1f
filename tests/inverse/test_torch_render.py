"""The renderer as a layer of PyTorch."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes
from rimlight.inverse import torch_render

torch = pytest.importorskip("torch")

GREEN, COLOUR = "green.vertex_positions", "green.bsdf.reflectance.value"
OPTIONS = {"integrator": "direct_edge"}


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return mi.load_file(str(scenes.path("two_triangles")), res=16)


def parameters(scene) -> dict:
    params = mi.traverse(scene)
    place = torch.tensor(np.array(params[GREEN]))
    return {GREEN: place, COLOUR: torch.tensor([0.2, 0.5, 0.3])}


def weights() -> torch.Tensor:
    return torch.rand((16, 16, 3), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("along", ["colour", "place"])
def test_gradient_is_that_of_differences(scene, along):
    """Of a linear function of the image: within 4 standard errors."""
    base = parameters(scene)
    key = COLOUR if along == "colour" else GREEN
    change = torch.tensor([0.5, -0.2, 1.0]) if along == "colour" else torch.tensor([1.0, 0.5, 0.0]).repeat(3)
    h = 0.02
    render = lambda place, spp, seed: torch_render(scene, {**base, key: place}, spp=spp, seed=seed, **OPTIONS)
    value = lambda s, seed: (render(base[key] + s * change, 8192, seed) * weights()).sum().item()
    differences = [(value(h, seed) - value(-h, seed)) / (2 * h) for seed in range(8)]
    found = []
    for seed in range(4):
        leaf = base[key].clone().requires_grad_()
        (render(leaf, 2048, seed) * weights()).sum().backward()
        found.append((leaf.grad * change).sum().item())
    error = np.hypot(np.std(differences, ddof=1) / np.sqrt(8), np.std(found, ddof=1) / 2)
    print(np.mean(found), np.mean(differences), error)
    assert abs(np.mean(found) - np.mean(differences)) < 4 * error
    assert error < 0.05 * abs(np.mean(found))


def test_noise_does_not_bias_the_gradient_of_squares(scene):
    """Light is linear in a colour, if all else is dark: the derivative of Σ Ī² with respect to its logarithm is 2 Σ Ī².
    With the same random numbers in both renders, it would be that of E[Σ I²]."""
    base = parameters(scene)
    black = {**base, "red.bsdf.reflectance.value": torch.zeros(3)}
    found, squares = [], []
    for seed in range(150):
        factor = torch.tensor(1.0, requires_grad=True)
        image = torch_render(scene, {**black, COLOUR: factor * base[COLOUR]}, spp=1, seed=seed, **OPTIONS)
        (image**2).sum().backward()
        found.append(factor.grad.item())
        squares.append(2 * (image**2).sum().item())
    converged = 2 * (torch_render(scene, {**black, COLOUR: base[COLOUR]}, spp=16384, **OPTIONS) ** 2).sum().item()
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - converged) < 4 * error
    assert np.mean(squares) - converged > 10 * error  # the noise would be seen


def test_it_is_a_layer(scene):
    """Between others, of other shapes and precisions; used twice in a graph, each time with its own parameters."""
    base = parameters(scene)
    grey = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
    render = lambda x: torch_render(scene, {GREEN: base[GREEN], COLOUR: x.repeat(3)}, spp=64, **OPTIONS)
    dark, bright = render(grey), render(2 * grey)
    assert dark.shape == (16, 16, 3) and dark.dtype == torch.float32
    dark.sum().backward(retain_graph=True)
    once = grey.grad.item()
    bright.sum().backward()
    assert grey.grad.dtype == torch.float64
    assert grey.grad.item() - once == pytest.approx(2 * once, rel=0.02)  # light is linear in the colour
    with torch.no_grad():
        assert not render(grey).requires_grad


def test_seeds(scene):
    base = parameters(scene)
    image = lambda seed: torch_render(scene, base, spp=4, seed=seed, **OPTIONS)
    assert torch.equal(image(1), image(1)) and not torch.equal(image(1), image(2))


def test_a_scene_may_be_a_file():
    image = torch_render(scenes.path("two_triangles"), {COLOUR: torch.zeros(3)}, spp=1, integrator={"type": "direct"})
    assert image.shape == (64, 64, 3)


def test_what_does_not_fit_is_refused(scene):
    with pytest.raises(ValueError, match=r'^torch_render: the scene has no parameter "gren"$'):
        torch_render(scene, {"gren": torch.zeros(3)}, **OPTIONS)
    with pytest.raises(ValueError, match=rf'^torch_render: "{COLOUR}" has 3 numbers, got 4$'):
        torch_render(scene, {COLOUR: torch.zeros(4)}, **OPTIONS)
