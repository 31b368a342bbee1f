"""Fits that nobody designed: what Python lets pass must be said in one line, or work."""

from __future__ import annotations

import functools
import os
import signal
import threading

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight import inverse
from rimlight.cli import main
from rimlight.inverse import Free, Problem, Stage, Target
from rimlight.inverse import problem as problems

pytestmark = pytest.mark.usefixtures("no_derivative_image")

BALL, BOX = "ball.bsdf.reflectance.value", "box.vertex_positions"
WIDTH, HEIGHT = 17, 11


def scene(width: int = WIDTH, height: int = HEIGHT, *, pixels: str = "rgb", texels: int = 0) -> dict:
    """A ball and a box under a sky, seen by a camera whose film has an odd size. texels : of the ball, in a row."""
    look = mi.ScalarTransform4f().look_at
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": pixels, "rfilter": {"type": "box"}}
    colour = {"type": "rgb", "value": [0.5, 0.4, 0.3]}
    if texels:
        colour = {"type": "bitmap", "data": mi.TensorXf(np.full((texels, texels, 3), 0.5)), "raw": True}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40, "to_world": look([0, 1, -5], [0, 0, 0], [0, 1, 0]), "film": film},
        "sky": {"type": "constant"},
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": colour}},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([1, 0, 0]).scale(0.5)},
    }


def grey(channels: int = 3, value: float = 0.4, kind: str = "float32") -> np.ndarray:
    return np.full((HEIGHT, WIDTH, channels), value, kind)


def posed(**options) -> Problem:
    options = {"scene": scene(), "target": grey(), "free": Free(key=BALL, kind="material", rate=0.02)} | options
    return Problem(**({"stage": Stage(iterations=3, spp=1), "integrator": {"type": "direct_edge"}} | options))


def fitted(**options) -> inverse.Result:
    return inverse.fit(posed(**options), progress=False)


# ------------------------------------------------------------------ settings


@pytest.mark.parametrize(
    ("make", "culprit"),
    [
        (lambda: Free(key=BALL, kind="materials"), "free.kind must be one of pose, material, light, shape, got 'mat"),
        (lambda: Free(key=3, kind="material"), "free.key must be texts, got 3"),
        (lambda: Free(key=BALL, kind="material", rate="0.1"), "free.rate must be a number, got '0.1'"),
        (lambda: Free(key=BALL, kind="material", start="0.1"), "free.start must be numbers, got '0.1'"),
        (lambda: Free(key=BALL, kind="material", vertices=(0.5,)), "free.vertices must be whole numbers"),
        (lambda: Stage(iterations=2.5), "stage.iterations must be a whole number, got 2.5"),
        (lambda: Stage(rate="fast"), "stage.rate must be a number > 0, or a function of the step, got 'fast'"),
        (lambda: Target(alpha="no"), "target.alpha must be true or false, got 'no'"),
        (lambda: Target(colour="rgb"), "target.colour must be one of auto, linear, srgb, got 'rgb'"),
        (lambda: inverse.Loss(pyramid=1.5), "loss.pyramid must be a whole number, got 1.5"),
        (lambda: inverse.Starts(count="3"), "starts.count must be a whole number, got '3'"),
        (lambda: posed(seed=1.5), "fit: seed must be a whole number, got 1.5"),
        (lambda: posed(free=BALL), "free must be of the type Free, got 'ball"),
        (lambda: posed(stage={"iterations": 3}), "stage must be of the type Stage, got {'iterations': 3}"),
        (lambda: posed(integrator="direct_edge"), "integrator must be a dictionary, got 'direct_edge'"),
        (lambda: posed(loss="l3"), "one of l1, l2, relative, classifier, or in Python a function, got 'l3'"),
    ],
)
def test_settings_of_another_type_are_refused(make, culprit):
    with pytest.raises(ValueError) as error:
        make()
    assert culprit in str(error.value) and "\n" not in str(error.value)


