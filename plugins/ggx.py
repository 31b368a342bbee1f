"""Dictionaries of fixed lobes, GGX and diffuse: their formulas, and the files that hold them with their weights.

A file is JSON: ``{"alpha": [0.1, null], "eta": [1.5, null], "weights": [[r, g, b], [r, g, b]]}``, an entry for each
lobe; null marks diffuse ones, see `Lobes`. `rimlight.inverse.reflectance` makes such files, the plugin
``ggx_dictionary`` reads them::

    lobes, weights = ggx.read("weights.json")
    f = ggx.lobes(lobes, wi, wo)  # of each lobe
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.refusals import InputError

#: The dictionary that is part of the package, with the weights of the materials that it was reduced for.
SHIPPED = Path(__file__).with_name("ggx_dictionary.json")

#: By how much weights may sum to more than 1, since files round them.
SLACK = 1e-5

#: Cosines are taken to be at least this large, so that every pair of directions has a half vector.
GRAZING = 1e-6


@dataclass(frozen=True)
class Lobes:
    """The lobes of a dictionary. Without alpha (NaN) a lobe is diffuse: Lambertian, of albedo 1, if it has no eta
    either; else under a smooth coat.

    Raises
    ------
    ValueError : there are none; as many of one as of the other are not given; a number is out of its range.
    """

    #: Roughness of the GGX distribution, in (0, 1], or NaN.
    alpha: tuple[float, ...]
    #: Index of refraction, above 1, or NaN.
    eta: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.alpha) != len(self.eta) or not self.alpha:
            raise InputError(
                f'"alpha" and "eta" must have a number for each lobe, got {len(self.alpha)} and {len(self.eta)}'
            )
        for i, (alpha, eta) in enumerate(zip(self.alpha, self.eta, strict=True), 1):
            if not (((np.isnan(alpha) or 0 < alpha <= 1) and 1 < eta < np.inf) or (np.isnan(alpha) and np.isnan(eta))):
                raise InputError(
                    f"lobe {i}: expected alpha in (0, 1] and eta > 1, or eta alone (diffuse, under a coat), or neither "
                    f"(Lambertian), got {alpha} and {eta}"
                )

    def __len__(self) -> int:
        return len(self.alpha)

    def groups(self) -> list[tuple[float, list[tuple[int, float]]]]:
        """For each alpha, the numbers and etas of the lobes that have it: they share what does not depend on eta."""
        found: dict[float, list[tuple[int, float]]] = {}
        for i, (alpha, eta) in enumerate(zip(self.alpha, self.eta, strict=True)):
            found.setdefault(alpha, []).append((i, eta))
        return list(found.items())

    @property
    def normal_reflectance(self) -> np.ndarray:
        """What each reflects at normal incidence, (B,): GGX lobes as much as smooth surfaces would."""
        alpha, eta = np.array(self.alpha), np.array(self.eta)
        F = np.square((eta - 1) / (eta + 1))
        return np.where(np.isnan(eta), 1, np.where(np.isnan(alpha), 1 - F, F))


# ---------------------- The model ----------------------
# Bangaru 2019, section 3.4. Directions: shading frame, unit length, away from the surface.


def terms(lobes: Lobes, wi: Any, wo: Any) -> Iterator[tuple[float, Any, list[tuple[int, Any]]]]:
    """The factors of the lobes' values: of each alpha D G / (4 cos θᵢ cos θₒ), and the numbers and the F of its lobes.

    wi, wo : mi.Vector3f, (N,), above the surface; for others the results are finite, and mean nothing. Attached.
    """
    cos_i, cos_o = dr.maximum(wi.z, GRAZING), dr.maximum(wo.z, GRAZING)
    sin2, cos2 = dr.square(wi.x + wo.x) + dr.square(wi.y + wo.y), dr.square(cos_i + cos_o)
    length2 = sin2 + cos2
    scale = dr.rcp(length2)
    c = 0.5 * dr.sqrt(length2)  # ωᵢ·h
    sin2, cos2 = sin2 * scale, cos2 * scale
    F = {eta: fresnel(eta, c) for eta in dict.fromkeys(lobes.eta) if not np.isnan(eta)}
    for alpha, members in lobes.groups():
        if np.isnan(alpha):
            within = lambda eta: 1 if np.isnan(eta) else coated(eta, cos_i, cos_o)
            yield alpha, type(c)(dr.inv_pi), [(i, within(eta)) for i, eta in members]
            continue
        a2 = alpha * alpha
        t = dr.fma(cos2, a2, sin2)  # (n·h)² (α² - 1) + 1, without its cancellation near the normal
        # G₁ / (2 cos θ) = 1 / (cos θ + √(α² + (1 - α²) cos² θ))
        smith = (cos_i + stretched(cos_i, a2)) * (cos_o + stretched(cos_o, a2))
        yield alpha, a2 * dr.inv_pi * dr.rcp(dr.square(t) * smith), [(i, F[eta]) for i, eta in members]


def lobes(lobes: Lobes, wi: Any, wo: Any) -> list[Any]:
    """The value of each lobe, per sr, without the cosine.

    wi, wo : mi.Vector3f, (N,), or another array of Dr.Jit, such as `drjit.llvm.Array3f64`; shading frame, unit length,
        away from the surface and above it.

    Returns
    -------
    B arrays, mi.Float, (N,), attached to the directions. `np.array` makes a matrix (B, N) of them.
    """
    zero = 0 * wo.z  # for the Lambertian lobe, which is one number
    found = {i: zero + factor * F for _, factor, members in terms(lobes, wi, wo) for i, F in members}
    return [found[i] for i in range(len(lobes))]


def fresnel(eta: float, c: Any) -> Any:
    """Of unpolarised light, at an index of refraction `eta` and the cosine `c` to the half vector; c > 0."""
    k = eta * eta - 1
    g2 = dr.fma(c, c, k)
    s = dr.fma(g2, dr.rsqrt(g2), c)  # g + c; and g - c = k / s
    # Cook and Torrance 1982, with one common denominator
    p, q = s * dr.fma(s, c, -1), dr.fma(c, k, s)
    return 0.5 * dr.square(k * dr.rcp(dr.square(s) * q)) * dr.fma(p, p, dr.square(q))


def diffuse(eta: float, cos_i: Any, cos_o: Any) -> Any:
    """The value of a diffuse lobe, per sr, without the cosine: Lambertian (`eta` is NaN), or under a smooth coat."""
    if np.isnan(eta):
        return dr.inv_pi + 0 * cos_o
    return coated(eta, dr.maximum(cos_i, GRAZING), dr.maximum(cos_o, GRAZING)) * dr.inv_pi


def coated(eta: float, cos_i: Any, cos_o: Any) -> Any:
    """π times a diffuse lobe under a smooth coat, which lets 1 - F in and out: of the light, 1 - F(cos θᵢ) is reflected
    in all (Shirley et al. 1997, with Fresnel's term instead of Schlick's)."""
    return (1 - fresnel(eta, cos_i)) * (1 - fresnel(eta, cos_o)) * (1 / (1 - mean_fresnel(eta)))


@cache
def mean_fresnel(eta: float) -> float:
    """Reflectance of a smooth surface in light from everywhere, 2 ∫ F(c) c dc."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cos = 0.5 * (nodes + 1)
    return sum(w * c * fresnel(eta, c) for w, c in zip(weights.tolist(), cos.tolist(), strict=True))


