"""The choice of an edge for one of two kinds of light: what lamps emit, or what surfaces scatter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import EdgeSample, Reservoir
from rimlight.edge_sampling.parametrisation import Division, Vicinity

#: Part of the samples that are for emitted light, where both kinds of light may come past an edge.
EMISSION = 2 / 3


def either(emitted: mi.Bool, to_lamp: Division, to_surface: Division) -> Division:
    """How the light is divided that lamps emit, or that surfaces scatter."""
    radius, turning = dr.select(emitted, to_lamp.vicinity.radius, to_surface.vicinity.radius), to_lamp.turning
    return Division(Vicinity(radius), turning and replace(turning, size=dr.select(emitted, turning.size, 0)))


def chosen_edge(
    candidate: Callable, number: int, choice: mi.Float, emission: mi.Bool, scattering: mi.Bool, sampler: mi.Sampler
) -> tuple[EdgeSample, mi.Bool]:
    """Of a number of candidates one: for emitted light, or for scattered light. If there are both, a reservoir of each
    takes half of the candidates, and one of the two is kept. And is it for emitted light?

    candidate : makes one, given a uniform number, the kind of light, and a mask. number : even, but for one kind alone.
    choice : uniform in [0, 1); the
    numbers of each kind are stratified by it.
    """
    active, half = emission | scattering, number // 2
    both = emission & scattering
    count = dr.select(both, mi.Float(half), number)

    def look(k, emitted, scattered, sampler):
        is_emitted = emission & (~scattering | (k < half))
        e, target = candidate((choice + dr.select(both, k % half, k)) / count, is_emitted, active, sampler)
        fuller, _ = dr.select(is_emitted, emitted, scattered).take(e, target, sampler, active)
        return k + 1, dr.select(is_emitted, fuller, emitted), dr.select(is_emitted, scattered, fuller), sampler

    width = dr.width(active)
    _, emitted, scattered, _ = dr.while_loop(
        (dr.zeros(mi.UInt32, width), dr.zeros(Reservoir, width), dr.zeros(Reservoir, width), sampler),
        lambda k, *_: active & (k < number),
        look,
        label="candidates",
    )
    p = dr.select(scattered.total > 0, EMISSION, mi.Float(1))
    p = dr.select(emitted.total > 0, p, 0)
    for_emission = sampler.next_1d(active) < p
    e = dr.select(for_emission, emitted, scattered).kept(count)
    e.density *= dr.select(for_emission, p, 1 - p)
    return e, for_emission
