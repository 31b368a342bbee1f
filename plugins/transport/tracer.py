"""The one object that traces paths: for the interior term, and for the sides of boundaries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.crease import Directions
from rimlight.edge_sampling.boundaries.fine_mirrors import FineMirrors
from rimlight.edge_sampling.boundaries.horizon import Horizon, turn_to_side, turn_to_viewer
from rimlight.edge_sampling.boundaries.tracer import ShadingPoint
from rimlight.edge_sampling.boundaries.veils import Before
from rimlight.edge_sampling.choice.light_choice import LightChoice
from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.first_points import FirstPoints, seen_by_camera
from rimlight.edge_sampling.parametrisation import Slides, Vicinity
from rimlight.edge_sampling.rays import spawn_ray

from .paths import Depths, Vertex, scattered_light
from .replay import MovingVertex, Replay, Start
from .scattering import Scattering
from .walk import Walk


@dataclass
class Radiance:
    """Light along camera rays.

    L : mi.Spectrum, (N,). Where it is attached, only what the first vertex reflects directly.
    valid : mi.Bool, (N,); does the ray meet a surface, or a visible environment? The alpha channel.
    rest : None, or what differentiates the light that arrives by further vertices.
    """

    L: mi.Spectrum
    valid: mi.Bool
    rest: Replay | None = None


class PathTracer:
    """Traces the paths of an integrator in a scene. Call it with gradients suspended: it resumes them where they
    belong.

    integrator : tells `depths` and `hide_emitters`.
    """

    #: See `Vicinity`.
    slides = Slides.NOTHING

    #: See `Scattering`.
    lights: LightChoice | None = None
    lamps: DividedLight | None = None

    #: What is held where the camera sees it; None: nothing.
    held: FirstPoints | None = None

    #: See `Scattering`.
    brightens = False

    #: The shapes that move, where nothing else does; None: all are taken to do so.
    moving: Sequence[mi.ShapePtr] | None = None

    #: See `rimlight.edge_sampling.boundaries.tracer.Tracer`.
    shares_directions = True

    #: Whose normals are turned on the sides of boundaries: where paths are traced with detached values in a derivative.
    fine_mirrors: FineMirrors | None = None

    def __init__(self, scene: mi.Scene, integrator: mi.ad.common.ADIntegrator):
        self.scene = scene
        self.depths: Depths = integrator.depths
        self.hide_emitters: bool = integrator.hide_emitters

    def scatters(self, depth: mi.UInt32 | int) -> mi.Bool | bool:
        """May a vertex of this number reflect direct light?"""
        return self.depths.scatters(depth)

    # ---------------------- From the camera ----------------------

    def radiance(
        self,
        ray: mi.Ray3f,
        sampler: mi.Sampler,
        active: mi.Bool,
        *,
        attached: bool,
        horizon: Horizon | None = None,
        directions: Directions | None = None,
        pi: mi.PreliminaryIntersection3f | None = None,
        stretch: mi.Float | float = 1.0,
        before: Before | None = None,
    ) -> Radiance:
        """Estimate the radiance along camera rays.

        before : what veils before it scatter is left out; None: nothing is.
        pi : their first hits, if these are known. stretch : see `FirstPoints.stretch`.
        horizon : on which side of the horizon of interpolated normals the first hit is; None: as it is.
        directions : see `Scattering.scatter`, for the first hit.
        """
        scene = self.scene
        active = active & (self.depths.max_depth > 0)
        L = mi.Spectrum(0)

        # ---------------------- First hit ----------------------

        pi = self.first_hit(ray, active) if pi is None else pi
        si = seen_by_camera(scene, ray, pi, active, attached=attached, held=self.held)
        if horizon is not None:
            turn_to_side(si, ray, horizon)
        if self.fine_mirrors is not None and not attached:
            self.fine_mirrors.turn(si, ray, active)
        with dr.resume_grad(when=attached):
            if not self.hide_emitters:
                L += si.emitter(scene).eval(si, active) * stretch
        bsdf = si.bsdf(ray)
        backdrop = active & (scene.environment() is not None and not self.hide_emitters)
        active &= si.is_valid()
        chosen = {"lights": self.lights, "lamps": self.lamps, "brightens": self.brightens}
        scattering = Scattering(scene, attached=attached, **chosen)
        if not self.scatters(1):
            return Radiance(L, backdrop | scattering.stops(ray, pi, sampler, active))

        # ---------------------- Light that it scatters ----------------------

        vicinity = Vicinity.of(pi, self.slides) if attached and self.scatters(2) else None
        there, veiled = directions, None
        if before is not None:
            veiled = before.veils(si, ray)
            there = directions.where(~veiled) if directions is not None else None
        direct, onwards = scattering.scatter(
            si, bsdf, scattering.draw(sampler, active), active, vicinity, directions=there
        )
        if before is not None:
            lost = veiled & ~onwards.through
            direct, onwards.weight = (dr.select(lost, 0, v) for v in (direct, onwards.weight))
        with dr.resume_grad(when=attached):
            L += direct * stretch
        valid = backdrop | (active & ~onwards.through)
        if not self.scatters(2):
            return Radiance(L, valid | scattering.stops(onwards.ray, onwards.pi, sampler, active & onwards.through))
        β = dr.select(active, dr.detach(onwards.weight), 0)
        detached, η = dr.detach(mi.Ray3f(onwards.ray)), mi.Float(onwards.η)
        two = dr.full(mi.UInt32, 2, dr.width(pi.t))
        second = Vertex(detached, onwards.pi, two, β, η, onwards.mirrored, onwards.slides)
        if attached:
            if self.brightens:
                second.lit = dr.select(active, dr.select(β != 0, β, 1), 0)
            with dr.resume_grad():
                start = Start(onwards.moving.o, onwards.moving.d, mi.Spectrum(onwards.weight * stretch))
            return Radiance(L, valid, Replay(scene, sampler, second, start, vicinity, self.depths, active, **chosen))
        options = {"lights": self.lights}
        if before is not None:
            beyond = {"before": before, "horizon": horizon, "directions": directions}
            options |= {k: v.where(veiled & onwards.through) for k, v in beyond.items() if v is not None}
        indirect, stopped = scattered_light(scene, sampler, second, self.depths, active, **options)
        return Radiance(L + dr.select(β != 0, indirect, 0), valid | (onwards.through & stopped))

    def first_hit(self, ray: mi.Ray3f, active: mi.Bool | bool) -> mi.PreliminaryIntersection3f:
        """What camera rays meet."""
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        return self._behind_emitters(ray, pi, pi.is_valid() & active) if self.hide_emitters else pi

    def _behind_emitters(
        self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
    ) -> mi.PreliminaryIntersection3f:
        """What camera rays meet that pass through emitters, on their own line: Mitsuba's `skip_area_emitters` leaves it
        by more than the rays beside an edge are apart, and counts the distance from the last emitter."""

        def step(pi, going):
            at = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, going)
            onwards = spawn_ray(self.scene, at, ray.d, True)
            gone = dr.dot(onwards.o - ray.o, ray.d)
            onwards.maxt = ray.maxt - gone
            beyond = self.scene.ray_intersect_preliminary(onwards, coherent=True, active=going)
            beyond.t += gone
            pi = dr.select(going, beyond, pi)
            return pi, going & emits(pi)

        emits = lambda pi: pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (an array of pointers)
        return dr.while_loop((pi, active & emits(pi)), lambda pi, going: going, step, label="hidden emitters")[0]

    def seen(
        self,
        ray: mi.Ray3f,
        pi: mi.PreliminaryIntersection3f,
        sampler: mi.Sampler,
        active: mi.Bool,
        horizon: Horizon | None,
        directions: Directions | None,
        before: Before | None = None,
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Radiance and alpha along camera rays, detached."""
        of_side = {"horizon": horizon, "directions": directions, "pi": pi, "before": before}
        found = self.radiance(ray, sampler, active, attached=False, **of_side)
        return found.L, dr.select(found.valid, mi.Float(1), 0)

    # ---------------------- From points of a path ----------------------

    def walk(self, ray: mi.Ray3f, sampler: mi.Sampler, beyond: Sequence[int]) -> Walk | Vertex:
        """Paths along camera rays, with vertices for `point`: one for each number in `beyond`. If none reflects light
        of other surfaces: what the rays meet."""
        first = camera_vertex(ray, self.first_hit(ray, True))
        if not self.scatters(2):
            return first
        return Walk(self.scene, sampler, first, self.depths, self.slides, beyond, self.held, self.moving)

    def point(
        self, ray: mi.Ray3f, walk: Walk | Vertex, mode: dr.ADMode, *, beyond: int = 0
    ) -> tuple[ShadingPoint, MovingVertex | None]:
        """One vertex of each path at which light is scattered; and what hands its gradient on in backward mode, if that
        does not go by itself.

        ray : camera rays, attached to the camera. walk : along these.
        beyond : at least so many more vertices may follow it. If it is 0, it is known with what directions turn there.
        """
        lamps = self.lamps if beyond == 0 else None
        if not isinstance(walk, Walk):
            pi = walk.pi
            si = seen_by_camera(self.scene, ray, pi, pi.is_valid(), attached=True, held=self.held)
            no = mi.Bool(False)
            still, turning = Vicinity(mi.Float(0)), None
            if lamps is not None:
                with dr.resume_grad():
                    turning = lamps.turning(si, si.bsdf(), pi.is_valid())
            return ShadingPoint(si, walk.depth, walk.β, pi.is_valid(), no, still, mi.Float(0), turning), None
        chosen = walk.choice(beyond)
        c = walk.vertex(chosen, ray, mode, lamps)
        # Where lobes turn, it matters from where a vertex is looked at.
        moves = (c.since < c.depth) & (chosen.moved if lamps is None else True), c.vicinity
        return ShadingPoint(c.si, c.depth, chosen.β, c.active, *moves, chosen.density, c.turning), c

    def scattered(
        self, ray, pi, depth, sampler, active, beside_outline=None, directions=None, found=None, horizon=None
    ) -> mi.Spectrum:
        """Light that is scattered, by what a ray from a vertex meets, back to this vertex of number `depth`. Detached.

        ray, pi : the ray and what it meets. sampler : for the paths beyond. active : mi.Bool, (N,)
        beside_outline : mi.Bool, (N,), is it met just inside of its outline?
        directions : see `Scattering.scatter`, for what the ray meets. found : of no use here, see `Tracer`.
        horizon : on which side of the horizon of interpolated normals this is; None: as it is.
        """
        one, no = dr.full(mi.Spectrum, 1, dr.width(active)), mi.Bool(False)
        beyond = Vertex(mi.Ray3f(ray), pi, depth + 1, one, mi.Float(1), no, no)
        turned = beside_outline, directions, self.lights, self.fine_mirrors, horizon
        return scattered_light(self.scene, sampler, beyond, self.depths, active, *turned)[0]

    def arriving(
        self, vertex: Vertex, sampler: mi.Sampler, active: mi.Bool, beside_outline: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Bool]:
        """Light along the ray to a vertex of which a perfect mirror, or the camera, knows: without its β, detached; and
        does the path meet, there or farther on, a surface that it does not go through?

        beside_outline : see `scattered`.
        """
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        turn_to_viewer(si, vertex.ray, active & beside_outline)
        shines = active & ((vertex.depth > 1) | (not self.hide_emitters))
        emitted = si.emitter(self.scene).eval(si, shines)
        one = dr.full(mi.Spectrum, 1, dr.width(active))
        start = Vertex(vertex.ray, vertex.pi, vertex.depth, one, mi.Float(1), vertex.mirrored, vertex.slides)
        turned = beside_outline, None, self.lights, self.fine_mirrors
        scattered, stopped = scattered_light(self.scene, sampler, start, self.depths, active, *turned)
        return dr.select(shines, emitted, 0) + scattered, stopped


def camera_vertex(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f) -> Vertex:
    """The first vertex of a path, which a camera ray meets."""
    width = dr.width(pi.t)
    one, β = dr.full(mi.UInt32, 1, width), dr.full(mi.Spectrum, 1, width)
    no = dr.full(mi.Bool, False, width)
    return Vertex(dr.detach(mi.Ray3f(ray)), pi, one, β, mi.Float(1), no, mi.Bool(no))
