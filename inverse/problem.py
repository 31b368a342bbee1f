"""The description of a fit: frozen dataclasses, which TOML files and the command line fill in, and Python programs with
scenes, pictures, losses and optimisers in memory besides."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args, get_origin

import cattrs
import numpy as np
import tomli_w
from cattrs.gen import make_dict_structure_fn
from cattrs.strategies import configure_union_passthrough

from rimlight.exr import replacing
from rimlight.loading import InputError

from . import checks, losses
from .conforming import conform, of_kind, one_of
from .losses import Loss, Norm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Kind = Literal["pose", "material", "light", "shape"]
Colour = Literal["auto", "linear", "srgb"]
Value = str | bool | int | float

# What files and the command line can say is less than what Python can.
if TYPE_CHECKING:
    import mitsuba as mi

    Scene: TypeAlias = Path | str | dict[str, Any] | mi.Scene
    Picture: TypeAlias = Path | str | Any
    Rate: TypeAlias = float | Callable[[int], float]
    Rule: TypeAlias = Literal["adam", "sgd"] | Any
else:
    Scene, Picture, Rate, Rule = Path, Path, float, Literal["adam", "sgd"]


def _place(source: Any) -> Any:
    """What stands for a path, with texts as paths."""
    return Path(source) if isinstance(source, str) else source


@dataclass(frozen=True, kw_only=True)
class Target:
    """A picture that the scene should look like."""

    file: Picture | None = None
    """Picture: EXR, PNG or JPEG. Without one, the unchanged scene file is rendered; its parameters are the truth. In
    Python also an array or tensor, (H, W, C), of linear radiance if its numbers are floats, else sRGB; or a function of
    the view, which has a `size`, (H, W), and a `number`, and returns such an array."""
    scene: Scene | None = None
    """Scene that the picture shows. Default: the scene of the problem."""
    sensor: int = 0
    """Number of the sensor that took the picture."""
    colour: Colour = "auto"
    """How its numbers relate to radiance. auto: EXR is linear, PNG and JPEG are sRGB."""
    alpha: bool = False
    """Weigh pixels by the alpha channel of the picture."""
    mask: Picture | None = None
    """Picture whose black pixels are left out of the loss."""
    resize: bool = False
    """Resample the picture if its size is not that of the film."""
    spp: int = 4096
    """Samples per pixel of a target that is rendered."""

    def __post_init__(self) -> None:
        conform(self)
        one_of(self, "colour", get_args(Colour))
        for name in ("file", "scene", "mask"):
            object.__setattr__(self, name, _place(getattr(self, name)))


@dataclass(frozen=True, kw_only=True)
class Free:
    """A free parameter: one that the fit optimises. `to_world`, and vertex positions of the kind "pose", move as a
    rigid body. Other vertex positions move one by one. Of all other parameters, the numbers themselves change."""

    key: tuple[str, ...]
    """Parameters, as `rimlight params` lists them. Several keys move as one rigid body, or are fitted alike. In Python
    one key may stand without the tuple."""
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

    def __post_init__(self) -> None:
        if isinstance(self.key, str):
            object.__setattr__(self, "key", (self.key,))
        conform(self)
        one_of(self, "kind", get_args(Kind))


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of the fit, with a resolution and rates of its own."""

    iterations: int = 100
    """Number of steps."""
    resolution: int | None = None
    """Width of the film, in pixels. Default: the width in the scene."""
    spp: int = 4
    """Samples per pixel of the image, and of the derivative as well."""
    rate: Rate = 1
    """Factor of all rates at the beginning of the stage. In Python also a schedule: a function of the number of the
    step in the stage, which returns the factor."""
    decay: float = 1
    """Rates at the end of the stage over those at its beginning. In between, they change exponentially."""
    norm: Norm | None = None
    """Norm of the loss in this stage. Default: that of the loss of the problem."""

    def __post_init__(self) -> None:
        conform(self)

    def factor(self, iteration: int) -> float:
        """Factor of all rates in a step of the stage. InputError : a schedule says nonsense."""
        first: Any = self.rate
        if callable(first):
            first = np.asarray(first(iteration))  # those of other libraries return arrays without dimensions
            if first.shape or first.dtype.kind not in "fiu" or not 0 <= first < np.inf:
                said = " ".join(repr(first.tolist()).split())
                raise InputError(
                    f"fit: the schedule of a stage must return a number >= 0, got {said} at step {iteration}"
                )
        return float(first * self.decay ** (iteration / max(self.iterations - 1, 1)))


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

    def __post_init__(self) -> None:
        conform(self)


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The complete description of a fit. It is written to TOML and read from it without loss, unless parts of it are
    objects in memory. `target` may hold pictures as they are: then number i was taken by sensor i."""

    scene: Scene
    """Scene file of Mitsuba 3. In Python also a dictionary, as for `mi.load_dict`, or an `mi.Scene`, which the fit
    changes."""
    define: dict[str, str] = dataclasses.field(default_factory=dict)
    """Values for parameters of the scene file, such as res."""
    target: tuple[Target, ...] = (Target(),)
    """Pictures that the scene should look like."""
    free: tuple[Free, ...]
    """Free parameters, which the fit optimises."""
    loss: Loss = dataclasses.field(default_factory=Loss)
    """Loss function."""
    stage: tuple[Stage, ...] = (Stage(),)
    """Stages, one after the other."""
    starts: Starts = Starts()
    """Several starting points."""
    integrator: dict[str, Value] = dataclasses.field(default_factory=lambda: {"type": "prb_edge"})
    """Integrator plugin that renders and differentiates, with its parameters."""
    optimiser: Rule = "adam"
    """Optimiser of Mitsuba. With sgd, `rate` is a factor of the gradient, not a length. In Python also any other one:
    see `Optimiser`."""
    momentum: float = 0.9
    """Momentum of sgd, and first decay rate of adam."""
    smooth_scale: float = 0.99
    """Second decay rate of adam."""
    clip: float | None = None
    """Longest gradient of one parameter, as a multiple of the median of its last 50 lengths. Default: no limit."""
    parts: int = 1
    """Number of independent renders of each target in a step. Their losses and gradients are averaged. Several
    processes or machines can share them."""
    views_per_step: int | None = None
    """Number of targets that a step compares. They are drawn at random, one of each of so many groups of neighbours.
    Default: all."""
    max_memory: float | None = None
    """Memory that Dr.Jit may use in a process, in MB. Samples beyond it are rendered one after the other. Default: no
    limit."""
    seed: int = 0
    """Random seed."""
    patience: int | None = None
    """End a stage if its loss has not fallen by 0.1 % within this many steps. Default: never."""
    seconds: float | None = None
    """End the fit after this many seconds. Default: no limit."""
    balance: bool = False
    """After the first step of each stage, measure how noisy each part of the derivative is, and divide the samples
    among them so that a given time leaves the least error. Takes as long as 20 to 40 steps."""
    max_bad: int = 20
    """End the fit after this many gradients in a row that are not finite. Each is skipped and counted."""
    freeze: bool = True
    """Record the step once and replay it, where the integrator and the sensor allow that."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""
    threads: int | None = None
    """Threads of this process, no more than it has cores. With 1, a fit that is repeated or resumed ends with the same
    numbers, bit by bit. Default: one for each core."""

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)
        put("scene", _place(self.scene))
        conform(self)
        if isinstance(self.loss, str) or (callable(self.loss) and not isinstance(self.loss, Loss)):
            put("loss", Loss(norm=self.loss))
        for name in ("free", "stage", "target"):
            entries = getattr(self, name)
            put(name, tuple(entries) if isinstance(entries, tuple | list) else (entries,))
        if any(t is None for t in self.target):  # what some programs return for a file that is not there
            raise InputError("fit: a target is None; Target() is the unchanged scene file, rendered")
        targets = (t if isinstance(t, Target) else Target(file=t, sensor=i) for i, t in enumerate(self.target))
        put("target", tuple(targets))
        for name, kind in {"free": Free, "stage": Stage, "starts": Starts, "loss": Loss, "integrator": dict}.items():
            of_kind(name, getattr(self, name), kind)
        checks.check(self)

    @property
    def norms(self) -> tuple[Norm, ...]:
        """Of the loss in each stage."""
        return tuple(self.loss.norm if stage.norm is None else stage.norm for stage in self.stage)

    @property
    def compares(self) -> bool:
        """Are pictures compared with their targets?"""
        return all(map(losses.compares, self.norms))


