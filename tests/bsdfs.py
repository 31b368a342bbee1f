"""What tests of BSDFs share. Directions are arrays (3, N), in the frame of the surface."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def context(component: int | None = None) -> mi.BSDFContext:
    result = mi.BSDFContext()
    if component is not None:
        result.component = component
    return result


def direction(theta, phi=0.0) -> np.ndarray:
    """Degrees -> (3, N)."""
    theta, phi = np.broadcast_arrays(np.radians(theta), np.radians(phi))
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]).reshape(3, -1)


def vector(directions: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(np.float32(directions))


def interaction(wi: np.ndarray) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, wi.shape[1])
    si.wi = vector(wi)
    si.wavelengths = mi.Color0f() if not mi.is_spectral else mi.Spectrum(450, 500, 550, 600)
    return si


def random_numbers(count: int, seed: int = 0) -> tuple[mi.Float, mi.Point2f]:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return sampler.next_1d(), sampler.next_2d()


def random_directions(count: int = 4096, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Pairs above the surface, half of them near to mirrors of each other: (3, N) each; exact in single precision."""
    rng = np.random.default_rng(seed)
    wi, wo = (direction(rng.uniform(0, 89.5, count), rng.uniform(0, 360, count)) for _ in range(2))
    near = wi * [[-1], [-1], [1]] + rng.normal(0, 0.1, (3, count)) * rng.uniform(0, 1, count) ** 3
    wo = np.where(np.arange(count) % 2, near * np.sign(near[2]), wo)
    return tuple(np.float32(w / np.linalg.norm(w, axis=0)).astype(float) for w in (wi, wo))


def chi_squared(bsdf, angle: float, component: int | None = None, other=None) -> mi.chi2.ChiSquareTest:
    """Of the samples of `bsdf` against the density of `other`, by default its own.

    Mitsuba's `BSDFAdapter` drops samples of no weight. Far from the peak, models underflow before their density.
    """
    wi = direction(angle)
    repeated = lambda count: interaction(np.broadcast_to(wi, (3, count)))

    def draw(numbers):
        si = repeated(dr.width(numbers))
        bs, _ = bsdf.sample(context(component), si, numbers[0], mi.Point2f(numbers[1], numbers[2]))
        return bs.wo, dr.select(bs.pdf > 0, mi.Float(1), 0)

    density = lambda wo: (other or bsdf).pdf(context(component), repeated(dr.width(wo)), wo)
    return mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), draw, density, 3, 200_000, res=101, ires=16)
