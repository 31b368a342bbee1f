"""Lights from pictures of balls, and exposures from the images themselves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from tqdm import tqdm

from rimlight.edge_sampling.refusals import InputError

from . import least_squares
from .files import DIRECTIONS, INTENSITIES, read_camera, read_mask, read_names, read_pixels
from .integration import ray_matrix
from .vectors import LUMINANCE, unit

#: As many images as a quadratic polynomial over light directions needs to be told from single exposures.
FEWEST = 20

#: Unknowns of this polynomial, but for its constant; and pixels from which the exposures of a matte surface are found.
TREND, SAMPLED = 5, 1000

#: The highlight of a chrome ball is what is brighter than this part of its brightest pixel; light of a small source
#: comes from directions that scatter by less than this (root mean square), degrees.
HIGHLIGHT, SCATTER = 0.25, 10.0

#: Pixels of a matte ball count where the cosines of incidence and to the camera are above this: away from the border of
#: the shadow and from the outline.
LEAST_COSINE = 0.2

#: Part of the pixels of a matte ball that may have exactly the largest value.
CLIPPED = 0.02

#: Largest distance of the outline of a ball's mask from a circle, root mean square: pixels, or part of the radius.
OUTLINE = 1.0, 0.02


# ---------------------- Balls ----------------------


@dataclass(frozen=True)
class Ball:
    """What the B pixels of a ball's mask show. normals : (B, 3), of its surface. view : (B, 3), unit, to the camera."""

    normals: np.ndarray
    view: np.ndarray

    @classmethod
    def of_mask(cls, mask: np.ndarray, camera: np.ndarray | None = None) -> Ball:
        """A ball, of which `mask`, (H, W), bool, has all that is seen; it may go beyond the image.

        camera : intrinsic matrix, (3, 3), pixels. None: orthographic.

        Raises
        ------
        ValueError : the outline of the mask is no circle (with a camera: not that of a ball).
        """
        edges, pixels = _outline(mask), np.argwhere(mask)[:, ::-1]
        if camera is None:
            # As scikit-image's CircleModel, whose names changed in 0.26:
            # (u - a)^2 + (v - b)^2 = R^2 is linear in a, b and R^2 - a^2 - b^2 (Kasa 1976)
            design = np.c_[2 * edges, np.ones(len(edges))]
            *centre, rest = np.linalg.lstsq(design, (edges**2).sum(1), rcond=None)[0]
            radius = np.sqrt(rest + np.square(centre).sum())
            _check_outline(np.linalg.norm(edges - centre, axis=1) - radius, radius)
            x, y = ((pixels - centre) / radius).T
            z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
            return cls(unit(np.stack([x, -y, z], 1)), np.tile([0.0, 0, 1], (len(pixels), 1)))
        # Unit rays r to the outline are a cone: r . c = 1, where |c| is 1 over the cosine of its half-angle. A ball of
        # the radius 1 has its centre at c / tan
        edge_rays, rays = (unit(np.c_[uv, np.ones(len(uv))] @ ray_matrix(camera).T) for uv in (edges, pixels))
        c = np.linalg.lstsq(edge_rays, np.ones(len(edges)), rcond=None)[0]
        tangent = np.sqrt(max(c @ c - 1, 0))
        focal = np.sqrt(camera[0, 0] * camera[1, 1])
        _check_outline((edge_rays @ c - 1) / max(tangent, 1e-9) * focal, tangent * focal)
        centre = c / tangent
        along = rays @ centre
        distance = along - np.sqrt(np.maximum(along**2 - centre @ centre + 1, 0))
        return cls(unit(distance[:, None] * rays - centre), -rays)


def _outline(mask: np.ndarray) -> np.ndarray:
    """Points (u, v) between neighbours of which one lies in the mask."""
    v, u = np.nonzero(mask[:, 1:] != mask[:, :-1])
    y, x = np.nonzero(mask[1:] != mask[:-1])
    points = np.concatenate([np.c_[u + 0.5, v], np.c_[x, y + 0.5]])
    if len(points) < 8:
        raise InputError(f"ps: the ball's mask has {int(mask.sum())} pixels and no outline in the image")
    return points


def _check_outline(residuals: np.ndarray, radius: float) -> None:
    """In pixels."""
    off = np.sqrt(np.square(residuals).mean())
    if not off <= max(OUTLINE[0], OUTLINE[1] * radius):
        raise InputError(f"ps: the ball's mask is no disc: its outline is {off:.1f} pixels off a circle")


