"""Images by paths from both ends: what `bdpt` and `bdpt_edge` have in common."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from rimlight._collection import no_collection
from rimlight.edge_sampling.refusals import InputError, Refusal
from rimlight.terms.sampling import in_a_row, seed_of, seed_of_pass
from rimlight.transport.bidirectional import CameraPaths
from rimlight.transport.emission import Emission
from rimlight.transport.film_views import FilmViews
from rimlight.transport.found_light import Total
from rimlight.transport.light_subpaths import LightSubpaths, Ways
from rimlight.transport.tracer import PathTracer

from ._light_image import LightImage
from ._limits import Media


@no_collection()
def render(it, scene, sensor, seed, spp, develop, *, per_pass=None, ways=(None, None), around=None):
    """The image, as Mitsuba has it.

    it : the integrator, which tells `depths`, `light_paths` and `hide_emitters`.
    per_pass : samples per pixel that are in memory at once; None: all.
    ways : numbers of vertices from the light and from the camera of the paths that are rendered; None: any.
    around : the scene, see `Emission`.

    Raises
    ------
    RuntimeError : there are participating media, or the passes do not add up to the samples per pixel.
    """
    if not develop:
        raise Refusal(f"{it.name}: images are developed; leave develop=False out")
    if Media(scene).found:
        raise Refusal(f"{it.name}: participating media are not supported: remove them, or use Mitsuba's volpath")
    sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    with dr.suspend_grad():
        sampler, spp = it.prepare(sensor, seed, spp, [])
        per_pass = min(per_pass or spp, spp)
        if spp % per_pass:
            raise Refusal(f'{it.name}: "spp_per_pass", {per_pass}, must divide the {spp} samples per pixel')
        film = sensor.film()
        light, block = LightImage(film, spp), film.create_block()
        block.set_coalesce(block.coalesce() and per_pass >= 4)
        pixels = sampler.wavefront_size() // spp
        for i in range(spp // per_pass):
            if per_pass < spp:
                sampler = _of_pass(sampler, seed_of_pass(seed, i), per_pass, pixels)
            lights = max(1, round(pixels * per_pass * it.light_paths))
            _trace(
                it,
                Emission(scene, around),
                Ways.of(*ways),
                scene,
                sensor,
                sampler,
                in_a_row(sensor, seed_of("light paths", seed_of_pass(seed, i)), lights),
                light,
                block,
            )
            if per_pass < spp:
                dr.eval(block.tensor(), light.block.tensor())
        light.add_to(block)
        return film.develop()


def _trace(it, emission, ways, scene, sensor, sampler, light_sampler, light: LightImage, block: mi.ImageBlock):
    """Add samples to the images of light subpaths and of camera paths."""
    film = sensor.film()
    count, lights = sampler.wavefront_size(), light_sampler.wavefront_size()
    views = FilmViews(sensor, count // sampler.sample_count(), lights / count)
    subpaths = LightSubpaths(scene, emission, it.depths, ways, hide_emitters=it.hide_emitters)
    # All samples of a wavefront happen at one time: nothing in Mitsuba moves.
    vertices, *_ = subpaths.trace(light_sampler, lights, sensor.shutter_open(), views, light)
    ray, ray_weight, u = it.sample_rays(scene, sensor, sampler)
    pi = PathTracer(scene, it).first_hit(ray, True)
    camera = CameraPaths(scene, emission, it.depths, ways, hide_emitters=it.hide_emitters)
    first, shorter = camera.from_camera(ray, pi, u, views)
    got, valid = camera.trace(first, shorter, sampler, vertices, Total(dr.zeros(mi.Spectrum, count)), mi.Bool(True))
    valid |= scene.environment() is not None and not it.hide_emitters
    L = got.L
    alpha = dr.select(valid, mi.Float(1), 0)
    ADIntegrator._splat_to_block(block, film, u, L * ray_weight, 1.0, alpha, [], ray.wavelengths)


def light_paths_of(props: mi.Properties) -> float:
    """The property `light_paths`.

    Raises
    ------
    ValueError : it is out of range, or the variant is one of those that have no light subpaths.
    """
    who, value = props.plugin_name(), props.get("light_paths", 0.5)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 16:
        raise InputError(f'{who}: "light_paths" must be a number above 0 and up to 16, got {value}')
    if mi.is_polarized or mi.is_spectral:
        kind = "polarised" if mi.is_polarized else "spectral"
        other = "prb_edge" if who == "bdpt_edge" else "Mitsuba's path"
        raise InputError(
            f"{who}: {kind} variants are not supported, got {mi.variant()}: set an rgb or mono variant, or use {other}"
        )
    return float(value)


def _of_pass(sampler: mi.Sampler, seed: int | mi.UInt32, spp: int, pixels: int) -> mi.Sampler:
    sampler = sampler.clone()
    sampler.set_sample_count(spp)
    if sampler.sample_count() != spp:
        raise Refusal(
            f'bdpt: the sampler takes {sampler.sample_count()} samples per pixel for the {spp} of "spp_per_pass": '
            "set that number"
        )
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, pixels * spp)
    return sampler
