"""How near the lights are, told from the shading, where no file says it.

Of a near light, the direction and the irradiance change over the object: what is on the right sees it further to the
left, and lights on the right shine more brightly there. That depends on where a pixel is, and a material depends on
where its normal points, so the two can be told apart, unless the object is as round as a ball.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from rimlight import ggx
from rimlight.leds import Led

from .alternation import Alternations, State, View
from .dataset import LUMINANCE, Dataset
from .direct import HUBER, RIDGE, SAMPLED, TURN, DirectModel, Guess, without_turns
from .evidence import Kind
from .vectors import unit

log = logging.getLogger(__name__)

#: Fewest lights by which the distance is told, and least width of the object, pixels of the smallest images.
FEWEST, SMALLEST = 20, 16

#: The camera is so many times as far away as the lights, which is as good as orthographic.
CAMERA = 10.0

#: The derivative with respect to the inverse distance is a difference of images, with lights at infinity and at so many
#: widths of the object.
DISTANT = 100.0

#: Damping of what is a pixel's own, which must follow entirely: else the distance stays what it is.
FREE = 1.0001

#: Parts of the lights, and of blocks of pixels of this width, that are left out in turns for the standard error.
PARTS, BLOCK = 12, 8

#: Standard errors by which the inverse distance must be above 0, and least distance, widths of the object.
SURE, LEAST = 3.0, 2.0


def width(data: Dataset) -> int:
    """Of the object: the larger side of what the mask fills, pixels."""
    return max(int(np.ptp(x)) + 1 for x in np.nonzero(data.mask))


def around(data: Dataset, away: float) -> Dataset:
    """A data set whose lights, at infinity, are all so far from the middle of the object, pixels, in the unit of that
    distance: there, they are as bright as before. It has a camera that is `CAMERA` times as far away."""
    rows, columns = np.nonzero(data.mask)
    focal = CAMERA * away
    camera = np.array([[focal, 0, columns.mean()], [0, focal, rows.mean()], [0, 0, 1]])
    middle = np.array([0, 0, -CAMERA])
    lights = tuple(Led(tuple(middle + at), tuple(-at), 0.0, (1.0, 1.0, 1.0)) for at in data.lights)
    return replace(data, lights=lights, camera=camera, distance=CAMERA)


def as_orthographic(depth: np.ndarray, away: float) -> np.ndarray:
    """Depth of a data set made by `around`, as an orthographic camera has it: pixels, towards the camera, mean 0."""
    return (depth.mean() - depth) * away


def as_near(depth: np.ndarray, away: float) -> np.ndarray:
    """The other way around."""
    return CAMERA - depth / away


def distance(work: Alternations, state: State) -> float:
    """Of the lights from the middle of the object, pixels, as the shading tells it; infinity if it does not.

    work : of the kind of the state.
    """
    data = work.data
    enough = data.values.shape[1] >= FEWEST and width(data) >= SMALLEST
    if data.near or data.camera is not None or not enough or state.start or (data.lights[:, 2] <= 0).any():
        return np.inf
    view = work.view(state.guess, state.depth)
    counts = (work.judge.counts * view.seen).astype(np.float32)
    inverse, error = estimate(data, work.lobes, state.guess, state.kind, view, counts, work.judge.seed)
    both = width(data) * inverse, width(data) * error
    log.info("ps: widths of the object over the distance of the lights: %.3g ± %.2g", *both)
    return max(1 / inverse, LEAST * width(data)) if inverse > SURE * error else np.inf


def estimate(
    data: Dataset, lobes: ggx.Lobes, guess: Guess, kind: Kind, view: View, counts: np.ndarray, seed: int
) -> tuple[float, float]:
    """One over the distance of the lights, 1 / pixels, and its standard error.

    It is found with the BSDF, by least squares, as if normals and albedos followed. The standard error has three parts:
    of the lights, of blocks of pixels (both by leaving parts of them out), and of the material: the distance is the
    mean of two, with and without a coat over what is diffuse, which are different laws of how normals shade. What
    differs between these is the material's.

    data : with lights at infinity and an orthographic camera. view : of the guess. counts : (P, K).
    """
    found = [
        _of_kind(data, lobes, guess, replace(kind, coat=coat), view, counts, np.random.default_rng([seed, 21]))
        for coat in (False, True)
    ]
    (first, error), (second, other) = found
    return (first + second) / 2, float(np.sqrt(max(error, other) ** 2 + (first - second) ** 2))


def _of_kind(
    data: Dataset,
    lobes: ggx.Lobes,
    guess: Guess,
    kind: Kind,
    view: View,
    counts: np.ndarray,
    rng: np.random.Generator,
) -> tuple[float, float]:
    model = DirectModel(data, lobes, points=view.points, counts=counts, indirect=view.indirect)
    guess = copy.deepcopy(guess)
    if guess.base is not None:
        guess.base_eta = kind.base_eta(lobes)
    model.fit_bsdf(guess, rng, coat=kind.coat)
    model.fit_normals(guess, steps=2)
    pixels = np.sort(rng.choice(model.P, min(SAMPLED, model.P), replace=False))
    shown = lambda of, **changed: (of.predicted(replace(guess, **changed), pixels) @ LUMINANCE).astype(np.float64)
    here = shown(model)
    values = (data.values[pixels] @ LUMINANCE).astype(np.float64)
    indirect = 0.0 if view.indirect is None else (view.indirect[pixels] @ LUMINANCE).astype(np.float64)

    # What each pixel has of its own: two turns of its normal, and how bright it is
    across = np.cross(guess.normals, [0.0, 1, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-12
    turned = lambda t: unit(guess.normals + TURN * t)
    own = [(shown(model, normals=turned(t)) - here) / TURN for t in (across, np.cross(guess.normals, across))]
    own.append(here - indirect)
    if guess.base is not None:
        own[-1] = shown(model, albedo=np.zeros_like(guess.albedo)) - indirect

    # What all share: the lobes, and the distance, as a number of either sign
    shared = model.of_lobes(guess, pixels)[..., model.wanted(guess, kind.coat)]
    by_distance = _by_distance(data, lobes, guess, view, pixels)
    shared = np.concatenate([shared, by_distance[..., None], -by_distance[..., None]], 2)
    residual = values - here
    values = values - indirect - (0 if guess.base is None else own[-1])
    weights = counts[pixels] * np.minimum(1, HUBER * model.scale / np.maximum(np.abs(residual), 1e-20))
    columns = np.stack(own, -1)

    def equations(weights: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return without_turns(shared[p], columns[p][:, :, None], values[p][..., None], weights[p], damping=FREE)

    rows, places = (x[pixels] // BLOCK for x in np.nonzero(data.mask))
    _, block = np.unique(np.stack([rows, places]), axis=1, return_inverse=True)
    blocks = block.max() + 1
    part_of_pixel = (rng.permutation(blocks) % PARTS)[block.ravel()]
    part_of_light = rng.permutation(data.values.shape[1]) % PARTS
    of_parts = [equations(weights, part_of_pixel == i) for i in range(min(PARTS, blocks))]
    gram, moments = (sum(x) for x in zip(*of_parts, strict=True))
    without_pixels = [_distance(gram - g, moments - m) for g, m in of_parts]
    everything = np.ones(len(pixels), bool)
    without_lights = [_distance(*equations(weights * (part_of_light != i), everything)) for i in range(PARTS)]
    # Jackknife: leaving out parts changes little, for most is the same
    variance = sum((len(x) - 1) * np.var(x) for x in (without_pixels, without_lights))
    return _distance(gram, moments), float(np.sqrt(variance))


def _by_distance(data: Dataset, lobes: ggx.Lobes, guess: Guess, view: View, pixels: np.ndarray) -> np.ndarray:
    """Derivative of the direct values of some pixels with respect to one over the distance of the lights, (P', K)."""
    away = DISTANT * width(data)
    rows, columns = np.nonzero(data.mask)
    x, y, z = columns - columns.mean(), rows.mean() - rows, view.points[:, 2] - view.points[:, 2].mean()
    near = DirectModel(around(data, away), lobes, points=np.stack([x, y, z], 1) / away - [0, 0, CAMERA])
    far = DirectModel(data, lobes, points=view.points)
    return ((near.predicted(guess, pixels) - far.predicted(guess, pixels)) @ LUMINANCE).astype(np.float64) * away


def _distance(gram: np.ndarray, moments: np.ndarray) -> float:
    """The last two unknowns of non-negative least squares, one less the other."""
    size = np.sqrt(np.maximum(np.diag(gram), 0)) + 1e-30
    root = np.linalg.cholesky(gram / size / size[:, None] + RIDGE * np.eye(len(moments))).T * size
    x, _ = nnls(root, solve_triangular(root, moments, trans=1), maxiter=50 * len(moments))
    return float(x[-2] - x[-1])
