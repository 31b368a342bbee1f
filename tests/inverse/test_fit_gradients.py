"""Gradients of losses with respect to scenes: against finite differences, without bias, replayed, at any resolution."""

from __future__ import annotations

import dataclasses
import gc
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from rimlight.inverse import balancing, free_parameters, losses, renderer
from rimlight.inverse.fitting import Fit
from rimlight.inverse.optimisers import inner_product
from rimlight.inverse.problem import Free, Loss, Problem, Stage, Target
from rimlight.inverse.renderer import Gradient, Renderer, Task

ROOM = """<scene version="3.0.0">
    <default name="width" value="24"/>
    <default name="format" value="rgb"/>
    <sensor type="perspective" id="left">
        <transform name="to_world"><lookat origin="-2, 3, -4" target="0, 0.3, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="$width"/> <integer name="height" value="24"/>
            <string name="pixel_format" value="$format"/> <rfilter type="gaussian"/>
        </film>
    </sensor>
    <sensor type="perspective" id="right">
        <transform name="to_world"><lookat origin="3, 2, -3" target="0, 0.3, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="$width"/> <integer name="height" value="16"/>
            <string name="pixel_format" value="$format"/> <rfilter type="gaussian"/>
        </film>
    </sensor>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.6, 0.5"/></bsdf>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.5"/><rotate y="1" angle="20"/><translate y="0.8"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.5, 0.7"/></bsdf>
    </shape>
    <shape type="rectangle" id="light">
        <transform name="to_world"><scale value="0.5"/><rotate x="1" angle="90"/><translate x="-1" y="4"/></transform>
        <emitter type="area"><rgb name="radiance" value="40, 36, 32"/></emitter>
    </shape>
</scene>"""

BOX, FLOOR, LIGHT = "box.vertex_positions", "floor.bsdf.reflectance.value", "light.emitter.radiance.value"


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("room") / "room.xml"
    file.write_text(ROOM)
    return file


def problem(room: Path, *free: Free, **options) -> Problem:
    options = {"integrator": {"type": "direct_edge"}, "target": (Target(spp=256), Target(spp=256, sensor=1))} | options
    return Problem(scene=room, free=free or (Free(key=(FLOOR,), kind="material"),), **options)


def numbers(latents) -> dict[str, mi.Float]:
    return {name: mi.Float(np.float32(latent)) for name, latent in latents.items()}


def values(parameter, latents) -> dict[str, np.ndarray]:
    return {key: free_parameters.to_numpy(value) for key, value in parameter.values(numbers(latents)).items()}


def mean_and_error(samples) -> tuple[float, float]:
    return float(np.mean(samples)), float(np.std(samples, ddof=1) / np.sqrt(len(samples)))


# ------------------------------------------------------------------ finite differences


@pytest.mark.parametrize(
    ("view", "key", "kind", "start", "latent", "direction", "step"),
    [
        (1, FLOOR, "material", (0.3, 0.4, 0.5), FLOOR, (1, 0.5, -0.5), 0.02),
        (0, LIGHT, "light", (30, 20, 40), LIGHT, (1, 1, -0.5), 0.5),
        (0, BOX, "shape", (0.15, 0.1, 0), BOX, (0, 0, 0, 1, 0.5, 0.5) + 18 * (0,), 0.02),
        (1, BOX, "pose", (0.15, 0.1, 0, 0, 9, 0), "box.move", (1, 0, 0.5), 0.01),
        (1, BOX, "pose", (0.15, 0.1, 0, 0, 9, 0), "box.turn", (0.5, 1, 0), 0.02),
        (0, "left.to_world", "pose", (0.1, 0, 0, 0, 3, 0), "left.turn", (0, 1, 0.5), 0.003),
        (1, "right.to_world", "pose", (0.1, 0, 0, 0, 3, 0), "right.move", (1, 0.5, 0), 0.01),
    ],
    ids=["reflectance", "radiance", "vertex", "shift", "turn", "camera-turn", "camera-shift"],
)
def test_gradient_is_that_of_the_loss(room, view, key, kind, start, latent, direction, step):
    """Of the loss at a picture without noise: with pictures I, I' of other random numbers, (I − t) (I' − t) has the
    mean (Ī − t)²."""
    free, direction = Free(key=(key,), kind=kind, start=start), np.float32(direction)
    tested = Renderer(problem(room, free))
    (parameter,) = free_parameters.find([free], tested.params)
    target, _ = tested.views[view].picture()

    def along(seed: int) -> float:
        latents = numbers(parameter.start)
        dr.enable_grad(latents[latent])
        attached = parameter.values(latents)
        at = {key: free_parameters.to_numpy(value) for key, value in attached.items()}
        found = tested.gradient(at, [Task(view, None, 64, seed)]).gradients
        dr.backward(sum(inner_product(value, found[key]) for key, value in attached.items()))
        return float(np.dot(dr.grad(latents[latent]).numpy(), direction))

    def loss(θ: float, seed: int) -> float:
        at = values(parameter, parameter.start | {latent: parameter.start[latent] + θ * direction})
        first, second = (tested.image(at, Task(view, None, 256, 10_000 + 2 * seed + i)) for i in range(2))
        return float(np.mean((first - target).astype(np.float64) * (second - target)))

    g, g_error = mean_and_error([along(seed) for seed in range(12)])
    f, f_error = mean_and_error([(loss(step, s) - loss(-step, s)) / (2 * step) for s in range(10)])
    error = np.hypot(g_error, f_error)
    assert abs(g - f) <= 4 * error
    assert error < 0.05 * abs(f), "too noisy to mean something"


