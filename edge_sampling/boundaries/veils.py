"""Surfaces that rays go through as if nothing was there, such as opacity masks: veils."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.meshes import lets_rays_through, surfaces
from rimlight.edge_sampling.rays import spawn_ray


def has_veils(scene: mi.Scene) -> bool:
    return any(lets_rays_through(s) for s in surfaces(scene))


def is_veil(si: mi.SurfaceInteraction3f) -> mi.Bool:
    return si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)


def behind_veils(
    scene: mi.Scene,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    passed: Callable[[mi.SurfaceInteraction3f, mi.Ray3f], mi.Bool],
    active: mi.Bool,
) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f, mi.UInt32]:
    """The rays behind veils, what they meet, and how many veils they went through. Detached.

    pi : what they meet first. passed : which veils.
    """

    def go_on(ray, pi, count, active):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        through = active & is_veil(si) & passed(si, ray)
        ray = dr.select(through, mi.Ray3f(spawn_ray(scene, si, ray.d, True)), ray)
        beyond = scene.ray_intersect_preliminary(ray, active=through)
        return ray, dr.select(through, beyond, pi), count + dr.select(through, 1, 0), through & beyond.is_valid()

    none = dr.zeros(mi.UInt32, dr.width(pi.t))
    state = (mi.Ray3f(ray), mi.PreliminaryIntersection3f(pi), none, active & pi.is_valid())
    return dr.while_loop(state, lambda *state: state[-1], go_on, label="behind veils")[:3]


@dataclass
class Before:
    """What lies before a point of an outline, as the camera sees it. (A Dr.Jit structure: not frozen.)

    A veil before it lets the light through that jumps there. What the veil mirrors or scatters itself does not jump
    there, but where something lies by symmetry: an upright wall in water, and its reflection, end at one line of the
    film, though the outlines of both are found one by one.

    p : the point, world space. slack : so far from it, what the outline belongs to may be met, scene units.
    active : mi.Bool, do rays go towards it?
    """

    p: mi.Point3f
    slack: mi.Float
    active: mi.Bool

    def veils(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> mi.Bool:
        """Is what a ray meets a veil before the point?"""
        to_p = self.p - si.p
        return self.active & is_veil(si) & (dr.dot(to_p, ray.d) > 0) & (dr.abs_dot(si.n, to_p) > self.slack)

    def where(self, active: mi.Bool) -> Before:
        """The same, active at most there."""
        return replace(self, active=self.active & active)


@dataclass
class Veiled:
    """What veils let through of the light along rays that end.

    part : mi.Spectrum, of the light; 0 where something else is in the way.
    count : mi.UInt32, number of the veils.
    ray, first : the ray, and what it meets first. Detached.
    """

    part: mi.Spectrum
    count: mi.UInt32
    ray: mi.Ray3f
    first: mi.PreliminaryIntersection3f

    @staticmethod
    def along(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> Veiled:
        first = scene.ray_intersect_preliminary(ray, active=active)

        def go_on(ray, pi, part, count, active):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            through = active & is_veil(si)
            part *= dr.select(active, dr.select(through, si.bsdf().eval_null_transmission(si, through), 0), 1)
            count += dr.select(active, mi.UInt32(1), 0)
            active = through & dr.any(part != 0)
            beyond = spawn_ray(scene, si, ray.d, True)
            beyond.maxt = ray.maxt - dr.norm(beyond.o - ray.o)
            pi = scene.ray_intersect_preliminary(beyond, active=active)
            return beyond, pi, part, count, active & pi.is_valid()

        width = dr.width(active)
        state = (mi.Ray3f(ray), first, dr.full(mi.Spectrum, 1, width), dr.zeros(mi.UInt32, width))
        _, _, part, count, _ = dr.while_loop(
            (*state, active & first.is_valid()), lambda *state: state[-1], go_on, label="veils"
        )
        return Veiled(part, count, ray, first)