def test_numbers_of_numpy_are_numbers():
    free = Free(key=[BALL], kind="material", rate=np.float32(0.5), start=np.array([0.1, 0.2, 0.3]))
    assert free.key == (BALL,) and free.rate == 0.5 and free.start == (0.1, 0.2, 0.3)
    assert {type(x) for x in (free.rate, *free.start)} == {float}
    assert Free(key=BALL, kind="material", start=0.1).start == (0.1,)
    assert type(Stage(iterations=np.int64(3)).iterations) is int
    assert posed(loss="l1").norms == ("l1",)


@pytest.mark.parametrize("says", [float("nan"), -1.0, None, np.ones(1), "0.1"])
def test_schedules_that_say_nonsense(says):
    with pytest.raises(ValueError, match=r"schedule of a stage must return a number >= 0, got .* at step 0"):
        fitted(stage=Stage(iterations=3, spp=1, rate=lambda step: says))


class Rule:
    """An optimiser that returns anything."""

    def __init__(self, says):
        self.says = says

    def init(self, latents):
        return ()

    def update(self, gradients, state, latents):
        return self.says(gradients)


@pytest.mark.parametrize("says", [lambda g: ({}, ()), lambda g: ({k: np.zeros(7) for k in g}, ()), lambda g: None])
def test_optimisers_that_return_nonsense(says):
    with pytest.raises(ValueError, match=f"must return changes of these numbers, {BALL}: 3, and its state"):
        fitted(optimiser=Rule(says))


@pytest.mark.parametrize("metrics", [{"a": np.zeros(3)}, {"a": "b"}, [1.0]])
def test_metrics_that_are_no_numbers(metrics):
    with pytest.raises(ValueError, match="a dictionary of metrics, numbers by name"):
        inverse.Fit(posed(loss=lambda image, target, weight: (1.0, np.zeros_like(image), metrics)))


@pytest.mark.parametrize("says", [1.0, np.float32(1)])
def test_regularisers_without_a_derivative(says):
    with pytest.raises(ValueError, match=f"a number of Dr.Jit, which has a derivative, got {type(says).__name__}"):
        inverse.Fit(posed(), regularisers=[lambda values: says]).step()


def test_gradients_that_are_not_finite_are_counted():
    """Integrators leave them out, so that they looked like those of a parameter without influence."""
    loss = lambda image, target, weight: (1.0, np.full_like(image, np.nan), {})
    found = fitted(loss=loss, stage=Stage(iterations=9, spp=1), max_bad=4)
    assert found.status == "gave up: 4 steps in a row led to numbers that are not finite"
    assert found.skipped == len(found.losses) == 4


def test_bodies_that_fly_away_are_held_back():
    """Sines of such angles are not finite."""
    free = Free(key=BOX, kind="pose", rate=1e12)
    found = fitted(optimiser="sgd", free=free, stage=Stage(iterations=9, spp=1), max_bad=3)
    assert found.status == "gave up: 3 steps in a row led to numbers that are not finite"
    assert all(np.isfinite(value).all() for value in found.values.values())


def test_losses_cannot_change_the_target():
    def loss(image, target, weight):
        target[:] = 0
        return 1.0, np.ones_like(image), {}

    with pytest.raises(ValueError, match="read-only"):
        fitted(loss=loss)


def test_metrics_that_come_and_go():
    """Each is a curve with gaps."""
    calls = []

    def loss(image, target, weight):
        calls.append(0)
        return 1.0, np.ones_like(image), {"odd" if len(calls) % 2 else "even": 1.0}

    found = fitted(loss=loss)
    np.testing.assert_array_equal(np.isnan(found.scores["odd"]), ~np.isnan(found.scores["even"]))


def test_no_more_threads_than_cores():
    before = dr.thread_count()
    try:
        fitted(threads=500)
        assert dr.thread_count() <= (os.cpu_count() or 1)
    finally:
        dr.set_thread_count(before)


def test_functions_that_are_none():
    with pytest.raises(ValueError, match=r"^fit: on_step must be functions, got 3$"):
        inverse.Fit(posed(), on_step=3)


