"""Weights of a dictionary for a measured material, and the reduction of many lobes to a dictionary of few.

Bangaru 2019, section 3.3. The cost of weights a for a colour of a material is Σ J (Y - D a)² / (Y + ε), over directions
at which the table has the values Y and the lobes the values D (without cosines). J is the Jacobian of these directions
with the cosines that images have; dividing by Y + ε makes errors relative where the material is bright.

Tables are taken as they are. They are reciprocal by the way in which they are stored; the lobes are the same, too, when
mirrored at the plane of incidence. Where a table is not, the fit goes between both sides.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import drjit.auto
import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from tqdm import tqdm

from rimlight import ggx, merl_tables
from rimlight.edge_sampling.refusals import InputError

#: ε of the cost, 1/sr: below this, it is absolute errors that count. White paper has 0.3.
EPSILON = 0.01

#: Directions with less elevation than this, in degrees, do not count: they are measured badly, if at all.
HORIZON = 5.0

#: Entries of a table that are compared: all θ_h, since peaks are narrow, and some θ_d and φ_d, placed symmetrically.
SUBSET = np.ix_(np.arange(90), np.arange(1, 90, 3), np.arange(5, 180, 13))

#: Numbers that thousands of lobes, which are much alike, are reduced to in a fit. It is exact to about 0.00001.
RANK = 100

#: Index of refraction of the coat of diffuse candidates, on which fits hardly depend: that of glass and resins.
COAT = 1.5

#: In each round of the reduction at most this part is removed.
REMOVED = 0.1


class FitError(NamedTuple):
    """Of a fit, over all directions and colours, as parts of the same measures of the table."""

    #: √(Σ J (Y - D a)² / Σ J Y²): peaks decide.
    rms: float
    #: √(Σ W (Y - D a)² / Σ W Y²) with W = J / (Y + ε), the root of the cost.
    cost: float


def candidates(
    alpha: tuple[float, float] = (0.003, 1.0),
    eta: tuple[float, float] = (1.05, 100.0),
    counts: tuple[int, int] = (50, 40),
    diffuse: bool = True,
) -> ggx.Lobes:
    """A grid of lobes to choose from, and two diffuse ones, under a coat and Lambertian. The steps grow with alpha and
    eta - 1.

    alpha, eta : smallest and largest.
    counts : of different alphas and etas.
    """
    alphas = np.geomspace(*alpha, counts[0])
    etas = 1 + np.geomspace(eta[0] - 1, eta[1] - 1, counts[1])
    grid = [(float(f"{a:.3g}"), float(f"{e:.4g}")) for a in alphas for e in etas]
    return ggx.Lobes(*zip(*grid, *[(np.nan, COAT), (np.nan, np.nan)][: 2 * diffuse], strict=True))


def fit(table: np.ndarray, lobes: ggx.Lobes) -> np.ndarray:
    """The weights of least cost that are not negative and sum to at most 1.

    table : (90, 90, 180, 3), 1/sr, see `rimlight.merl_tables`.

    Returns
    -------
    (B, 3).
    """
    return _fit(_values(table), _design(lobes))


def error(table: np.ndarray, lobes: ggx.Lobes, weights: np.ndarray) -> FitError:
    """Of weights (B, 3) for a table (90, 90, 180, 3)."""
    return _error(_values(table), _design(lobes), weights)


def reduce(
    tables: Iterable[tuple[str, np.ndarray]],
    lobes: ggx.Lobes,
    *,
    count: int = 40,
    alphas: int = 12,
    etas: int = 8,
    progress: bool = False,
) -> tuple[ggx.Lobes, dict[str, np.ndarray], dict[str, FitError]]:
    """Choose the lobes that describe all materials best: fit all materials, remove the least useful, and repeat.

    A lobe is as useful as what it contributes to all fits: weight times root mean square. (Bangaru 2019 takes the sum
    of the weights, which are large where lobes are dark.) Since lobes that share alpha or eta are cheaper, first whole
    alphas and etas are removed, by the sums over their lobes; then single lobes.

    tables : names, and tables (90, 90, 180, 3), 1/sr. They are read once, one after the other.
    lobes : to choose from.
    count : of lobes that remain.
    alphas, etas : different ones that remain, at most.
    progress : show a bar?

    Returns
    -------
    lobes : in the order in which they were given.
    weights : (B, 3) of each material, as by `fit`.
    errors : of each material.

    Raises
    ------
    ValueError : there are no tables.
    """
    bar = lambda items, text: tqdm(items, desc=text, leave=False, disable=not progress)
    values = {name: _values(table) for name, table in bar(tables, "read")}
    if not values:
        raise InputError("there are no tables")
    design = _design(lobes)
    # Rows weighed as in the mean fit, so that what is left out does not matter in any
    typical = np.sqrt(_weights(np.mean(list(values.values()), axis=(0, 1))))[:, None]
    design *= typical
    useful = np.linalg.norm(design, axis=0)
    directions = np.random.default_rng(0).normal(size=(len(lobes), min(RANK, len(lobes)))) / useful[:, None]
    basis, _ = np.linalg.qr(design @ directions)  # Halko et al. 2011, algorithm 4.1
    columns = basis.T @ design
    basis /= typical
    del design
    systems = [_compressed(basis, y) for three in bar(values.values(), "prepare") for y in three]

    alpha = np.array(lobes.alpha)
    eta = np.where(np.isnan(alpha), np.nan, lobes.eta)  # of GGX lobes only
    kept = np.arange(len(lobes))
    while len(kept) > count:
        fits = bar(systems, f"fit {len(kept)} lobes")
        usefulness = useful[kept] * sum(_solve(r @ columns[:, kept], rhs) for r, rhs in fits)
        most_alphas = _most_useful(alpha[kept], usefulness, alphas)
        most_etas = _most_useful(eta[kept], usefulness, etas)
        both = np.isin(alpha[kept], most_alphas) & np.isin(eta[kept], most_etas) | np.isnan(alpha[kept])
        if both.all():
            both = np.isin(kept, _most_useful(kept, usefulness, count))
        kept = kept[both]
    reduced = ggx.Lobes(*(tuple(np.array(numbers)[kept].tolist()) for numbers in (lobes.alpha, lobes.eta)))
    design = _design(reduced)
    weights = {name: _fit(y, design) for name, y in bar(values.items(), "fit")}
    return reduced, weights, {name: _error(y, design, weights[name]) for name, y in values.items()}


def _most_useful(keys: np.ndarray, usefulness: np.ndarray, count: int) -> np.ndarray:
    """Of the different keys those with the largest sums: all but a tenth, and `count` in the end. NaN is none."""
    found, which = np.unique(keys[~np.isnan(keys)], return_inverse=True)
    total = np.bincount(which, usefulness[~np.isnan(keys)])
    count = max(count, min(int(np.count_nonzero(total)), int((1 - REMOVED) * len(found))))
    return found[np.argsort(-total)[:count]]


# ---------------------- Least squares ----------------------


def _fit(values: np.ndarray, design: np.ndarray) -> np.ndarray:
    """Values (3, N) and lobes (N, B) -> weights (B, 3)."""
    scaled = ((np.sqrt(_weights(y)), y) for y in values)
    return np.stack([_solve(scale[:, None] * design, scale * y) for scale, y in scaled], axis=1)


def _solve(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The a of least |A a - y| with a >= 0 and a sum of at most 1. A : (N, B), y : (N,)."""
    steps = 20 * A.shape[1]
    a, _ = nnls(A, y, maxiter=steps)
    if a.sum() > 1:
        # The bound then holds with equality: one more equation, of great weight, and what is left of its error
        weight = 100 * np.linalg.norm(A, axis=0).max()
        a, _ = nnls(np.vstack([A, np.full(A.shape[1], weight)]), np.append(y, weight), maxiter=steps)
        a /= a.sum()
    return a


