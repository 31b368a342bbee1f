"""How rays move along the film (Igehy 1999, "Tracing ray differentials"), and what they meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.instances import surface_met
from rimlight.edge_sampling.geometry.surfaces import components


@dataclass
class RayDerivative:
    """How a ray moves along one axis of the film, per pixel."""

    o: mi.Vector3f
    d: mi.Vector3f

    def at(self, ray: mi.Ray3f, si: mi.SurfaceInteraction3f) -> mi.Vector3f:
        """Of the point in which the ray meets a surface."""
        across = self.o + si.t * self.d
        return mi.Vector3f(across - ray.d * (dr.dot(si.n, across) / dr.dot(si.n, ray.d)))

    def beyond(self, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, d: mi.Vector3f, η: mi.Float) -> RayDerivative:
        """Of the ray that a mirror, or glass of the relative index η, makes of it, whose direction is d.

        Both have d = r·d₀ + γ·n with a number r; γ follows from the length of d.
        """
        p, n = self.at(ray, si), mi.Vector3f(si.sh_frame.n)
        moved = normal_derivative(si, p)
        r = dr.select(dr.dot(d, n) * dr.dot(ray.d, n) > 0, dr.rcp(η), 1)
        γ = dr.dot(d - r * ray.d, n)
        rest = r * self.d + γ * moved
        return RayDerivative(p, rest - n * (dr.dot(d, rest) / dr.dot(d, n)))


def normal_derivative(si: mi.SurfaceInteraction3f, moved: mi.Vector3f) -> mi.Vector3f:
    """By how much the shading normal changes, where the point moves by so much."""
    du, dv = components(moved, si.dp_du, si.dp_dv)
    return du * si.dn_du + dv * si.dn_dv


def change_of(
    scene: mi.Scene,
    function: Callable[[mi.SurfaceInteraction3f], mi.Float | mi.Vector3f],
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    way: RayDerivative,
    active: mi.Bool,
) -> mi.Float | mi.Vector3f:
    """Derivative of a function of the point that a ray meets, where the ray moves, but not the scene. Detached."""
    τ = dr.zeros(mi.Float, dr.width(ray))
    with dr.resume_grad():
        dr.enable_grad(τ)
    with dr.resume_grad(τ):
        moved = mi.Ray3f(ray)
        moved.o, moved.d = ray.o + τ * way.o, ray.d + τ * way.d
        value = function(surface_met(scene, moved, pi, mi.RayFlags.All, active))
        dr.set_grad(τ, 1)
        dr.enqueue(dr.ADMode.Forward, τ)
        dr.traverse(dr.ADMode.Forward)
        return dr.detach(dr.grad(value))
