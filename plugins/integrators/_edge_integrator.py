"""What the integrators with edge sampling share: the way from camera rays to radiance, and to a derivative image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.python.ad.integrators.common import ADIntegrator

from rimlight._collection import collect_before, no_collection
from rimlight._plan import Plan, PlannedTerm, names
from rimlight.edge_sampling import (
    Batch,
    Edges,
    FacePlanes,
    FilmBoundary,
    FilmPart,
    Geometry,
    Lights,
    ShadingBoundary,
    ShadowBoundary,
    Silhouettes,
    Sources,
    film_parts,
    find_welded_edges,
    has_hard_beam,
    intersecting_meshes,
    jumping_textures,
    stratified,
    t_junctions,
)

from ._cut_rays import CutRays
from ._finite import report_gradients, report_image, values_of
from ._limits import Media, PartialParameters, beyond_far_plane, coarse_lamps, is_mirror, lets_through, small_scene
from ._options import check_options, is_whole
from ._paths import Depths, Replay, Vertex, choose_vertex, scattered_light
from ._scattering import Scattering, met_by, turn_to_side

HARD_SHADOWS = (
    "the derivative has the hard shadows of lights without size (point, spot, directional, ...) on what the camera "
    'sees, but lacks those in indirect light; give the lights a size, or set "max_depth" to 2 to leave it out.'
)

#: Parameters of a light that move the shadows in it.
PLACE_OF_LIGHT = ("position", "to_world", "directions", "angular_radius", "sun_direction")

#: Samples of the film boundary at one sample per pixel: at most so many times width plus height of the film.
LINE = 16

#: Longest path that a plan counts rays of.
LONG = 16


def _carries_gradient(params) -> bool:
    """Does any of the parameters?"""
    return any(dr.grad_enabled(v) for v in values_of(params).values())


@dataclass
class Sample:
    """Radiance and alpha of film samples, or their derivatives. (A Dr.Jit structure: not frozen.)"""

    L: mi.Spectrum
    alpha: mi.Float


@dataclass(frozen=True)
class Term:
    """The film samples of one term of the derivative.

    value : attached; only its gradient counts.
    weight : of each sample in the film's weight channel.
    per_pixel : how many neighbours in the wavefront belong to one pixel, 0 if they are in no order.
    replay : None, or what differentiates the part of the path that `value` is not attached to.
    throughput : of the camera ray, which weighs that part.
    rays : None, or the cut between `value` and the sensor.
    """

    position: mi.Point2f
    value: Sample
    wavelengths: mi.Spectrum
    weight: float
    per_pixel: int
    replay: Replay | None = None
    throughput: mi.Spectrum | None = None
    rays: CutRays | None = None

    def detached(self) -> Term:
        return replace(self, value=dr.detach(self.value))


@dataclass(frozen=True)
class Boundaries:
    """What samples the edges of a scene, for one answer to the question which meshes move, and whether the camera
    does. Nothing where nothing moves. `limits` : what the derivative will lack."""

    film: FilmBoundary | None = None
    shadows: ShadowBoundary | None = None
    shading: ShadingBoundary | None = None
    planes: FacePlanes | None = None
    moving: tuple[bool, ...] = ()
    camera_moves: bool = False
    lights_move: bool = False
    limits: tuple[str, ...] = ()

    @property
    def silhouettes(self) -> Silhouettes | None:
        return next((b.silhouettes for b in (self.shadows, self.shading) if b is not None), None)


class EdgeIntegrator(ADIntegrator):
    """Base of the integrators whose derivative has an interior term, from `sample`, and a boundary term, from the
    edges of the scene.

    max_depth, rr_depth : of paths, as in Mitsuba's `path`.

    Raises
    ------
    ValueError : a property is not among `OPTIONS`, or has a value that it cannot have.
    """

    #: Names of the properties. Subclasses that have more extend them.
    OPTIONS: tuple[str, ...] = ("sppc", "sppp", "sppi", "hide_emitters")

    #: Does the derivative have what the planes of faces do to soft light, where other normals shade?
    SOFT = True

    #: Properties that are accepted, but have no effect.
    IDLE: tuple[str, ...] = ()

    def __init__(self, props: mi.Properties, max_depth: int = 2, rr_depth: int = 5):
        check_options(props, self.OPTIONS, self.IDLE)
        super().__init__(props)
        self.depths = Depths(max_depth if max_depth >= 0 else 0xFFFFFFFF, rr_depth)
        self.name = props.plugin_name()
        if mi.is_polarized:
            raise ValueError(f"{self.name}: polarised variants are not supported, got {mi.variant()}")
        self.sppc, self.sppp, self.sppi = (self._sample_count(props, key) for key in ("sppc", "sppp", "sppi"))
        self._geometry: Geometry | None = None
        self._edges: Edges | None = None
        self._sources: Sources | None = None
        self._checked = False
        self._partial: PartialParameters | None = None
        self._media: Media | None = None
        self._beyond: dict[tuple, tuple[mi.Sensor, list[str]]] = {}
        self._boundaries: dict[tuple, Boundaries] = {}
        self._warned: set[str] = set()

    def to_string(self) -> str:
        counts = f"sppc={self.sppc}, sppp={self.sppp}, sppi={self.sppi}"
        return f"{type(self).__name__}[{counts}, hide_emitters={self.hide_emitters}]"

    # ---------------------- Mitsuba's interface ----------------------

    @no_collection()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The image, as Mitsuba has it."""
        return super().render(scene, sensor, seed, spp, develop, evaluate)

    @no_collection()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the image along the gradients that are set on the parameters.

        Returns
        -------
        mi.TensorXf, (H, W, C), linear radiance per unit of the parameter.
        """
        if params is not None and not _carries_gradient(params):
            raise RuntimeError(f"{self.name}: none of the parameters carries a gradient")
        with dr.suspend_grad():
            film, makers = self._terms(scene, sensor, seed, spp, dr.ADMode.Forward)
            terms, values = [], []
            for make in makers:
                # One term after the other: path replay needs that nothing else is attached to the parameters.
                term = make()
                with dr.resume_grad():
                    # A parameter that carries a gradient may well not show in the image: then the derivative is zero.
                    first = term.replay.first if term.replay is not None else mi.Point3f(0)
                    value, first = dr.forward_to(
                        [term.value, first], flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
                    )
                term = term.detached()
                if term.replay is not None:
                    value.L += term.throughput * term.replay.forward(first)
                terms.append(term)
                values.append(value)
            image = self._develop(film, terms, values)
        report_image(self.name, image)
        return image

    @no_collection()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add to the gradients of the parameters what `grad_in`, (H, W, C), the gradient of a loss with respect to the
        image, makes of them."""
        # Isolated, so that what lies behind the parameters is traversed once, and last: the sensor's share comes late.
        with dr.isolate_grad(), dr.suspend_grad():
            film, makers = self._terms(scene, sensor, seed, spp, dr.ADMode.Backward)
            terms = [make() for make in makers]
            with dr.resume_grad():
                # The image is linear in the samples: differentiate the way from them to it by itself, so that no ray
                # is traced for it.
                values = [dr.zeros(type(t.value), dr.width(t.position)) for t in terms]
                dr.enable_grad(values)
                image = self._develop(film, terms, values)
                dr.set_grad(image, grad_in)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                for term, value in zip(terms, values, strict=True):
                    gradient = dr.grad(value)
                    if term.replay is not None:
                        with dr.suspend_grad():
                            first = term.replay.backward(gradient.L * term.throughput)
                        if first is not None:
                            dr.set_grad(term.replay.first, first)
                            dr.enqueue(dr.ADMode.Backward, term.replay.first)
                    dr.set_grad(term.value, gradient)
                    dr.enqueue(dr.ADMode.Backward, term.value)
                dr.traverse(dr.ADMode.Backward)
                for term in terms:
                    if term.rays is not None:
                        term.rays.backward()
            dr.eval()
        report_gradients(self.name, params)

    # ---------------------- Radiance ----------------------

    def sample(self, mode, scene, sampler, ray, active=True, horizon=None, **_):
        """Estimate the radiance along camera rays. Call it with gradients suspended: it resumes them where they belong.

        horizon : `Horizon`, on which side of the horizon of interpolated normals the first hit is; None: as it is.

        Returns
        -------
        L : mi.Spectrum, (N,); unless `mode` is primal, attached to the first vertex of its path.
        valid : mi.Bool, (N,); does the ray meet a surface, or a visible environment? The alpha channel.
        aovs : empty; Mitsuba's interface has them.
        replay : None, or what differentiates the rest of the path.
        """
        attached = mode != dr.ADMode.Primal
        active = mi.Bool(active) & (self.depths.max_depth > 0)
        L, rest = mi.Spectrum(0), None

        # ---------------------- First hit ----------------------

        # A surface that moves is met by a fixed ray; a ray that moves with the camera takes its hit along.
        pi = self._first_hit(scene, ray, active)
        si = met_by(ray, pi, mi.RayFlags.All, active, attached)
        if horizon is not None:
            turn_to_side(si, ray, horizon)
        with dr.resume_grad(when=attached):
            if not self.hide_emitters:
                L += si.emitter(scene).eval(si, active)
        bsdf = si.bsdf(ray)
        backdrop = active & (scene.environment() is not None and not self.hide_emitters)
        active &= si.is_valid()
        scattering = Scattering(scene, attached=attached)
        if not self.depths.scatters(1):
            return L, backdrop | scattering.stops(ray, pi, sampler, active), [], None

        # ---------------------- Light that it scatters ----------------------

        direct, onwards = scattering.scatter(si, bsdf, sampler, active)
        with dr.resume_grad(when=attached):
            L += direct
        valid = backdrop | (active & ~onwards.through)
        if not self.depths.scatters(2):
            valid |= scattering.stops(onwards.ray, onwards.pi, sampler, active & onwards.through)
        else:
            first = self._camera_vertex(ray, pi)
            β = dr.select(active, dr.detach(onwards.weight), 0)
            second = Vertex(mi.Ray3f(onwards.ray), onwards.pi, first.depth + 1, β, mi.Float(onwards.η))
            again = sampler.clone() if attached else None
            indirect, stopped = scattered_light(scene, sampler, second, self.depths, active)
            valid |= onwards.through & stopped
            with dr.resume_grad(when=attached):
                L += dr.select(β != 0, indirect * onwards.weight / β, 0)
            if attached:
                rest = Replay(scene, again, first, second, self.depths, active, si.p, indirect)
        return L, valid, [], rest

    @staticmethod
    def _camera_vertex(ray, pi) -> Vertex:
        one = dr.full(mi.UInt32, 1, dr.width(pi.t))
        return Vertex(dr.detach(mi.Ray3f(ray)), pi, one, dr.full(mi.Spectrum, 1, dr.width(one)), mi.Float(1))

    def _first_hit(self, scene, ray, active):
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if self.hide_emitters:
            skip = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (an array of pointers)
            onwards = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, skip).spawn_ray(ray.d)
            pi[skip] = self.skip_area_emitters(scene, onwards, True, skip)
        return pi

    def _beside_edge(self, scene, ray, sampler, active, horizon) -> tuple[mi.Spectrum, mi.Float]:
        """Radiance and alpha beside an edge on the film."""
        L, valid, _, _ = self.sample(dr.ADMode.Primal, scene, sampler, ray, active=active, horizon=horizon)
        return L, dr.select(valid, mi.Float(1), 0)

    def _seen_from_vertex(self, scene, sampler, choice, ray, shading: ShadingBoundary) -> mi.Spectrum:
        """What edges do to the light that a vertex of each path reflects: mi.Spectrum, (N,), zero, with a gradient."""
        with dr.resume_grad():
            placement = shading.silhouettes.placement()
        si, vertex, chosen = self._any_vertex(scene, sampler, ray)
        at_first = vertex.depth == 1
        scattered = lambda ray, pi, sampler, active: self._onwards(scene, vertex, ray, pi, sampler, active)
        L = shading.from_points(
            scene,
            placement,
            si,
            sampler,
            choice,
            chosen,
            share_emission=at_first,
            emission=~at_first | shading.emission_at_first,
            scattering=self.depths.scatters(vertex.depth + 1),
            scattered=scattered if self.depths.scatters(2) else None,
        )
        with dr.resume_grad():
            return L * vertex.β

    def _behind_faces(self, scene, sampler, ray, planes: FacePlanes) -> mi.Spectrum:
        """What the planes of faces do to the light that a vertex of each path reflects: likewise."""
        si, vertex, chosen = self._any_vertex(scene, sampler, ray)

        def incident(ray, pi, y, sampler, active):
            L = y.emitter(scene, active).eval(y, active)
            if self.depths.scatters(2):
                onwards = active & y.is_valid() & self.depths.scatters(vertex.depth + 1)
                L += dr.select(onwards, self._onwards(scene, vertex, ray, pi, sampler, onwards), 0)
            return L

        L = planes.sample(scene, si, sampler, chosen, incident)
        with dr.resume_grad():
            return L * vertex.β

    def _any_vertex(self, scene, sampler, ray) -> tuple[mi.SurfaceInteraction3f, Vertex, mi.Bool]:
        """One vertex of each path at which light is scattered; and is there one? The surface is attached: to the ray
        at the first vertex, farther on to the material point."""
        pi = self._first_hit(scene, ray, True)
        vertex, chosen = self._camera_vertex(ray, pi), pi.is_valid()
        if self.depths.scatters(2):
            vertex, chosen = choose_vertex(scene, sampler, vertex, self.depths, chosen)
        at_first = vertex.depth == 1
        with dr.resume_grad():
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, at_first)
            if self.depths.scatters(2):
                follow = mi.RayFlags.All | mi.RayFlags.FollowShape
                si = dr.select(at_first, si, vertex.pi.compute_surface_interaction(vertex.ray, follow, chosen))
        return si, vertex, chosen

    def _onwards(self, scene, vertex, ray, pi, sampler, active) -> mi.Spectrum:
        """Light that is scattered towards `vertex` by what `ray` meets past an edge."""
        seen = Vertex(mi.Ray3f(ray), pi, vertex.depth + 1, dr.full(mi.Spectrum, 1, dr.width(active)), mi.Float(1))
        return scattered_light(scene, sampler, seen, self.depths, active)[0]

    # ---------------------- Derivative image ----------------------

    def _terms(self, scene, sensor, seed, spp, mode) -> tuple[mi.Film, list[Callable[[], Term]]]:
        """What makes the samples of each term of the derivative."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        sppc, sppp, sppi = self._counts(spp, sensor)
        boundaries = self._boundaries_of(scene, sensor, sppi)
        # Without interior samples, zeros still tell how much the filter weighs at each pixel. There, the weights of the
        # interior samples add up to `weights` times the integral of the filter. The film divides by that sum: so
        # samples of boundaries, of weight zero, are normalised as the image is, for every filter.
        sampler, weights = self._sampler(sensor, seed, sppc or 16)
        terms = [lambda: self._interior(scene, sensor, sampler, weights, mode, sppc > 0)]
        parts = [(part, seed ^ i << 16) for i, part in enumerate(film_parts(sensor))]
        if boundaries.film is not None and sppp > 0:
            terms += [
                partial(self._film_boundary, scene, sensor, *part, sppp, weights, boundaries.film) for part in parts
            ]
        if boundaries.silhouettes is not None:
            boundaries.silhouettes.refit()
        if boundaries.shadows is not None:
            terms += [partial(self._shadows, scene, sensor, *part, sppi, weights, boundaries) for part in parts]
        if boundaries.shading is not None:
            boundaries.shading.refit()
            edges = lambda sampler, choice, ray: self._seen_from_vertex(scene, sampler, choice, ray, boundaries.shading)
            terms.append(lambda: self._from_points(scene, sensor, 0x55555555 ^ seed, sppi, weights, mode, edges))
        if boundaries.planes is not None:
            planes = lambda sampler, _, ray: self._behind_faces(scene, sampler, ray, boundaries.planes)
            terms.append(lambda: self._from_points(scene, sensor, 0x33333333 ^ seed, sppi, weights, mode, planes))
        return sensor.film(), terms

    def sample_rays(self, scene, sensor, sampler):
        """Camera rays, their weights, and film positions in pixels, as Mitsuba has it."""
        batch = sensor.class_name() == "BatchSensor"
        return super().sample_rays(scene, Batch(sensor) if batch else sensor, sampler)

    def _interior(self, scene, sensor, sampler, weights, mode, wanted: bool) -> Term:
        ray, ray_weight, position = self.sample_rays(scene, sensor, sampler)
        if not wanted:
            return Term(position, Sample(mi.Spectrum(0), mi.Float(0)), ray.wavelengths, 1.0, weights)
        rays = CutRays(mode)
        L, _, _, replay = self.sample(mode, scene, sampler, rays(ray))
        with dr.resume_grad():
            value = Sample(mi.Spectrum(L * ray_weight), mi.Float(0))
        return Term(position, value, ray.wavelengths, 1.0, weights, replay, dr.detach(ray_weight), rays)

    def _film_boundary(self, scene, sensor, part: FilmPart, seed, sppp, weights, boundary: FilmBoundary) -> Term:
        """Visibility as seen from the sensor, on one part of its film."""
        count = self._line_samples(part.sensor, sppp)
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(1)
        sampler.set_samples_per_wavefront(1)
        sampler.seed(0xFFFFFFFF ^ seed, count)
        s = boundary.sample(scene, part.sensor, sampler, count, lambda *args: self._beside_edge(scene, *args))
        with dr.resume_grad():
            weight = weights * part.area
            value = Sample(mi.Spectrum(s.value * weight), s.alpha * weight)
            return Term(part.to_film(s.position), value, s.wavelengths, 0.0, 0)

    def _shadows(self, scene, sensor, part: FilmPart, seed, sppi, weights, boundaries: Boundaries) -> Term:
        """Shadows on what the camera sees, found from the lights, on one part of the film."""
        sampler, _ = self._sampler(sensor, 0xAAAAAAAA ^ seed, sppi, part.sensor.film())
        share = boundaries.shading is not None and boundaries.shading.emission_at_first
        s = boundaries.shadows.sample(scene, part.sensor, sampler, self._first_hit, share=share)
        with dr.resume_grad():
            value = Sample(mi.Spectrum(s.value * (weights * part.area)), mi.Float(0))
            return Term(part.to_film(s.position), value, s.wavelengths, 0.0, 0)

    def _from_points(self, scene, sensor, seed, sppi, weights, mode, reflected: Callable[..., mi.Spectrum]) -> Term:
        """Boundaries as seen from one vertex of each path.

        reflected : maps (sampler, which part of the samples each is, camera rays) to what they do to its light.
        """
        sampler, sppi = self._sampler(sensor, seed, sppi)
        ray, ray_weight, position = self.sample_rays(scene, sensor, sampler)
        choice = stratified(sampler, seed)
        rays = CutRays(mode)
        L = reflected(sampler, choice, rays(ray))
        with dr.resume_grad():
            value = Sample(mi.Spectrum(L * ray_weight * (weights / sppi)), mi.Float(0))
            return Term(position, value, ray.wavelengths, 0.0, sppi, rays=rays)

    @staticmethod
    def _develop(film: mi.Film, terms: list[Term], values: list[Sample]) -> mi.TensorXf:
        """The image that the film makes of `values` at the positions of `terms`: (H, W, C)."""
        film.prepare([])
        for term, value in zip(terms, values, strict=True):
            block = film.create_block()
            # Mitsuba may add up neighbours in a wavefront first, if those belong to one pixel.
            block.set_coalesce(block.coalesce() and term.per_pixel >= 4)
            ADIntegrator._splat_to_block(
                block, film, term.position, value.L, term.weight, value.alpha, [], term.wavelengths
            )
            film.put_block(block)
        return film.develop()

    # ---------------------- Plan ----------------------

    @no_collection()
    def plan(self, scene: mi.Scene, sensor: int | mi.Sensor = 0, spp: int = 0) -> Plan:
        """What a derivative with respect to the parameters that carry a gradient now will do, see `rimlight.plan`."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        sppc, sppp, sppi = self._counts(spp, sensor)
        with dr.suspend_grad():
            boundaries = self._boundaries_of(scene, sensor, sppi)
        width, height = self._size(sensor.film())
        pixels, segments = width * height, min(self.depths.max_depth, LONG)
        film, shadows, shading = boundaries.film, boundaries.shadows, boundaries.shading
        path = 1 + 2 * max(segments - 1, 0)
        terms = [
            PlannedTerm("interior", sppc * pixels, path + (segments > 2) * 2 * (path - 3), "always")
            if sppc
            else PlannedTerm("interior", 0, 0, '"sppc" is 0')
        ]

        def add(name, samples, rays, needed, why, why_not):
            samples = samples if needed else 0
            terms.append(PlannedTerm(name, samples, rays if samples else 0, why if samples else why_not))

        moves = any(boundaries.moving) or boundaries.camera_moves or boundaries.lights_move
        still = "nothing moves" if not moves else '"sppi" is 0' if not sppi else "nothing is lit"
        add(
            "film boundary",
            sum(self._line_samples(part.sensor, sppp) for part in film_parts(sensor)),
            2 * path,
            film is not None and sppp,
            f"{film.counts[0] + film.counts[3] if film else 0} edges may move on the film",
            '"sppp" is 0' if film is not None else "only lights move" if moves else "nothing moves",
        )
        add(
            "shadows from lights",
            sppi * pixels,
            3,
            shadows is not None,
            f"{len(shadows) if shadows is not None else 0} lights",
            still if shading is None else "no lights but the environment",
        )
        add(
            "edges from points",
            sppi * pixels,
            1 + path,
            shading is not None,
            "light that is scattered may be occluded" if segments > 2 else "glossy surfaces, or an environment",
            still if shadows is None else "direct light: found from the lights",
        )
        add(
            "planes of faces",
            sppi * pixels,
            1 + path,
            boundaries.planes is not None,
            "interpolated normals, or normal maps, in soft light",
            "nothing that moves" if sppi else '"sppi" is 0',
        )
        shapes = zip((*self._geometry.meshes, *self._geometry.analytic), boundaries.moving, strict=False)
        return Plan(
            integrator=self.name,
            moving=names(s for s, moves in shapes if moves),
            camera_moves=boundaries.camera_moves,
            lights_move=boundaries.lights_move,
            edges=len(self._edges),
            tree=boundaries.silhouettes.leaves if boundaries.silhouettes is not None else 0,
            terms=tuple(terms),
            limits=boundaries.limits,
        )

    # ---------------------- What moves ----------------------

    @no_collection()
    def find_boundaries(self, scene, sensor=0) -> Boundaries | None:
        """Find the edges that can contribute to a derivative with respect to the parameters that carry a gradient now.

        Derivatives do this by themselves, but not inside of a function that `dr.freeze` records, since the search runs
        on the host. Give this as the function's `state_fn`.

        Returns
        -------
        What a frozen function depends on (a PyTree).
        """
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        with dr.suspend_grad():
            boundaries = self._boundaries_of(scene, sensor, self._override(self.sppi, 0, sensor))
        self._checked = True
        return boundaries

    def _boundaries_of(self, scene, sensor, sppi) -> Boundaries:
        """The edges that can contribute."""
        geometry, params = Geometry.of(scene), mi.traverse(scene)
        self._renew(scene, params, geometry)
        with dr.resume_grad():
            self._media.refuse_gradients(self.name)
            limits = (*self._media.limits(), *self._partial.limits())
            geometry.refuse_moving_others(params, self.name)
            moving = geometry.moving()
            camera = mi.traverse(sensor)
            camera_moves = any(dr.grad_enabled(value) for _, value in camera.items())
            lights_move = self._lights_move(scene, moving)
        if camera_moves and geometry.others:
            names = ", ".join(f'"{s.id()}" ({s.class_name()})' for s in geometry.others)
            raise RuntimeError(
                f"{self.name}: the camera moves past {names}, whose silhouettes cannot be sampled yet. "
                "Replace them by meshes."
            )
        if not (camera_moves or lights_move or any(moving)):
            self._warn_once(*limits)
            return Boundaries(limits=limits)
        if not self._checked:
            # A frozen function cannot look at arrays: its `state_fn` must have done so, just before.
            self._refuse_while_recording()
        key = (moving, camera_moves, lights_move, sppi > 0)
        if key not in self._boundaries:
            self._refuse_while_recording()
            on_film = np.array([m or camera_moves for m in moving], bool)
            soft = self.depths.scatters(2) or any(not e.flags() & mi.EmitterFlags.Delta for e in scene.emitters())
            soft = soft and self.depths.scatters(1) and self.SOFT
            film = FilmBoundary(geometry, self._edges, on_film, Lights(scene), soft=soft) if on_film.any() else None
            film = film if film is not None and any(film.counts) else None
            planes = self._face_planes(scene, moving, lights_move) if soft and sppi else None
            shadows, shading = self._light_boundaries(scene, moving, camera_moves or lights_move, sppi)
            lasting = self._limits(scene, moving, camera_moves, lights_move, sppi)
            self._boundaries[key] = Boundaries(
                film, shadows, shading, planes, moving, camera_moves, lights_move, lasting
            )
        boundaries = self._boundaries[key]
        if boundaries.shading is not None and not dr.flag(dr.JitFlag.FreezingScope):
            boundaries.shading.boxes.find_shapes()
        limits += (*boundaries.limits, *self._limits_of_sensor(sensor, moving, camera_moves))
        self._warn_once(*limits)
        return replace(boundaries, limits=limits)

    def _renew(self, scene, params, geometry) -> None:
        """Find the edges, if what they were derived from is no longer the same."""
        same = self._sources is not None and self._sources.same_objects(scene, params, geometry)
        if not dr.flag(dr.JitFlag.FreezingScope):
            same, self._checked = same and self._sources.same_content(geometry), False
        if same:
            return
        self._refuse_while_recording()
        # The scene before may be garbage by now. Nothing is traced yet, and `dr.freeze` may be about to record.
        self._geometry = self._edges = self._sources = self._partial = self._media = None
        self._boundaries, self._beyond = {}, {}
        collect_before()
        self._geometry = geometry
        self._edges, weld = find_welded_edges(geometry)
        self._sources = Sources(scene, params, geometry, self._edges, weld)
        self._partial, self._media = PartialParameters(scene), Media(scene)

    def _refuse_while_recording(self) -> None:
        if dr.flag(dr.JitFlag.FreezingScope):
            raise RuntimeError(
                f"{self.name}: a frozen function cannot find the edges. Let it do so before: "
                "`@dr.freeze(state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))`."
            )

    def _light_boundaries(
        self, scene, moving, everything, sppi
    ) -> tuple[ShadowBoundary | None, ShadingBoundary | None]:
        """What samples the edges of which lights and shading points know, as far as it is needed."""
        if not sppi or not scene.emitters() or not self.depths.scatters(1):
            return None, None
        silhouettes = Silhouettes(self._geometry, self._edges, None if everything else moving)
        if not len(silhouettes):
            return None, None
        shapes = zip((*self._geometry.meshes, *self._geometry.analytic), moving, strict=True)
        moving_shapes = None if everything else [s for s, moves in shapes if moves]
        shadows = ShadowBoundary(scene, silhouettes)
        shading = ShadingBoundary(scene, silhouettes, moving_shapes)
        needed = self.depths.scatters(2) or shading.emission_at_first
        return shadows if len(shadows) else None, shading if needed else None

    def _face_planes(self, scene, moving, lights_move) -> FacePlanes | None:
        """What samples the planes of faces, if what they hide can change: where the faces move, or what lights them.
        (The camera alone moves neither.)"""
        planes = FacePlanes(scene)
        shapes = zip((*self._geometry.meshes, *self._geometry.analytic), moving, strict=True)
        moving_shapes = [s for s, moves in shapes if moves]
        what_lights = lights_move or (moving_shapes and self.depths.scatters(2))
        return planes if planes.shapes and (what_lights or any(s in moving_shapes for s in planes.shapes)) else None

    def _lights_move(self, scene, moving) -> bool:
        """Do meshes that emit light move, or lights that are no shapes?"""
        shapes = (*self._geometry.meshes, *self._geometry.analytic)
        if any(s.is_emitter() and moves for s, moves in zip(shapes, moving, strict=True)):
            return True
        others = [mi.traverse(e) for e in scene.emitters() if not e.flags() & mi.EmitterFlags.Surface]
        return any(dr.grad_enabled(p[k]) for p in others for k in PLACE_OF_LIGHT if k in p)

    def _limits(self, scene, moving, camera_moves, lights_move, sppi) -> tuple[str, ...]:
        """What the derivative will lack."""
        limits = []
        geometry = self._geometry
        delta = any(
            e.flags() & mi.EmitterFlags.Delta or (hasattr(e, "light_count") and dr.any(e.angular_radius == 0))
            for e in scene.emitters()
        )
        if sppi > 0 and delta and self.depths.scatters(2):
            limits.append(HARD_SHADOWS)
        beams = names(e for e in scene.emitters() if has_hard_beam(e))
        if sppi > 0 and beams:
            limits.append(
                f"the derivative lacks the border of the beams of {', '.join(beams)}: give a spot a beam_width below "
                "its cutoff_angle, and a projector an image with a black border."
            )
        if sppi > 0 and any(is_mirror(s) for s in scene.shapes()):
            limits.append(
                "the derivative lacks the motion of what perfect mirrors and glass show; "
                'give them a roughness, or set "sppi" to 0 to accept this.'
            )
        through = names(s for s in scene.shapes() if lets_through(s))
        if sppi > 0 and through and self.depths.scatters(2):
            limits.append(
                "the derivative lacks part of the motion of what is seen, and of what shines, through "
                f"{', '.join(through)}; "
                'cut the meshes out, or set "max_depth" to 2 or "sppi" to 0 to accept this.'
            )
        if sppi > 0 and self.depths.scatters(1):
            limits += coarse_lamps(scene) + small_scene(scene)
        textures = jumping_textures(scene)
        if textures:
            limits.append(
                f"the derivative lacks the jumps of the textures {', '.join(textures)}; use bilinear bitmaps, and "
                "normal maps for bump maps."
            )
        if (camera_moves or lights_move) and any(e.class_name() == "SunskyEmitter" for e in scene.emitters()):
            limits.append(
                "the derivative lacks the motion of the border of the sun; set the sun_scale of sunsky to 0, and add a "
                "directional light."
            )
        casts = names(s for s in geometry.others if not s.is_emitter())
        if sppi > 0 and casts:
            limits.append(
                f"the derivative lacks the shadows and reflections of {', '.join(casts)} on what moves, or in moving "
                "light: their silhouettes are unknown. Replace them by meshes."
            )
        grids = names(s for s in scene.shapes() if s.class_name() == "SDFGrid")
        if grids:
            limits.append(
                f"the derivative is off by up to a fifth at the silhouettes of {', '.join(grids)} (sdfgrid). Replace "
                "them by meshes."
            )
        cut = {
            (geometry.meshes[i].id(), geometry.meshes[j].id())
            for i, j in intersecting_meshes(scene, geometry, self._edges)
            if moving[i] or moving[j] or camera_moves
        }
        if cut:
            pairs = ", ".join(f'"{a}" and "{b}"' for a, b in sorted(cut))
            limits.append(f"the derivative lacks the lines in which meshes cut through each other: {pairs}.")
        # Of edges that lie on one another, those of what stands still have no velocity, and do not count.
        twice = sorted(
            (geometry.meshes[i].id(), geometry.meshes[j].id())
            for i, j in (t_junctions(geometry, self._edges) if any(moving) or camera_moves else ())
            if camera_moves or (moving[i] and moving[j])
        )
        if twice:
            pairs = ", ".join(f'"{a}"' if a == b else f'"{a}" and "{b}"' for a, b in twice)
            limits.append(
                "the derivative counts the jump at T-junctions twice, where a vertex lies inside of an open edge: "
                f"{pairs}. Divide the longer edges there."
            )
        return tuple(limits)

    def _limits_of_sensor(self, sensor, moving, camera_moves) -> list[str]:
        """What the derivative will lack as seen from this sensor. Found once, since it looks at positions."""
        key = (id(sensor), moving, camera_moves)
        if key not in self._beyond and not dr.flag(dr.JitFlag.FreezingScope):
            shapes = zip((*self._geometry.meshes, *self._geometry.analytic), moving, strict=True)
            # With the sensor, so that its number is given to no other one.
            found = beyond_far_plane(sensor, [s for s, moves in shapes if moves or camera_moves])
            self._beyond[key] = sensor, found
        return self._beyond[key][1] if key in self._beyond else []

    def _warn_once(self, *messages: str) -> None:
        for message in messages:
            if message not in self._warned:
                self._warned.add(message)
                mi.Log(mi.LogLevel.Warn, f"{self.name}: {message}")

    # ---------------------- Sample counts ----------------------

    def _sample_count(self, props: mi.Properties, key: str) -> int | None:
        value = props.get(key, None)
        if value is not None and (not is_whole(value) or value < 0):
            raise ValueError(f'{self.name}: "{key}" must be a whole number >= 0, got {value}')
        return value

    @staticmethod
    def _override(own: int | None, spp: int, sensor: mi.Sensor) -> int:
        """0 in the scene file switches a term off. Else the call comes first, then the scene file, then the sampler."""
        return 0 if own == 0 else spp or own or sensor.sampler().sample_count()

    @staticmethod
    def _size(film: mi.Film) -> tuple[int, int]:
        """Width and height of what is sampled, in pixels."""
        border = 2 * film.rfilter().border_size() if film.sample_border() else 0
        return tuple(int(n) + border for n in film.crop_size())

    def _line_samples(self, sensor: mi.Sensor, sppp: int) -> int:
        """A line covers few pixels: unless a number of samples was asked for, so many a pixel of it are enough."""
        width, height = self._size(sensor.film())
        return sppp * (width * height if self.sppp else min(width * height, LINE * (width + height)))

    def _counts(self, spp: int, sensor: mi.Sensor) -> tuple[int, int, int]:
        return tuple(self._override(own, spp, sensor) for own in (self.sppc, self.sppp, self.sppi))

    @staticmethod
    def _sampler(
        sensor: mi.Sensor, seed: int | mi.UInt32, spp: int, film: mi.Film | None = None
    ) -> tuple[mi.Sampler, int]:
        """A sampler for one wavefront over the film, and its samples per pixel (some kinds round them up)."""
        width, height = EdgeIntegrator._size(film or sensor.film())
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()
        count = width * height * spp
        if count > 2**32:
            raise RuntimeError(
                f"{count} samples in one wavefront exceed 2^32: use fewer samples per pixel and average several seeds"
            )
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, count)
        return sampler, spp
