"""Plugin `bdpt_edge`: bidirectional path tracing, with the derivative of visibility."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from rimlight.terms.bidirectional import BidirectionalTerm
from rimlight.terms.deep import DeepShadowsTerm
from rimlight.terms.indirect import ContinuedShadowsTerm
from rimlight.terms.order import TERMS
from rimlight.terms.sampling import in_a_row, seed_of
from rimlight.terms.term import Job
from rimlight.transport.bidirectional_tracer import BidirectionalTracer
from rimlight.transport.emission import Around
from rimlight.transport.replay import LONG

from . import prb_edge
from ._bidirectional_image import light_paths_of, render
from ._bidirectional_limits import BidirectionalLimits


class BDPTEdgeIntegrator(prb_edge.PRBEdgeIntegrator):
    r"""
    .. _integrator-bdpt_edge:

    Bidirectional path tracing with edge sampling (:monosp:`bdpt_edge`)
    -------------------------------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path, in segments, as in ``path``, at most 32: 1 shows emitters only, 2 adds direct illumination.
         (Default: 6)

     * - rr_depth
       - |int|
       - From this depth on, paths end at random ("Russian roulette"). (Default: 5)

     * - light_paths
       - |float|
       - Paths that start on lights, for each path that starts at the camera. (Default: 0.5)

     * - sppc, sppp, sppi
       - |int|
       - Samples per pixel of the terms of the derivative, as in ``prb_edge``.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``bdpt`` renders, and differentiates it with respect to what ``prb_edge`` differentiates. Use it where
    light is hard to find from the camera, such as caustics and the light of lamps in shades or behind doors. In the
    open, ``prb_edge`` takes about half of its time for the same noise; ``rimlight plan --images`` says which suits.

    **Interior.** Each camera path and each light path keeps one of the paths that were made of it, in proportion to its
    light, and differentiates this path alone, from its light to the camera. Vertices are held as in ``prb_edge``,
    however they were found: see the documentation under "Theory". In memory are 28 to 40 bytes for each vertex.

    **Boundaries** are those of ``prb_edge``. What is seen on both sides of them is connected with light paths. Shadows
    in indirect light go on from where they fall, too, and edges are looked for from surfaces that light paths meet.

    **Memory.** As with ``direct_edge``, many samples are taken in passes: 256 × 256 pixels, 16 samples per pixel and
    paths of 8 segments need less than 1 GiB.

    **Limits.** Those of ``prb_edge``. The derivative knows only paths that bring light: with respect to a reflectance
    or a radiance that is 0, it is 0, with a warning. Missing, with a warning, are the caustics that perfect mirrors and
    glass throw in the light of emitters without size. Lamps with interpolated normals, emitters of several lights,
    ``directionalarea``, participating media, spectral and polarised variants are refused.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpt_edge">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpt_edge',
            'max_depth': 8
    """

    OPTIONS = (*prb_edge.PRBEdgeIntegrator.OPTIONS, "light_paths")
    FROM_SURFACES = True
    LONGEST = LONG
    TRACER = BidirectionalTracer
    TERMS = (BidirectionalTerm(), *TERMS[1:], DeepShadowsTerm(), ContinuedShadowsTerm())

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.light_paths, self.limits = light_paths_of(props), BidirectionalLimits()
        self._around: Around | None = None

    def _job(self, scene, sensor, seed, spp, mode) -> Job:
        """As that of `EdgeIntegrator`.

        Raises
        ------
        RuntimeError : the scene has lights or media of which paths from both ends have no derivative.
        """
        job = super()._job(scene, sensor, seed, spp, mode)
        job.tracer.around = self._around
        return job

    def passes(self, job: Job) -> list[Job]:
        """As those of `EdgeIntegrator`, each with light paths of its own."""
        return [replace(part, tracer=self._with_light_paths(part)) for part in super().passes(job)]

    def _with_light_paths(self, job: Job) -> BidirectionalTracer:
        count = max(1, round(job.pixels * max(job.counts.shading, job.counts.film) * self.light_paths))
        tracer = copy(job.tracer)
        tracer.light_sampler = in_a_row(job.sensor, seed_of("light paths", job.seed, 1), count)
        return tracer

    def _boundaries(self, scene, sensor, sppi, find=None):
        self.limits.refuse(scene, self.name)
        boundaries = super()._boundaries(scene, sensor, sppi, find)
        boundaries = replace(boundaries, limits=(*boundaries.limits, *self.limits.of(scene)))
        if not dr.flag(dr.JitFlag.FreezingScope):
            self._around = Around(scene)
        return boundaries

    def find_boundaries(self, scene, sensor=0):
        """As that of `EdgeIntegrator`: give this to `dr.freeze` as `state_fn`."""
        return super().find_boundaries(scene, sensor), self._around

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The image, as Mitsuba has it."""
        sensor = self._sensor(scene, sensor)
        self._rendered.remember(scene, sensor, seed)
        around = self._around if dr.flag(dr.JitFlag.FreezingScope) else None
        return render(self, scene, sensor, seed, spp, develop, around=around)


mi.register_integrator("bdpt_edge", BDPTEdgeIntegrator)
