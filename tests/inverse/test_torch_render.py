"""The renderer as a layer of PyTorch, and modules of PyTorch as losses."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes
from rimlight.inverse import Free, Problem, torch_loss, torch_render

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


def test_renders_in_between_do_not_matter(scene):
    """What they gave is not left in the scene when the gradient of an earlier one is asked for, or in later ones."""
    base = parameters(scene)

    def gradient(between: bool) -> torch.Tensor:
        colour = base[COLOUR].clone().requires_grad_()
        image = torch_render(scene, {COLOUR: colour}, **OPTIONS)
        if between:  # the triangle is out of sight
            torch_render(scene, {"red.bsdf.reflectance.value": torch.zeros(3), GREEN: base[GREEN] + 50}, **OPTIONS)
        image.sum().backward()
        return colour.grad

    expected = gradient(False)
    assert (expected > 1).all()
    for between in (True, False):
        torch.testing.assert_close(gradient(between), expected)


def test_only_tensors_that_need_it_get_a_gradient(scene):
    base = parameters(scene)
    colour = base[COLOUR].clone().requires_grad_()
    place = base[GREEN].clone().requires_grad_()
    torch_render(scene, {COLOUR: colour, GREEN: place}, **OPTIONS).sum().backward()
    expected, colour.grad = colour.grad, None
    torch_render(scene, {COLOUR: colour, GREEN: base[GREEN]}, **OPTIONS).sum().backward()
    torch.testing.assert_close(colour.grad, expected, rtol=1e-4, atol=0)
    assert base[GREEN].grad is None and place.grad.abs().max() > 0


def test_values_of_any_kind(scene):
    base = parameters(scene)
    image = lambda colour, place=base[GREEN]: torch_render(scene, {COLOUR: colour, GREEN: place}, spp=4, **OPTIONS)
    expected = image([0.25, 0.5, 0.25])
    for kind in (torch.float64, torch.float16, torch.bfloat16):
        colour = torch.tensor([0.25, 0.5, 0.25], dtype=kind, requires_grad=True)
        found = image(colour)
        torch.testing.assert_close(found, expected)
        found.sum().backward()
        assert colour.grad.dtype == kind and (colour.grad > 0).all()
    rows = base[GREEN].reshape(-1, 3)
    torch.testing.assert_close(image([0.25, 0.5, 0.25], rows.T.contiguous().T), expected)


def test_several_sensors_and_channels():
    """A mask, as a layer: a ball that one sensor sees, and the other does not."""
    look = lambda z: {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, z], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}},
    }
    scene = mi.load_dict({"type": "scene", "a": look(0), "b": look(-9), "ball": {"type": "sphere"}})
    place = torch.eye(4, requires_grad=True)
    options = {"integrator": {"type": "aov_edge", "aovs": "m:mask:ball"}, "channel": "m"}
    seen, unseen = (torch_render(scene, {"ball.to_world": place}, sensor=i, **options) for i in range(2))
    assert seen.shape == (6, 8, 1) and seen.max() == 1 and not unseen.any()
    (seen.sum() + unseen.sum()).backward()
    assert place.grad[2, 3] < -1  # away from the camera, it is smaller


REFUSED = [
    ({"gren": torch.zeros(3)}, {}, 'the scene has no parameter "gren"'),
    ({COLOUR: torch.zeros(4)}, {}, f'"{COLOUR}" has 3 numbers, got 4'),
    ({COLOUR: torch.zeros(3, dtype=torch.complex64)}, {}, f'"{COLOUR}" must be real, got torch.complex64'),
    ({COLOUR: "red"}, {}, f'"{COLOUR}" must be a tensor, got str'),
    ({"green.faces": torch.zeros(3)}, {}, '"green.faces" is of type UInt, which has no derivative'),
    (
        [torch.zeros(3)],
        {},
        "params is a dictionary of tensors, and integrator a name or a dictionary, got list and str",
    ),
    ({}, {"spp": 0}, "spp must be a whole number >= 1"),
    ({}, {"spp": 2.5}, "spp must be a whole number >= 1"),
    ({}, {"seed": -1}, "seed must be a whole number >= 0"),
    ({}, {"sensor": 1}, "the scene has 1 sensors, there is no number 1"),
]


@pytest.mark.parametrize(("params", "options", "culprit"), REFUSED)
def test_what_does_not_fit_is_refused(scene, params, options, culprit):
    with pytest.raises(ValueError, match=rf"^torch_render: {culprit}") as error:
        torch_render(scene, params, **{**OPTIONS, **options})
    assert "\n" not in str(error.value)


def test_pictures_in_the_order_of_pytorch_are_refused():
    """(C, H, W) has as many numbers as (H, W, C)."""
    texture = {"type": "bitmap", "data": mi.TensorXf(np.zeros((2, 4, 3))), "raw": True}
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    scene = mi.load_dict({"type": "scene", "camera": {"type": "perspective"}, "wall": wall})
    with pytest.raises(ValueError, match=r"is of the shape \(2, 4, 3\), or flat, got \(3, 2, 4\)"):
        torch_render(scene, {"wall.bsdf.reflectance.data": torch.zeros(3, 2, 4)})
    with pytest.raises(ValueError, match=r"is of the shape \(\d+, 3\), or flat, got \(3, \d+\)"):
        torch_render(mi.load_file(str(scenes.path("cube")), res=4), {"cube.vertex_positions": torch.zeros(3, 24)})


def test_scenes_that_are_dictionaries_are_refused():
    with pytest.raises(ValueError, match=r"is an mi\.Scene or the path of a file, got dict; load a dictionary once"):
        torch_render({"type": "scene"}, {})


# ------------------------------------------------------------------ modules as losses


def loss_of(module):
    image, target = np.random.default_rng(0).uniform(0, 1, (2, 6, 5, 3)).astype(np.float32)
    return torch_loss(module)(image, target, np.ones((6, 5), np.float32))


@pytest.mark.parametrize(
    ("says", "got"),
    [
        (lambda image, target: 1.0, "float"),
        (lambda image, target: None, "NoneType"),
        (lambda image, target: torch.tensor(1.0), "1 of Tensor"),
        (lambda image, target: 2 * torch.tensor(1.0, requires_grad=True), "1 of Tensor"),
        (lambda image, target: (image - target).mean(dim=(0, 2, 3)), "3 of Tensor"),
    ],
)
def test_modules_that_return_no_number_of_the_image(says, got):
    with pytest.raises(ValueError, match=f"one number of PyTorch that depends on the image, got {got}$"):
        loss_of(says)


def test_modules_have_their_own_precision():
    """Images go where the weights are. Without a gradient around it, there still is one; the weights get none."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.Softplus(), torch.nn.Conv2d(4, 1, 3))
    value, gradient, metrics = loss_of(comparison(network))
    with torch.no_grad():
        again, slope, _ = loss_of(comparison(network.double()))
    assert again == pytest.approx(value, rel=1e-5) and metrics["largest"] > 0
    np.testing.assert_allclose(slope, gradient, rtol=1e-3, atol=1e-7)
    assert slope.dtype == np.float32 and slope.any() and all(w.grad is None for w in network.parameters())


def comparison(network) -> torch.nn.Module:
    class Module(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.network = network

        def forward(self, image, target):
            difference = self.network(image) - self.network(target)
            return (difference**2).mean(), {"largest": difference.abs().max()}

    return Module()


def test_modules_that_are_none():
    with pytest.raises(
        ValueError, match=r"^fit: torch_loss takes a module or a function of image and target, got <cla"
    ):
        torch_loss(torch.nn.MSELoss)
    with pytest.raises(
        ValueError, match=r"^fit: the loss is a module of PyTorch, give inverse.torch_loss\(MSELoss\(\)\)"
    ):
        Problem(scene="scene.xml", free=Free(key=COLOUR, kind="material"), loss=torch.nn.MSELoss())
    with pytest.raises(ValueError, match=r"or one number and a dictionary of metrics, numbers by name$"):
        loss_of(lambda image, target: ((image - target).mean(), [1.0]))
