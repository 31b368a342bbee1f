"""Fits as a library: scenes, targets, losses, optimisers and loops of one's own."""

from __future__ import annotations

import ast
import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight import inverse, scenes
from rimlight.inverse import losses, optimisers, sources
from rimlight.inverse import problem as problems
from rimlight.inverse.problem import Free, Loss, Problem, Stage, Target

pytestmark = pytest.mark.usefixtures("no_derivative_image")

GREEN, COLOUR = "green.vertex_positions", "green.bsdf.reflectance.value"
MATERIAL = Free(key=COLOUR, kind="material", rate=0.02, start=(0.2,))
RELATIVE = f"{COLOUR}: relative error"


def posed(**options) -> Problem:
    options = {"scene": scenes.path("two_triangles"), "define": {"res": "16"}} | options
    options = {"free": MATERIAL, "stage": Stage(iterations=4), "target": Target(spp=16)} | options
    return Problem(**{"integrator": {"type": "direct_edge"}} | options)


def load() -> mi.Scene:
    return mi.load_file(str(scenes.path("two_triangles")), res=16)


# ------------------------------------------------------------------ scenes and targets


def test_a_scene_in_memory_is_fitted_as_its_file_is():
    expected = inverse.fit(posed(), progress=False)
    found = inverse.fit(posed(scene=load(), define={}), progress=False)
    np.testing.assert_allclose(found.losses, expected.losses, rtol=1e-5)
    np.testing.assert_allclose(found.values[COLOUR], expected.values[COLOUR], rtol=1e-4)


def target_in(kind: str, tmp_path):
    """One picture, (6, 8, 3), of which the scene can show the mean."""
    image = np.random.default_rng(0).uniform(0.2, 0.4, (6, 8, 3)).astype(np.float32)
    if kind == "array":
        return image
    if kind == "tensor":
        return mi.TensorXf(image)
    if kind == "torch":
        return pytest.importorskip("torch").tensor(image, requires_grad=True)
    if kind == "function":
        return lambda view: image[: view.size[0], : view.size[1]] + 0 * view.number
    from rimlight.exr import write_exr

    write_exr(tmp_path / "target.exr", {"": image})
    return str(tmp_path / "target.exr")


@pytest.mark.parametrize("kind", ["file", "array", "tensor", "torch", "function"])
def test_targets_of_any_kind(tmp_path, kind):
    target = target_in(kind, tmp_path)
    fit = inverse.Fit(posed(target=target, define={"res": "8"}, scene=small(tmp_path)))
    image, _ = fit.renderer.views[0].picture()
    expected = np.random.default_rng(0).uniform(0.2, 0.4, (6, 8, 3)).astype(np.float32)
    np.testing.assert_array_equal(image, expected)


def small(folder):
    """The scene with a film of 6 rows."""
    file = folder / "scene.xml"
    text = (
        scenes.path("two_triangles").read_text("utf-8").replace('name="height" value="$res"', 'name="height" value="6"')
    )
    file.write_text(text.replace("meshes/", f"{scenes.path('two_triangles').parent}/meshes/"), "utf-8")
    return file


def test_whole_numbers_are_srgb():
    whole = np.full((16, 16, 3), 188, np.uint8)
    image, _ = inverse.Fit(posed(target=whole)).renderer.views[0].picture()
    assert image == pytest.approx(0.5029, abs=1e-4)


def test_several_pictures_are_of_the_sensors_in_their_order():
    several = posed(target=[np.zeros((16, 16, 3)), np.ones((16, 16, 3))])
    assert [target.sensor for target in several.target] == [0, 1]


