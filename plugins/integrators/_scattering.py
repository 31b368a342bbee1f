"""Light that a surface scatters: direct illumination, and the next vertex of the path, attached to what moves."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from rimlight.edge_sampling import Horizon, SmoothLamps
from rimlight.edge_sampling.device_edges import rounding

from ._limits import divides_by_density


@dataclass
class Next:
    """The next vertex of a path, in the direction that was sampled from the BSDF.

    ray, pi : the ray to it, and what that meets. Detached.
    weight : throughput, mi.Spectrum; attached where wanted.
    η : relative index of refraction along the ray.
    through : mi.Bool, does the ray go on as if nothing was there?
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    weight: mi.Spectrum
    η: mi.Float
    through: mi.Bool


@dataclass
class Connection:
    """What joins a point to a material point y that a ray from there meets. Attached.

    y : mi.SurfaceInteraction3f.
    ω : mi.Vector3f, the direction to it.
    geometry : mi.Float, |cos θ_y| dA / r², relative to its present value.
    still : mi.Bool, is all of this taken to stand still, since rounding would make its derivative? Then it is detached.
    smooth : mi.Bool, is y on one of the `SmoothLamps`, and does not stand still?
    spread : mi.Float, if so: the solid angle of an element of area there, as light samples reckon it, relative to its
        present value.
    """

    y: mi.SurfaceInteraction3f
    ω: mi.Vector3f
    geometry: mi.Float
    still: mi.Bool
    smooth: mi.Bool
    spread: mi.Float

    def attach(self, weight: mi.Float, p: mi.Float, q: mi.Float, *, by_light: bool) -> mi.Float:
        """Attach a weight of multiple importance sampling where y is on one of the `SmoothLamps`.

        p, q : the densities of which it is made, that of light samples detached. by_light : is that p, or q?
        """
        attached = self.smooth & (self.spread > 0) & (p > 0) & dr.isfinite(p) & dr.isfinite(q)
        spread = dr.select(attached, self.spread, 1)
        ratio = dr.select(attached, q, 0) / dr.select(attached, p, 1) * (spread if by_light else dr.rcp(spread))
        return dr.select(attached, dr.replace_grad(weight, dr.rcp(1 + dr.square(ratio))), weight)


