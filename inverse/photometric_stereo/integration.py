"""Depth from normals: weighted least squares of slopes, with and without discontinuities; and meshes and normals of it.

Axes: x to the right, y up, z towards the camera. Rows of arrays go down; the centre of pixel (row, column) = (v, u) is
at the pixel coordinates (u, v), so that the first one is at (0, 0).

* Without a camera, orthographic: pixel (v, u) with depth z shows the point `pixel_size` · (u, −v, 0) + (0, 0, z). Depth
  grows **towards** the camera.
* With `camera`, an intrinsic matrix K: the pixel with depth d shows the point d · (x, −y, −1), where
  (x, y, 1) = K⁻¹ (u, v, 1). Depth is the distance from the camera along its axis: positive, and it grows **away from**
  the camera.

Both cases are one problem for q, which is −z or log d. From one pixel to the next, the point of a surface moves by
∂r/∂u + r ∂q/∂u (times d with a camera), where r is the ray through the pixel, and this is perpendicular to the normal n
(Cao et al. 2022):

    −(n · r) ∂q/∂u = n · ∂r/∂u,   −(n · r) ∂q/∂v = n · ∂r/∂v.

With a camera, r = (x, −y, −1); without, r = (0, 0, −1), ∂r/∂u = (`pixel_size`, 0, 0), ∂r/∂v = (0, −`pixel_size`, 0).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.ndimage import label
from scipy.spatial.transform import Rotation
from scipy.special import expit

from rimlight.edge_sampling.refusals import InputError

from . import laplacian

log = logging.getLogger(__name__)

#: Least cosine between a normal and the direction to the camera (89 degrees): normals beyond, or facing away, count as
#: slopes this steep.
LEAST_COSINE = 0.02

#: Weight of a pixel, relative to the largest, below which none falls: without any equation it had no depth.
LEAST_WEIGHT = 1e-6

#: How much q sticks to its last value, relative to the equations: parts that nothing connects stay where they are.
INERTIA = 1e-12


def integrate(
    normals: np.ndarray,
    mask: np.ndarray,
    *,
    camera: np.ndarray | None = None,
    pixel_size: float = 1.0,
    weights: np.ndarray | None = None,
    bilateral: float | None = None,
    tolerance: float = 1e-5,
    max_iterations: int = 100,
) -> np.ndarray:
    """Depth of a surface from its normals: weighted Poisson equation, with natural boundary conditions at the mask.

    Each pixel states the difference of depth to each of its four neighbours, as its normal has it; these equations are
    solved by weighted least squares.

    Parameters
    ----------
    normals : (H, W, 3), camera coordinates. Their length does not count. Outside the mask, anything.
    mask : (H, W), bool. Parts that no edges of pixels connect are independent of each other.
    camera : (3, 3), pixels: intrinsic matrix. None: orthographic.
    pixel_size : side of a pixel of an orthographic camera, in the unit that depth shall have.
    weights : (H, W), >= 0, relative: how much the squared errors of the slopes of a pixel count. By default, the cosine
        c between the normal and the direction to the camera, n_z of an orthographic one (Bangaru 2019, section 4.5);
        with `bilateral`, c² (Cao et al. 2022). Weights below 1e-6 of the largest count as that.
    bilateral : sharpness k of bilateral weights, which let go of neighbours across discontinuities; Cao et al. use 2.
        None: the surface is continuous.
    tolerance : bilateral iterations end when the energy changes by less than this part of it.
    max_iterations : of the bilateral weights. A warning is logged if they did not suffice.

    Returns
    -------
    depth : (H, W), float64, NaN outside the mask. Orthographic: in the unit of `pixel_size`, mean 0 in each connected
        part. With a camera: geometric mean 1 in each connected part, for the scale is unknown.

    Raises
    ------
    ValueError : shapes do not agree; the mask is empty; a normal in the mask is not finite, or zero; a weight is
        negative or not finite; the camera, or an option, is no such thing.
    """
    mask = _checked_mask("integrate", mask)
    check_camera("integrate", camera, pixel_size)
    if not (bilateral is None or 0 < bilateral < np.inf):
        raise InputError(f'integrate: "bilateral" must be positive, got {bilateral}; 2 is usual')
    if not tolerance > 0 or max_iterations < 1:
        raise InputError(f"integrate: tolerance {tolerance} and max_iterations {max_iterations} must be positive")
    n = _unit_normals(normals, mask)
    rays, steps = view_rays(mask, camera, pixel_size)
    cosine = -np.sum(n * rays, axis=1) / np.linalg.norm(rays, axis=1)
    cosine = np.maximum(cosine, LEAST_COSINE)
    by_default = cosine if bilateral is None else cosine**2
    weight = by_default if weights is None else _checked_weights(weights, mask)
    equations = _equations(mask, n, rays, steps, cosine)

    # `slope` contains the cosine: its square is part of the weights already
    confidence = [(weight / cosine**2)[e.pixels] for e in equations]
    q = _least_squares(equations, confidence, np.zeros(len(n)))
    if bilateral is not None:
        energy = np.inf
        for _ in range(max_iterations):  # iteratively reweighted least squares
            W = [c * e.trust(q, bilateral) for e, c in zip(equations, confidence, strict=True)]
            q = _least_squares(equations, W, q)
            last, energy = energy, sum(np.sum(w * e.residuals(q) ** 2) for e, w in zip(equations, W, strict=True))
            if abs(last - energy) <= tolerance * energy:
                break
        else:
            log.warning("integrate: bilateral weights still change after %d iterations", max_iterations)

    parts = label(mask)[0][mask]
    q -= (np.bincount(parts, q) / np.maximum(np.bincount(parts), 1))[parts]
    depth = np.full(mask.shape, np.nan)
    depth[mask] = -q if camera is None else np.exp(q)
    return depth


@dataclass(frozen=True)
class _Equations:
    """What pixels state about neighbours in one direction: `slope` (q[second] − q[first]) = `rise`.

    E pairs of neighbours make two equations each: row 0 is that of the first pixel, which looks at the one to the right
    or below, row 1 that of the second, which looks back.

    count : of all pixels of the mask. pixels : (2, E), whose equation it is. slope, rise : (2, E), both scaled such
    that `rise` is the component of the normal along the direction.
    """

    count: int
    pixels: np.ndarray
    slope: np.ndarray
    rise: np.ndarray

    @property
    def first(self) -> np.ndarray:
        return self.pixels[0]

    @property
    def second(self) -> np.ndarray:
        return self.pixels[1]

    def residuals(self, q: np.ndarray) -> np.ndarray:
        return self.slope * (q[self.second] - q[self.first]) - self.rise

    def trust(self, q: np.ndarray, sharpness: float) -> np.ndarray:
        """Bilateral weights, (2, E), in [0, 1]: larger to the side where depth differs less (Cao et al. 2022).

        The differences are measured along the normal. Where the mask ends, there is none: 0.
        """
        squared = np.zeros((2, self.count))
        for side in (0, 1):
            squared[side, self.pixels[side]] = (self.slope[side] * (q[self.second] - q[self.first])) ** 2
        ahead = expit(sharpness * (squared[1] - squared[0]))
        return np.stack([ahead[self.first], 1 - ahead[self.second]])


def _equations(
    mask: np.ndarray, normals: np.ndarray, rays: np.ndarray, steps: np.ndarray, cosine: np.ndarray
) -> tuple[_Equations, ...]:
    """Equations between neighbours in rows, and in columns."""
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(len(normals))
    found = []
    for axis, step in zip((1, 0), steps, strict=True):
        near, far = (index[:, :-1], index[:, 1:]) if axis else (index[:-1], index[1:])
        both = (near >= 0) & (far >= 0)
        pixels = np.stack([near[both], far[both]])
        length = np.linalg.norm(step)
        slope = cosine * np.linalg.norm(rays, axis=1) / length
        found.append(_Equations(len(normals), pixels, slope[pixels], (normals @ step / length)[pixels]))
    return tuple(found)


def _least_squares(equations: Sequence[_Equations], weights: Sequence[np.ndarray], q: np.ndarray) -> np.ndarray:
    """Least weighted squares of the residuals: normal equations, whose matrix is a Laplacian of the graph of pixels."""
    first, second = (np.concatenate([e.pixels[k] for e in equations]) for k in (0, 1))
    stiffness = np.concatenate([(w * e.slope**2).sum(0) for e, w in zip(equations, weights, strict=True)])
    flux = np.concatenate([(w * e.slope * e.rise).sum(0) for e, w in zip(equations, weights, strict=True)])
    total = lambda pixel, values: np.bincount(pixel, values, minlength=len(q))
    diagonal = total(first, stiffness) + total(second, stiffness)
    inertia = INERTIA * (diagonal.mean() or 1.0)
    unknowns = np.arange(len(q))
    rows, columns = np.r_[unknowns, first, second], np.r_[unknowns, second, first]
    A = sp.csr_matrix((np.r_[diagonal + inertia, -stiffness, -stiffness], (rows, columns)))
    return laplacian.solve(A, total(second, flux) - total(first, flux) + inertia * q, q)


def view_rays(mask: np.ndarray, camera: np.ndarray | None, pixel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays r through the pixels of the mask, (P, 3); and their derivatives, to the next column and row, (2, 3)."""
    v, u = np.nonzero(mask)
    if camera is None:
        return np.tile([0.0, 0.0, -1.0], (len(u), 1)), pixel_size * np.array([[1.0, 0, 0], [0, -1, 0]])
    towards = ray_matrix(camera)
    return np.stack([u, v, np.ones_like(u)], 1) @ towards.T, towards[:, :2].T


