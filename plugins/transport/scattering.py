"""Light that a surface scatters: direct illumination, and the next vertex of the path, attached to what moves."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.crease import Directions
from rimlight.edge_sampling.choice.bent_lamps import BentLamps
from rimlight.edge_sampling.choice.light_choice import ChosenLight, LightChoice
from rimlight.edge_sampling.choice.sampling import power_heuristic
from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.geometry.meshes import objects_below, surfaces
from rimlight.edge_sampling.parametrisation import Connection, Division, Parametrisation, Vicinity, shown_by_mirror
from rimlight.edge_sampling.rays import spawn_ray, spawn_ray_to_light

from .matt import MattDirections, turning


@dataclass
class Next:
    """The next vertex of a path, in the direction that was sampled from the BSDF.

    ray, pi : the ray to it, and what that meets. Detached.
    weight : throughput, mi.Spectrum; attached where wanted.
    η : relative index of refraction along the ray.
    matters : mi.Bool, does light from there matter?
    through : mi.Bool, does the ray go on as if nothing was there?
    mirrored : mi.Bool, is its direction that of a perfect mirror, or of a smooth glass?
    slides : mi.Bool, is its direction held, however far it is?
    moving : the same ray, as it moves with the surface; attached where wanted. Only given where the next vertex slides.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    weight: mi.Spectrum
    η: mi.Float
    matters: mi.Bool
    through: mi.Bool
    mirrored: mi.Bool
    slides: mi.Bool
    moving: mi.Ray3f | None = None


@dataclass
class Numbers:
    """Random numbers of one vertex: for a point on a light, a lobe of the BSDF, and a direction."""

    light: mi.Point2f
    lobe: mi.Float
    direction: mi.Point2f