def test_one_function_in_place_of_several():
    seen: list[inverse.Step] = []
    fit = inverse.Fit(posed(), regularisers=inverse.prior(BALL, 0.5, 1), on_step=seen.append)
    assert len(list(fit)) == len(seen) == 3
    with pytest.raises(RuntimeError, match="no step left of 3"):
        fit.step()


def test_makers_of_optimisers_take_a_rate():
    with pytest.raises(ValueError, match=r"optimiser\(1\.0\).* makes no optimiser"):
        inverse.Fit(posed(optimiser=functools.partial(mi.ad.Adam, lr=0.1)))


@pytest.mark.parametrize("executor", [3, inverse.Cluster])
def test_executors_that_are_none(executor):
    with pytest.raises(ValueError, match=r"^fit: an executor has the methods gradient and map, such as a Cluster, got"):
        inverse.Fit(posed(), executor=executor)


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        ({"starts": inverse.Starts(count=3, move=0.1)}, "all starts are the same: starts.move and starts.turn spread"),
        ({"free": Free(key=BOX, kind="pose", move="", turn="")}, '"box" cannot move'),
        ({"free": Free(key=BOX, kind="shape", move="")}, '"box" cannot move'),
        ({"target": ["nothing.png"]}, 'there is no file "nothing.png"'),
        ({"target": [None]}, r"a target is None; Target\(\) is the unchanged scene file"),
    ],
)
def test_fits_of_nothing(options, culprit):
    with pytest.raises((ValueError, FileNotFoundError), match=f"^fit: {culprit}"):
        inverse.Fit(posed(**options))


# ------------------------------------------------------------------ files and folders

TOML = 'scene = "s.xml"\n[[free]]\nkey = "a"\nkind = "{}"\n'


def test_files_of_other_editors(tmp_path):
    """Those of Windows begin files with a mark, and may not write UTF-8."""
    file = tmp_path / "Größe 1.toml"
    file.write_text(TOML.format("light").replace("\n", "\r\n"), "utf-8-sig")
    assert problems.read(file).free[0].kind == "light"
    file.write_text("# grün\n" + TOML.format("light"), "latin-1")
    with pytest.raises(ValueError, match=r"Größe 1\.toml: it is not UTF-8 \(byte 4\); save it as that$"):
        problems.read(file)


def test_a_kind_that_is_none(tmp_path):
    (tmp_path / "fit.toml").write_text(TOML.format("mat"), "utf-8")
    with pytest.raises(ValueError, match=r"expected one of pose, material, light, shape, got 'mat' @ fit\.free"):
        problems.read(tmp_path / "fit.toml")


