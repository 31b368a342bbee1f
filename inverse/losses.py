"""Losses between pictures and their gradients, and measures for people. No other file knows the names of the losses.

A loss is a function of one rendered picture, whose gradient with respect to that picture weighs a derivative image. The
picture and the derivative image are rendered with *independent* random numbers. If I has the mean Ī and the derivative
image J the mean J̄, then the mean of ∇f(I) · J is the product of the means, which for `l2` and `relative` (whose ∇f is
linear in I) is the gradient of f(Ī), without bias. Were both made of the same samples, the covariance of I and J would
be added. ∇f of `l1` is a sign: where the noise of I exceeds its distance from the target, the gradient is weaker than
that of f(Ī), and it vanishes where the *median* of I is at the target, not Ī. The noise of paths is skewed, by few
samples that are bright, so fits by `l1` with few samples end a little too bright. For the loss that compares nothing,
see `classifier`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import numpy as np
from skimage.transform import pyramid_reduce

from rimlight.loading import InputError

from .classifier import Classifier
from .conforming import conform

#: In the denominator of `relative`, squared radiance.
FLOOR = 0.01


class LossFunction(Protocol):
    """What a fit minimises, as a function of one rendered picture.

    It may also have two attributes: `label`, which says in the report what it measures, and in which unit; and
    `compares`, which is False if it does not look at the target.
    """

    def __call__(
        self, image: np.ndarray, target: np.ndarray, weight: np.ndarray
    ) -> tuple[float, np.ndarray, dict[str, float]]:
        """Value, gradient and metrics.

        Parameters
        ----------
        image : (H, W, C), float32, linear radiance.
        target : (H, W, C) or (H, W, 1), linear radiance; read-only.
        weight : (H, W), how much each pixel counts, >= 0; read-only.

        Returns
        -------
        value : the loss.
        gradient : (H, W, C), its derivative with respect to each number of the image. If one is not finite, the step is
            skipped.
        metrics : label -> number, which the log and the report show.
        """
        ...


class Pointwise:
    """The weighted mean over pixels and channels of ρ(s d), of the difference d of image and target.

    levels : of a Gaussian pyramid of s d. The loss is the mean of its levels and the pictures themselves.
    """

    label = ""

    def __init__(self, levels: int = 0):
        self.levels = levels

    def ρ(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The function, and its derivative."""
        raise NotImplementedError

    def s(self, target: np.ndarray) -> np.ndarray | float:
        """By what a difference is multiplied."""
        return 1.0

    def __call__(
        self, image: np.ndarray, target: np.ndarray, weight: np.ndarray
    ) -> tuple[float, np.ndarray, dict[str, float]]:
        # Single precision takes half of the time, a tenth of that of a quick render; sums are in double precision.
        s = self.s(target)
        difference = (image - target) * s
        value, gradient = self._level(difference, weight)
        # Reduction is linear and separable: image -> A image Bᵀ, so that gradient -> Aᵀ gradient B. What does not count
        # shall not bleed into what does: reduce the weighted difference, and the weights.
        weighted, share = difference * weight[..., None], weight
        down, across = np.eye(image.shape[0]), np.eye(image.shape[1])
        for _ in range(self.levels):
            A, B = reduction(share.shape[0]), reduction(share.shape[1])
            down, across = A @ down, B @ across
            share = A @ share @ B.T
            known = np.maximum(share, 1e-12)[..., None]
            v, g = self._level(np.einsum("ih,hwc,jw->ijc", down, weighted, across, optimize=True) / known, share)
            value += v
            back = np.einsum("ih,ijc,jw->hwc", down, g / known, across, optimize=True)
            gradient = gradient + back * weight[..., None]
        return value / (self.levels + 1), s * gradient / (self.levels + 1), {}

    def _level(self, x: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray]:
        share = weight[..., None] / max(weight.sum() * x.shape[2], 1e-12)
        value, slope = self.ρ(x)
        return float(np.sum(share * value, dtype=np.float64)), share * slope