# ---------------------- Lights at infinity ----------------------


def chrome(values: np.ndarray, ball: Ball) -> np.ndarray:
    """Direction of the light that a mirror ball shows, (3,), unit: the mean over its highlight of the reflected
    directions, by brightness. (On a ball seen from far away, equal areas show equal solid angles.)

    values : (B, 3), linear.

    Raises
    ------
    ValueError : there is no highlight, or more than a small one.
    """
    brightness = values @ LUMINANCE
    if not np.isfinite(values).all() or brightness.max() <= 0:
        raise InputError("no highlight: the ball is black")
    weights = np.maximum(brightness - HIGHLIGHT * brightness.max(), 0)
    n, v = ball.normals, ball.view
    directions = 2 * (n * v).sum(1, keepdims=True) * n - v
    mean = weights @ directions / weights.sum()
    # The mean of unit vectors that scatter by an angle is shorter by half its square
    scatter = np.degrees(np.sqrt(2 * max(1 - np.linalg.norm(mean), 0)))
    if scatter > SCATTER:
        raise InputError(
            "no single small highlight: what is brighter than a quarter of the brightest pixel reflects directions "
            f"that scatter by {scatter:.0f} degrees; is the picture overexposed, or are there two lights?"
        )
    return unit(mean)


def matte(values: np.ndarray, ball: Ball) -> tuple[np.ndarray, np.ndarray]:
    """Direction of the light on a Lambertian ball, (3,), unit, and its irradiance times albedo over pi, (3,), for each
    colour: least squares over the pixels that the light meets at less than 78 degrees.

    values : (B, 3), linear.

    Raises
    ------
    ValueError : the ball is black, or overexposed, or its light too low.
    """
    if not np.isfinite(values).all() or values.max() <= 0:
        raise InputError("the ball is black")
    clipped = max((values[:, c] == values[:, c].max()).mean() for c in range(3) if values[:, c].max() > 0)
    if clipped > CLIPPED:
        raise InputError(f"the ball is overexposed: {100 * clipped:.0f} % of its pixels have the largest value")
    n, brightness = ball.normals.astype(np.float64), (values @ LUMINANCE).astype(np.float64)
    inside = (n * ball.view).sum(1) > LEAST_COSINE
    lit = inside & (brightness > LEAST_COSINE * np.quantile(brightness, 0.99))
    for _ in range(10):
        if lit.sum() < 10:
            raise InputError("the light meets fewer than 10 pixels of the ball")
        b = np.linalg.lstsq(n[lit], brightness[lit], rcond=None)[0]
        direction = unit(b)
        before, lit = lit, inside & (n @ direction > LEAST_COSINE)
        if (before == lit).all():
            break
    cosine = n[lit] @ direction
    return direction, cosine @ values[lit] / (cosine @ cosine)


def calibrate(folder: Path, ball: Path, kind: Literal["chrome", "matte"]) -> tuple[np.ndarray, np.ndarray | None]:
    """Lights from pictures of a ball, one for each light; writes `light_directions.txt`, and for a matte ball
    `light_intensities.txt`, for `dataset.read`.

    folder : pictures, listed by `filenames.txt` or all there are; with `K.txt`, of a perspective camera.
    ball : mask of the ball. kind : "chrome" is a mirror, "matte" is Lambertian.

    Returns
    -------
    directions : (K, 3). intensities : (K, 3), of mean 1, as seen by reflection at the ball, if it is matte.

    Raises
    ------
    ValueError : see `Ball.of_mask`, `chrome` and `matte`; names the picture. OSError.
    """
    if kind not in ("chrome", "matte"):
        raise InputError(f'ps: unknown kind of ball "{kind}", expected chrome or matte')
    mask = read_mask(ball)
    surface = Ball.of_mask(mask, read_camera(folder))
    names = [name for name in read_names(folder) if (folder / name).resolve() != ball.resolve()]
    if not names:
        raise InputError(f'ps: there are no pictures in "{folder}"')
    found = []
    for name in tqdm(names, desc="images", disable=len(names) < 10, leave=False):
        try:
            values = read_pixels(folder / name, mask)
            found.append((chrome(values, surface), None) if kind == "chrome" else matte(values, surface))
        except ValueError as error:
            raise InputError(str(error) if str(error).startswith("ps: ") else f'ps: "{name}": {error}') from None
    directions = np.stack([direction for direction, _ in found])
    np.savetxt(folder / DIRECTIONS, directions, "%.9g")
    if kind == "chrome":
        return directions, None
    intensities = np.stack([intensity for _, intensity in found])
    intensities /= intensities.mean()
    np.savetxt(folder / INTENSITIES, intensities, "%.9g")
    return directions, intensities