@pytest.mark.parametrize("command", ["fit joint fit.toml", "reproduce fig6a"])
def test_workers_of_two_clusters(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fit.toml").write_text(TOML.format("light"), "utf-8")
    assert main([*command.split(), "--out", "out", "--workers", "1", "--cluster", "tcp://127.0.0.1:1"]) == 2
    assert "--cluster takes those of a cluster; give one of them" in capsys.readouterr().err


def test_what_is_no_checkpoint(tmp_path):
    (tmp_path / "checkpoint.npz").write_bytes(b"garbage")
    with pytest.raises(ValueError, match=r"is no checkpoint, or damaged: File is not a zip file$"):
        inverse.Fit(posed(), out=tmp_path, resume=True)


def test_a_checkpoint_that_is_replaced_is_named(tmp_path, caplog):
    inverse.Fit(posed(), out=tmp_path)
    assert not caplog.messages
    inverse.Fit(posed(), out=tmp_path)
    assert "of a former fit is replaced; resume=True would go on from it" in caplog.text


@pytest.mark.parametrize(
    ("function", "got"),
    [
        (lambda image, target, weight: (image - target) ** 2, "561 of TensorXf"),
        (lambda image, target, weight: 0.5, "1 of float"),
        (lambda image, target, weight: dr.mean(dr.detach(image) - target, axis=None), "1 of TensorXf"),
    ],
)
def test_losses_of_drjit_that_return_no_number(function, got):
    with pytest.raises(ValueError, match=f"one number of Dr.Jit that depends on the image, got {got}$"):
        inverse.Fit(posed(loss=inverse.drjit_loss(function)))


# ------------------------------------------------------------------ pictures


@pytest.mark.parametrize(
    ("target", "culprit"),
    [
        (grey(kind="int64", value=128), "is of type int64; whole numbers that are sRGB are uint8 or uint16"),
        (grey(kind="complex64"), "a picture is a path, an array or a tensor, got an array of complex64"),
        (np.full((3, HEIGHT, WIDTH), 0.4), r"no picture of 1 to 4 channels, its shape is \(3, 11, 17\)"),
        (Target(file=grey(), mask=np.full((HEIGHT, WIDTH), np.nan)), 'mask "in memory" has pixels that are not finite'),
        (Target(file=grey(), mask=np.zeros((HEIGHT, WIDTH), int)), "no pixel counts"),
    ],
)
def test_pictures_that_are_none(target, culprit):
    with pytest.raises(ValueError, match=culprit):
        inverse.Fit(posed(target=target))


def test_bytes_as_floats_are_doubted():
    (doubt,) = fitted(target=grey(value=128)).doubts
    assert "is made of whole numbers, up to 128: if they are sRGB, give them as uint8 or uint16" in doubt


@pytest.mark.parametrize(
    ("pixels", "channels", "size"),
    [("rgb", 4, None), ("rgba", 4, 5), ("rgba", 3, None), ("luminance", 1, 4)],
)
def test_odd_sizes_and_channels(pixels, channels, size):
    """Width and height are prime; alpha is not compared; the ball ends darker or brighter, as the target says."""
    stage = Stage(iterations=6, spp=4, resolution=size)
    found = fitted(scene=scene(pixels=pixels), target=grey(channels, 0.05), stage=stage)
    assert not found.silent and (found.values[BALL] < [0.5, 0.4, 0.3]).all()
    assert found.views[0].result.shape == (HEIGHT, WIDTH, 1 if channels == 1 else 3)


# ------------------------------------------------------------------ scenes


def test_scenes_in_which_a_parameter_is_not_alike():
    """Once the numbers of the one were written into the other, whatever their count."""
    key = "ball.bsdf.reflectance.data"
    other = Target(scene=scene(texels=2), file=grey())
    free = Free(key=key, kind="material")
    with pytest.raises(ValueError, match=r"is not alike in all scenes, but TensorXf \(4, 4, 3\) and TensorXf \(2, 2"):
        inverse.Fit(posed(scene=scene(texels=4), target=[Target(file=grey()), other], free=free))


def test_two_scenes_of_which_one_has_the_parameter():
    without = scene(13, 9)
    del without["ball"]
    target = [Target(scene=without, file=np.full((9, 13, 3), 0.4)), Target(file=grey())]
    found = fitted(target=target, stage=Stage(iterations=3, spp=4))
    assert len(found.views) == 2 and not found.silent


def test_a_camera_inside_of_a_ball_sees_nothing():
    """A fit of what it does not see says so."""
    inside = scene()
    inside["camera"]["to_world"] = mi.ScalarTransform4f()
    found = fitted(scene=inside, stage=Stage(iterations=10, spp=1))
    assert found.silent == [BALL] and "the scene shows 0 at the start" in found.doubts[0]


# ------------------------------------------------------------------ Ctrl-C


def test_an_interruption_in_the_first_step_is_said(caplog):
    """While kernels are compiled, nothing else happens for a while."""
    fit = inverse.Fit(posed(stage=Stage(iterations=300, spp=1)))
    step = fit.step

    def interrupted() -> inverse.Step:
        os.kill(os.getpid(), signal.SIGINT)
        return step()

    fit.step = interrupted  # type: ignore[method-assign]
    assert threading.current_thread() is threading.main_thread()
    found = fit.run(progress=False)
    assert found.status == "interrupted" and len(found.losses) == 1
    assert "interrupted: the fit ends after this step, with a result; Ctrl-C ends it at once" in caplog.messages
