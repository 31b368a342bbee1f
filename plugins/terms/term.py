"""What a term is, and what it makes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight._plan import PlannedTerm
from rimlight.edge_sampling import FilmPart, film_parts
from rimlight.edge_sampling.boundaries.found import Boundaries
from rimlight.transport.cut import Cut
from rimlight.transport.replay import MovingVertex, Replay
from rimlight.transport.tracer import PathTracer

from .sampling import Counts, per_pixel, seed_of_pass, size

#: Name of the term whose samples are those of the image.
INTERIOR = "interior"

#: Longest path that a plan counts rays of.
LONG = 16


@dataclass
class Sample:
    """Radiance and alpha of film samples, or their derivatives. (A Dr.Jit structure: not frozen.)"""

    L: mi.Spectrum
    alpha: mi.Float

    #: Numbers of the film besides light.
    channels = ()

    def zeros(self, width: int) -> Sample:
        return dr.zeros(Sample, width)


@dataclass(frozen=True)
class FilmSamples:
    """The film samples of one term of the derivative.

    position : mi.Point2f, (N,), pixels.
    value : attached; only its gradient counts.
    weight : of each sample in the film's weight channel.
    per_pixel : how many neighbours in the wavefront belong to one pixel, 0 if they are in no order.
    replay : None, or what differentiates the part of the path that `value` is not attached to.
    throughput : of the camera ray, which weighs that part.
    cuts : where `value` is cut from what it depends on: they hand gradients on in backward mode, one after the other.
    one_pixel : do they count for the pixel alone in which they are, and not by its filter?
    """

    position: mi.Point2f
    value: Sample
    wavelengths: mi.Spectrum
    weight: float
    per_pixel: int
    replay: Replay | None = None
    throughput: mi.Spectrum | None = None
    cuts: tuple[MovingVertex | Cut, ...] = ()
    one_pixel: bool = False

    def detached(self) -> FilmSamples:
        return replace(self, value=dr.detach(self.value))


def forward(make: Callable[[], FilmSamples]) -> tuple[FilmSamples, Sample]:
    """Film samples of a term, detached, and their derivatives along the gradients that are set on the parameters."""
    samples = make()
    with dr.resume_grad():
        # A parameter that carries a gradient may well not show in the image: then the derivative is zero.
        start = samples.replay.start if samples.replay is not None else mi.Float(0)
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        value, start = dr.forward_to([samples.value, start], flags=flags)
    samples = samples.detached()
    if samples.replay is not None:
        value.L += samples.throughput * samples.replay.forward(start)
    return samples, value


@dataclass(frozen=True)
class Job:
    """One derivative: of what, as seen from where, along which boundaries, with how many samples.

    sample_rays : maps a sampler to camera rays, their weights, and film positions in pixels.
    terms : of the derivative, in their order.
    shares : by what the samples of a term are multiplied, by its name; 1 if it is not there.
    walks : paths that terms share, by their samples per pixel: see `walked`.
    """

    tracer: PathTracer
    sensor: mi.Sensor
    boundaries: Boundaries
    counts: Counts
    sample_rays: Callable[[mi.Sampler], tuple[Any, Any, Any]]
    seed: int | mi.UInt32 = 0
    mode: dr.ADMode = dr.ADMode.Primal
    terms: tuple[Term, ...] = ()
    shares: dict[str, float] = field(default_factory=dict)
    walks: dict[int, Any] = field(default_factory=dict)

    @property
    def each(self) -> list[tuple[Term, Job]]:
        """The terms, and what each is to do of it."""
        if not self.shares:
            return [(term, self) for term in self.terms]
        shares = [[self.shares.get(name, 1.0) for name in (INTERIOR, term.name)] for term in self.terms]
        counts = [self.counts.shared(*share) for share in shares]
        return [(term, replace(self, counts=own)) for term, own in zip(self.terms, counts, strict=True)]

    def divided(self, at_once: int) -> list[Job]:
        """The same in passes of equal size, with other random numbers each. Of no term, one of them has more than
        `at_once` samples, rounded up to whole samples per pixel."""
        counts = [own.counts for _, own in self.each]
        samples = [max(c.interior, c.shading) * self.pixels for c in counts]
        samples += [c.on_line(part.sensor.film()) for c in counts for part in self.parts]
        spp = max(self.counts.interior, self.counts.film, self.counts.shading, 1)
        needed = min(max(-(-max(samples) // at_once), 1), spp)
        # Else some more samples are made, so that all passes have as many.
        number = next((n for n in range(needed, min(2 * needed, spp + 1)) if spp % n == 0), needed)
        if number == 1:
            return [self]
        of_each = self.counts.part(number)
        return [replace(self, counts=of_each, seed=seed_of_pass(self.seed, i), walks={}) for i in range(number)]

    @cached_property
    def parts(self) -> list[FilmPart]:
        """Of the film."""
        return film_parts(self.sensor)

    @cached_property
    def weights(self) -> int:
        """At each pixel, the weights of the interior samples add up to so many times the integral of the filter. The
        film divides by that sum: so samples of boundaries, of weight zero, are normalised as the image is, for every
        filter."""
        return per_pixel(self.sensor, self.counts.weights)

    # ---------------------- For plans ----------------------

    @property
    def pixels(self) -> int:
        width, height = size(self.sensor.film())
        return width * height

    @property
    def segments(self) -> int:
        """Of the longest path that a plan counts."""
        return min(self.tracer.depths.max_depth, LONG)

    @property
    def rays_of_path(self) -> int:
        return 1 + 2 * max(self.segments - 1, 0)


class Term(ABC):
    """A term of the derivative.

    name : what it is, in plans; its seed goes by it.
    of_property : the property of an integrator that fixes its number of samples.
    effort : about how long one of its rays takes, choice of edges included, relative to one of the interior.
    """

    name: str
    of_property: str = "sppi"
    effort: float = 1.0

    @abstractmethod
    def planned(self, job: Job) -> PlannedTerm:
        """What it will do."""

    @abstractmethod
    def samples(self, job: Job) -> list[Callable[[], FilmSamples]]:
        """What makes its film samples, one after the other: nothing is traced before these are called."""

    def plan(self, samples: int, rays: int, why: str, why_not: str) -> PlannedTerm:
        """samples : 0 if it is left out."""
        return PlannedTerm(self.name, samples, rays if samples else 0, why if samples else why_not)