def test_derivative_image_is_that_on_the_way(room):
    """From the start through the result, of a rigid body, a camera and a colour at once."""
    free = (
        Free(key=(BOX,), kind="pose", start=(0.2, 0, 0, 0, 20, 0)),
        Free(key=("left.to_world",), kind="pose", start=(0.1, 0.1, 0, 0, 0, 0)),
        Free(key=(FLOOR,), kind="material", start=(0.3, 0.4, 0.5)),
    )
    run = Fit(problem(room, *free, target=(Target(spp=16),)))
    result, step = {name: truth for p in run.parameters for name, truth in p.truth.items()}, 0.05

    def image(t: float, seed: int) -> np.ndarray:
        at = {name: x + np.float32(t) * (x - run.start[name]) for name, x in result.items()}
        return run.renderer.image(run.values(at), Task(0, None, 4096, seed)).astype(np.float64)

    seeds, at = range(4), run.values(result)
    way = balancing.way(run, run.start, result)
    found = np.mean([run.renderer.derivative(at, way, Task(0, None, 1024, seed)) for seed in seeds], 0)
    expected = np.mean([image(step, 9 + seed) - image(-step, 9 + seed) for seed in seeds], 0) / (2 * step)
    print(np.abs(found - expected).sum() / np.abs(expected).sum())
    assert np.abs(found - expected).sum() < 0.04 * np.abs(expected).sum()


# ------------------------------------------------------------------ random numbers


@pytest.mark.parametrize("shared", [False, True])
def test_gradient_is_not_biased_by_shared_samples(room, monkeypatch, shared):
    """With one sample per pixel. The picture is linear in ρ, whence the derivative without noise. Were image and
    derivative made of the same samples, the mean would be another one: this test could tell."""
    one, ρ = Task(0, 8, 4096, 0), np.float32([0.3, 0.2, 0.1])
    posed = problem(room, integrator={"type": "prb", "max_depth": 2}, target=(Target(spp=256),))
    tested = Renderer(posed)
    dark, bright = (np.float64(tested.image({FLOOR: np.full(3, x, np.float32)}, one)) for x in (0, 1))
    target, _ = tested.views[0].target_at((8, 8))
    per_ρ = bright - dark
    expected = 2 * np.sum((dark + ρ * per_ρ - target) * per_ρ, axis=(0, 1)) / target.size
    if shared:
        monkeypatch.setattr(renderer, "derived_seed", lambda *numbers: numbers[0])
    gradients = [tested.gradient({FLOOR: ρ}, [Task(0, 8, 1, seed)]).gradients[FLOOR] for seed in range(300)]
    error = np.std(gradients, axis=0, ddof=1) / np.sqrt(len(gradients))
    z = (np.mean(gradients, axis=0) - expected) / error
    assert (error < 0.02 * np.abs(expected)).all(), "too noisy to mean something"
    assert (np.abs(z) > 4).all() if shared else (np.abs(z) <= 4).all(), z