class Scattering:
    """Direct illumination by multiple importance sampling, and the next vertex of a path.

    Of a light sample, the *material point* y is held fixed, and of every next vertex (`parametrisation.py`), as far as
    they are not close. The
    estimate of a light sample is

        f(ω) |cos θ_x| Lₑ(y, −ω) · |cos θ_y| dA / r²  /  p(ω),      ω = (y − x) / r,

    where all factors but the density p follow the motion of x and y, dA by the change of the area of the triangle. The
    weights of multiple importance sampling have no derivative, but in the light of `SmoothLamps`, where they do not
    cancel.

    attached : carry gradients? Otherwise values only.
    lights : chooses one of many lights; None: Mitsuba does.
    lamps : how their light is divided; None: it is held at points of the lamps.
    brightens : may what is black become brighter? Then paths go on from there, if attached.
    """

    def __init__(
        self,
        scene: mi.Scene,
        *,
        attached: bool,
        brightens: bool = False,
        lights: LightChoice | None = None,
        lamps: DividedLight | None = None,
    ):
        self.scene, self.lights, self.lamps = scene, lights, lamps
        self.attached, self.brightens = attached, attached and brightens
        flags = [e.flags() for e in scene.emitters()]
        self.any = bool(flags)
        self.any_delta = any(f & mi.EmitterFlags.Delta for f in flags)
        self.any_hit_by_rays = any(not f & mi.EmitterFlags.Delta for f in flags)
        #: Emitters of several lights, see `rimlight.edge_sampling.lights.Lights`.
        self.several = [e for e in scene.emitters() if hasattr(e, "light_count") and e.sampling_weight() > 0]
        self.any_elsewhere = any(not f & (mi.EmitterFlags.Delta | mi.EmitterFlags.Surface) for f in flags)
        self.held, self.bent = Parametrisation(scene), BentLamps(scene)
        # The BSDFs inside of shape groups are not listed: assume the worst of an instance.
        bsdfs = [s.bsdf().flags() if s.bsdf() is not None else mi.BSDFFlags.All for s in scene.shapes()]
        self.any_mirror = any(f & mi.BSDFFlags.Delta for f in bsdfs)
        self.any_null = any(f & mi.BSDFFlags.Null for f in bsdfs)
        self.by_density = [mi.BSDFPtr(s.bsdf()) for s in surfaces(scene) if s.bsdf() and divides_by_density(s.bsdf())]
        #: Does it matter from where a surface is looked at?
        self.directional = any(f & (mi.BSDFFlags.Delta | mi.BSDFFlags.Glossy) for f in bsdfs)
        self.transmits = any(f & mi.BSDFFlags.Transmission for f in bsdfs)
        #: Shapes at whose points the cosine of a direction may change where it is 0.
        self.turning = turning(scene) if attached else []

    def draw(self, sampler: mi.Sampler, active: mi.Bool) -> Numbers:
        light = sampler.next_2d(active) if self.any else mi.Point2f(0)
        return Numbers(light, sampler.next_1d(active), sampler.next_2d(active))

    def scatter(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        numbers: Numbers,
        active: mi.Bool,
        vicinity: Vicinity | None = None,
        met: mi.PreliminaryIntersection3f | None = None,
        directions: Directions | MattDirections | None = None,
    ) -> tuple[mi.Spectrum, Next]:
        """Direct illumination that `si` reflects, and the next vertex.

        vicinity : in which that slides; None: it is a material point.
        met : what the ray to it meets, if that is known.
        directions : where it is active, directions are sampled from there, and only what comes from a lune is found.
            None: as `directions_of` has it.
        """
        directions = self.directions_of(si, bsdf, active) if directions is None else directions
        chosen = self._choose(si, numbers, active)
        from_emitter = self.sample_emitter(si, bsdf, numbers.light, active, directions, chosen) if self.any else 0
        from_bsdf, onwards = self.sample_bsdf(si, bsdf, numbers, active, vicinity, met, directions, chosen)
        with dr.resume_grad(when=self.attached):
            return from_bsdf + from_emitter, onwards

    def directions_of(self, si, bsdf: mi.BSDFPtr, active: mi.Bool) -> MattDirections | None:
        """In which directions to go on from surfaces, for a derivative. None: in those that the BSDF samples."""
        return MattDirections.above(si, bsdf, self.turning, active) if self.turning else None

    def _choose(self, si, numbers: Numbers, active) -> ChosenLight | None:
        """The light of a light sample; None: it is Mitsuba that chooses."""
        if self.lights is None:
            return None
        at = dr.detach(si)
        facing = mi.Vector3f(0) if self.transmits else at.n * dr.sign(dr.dot(at.n, at.to_world(at.wi)))
        return self.lights.choose(at.p, mi.Vector3f(facing), numbers.light.x, active)

    def sample_emitter(
        self,
        si,
        bsdf,
        sample: mi.Point2f,
        active,
        directions: Directions | MattDirections | None = None,
        chosen: ChosenLight | None = None,
    ):
        """Radiance reflected at `si` by a sampled light: mi.Spectrum, (N,). directions : see `scatter`. chosen : which
        light."""

        if not len(self.bent):
            if chosen is None:
                found = lambda active: self.scene.sample_emitter_direction(si, sample, False, active)
            else:
                found = lambda active: _of(chosen.emitter, si, mi.Point2f(chosen.left, sample.y), chosen.p, active)
            return self.reflect(si, bsdf, found, active, directions)
        with dr.suspend_grad():
            if chosen is None:
                index, over_p, left = self.scene.sample_emitter(sample.x, active)
                emitter = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index, active)
                p = dr.rcp(over_p)
            else:
                emitter, p, left = chosen.emitter, chosen.p, chosen.left
            at = dr.detach(si)
            look = lambda u, active: _of(emitter, at, u, mi.Float(1), active)[1]
            u, factor = self.bent.resample(emitter, look, mi.Point2f(left, sample.y), active)
        L = self.reflect(si, bsdf, lambda active: _of(emitter, si, u, p, active), active, directions)
        with dr.resume_grad(when=self.attached):
            return L * factor

    def reflect(self, si, bsdf, towards_light, active, directions: Directions | MattDirections | None = None):
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
            direction, attached, visible, to_lamp = self.attach_light(si, ds, towards_light, active)
            active &= visible
            with dr.resume_grad():
                weight = dr.replace_grad(weight, attached)
        with dr.resume_grad(when=self.attached):
            f, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direction), active)
            if directions is not None:
                pdf = dr.select(directions.active, directions.pdf(direction), pdf)
                # What comes from elsewhere is the same on both sides of an edge, unless a texture jumps there, too.
                active &= ~directions.active | (pdf > 0)
            mis = power_heuristic(ds.pdf, pdf)
            if len(self.held.smooth_lamps) and to_lamp is not None:
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
        active &= ~self.scene.ray_test(spawn_ray_to_light(self.scene, si, ds), active)
        with dr.resume_grad(when=self.attached):
            return dr.select(active, L, 0)

    def attach_light(self, si, ds, towards_light, active):
        """Direction to a point of a light, or to one at infinity, what arrives from there over `ds.pdf`, whether it is
        visible, and what joins it to `si`.

        ds : the light as `si` sees it. towards_light : see `reflect`; called for lights without size.
        """
        scene = self.scene
        on_surface = active & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
        # One ray answers both questions: is the light visible, and which of its triangles is y on?
        ray = spawn_ray_to_light(scene, si, ds)
        before = mi.Float(ray.maxt)
        ray.maxt = dr.select(on_surface, 2 * dr.norm(ds.p - ray.o) - ray.maxt, ray.maxt)
        pi = scene.ray_intersect_preliminary(ray, active=active)
        visible = dr.select(on_surface, pi.is_valid() & (pi.t >= before), ~pi.is_valid())
        with dr.resume_grad():
            to_lamp = self.held.connect(si, pi, ray, on_surface & visible, by_light=True)
            elsewhere, change = ds.d, mi.Float(1)
            if self.lamps is not None:
                division = self.lamps.at(self.lamps.turning(si, si.bsdf(), active), ds.emitter)
                to_lamp = to_lamp.sliding(si, ray.d, division, on_surface & visible)
                elsewhere, change = division.at_infinity(ds.d)
            y = to_lamp.y
            direction = dr.select(on_surface, to_lamp.ω, elsewhere)
            # Lights at infinity: the direction is fixed.
            attached = y.emitter(scene).eval(y, on_surface & visible) * (to_lamp.geometry / ds.pdf)
            if self.any_elsewhere:
                # By `eval`: the `eval_direction` of `envmap` does not notice that the environment turns (Mitsuba 3.9).
                seen = dr.zeros(mi.SurfaceInteraction3f, dr.width(ds.d))
                seen.wi, seen.wavelengths, seen.time = -elsewhere, si.wavelengths, si.time
                from_there = ds.emitter.eval(seen, active & ~on_surface & ~ds.delta) * (change / ds.pdf)
                attached = dr.select(on_surface, attached, from_there)
            if self.any_delta or self.several:
                # A point of a disc follows it.
                follows = ds.delta | self._of_several(ds.emitter)
                moved, at_moved = towards_light(active & follows)
                direction = dr.select(follows, moved.d, direction)
                attached = dr.select(follows, at_moved, attached)
            return direction, attached, visible, to_lamp

    def sample_bsdf(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        numbers: Numbers,
        active: mi.Bool,
        vicinity: Vicinity | None = None,
        met: mi.PreliminaryIntersection3f | None = None,
        directions: Directions | MattDirections | None = None,
        chosen: ChosenLight | None = None,
    ) -> tuple[mi.Spectrum, Next]:
        """Emitted light that `si` reflects from a direction sampled from the BSDF: mi.Spectrum, (N,); and the next
        vertex. The arguments are those of `scatter`. chosen : the light of the light sample there."""
        scene, context = self.scene, mi.BSDFContext()
        bs, onwards = next_vertex(scene, si, bsdf, numbers, active, vicinity, met, directions, self.brightens)
        ray, pi, weight, mirrored = onwards.ray, onwards.pi, onwards.weight, onwards.mirrored
        active = active & onwards.matters
        if not self.attached:
            y = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        else:
            with dr.resume_grad():
                to_y, ω, attached, scattered = self.throughput(si, bsdf, ray, pi, bs.pdf, vicinity, active, ~mirrored)
                y = to_y.y
                if vicinity is not None:
                    onwards.moving = mi.Ray3f(ray)
                    onwards.moving.o = dr.replace_grad(ray.o, si.p)
                if self.any_mirror:
                    # A mirror turns its ray with it: what that meets slides over the light.
                    wo, at_mirror = self.mirror(si, bsdf, numbers.lobe, numbers.direction, active & mirrored)
                    y = dr.select(mirrored, shown_by_mirror(scene, si, wo, ray, pi, active & mirrored), y)
                    attached, scattered = (dr.select(mirrored, at_mirror, x) for x in (attached, scattered))
                    if vicinity is not None:
                        d = dr.select(mirrored & active, si.to_world(wo), ray.d)
                        onwards.moving.d = dr.replace_grad(ray.d, d)
                onwards.weight = dr.replace_grad(weight, dr.select(active, scattered, 0))
                weight = dr.replace_grad(weight, dr.select(active, attached, 0))
        if not self.any_hit_by_rays:
            return mi.Spectrum(0), onwards
        emitter = y.emitter(scene, active)
        ds = mi.DirectionSample3f(scene, y, si)
        pdf = self.pdf_direction(si, ds, active & ~mirrored & (emitter != None), chosen)  # noqa: E711
        with dr.resume_grad(when=self.attached):
            mis = power_heuristic(bs.pdf, pdf)
            if len(self.held.smooth_lamps) and self.attached:
                p = bsdf.pdf(context, si, si.to_local(ω), active & ~mirrored)
                p = dr.select(directions.active, directions.pdf(ω), p) if directions is not None else p
                mis = to_y.attach(mis, p, pdf, by_light=False)
            mis = dr.select(mirrored, 1, mis)
            Le = dr.select(active, weight * self._emission(emitter, y, mirrored, active) * mis, 0)
        return Le, onwards

    def mirror(self, si, bsdf, lobe: mi.Float, direction: mi.Point2f, active) -> tuple[mi.Vector3f, mi.Spectrum]:
        """Where a perfect mirror or smooth glass sends a path, in the frame of `si`, and what it scatters from there
        over its probability, of which only the value is divided by. lobe, direction : random numbers."""
        turned, at_mirror = bsdf.sample(mi.BSDFContext(), si, lobe, direction, active)
        wrong = mi.Bool(False)
        for other in self.by_density:
            wrong |= bsdf == other
        p = dr.detach(turned.pdf)
        return turned.wo, at_mirror * dr.select(wrong & (p > 0), turned.pdf / dr.select(p > 0, p, 1), 1)

    def throughput(
        self,
        si,
        bsdf,
        ray: mi.Ray3f,
        pi: mi.PreliminaryIntersection3f,
        pdf: mi.Float,
        vicinity: Vicinity | None,
        active,
        rough: mi.Bool,
    ) -> tuple[Connection, mi.Vector3f, mi.Spectrum, mi.Spectrum]:
        """What joins `si` to the surface that a ray from there meets, the direction to it, and the light scattered from
        there over a density: if it is a point of a lamp, and as it moves in the vicinity.

        rough : mi.Bool, is the BSDF evaluated? Else all of this is zero.
        """
        on_surface = active & pi.is_valid()
        to_y = to_lamp = self.held.connect(si, pi, ray, on_surface, by_light=False)
        elsewhere, change = ray.d, mi.Float(1)
        if self.lamps is not None:
            emitter = to_y.y.emitter(self.scene, active)
            division = self.lamps.at(self.lamps.turning(si, bsdf, active & rough), emitter)
            to_lamp = to_y.sliding(si, ray.d, division, on_surface & rough)
            elsewhere, change = division.at_infinity(ray.d)
            to_lamp.y.wi = dr.select(on_surface, to_lamp.y.wi, dr.replace_grad(to_lamp.y.wi, -elsewhere))
        joined = [(to_lamp, elsewhere, change)]
        if vicinity is not None:
            near = Division(vicinity.around(bsdf))
            joined.append((to_y.sliding(si, ray.d, near, on_surface & rough), ray.d, mi.Float(1)))
        weights = []
        for to, elsewhere, change in joined:
            ω = dr.select(on_surface, to.ω, elsewhere)
            f = bsdf.eval(mi.BSDFContext(), si, si.to_local(ω), active & rough)
            f *= dr.select(on_surface, to.geometry, change) / pdf
            weights.append(dr.select(to.still, dr.detach(f), f))
        return to_lamp, dr.select(on_surface, to_lamp.ω, ray.d), weights[0], weights[-1]

    def stops(self, ray, pi, sampler, active) -> mi.Bool:
        """Does a ray meet a surface that it does not go through as if nothing was there?"""
        active = active & pi.is_valid()
        if not self.any_null:
            return active
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        numbers = sampler.next_1d(active), sampler.next_2d(active)
        bs, _ = si.bsdf(ray).sample(mi.BSDFContext(), si, *numbers, active)
        return active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)

    def pdf_direction(self, si, ds, active, chosen: ChosenLight | None) -> mi.Float:
        """Density with which `ds` would have been sampled as a light."""
        if chosen is None:
            return self.scene.pdf_emitter_direction(si, ds, active)
        return ds.emitter.pdf_direction(si, ds, active) * self.lights.probability(ds.emitter, chosen)

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