def reflected_density(a2: Any, wi: Any, wo: Any) -> Any:
    """Density per sr of `wo`, mi.Float, (N,), where it is `wi` reflected at `sample_visible_normal`, both above the
    surface: D G₁(ωᵢ) / (4 cos θᵢ).

    a2 : mi.Float, (N,), or a number: alpha².
    """
    cos_i, cos_o = dr.maximum(wi.z, GRAZING), dr.maximum(wo.z, GRAZING)
    tan2 = dr.square(wi.x + wo.x) + dr.square(wi.y + wo.y)
    cos2 = dr.square(cos_i + cos_o)
    ratio = (cos2 + tan2) / dr.fma(cos2, a2, tan2)
    return a2 * dr.square(ratio) * dr.inv_two_pi / (cos_i + stretched(cos_i, a2))


def sample_visible_normal(a2: Any, wi: Any, sample: Any) -> Any:
    """A normal of the GGX distribution as visible from `wi`: mi.Normal3f, (N,), shading frame. Dupuy and Benyoub 2023.

    a2 : mi.Float, (N,): alpha².
    wi : mi.Vector3f, (N,), shading frame, unit length.
    sample : mi.Point2f, (N,), uniform in [0, 1)².
    """
    alpha = dr.sqrt(a2)
    view = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, dr.maximum(wi.z, GRAZING)))
    height = (1 - sample.x) * (1 + view.z)
    sin = dr.safe_sqrt(1 - dr.square(height - view.z))
    sin_phi, cos_phi = dr.sincos(dr.two_pi * sample.y)
    x, y = sin * cos_phi + view.x, sin * sin_phi + view.y
    return mi.Normal3f(dr.normalize(mi.Vector3f(alpha * x, alpha * y, dr.maximum(height, GRAZING))))