def test_seeds_differ():
    assert renderer.derived_seed(0, 7) != renderer.derived_seed(0, 7, 0, 0)  # of targets and of steps
    seeds = {renderer.derived_seed(a, b, c, d) for a in range(2) for b in range(50) for c in range(3) for d in range(4)}
    assert len(seeds) == 2 * 50 * 3 * 4
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_parts_of_a_step_are_independent_and_can_be_repeated(room):
    tested = Renderer(problem(room))
    at = {FLOOR: np.float32([0.3, 0.4, 0.5])}
    first, other, again = (tested.gradient(at, [Task(0, None, 2, seed, show=True)]) for seed in (1, 2, 1))
    np.testing.assert_allclose(again.gradients[FLOOR], first.gradients[FLOOR], rtol=1e-5)
    np.testing.assert_allclose(again.image, first.image, rtol=1e-4, atol=1e-6)
    assert np.abs(first.image - other.image).max() > 0.01 and first.loss != other.loss


def test_what_came_before_does_not_matter(room):
    """Neither to the target, which is the scene as its file has it, nor to the random samples of edges."""
    box = np.array(Renderer(problem(room)).params[BOX], np.float32)
    at = lambda x: {FLOOR: np.float32([0.3, 0.4, x]), BOX: box + np.float32(x)}
    first, second = Renderer(problem(room)), Renderer(problem(room))
    first.image(at(0.4), Task(1, 8, 4, 0))
    first.gradient(at(-0.3), [Task(1, 8, 4, 0)])
    first.gradient(at(0.3), [Task(0, None, 4, 0)])
    found, expected = (tested.gradient(at(0.1), [Task(0, None, 4, 1, show=True)]) for tested in (first, second))
    np.testing.assert_allclose(first.views[0].picture()[0], second.views[0].picture()[0], rtol=1e-5)
    assert found.loss == pytest.approx(expected.loss, rel=1e-5)
    for key, gradient in expected.gradients.items():
        np.testing.assert_allclose(found.gradients[key], gradient, rtol=0, atol=1e-4 * np.abs(gradient).max())


# ------------------------------------------------------------------ replayed, resized


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge", "prb"])
def test_replayed_gradients_are_the_same(room, kind):
    """With other values and random numbers each time; of two views, one of another size."""
    found = []
    for freeze in (True, False):
        depth = {"prb": {"max_depth": 2}, "prb_edge": {"max_depth": 3}}
        integrator = {"type": kind, **depth.get(kind, {})}
        tested = Renderer(problem(room, integrator=integrator, freeze=freeze))
        box = np.array(tested.params[BOX], np.float32)
        camera = free_parameters.to_numpy(tested.params["right.to_world"])
        gradients = []
        for i in range(6):
            at = {FLOOR: np.float32([0.3, 0.4, 0.1 * i]), BOX: box + np.float32(0.02 * i)}
            at["right.to_world"] = camera + np.outer([0.05 * i, 0, 0, 0], [0, 0, 0, 1])
            gradients.append(tested.gradient(at, [Task(i % 2, (None, 12)[i % 2], 4, i, show=True)]))
        found.append(gradients)
        functions = [f for view in tested.views for pair in view.functions.values() for f in pair]
        assert len(functions) == 4 and {hasattr(f, "n_recordings") for f in functions} == {freeze}
        if freeze:
            assert {f.n_recordings for f in functions} <= {1, 2}  # the first call makes the film's storage
    for frozen, plain in zip(*found, strict=True):
        np.testing.assert_allclose(frozen.loss, plain.loss, rtol=1e-5)
        np.testing.assert_allclose(frozen.image, plain.image, rtol=1e-4, atol=1e-6)
        for key, gradient in plain.gradients.items():
            scale = np.abs(gradient).max()
            np.testing.assert_allclose(frozen.gradients[key], gradient, rtol=0, atol=2e-4 * scale, err_msg=key)
    keys = (FLOOR,) if kind == "prb" else (FLOOR, BOX, "right.to_world")  # which knows nothing of edges
    assert all(gradients[5].gradients[key].any() for gradients in found for key in keys)