def _of(emitter: mi.EmitterPtr, si, u: mi.Point2f, p: mi.Float, active) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """A light sample, and the light over its density: of emitters that were chosen with the probability p."""
    ds, weight = emitter.sample_direction(si, u, active)
    ds.pdf *= p
    return ds, weight / p


def next_vertex(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    numbers: Numbers,
    active: mi.Bool,
    vicinity: Vicinity | None = None,
    met: mi.PreliminaryIntersection3f | None = None,
    directions: Directions | MattDirections | None = None,
    brightens: bool = False,
) -> tuple[mi.BSDFSample3f, Next]:
    """A direction sampled from the BSDF, and the vertex there. Detached.

    vicinity : in which that slides.
    met : what the ray to it meets, if that is known.
    directions : where it is active, the direction is sampled from there. The BSDF has no perfect reflection, and lets
        nothing through.
    brightens : see `Scattering`.
    """
    bs, weight = bsdf.sample(mi.BSDFContext(), si, numbers.lobe, numbers.direction, active)
    if directions is not None:
        ω, pdf = directions.sample(numbers.lobe, numbers.direction)
        bs.wo, bs.pdf = dr.select(directions.active, si.to_local(ω), bs.wo), dr.select(directions.active, pdf, bs.pdf)
        there = bsdf.eval(mi.BSDFContext(), si, bs.wo, active & directions.active) / pdf
        weight = dr.select(directions.active, there, weight)
        bs.sampled_type = dr.select(directions.active, 0, bs.sampled_type)
    matters = dr.any(weight != 0) | (brightens & (bs.pdf > 0))
    active = active & matters
    through, mirrored = (mi.has_flag(bs.sampled_type, f) for f in (mi.BSDFFlags.Null, mi.BSDFFlags.Delta))
    ray = spawn_ray(scene, si, si.to_world(bs.wo), through)
    pi = scene.ray_intersect_preliminary(ray, active=active) if met is None else met
    slides = mirrored if vicinity is None else mirrored | vicinity.is_infinite(bsdf)
    return bs, Next(ray, pi, weight, bs.eta, matters, active & through, mirrored, slides)


def divides_by_density(bsdf: mi.BSDF) -> bool:
    """Must the weight f / p of a perfect reflection be multiplied by its attached probability p, over the present p, to
    have the gradient of f? (In Mitsuba 3.9, the weights of other BSDFs have that already.)"""
    if not bsdf.flags() & mi.BSDFFlags.Delta:
        return False
    if bsdf.class_name() == "TwoSidedBRDF":
        return any(divides_by_density(b) for b in objects_below(bsdf).values() if isinstance(b, mi.BSDF) and b != bsdf)
    return bsdf.class_name() in ("SmoothPlastic", "ThinDielectric")