def ray_matrix(camera: np.ndarray) -> np.ndarray:
    """Makes rays (x, −y, −1), camera coordinates, of pixel coordinates (u, v, 1): (3, 3)."""
    return np.linalg.inv(np.asarray(camera, np.float64)) * np.array([[1.0], [-1], [-1]])


def _points(depth: np.ndarray, mask: np.ndarray, camera: np.ndarray | None, pixel_size: float) -> np.ndarray:
    """Points that the pixels of the mask show, (P, 3), camera coordinates."""
    z = np.asarray(depth, np.float64)[mask]
    if camera is not None:
        return z[:, None] * view_rays(mask, camera, pixel_size)[0]
    v, u = np.nonzero(mask)
    return np.stack([pixel_size * u, -pixel_size * v, z], 1)


# ------------------------------------------------------------------ from depth


def normals_of(
    depth: np.ndarray, mask: np.ndarray, *, camera: np.ndarray | None = None, pixel_size: float = 1.0
) -> np.ndarray:
    """Unit normals of a depth map, which face the camera: central differences, one-sided ones at the mask.

    depth : (H, W), as `integrate` returns it. mask, camera, pixel_size : as there.

    Returns
    -------
    normals : (H, W, 3), float64, camera coordinates. NaN outside the mask, and where a pixel has no neighbour in its
        row, or none in its column.

    Raises
    ------
    ValueError : shapes do not agree; the mask is empty; depth in the mask is not finite, or with a camera not positive.
    """
    mask = _checked_mask("normals_of", mask)
    check_camera("normals_of", camera, pixel_size)
    _check_depth("normals_of", depth, mask, positive=camera is not None)
    points = np.full((*mask.shape, 3), np.nan)
    points[mask] = _points(depth, mask, camera, pixel_size)
    down, right = (_derivative(points, axis) for axis in (0, 1))
    normals = np.cross(down, right)
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


