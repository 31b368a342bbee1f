"""Pieces of a fit: problems in TOML, losses, pictures as targets."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from skimage.transform import pyramid_reduce

from rimlight.exr import write_exr
from rimlight.inverse import losses, problem, targets
from rimlight.inverse.problem import Free, Loss, Problem, Stage, Starts, Target

# ------------------------------------------------------------------ problems

RICH = Problem(
    scene=Path("scenes/room.xml"),
    define={"res": "48", "path": 'C:\\ä "quoted"'},
    target=(
        Target(file=Path("a.png"), sensor=2, colour="linear", alpha=True, mask=Path("../mask.png"), resize=True),
        Target(scene=Path("other.xml"), spp=7),
    ),
    free=(
        Free(
            key=("a.vertex_positions", "b.vertex_positions"), kind="pose", rate=1e-3, turn_rate=0.5, move="zx", turn=""
        ),
        Free(key=("c.vertex_positions",), kind="shape", vertices=(3, 1), smoothing=12.5, start=(0.1, -2.0, 1e-30)),
        Free(key=("d.normal",), kind="material", lower=-1.5, upper=2.0, unit_length=True),
    ),
    loss=Loss(norm="relative", pyramid=3, exclude_above=4.5, channel="depth"),
    stage=(Stage(iterations=3, resolution=16, spp=2, rate=0.5, decay=0.1, norm="l1"), Stage()),
    starts=Starts(count=4, move=0.1, turn=20.0, value=0.3),
    integrator={"type": "prb", "max_depth": 3, "hide_emitters": True, "scale": 0.5, "flag": False},
    optimiser="sgd",
    momentum=0.5,
    smooth_scale=0.9,
    clip=3.0,
    parts=2,
    views_per_step=1,
    max_memory=500.0,
    seed=11,
    patience=9,
    seconds=1.5,
    balance=True,
    max_bad=2,
    freeze=False,
    variant="cuda_ad_rgb",
    threads=3,
)
ADVERSARIAL = Problem(
    scene=Path("a.xml"),
    free=RICH.free,
    loss=Loss(norm="classifier", rise={"traffic light": 920}, fall={'"ä"': 0, "b.c": 999}),
)
HEAD = 'scene = "a.xml"\n'
FREE = '[[free]]\nkey = "a"\nkind = "shape"\n'


def set_fields(values) -> dict[str, list]:
    """Of several dataclasses: names of fields -> those values that are not the default."""
    found: dict[str, list] = {}
    for field in dataclasses.fields(values[0]):
        default = field.default_factory() if callable(field.default_factory) else field.default
        found[field.name] = [v for value in values if (v := getattr(value, field.name)) != default]
    return found


def test_problems_survive_toml(tmp_path, monkeypatch):
    for of_a_kind in ([RICH], RICH.target, RICH.free, [RICH.loss, ADVERSARIAL.loss], RICH.stage, [RICH.starts]):
        assert all(set_fields(of_a_kind).values()), "the example leaves a field at its default"
    again = problem.from_text(problem.text(RICH))
    assert again == RICH
    assert problem.from_text(problem.text(ADVERSARIAL)) == ADVERSARIAL
    assert [type(v) for v in again.integrator.values()] == [str, int, bool, float, bool]
    monkeypatch.chdir(tmp_path)
    problem.write(Path("fit.toml"), RICH)
    assert problem.read("fit.toml") == problem.relative_to(RICH, tmp_path)


def test_paths_are_relative_to_the_file(tmp_path):
    (tmp_path / "deep").mkdir()
    file = tmp_path / "deep" / "fit.toml"
    file.write_text('scene = "../a.xml"\ntarget = [{ file = "t.png", mask = "/m.png" }, { scene = "b.xml" }]\n' + FREE)
    read = problem.read(file)
    assert read.scene == tmp_path / "a.xml"
    assert read.target[0].file == tmp_path / "deep" / "t.png"
    assert read.target[0].mask == Path("/m.png")
    assert read.target[1].scene == tmp_path / "deep" / "b.xml" and read.target[1].file is None
    assert read.free[0].key == ("a",)  # a plain string is one key


def test_numbers_of_scene_files_need_no_quotes():
    assert problem.from_text(f"{HEAD}define = {{ res = 64, x = 0.5 }}\n{FREE}").define == {"res": "64", "x": "0.5"}


@pytest.mark.parametrize(
    ("text", "culprits"),
    [
        (HEAD + "sead = 3\n" + FREE, ["sead"]),
        (HEAD + "loss = { levels = 3 }\n" + FREE, ["levels", "fit.loss"]),
        (HEAD + "stage = [{}, { spps = 3 }]\n" + FREE, ["spps", "stage[1]"]),
        (HEAD + FREE + "rates = 3\n", ["rates", "free[0]"]),
        (HEAD + "seed = 2.5\n" + FREE, ["2.5", "fit.seed"]),
        (HEAD + 'seed = "3"\n' + FREE, ["'3'", "fit.seed"]),
        (HEAD + "seed = true\n" + FREE, ["True", "fit.seed"]),
        (HEAD + 'freeze = "false"\n' + FREE, ["'false'", "fit.freeze"]),
        (HEAD + 'momentum = "much"\n' + FREE, ["'much'", "fit.momentum"]),
        (HEAD + 'loss = { norm = "l3" }\n' + FREE, ["l3", "l1", "fit.loss.norm"]),
        (HEAD + "loss = 3\n" + FREE, ["fit.loss"]),
        (HEAD + "define = { res = [1] }\n" + FREE, ["res"]),
        (HEAD + 'integrator = { type = "prb", x = [1] }\n' + FREE, ["fit.integrator['x']"]),
        (HEAD + "[stage]\nspp = 3\n" + FREE, ["[[stage]]"]),
        (HEAD + FREE + "vertices = [1.5]\n", ["1.5", "free[0].vertices[0]"]),
        (HEAD + FREE + 'start = "12"\n', ["free[0].start[0]"]),
        (HEAD + '[[free]]\nkey = "a"\nkind = "shap"\n', ["shap", "shape", "free[0].kind"]),
        (HEAD + '[[free]]\nkey = "a"\n', ["missing", "free[0].kind"]),
        (HEAD + '[[free]]\nkey = []\nkind = "shape"\n', ["free.0.key"]),
        (HEAD, ["missing", "fit.free"]),
        (FREE, ["missing", "fit.scene"]),
        (HEAD + "free = []\n", ["[[free]]"]),
        (HEAD + "target = []\n" + FREE, ["target"]),
        ("scene = \n", ["line 1"]),
        (HEAD + "parts = 0\n" + FREE, ["parts must be >= 1, got 0"]),
        (HEAD + "seconds = nan\n" + FREE, ["seconds", "nan"]),
        (HEAD + "momentum = 1\n" + FREE, ["momentum must be in [0, 1), got 1"]),
        (HEAD + "integrator = { max_depth = 2 }\n" + FREE, ["integrator", "type"]),
        (HEAD + "starts = { count = 3 }\n" + FREE, ["starts.move"]),
        (HEAD + "starts = { count = 3, turn = -1 }\n" + FREE, ["starts.turn", "-1"]),
        (HEAD + "stage = [{}, { iterations = 0 }]\n" + FREE, ["stage.1.iterations", "0"]),
        (HEAD + "stage = [{ decay = 0 }]\n" + FREE, ["stage.0.decay", "0"]),
        (HEAD + "target = [{ sensor = -1 }]\n" + FREE, ["target.0.sensor", "-1"]),
        (HEAD + "loss = { pyramid = -1 }\n" + FREE, ["loss.pyramid", "-1"]),
        (HEAD + FREE + "rate = inf\n", ["free.0.rate", "inf"]),
        (HEAD + FREE + 'move = "xw"\n', ["free.0.move", "xw"]),
        (HEAD + FREE + 'turn = "xx"\n', ["free.0.turn", "xx"]),
        (HEAD + FREE + "lower = 2\nupper = 1\n", ["free.0.lower", "2", "1"]),
        (HEAD + FREE + "lower = nan\n", ["free.0.lower", "nan"]),
        (HEAD + "clip = 0\n" + FREE, ["clip must be > 0, got 0"]),
    ],
)
def test_mistakes_are_named_in_one_line(tmp_path, text, culprits):
    file = tmp_path / "fit.toml"
    file.write_text(text)
    with pytest.raises(ValueError) as error:
        problem.read(file)
    message = str(error.value)
    assert "\n" not in message
    for culprit in ("fit.toml", *culprits):
        assert culprit in message


# ------------------------------------------------------------------ losses

LOSSES = [Loss(norm=norm, pyramid=pyramid) for norm in ("l1", "l2", "relative") for pyramid in (0, 3)]


def pictures(height: int, width: int, channels: int = 3):
    """Image, target and weights, of which a third is 0."""
    rng = np.random.default_rng(0)
    image, target = rng.uniform(0, 2, (2, height, width, channels))
    return image, target, np.maximum(rng.uniform(-0.5, 1, (height, width)), 0)


@pytest.mark.parametrize("size", [(13, 18), (16, 8, 1), (1, 5)], ids=str)
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: f"{loss.norm}-{loss.pyramid}")
def test_gradients_of_losses(loss, size):
    image, target, weight = pictures(*size)
    _, gradient, _ = losses.function(loss)(image, target, weight)
    assert gradient.shape == image.shape
    rng, h = np.random.default_rng(1), 1e-6
    value = lambda change: losses.function(loss)(image + change, target, weight)[0]
    for i in range(30):
        change = np.zeros_like(image) if i else rng.standard_normal(image.shape)
        if i:
            change.flat[rng.integers(image.size)] = 1
        expected = (value(h * change) - value(-h * change)) / (2 * h)
        np.testing.assert_allclose(np.sum(gradient * change), expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: f"{loss.norm}-{loss.pyramid}")
def test_what_does_not_count_does_not_matter(loss):
    image, target, weight = pictures(13, 18)
    target[2:4, 5:9] += 1000  # the sun
    loss = dataclasses.replace(loss, exclude_above=500)
    weight = losses.pixels_that_count(loss, target, weight)
    assert not weight[2:4, 5:9].any() and weight.any()
    out = weight == 0
    value, gradient, _ = losses.function(loss)(image, target, weight)
    assert not gradient[out].any()
    image[out], target[out] = 1e4, -7e3
    other_value, other_gradient, _ = losses.function(loss)(image, target, weight)
    np.testing.assert_allclose(other_value, value, rtol=1e-12)
    np.testing.assert_allclose(other_gradient, gradient, rtol=1e-9, atol=1e-15)
    perfect, flat, _ = losses.function(loss)(target, target, weight)
    assert perfect == 0 and not flat.any()


def test_values_of_losses():
    """By hand, for one pixel of two that counts half."""
    image, target = np.array([[[3.0], [5.0]]]), np.array([[[1.0], [1.0]]])
    weight = np.array([[1.0, 0.5]])
    value = lambda norm: losses.function(Loss(norm=norm))(image, target, weight)[0]
    assert value("l1") == pytest.approx((2 + 0.5 * 4) / 1.5)
    assert value("l2") == pytest.approx((4 + 0.5 * 16) / 1.5)
    assert value("relative") == pytest.approx((4 + 0.5 * 16) / 1.01 / 1.5)


def test_pyramid_is_that_of_scikit_image():
    image, target, _ = pictures(13, 18)
    reduce = lambda a: pyramid_reduce(a, downscale=2, channel_axis=2)
    np.testing.assert_allclose(
        np.einsum("ih,hwc,jw->ijc", losses.reduction(13), image, losses.reduction(18)), reduce(image), atol=1e-12
    )
    value, _, _ = losses.function(Loss(pyramid=2))(image, target, np.ones((13, 18)))
    levels = [image - target]
    for _ in range(2):
        levels.append(reduce(levels[-1]))
    assert value == pytest.approx(np.mean([np.mean(np.square(level)) for level in levels]))


# ------------------------------------------------------------------ pictures as targets


def linear(encoded: float) -> float:
    """IEC 61966-2-1, above its straight part."""
    return ((encoded + 0.055) / 1.055) ** 2.4


def random_picture(height: int = 6, width: int = 8, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 0.9, (height, width, channels)).astype(np.float32)


def save(path: Path, image: np.ndarray) -> Path:
    """Numbers as they are, to a file of any format."""
    if path.suffix == ".exr":
        write_exr(path, {"": image})
    elif image.dtype == np.uint16:
        mi.Bitmap(image).write(str(path))
    else:
        options = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {}
        Image.fromarray(image.squeeze()).save(path, **options)
    return path


@pytest.mark.parametrize(
    ("name", "channels"),
    [(name, channels) for name in ("a.png", "a16.png", "A.PNG", "a.jpg") for channels in (1, 3, 4)][:-1],
)
def test_encoded_pictures(tmp_path, name, channels):
    kind = np.uint16 if "16" in name else np.uint8
    top = np.iinfo(kind).max
    image = (random_picture(16, 8, channels) * top).astype(kind)
    if name == "a.jpg":
        image[:] = 128
    file = save(tmp_path / name, image)
    colours = image[..., :3].astype(np.float64) / top
    read, weight = targets.read(Target(file=file), (16, 8))
    np.testing.assert_allclose(read, linear(colours), atol=2e-6 if name != "a.jpg" else 4e-3)
    np.testing.assert_array_equal(weight, 1)
    assert read.dtype == weight.dtype == np.float32
    if name != "a.jpg":
        raw, _ = targets.read(Target(file=file, colour="linear"), (16, 8))
        np.testing.assert_allclose(raw, colours, atol=1e-6)


def test_middle_grey(tmp_path):
    file = save(tmp_path / "grey.png", np.full((2, 2, 3), 188, np.uint8))
    assert targets.read(Target(file=file), (2, 2))[0] == pytest.approx(0.5029, abs=1e-4)
    exr = save(tmp_path / "grey.exr", np.full((2, 2, 3), 0.5, np.float32))
    assert targets.read(Target(file=exr), (2, 2))[0] == pytest.approx(0.5)
    assert targets.read(Target(file=exr, colour="srgb"), (2, 2))[0] == pytest.approx(linear(0.5), abs=1e-6)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_is_radiance(tmp_path, channels):
    image = 7 * random_picture(channels=channels) - 1
    read, _ = targets.read(Target(file=save(tmp_path / "a.exr", image)), (6, 8))
    np.testing.assert_array_equal(read, image[..., :3])


def test_alpha_and_mask_are_weights(tmp_path):
    image = random_picture(channels=4)
    image[0, 0, 3], image[0, 1, 3] = -1, 2
    file = save(tmp_path / "a.exr", image)
    alpha = np.clip(image[..., 3], 0, 1)
    black_and_white = np.uint8(255 * (np.arange(48).reshape(6, 8) % 3 > 0))
    mask = save(tmp_path / "mask.png", black_and_white[..., None])
    bits = tmp_path / "bits.png"
    Image.fromarray(black_and_white).convert("1").save(bits)
    for target, expected in (
        (Target(file=file), np.ones((6, 8))),
        (Target(file=file, alpha=True), alpha),
        (Target(file=file, mask=mask), black_and_white / 255),
        (Target(file=file, mask=bits), black_and_white / 255),
        (Target(file=file, mask=mask, alpha=True), alpha * black_and_white / 255),
    ):
        np.testing.assert_allclose(targets.read(target, (6, 8))[1], expected, rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_or_masked(tmp_path, bad):
    image = random_picture()
    image[2, 3, 1] = image[2, 4, 0] = bad
    file = save(tmp_path / "a.exr", image)
    with pytest.raises(ValueError, match=r"2 pixels that are not finite.*mask"):
        targets.read(Target(file=file), (6, 8))
    mask = np.full((6, 8, 1), 255, np.uint8)
    mask[2, 3:5] = 0
    target = Target(file=file, mask=save(tmp_path / "mask.png", mask), resize=True)
    for size in ((6, 8), (3, 4), (4, 5)):
        read, weight = targets.read(target, size)
        assert np.isfinite(read).all() and weight.max() <= 1
        assert (read[weight > 0.1] > 0.05).all() and (read < 0.95).all()
    assert not targets.read(target, (6, 8))[1][2, 3:5].any()


@pytest.mark.parametrize("size", [(3, 4), (4, 5), (5, 8)])
def test_smaller_targets_are_means_over_their_pixels(tmp_path, size):
    image = random_picture()
    file = save(tmp_path / "a.exr", image)
    read, _ = targets.read(Target(file=file, resize=True), size)
    (height, width), (rows, columns) = image.shape[:2], size
    fine = image.repeat(rows, axis=0).repeat(columns, axis=1)  # of which old and new pixels are blocks
    means = fine.reshape(rows, height, columns, width, 3).mean((1, 3))
    np.testing.assert_allclose(read, means, rtol=1e-5)


def test_pixels_that_count_in_part_do_not_count_when_smaller():
    """A render would show all of them."""
    image, weight = random_picture(), np.ones((6, 8), np.float32)
    weight[0], image[0] = 0, 1e30
    weight[4, 2] = 0.5
    read, share = targets.smaller(image, weight, (3, 4))
    np.testing.assert_allclose(read[1:], image.reshape(3, 2, 4, 2, 3).mean((1, 3))[1:], rtol=1e-5)
    expected = np.ones((3, 4))
    expected[0], expected[2, 1] = 0, 0.875
    np.testing.assert_allclose(share, expected)


def test_pictures_of_another_size(tmp_path):
    file = save(tmp_path / "a.exr", np.full((6, 8, 3), 0.7, np.float32))
    with pytest.raises(ValueError, match="8 x 6 pixels, the film 5 x 4; set resize"):
        targets.read(Target(file=file), (4, 5))
    for size in ((4, 5), (12, 16), (9, 3)):
        read, weight = targets.read(Target(file=file, resize=True), size)
        np.testing.assert_allclose(read, np.full((*size, 3), 0.7), rtol=1e-5)
        np.testing.assert_allclose(weight, np.ones(size), rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "culprits"),
    [
        ({"file": "gone.png"}, ["gone.png", "no file"]),
        ({"file": "."}, ["no file"]),
        ({"file": "a.png", "mask": "gone.png"}, ["gone.png"]),
        ({"file": "empty.png"}, ["empty.png"]),
        ({"file": "half.png"}, ["half.png"]),
        ({"file": "half.jpg"}, ["half.jpg"]),
        ({"file": "half.exr"}, ["half.exr"]),
        ({"file": "text.exr"}, ["text.exr", "no OpenEXR file"]),
        ({"file": "bright.exr", "colour": "srgb"}, ["bright.exr", "cannot be sRGB", "linear"]),
        ({"file": "a.jpg", "colour": "linear"}, ["a.jpg", "srgb"]),
        ({"file": "a.png", "alpha": True}, ["a.png", "no alpha channel"]),
        ({"file": "a.png", "mask": "black.png"}, ["a.png", "no pixel counts"]),
        ({"file": "a.png", "mask": "small.png"}, ["small.png", "4 x 3", "8 x 6"]),
    ],
)
def test_targets_that_cannot_be_read(tmp_path, capfd, options, culprits):
    picture = np.uint8(255 * random_picture())
    for name in ("a.png", "a.jpg", "a.exr"):
        file = save(tmp_path / name, random_picture() if "exr" in name else picture)
        (tmp_path / name.replace("a.", "half.")).write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.exr").write_text("no picture")
    save(tmp_path / "bright.exr", 4 * random_picture())
    save(tmp_path / "black.png", np.zeros((6, 8, 1), np.uint8))
    save(tmp_path / "small.png", np.full((3, 4, 1), 255, np.uint8))
    paths = {key: tmp_path / value for key, value in options.items() if key in ("file", "mask")}
    with pytest.raises((ValueError, OSError)) as error:
        targets.read(Target(**{**options, **paths}), (6, 8))
    assert "\n" not in str(error.value)
    for culprit in culprits:
        assert culprit in str(error.value)
