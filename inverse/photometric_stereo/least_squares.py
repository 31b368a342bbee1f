"""Normals of diffuse surfaces: least squares (Woodham 1980), and how to keep shadows and highlights out of them.

All for lights at infinity, or directions of the lights at each pixel: `lights` is (K, 3) or (P, K, 3), `values` (P, K).
What does not count at all, such as clipped values, has a weight of 0; pixels of which too few values are left without
it keep them all (`weights_of`).
"""

from __future__ import annotations

import numpy as np

from rimlight.edge_sampling.refusals import InputError

from .vectors import unit

#: Trimming leaves at least so many values of a pixel, and lights that are spread at least this part as far (smallest
#: eigenvalue of the mean of their products) as all of them: else the pixel keeps all its values.
FEWEST, SPREAD = 4, 0.05

#: Directions whose third singular value is less than this part of the first are taken to lie in a plane.
PLANE = 1e-3

#: Said of lights none of which shines on what the camera sees.
BEHIND = "all lights are behind the object: z must point towards the camera; change the signs in light_directions.txt"

#: Pixels that are treated at a time, for memory.
BLOCK = 2**14

#: Iterations of reweighted least squares, and the part of a pixel's mean size below which residuals count as small.
ITERATIONS, SMALL = 30, 1e-3


def least_squares(values: np.ndarray, lights: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Albedo times normal of each pixel, (P, 3): weighted least squares of `lights @ b = values`.

    weights : (P, K), default 1. Pixels whose weights leave fewer than three lights get the solution of least length.
    """
    w = np.ones_like(values) if weights is None else weights
    wide = "ki,kj" if lights.ndim == 2 else "pki,pkj"
    M = np.einsum(f"pk,{wide}->pij", w, lights, lights, optimize=True)
    b = np.einsum(f"pk,{wide[: wide.index(',')]}->pi", w * values, lights, optimize=True)
    return (np.linalg.pinv(M, rcond=1e-9, hermitian=True) @ b[..., None])[..., 0]


def as_at_infinity(values: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Values as of lights at infinity, (P, K). 0 where a light does not shine."""
    return np.divide(values, irradiance, out=np.zeros(values.shape), where=irradiance > 1e-6 * irradiance.max())


def ranks(values: np.ndarray) -> np.ndarray:
    """Of the values of each pixel, from 0, the darkest, to 1: (P, K)."""
    return np.argsort(np.argsort(values, axis=1), axis=1) / (values.shape[1] - 1)


def trimmed(
    values: np.ndarray, lights: np.ndarray, weights: np.ndarray | None = None, low: float = 0.2, high: float = 0.8
) -> np.ndarray:
    """Least squares without the darkest and the brightest values of each pixel, where what is left tells all three
    numbers: (P, 3).

    weights : 0 or 1, default 1.
    """
    found = np.empty((len(values), 3))
    for i in range(0, len(values), BLOCK):
        part, of_part = values[i : i + BLOCK], lights if lights.ndim == 2 else lights[i : i + BLOCK]
        given = np.ones(part.shape, bool) if weights is None else weights[i : i + BLOCK] > 0
        rank = ranks(part)
        inside = (rank >= low) & (rank <= high)
        kept = inside & given
        for wider in (inside, given):
            kept |= wider & ~telling(kept, of_part)[:, None]
        found[i : i + BLOCK] = least_squares(part, of_part, kept.astype(part.dtype))
    return found


def weights_of(usable: np.ndarray | None, lights: np.ndarray) -> np.ndarray | None:
    """Weights, (P, K), of values of which only some are `usable`, (P, K), bool, or all (None): 1, or 0 for those that
    are not, where the others tell normals."""
    if usable is None or usable.all():
        return None
    return (usable | ~telling(usable, lights)[:, None]).astype(np.float32)


def telling(kept: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Are there enough values of each pixel, and do their lights lie apart? (P,)"""
    wide = "ki,kj" if lights.ndim == 2 else "pki,pkj"
    spread = lambda w: np.linalg.eigvalsh(
        np.einsum(f"pk,{wide}->pij", w / np.maximum(w.sum(1, keepdims=True), 1), lights, lights, optimize=True)
    )[:, 0]
    enough = kept.sum(1) >= FEWEST
    return enough & (spread(kept.astype(float)) >= SPREAD * spread(np.ones(kept.shape)))


def brightest(values: np.ndarray, dark: float) -> np.ndarray:
    """Which values of each pixel are not among its darkest, of which `dark` is the part: (P, K), bool. At least four of
    a pixel are left, or all."""
    last = values.shape[1] - 1
    bright = lambda part: ranks(part) * last >= min(dark * last, last + 1 - FEWEST) - 1e-9
    return np.concatenate([bright(values[i : i + BLOCK]) for i in range(0, len(values), BLOCK)])


def check_lights(lights: np.ndarray) -> None:
    """Raises ValueError if directions, (K, 3), lie in a plane, and so do not tell normals apart, or behind the
    object."""
    if lights[:, 2].max() <= 0:
        raise InputError(f"ps: {BEHIND}")
    size = np.linalg.svd(lights, compute_uv=False)
    if size[2] < PLANE * size[0]:
        raise InputError(
            "ps: the directions of the lights are all equal, or lie in a plane, so that normals cannot be told; "
            "check light_directions.txt, and that the lights chosen are not in a row"
        )


def reweighted(values: np.ndarray, lights: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Least sums of absolute residuals, by iteratively reweighted least squares: (P, 3)."""
    floor = SMALL * np.abs(values).mean(1, keepdims=True) + np.finfo(np.float32).tiny
    given = 1.0 if weights is None else weights
    b = least_squares(values, lights, weights)
    for _ in range(ITERATIONS):
        b = least_squares(values, lights, given / np.maximum(np.abs(predicted(b, lights) - values), floor))
    return b


def predicted(b: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Values of albedo times normal, (P, 3), without shadows: (P, K)."""
    return b @ lights.T if lights.ndim == 2 else np.einsum("pi,pki->pk", b, lights)


METHODS = {"least squares": least_squares, "trimmed": trimmed, "reweighted": reweighted}


def normals(
    values: np.ndarray, lights: np.ndarray, method: str = "trimmed", usable: np.ndarray | None = None
) -> np.ndarray:
    """Unit normals, (P, 3), by one of `METHODS`. Those that would face away from the camera are turned to its side.

    usable : which values are, (P, K), bool, see `weights_of`; default all.

    Raises
    ------
    ValueError : there is no such method.
    """
    if method not in METHODS:
        raise InputError(f'ps: unknown method "{method}", expected one of {", ".join(METHODS)}')
    return facing(METHODS[method](values.astype(np.float64), lights, weights_of(usable, lights)))


def facing(b: np.ndarray) -> np.ndarray:
    """Unit normals of albedo times normal, (P, 3), on the side of the camera."""
    n = unit(b)
    return np.where(n[:, 2:] < 0, n * [1, 1, -1], n)
