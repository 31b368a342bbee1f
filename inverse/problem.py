"""The description of a fit: frozen dataclasses, which TOML files and the command line fill in."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cattrs
import tomli_w
from cattrs.gen import make_dict_structure_fn
from cattrs.strategies import configure_union_passthrough

from rimlight.exr import replacing
from rimlight.loading import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Kind = Literal["pose", "material", "light", "shape"]
Value = str | bool | int | float

#: Classes of ImageNet.
CLASSES = 1000


@dataclass(frozen=True, kw_only=True)
class Target:
    """A picture that the scene should look like."""

    file: Path | None = None
    """Picture: EXR, PNG or JPEG. Without one, the unchanged scene file is rendered; its parameters are the truth."""
    scene: Path | None = None
    """Scene that the picture shows. Default: the scene of the problem."""
    sensor: int = 0
    """Number of the sensor that took the picture."""
    colour: Literal["auto", "linear", "srgb"] = "auto"
    """How its numbers relate to radiance. auto: EXR is linear, PNG and JPEG are sRGB."""
    alpha: bool = False
    """Weigh pixels by the alpha channel of the picture."""
    mask: Path | None = None
    """Picture whose black pixels are left out of the loss."""
    resize: bool = False
    """Resample the picture if its size is not that of the film."""
    spp: int = 4096
    """Samples per pixel of a target that is rendered."""


@dataclass(frozen=True, kw_only=True)
class Free:
    """A free parameter: one that the fit optimises. `to_world`, and vertex positions of the kind "pose", move as a
    rigid body. Other vertex positions move one by one. Of all other parameters, the numbers themselves change."""

    key: tuple[str, ...]
    """Parameters, as `rimlight params` lists them. Several keys move as one rigid body, or are fitted alike."""
    kind: Kind
    """Kind of the parameter. `rimlight fit KIND` optimises the parameters of one kind."""
    rate: float = 0.01
    """Length of the first steps, in scene units for positions and in the unit of the parameter otherwise."""
    turn_rate: float | None = None
    """Angle of the first steps of a rigid body, in radians. Default: `rate` divided by the size of the body."""
    move: str = "xyz"
    """World axes along which vertices or a rigid body may move."""
    turn: str = "xyz"
    """World axes about which a rigid body may turn. A body turns about its centre, a camera about its own."""
    vertices: tuple[int, ...] = ()
    """Only these vertices are free. Default: all."""
    smoothing: float = 0
    """λ of Mitsuba's large steps (Nicolet et al. 2021) for vertices. 0: no smoothing. Needs the package cholespy."""
    lower: float | None = None
    """Smallest legal value. Default: the limit that the name of the parameter implies."""
    upper: float | None = None
    """Largest legal value. Default: the limit that the name of the parameter implies."""
    unit_length: bool = False
    """Keep the rows of the parameter at unit length, because they are directions."""
    start: tuple[float, ...] = ()
    """Where the fit starts. Rigid bodies: a displacement and a rotation vector in degrees, 6 numbers. Vertices: a
    displacement of each, or one for all. Others: the value, or one number for all. Default: the value in the scene."""