# ------------------------------------------------------------------ files


#: Begins the name of an object that a file cannot hold.
IN_MEMORY = "in memory: "

#: Names of objects that are no longer than so are what they say of themselves; characters.
LONGEST_NAME = 500

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
    converter.register_structure_hook_func(lambda kind: get_origin(kind) is Literal, _one_of)
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    converter.register_unstructure_hook(Path, Path.as_posix)
    # "key" may be one name.
    structure_free = make_dict_structure_fn(Free, converter, _cattrs_forbid_extra_keys=True)
    one_key = lambda d: {**d, "key": [d["key"]]} if isinstance(d.get("key"), str) else d
    converter.register_structure_hook(Free, lambda d, kind: structure_free(one_key(d), kind))
    return converter


def _one_of(value: Any, kind: Any) -> Any:
    if value not in get_args(kind):
        raise InputError(f"fit: expected one of {', '.join(get_args(kind))}, got {value!r}")
    return value


def _exactly(told: str, allowed: tuple[type, ...]) -> Any:
    """Structures values of TOML without the conversions of Python, to which "false" is true and 2.7 is 2."""

    def structure(value: Any, kind: type) -> Any:
        if not isinstance(value, allowed) or (isinstance(value, bool) and kind is not bool):
            raise InputError(f"fit: expected {told}, got {value!r}")
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
        problem = from_text(path.read_text("utf-8-sig"))  # editors of Windows begin files with a mark
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: it is not UTF-8 (byte {error.start}); save it as that") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return relative_to(problem, path.parent)


