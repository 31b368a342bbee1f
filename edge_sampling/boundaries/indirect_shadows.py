"""Shadows in indirect light: what edges do by the shadows that they throw on what lights the visible surfaces.

As in `shadow_boundary.py`, a shadow is found from its light: from a point y of the light past an edge to the point x
of a surface. There, the light that x reflects jumps; a vertex z of a path from the camera sees it. With x written over
area, the derivative of what z reflects gains

    ∮ f_z cos θ_z · cos θ_x / |x − z|² · f_x L_y · n · (ẋ_shadow − ẋ) dl,

with the normal n of the curve in the surface, away from the lit side, and the motion ẋ that the interior term has:
x is a material point, or near z that where a fixed direction from z meets the surface. For lights without size, there
is no other way to find these shadows. Those of lamps are found from the points x, too (`shading_boundary.py`), and are
divided between the two: see `share`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import Reservoir, power_heuristic
from rimlight.edge_sampling.choice.silhouettes import Placement, Silhouettes
from rimlight.edge_sampling.geometry.meshes import is_smooth, pointer
from rimlight.edge_sampling.parametrisation import Vicinity, material_point
from rimlight.edge_sampling.rays import spawn_ray, spawn_ray_to

from .fallen_shadow import LightPoint, LitEdge, SeenShadow, Shadow, fall, thrown
from .shadow_boundary import ShadowBoundary
from .tracer import ShadingPoint, Tracer
from .veils import Veiled, has_veils

#: Shadows in the light of lamps of which one is kept, in proportion to what it contributes if nothing hides it. In that
#: of lights without size, one is taken as it comes: the borders of a shadow mostly contribute with opposite signs, and
#: a stratified choice leaves less of them by chance than a choice by size.
CANDIDATES = 2

#: The same where light is hidden, for all lights.
MANY = 8

#: How much to prefer a shadow that stands still, of which only what slides over it counts.
STILL = 0.05

#: What the estimated density of edges, as they are found from lamps, is divided by: see `share`.
AROUND = 0.4


def share(
    density: mi.Float, light_pdf: mi.Float, pdf: mi.Float, cos: mi.Float, near: mi.Float, whole: mi.Float
) -> mi.Float:
    """Part of the shadows of lamps that is found from the lamps: the balance heuristic (Veach 1997) for the density of
    the place x of the shadow, by area, and of the point of the edge, by length.

    From the lamp, a point of it is chosen, then an edge, and x is behind that. From the vertex before, x is sampled by
    the BSDF; then an edge in the directions of the lamp, or of the highlight, if that is smaller.

    density : of x by area as it is sampled from the vertex before. light_pdf, pdf : of the direction from x to the
    lamp, among light samples and among those of the BSDF. cos : of the angle between it and the normal at x. near,
    whole : distances of the edge and of the lamp from x.
    """
    # Not below 0 at the own edges of a lamp, whatever rounding does: both ways must find a part from 0 to 1.
    beyond = dr.maximum(whole - near, 0)
    from_lamp = light_pdf * cos * beyond * dr.rsqrt(light_pdf + pdf) / (AROUND * dr.square(whole) * near)
    part = from_lamp / (from_lamp + density)
    return dr.select(dr.isfinite(part) & dr.isfinite(density), part, 0)


def is_bent(lamp: mi.Shape) -> bool:
    """Is a lamp shaded with other normals than those of its faces? Then the shadows in its light, where it arrives
    indirectly, are found from points alone."""
    return lamp.is_mesh() and is_smooth(lamp)


class IndirectShadows(ShadowBoundary):
    """Samples the shadows that points of paths see.

    moving : the shapes that move; None: edges matter at all points.
    hidden : is light hard to find? Then more shadows are compared, and `onwards` takes part.
    """

    DRJIT_STRUCT = ShadowBoundary.DRJIT_STRUCT | dict.fromkeys(("candidates", "continues", "veils", "moving_shapes"))

    def __init__(
        self, scene: mi.Scene, silhouettes: Silhouettes, moving: list[mi.Shape] | None = None, *, hidden: bool = False
    ):
        super().__init__(scene, silhouettes)
        #: See `_chosen`. In the light of lights without size, one is taken as it comes, unless it is hidden.
        self.candidates = MANY if hidden else CANDIDATES if self.any_surface else 1
        self.continues = hidden
        #: May points see shadows through surfaces that rays go through as if nothing was there?
        self.veils = has_veils(scene)
        self.moving_shapes = None if moving is None else [pointer(s) for s in moving]

    def counts(self, emitter: mi.Emitter) -> bool:
        on_surface = bool(emitter.flags() & mi.EmitterFlags.Surface)
        return super().counts(emitter) and not (on_surface and is_bent(emitter.get_shape()))

    def at(
        self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> mi.Spectrum:
        """One sample of what each point reflects of shadows: mi.Spectrum, (N,), zero, with its gradient.

        placement : of the shapes, attached. choice : uniform in [0, 1).
        """
        scene, z = tracer.scene, point.si
        with dr.suspend_grad():
            light, edge = self._chosen(scene, placement, z, point.active, sampler, choice)
            shadow = fall(scene, light, edge)
            active = shadow.active & point.active & tracer.scatters(point.depth + 1)
            x = shadow.fallen.compute_surface_interaction(shadow.ray, mi.RayFlags.All, active)
            join = Join.of(scene, z, x, active, through=self.veils)
            if self.veils:
                join.active &= tracer.scatters(point.depth + 1 + join.veiled.count)
            if self.continues:
                back = density_onwards(x, edge.ω, z, join)
                later = (point.depth > 1) & dr.isfinite(point.density) & dr.isfinite(join.pdf)
                join.weight *= dr.select(later, power_heuristic(point.density, back), 1)
            view, met, jump, n_dl = self._boundary(tracer, light, edge, shadow, x, z, join)
            vicinity = point.vicinity.around(z.bsdf())
            far = vicinity.far(join.r2)
        with dr.resume_grad():
            m = material_point(shadow.ray, shadow.fallen, view.active).p
            held = held_point(z.p, m, x.n, join.ω, far, view.active)
            if self.veils:
                held = _held_by_veil(z.p, m, x.n, join, vicinity, held, view.active)
            return self._value(scene, placement, light, edge, shadow, view, met, m, held, jump, n_dl)

    def onwards(
        self, tracer: Tracer, placement: Placement, point: ShadingPoint, sampler: mi.Sampler, choice: mi.Float
    ) -> mi.Spectrum:
        """As `at`, for shadows that each point sees by way of one more vertex z, which is found from the shadow: so
        1 / |x − z|² is sampled. With the part of them that `at` leaves to it."""
        scene, w = tracer.scene, point.si
        with dr.suspend_grad():
            light, edge = self._chosen(scene, placement, None, point.active, sampler, choice)
            shadow = fall(scene, light, edge)
            active = shadow.active & point.active & tracer.scatters(point.depth + 2)
            x = shadow.fallen.compute_surface_interaction(shadow.ray, mi.RayFlags.All, active)

            # ---------------------- From the shadow to a vertex, and to the point ----------------------

            x.wi = x.to_local(-edge.ω)
            numbers = sampler.next_1d(active), sampler.next_2d(active)
            bs, _ = x.bsdf().sample(mi.BSDFContext(mi.TransportMode.Importance), x, *numbers, active)
            active &= (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            ray = spawn_ray(scene, x, x.to_world(bs.wo))
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            z = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            to_z = Join.of(scene, w, z, active & z.is_valid())
            z.wavelengths = w.wavelengths
            join = Join.of(scene, z, x, to_z.active)
            back = density_onwards(x, edge.ω, z, join)
            join.weight *= to_z.weight * (power_heuristic(back, to_z.pdf) / back)
            join.active &= back > 0
            join.weight = dr.select(join.active, join.weight, 0)
            view, met, jump, n_dl = self._boundary(tracer, light, edge, shadow, x, z, join)
            far_z = point.vicinity.around(w.bsdf()).far(to_z.r2)
            far = point.vicinity.around(z.bsdf()).far(join.r2)
        with dr.resume_grad():
            active = view.active
            p_z = held_point(w.p, material_point(ray, pi, active).p, z.n, to_z.ω, far_z, active)
            m = material_point(shadow.ray, shadow.fallen, active).p
            held = held_point(p_z, m, x.n, join.ω, far, active)
            return self._value(scene, placement, light, edge, shadow, view, met, m, held, jump, n_dl)

    def _boundary(self, tracer: Tracer, light, edge, shadow, x, z, join: Join):
        """The shadow as z sees it; what the ray to the light meets; the jump; and the normal of the curve, with its
        length element over the density, away from the lit side."""
        near, whole = dr.norm(edge.p - x.p), dr.norm(light.y - x.p)
        ours = partial(share, join.pdf, cos=dr.abs_dot(x.n, edge.ω), near=near, whole=whole)
        ray = mi.RayDifferential3f(shadow.ray)
        x.wavelengths = ray.wavelengths = z.wavelengths
        x.wi = x.to_local(-join.ω)
        view = SeenShadow(mi.Point2f(0), ray, join.weight, shadow.fallen, x, None, join.active)
        met, jump, view.active = self._arriving(tracer, light, edge, shadow, view, ours)
        tangent, towards_light = (thrown(v, light, edge, shadow) for v in (edge.tangent, edge.lit))
        n_dl = dr.cross(shadow.facing, tangent) * (len(self) / edge.sample.density)
        n_dl = dr.mulsign(n_dl, -dr.dot(n_dl, towards_light)) * edge.sign
        view.active &= dr.isfinite(dr.squared_norm(n_dl)) & dr.any(jump != 0)
        return view, met, jump, dr.select(view.active, n_dl, 0)

    def _value(self, scene, placement, light, edge, shadow, view, met, m, held, jump, n_dl) -> mi.Spectrum:
        """m : the material point on which the shadow falls. held : the point as the path has it."""
        x = self._moving(scene, placement, light, edge, shadow, view, m, held, met)
        moved = (x - dr.detach(x)) - (held - dr.detach(held))
        return jump * dr.dot(n_dl, dr.select(view.active, moved, 0))

    def _chosen(
        self,
        scene: mi.Scene,
        placement: Placement,
        z: mi.SurfaceInteraction3f | None,
        active: mi.Bool,
        sampler: mi.Sampler,
        choice: mi.Float,
    ) -> tuple[LightPoint, LitEdge]:
        """Of a few shadows one, in proportion to what it does to the light of z; None: to that of its surface. The
        density of its edge is what an unbiased estimate divides by, that of the point on the light included."""
        time, active = mi.Float(0) if z is None else z.time, mi.Bool(active)
        if self.candidates == 1:
            light = self._point_on_light(scene, choice * len(self), time, sampler.next_2d())
            return light, self._edge(placement, light, sampler)

        def look(k, on_light, reservoir, sampler):
            at = _OnLight((choice + k) * (len(self) / self.candidates), sampler.next_2d())
            light = self._point_on_light(scene, at.choice, time, at.numbers)
            edge = self._edge(placement, light, sampler)
            target = self._unshadowed(scene, z, light, edge, fall(scene, light, edge), active)
            edge.sample.density *= light.density
            reservoir, taken = reservoir.take(edge.sample, target, sampler, active)
            return k + 1, dr.select(taken, at, on_light), reservoir, sampler

        width = dr.width(active)
        _, at, reservoir, _ = dr.while_loop(
            (dr.zeros(mi.Float, width), dr.zeros(_OnLight, width), dr.zeros(Reservoir, width), sampler),
            lambda k, *_: active & (k < self.candidates),
            look,
            label="shadows",
        )
        light = self._point_on_light(scene, at.choice, time, at.numbers)
        return light, self._edge_at(placement, light, reservoir.kept(self.candidates))

    def _unshadowed(
        self, scene: mi.Scene, z: mi.SurfaceInteraction3f | None, light: LightPoint, edge, shadow: Shadow, active
    ) -> mi.Float:
        """About what a shadow does to the light of a point, if nothing hides it, and all surfaces are equal."""
        arrives = dr.abs_dot(shadow.facing, edge.ω) * dr.select(light.on_surface, dr.abs_dot(light.n, edge.ω), 1)
        arrives *= dr.rcp(dr.select(light.far, 1, dr.squared_norm(shadow.x - light.y)))
        return self._reflected(z, light, edge, shadow, arrives, active & shadow.active)

    def _reflected(
        self, z: mi.SurfaceInteraction3f | None, light, edge: LitEdge, shadow: Shadow, arrives: mi.Float, active
    ) -> mi.Float:
        """What a point reflects of it. arrives : at the surface on which the shadow falls."""
        along = dr.norm(dr.cross(shadow.facing, thrown(edge.tangent, light, edge, shadow)))
        if z is None:
            return dr.select(active, along * arrives * self._moves(edge, shadow), 0)
        d = shadow.x - z.p
        r2 = dr.squared_norm(d)
        ω = d * dr.rsqrt(r2)
        f = dr.max(z.bsdf().eval(mi.BSDFContext(), z, z.to_local(ω), active))
        return dr.select(active, f * dr.abs_dot(shadow.facing, ω) / r2 * along * arrives, 0)

    def _moves(self, edge: LitEdge, shadow: Shadow) -> mi.Float:
        """About how much a shadow moves: little, if neither edge nor surface do."""
        if self.moving_shapes is None:
            return mi.Float(1)
        moves = self.silhouettes.preferred(edge.sample, [1.0, 0.0][: self.silhouettes.groups]) > 0
        for shape in self.moving_shapes:
            moves |= shadow.shape == shape
        return dr.select(moves, mi.Float(1), STILL)


@dataclass
class Join:
    """What joins a vertex z to the point x beyond it.

    ω : unit vector from z to x. r2 : squared distance. pdf : density of x by area, as it is sampled from z.
    weight : mi.Spectrum, what z reflects of the radiance of an element of area at x. active : do they see each other?
    veiled : what is between them; None: nothing may be. Where there is something, `pdf` is infinite: shadows in the
        light of lamps are found from x alone.
    """

    ω: mi.Vector3f
    r2: mi.Float
    pdf: mi.Float
    weight: mi.Spectrum
    active: mi.Bool
    veiled: Veiled | None = None

    @staticmethod
    def of(
        scene: mi.Scene,
        z: mi.SurfaceInteraction3f,
        x: mi.SurfaceInteraction3f,
        active: mi.Bool,
        *,
        through: bool = False,
    ) -> Join:
        """And let x be seen from there. through : through veils as well?"""
        d = x.p - dr.detach(z.p)
        r2 = dr.squared_norm(d)
        active = active & (r2 > 0)
        ω = d * dr.rsqrt(dr.select(active, r2, 1))
        x.wi = x.to_local(-ω)
        f, pdf = z.bsdf().eval_pdf(mi.BSDFContext(), z, z.to_local(ω), active)
        active &= dr.any(f != 0)
        cos_over_r2, ray = dr.abs_dot(x.n, ω) / r2, spawn_ray_to(scene, z, x.p)
        if through:
            veiled = Veiled.along(scene, ray, active)
            active &= dr.any(veiled.part != 0)
            weight = f * veiled.part * dr.select(active, cos_over_r2, 0)
            pdf = dr.select(veiled.count > 0, dr.inf, pdf * cos_over_r2)
            return Join(ω, r2, pdf, weight, active, veiled)
        active &= ~scene.ray_test(ray, active)
        return Join(ω, r2, pdf * cos_over_r2, f * dr.select(active, cos_over_r2, 0), active)


def density_onwards(x: mi.SurfaceInteraction3f, ω: mi.Vector3f, z: mi.SurfaceInteraction3f, join: Join) -> mi.Float:
    """Density by area with which z is found from x, where light arrives in the direction ω."""
    lit = mi.SurfaceInteraction3f(x)
    lit.wi = x.to_local(-ω)
    pdf = x.bsdf().pdf(mi.BSDFContext(mi.TransportMode.Importance), lit, x.to_local(-join.ω), join.active)
    return dr.detach(pdf * dr.abs_dot(z.n, join.ω) / join.r2)


def held_point(
    z: mi.Point3f, m: mi.Point3f, n: mi.Vector3f, ω: mi.Vector3f, far: mi.Float, active: mi.Bool
) -> mi.Point3f:
    """The point that is held as z sees it: the material point m, or close to z the one in the direction ω, on the
    plane with the normal n."""
    slid = z + ω * (dr.dot(m - z, n) / dr.select(active, dr.dot(ω, n), 1))
    return dr.lerp(slid, m, far)


def _held_by_veil(
    z: mi.Point3f,
    m: mi.Point3f,
    n: mi.Vector3f,
    join: Join,
    vicinity: Vicinity,
    held: mi.Point3f,
    active: mi.Bool,
) -> mi.Point3f:
    """`held_point`, but where a veil is before the point: the point that z sees through what is held on the veil."""
    veiled = join.veiled
    active = active & (veiled.count > 0)
    on_veil = material_point(veiled.ray, veiled.first, active)
    far = vicinity.far(dr.square(veiled.first.t))
    d = held_point(z, on_veil.p, dr.detach(on_veil.n), join.ω, far, active) - z
    seen = z + d * (dr.dot(m - z, n) / dr.select(active, dr.dot(d, n), 1))
    return dr.select(active, seen, held)


@dataclass
class _OnLight:
    """The random numbers of a point on a light."""

    choice: mi.Float
    numbers: mi.Point2f
