"""What the integrators with edge sampling share: sample counts, the edges of a scene, and the way to a derivative image."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.ad.integrators.common import ADIntegrator

from rimlight.edge_sampling import Edges, FilmBoundary, Geometry, Projection, ShadingBoundary, find_edges, jumping_textures


@dataclass(frozen=True)
class Boundaries:
    """What samples the edges of a scene, for one answer to the question which meshes move, and whether the camera does."""

    film: FilmBoundary
    shading: ShadingBoundary
    camera_moves: bool


class EdgeIntegrator(ADIntegrator):
    """Base of the integrators whose derivative has an interior term, from `sample`, and a boundary term, from the edges of the scene.

    A subclass provides ``sample(mode, scene, sampler, ray, active)`` and ``sample_shading_boundary(scene, sampler, ray, boundaries)``, see
    `DirectEdgeIntegrator`.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.name = props.plugin_name()
        if mi.is_polarized:
            raise ValueError(f"{self.name}: polarised variants are not supported, got {mi.variant()}")
        self.sppc, self.sppp, self.sppi = (self._sample_count(props, key) for key in ("sppc", "sppp", "sppi"))
        self._geometry: Geometry | None = None
        self._edges: Edges | None = None
        self._boundaries: dict[tuple, Boundaries] = {}
        self._warned: set[str] = set()

    def to_string(self) -> str:
        return f"{type(self).__name__}[sppc={self.sppc}, sppp={self.sppp}, sppi={self.sppi}, hide_emitters={self.hide_emitters}]"

    # ---------------------- Mitsuba's interface ----------------------

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the image along the gradients that are set on the parameters.

        Returns
        -------
        mi.TensorXf, (H, W, C), linear radiance per unit of the parameter.
        """
        with dr.suspend_grad():
            image = self._attached_image(scene, sensor, seed, spp, dr.ADMode.Forward)
            # A parameter that carries a gradient may well not show in the image: then the derivative is zero. None at all is a mistake.
            free = dr.ADFlag.AllowNoGrad if params is not None and dr.grad_enabled(dict(params)) else dr.ADFlag(0)
            with dr.resume_grad():
                dr.forward_to(image, flags=dr.ADFlag.Default | free)
        return dr.grad(image)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add to the gradients of the parameters what `grad_in`, (H, W, C), the gradient of a loss with respect to the image, makes of them."""
        with dr.suspend_grad():
            image = self._attached_image(scene, sensor, seed, spp, dr.ADMode.Backward)
            with dr.resume_grad():
                dr.set_grad(image, grad_in)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
            dr.eval()

    # ---------------------- Derivative image ----------------------

    def _attached_image(self, scene, sensor, seed, spp, mode) -> mi.TensorXf:
        """An image whose values mean nothing, and whose gradient is that of the rendered image."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        film = sensor.film()
        film.prepare([])
        sppc, sppp, sppi = (self._override(own, spp, sensor) for own in (self.sppc, self.sppp, self.sppi))
        boundaries = self._boundaries_of(scene, sensor, sppi)

        # ---------------------- Interior ----------------------

        # Without interior samples, zeros still tell how much the filter weighs at each pixel.
        sampler, weights = self._sampler(sensor, seed, sppc or 16)
        ray, ray_weight, position = self.sample_rays(scene, sensor, sampler)
        L, valid = mi.Spectrum(0), mi.Bool(False)
        if sppc > 0:
            L, valid, _, _ = self.sample(mode, scene, sampler, ray)
        with dr.resume_grad():
            block = film.create_block()
            block.set_coalesce(block.coalesce() and weights >= 4)
            alpha = dr.select(valid, mi.Float(1), 0)
            ADIntegrator._splat_to_block(block, film, position, L * ray_weight, 1.0, alpha, [], ray.wavelengths)
            film.put_block(block)

        # At a pixel, the weights of the interior samples add up to `weights` times the integral of the filter. The film divides by that sum: so
        # samples of boundaries, of weight zero, are normalised as the image is, for every filter.

        # ---------------------- Film boundary ----------------------

        if boundaries is not None and sppp > 0:
            sampler, _ = self._sampler(sensor, 0xFFFFFFFF ^ seed, sppp)
            radiance = lambda *args: self._primal(scene, *args)
            s = boundaries.film.sample(sensor, sampler, sampler.wavefront_size(), radiance)
            with dr.resume_grad():
                block = film.create_block()
                block.set_coalesce(False)
                value, alpha = s.value * weights, s.alpha * weights
                ADIntegrator._splat_to_block(block, film, s.position, value, 0.0, alpha, [], s.wavelengths)
                film.put_block(block)

        # ---------------------- Boundaries at shading points ----------------------

        if boundaries is not None and sppi > 0 and scene.emitters():
            sampler, sppi = self._sampler(sensor, 0xAAAAAAAA ^ seed, sppi)
            ray, ray_weight, position = self.sample_rays(scene, sensor, sampler)
            L = self.sample_shading_boundary(scene, sampler, ray, boundaries)
            with dr.resume_grad():
                L *= ray_weight
                block = film.create_block()
                block.set_coalesce(block.coalesce() and sppi >= 4)
                ADIntegrator._splat_to_block(block, film, position, L * (weights / sppi), 0.0, 0.0, [], ray.wavelengths)
                film.put_block(block)

        with dr.resume_grad():
            return film.develop()

    def _primal(self, scene, ray, sampler, active) -> tuple[mi.Spectrum, mi.Float]:
        L, valid, _, _ = self.sample(dr.ADMode.Primal, scene, sampler, ray, active=active)
        return L, dr.select(valid, mi.Float(1), 0)

    # ---------------------- What moves ----------------------

    def _boundaries_of(self, scene, sensor, sppi) -> Boundaries | None:
        """The edges that can contribute, or None where nothing moves."""
        if self._geometry is None or self._geometry.key() != Geometry.of(scene).key():
            self._geometry = Geometry.of(scene)
            self._edges = find_edges(self._geometry)
            self._boundaries = {}
        geometry = self._geometry
        with dr.resume_grad():
            geometry.refuse_moving_others(self.name)
            moving = geometry.moving()
            camera_moves = Projection(sensor).attached
        if camera_moves and geometry.others:
            names = ", ".join(f'"{s.id()}" ({s.class_name()})' for s in geometry.others)
            raise RuntimeError(
                f"{self.name}: the camera moves past {names}, whose silhouettes cannot be sampled yet. Replace them by meshes."
            )
        if not camera_moves and not any(moving):
            return None
        self._warn_of_limits(scene, sppi)
        key = (moving, camera_moves)
        if key not in self._boundaries:
            on_film = self._edges if camera_moves else self._edges.of_meshes(np.array(moving))
            self._boundaries[key] = Boundaries(
                FilmBoundary(geometry, on_film), ShadingBoundary(geometry, self._edges, moving), camera_moves
            )
        return self._boundaries[key]

    def _warn_of_limits(self, scene, sppi) -> None:
        if sppi > 0 and any(e.flags() & mi.EmitterFlags.Delta for e in scene.emitters()):
            self._warn_once("the derivative lacks the motion of the hard shadows of point, spot and directional lights; "
                            'give them a size, or set "sppi" to 0 to accept this.')
        if sppi > 0 and any(s.bsdf() is not None and s.bsdf().flags() & mi.BSDFFlags.Delta for s in scene.shapes()):
            self._warn_once("the derivative lacks the motion of edges seen in perfect mirrors and glass; "
                            'give them a roughness, or set "sppi" to 0 to accept this.')
        textures = jumping_textures(scene)
        if textures:
            self._warn_once(f"the derivative lacks the jumps of the textures {', '.join(textures)}; use a bilinear bitmap.")

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            mi.Log(mi.LogLevel.Warn, f"{self.name}: {message}")

    # ---------------------- Sample counts ----------------------

    def _sample_count(self, props: mi.Properties, key: str) -> int | None:
        value = props.get(key, None)
        if value is not None and (not isinstance(value, int) or value < 0):
            raise ValueError(f'{self.name}: "{key}" must be a whole number >= 0, got {value}')
        return value

    @staticmethod
    def _override(own: int | None, spp: int, sensor: mi.Sensor) -> int:
        """0 in the scene file switches a term off; otherwise the call comes before the scene file, and that before the sampler."""
        return 0 if own == 0 else spp or own or sensor.sampler().sample_count()

    @staticmethod
    def _sampler(sensor: mi.Sensor, seed: int, spp: int) -> tuple[mi.Sampler, int]:
        """A sampler for one wavefront over the film, and its samples per pixel (some kinds round them up)."""
        film = sensor.film()
        size = np.array(film.crop_size()) + (2 * film.rfilter().border_size() if film.sample_border() else 0)
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()
        count = int(np.prod(size)) * spp
        if count > 2**32:
            raise RuntimeError(f"{count} samples in one wavefront exceed 2^32: use fewer samples per pixel and average several seeds")
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, count)
        return sampler, spp