@dataclass(frozen=True, kw_only=True)
class Loss:
    """Loss function: how much two pictures differ, as a weighted mean over pixels and channels; or, with `classifier`,
    what a neural network sees in the picture."""

    norm: Literal["l1", "l2", "relative", "classifier"] = "l2"
    """l1: |d|, l2: d², relative: d² / (t² + 0.01), of the difference d and the target t. classifier: the logarithm of
    the probabilities of `fall` over those of `rise`. It compares nothing: the target is the unchanged scene file, shown
    to people. Needs the extra `adversarial`."""
    rise: dict[str, int] = dataclasses.field(default_factory=dict)
    """Classes of ImageNet whose probability shall rise: label -> number, 0 … 999."""
    fall: dict[str, int] = dataclasses.field(default_factory=dict)
    """Classes of ImageNet whose probability shall fall: label -> number, 0 … 999."""
    pyramid: int = 0
    """Levels of a Gaussian pyramid. The loss is the mean over the levels. 0: only the pictures themselves."""
    exclude_above: float | None = None
    """Leave out pixels whose target exceeds this radiance in any channel."""
    channel: str | None = None
    """Name of the channel of `aov_edge` that is compared, such as a depth map or a mask. The target holds its numbers
    as they are. Default: none, for integrators that render nothing but light."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of the fit, with a resolution and rates of its own."""

    iterations: int = 100
    """Number of steps."""
    resolution: int | None = None
    """Width of the film, in pixels. Default: the width in the scene."""
    spp: int = 4
    """Samples per pixel of the image, and of the derivative as well."""
    rate: float = 1
    """Factor of all rates at the beginning of the stage."""
    decay: float = 1
    """Rates at the end of the stage over those at its beginning. In between, they change exponentially."""


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Several starts. The best one after the first stage continues. The first is the start as given."""

    count: int = 1
    """Number of starts."""
    move: float = 0
    """Standard deviation of displacements of rigid bodies along their free axes, in scene units."""
    turn: float = 0
    """Standard deviation of the rotation vectors of rigid bodies, in degrees."""
    value: float = 0
    """Standard deviation of other parameters, in their own units."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The complete description of a fit. It is written to TOML and read from it without loss."""

    scene: Path
    """Scene file of Mitsuba 3."""
    define: dict[str, str] = dataclasses.field(default_factory=dict)
    """Values for parameters of the scene file, such as res."""
    target: tuple[Target, ...] = (Target(),)
    """Pictures that the scene should look like."""
    free: tuple[Free, ...]
    """Free parameters, which the fit optimises."""
    loss: Loss = Loss()
    """Loss function."""
    stage: tuple[Stage, ...] = (Stage(),)
    """Stages, one after the other."""
    starts: Starts = Starts()
    """Several starting points."""
    integrator: dict[str, Value] = dataclasses.field(default_factory=lambda: {"type": "prb_edge"})
    """Integrator plugin that renders and differentiates, with its parameters."""
    optimiser: Literal["adam", "sgd"] = "adam"
    """Optimiser of Mitsuba. With sgd, `rate` is a factor of the gradient, not a length."""
    momentum: float = 0.9
    """Momentum of sgd, and first decay rate of adam."""
    smooth_scale: float = 0.99
    """Second decay rate of adam."""
    clip: float | None = None
    """Longest gradient of one parameter, as a multiple of the median of its last 50 lengths. Default: no limit."""
    parts: int = 1
    """Number of independent renders of each target in a step. Their losses and gradients are averaged. Several
    processes or machines can share them."""
    seed: int = 0
    """Random seed."""
    patience: int | None = None
    """End a stage if its loss has not fallen by 0.1 % within this many steps. Default: never."""
    seconds: float | None = None
    """End the fit after this many seconds. Default: no limit."""
    max_bad: int = 20
    """End the fit after this many gradients in a row that are not finite. Each is skipped and counted."""
    freeze: bool = True
    """Record the step once and replay it, where the integrator and the sensor allow that."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""
    threads: int | None = None
    """Threads of this process. With 1, a fit that is repeated or resumed ends with the same numbers, bit by bit.
    Default: one for each core."""

    def __post_init__(self) -> None:
        check(self)


# ------------------------------------------------------------------ checks


def check(problem: Problem) -> None:
    """Refuse what cannot be meant.

    Raises
    ------
    InputError : a number is out of range, or something is missing. The text names it as the TOML file does.
    """
    if not problem.free:
        raise InputError("fit: nothing is free, add a table [[free]]")
    if not problem.target or not problem.stage:
        raise InputError("fit: a fit needs at least one target and one stage")
    at_least = {"parts": 1, "seed": 0, "threads": 1, "max_bad": 1, "patience": 1, "seconds": 0}
    _at_least("", problem, at_least)
    _positive("", problem, ("clip",))
    for name in ("momentum", "smooth_scale"):
        if not 0 <= getattr(problem, name) < 1:
            raise InputError(f"fit: {name} must be in [0, 1), got {getattr(problem, name)}")
    if "type" not in problem.integrator:
        raise InputError('fit: integrator needs a "type"')
    _at_least("loss.", problem.loss, {"pyramid": 0, "exclude_above": 0})
    _at_least("starts.", problem.starts, {"count": 1, "move": 0, "turn": 0, "value": 0})
    if problem.starts.count > 1 and not (problem.starts.move or problem.starts.turn or problem.starts.value):
        raise InputError(
            "fit: several starts need starts.move, starts.turn or starts.value, else they are all the same"
        )
    for i, stage in enumerate(problem.stage):
        _at_least(f"stage.{i}.", stage, {"iterations": 1, "resolution": 1, "spp": 1})
        _positive(f"stage.{i}.", stage, ("rate", "decay"))
    for i, target in enumerate(problem.target):
        _at_least(f"target.{i}.", target, {"sensor": 0, "spp": 1})
    _check_classifier(problem)
    for i, free in enumerate(problem.free):
        where = f"free.{i}."
        if not free.key:
            raise InputError(f"fit: {where}key is empty")
        _positive(where, free, ("rate", "turn_rate"))
        _at_least(where, free, {"smoothing": 0})
        for name in ("move", "turn"):
            axes = getattr(free, name)
            if set(axes) - set("xyz") or len(set(axes)) < len(axes):
                raise InputError(f'fit: {where}{name} must consist of the letters x, y, z, got "{axes}"')
        low, high = (
            default if bound is None else bound
            for bound, default in ((free.lower, float("-inf")), (free.upper, float("inf")))
        )
        if not low < high:  # nor if one is not a number
            raise InputError(f"fit: {where}lower must be below upper, got {low} and {high}")


def _check_classifier(problem: Problem) -> None:
    loss = problem.loss
    named = [*loss.rise.items(), *loss.fall.items()]
    if loss.norm != "classifier":
        if named:
            raise InputError(f'fit: loss.rise and loss.fall need the norm "classifier", got "{loss.norm}"')
        return
    if not named:
        raise InputError('fit: the norm "classifier" needs loss.rise or loss.fall, such as { "traffic light" = 920 }')
    for label, number in named:
        if not 0 <= number < CLASSES:
            raise InputError(f'fit: the class "{label}" must have a number 0 … {CLASSES - 1}, got {number}')
    for what, column in (("label", 0), ("class", 1)):
        given = [pair[column] for pair in named]
        if twice := {x for x in given if given.count(x) > 1}:
            raise InputError(f'fit: loss.rise and loss.fall name the {what} "{twice.pop()}" twice')
    for name in ("pyramid", "exclude_above"):
        if getattr(loss, name):
            raise InputError(f'fit: loss.{name} needs pictures that are compared, the norm "classifier" has none')
    for i, target in enumerate(problem.target):
        for name in ("file", "mask"):
            if getattr(target, name) is not None:
                raise InputError(f'fit: target.{i}.{name}: with the norm "classifier" there is nothing to compare with')


def _at_least(where: str, of: Any, minima: Mapping[str, float]) -> None:
    for name, minimum in minima.items():
        value = getattr(of, name)
        if value is not None and not value >= minimum:
            raise InputError(f"fit: {where}{name} must be >= {minimum}, got {value}")


def _positive(where: str, of: Any, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(of, name)
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"fit: {where}{name} must be > 0, got {value}")


# ------------------------------------------------------------------ files


#: Type of a field -> its name for people, and what a file may say.
EXACT: dict[type, tuple[str, tuple[type, ...]]] = {
    bool: ("true or false", (bool,)),
    int: ("a whole number", (int,)),
    float: ("a number", (int, float)),
    str: ("a text", (str, int, float)),  # `define` may hold numbers
}


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True, omit_if_default=True)
    configure_union_passthrough(Value, converter)
    for kind, (told, allowed) in EXACT.items():
        converter.register_structure_hook(kind, _exactly(told, allowed))
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    converter.register_unstructure_hook(Path, Path.as_posix)
    # "key" may be one name.
    structure_free = make_dict_structure_fn(Free, converter, _cattrs_forbid_extra_keys=True)
    one_key = lambda d: {**d, "key": [d["key"]]} if isinstance(d.get("key"), str) else d
    converter.register_structure_hook(Free, lambda d, kind: structure_free(one_key(d), kind))
    return converter


def _exactly(told: str, allowed: tuple[type, ...]) -> Any:
    """Structures values of TOML without the conversions of Python, to which "false" is true and 2.7 is 2."""

    def structure(value: Any, kind: type) -> Any:
        if not isinstance(value, allowed) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"fit: expected {told}, got {value!r}")
        return kind(value)

    return structure


def read(path: Path | str) -> Problem:
    """Read a problem from a TOML file. Paths in it are relative to it.

    Raises
    ------
    ValueError : it is no TOML file, a key in it is unknown or missing, or has a value that makes no sense. The text is
        one line.
    OSError : it cannot be read.
    """
    path = Path(path)
    try:
        problem = from_text(path.read_text("utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return relative_to(problem, path.parent)


def from_text(text: str) -> Problem:
    """Read a problem from TOML. Raises ValueError, as `read` does."""
    tables = parse(text)
    for name in ("target", "free", "stage"):
        if isinstance(tables.get(name), dict):
            raise ValueError(f"fit: there may be several of {name}, write [[{name}]] instead of [{name}]")
    try:
        return _converter().structure(tables, Problem)
    except cattrs.BaseValidationError as error:
        raise ValueError("; ".join(cattrs.transform_error(error, "fit", _say))) from None


def _say(error: BaseException, kind: type | None) -> str:
    return str(error) if str(error).startswith("fit:") else cattrs.v.format_exception(error, kind)


def write(path: Path, problem: Problem) -> None:
    """Write a problem as `read` reads it, with absolute paths."""
    with replacing(path) as temporary:
        temporary.write_text(text(relative_to(problem, Path.cwd())), "utf-8")


def parse(text: str) -> dict[str, Any]:
    """TOML as a dictionary."""
    return tomllib.loads(text)


def text(problem: Problem) -> str:
    """A problem as TOML."""
    return tomli_w.dumps(_without_none(_converter().unstructure(problem)))


def relative_to(problem: Problem, folder: Path) -> Problem:
    """The problem with all paths seen from a folder, absolute."""
    place = lambda path: None if path is None else (folder / path).resolve()
    targets = tuple(
        dataclasses.replace(t, file=place(t.file), scene=place(t.scene), mask=place(t.mask)) for t in problem.target
    )
    return dataclasses.replace(problem, scene=(folder / problem.scene).resolve(), target=targets)


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return [_without_none(v) for v in value] if isinstance(value, list | tuple) else value