def test_a_fit_in_memory_is_resumed_if_its_arrays_are_the_same(tmp_path):
    image = np.full((16, 16, 3), 0.3, np.float32)
    mine = lambda target: posed(scene=load(), define={}, target=target, loss=Square())
    fit = inverse.Fit(mine(image), out=tmp_path)
    steps = iter(fit)
    next(steps)
    steps.close()  # a loop that is left writes a checkpoint
    assert inverse.Fit(mine(image.copy()), out=tmp_path, resume=True).progress.step == 1
    with pytest.raises(ValueError, match=r"target\.0\.file changed"):
        inverse.Fit(mine(image + 0.01), out=tmp_path, resume=True)
    text = (tmp_path / "problem.toml").read_text()
    assert 'scene = "in memory: mitsuba' in text and "Square" in text
    with pytest.raises(ValueError, match=r"problem\.toml: fit: .*memory of a Python program"):
        problems.read(tmp_path / "problem.toml")
    with pytest.raises(ValueError, match="memory of a Python program"):
        inverse.Cluster(mine(image), 2)


# ------------------------------------------------------------------ losses


class Square:
    """Mean squared difference, by hand."""

    label = "my squares"

    def __call__(self, image, target, weight):
        difference = np.float64(image) - target
        return np.mean(difference**2), 2 * difference / difference.size, {"largest": np.abs(difference).max()}


def by_drjit(image, target, weight):
    difference = image - target
    return dr.mean(weight[:, :, None] * difference * difference, axis=None), {
        "largest": dr.max(dr.abs(difference).array)
    }


def by_torch(image, target):
    return ((image - target) ** 2).mean(), {"largest": (image - target).abs().max().detach()}


@pytest.mark.parametrize("kind", ["own", "drjit", "torch"])
def test_losses_of_ones_own(kind):
    """The squared difference, in three ways: value, gradient and metrics, and the course of a fit."""
    if kind == "torch":
        pytest.importorskip("torch")
    loss = {
        "own": Square,
        "drjit": lambda: inverse.drjit_loss(by_drjit, "my squares"),
        "torch": lambda: inverse.torch_loss(by_torch, "my squares"),
    }[kind]()
    image, target = np.random.default_rng(0).uniform(0, 1, (2, 5, 7, 3)).astype(np.float32)
    weight = np.ones((5, 7), np.float32)
    value, gradient, metrics = loss(image, target, weight)
    expected, slope, _ = losses.L2()(image, target, weight)
    assert value == pytest.approx(expected, rel=1e-5) and gradient.shape == image.shape
    np.testing.assert_allclose(gradient, slope, rtol=1e-4, atol=1e-8)
    assert metrics["largest"] == pytest.approx(np.abs(image - target).max(), rel=1e-6)
    found, alike = (inverse.fit(posed(loss=of_one), progress=False) for of_one in (loss, Loss()))
    np.testing.assert_allclose(found.losses, alike.losses, rtol=1e-4)
    assert found.loss == "my squares" and found.scores["largest"].shape == (4,)
    assert found.measures[0]["largest"][1] < found.measures[0]["largest"][0]
    assert "my squares" in inverse.report._curves(found)


def test_what_does_not_count_does_not_matter_to_a_network():
    torch = pytest.importorskip("torch")
    loss = inverse.torch_loss(torch.nn.MSELoss())
    image, target = np.random.default_rng(0).uniform(0, 1, (2, 4, 4, 3)).astype(np.float32)
    weight = np.ones((4, 4), np.float32)
    weight[1] = 0
    value, gradient, _ = loss(image, target, weight)
    image[1] = 1e6
    assert loss(image, target, weight)[0] == pytest.approx(value) and not gradient[1].any() and gradient[0].all()


def test_stages_have_norms():
    """The second stage sees squares, the first one does not."""
    stages = Stage(iterations=2, norm="l1"), Stage(iterations=2, norm=Square()), Stage(iterations=2)
    fit = inverse.Fit(posed(loss=Loss(norm="relative"), stage=stages))
    values = fit.values()
    seen = [step.loss for step in fit]
    first = fit.renderer.gradient(values, [fit_task(fit, 0, 0)])
    image, (target, weight) = first.image, fit.renderer.views[0].target_at((16, 16))
    for stage, norm in enumerate((losses.L1(), losses.L2(), losses.Relative())):
        assert fit.renderer.losses[stage](image, target, weight)[0] == pytest.approx(norm(image, target, weight)[0])
    assert seen[0] == pytest.approx(losses.L1()(image, target, weight)[0], rel=1e-4)
    assert fit.result().loss == f"{losses.L1.label}, then my squares, then {losses.Relative.label}"
    assert np.isnan(fit.progress.scores["largest"]).tolist() == [True, True, False, False, True, True]