def from_text(text: str) -> Problem:
    """Read a problem from TOML. Raises ValueError, as `read` does."""
    check_is_text(text)
    tables = parse(text)
    for name in ("target", "free", "stage"):
        if isinstance(tables.get(name), dict):
            raise InputError(f"fit: there may be several of {name}, write [[{name}]] instead of [{name}]")
    try:
        return _converter().structure(tables, Problem)
    except cattrs.BaseValidationError as error:
        raise InputError("; ".join(cattrs.transform_error(error, "fit", _say))) from None


def _say(error: BaseException, kind: type | None) -> str:
    return str(error) if str(error).startswith("fit:") else cattrs.v.format_exception(error, kind)


def write(path: Path, problem: Problem) -> None:
    """Write a problem as `read` reads it, with absolute paths. What is in memory only is named, but cannot be read."""
    with replacing(path) as temporary:
        temporary.write_text(text(relative_to(problem, Path.cwd())), "utf-8")


def parse(text: str) -> dict[str, Any]:
    """TOML as a dictionary."""
    return tomllib.loads(text)


def text(problem: Problem) -> str:
    """A problem as TOML."""
    return tomli_w.dumps(tables(problem))


def tables(problem: Problem) -> dict[str, Any]:
    """A problem as a dictionary for TOML."""
    # First of all, paths in place of arrays, which cannot be compared with defaults.
    said = _with_sources(
        problem, lambda source: source if isinstance(source, Path) else Path(IN_MEMORY + _kind(source))
    )
    return _plain(_converter().unstructure(said))


def relative_to(problem: Problem, folder: Path) -> Problem:
    """The problem with all paths seen from a folder, absolute."""
    return _with_sources(problem, lambda source: (folder / source).resolve() if isinstance(source, Path) else source)


def _with_sources(problem: Problem, change: Callable[[Any], Any]) -> Problem:
    """The problem with other scenes and pictures. change : makes them of those that there are."""
    of = lambda source: None if source is None else change(source)
    targets = tuple(dataclasses.replace(t, file=of(t.file), scene=of(t.scene), mask=of(t.mask)) for t in problem.target)
    return dataclasses.replace(problem, scene=of(problem.scene), target=targets)


def _plain(value: Any) -> Any:
    """Tables without what is None, and with the names of objects that TOML cannot hold."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value if isinstance(value, str | bool | int | float) else IN_MEMORY + _name(value)


def _name(thing: Any) -> str:
    """Of an object, the same in every process: what it says of itself, unless it says where in memory it is."""
    said = repr(thing)
    if " at 0x" not in said and len(said) < LONGEST_NAME:
        return said
    return f"{thing.__module__}.{thing.__qualname__}" if hasattr(thing, "__qualname__") else _kind(thing)


def _kind(thing: Any) -> str:
    return f"{type(thing).__module__}.{type(thing).__qualname__}"


def check_is_text(text: str) -> None:
    """Refuse a problem of which a part is an object in memory. InputError: there is one."""
    if IN_MEMORY in text:
        raise InputError(
            "fit: a scene, picture, loss, schedule or optimiser of this fit is an object in the memory of a Python "
            "program, which files and other processes cannot hold; name a file, or a loss and an optimiser by name"
        )