def stretched(cos: Any, a2: Any) -> Any:
    """√(cos² θ + α² sin² θ), for a2 = α² > 0."""
    square = dr.fma(dr.square(cos), 1 - a2, a2)
    return square * dr.rsqrt(square)  # cheaper than a root, as is its derivative


# ---------------------- Weights and files ----------------------


def check_weights(weights: np.ndarray, lobes: Lobes) -> None:
    """Weights of a material: (B, 1) or (B, 3), not negative, with a sum of at most 1 (+ SLACK) for each colour.

    Raises
    ------
    ValueError
    """
    if weights.ndim != 2 or weights.shape[0] != len(lobes) or weights.shape[1] not in (1, 3):
        B = len(lobes)
        raise InputError(f'"weights" must have the shape ({B}, 3) or ({B}, 1), for {B} lobes, got {weights.shape}')
    if not np.isfinite(weights).all():
        raise InputError('"weights" must be finite')
    if (weights < 0).any():
        raise InputError(f'"weights" must be >= 0, got {weights.min():g}')
    if (total := weights.sum(0).max()) > 1 + SLACK:
        raise InputError(f'"weights" must sum to at most 1 for each colour, got {total:.7g}')


def read(path: Path | str) -> tuple[Lobes, np.ndarray]:
    """A file of lobes with the weights of a material: the lobes, and (B, 3) or (B, 1).

    Raises
    ------
    ValueError : not of this form; see `Lobes` and `check_weights`. Names the file.
    OSError
    """
    lobes, weights = _read(path, "weights", lambda value: {"weights": value})
    return lobes, weights["weights"]


def write(path: Path | str, lobes: Lobes, weights: np.ndarray) -> None:
    """Write a file that `read` reads. Weights are rounded to six digits."""
    _write(path, lobes, '"weights": ' + _rows(weights))


def read_dictionary(path: Path | str = SHIPPED) -> tuple[Lobes, dict[str, np.ndarray]]:
    """A file of lobes with the weights of many materials, by default that of the package: the lobes, and for each
    material (B, 3) or (B, 1). Raises as `read`."""
    return _read(path, "materials", dict)


def write_dictionary(path: Path | str, lobes: Lobes, materials: dict[str, np.ndarray]) -> None:
    """Write a file that `read_dictionary` reads. Weights are rounded to six digits."""
    lines = ",\n".join(f"{json.dumps(name)}: {_rows(weights)}" for name, weights in materials.items())
    _write(path, lobes, f'"materials": {{\n{lines}}}')


def _read(
    path: Path | str, key: str, materials: Callable[[Any], dict[str, Any]]
) -> tuple[Lobes, dict[str, np.ndarray]]:
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(content, dict) or not {"alpha", "eta", key} <= set(content):
            raise InputError(f'expected an object with "alpha", "eta" and "{key}"')
        lobes = Lobes(*(tuple(_numbers(key, content[key]).tolist()) for key in ("alpha", "eta")))
        found = {name: _numbers("weights", value) for name, value in materials(content[key]).items()}
        for weights in found.values():
            check_weights(weights, lobes)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return lobes, found


def _write(path: Path | str, lobes: Lobes, rest: str) -> None:
    columns = {key: [None if np.isnan(x) else x for x in getattr(lobes, key)] for key in ("alpha", "eta")}
    Path(path).write_text(f"{json.dumps(columns)[:-1]},\n{rest}}}\n", encoding="utf-8")


def _numbers(key: str, value: Any) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64)  # null is NaN
    except (TypeError, ValueError):
        raise InputError(f'"{key}" must be an array of numbers') from None


def _rows(weights: np.ndarray) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{x:.6g}" for x in row) + "]" for row in weights) + "]"