class Scattering:
    """Direct illumination by multiple importance sampling, and the next vertex of a path.

    Of a light sample, the *material point* y is held fixed. With the solid angle written as area,
    dω = |cos θ_y| dA(y) / r², its estimate is

        f(ω) |cos θ_x| Lₑ(y, −ω) · |cos θ_y| dA / r²  /  p(ω),      ω = (y − x) / r,

    where all factors but the density p follow the motion of x and y, dA by the change of the area of the triangle. The
    same holds for every next vertex of a path (Zhang et al. 2020). So what moves together sees no motion at all. The
    weights of multiple importance sampling have no derivative, but in the light of `SmoothLamps`, where they do not
    cancel.

    attached : carry gradients? Otherwise values only.
    """

    def __init__(self, scene: mi.Scene, *, attached: bool):
        self.scene = scene
        self.attached = attached
        flags = [e.flags() for e in scene.emitters()]
        self.any = bool(flags)
        self.any_delta = any(f & mi.EmitterFlags.Delta for f in flags)
        self.any_hit_by_rays = any(not f & mi.EmitterFlags.Delta for f in flags)
        #: Emitters of several lights, see `rimlight.edge_sampling.lights.Lights`.
        self.several = [e for e in scene.emitters() if hasattr(e, "light_count") and e.sampling_weight() > 0]
        self.any_elsewhere = any(not f & (mi.EmitterFlags.Delta | mi.EmitterFlags.Surface) for f in flags)
        self.moving = [(mi.ShapePtr(s), s.is_mesh()) for s in scene.shapes() if s.parameters_grad_enabled()]
        self.any_curved = any(not s.is_mesh() for s in scene.shapes())
        # The BSDFs inside of shape groups are not listed: assume the worst of an instance.
        bsdfs = [s.bsdf().flags() if s.bsdf() is not None else mi.BSDFFlags.All for s in scene.shapes()]
        self.any_mirror = any(f & mi.BSDFFlags.Delta for f in bsdfs)
        self.any_null = any(f & mi.BSDFFlags.Null for f in bsdfs)
        self.smooth_lamps = SmoothLamps(scene)
        self.by_density = [mi.BSDFPtr(s.bsdf()) for s in scene.shapes() if s.bsdf() and divides_by_density(s.bsdf())]
        #: Does it matter from where a surface is looked at?
        self.directional = any(f & (mi.BSDFFlags.Delta | mi.BSDFFlags.Glossy) for f in bsdfs)

    def scatter(self, si, bsdf, sampler, active) -> tuple[mi.Spectrum, Next | None]:
        """Direct illumination that `si` reflects, and the next vertex."""
        from_emitter = self.sample_emitter(si, bsdf, sampler, active) if self.any else 0
        from_bsdf, onwards = self.sample_bsdf(si, bsdf, sampler, active)
        with dr.resume_grad(when=self.attached):
            return from_bsdf + from_emitter, onwards

    def sample_emitter(self, si, bsdf, sampler, active):
        """Radiance reflected at `si` by a sampled light: mi.Spectrum, (N,)."""
        sample = sampler.next_2d(active)
        towards_light = lambda active: self.scene.sample_emitter_direction(si, sample, False, active)
        return self.reflect(si, bsdf, towards_light, active)

    def reflect(self, si, bsdf, towards_light, active):
        """Radiance reflected at `si` by what `towards_light` samples: mi.Spectrum, (N,).

        towards_light : maps `active` to a direction and the light from there over its density, as Mitsuba's
            `Emitter.sample_direction` with fixed random numbers. Visibility is tested here.
        """
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        with dr.resume_grad(when=self.attached and not self.any_hit_by_rays):
            ds, weight = towards_light(active)
        active &= ds.pdf != 0
        direction, to_lamp = ds.d, None
        if self.attached and self.any_hit_by_rays:
            direction, weight, visible, to_lamp = self._attach_emitter(si, ds, weight, towards_light, active)
            active &= visible
        with dr.resume_grad(when=self.attached):
            f, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direction), active)
            mis = mis_weight(ds.pdf, pdf)
            if len(self.smooth_lamps) and to_lamp is not None:
                mis = to_lamp.attach(mis, ds.pdf, pdf, by_light=True)
            mis = dr.select(ds.delta | self._found_by_light_samples(ds), 1, mis)
            L = dr.select(active, f * weight * mis, 0)
            if to_lamp is not None:
                L = dr.select(to_lamp.still, dr.detach(L), L)
        if not self.attached:
            active &= dr.any(L != 0)
        elif not self.any_hit_by_rays:
            active &= dr.any(f != 0) | (pdf > 0)  # what is black may still become brighter
        else:
            return L
        active &= ~self.scene.ray_test(si.spawn_ray_to(ds.p), active)
        with dr.resume_grad(when=self.attached):
            return dr.select(active, L, 0)

    def _attach_emitter(self, si, ds, weight, towards_light, active):
        """Direction and weight (Lₑ · geometry / density) of a light sample with their gradients, its visibility, and
        what joins it to `si`."""
        scene = self.scene
        on_surface = active & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
        # One ray answers both questions: is the light visible, and which of its triangles is y on?
        ray = si.spawn_ray_to(ds.p)
        before = mi.Float(ray.maxt)
        ray.maxt = dr.select(on_surface, 2 * dr.norm(ds.p - ray.o) - ray.maxt, ray.maxt)
        pi = scene.ray_intersect_preliminary(ray, active=active)
        visible = dr.select(on_surface, pi.is_valid() & (pi.t >= before), ~pi.is_valid())
        with dr.resume_grad():
            to_lamp = self._connect(si, pi, ray, on_surface & visible, by_light=True)
            y = to_lamp.y
            direction = dr.select(on_surface, to_lamp.ω, ds.d)
            # Lights at infinity: the direction is fixed.
            attached = y.emitter(scene).eval(y, on_surface & visible) * (to_lamp.geometry / ds.pdf)
            if self.any_elsewhere:
                # By `eval`: the `eval_direction` of `envmap` does not notice that the environment turns (Mitsuba 3.9).
                seen = dr.zeros(mi.SurfaceInteraction3f, dr.width(ds.d))
                seen.wi, seen.wavelengths, seen.time = -ds.d, si.wavelengths, si.time
                elsewhere = ds.emitter.eval(seen, active & ~on_surface & ~ds.delta) / ds.pdf
                attached = dr.select(on_surface, attached, elsewhere)
            if self.any_delta or self.several:
                # A point of a disc follows it.
                follows = ds.delta | self._of_several(ds.emitter)
                moved, at_moved = towards_light(active & follows)
                direction = dr.select(follows, moved.d, direction)
                attached = dr.select(follows, at_moved, attached)
            return direction, dr.replace_grad(weight, attached), visible, to_lamp

    def sample_bsdf(self, si, bsdf, sampler, active):
        """Emitted light that `si` reflects from a direction sampled from the BSDF: mi.Spectrum, (N,); and the next
        vertex."""
        scene, context = self.scene, mi.BSDFContext()
        sample1, sample2 = sampler.next_1d(active), sampler.next_2d(active)
        bs, weight = bsdf.sample(context, si, sample1, sample2, active)
        active = active & dr.any(weight != 0)
        mirrored = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, active=active)
        if not self.attached:
            y = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        else:
            with dr.resume_grad():
                on_surface = active & pi.is_valid()
                to_y = self._connect(si, pi, ray, on_surface, by_light=False)
                y = to_y.y
                ω = dr.select(on_surface, to_y.ω, ray.d)
                f = bsdf.eval(context, si, si.to_local(ω), active & ~mirrored)
                attached = f * (dr.select(on_surface, to_y.geometry, 1) / bs.pdf)
                attached = dr.select(to_y.still, dr.detach(attached), attached)
                if self.any_mirror:
                    # A mirror turns its ray with it: what that meets slides over the light.
                    turned, at_mirror = bsdf.sample(context, si, sample1, sample2, active & mirrored)
                    wrong = mi.Bool(False)
                    for other in self.by_density:
                        wrong |= bsdf == other
                    p = dr.detach(turned.pdf)
                    at_mirror *= dr.select(wrong & (p > 0), turned.pdf / dr.select(p > 0, p, 1), 1)
                    onwards_turned = mi.Ray3f(ray)
                    onwards_turned.o, onwards_turned.d = si.p, si.to_world(turned.wo)
                    slid = pi.compute_surface_interaction(onwards_turned, mi.RayFlags.All, active & mirrored)
                    y = dr.select(mirrored, slid, y)
                    attached = dr.select(mirrored, at_mirror, attached)
                weight = dr.replace_grad(weight, dr.select(active, attached, 0))
        through = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        if not self.any_hit_by_rays:
            return mi.Spectrum(0), Next(ray, pi, weight, bs.eta, through)
        emitter = y.emitter(scene, active)
        ds = mi.DirectionSample3f(scene, y, si)
        pdf = self.pdf_direction(si, ds, active & ~mirrored & (emitter != None))  # noqa: E711
        with dr.resume_grad(when=self.attached):
            mis = mis_weight(bs.pdf, pdf)
            if len(self.smooth_lamps) and self.attached:
                bsdf_pdf = bsdf.pdf(context, si, si.to_local(ω), active & ~mirrored)
                mis = to_y.attach(mis, bsdf_pdf, pdf, by_light=False)
            mis = dr.select(mirrored, 1, mis)
            Le = dr.select(active, weight * self._emission(emitter, y, mirrored, active) * mis, 0)
        return Le, Next(ray, pi, weight, bs.eta, through)

    def stops(self, ray, pi, sampler, active) -> mi.Bool:
        """Does a ray meet a surface that it does not go through as if nothing was there?"""
        active = active & pi.is_valid()
        if not self.any_null:
            return active
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        numbers = sampler.next_1d(active), sampler.next_2d(active)
        bs, _ = si.bsdf(ray).sample(mi.BSDFContext(), si, *numbers, active)
        return active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)

    def pdf_direction(self, si, ds, active) -> mi.Float:
        """Density with which `ds` would have been sampled as a light."""
        return self.scene.pdf_emitter_direction(si, ds, active)

    # ---------------------- Emitters of several lights ----------------------

    # Discs that overlap move apart: a direction that was sampled from the BSDF cannot follow both. So discs are left to
    # light samples, wherever these are possible, in values and derivatives alike.

    def _of_several(self, emitter: mi.EmitterPtr) -> mi.Bool:
        found = mi.Bool(False)
        for several in self.several:
            found |= emitter == mi.EmitterPtr(several)
        return found

    def _found_by_light_samples(self, ds: mi.DirectionSample3f) -> mi.Bool:
        """Is a light sample the only way to its light?"""
        found = mi.Bool(False)
        for several in self.several:
            found |= several.of_light(ds)
        return found

    def _emission(self, emitter, y, mirrored, active) -> mi.Spectrum:
        """What the BSDF sample sees at y."""
        without = active & self._of_several(emitter) & ~mirrored
        L = emitter.eval(y, active & ~without)
        for several in self.several:
            mine = without & (emitter == mi.EmitterPtr(several))
            L = dr.select(mine, several.eval_background(y, mine), L)
        return L

    def _connect(self, si, pi, ray, active, *, by_light: bool) -> Connection:
        """What joins `si` to the material point that `pi` stands for, found by a sample of a light or of the BSDF."""
        y = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
        d = y.p - si.p
        r2 = dr.squared_norm(d)
        ω = d * dr.rsqrt(r2)
        # A ray that meets nothing keeps its direction.
        y.wi = dr.select(active, dr.replace_grad(y.wi, y.to_local(-ω)), y.wi)
        cos, smooth, spread = dr.abs_dot(y.n, ω), mi.Bool(False), mi.Float(1)
        if len(self.smooth_lamps):
            smooth, shading_cos = self.smooth_lamps.are(pi.shape), dr.abs_dot(y.sh_frame.n, ω)
            spread = _relative(shading_cos / r2)  # 0 only where nothing is emitted
            if by_light:
                cos = dr.select(smooth, shading_cos, cos)
        geometry = cos / r2
        if self.moving:
            geometry *= self._area(pi, ray, active)
        geometry = _relative(geometry)
        still = active & flush(si, y)
        fixed = still | grazes(y, ω, active) if self.any_curved else still
        y, ω = dr.select(still, dr.detach(y), y), dr.select(still, dr.detach(ω), ω)
        return Connection(y, ω, dr.select(fixed, dr.detach(geometry), geometry), still, smooth & ~still, spread)

    def _area(self, pi, ray, active):
        """What an area element on the shapes hit is proportional to, attached; 1 where they do not move."""
        on_mesh, on_other = mi.Bool(False), mi.Bool(False)
        for shape, is_mesh in self.moving:
            on_mesh |= is_mesh & (pi.shape == shape)
            on_other |= (not is_mesh) & (pi.shape == shape)
        on_mesh, on_other = on_mesh & active, on_other & active
        # Of a triangle, twice its area.
        corners = []
        for u, v in ((0, 0), (1, 0), (0, 1)):
            corner = mi.PreliminaryIntersection3f(pi)
            corner.prim_uv = mi.Point2f(u, v)
            flags = mi.RayFlags.Minimal | mi.RayFlags.FollowShape
            corners.append(corner.compute_surface_interaction(ray, flags, on_mesh).p)
        area = dr.select(on_mesh, dr.norm(dr.cross(corners[1] - corners[0], corners[2] - corners[0])), 1)
        if all(is_mesh for _, is_mesh in self.moving):
            return area
        si = pi.compute_surface_interaction(ray, mi.RayFlags.dPdUV | mi.RayFlags.FollowShape, on_other)
        return dr.select(on_other, dr.norm(dr.cross(si.dp_du, si.dp_dv)), area)