def _derivative(points: np.ndarray, axis: int) -> np.ndarray:
    """Mean of the differences to the neighbours on both sides, as far as there are any; else NaN."""
    ahead, back = np.full_like(points, np.nan), np.full_like(points, np.nan)
    difference = np.diff(points, axis=axis)
    if axis:
        ahead[:, :-1], back[:, 1:] = difference, difference
    else:
        ahead[:-1], back[1:] = difference, difference
    ahead, back = np.where(np.isnan(ahead), back, ahead), np.where(np.isnan(back), ahead, back)
    return (ahead + back) / 2


def mesh_of(
    depth: np.ndarray, mask: np.ndarray, *, camera: np.ndarray | None = None, pixel_size: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A triangle mesh with a vertex at the centre of each pixel of the mask.

    Four pixels make two triangles, apart at the shorter diagonal; three of which the fourth is outside the mask, one.
    Seen from the camera, the triangles are counter-clockwise: their normals face it. They bridge discontinuities.

    depth : (H, W), as `integrate` returns it. mask, camera, pixel_size : as there.

    Returns
    -------
    vertices : (V, 3), float64, camera coordinates.
    faces : (F, 3), int64, of vertices.
    pixels : (V, 2), int64, row and column of each vertex: those of the mask, row by row.

    Raises
    ------
    ValueError : as of `normals_of`.
    """
    mask = _checked_mask("mesh_of", mask)
    check_camera("mesh_of", camera, pixel_size)
    _check_depth("mesh_of", depth, mask, positive=camera is not None)
    vertices = _points(depth, mask, camera, pixel_size)
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(len(vertices))
    # a b
    # c d, vertices of four pixels; -1: outside the mask
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    length = lambda p, q: np.linalg.norm(vertices[p] - vertices[q], axis=1)
    from_a_to_d = (np.minimum(a, d) >= 0) & ((np.minimum(b, c) < 0) | (length(a, d) < length(b, c)))
    upper = np.where(from_a_to_d, [a, d, b], [a, c, b])
    lower = np.where(from_a_to_d, [a, c, d], [b, c, d])
    faces = np.concatenate([upper, lower], axis=1).T
    return vertices, faces[np.all(faces >= 0, axis=1)], np.argwhere(mask)


def depth_error(
    depth: np.ndarray,
    truth: np.ndarray,
    mask: np.ndarray,
    *,
    align: Literal["offset", "scale", "rigid"] = "offset",
    camera: np.ndarray | None = None,
) -> float:
    """Mean absolute error of depth after alignment, in the unit of `truth`.

    depth, truth : (H, W). mask : (H, W), bool.
    align : what normals do not tell, of each connected part of the mask, is chosen such that the error is least: an
        offset (the median of the differences) for an orthographic camera; a factor (the median of the quotients,
        weighted by depth) for a perspective one. Never both. "rigid" also rotates and moves the points that the whole
        mask shows, such that squared distances to those of the truth, pixel by pixel, are least (Umeyama 1991).
    camera : as of `integrate`, of a rigid alignment.

    Raises
    ------
    ValueError : shapes do not agree; the mask is empty; a depth in the mask is not finite, or, for a factor, not
        positive; there is no such alignment.
    """
    mask = _checked_mask("depth_error", mask)
    if align not in ("offset", "scale", "rigid"):
        raise InputError(f'depth_error: "align" must be "offset", "scale" or "rigid", got "{align}"')
    for a in (depth, truth):
        _check_depth("depth_error", a, mask, positive=align == "scale" or camera is not None)
    if align == "rigid":
        check_camera("depth_error", camera)
        found, true = (_points(a, mask, camera, 1.0) for a in (depth, truth))
        found, true = (points - points.mean(0) for points in (found, true))
        turned = Rotation.align_vectors(true, found)[0].apply(found)
        scale = 1.0 if camera is None else np.sum(turned * true) / np.sum(turned**2)
        return float(np.abs(scale * turned - true)[:, 2].mean())
    parts, count = label(mask)
    total = 0.0
    for part in range(1, count + 1):
        d, t = (np.asarray(a, np.float64)[parts == part] for a in (depth, truth))
        if align == "offset":
            total += np.sum(np.abs(d + np.median(t - d) - t))
        else:
            order = np.argsort(t / d)
            half = np.searchsorted(np.cumsum(d[order]), d.sum() / 2)
            total += np.sum(np.abs(d * (t / d)[order[half]] - t))
    return float(total / mask.sum())


# ------------------------------------------------------------------ checks


def _checked_mask(who: str, mask: np.ndarray) -> np.ndarray:
    mask = np.asarray(mask)
    if mask.ndim != 2 or mask.dtype != bool:
        raise InputError(
            f'{who}: the mask must be an array (H, W) of bool, got {mask.dtype} {mask.shape}; "mask > 0" makes one'
        )
    if not mask.any():
        raise InputError(f"{who}: the mask is empty")
    return mask


def check_camera(who: str, camera: np.ndarray | None, pixel_size: float = 1.0) -> None:
    if not 0 < pixel_size < np.inf:
        raise InputError(f'{who}: "pixel_size" must be positive, got {pixel_size}')
    if camera is None:
        return
    K = np.asarray(camera, np.float64)
    if K.shape != (3, 3) or not np.isfinite(K).all() or np.any(K[2] != (0, 0, 1)) or min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(f"{who}: the camera must be a matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}")


def _check_depth(who: str, depth: np.ndarray, mask: np.ndarray, *, positive: bool) -> None:
    if np.shape(depth) != mask.shape:
        raise InputError(f"{who}: depth has the shape {np.shape(depth)}, the mask {mask.shape}")
    bad = ~np.isfinite(np.asarray(depth)[mask])
    if bad.any():
        raise InputError(f"{who}: depth is not finite in {bad.sum()} pixels of the mask; take them out of the mask")
    if positive and np.any(np.asarray(depth)[mask] <= 0):
        raise InputError(f"{who}: depth of a perspective camera must be positive")


def _unit_normals(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    if np.shape(normals) != (*mask.shape, 3):
        raise InputError(f"integrate: normals have the shape {np.shape(normals)}, not {(*mask.shape, 3)} as the mask")
    n = np.asarray(normals, np.float64)[mask]
    length = np.linalg.norm(n, axis=1, keepdims=True)
    bad = ~(np.isfinite(length) & (length > 0))
    if bad.any():
        raise InputError(
            f"integrate: {bad.sum()} normals in the mask are not finite, or zero; take these pixels out of the mask, "
            "or give them any normal and a weight of 0"
        )
    return n / length


def _checked_weights(weights: np.ndarray, mask: np.ndarray) -> np.ndarray:
    if np.shape(weights) != mask.shape:
        raise InputError(f"integrate: weights have the shape {np.shape(weights)}, the mask {mask.shape}")
    w = np.asarray(weights, np.float64)[mask]
    if not (np.isfinite(w).all() and w.min() >= 0 < w.max()):
        raise InputError("integrate: weights in the mask must be finite, >= 0, and not all 0")
    return np.maximum(w, LEAST_WEIGHT * w.max())
