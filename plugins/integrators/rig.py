"""Plugin `rig`: one image for each light of a scene, from camera paths that all lights share."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from rimlight._collection import no_collection
from rimlight.edge_sampling import FilmPart, Lights, stratified
from rimlight.edge_sampling.geometry.instances import copied_places
from rimlight.edge_sampling.refusals import InputError, Refusal
from rimlight.terms.sampling import in_a_row, over_film, seed_of
from rimlight.terms.term import Job

from ._black import BlackParameters
from ._finite import report_gradients, report_image
from ._layers import Layers, LayerSamples
from ._light_paths import LightPaths
from ._options import is_whole
from ._sinks import Backward, Forward, Measure, Splat
from .edge_integrator import EdgeIntegrator

#: Longest path. A derivative keeps all of its vertices in memory.
LONGEST = 16


class RigIntegrator(EdgeIntegrator):
    r"""
    .. _integrator-rig:

    Light by light (:monosp:`rig`)
    ------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path, in segments, as in ``path``: 1 shows emitters only, 2 adds direct illumination. From 0 to 16; a
         derivative keeps all vertices of its paths in memory. (Default: 2)

     * - min_depth
       - |int|
       - Shortest path that counts, in segments: 3 leaves out direct illumination and visible emitters. For images only;
         derivatives of such images are refused. (Default: 0, all)

     * - rr_depth
       - |int|
       - From this depth on, paths end at random ("Russian roulette"). (Default: 5)

     * - lights_per_path
       - |int|
       - Evaluate so many of the lights along each path, chosen at random, one from each of as many equal parts of their
         list. What they contribute is scaled up, so that images stay right in the mean. (Default: 0, all)

     * - sppc
       - |int|
       - Samples per pixel of the interior derivative. 0 switches it off; otherwise the ``spp`` argument of the render
         call overrides it. Default: that argument, or the sampler's ``sample_count``.

     * - sppp
       - |int|
       - Samples per pixel of the film boundary (visibility as seen from the sensor); likewise, but without a number
         in the scene at most 16 (width + height) for each sample per pixel. Each sample sees all lights.

     * - sppi
       - |int|
       - Samples per pixel of the shadows that the lights throw on what the camera sees; likewise. Each sample belongs
         to one light.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders *one image for each light* of a scene, as photometric stereo and light stages take them, from one set of
    camera paths. For K lights the image is of shape :monosp:`(H, W, 3 K)`, or :monosp:`(H, W, K)` in monochromatic
    variants: the channels of the first light, then those of the second, and so on, in the order of the scene's
    emitters; emitters of several lights (``distant_lights``, ``led``) have a layer for each of them. Layers are linear
    radiance, whatever the pixel format of the film, and have no alpha channel. Their sum is what ``path`` renders, and
    each is what ``path`` renders with that light alone. With lights that rays cannot hit and ``max_depth`` 2, the
    random numbers are those of ``direct_edge``, and so are the images.

    A path is traced once, and its vertices, their surfaces and their throughput are found once. At each vertex, a loop
    runs over the lights, with one shadow ray for each whose light would be reflected.

    **Interior.** As for ``prb_edge``: the first vertex is met by a ray that is fixed on the film, all further ones are
    material points. A derivative in backward mode runs the loop over the lights once, too: what a vertex reflects of
    them, weighed with their gradients, is a single spectrum, and the gradient of a surface is added up before it is
    handed on.

    **Boundaries.** On the film, both sides of an edge see all lights. Of the boundaries at shading points, the shadows
    that lights throw on what the camera sees are found from the lights, hard and soft ones.

    **Adaptive sampling.** :monosp:`integrator.pixel_density`, a number for each pixel of the film, row by row (Python
    only, default :monosp:`None`: all alike), distributes the camera paths over the pixels in proportion to it; those of
    density 0 stay black. Images and derivatives stay right in the mean. For the box filter only.

    **Names.** :monosp:`integrator.light_names(scene)` lists the names of the layers, and
    :monosp:`rimlight.exr` has :monosp:`write_layers` and :monosp:`read_layers` for OpenEXR files with
    named layers.

    **Limits.** Those of ``prb_edge``. In light of lamps with a size, coarse smooth-shaded meshes are off by some
    per cent, since their faces hide light from themselves, which ``direct_edge`` and ``prb_edge`` follow: there is
    a warning. Shadows under an environment and all that edges do to indirect light are taken not to move, with a
    warning, unless ``sppi`` is 0. Discs of ``distant_lights`` need ``hide_emitters`` and a scene without perfect
    mirrors, since nobody knows which of them a ray hits. Spectral variants are not supported. Filters other than
    ``box`` are right, and slower in proportion to the pixels that they cover.

    .. tabs::
        .. code-tab:: xml

            <integrator type="rig">
                <integer name="max_depth" value="3"/>
            </integrator>

        .. code-tab:: python

            'type': 'rig',
            'max_depth': 3
    """

    OPTIONS = (*EdgeIntegrator.OPTIONS, "max_depth", "min_depth", "rr_depth", "lights_per_path")
    LONGEST = LONGEST
    PLANES = False
    FROM_POINTS = False
    BALANCES = False

    def __init__(self, props: mi.Properties):
        who = props.plugin_name()
        limits = {
            "max_depth": (2, 0, LONGEST),
            "min_depth": (0, 0, None),
            "rr_depth": (5, 1, None),
            "lights_per_path": (0, 0, None),
        }
        values = {key: _whole(who, props, key, *limit) for key, limit in limits.items()}
        super().__init__(props, max_depth=values["max_depth"], rr_depth=values["rr_depth"])
        if mi.is_spectral:
            raise InputError(f"{who}: spectral variants are not supported, got {mi.variant()}")
        self.lights_per_path, self.min_depth = values["lights_per_path"], values["min_depth"]
        self.pixel_density: mi.Float | None = None
        missing = "its derivative lacks the light that samples of the material find"
        self.limits = BlackParameters(missing, "direct_edge or prb_edge", emitters=False)

    # ---------------------- Mitsuba's interface ----------------------

    @no_collection()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The layers: mi.TensorXf, (H, W, 3 K), linear radiance."""
        with dr.suspend_grad():
            sensor = self._sensor(scene, sensor)
            self._rendered.remember(scene, sensor, seed)
            paths = self._paths(scene)
            sampler, spp = over_film(sensor, seed, spp or sensor.sampler().sample_count())
            ray, weight, u = self.sample_rays(scene, sensor, sampler)
            layers = Layers(sensor.film(), len(paths.lights), u, spp)
            paths.trace(Splat(layers), sampler, ray, u, weight / spp, self._choice(sampler, seed))
            return layers.image()

    @no_collection()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the layers along the gradients that are set on the parameters.

        Returns
        -------
        mi.TensorXf, (H, W, 3 K), linear radiance per unit of the parameter.
        """
        if params is not None and not dr.grad_enabled(dict(params)):
            raise Refusal(f"{self.name}: none of the parameters carries a gradient")
        with dr.suspend_grad(), copied_places(scene, dr.ADMode.Forward):
            image = self._differentiate(scene, sensor, seed, spp, None).image()
        report_image(self.name, image)
        return image

    @no_collection()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add to the gradients of the parameters what `grad_in`, (H, W, 3 K), the gradient of a loss with respect to
        the layers, makes of them."""
        with dr.isolate_grad(), dr.suspend_grad(), copied_places(scene, dr.ADMode.Backward):
            self._differentiate(scene, sensor, seed, spp, grad_in)
            dr.eval()
        report_gradients(self.name, params)

    # ---------------------- Derivative ----------------------

    def _boundaries(self, scene, sensor, sppi, find=None):
        boundaries = super()._boundaries(scene, sensor, sppi, find)
        return replace(boundaries, limits=(*boundaries.limits, *self.limits.of(scene)))

    def _differentiate(self, scene, sensor, seed, spp, grad_in) -> Layers:
        """All terms, in forward mode, or given a gradient, in backward mode."""
        if self.min_depth:
            raise Refusal(f'{self.name}: derivatives are those of all light; leave out "min_depth" {self.min_depth}')
        forward = grad_in is None
        job = self.job(scene, sensor, seed, spp)
        paths = self._paths(scene)
        sampler, spp = over_film(job.sensor, seed, job.counts.weights)
        ray, weight, u = job.sample_rays(sampler)
        layers = Layers(job.sensor.film(), len(paths.lights), u, spp, grad_in)
        if job.counts.interior:
            to = Forward(layers) if forward else Backward(layers)
            paths.trace(to, sampler, ray, u, dr.detach(weight) / spp, self._choice(sampler, seed))
            if not forward:
                to.finish()
        job.boundaries.refit()
        for i, part in enumerate(job.parts):
            if job.boundaries.film is not None and job.counts.film:
                self._film_boundary(job, i, part, paths, layers, forward)
            if job.boundaries.shadows is not None:
                samples = self._shadows(job, i, part)
                layers.forward(samples) if forward else layers.backward(samples)
        return layers

    def _shadows(self, job: Job, i: int, part: FilmPart) -> LayerSamples:
        """Shadows on what the camera sees, on one part of the film; each belongs to one light."""
        seed = seed_of("shadows from lights", job.seed, i)
        sampler, _ = over_film(job.sensor, seed, job.counts.shading, part.sensor.film())
        s = job.boundaries.shadows.sample(job.tracer, part.sensor, sampler, share=False)
        with dr.resume_grad():
            return LayerSamples(part.to_film(s.position), s.light, s.value * part.area)

    def _film_boundary(self, job: Job, i: int, part: FilmPart, paths, layers, forward: bool) -> None:
        """Visibility as seen from the sensor, on one part of its film: all lights, on both sides of the edges."""
        count, seed = job.counts.on_line(part.sensor.film()), seed_of("film boundary", job.seed, i)
        sampler = in_a_row(job.sensor, seed, count)
        points = job.boundaries.film.points(job.tracer, part.sensor, sampler, count)
        position = part.to_film(points.position)
        with dr.resume_grad():
            normal_velocity = dr.dot(points.n_dl, points.velocity) * part.area
        weight = 1.0
        if forward:
            with dr.resume_grad():
                weight = dr.forward_to(normal_velocity, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            weight = dr.detach(weight)
        choice = self._choice(sampler, seed)
        to = Splat(layers) if forward else Measure(layers)
        sides = zip((1, -1), points.rays, points.met, points.weights, points.horizons, strict=True)
        for sign, ray, pi, ray_weight, horizon in sides:
            scale = ray_weight * (sign * weight)
            paths.trace(to, sampler.clone(), ray, position, scale, choice, points.active, horizon, pi)
        if not forward:
            dr.eval(to.total, points.n_dl)
            with dr.resume_grad():
                normal_velocity = dr.dot(points.n_dl, points.velocity) * part.area
                dr.backward_from(to.total * normal_velocity, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)

    def sample_rays(self, scene, sensor, sampler):
        if self.pixel_density is None:
            return super().sample_rays(scene, sensor, sampler)
        film = sensor.film()
        size, count = mi.ScalarVector2u(film.crop_size()), dr.width(self.pixel_density)
        if count != size.x * size.y or not film.rfilter().is_box_filter():
            raise Refusal(
                f'{self.name}: "pixel_density" needs a box filter, and a number for each of {size.x} x {size.y} '
                f"pixels, got {count}"
            )
        pixels = mi.DiscreteDistribution(self.pixel_density)
        pixel, probability = pixels.sample_pmf(sampler.next_1d())
        corner = mi.Vector2f(mi.Float(pixel % size.x), mi.Float(pixel // size.x))
        position = corner + sampler.next_2d()
        on_film = mi.Point2f(position / mi.Vector2f(size))
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
        ray, weight = sensor.sample_ray_differential(0, sampler.next_1d(), on_film, aperture)
        return ray, weight / (probability * count), mi.Point2f(position + film.crop_offset())

    # ---------------------- Lights ----------------------

    def light_names(self, scene: mi.Scene) -> list[str]:
        """A name for each layer, in their order: the identifier of the emitter, or of the shape that emits, with a
        number if it consists of several lights or if another has the same."""
        names = []
        for e in scene.emitters():
            on_surface = e.flags() & mi.EmitterFlags.Surface and e.get_shape() is not None
            name = e.get_shape().id() if on_surface else e.id()
            names += [f"{name}{k:02d}" for k in range(e.light_count)] if hasattr(e, "light_count") else [name]
        return [n if names.count(n) == 1 else f"{n}_{names[:i].count(n)}" for i, n in enumerate(names)]

    def _lights(self, scene) -> Lights:
        mirrors = any(s.bsdf() is not None and s.bsdf().flags() & mi.BSDFFlags.Delta for s in scene.shapes())
        for e in scene.emitters():
            if not hasattr(e, "light_count") or e.flags() & mi.EmitterFlags.Delta:
                continue
            who = f'{self.name}: "{e.id()}" ({e.class_name()})'
            if getattr(e, "background", None) is not None:
                raise Refusal(f"{who} has a background, which is none of its lights; make it an emitter of its own")
            if mirrors or not self.hide_emitters:
                where = "in perfect mirrors; make these rough" if mirrors else 'directly; set "hide_emitters"'
                raise Refusal(f"{who} has several lights, and which of them is seen is unknown {where}")
        lights = Lights(scene)
        if len(lights) < max(self.lights_per_path, 1):
            few = f'only {len(lights)} of "lights_per_path" {self.lights_per_path}' if len(lights) else "no"
            raise Refusal(f"{self.name}: the scene has {few} lights")
        return lights

    def _paths(self, scene) -> LightPaths:
        return LightPaths(self.TRACER(scene, self), self._lights(scene), self.lights_per_path, self.min_depth)

    def _choice(self, sampler, seed) -> mi.Float | None:
        """Random numbers that choose lights, stratified over the samples of a pixel, or over neighbours."""
        return stratified(sampler, seed) if self.lights_per_path else None


def _whole(who: str, props: mi.Properties, key: str, default: int, least: int, most: int | None) -> int:
    value = props.get(key, default)
    if not is_whole(value) or value < least or (most is not None and value > most):
        wanted = f">= {least}" if most is None else f"from {least} to {most}"
        raise InputError(f'{who}: "{key}" must be a whole number {wanted}, got {value}')
    return value


mi.register_integrator("rig", RigIntegrator)