def _relative(x: mi.Float) -> mi.Float:
    """A number over its present value; 0 where that is 0."""
    now = dr.detach(x)
    return dr.select(now > 0, x / dr.select(now > 0, now, 1), 0)


#: Cosine below which a surface that is no mesh is taken to stand still. Where a fixed ray meets a curved one, and the
#: solid angle that an element of it covers, change as 1 / cos; single precision does not know cosines of 1e-4, and
#: single samples would outweigh all others. The loss is of this order, relative to what the surface itself contributes.
GRAZING = 1e-3


def flush(x: mi.SurfaceInteraction3f, y: mi.SurfaceInteraction3f) -> mi.Bool:
    """Does y lie in the tangent plane at x, or x in that at y, as far as single precision can tell?

    So do points of one face, and points close to each other on one curved surface: one does not light the other, but
    the cosine between them is what rounding makes it, and its derivative relative to that is arbitrarily large.
    """
    with dr.suspend_grad():
        d = y.p - x.p
        scale = dr.max(dr.maximum(dr.abs(x.p), dr.abs(y.p)))
        height = dr.minimum(dr.abs_dot(x.n, d), dr.abs_dot(y.n, d))
        return height <= FLUSH * dr.epsilon(mi.Float) * scale


#: Height over a tangent plane that is taken for rounding, in units in the last place of the coordinates.
FLUSH = 16