def _compressed(basis: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A few equations R x = z with the same minimum in x as the weighted ones basis x = y. basis : (N, r), y : (N,)."""
    weighted = _weights(y)[:, None] * basis
    R = cholesky(weighted.T @ basis)
    return R, solve_triangular(R, weighted.T @ y, trans="T")


def _error(values: np.ndarray, design: np.ndarray, weights: np.ndarray) -> FitError:
    squares = np.square(values - (design @ weights).T), np.square(values)
    measures = _directions().jacobian, _weights(values)
    return FitError(*(float(np.sqrt((w * squares[0]).sum() / (w * squares[1]).sum())) for w in measures))


# ---------------------- Directions ----------------------


class _Directions(NamedTuple):
    """The N pairs of directions at which tables are compared."""

    #: (90, 30, 14): which entries of `SUBSET` they are.
    valid: np.ndarray
    #: (N, 3) each, shading frame, unit length.
    wi: np.ndarray
    wo: np.ndarray
    #: (N,), of sum 1: d ωi d ωo cos θi cos θo.
    jacobian: np.ndarray


@cache
def _directions() -> _Directions:
    valid = merl_tables.elevation()[SUBSET] > np.radians(HORIZON)
    centres = merl_tables.angles()
    theta_h, theta_d, phi_d = (
        a[valid] for a in np.meshgrid(*(c[i.ravel()] for c, i in zip(centres, SUBSET, strict=True)), indexing="ij")
    )
    wi, wo = merl_tables.directions(theta_h, theta_d, phi_d)
    # dωi dωo = 4 cos θ_d dω_h dω_d (Rusinkiewicz 1998); steps of θ_h grow with its root
    solid_angles = np.cos(theta_d) * np.sin(theta_h) * np.sin(theta_d) * np.sqrt(theta_h)
    jacobian = solid_angles * wi[:, 2] * wo[:, 2]
    return _Directions(valid, wi, wo, jacobian / jacobian.sum())


def _values(table: np.ndarray) -> np.ndarray:
    """Table (90, 90, 180, 3) -> (3, N)."""
    return table[SUBSET][_directions().valid].T


def _design(lobes: ggx.Lobes) -> np.ndarray:
    """The lobes at all directions, (N, B)."""
    used = _directions()
    wi, wo = (drjit.auto.Array3f64(np.ascontiguousarray(w.T)) for w in (used.wi, used.wo))
    result = np.empty((len(used.wi), len(lobes)))
    for alpha, members in lobes.groups():  # a kernel each
        numbers, etas = zip(*members, strict=True)
        result[:, numbers] = np.array(ggx.lobes(ggx.Lobes((alpha,) * len(etas), etas), wi, wo)).T
    return result


def _weights(values: np.ndarray) -> np.ndarray:
    """W of the cost: (..., N), at the values (..., N)."""
    return _directions().jacobian / (values + EPSILON)