def fit_task(fit: inverse.Fit, step: int, stage: int):
    from rimlight.inverse.renderer import Task, derived_seed

    return Task(0, None, 4, derived_seed(fit.problem.seed, step, 0, 0), stage, show=True)


@pytest.mark.parametrize(
    ("loss", "culprit"),
    [
        (lambda image, target, weight: 1.0, "must return a number, its gradient, and a dictionary"),
        (lambda image, target, weight: (1.0, np.zeros(3), {}), r"gradient of shape \(3,\).*\(16, 16, 3\)"),
        (Loss(norm=Square(), pyramid=2), "loss.pyramid is for the losses by name"),
        (Loss(norm="l3"), "one of l1, l2, relative, classifier, or in Python a function, got 'l3'"),
    ],
)
def test_losses_that_make_no_sense(loss, culprit):
    with pytest.raises(ValueError, match=culprit):
        inverse.Fit(posed(loss=loss))


def test_no_other_file_knows_the_names_of_losses(root):
    """As words of a program; texts for people may say them."""
    for file in (root / "inverse").glob("*.py"):
        if file.name == "losses.py":
            continue
        tree = ast.parse(file.read_text("utf-8"))
        known = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and n.value in losses.NORMS}
        assert not known, file.name


# ------------------------------------------------------------------ optimisers


class Adam:
    """As Mitsuba's, by hand: a pair of functions."""

    def init(self, latents):
        zeros = {name: np.zeros(x.shape) for name, x in latents.items()}
        return 0, (zeros, dict(zeros))

    def update(self, gradients, state, latents):
        assert gradients.keys() == latents.keys()
        t, (mean, square) = state[0] + 1, state[1]
        mean = {n: 0.9 * mean[n] + 0.1 * np.float64(g) for n, g in gradients.items()}
        square = {n: 0.99 * square[n] + 0.01 * np.float64(g) ** 2 for n, g in gradients.items()}
        step = lambda n: -(mean[n] / (1 - 0.9**t)) / (np.sqrt(square[n] / (1 - 0.99**t)) + 1e-8)
        return {n: step(n) for n in gradients}, (t, (mean, square))


def descent(optimiser, **options) -> inverse.Result:
    free = MATERIAL, Free(key=GREEN, kind="shape", move="xy", rate=0.05, start=(0.2, -0.1, 0))
    return inverse.fit(
        posed(free=free, optimiser=optimiser, stage=Stage(iterations=6, decay=0.5), **options), progress=False
    )


@pytest.mark.parametrize("kind", ["pair", "maker", "instance"])
def test_optimisers_of_ones_own(kind):
    """Adam, in three ways, takes the same steps as ours."""
    own = {
        "pair": Adam(),
        "maker": functools.partial(mi.ad.Adam, beta_1=0.9, beta_2=0.99),
        "instance": mi.ad.Adam(lr=0.3, beta_1=0.9, beta_2=0.99),
    }[kind]
    expected, found = descent("adam"), descent(own)
    np.testing.assert_allclose(found.losses, expected.losses, rtol=2e-3)
    for key, value in expected.values.items():
        np.testing.assert_allclose(found.values[key], value, atol=2e-4)


