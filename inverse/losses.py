"""Losses between pictures and their gradients, and measures for people.

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

from functools import cache

import numpy as np
from skimage.transform import pyramid_reduce

from .problem import Loss

#: In the denominator of `relative`, squared radiance.
FLOOR = 0.01


def value_and_gradient(
    loss: Loss, image: np.ndarray, target: np.ndarray, weight: np.ndarray
) -> tuple[float, np.ndarray]:
    """The loss, and its derivative with respect to each number of the image.

    image, target : (H, W, C), linear radiance. weight : (H, W), >= 0.

    Returns
    -------
    value : weighted mean over pixels and channels; with a pyramid, mean of the levels.
    gradient : (H, W, C), float64.
    """
    image, target, weight = (np.asarray(a, np.float64) for a in (image, target, weight))
    if not loss.pyramid:
        return _at_one_level(loss, image, target, weight)
    value, gradient = _at_one_level(loss, image, target, weight)
    # Reduction is linear and separable: image -> A image Bᵀ, so that gradient -> Aᵀ gradient B. What does not count
    # shall not bleed into what does: reduce the weighted difference, and the weights.
    difference, share = (image - target) * weight[..., None], weight
    if loss.norm == "relative":
        difference = difference / np.sqrt(np.square(target) + FLOOR)
    down, across = np.eye(image.shape[0]), np.eye(image.shape[1])
    for _ in range(loss.pyramid):
        A, B = reduction(share.shape[0]), reduction(share.shape[1])
        down, across = A @ down, B @ across
        share = A @ share @ B.T
        level = np.einsum("ih,hwc,jw->ijc", down, difference, across, optimize=True)
        known = np.maximum(share, 1e-12)[..., None]
        v, g = _at_one_level(Loss(norm="l1" if loss.norm == "l1" else "l2"), level / known, 0 * level, share)
        value += v
        back = np.einsum("ih,ijc,jw->hwc", down, g / known, across, optimize=True) * weight[..., None]
        gradient += back / np.sqrt(np.square(target) + FLOOR) if loss.norm == "relative" else back
    return value / (loss.pyramid + 1), gradient / (loss.pyramid + 1)


def _at_one_level(loss: Loss, image: np.ndarray, target: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray]:
    d = image - target
    share = weight[..., None] / max(weight.sum() * image.shape[2], 1e-12)
    if loss.norm == "l1":
        return float(np.sum(share * np.abs(d))), share * np.sign(d)
    if loss.norm == "relative":
        share = share / (np.square(target) + FLOOR)
    return float(np.sum(share * np.square(d))), 2 * share * d


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
    return float(np.sqrt(np.sum(weight * np.square(difference).mean(2)) / max(weight.sum(), 1e-12)))


def measures(image: np.ndarray, target: np.ndarray, weight: np.ndarray, light: bool = True) -> dict[str, float]:
    """How alike two pictures are, for people: root mean square error, structural similarity, and the mean colour
    difference ΔE of CIE 2000, where there is colour.

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
    if min(image.shape[:2]) >= 7:
        _, similarity = structural_similarity(shown, wanted, channel_axis=2, full=True)
        found["structural similarity"] = float(np.sum(share * similarity.mean(2)))
    if image.shape[2] >= 3:
        import colour

        lab = lambda rgb: colour.XYZ_to_Lab(colour.sRGB_to_XYZ(rgb / 255))
        difference = colour.delta_E(lab(shown), lab(wanted), method="CIE 2000")
        found["mean colour difference ΔE 2000"] = float(np.sum(share * difference))
    return found