# ---------------------- Exposures ----------------------


def with_trend(exposures: np.ndarray, values: np.ndarray, counts: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Exposures, (K,), median 1, to which a trend over the directions of the lights is given back, if there is one.

    Exposures that are off at random follow a trend, too, by chance, and `exposures` takes it for the material's. Of a
    matte surface, `of_matte` tells it; of another one, what this finds is the material's as well. How large is a trend
    by chance? As large as the standard error of a fit of least absolute residuals, which follows from the spread of the
    exposures between their quartiles. That part of the difference, in squares, is taken to be the exposures'.

    exposures : as of `exposures`, all of them. values : (P, K), as they are in the images. counts, lights : see there.
    """
    with np.errstate(divide="ignore"):
        change = np.log(of_matte(values / exposures, counts, lights))
    known = np.isfinite(change)
    if known.sum() < FEWEST:
        return exposures
    change = np.where(known, change - np.median(change[known]), 0)
    spread = np.subtract(*np.quantile(np.log(exposures[known]), (0.75, 0.25)))
    by_chance = spread**2 * TREND / known.sum()
    share = min(by_chance / max(np.square(change[known]).mean(), 1e-30), 1)
    found = exposures * np.exp(share * change)
    return found / np.median(found)


def of_matte(values: np.ndarray, counts: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Exposures of images of a matte surface, (K,), 0 of images that are black: those with which any normals and
    albedos explain the values best (Cho et al. 2020), without the darkest and the brightest fifth of each pixel.

    values, counts : (P, K). lights : directions, (K, 3) or (P, K, 3).
    """
    pixels = np.unique(np.linspace(0, len(values) - 1, SAMPLED).astype(int))
    values = values[pixels] / np.maximum(values[pixels].mean(1, keepdims=True), 1e-30)
    lights = lights if lights.ndim == 2 else lights[pixels]
    rank = least_squares.ranks(values)
    weighted = values * ((rank >= 0.2) & (rank <= 0.8) & (counts[pixels] > 0))
    # values / exposures - lights @ b is to be small; b is eliminated, and what is left is quadratic in 1 / exposures
    A = weighted[..., None] * lights
    M = np.einsum("pki,pkj->pij", (weighted > 0)[..., None] * lights, np.broadcast_to(lights, A.shape))
    squares = (weighted * values).sum(0)
    left = np.diag(squares) - np.tensordot(A, A @ np.linalg.pinv(M, rcond=1e-6, hermitian=True), ((0, 2), (0, 2)))
    shown = squares > 0
    size = np.sqrt(squares[shown])
    _, vectors = np.linalg.eigh(left[np.ix_(shown, shown)] / size / size[:, None])
    found = np.zeros(len(squares))
    found[shown] = size / np.abs(vectors[:, 0])
    return found


def exposures(values: np.ndarray, predicted: np.ndarray, counts: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """How much brighter each image is than it should be: (K,), median 1.

    The median over the pixels of values over predictions. What of its logarithm is a quadratic polynomial of the
    direction of the light (least absolute residuals) is what errors of normals and BSDF look like, too, and does not
    count: what remains are single images, or groups of them, that are off. With fewer than 20 images, all are 1.

    values, predicted, counts : (P, K), luminances, and which of them count (> 0). lights : (K, 3).
    """
    K = values.shape[1]
    if K < FEWEST:
        return np.ones(K)
    usable = (counts > 0) & (predicted > 0.1 * np.median(predicted)) & (predicted > 0)
    # An image at a time: all of their ratios would take much memory
    ratio = np.array([np.median(values[u, k] / predicted[u, k]) if u.any() else 0.0 for k, u in enumerate(usable.T)])
    known = ratio > 0
    x, y = lights[known, 0], lights[known, 1]
    design = np.stack([np.ones(len(x)), x, y, x * x, y * y, x * y], 1)
    log = np.log(ratio[known])
    weights = np.ones(len(log))
    for _ in range(50):
        root = np.sqrt(weights)
        residual = log - design @ np.linalg.lstsq(design * root[:, None], log * root, rcond=None)[0]
        weights = 1 / np.maximum(np.abs(residual), 1e-4)
    found = np.ones(K)
    found[known] = np.exp(residual - np.median(residual))
    return found