def grazes(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Bool:
    """Is a curved surface met almost along a tangent?"""
    return active & si.is_valid() & ~si.shape.is_mesh() & (dr.abs_dot(dr.detach(si.n), dr.detach(direction)) < GRAZING)


def met_by(
    ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, flags: mi.RayFlags, active: mi.Bool, attached: bool
) -> mi.SurfaceInteraction3f:
    """The surface that a ray meets; with all its derivatives but where it is curved, and seen edge-on."""
    with dr.resume_grad(when=attached):
        si = pi.compute_surface_interaction(ray, flags, active)
        if attached:
            si = dr.select(grazes(si, ray.d, active), dr.detach(si), si)
        return si


def turn_to_side(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, horizon: Horizon) -> None:
    """Turn interpolated normals that lie on the horizon of the viewer, but for rounding, to a side of it.

    Does nothing to what hides the point of the horizon, nor, beside edges, to normals that face the right side.
    """
    to_viewer = -ray.d
    cos = dr.dot(si.sh_frame.n, to_viewer)
    there = dr.abs_dot(si.n, horizon.p - si.p) <= rounding(horizon.p, ray.o)
    turn = there & si.is_valid() & (horizon.side != 0) & (horizon.on_curve | (horizon.side * cos <= 0))
    n = dr.normalize(si.sh_frame.n + (horizon.side * BESIDE_HORIZON - cos) * to_viewer)
    si.sh_frame.n = dr.select(turn, n, si.sh_frame.n)
    si.initialize_sh_frame()
    si.wi = dr.select(turn, si.to_local(to_viewer), si.wi)


#: Cosine to the viewer of a normal just beside the horizon.
BESIDE_HORIZON = 1e-4