def test_gradients_of_several_tasks_are_their_sum(room):
    """The parameters are set once for all; two of the views are of one scene."""
    tested = Renderer(problem(room))
    at = {
        FLOOR: np.float32([0.3, 0.4, 0.5]),
        BOX: np.array(tested.params[BOX], np.float32) + np.float32(0.02),
        "right.to_world": free_parameters.to_numpy(tested.params["right.to_world"]),
    }
    tasks = [Task(i % 2, (None, 12)[i // 2], 4, i, stage=0, doubt=i == 0, show=i == 1) for i in range(4)]
    for _ in range(2):  # recorded, and replayed
        apart, together = [tested.gradient(at, [task]) for task in tasks], tested.gradient(at, tasks)
        assert together.loss == pytest.approx(sum(g.loss for g in apart), rel=1e-6)
        np.testing.assert_allclose(together.image, apart[1].image, rtol=1e-4, atol=1e-6)
        for key in at:
            total = sum(g.gradients[key] for g in apart)
            np.testing.assert_allclose(together.gradients[key], total, rtol=0, atol=2e-6 * np.abs(total).max())


def test_memory_has_a_limit(room):
    """Samples are rendered in passes; the derivatives are as good."""
    posed = problem(room, integrator={"type": "prb_edge", "max_depth": 3}, target=Target(spp=16))
    at = {FLOOR: np.float32([0.3, 0.4, 0.5])}

    def peak(limit: float | None, spp: int) -> tuple[float, Gradient, int]:
        tested = Renderer(dataclasses.replace(posed, max_memory=limit))
        tested.gradient(at, [Task(0, None, 1, 0)])
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        found = tested.gradient(at, [Task(0, None, spp, 7)])
        return dr.detail.malloc_watermark(dr.JitBackend.LLVM) / 1e6, found, tested.views[0]._passes(spp)

    most, whole, _ = peak(None, 64)
    little, parts, passes = peak(most / 3, 64)
    assert little <= most / 3 and 3 < passes < 64
    assert parts.loss == pytest.approx(whole.loss, rel=0.1)
    expected = whole.gradients[FLOOR]
    np.testing.assert_allclose(parts.gradients[FLOOR], expected, rtol=0, atol=0.02 * np.abs(expected).max())
    with pytest.raises(ValueError, match=r"max_memory is 0\.01 MB, but one sample per pixel of target 0 at \d+ x \d+"):
        peak(0.01, 4)


def test_scenes_are_not_freed_while_a_function_is_recorded(room, monkeypatch):
    """Dr.Jit would end the process."""
    seen = []
    renderer = Renderer(problem(room, freeze=False))
    plain = renderer.views[0]
    functions = plain._functions(1)
    spies = [lambda *a, f=f: (seen.append(gc.isenabled()), f(*a))[1] for f in functions]
    monkeypatch.setattr(plain, "_functions", lambda spp, shares=(): spies)
    renderer.gradient({FLOOR: np.float32([0.3, 0.4, 0.5])}, [Task(0, None, 1, 0)])
    assert seen == [False, False] and gc.isenabled()


def test_size_of_the_film_changes_and_comes_back(room):
    tested = Renderer(problem(room))
    at = {FLOOR: np.float32([0.3, 0.4, 0.5]), BOX: np.array(tested.params[BOX], np.float32)}
    full = tested.gradient(at, [Task(1, None, 16, 0, show=True)])
    small = tested.gradient(at, [Task(1, 6, 16, 0, show=True)])
    again = tested.gradient(at, [Task(1, None, 16, 0, show=True)])
    assert full.image.shape == (16, 24, 3) and small.image.shape == (4, 6, 3)
    np.testing.assert_allclose(small.image.mean(), full.image.mean(), rtol=0.1)
    np.testing.assert_allclose(again.loss, full.loss, rtol=1e-5)
    for key, gradient in full.gradients.items():
        np.testing.assert_allclose(again.gradients[key], gradient, rtol=0, atol=1e-4 * np.abs(gradient).max())
    target, weight = tested.views[1].target_at((4, 6))
    blocks = tested.views[1].picture()[0].reshape(4, 4, 6, 4, 3)
    np.testing.assert_allclose(target, blocks.mean((1, 3)), rtol=1e-5)
    assert weight.shape == (4, 6)


# ------------------------------------------------------------------ views


def test_views_of_scenes_of_their_own(room, tmp_path):
    """Each target has its sensor and scene; a value that its scene lacks is ignored."""
    (tmp_path / "bare.xml").write_text(ROOM.replace('id="box"', 'id="thing"').replace("0.8, 0.6, 0.5", "0.1, 0.1, 0.1"))
    two = Target(spp=64), Target(scene=tmp_path / "bare.xml", sensor=1, spp=64)
    tested = Renderer(problem(room, target=two))
    at = {FLOOR: np.float32([0.8, 0.6, 0.5]), BOX: np.array(tested.params[BOX], np.float32)}
    np.testing.assert_allclose(tested.params[FLOOR].numpy().ravel(), [0.8, 0.6, 0.5])  # of the first scene
    first, second = (tested.gradient(at, [Task(i, None, 16, 0, show=True)]) for i in range(2))
    assert first.gradients.keys() == {FLOOR, BOX} and second.gradients.keys() == {FLOOR}
    assert first.image.shape == (24, 24, 3) and second.image.shape == (16, 24, 3)
    assert second.loss > 20 * first.loss > 0


@pytest.mark.parametrize(
    ("pixels", "channels"),
    [("rgb", 1), ("rgb", 4), ("rgba", 1), ("rgba", 3), ("rgba", 4), ("luminance", 1), ("luminance_alpha", 1)],
)
def test_films_and_pictures_of_other_channels(room, tmp_path, pixels, channels):
    """Colours are compared, without alpha; grey is that of all."""
    grey = np.full((24, 24, channels), 0.5, np.float32)
    file = tmp_path / "target.png"
    Image.fromarray(np.uint8(255 * grey).squeeze()).save(file)
    posed = problem(room, define={"format": pixels}, target=(Target(file=file),), loss=Loss(pyramid=1))
    tested = Renderer(posed)
    found = tested.gradient({FLOOR: np.float32([0.3, 0.4, 0.5])}, [Task(0, None, 4, 0, show=True)])
    assert found.image.shape == (24, 24, 1 if pixels.startswith("luminance") else 3)
    assert tested.views[0]._truth().shape == found.image.shape
    target = np.full_like(found.image, ((0.5 + 0.055) / 1.055) ** 2.4)
    expected, _, _ = losses.function(posed.loss)(found.image, target, np.ones((24, 24)))
    assert found.loss == pytest.approx(expected, rel=0.02)  # the picture has 8 bits
    assert found.gradients[FLOOR].any()


def test_a_film_without_colours_does_not_show_them(room, tmp_path):
    file = tmp_path / "target.png"
    Image.fromarray(np.full((24, 24, 3), 128, np.uint8)).save(file)
    tested = Renderer(problem(room, define={"format": "luminance"}, target=(Target(file=file),)))
    with pytest.raises(ValueError, match=r"target\.0: the picture has 3 channels, the film 1"):
        tested.gradient({}, [Task(0, None, 1, 0, show=True)])


def test_a_resolution_at_which_no_pixel_counts_is_refused_at_once(room, tmp_path):
    """Else loss and gradient would be 0."""
    stripes = np.full((24, 24), 255, np.uint8)
    stripes[:, ::4] = 0
    Image.fromarray(stripes).save(tmp_path / "mask.png")
    Image.fromarray(np.full((24, 24, 3), 128, np.uint8)).save(tmp_path / "target.png")
    target = Target(file=tmp_path / "target.png", mask=tmp_path / "mask.png")
    Fit(problem(room, target=(target,), stage=(Stage(), Stage(resolution=12))))
    with pytest.raises(ValueError, match=r"target\.0: no pixel counts at 6 x 6"):
        Fit(problem(room, target=(target,), stage=(Stage(), Stage(resolution=6))))


@pytest.mark.parametrize(
    ("options", "culprits"),
    [
        ({"target": (Target(), Target(sensor=2))}, ["target.1.sensor", "2 sensors", "2"]),
        ({"target": (Target(scene=Path("gone.xml")),)}, ["gone.xml", "does not exist"]),
        ({"integrator": {"type": "direct_egde"}}, ["direct_egde", "did you mean direct_edge"]),
        ({"integrator": {"type": "direct_edge", "sppii": 3}}, ["sppii"]),
        ({"define": {"size": "3"}}, ["size"]),
        ({"variant": "scalar_rgb"}, ["scalar_rgb", "cannot differentiate"]),
    ],
)
def test_problems_that_cannot_be_posed(room, options, culprits):
    with pytest.raises(ValueError) as error:
        Renderer(problem(room, **options))
    assert "\n" not in str(error.value)
    for culprit in culprits:
        assert culprit in str(error.value)