@pytest.mark.parametrize("own", [Adam(), mi.ad.RMSProp, functools.partial(mi.ad.Adam, amsgrad=True)])
def test_checkpoints_hold_the_state_of_any_optimiser(tmp_path, own):
    fit = inverse.Fit(posed(optimiser=own))
    fit.step(), fit.step()
    fit.save(tmp_path / "fit.npz")
    again = inverse.Fit(posed(optimiser=own))
    again.load(tmp_path / "fit.npz")
    before, after = fit.optimiser.state(), again.optimiser.state()
    assert before.keys() == after.keys() and len(before) > 2
    for name in before:
        np.testing.assert_array_equal(after[name], before[name])
    fit.step(), again.step()
    np.testing.assert_allclose(again.latents()[COLOUR], fit.latents()[COLOUR], rtol=1e-5)


def test_trees_of_states_are_rebuilt():
    tree = {"b": (1, [np.zeros(2), None]), "a": np.float32(3)}
    leaves = list(optimisers._leaves(tree))
    again = optimisers._rebuilt(tree, iter([np.asarray(2 * leaf) for leaf in leaves]))
    assert again["a"] == 6 and again["b"][0] == 2 and isinstance(again["b"][0], int) and again["b"][1][1] is None


@pytest.mark.parametrize(
    ("optimiser", "culprit"),
    [("lion", 'one of adam, sgd, got "lion"'), (3, "got int"), (lambda rate: rate, "methods init and update")],
)
def test_optimisers_that_are_none(optimiser, culprit):
    with pytest.raises(ValueError, match=culprit):
        inverse.Fit(posed(optimiser=optimiser))


def test_schedules():
    stages = Stage(iterations=3, rate=lambda i: np.asarray(1 / (1 + i))), Stage(iterations=2, rate=0.5, decay=0.1)
    fit = inverse.Fit(posed(stage=stages))
    assert [step.rate for step in fit] == pytest.approx([1, 1 / 2, 1 / 3, 0.5, 0.05])


# ------------------------------------------------------------------ regularisers


def attached(value):
    dr.enable_grad(value)
    return value


def check_gradient(penalty, key: str, value, h: float = 1e-2) -> None:
    """Of a quadratic function: against central differences, which are exact."""
    held = attached(type(value)(value))
    dr.backward(penalty({key: held}))
    gradient = np.array(dr.grad(held)).ravel()
    flat = np.array(value, np.float32)
    for i in range(flat.size):
        change = np.zeros(flat.size, np.float32)
        change[i] = h
        at = lambda s: float(penalty({key: type(value)(flat + s * change.reshape(flat.shape))})[0])  # noqa: B023
        assert gradient[i] == pytest.approx((at(1) - at(-1)) / (2 * h), rel=2e-2, abs=2e-4)


def test_smooth_textures():
    texture = np.random.default_rng(0).uniform(0, 1, (3, 4, 2)).astype(np.float32)
    penalty = inverse.smooth_texture("t", 2.0)
    expected = sum(np.mean(np.diff(texture, axis=axis) ** 2) for axis in (0, 1))
    assert penalty({"t": mi.TensorXf(texture)})[0] == pytest.approx(2 * expected, rel=1e-5)
    check_gradient(penalty, "t", mi.TensorXf(texture))


def test_smooth_meshes():
    """A vertex in the middle of a square, and one above it."""
    place = np.float32([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 3]])
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    penalty = inverse.smooth_mesh("v", np.ravel(faces), 1.0)
    # The tip's neighbours have their middle 3 below it. Of a corner, the neighbours are two corners and the tip.
    corner = np.sum((np.float64([[2, 0, 0], [0, 2, 0], [1, 1, 3]]).mean(0)) ** 2)
    assert penalty({"v": mi.Float(place.ravel())})[0] == pytest.approx((9 + 4 * corner) / 5, rel=1e-5)
    check_gradient(penalty, "v", mi.Float(place.ravel()))


