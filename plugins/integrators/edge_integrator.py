"""The base of the integrators with edge sampling: Mitsuba's interface, and the sum over the terms of a derivative."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.python.ad.integrators.common import ADIntegrator

from rimlight._collection import no_collection
from rimlight._plan import Plan, names
from rimlight.edge_sampling import Batch
from rimlight.edge_sampling.boundaries.found import Boundaries
from rimlight.edge_sampling.first_points import FirstPoints
from rimlight.edge_sampling.geometry.instances import copied_places
from rimlight.edge_sampling.refusals import InputError, Refusal
from rimlight.terms.order import TERMS
from rimlight.terms.sampling import AT_ONCE, Counts, over_film
from rimlight.terms.term import FilmSamples, Job, Sample, Term, forward
from rimlight.transport.paths import Depths
from rimlight.transport.tracer import PathTracer

from ._balance import RUNS, Balance, balanced
from ._depths import attribute, checked_depths
from ._finite import report_gradients, report_image, values_of
from ._options import check_options, is_whole
from ._rendered import CHANGED, Rendered
from ._search import BoundarySearch


class EdgeIntegrator(ADIntegrator):
    """Base of the integrators whose derivative has an interior term, of what a tracer finds along camera rays, and
    boundary terms, from the edges of the scene.

    max_depth, rr_depth : of paths, as in Mitsuba's `path`.

    Raises
    ------
    ValueError : a property is not among `OPTIONS`, or has a value that it cannot have.
    """

    #: Names of the properties. Subclasses that have more extend them.
    OPTIONS: tuple[str, ...] = ("sppc", "sppp", "sppi", "hide_emitters")

    #: The longest paths that it can trace; None: there are no longest ones.
    LONGEST: int | None = None

    depths: Depths | None = None
    max_depth, rr_depth = attribute("max_depth"), attribute("rr_depth")

    #: Properties that are accepted, but have no effect.
    IDLE: tuple[str, ...] = ()

    #: What traces paths: a subclass of `PathTracer`.
    TRACER: type[PathTracer] = PathTracer

    #: The terms of the derivative, in their order; the interior is the first.
    TERMS: tuple[Term, ...] = TERMS

    #: Does the derivative have what the planes of faces do to soft light, where other normals shade?
    PLANES = True

    #: Does it have boundaries as shading points see them?
    FROM_POINTS = True

    #: And as vertices of light subpaths see them?
    FROM_SURFACES = False

    #: May points of fine textures, and of polished curved shapes, be held where the camera sees them?
    HOLDS = False

    #: Can samples be divided among its terms, see `balance`?
    BALANCES = True

    #: Names of the channels that the film holds besides light.
    CHANNELS: Sequence[str] = ()

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        if "sample" in vars(cls):
            # Images would follow it, derivatives would not.
            raise TypeError(
                f"{cls.__name__}: derivatives do not call `sample`. Override `radiance` of a `PathTracer`, and name "
                "that tracer in `TRACER`, as the documentation shows under Extending."
            )

    def __init__(self, props: mi.Properties, max_depth: int = 2, rr_depth: int = 5):
        check_options(props, self.OPTIONS, self.IDLE)
        self.name = props.plugin_name()
        depths = checked_depths(self.name, max_depth, rr_depth, self.LONGEST)
        super().__init__(props)
        self.depths = depths
        if mi.is_polarized:
            raise InputError(f"{self.name}: polarised variants are not supported, got {mi.variant()}")
        self.sppc, self.sppp, self.sppi = (self._sample_count(props, key) for key in ("sppc", "sppp", "sppi"))
        options = {"planes": self.PLANES, "from_points": self.FROM_POINTS, "from_surfaces": self.FROM_SURFACES}
        self.search = BoundarySearch(self.name, self.depths, **options)
        #: By what the samples of a term are multiplied, by its name; empty: all have as many. See `balance`.
        self.shares: dict[str, float] = {}
        #: Most samples of a term that a derivative has in memory at once. See `passes`.
        self.at_once: int = AT_ONCE[dr.backend_v(mi.Float)]
        self._rendered = Rendered()
        self._warned: set[str] = set()

    def _sample_count(self, props: mi.Properties, key: str) -> int | None:
        value = props.get(key, None)
        if value is not None and (not is_whole(value) or value < 0):
            raise InputError(f'{self.name}: "{key}" must be a whole number >= 0, got {value}')
        return value

    def to_string(self) -> str:
        counts = f"sppc={self.sppc}, sppp={self.sppp}, sppi={self.sppi}"
        return f"{type(self).__name__}[{counts}, hide_emitters={self.hide_emitters}]"

    # ---------------------- Mitsuba's interface ----------------------

    @no_collection()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The image, as Mitsuba has it."""
        sensor = self._sensor(scene, sensor)
        self._rendered.remember(scene, sensor, seed)
        return super().render(scene, sensor, seed, spp, develop, evaluate)

    @no_collection()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the image along the gradients that are set on the parameters.

        Returns
        -------
        mi.TensorXf, (H, W, C), linear radiance per unit of the parameter.
        """
        self._refuse_without_gradient(params)
        with dr.suspend_grad(), copied_places(scene, dr.ADMode.Forward):
            job = self.job(scene, sensor, seed, spp, dr.ADMode.Forward)
            job.boundaries.refit()
            passes, images = self.passes(job), []
            weights = self._weights(passes) if len(passes) > 1 else None
            for part in passes:
                # One term after the other: path replay needs that nothing else is attached to the parameters.
                made = [forward(make) for term, own in part.each for make in term.samples(own)]
                images.append(self._develop(part.sensor.film(), *zip(*made, strict=True), weights))
                del made
                part.walks.clear()
                dr.eval(images)
            image = reduce(operator.add, images)
        report_image(self.name, image)
        return image

    @no_collection()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add to the gradients of the parameters what `grad_in`, (H, W, C), the gradient of a loss with respect to the
        image, makes of them."""
        # Isolated, so that what lies behind the parameters is traversed once, and last: the sensor's share comes late.
        with dr.isolate_grad(), dr.suspend_grad(), copied_places(scene, dr.ADMode.Backward):
            job = self.job(scene, sensor, seed, spp, dr.ADMode.Backward)
            job.boundaries.refit()
            passes = self.passes(job)
            weights = self._weights(passes) if len(passes) > 1 else None
            for part in passes:
                self._backward(part, grad_in, weights)
                part.walks.clear()
        report_gradients(self.name, params)

    def _backward(self, job: Job, grad_in: mi.TensorXf, weights: mi.ImageBlock | None) -> None:
        """`render_backward` with the samples of one pass. weights : see `_develop`."""
        terms = [make() for term, own in job.each for make in term.samples(own)]
        with dr.resume_grad():
            # The image is linear in the samples: differentiate the way from them to it by itself, so that no ray
            # is traced for it.
            values = [t.value.zeros(dr.width(t.position)) for t in terms]
            dr.enable_grad(values)
            image = self._develop(job.sensor.film(), terms, values, weights)
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
            # The interior by itself, and first: traversed together with the film boundary, or after it, Dr.Jit 1.5
            # loses what it gives to one mesh where another one has interpolated normals.
            # Those that are cut are not traversed with others: at what lies behind these, Dr.Jit evaluates all, but
            # the gradients at the cuts, which would then trace all rays again.
            pairs = list(zip(terms, values, strict=True))
            alone = [[pair] for i, pair in enumerate(pairs) if i == 0 or pair[0].replay is not None]
            others = [pair for i, pair in enumerate(pairs) if i > 0 and pair[0].replay is None]
            cut, whole = ([pair for pair in others if bool(pair[0].cuts) == is_cut] for is_cut in (True, False))
            for group in (*alone, cut, whole):
                for term, value in group:
                    gradient = dr.grad(value)
                    if term.replay is not None:
                        with dr.suspend_grad():
                            start = term.replay.backward(gradient.L * term.throughput)
                        dr.set_grad(term.replay.start, start)
                        dr.enqueue(dr.ADMode.Backward, term.replay.start)
                    dr.set_grad(term.value, gradient)
                    dr.enqueue(dr.ADMode.Backward, term.value)
                dr.traverse(dr.ADMode.Backward)
                cuts = [cut for term, _ in group for cut in term.cuts]
                # In the kernels of what they come from.
                dr.eval([cut.gradients for cut in cuts])
                for cut in cuts:
                    cut.backward()
        dr.eval()

    def _develop(
        self,
        film: mi.Film,
        terms: Sequence[FilmSamples],
        values: Sequence[Sample],
        weights: mi.ImageBlock | None = None,
    ) -> mi.TensorXf:
        """The image that the film makes of `values` at the positions of `terms`: (H, W, C).

        weights : what the film divides by; None: the weights of `terms`.
        """
        film.prepare(list(self.CHANNELS))
        if weights is not None:
            # Before what carries gradients: Mitsuba 3.9 would lose these.
            film.put_block(weights)
        for term, value in zip(terms, values, strict=True):
            block = film.create_block()
            if term.one_pixel:
                block = mi.ImageBlock(film.crop_size(), film.crop_offset(), block.channel_count())
            # Mitsuba may add up neighbours in a wavefront first, if those belong to one pixel.
            block.set_coalesce(block.coalesce() and term.per_pixel >= 4)
            weight = term.weight if weights is None else 0.0
            shown = value.L, weight, value.alpha, list(value.channels)
            ADIntegrator._splat_to_block(block, film, term.position, *shown, term.wavelengths)
            film.put_block(block)
        return film.develop()

    def _weights(self, passes: Sequence[Job]) -> mi.ImageBlock:
        """The weights that the film gives to the interior samples of all passes."""
        film = passes[0].sensor.film()
        film.prepare(list(self.CHANNELS))
        block = film.create_block()
        black = mi.Spectrum(0), 1.0, mi.Float(0), [mi.Float(0)] * len(self.CHANNELS)
        for part in passes:
            _, own = part.each[0]
            sampler, _ = over_film(own.sensor, own.seed, own.counts.weights)
            ray, _, u = own.sample_rays(sampler)
            ADIntegrator._splat_to_block(block, film, dr.detach(u), *black, ray.wavelengths)
            dr.eval(block.tensor())
        return block

    def sample(self, mode, scene, sampler, ray, active=True, **_):
        """Radiance along camera rays, as Mitsuba asks for it.

        Raises
        ------
        RuntimeError : it is asked for by an integrator that differentiates what comes back, such as Mitsuba's `aov`.
        """
        self._refuse_to_be_differentiated(scene)
        found = self.TRACER(scene, self).radiance(ray, sampler, mi.Bool(active), attached=mode != dr.ADMode.Primal)
        return found.L, found.valid, [], found.rest

    def _refuse_without_gradient(self, params) -> None:
        if params is not None and not any(dr.grad_enabled(v) for v in values_of(params).values()):
            raise Refusal(f"{self.name}: none of the parameters carries a gradient")

    def _refuse_to_be_differentiated(self, scene: mi.Scene) -> None:
        probe = mi.Float(0)
        dr.enable_grad(probe)
        # Our own calls suspend gradients.
        if dr.grad_enabled(probe) and any(dr.grad_enabled(v) for v in values_of(mi.traverse(scene)).values()):
            raise Refusal(
                f"{self.name}: an integrator around it, such as Mitsuba's aov, differentiates its samples, and would "
                "lack the motion of visibility. Use aov_edge around it, which has the same syntax; or render the image "
                "alone, within dr.suspend_grad()."
            )

    def sample_rays(self, scene, sensor, sampler):
        """Camera rays, their weights, and film positions in pixels, as Mitsuba has it."""
        batch = sensor.class_name() == "BatchSensor"
        return super().sample_rays(scene, Batch(sensor) if batch else sensor, sampler)

    # ---------------------- What is to be done ----------------------

    def job(self, scene, sensor, seed=0, spp=0, mode=dr.ADMode.Primal) -> Job:
        """A derivative with respect to the parameters that carry a gradient now. Warns of what it will lack."""
        if self._rendered.has_changed(scene, self._sensor(scene, sensor), seed):
            self._warn([CHANGED])
        job = self._job(scene, sensor, seed, spp, mode)
        self._warn(job.boundaries.limits)
        return job

    def _job(self, scene, sensor, seed, spp, mode) -> Job:
        """The same, without a warning."""
        sensor = self._sensor(scene, sensor)
        counts = self._counts(sensor, spp)
        boundaries = self._boundaries(scene, sensor, counts.shading)
        rays = lambda sampler: self.sample_rays(scene, sensor, sampler)
        tracer = self.TRACER(scene, self)
        tracer.slides, tracer.lights, tracer.lamps = boundaries.slides, boundaries.lights, boundaries.lamps
        tracer.fine_mirrors, tracer.brightens = boundaries.fine_mirrors, boundaries.brightens
        tracer.moving = boundaries.shading.moving_shapes if boundaries.shading is not None else None
        if boundaries.held is not None:
            tracer.held = FirstPoints(boundaries.held, sensor)
        return Job(tracer, sensor, boundaries, counts, rays, seed, mode, self.TERMS, self.shares)

    def passes(self, job: Job) -> list[Job]:
        """A derivative in parts, one after the other, of which each has at most `at_once` samples of a term in memory:
        itself, if it has no more. No part has less than one sample per pixel."""
        return job.divided(self.at_once)

    @no_collection()
    def plan(self, scene: mi.Scene, sensor: int | mi.Sensor = 0, spp: int = 0) -> Plan:
        """What a derivative with respect to the parameters that carry a gradient now will do, see `rimlight.plan`."""
        with dr.suspend_grad():
            job = self._job(scene, sensor, 0, spp, dr.ADMode.Primal)
        found, search = job.boundaries, self.search
        shapes = zip(search.geometry.known, found.moving, strict=False)
        return Plan(
            integrator=self.name,
            moving=names(s for s, moves in shapes if moves),
            camera_moves=found.camera_moves,
            lights_move=found.lights_move,
            edges=len(search.edges),
            tree=found.silhouettes.leaves if found.silhouettes is not None else 0,
            terms=tuple(term.planned(own) for term, own in job.each),
            limits=found.limits,
        )

    @no_collection()
    def balance(
        self, scene: mi.Scene, params: Any = None, sensor: int | mi.Sensor = 0, seed: int = 0, spp: int = 16
    ) -> Balance:
        """Divide samples among the terms so that derivatives like this one have the least error in a given time.

        The noise of each term is measured along the gradients that are set on the parameters, as `render_forward` has
        them: `RUNS` derivatives with `spp` samples per pixel. From then on, in derivatives forward and backward, each
        term takes its share of the samples per pixel that are asked for, at least one. What a number of samples was
        given for in the scene file ("sppc", "sppp", "sppi") has the share 1. Estimates stay without bias whatever the
        shares. Frozen functions that were recorded before keep the shares of that time.

        Returns
        -------
        What was measured; `integrator.shares` has the shares, which may be kept, and set again.

        Raises
        ------
        RuntimeError : none of the parameters carries a gradient, the derivatives along these are zero or not finite, or
            `dr.freeze` records.
        """
        if not self.BALANCES:
            raise Refusal(f"{self.name} does not divide its samples; direct_edge or prb_edge does")
        self._refuse_without_gradient(params)
        if dr.flag(dr.JitFlag.FreezingScope):
            raise Refusal(f"{self.name}: a frozen function cannot measure noise: call `balance` before it")
        self.shares = {}
        with dr.suspend_grad(), copied_places(scene, dr.ADMode.Forward):
            jobs = [self.job(scene, sensor, seed + run, spp, dr.ADMode.Forward) for run in range(RUNS)]
            images = [self._images_of_terms(job) for job in jobs]
            plans = {term.name: term.planned(jobs[0]) for term in self.TERMS}
        cost = {term.name: term.effort * plans[term.name].samples * plans[term.name].rays for term in self.TERMS}
        fixed = {term.name for term in self.TERMS if getattr(self, term.of_property)}
        found = balanced({name: np.array([image[name] for image in images]) for name in cost}, cost, fixed)
        total = sum(found.noise.values())
        if not 0 < total < np.inf:
            what = "zero" if total == 0 else "not finite"
            raise Refusal(
                f"{self.name}: the derivatives to be measured are {what}: set gradients on the parameters along a "
                "motion that shows, as for `render_forward`"
            )
        self.shares = found.shares
        return found

    def _images_of_terms(self, job: Job) -> dict[str, np.ndarray]:
        """The derivative that each term makes of the image."""
        job.boundaries.refit()
        passes = self.passes(job)
        weights, images = self._weights(passes), {term.name: 0.0 for term in self.TERMS}
        for part in passes:
            for term in self.TERMS:
                made = [forward(make) for make in term.samples(part)]
                samples, values = zip(*made, strict=True) if made else ((), ())
                images[term.name] += np.array(self._develop(job.sensor.film(), samples, values, weights), np.float64)
            part.walks.clear()
        return images

    @no_collection()
    def find_boundaries(self, scene, sensor=0) -> Boundaries:
        """Find the edges that can contribute to a derivative with respect to the parameters that carry a gradient now.

        Derivatives do this by themselves, but not inside of a function that `dr.freeze` records, since the search runs
        on the host. Give this as the function's `state_fn`.

        Returns
        -------
        What a frozen function depends on (a PyTree).
        """
        sensor = self._sensor(scene, sensor)
        with dr.suspend_grad():
            found = self._boundaries(scene, sensor, self._counts(sensor, 0).shading, self.search.prepare)
        self._warn(found.limits)
        return found

    def _boundaries(self, scene, sensor, sppi, find=None) -> Boundaries:
        self.search.depths = self.depths
        # Without the film boundary, or the interior, the other one is to be what it is by itself. Tracers of others
        # need not know of it.
        self.search.holds = self.HOLDS and self.TRACER is PathTracer and self.sppc != 0 and self.sppp != 0
        return (find or self.search.boundaries)(scene, sensor, sppi)

    def _warn(self, limits: Sequence[str]) -> None:
        """Say what a derivative lacks, once."""
        for message in limits:
            if message not in self._warned:
                self._warned.add(message)
                mi.Log(mi.LogLevel.Warn, f"{self.name}: {message}")

    def _counts(self, sensor: mi.Sensor, spp: int) -> Counts:
        return Counts.of(self.sppc, self.sppp, self.sppi, spp, sensor)

    @staticmethod
    def _sensor(scene, sensor) -> mi.Sensor:
        return scene.sensors()[sensor] if isinstance(sensor, int) else sensor