class L1(Pointwise):
    """|d|"""

    label = "mean absolute difference (radiance)"

    def ρ(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.abs(x), np.sign(x)


class L2(Pointwise):
    """d²"""

    label = "mean squared difference (radiance²)"

    def ρ(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.square(x), 2 * x


class Relative(L2):
    """d² / (t² + 0.01), of the target t."""

    label = "mean squared relative difference"

    def s(self, target: np.ndarray) -> np.ndarray:
        return 1 / np.sqrt(np.square(target) + FLOOR)


# ------------------------------------------------------------------ by name

#: Name -> makes the loss from its settings.
NORMS: dict[str, Callable[[Loss], LossFunction]] = {
    "l1": lambda loss: L1(loss.pyramid),
    "l2": lambda loss: L2(loss.pyramid),
    "relative": lambda loss: Relative(loss.pyramid),
    "classifier": lambda loss: Classifier(loss.rise, loss.fall),
}

#: Of the losses by name, those that look at no target.
COMPARE_NOTHING = ("classifier",)

# Files and the command line know the names alone.
if TYPE_CHECKING:
    Norm: TypeAlias = str | LossFunction
else:
    Norm = Literal[tuple(NORMS)]


@dataclass(frozen=True, kw_only=True)
class Loss:
    """Loss function: how much two pictures differ, as a weighted mean over pixels and channels; or, with `classifier`,
    what a neural network sees in the picture. In Python, `norm` may be a function of your own: see `LossFunction`."""

    norm: Norm = "l2"
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

    def __post_init__(self) -> None:
        conform(self)


def function(loss: Loss, norm: Norm | None = None) -> LossFunction:
    """The loss that settings describe. norm : in place of that of the settings, for a stage that has its own.

    Raises
    ------
    InputError : packages are missing that it needs.
    """
    norm = loss.norm if norm is None else norm
    return norm if callable(norm) else NORMS[norm](loss)


def compares(norm: Norm) -> bool:
    """Does a loss look at the target?"""
    return norm not in COMPARE_NOTHING if isinstance(norm, str) else getattr(norm, "compares", True)


def label(loss: LossFunction) -> str:
    """What a loss measures, for people."""
    return getattr(loss, "label", "") or getattr(loss, "__name__", type(loss).__name__)


def check(loss: Loss, norms: Iterable[Norm], given: Iterable[str]) -> None:
    """Refuse settings that cannot be meant.

    norms : of all stages. given : what targets give that a loss must compare with, such as "target.0.file".

    Raises
    ------
    InputError : the text names the setting as the TOML file does.
    """
    norms = list(norms)
    for norm in norms:
        if not (callable(norm) or norm in NORMS):
            raise InputError(f"fit: loss.norm must be one of {', '.join(NORMS)}, or in Python a function, got {norm!r}")
        if hasattr(norm, "parameters") and hasattr(norm, "forward"):
            raise InputError(f"fit: the loss is a module of PyTorch, give inverse.torch_loss({type(norm).__name__}())")
        if callable(norm) and loss.pyramid:
            raise InputError("fit: loss.pyramid is for the losses by name; a function of your own does without")
    named = loss.rise or loss.fall
    if len({compares(norm) for norm in norms}) > 1:
        raise InputError("fit: stage.norm: all stages compare with the target, or none does")
    if all(map(compares, norms)):
        if named:
            raise InputError(f'fit: loss.rise and loss.fall need the norm "classifier", got "{loss.norm}"')
        return
    if any(norm in COMPARE_NOTHING for norm in norms):
        Classifier.check(loss.rise, loss.fall)
    for name in ("pyramid", "exclude_above"):
        if getattr(loss, name):
            raise InputError(f"fit: loss.{name} needs pictures that are compared, the norm {_said(norms[0])} has none")
    for name in given:
        raise InputError(f"fit: {name}: with the norm {_said(norms[0])} there is nothing to compare with")


def _said(norm: Norm) -> str:
    return f'"{norm if isinstance(norm, str) else label(norm)}"'


# ------------------------------------------------------------------ of your own


def drjit_loss(function: Callable[[Any, Any, Any], Any], label: str = "") -> LossFunction:
    """A loss from a function of Dr.Jit, which is differentiated automatically.

    function : of image and target, mi.TensorXf, (H, W, C), and weight, mi.TensorXf, (H, W). Returns one number, of a
        type of Dr.Jit that carries derivatives; or such a number and metrics, label -> number.
    label : what it measures, for the report.
    """

    def loss(image: np.ndarray, target: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray, dict[str, float]]:
        import drjit as dr
        import mitsuba as mi

        seen, *others = (mi.TensorXf(np.ascontiguousarray(a, np.float32)) for a in (image, target, weight))
        dr.enable_grad(seen)
        value, metrics = value_and_metrics(function(seen, *others))
        if not dr.is_diff_v(value) or dr.width(value) != 1 or not dr.grad_enabled(value):
            got = f"{dr.width(value)} of {type(value).__name__}"
            raise InputError(f"a loss must return one number of Dr.Jit that depends on the image, got {got}")
        dr.backward(value)
        return float(np.array(dr.detach(value)).item()), np.array(dr.grad(seen)).reshape(image.shape), metrics

    loss.label = label or getattr(function, "__name__", "loss")  # type: ignore[attr-defined]
    return loss


def value_and_metrics(found: Any) -> tuple[Any, dict[str, float]]:
    """Of what a function of the user returned: the number, and metrics, if any. InputError : these are none."""
    try:
        value, metrics = found if isinstance(found, tuple) else (found, {})
        plain = lambda number: number.detach() if hasattr(number, "detach") else number  # of PyTorch
        return value, {label: float(np.asarray(plain(number)).item()) for label, number in metrics.items()}
    except (TypeError, ValueError, AttributeError):
        raise InputError(
            "a loss must return one number, or one number and a dictionary of metrics, numbers by name"
        ) from None


# ------------------------------------------------------------------ pictures


@cache
def reduction(size: int) -> np.ndarray:
    """One step of scikit-image's Gaussian pyramid in one dimension: (⌈size / 2⌉, size)."""
    if size == 1:
        return np.eye(1)
    unit_images = np.eye(size)[:, None, :]  # (size, 1, channels)
    return pyramid_reduce(unit_images, downscale=2, channel_axis=2)[:, 0, :]


def pixels_that_count(loss: Loss, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weights without the pixels that the loss excludes: (H, W)."""
    if loss.exclude_above is None:
        return weight
    return np.where((target > loss.exclude_above).any(axis=2), 0, weight)


def root_mean_square(difference: np.ndarray, weight: np.ndarray) -> float:
    """Of a picture, (H, W, C), over the pixels that count: weight (H, W)."""
    squares = np.square(difference, dtype=np.float64).mean(2)
    return float(np.sqrt(np.sum(weight * squares) / max(weight.sum(), 1e-12)))


def measures(image: np.ndarray, target: np.ndarray, weight: np.ndarray, light: bool = True) -> dict[str, float]:
    """How alike two pictures are, for people: root mean square error, peak signal-to-noise ratio in sRGB, structural
    similarity, and the mean colour difference ΔE of CIE 2000, where there is colour.

    image, target : (H, W, C), linear radiance, of which 1 is white; unless `light`, other numbers, of which the first
        is all that is told. weight : (H, W).
    """
    if not light:
        return {"root mean square error": root_mean_square(image - target, weight)}
    from skimage.metrics import structural_similarity

    from rimlight import pictures

    share = weight / max(weight.sum(), 1e-12)
    found = {"root mean square error": root_mean_square(image - target, weight)}
    shown, wanted = (pictures.to_srgb(a) for a in (image, target))
    apart = root_mean_square((shown.astype(np.float32) - wanted) / 255, weight)
    found["peak signal-to-noise ratio (dB)"] = -20 * np.log10(max(apart, 1e-6)).item()
    if min(image.shape[:2]) >= 7:
        _, similarity = structural_similarity(shown, wanted, channel_axis=2, full=True)
        found["structural similarity"] = float(np.sum(share * similarity.mean(2)))
    if image.shape[2] >= 3:
        import colour

        lab = lambda rgb: colour.XYZ_to_Lab(colour.sRGB_to_XYZ(rgb / 255))
        difference = colour.delta_E(lab(shown), lab(wanted), method="CIE 2000")
        found["mean colour difference ΔE 2000"] = float(np.sum(share * difference))
    return found