def test_priors_hold_back():
    """A strong one keeps a colour where it is expected, and its value is part of the loss."""
    free = inverse.fit(posed(stage=Stage(iterations=20)), progress=False)
    prior = inverse.prior(COLOUR, mean=0.2, spread=0.01)
    held = inverse.Fit(posed(stage=Stage(iterations=20, spp=16)), regularisers=[prior]).run(progress=False)
    assert np.abs(free.values[COLOUR] - 0.2).max() > 0.05 > 0.02 > np.abs(held.values[COLOUR] - 0.2).max()
    assert prior({COLOUR: mi.Color3f(0.21, 0.2, 0.2)})[0] == pytest.approx(1 / 3, rel=1e-3)
    fit = inverse.Fit(posed(), regularisers=[inverse.prior(COLOUR, mean=0.1, spread=0.1)])
    assert fit.step().loss == pytest.approx(1 + inverse.Fit(posed()).step().loss, rel=1e-3)


def test_regularisers_of_what_is_not_free():
    fit = inverse.Fit(posed(), regularisers=[inverse.prior("red.bsdf.reflectance.value", 0.5, 1)])
    with pytest.raises(ValueError, match=rf"'red\.bsdf\.reflectance\.value', which is not free; free are {COLOUR}"):
        fit.step()


# ------------------------------------------------------------------ loops


def test_a_loop_is_a_run():
    looped = inverse.Fit(posed())
    steps = list(looped)
    found, run = looped.result(), inverse.Fit(posed()).run(progress=False)
    np.testing.assert_allclose([step.loss for step in steps], run.losses, rtol=1e-5)
    assert [step.number for step in steps] == [0, 1, 2, 3] == [step.iteration for step in steps]
    assert steps[-1].errors[RELATIVE] == pytest.approx(run.errors[RELATIVE][3], rel=1e-4)
    assert looped.status == found.status == "finished" and list(looped) == []


def test_a_result_may_be_asked_for_at_any_time():
    fit = inverse.Fit(posed())
    steps = iter(fit)
    next(steps)
    for _ in range(2):
        early = fit.result()
        assert early.status == "running" and len(early.losses) == 1 and len(early.errors[RELATIVE]) == 2
    assert len(list(steps)) == 3
    assert len(fit.result().errors[RELATIVE]) == 5


def test_a_step_that_fails_leaves_the_last_checkpoint(tmp_path):
    fit = inverse.Fit(posed(), out=tmp_path)
    before = (tmp_path / "checkpoint.npz").read_bytes()
    steps = iter(fit)
    next(steps)
    fit.optimiser.step = lambda *_: 1 / 0
    with pytest.raises(ZeroDivisionError):
        next(steps)
    steps.close()
    assert (tmp_path / "checkpoint.npz").read_bytes() == before
    assert len(inverse.fit(posed(), out=tmp_path, resume=True, progress=False).losses) == 4


def test_functions_are_called_at_each_step_and_may_stop_the_fit():
    seen = []
    fit = inverse.Fit(posed(), on_step=[seen.append])

    @fit.on_step
    def stop(step: inverse.Step) -> None:
        if step.number == 1:
            fit.stop("good enough")

    found = fit.run(progress=False)
    assert found.status == "good enough" and [step.number for step in seen] == [0, 1] and len(found.losses) == 2


def test_fields_or_a_problem():
    assert inverse.Fit(scene=scenes.path("two_triangles"), free=[MATERIAL], define={"res": "8"}).problem.free == (
        MATERIAL,
    )
    with pytest.raises(ValueError, match="not both: seed"):
        inverse.Fit(posed(), seed=3)


def test_results_in_notebooks():
    html = inverse.fit(posed(stage=Stage(iterations=1)), progress=False)._repr_html_()
    assert "finished" in html and html.count("<img") == 3 and html.count("data:image/png") == 3
    assert "<html" not in html and "<script" not in html


def test_what_is_equal_at_the_start_stays_apart():
    """Mitsuba would make one mesh of both, and lose their names."""
    cube = {"type": "cube", "bsdf": {"type": "diffuse"}}
    sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    scene = {"type": "scene", "sensor": sensor, "sky": {"type": "constant"}, "a": cube, "b": cube}
    found = sources.scene(scene, {})
    assert {"a.vertex_positions", "b.vertex_positions"} <= set(mi.traverse(found).keys())
