"""How many samples each term takes, and by which random numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.refusals import Refusal

#: What the seed of a call is changed by for each term (exclusive or), so that no two share their random numbers. The
#: interior term has the seed itself: its samples are those of the image.
SALT = {"film boundary": 0xFFFFFFFF, "shadows from lights": 0xAAAAAAAA, "edges from points": 0x55555555}
SALT |= {"planes of faces": 0x33333333, "shadows in indirect light": 0x99999999}
SALT |= {"mirrors and textures": 0x66666666, "horizons from points": 0x22222222}
SALT |= {"shadows in light from surfaces": 0x88888888, "shadows in indirect light, continued": 0x77777777}
SALT |= {"light paths": 0xCCCCCCCC, "paths": 0xBBBBBBBB, "passing surfaces": 0xDDDDDDDD, "planes of lamps": 0xEEEEEEEE}
SALT |= {"mirrors from points": 0x44444444}

#: Samples of the film boundary at one sample per pixel: at most so many times width plus height of the film.
LINE = 16

#: Most samples of a term of a derivative in memory at once, by where they are. See `Job.divided`.
AT_ONCE = {dr.JitBackend.LLVM: 2**18, dr.JitBackend.CUDA: 2**21}


def seed_of(term: str, seed: int | mi.UInt32, part: int = 0) -> int | mi.UInt32:
    """Seed of a term, on one part of the film, in a call with this seed."""
    return SALT[term] ^ (seed ^ part << 16)


def seed_of_pass(seed: int | mi.UInt32, i: int) -> int | mi.UInt32:
    """Seed of the i-th of several passes; the first one has the seed of the call."""
    return seed if i == 0 else mi.sample_tea_32(seed, i)[0]


@dataclass(frozen=True)
class Counts:
    """Samples per pixel: of the interior, of the film boundary, of the boundaries at shading points; 0: none.

    sppp_given : was a number of samples of the film boundary asked for in the scene?
    """

    interior: int
    film: int
    shading: int
    sppp_given: bool

    @staticmethod
    def of(sppc: int | None, sppp: int | None, sppi: int | None, spp: int, sensor: mi.Sensor) -> Counts:
        """From the properties of an integrator (None: not given) and the samples per pixel of a call (0: not given).

        0 in the scene file switches a term off. Else the call comes first, then the scene file, then the sampler.
        """
        count = lambda own: 0 if own == 0 else spp or own or sensor.sampler().sample_count()
        return Counts(count(sppc), count(sppp), count(sppi), bool(sppp))

    def shared(self, interior: float, term: float) -> Counts:
        """Those of one term: its share of samples, and that of the interior, which the film's weights follow."""
        times = lambda count, share: count and max(1, round(count * share))
        return replace(
            self,
            interior=times(self.interior, interior),
            film=times(self.film, term),
            shading=times(self.shading, term),
        )

    def part(self, number: int) -> Counts:
        """Those of one of so many passes, at least one where there are any."""
        each = (-(-count // number) for count in (self.interior, self.film, self.shading))
        return Counts(*each, self.sppp_given)

    def on_line(self, film: mi.Film) -> int:
        """Samples of the film boundary in all. A line covers few pixels: unless a number of samples was asked for, so
        many a pixel of it are enough."""
        width, height = size(film)
        return self.film * (width * height if self.sppp_given else min(width * height, LINE * (width + height)))

    @property
    def weights(self) -> int:
        """Samples per pixel of the wavefront whose weights the film divides by: of the interior, or without them so
        many zeros, which still tell how much the filter weighs at each pixel."""
        return self.interior or 16


def size(film: mi.Film) -> tuple[int, int]:
    """Width and height of what is sampled, in pixels."""
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    return tuple(int(n) + border for n in film.crop_size())


def per_pixel(sensor: mi.Sensor, spp: int) -> int:
    """Samples per pixel that the sensor's sampler takes if it is asked for `spp`: some kinds round them up."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    return sampler.sample_count()


def over_film(
    sensor: mi.Sensor, seed: int | mi.UInt32, spp: int, film: mi.Film | None = None
) -> tuple[mi.Sampler, int]:
    """A sampler for one wavefront over the film, and its samples per pixel."""
    width, height = size(film or sensor.film())
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    count = width * height * spp
    if count > 2**32:
        raise Refusal(
            f"{count} samples in one wavefront exceed 2^32: use fewer samples per pixel and average several seeds"
        )
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, count)
    return sampler, spp


def in_a_row(sensor: mi.Sensor, seed: int | mi.UInt32, count: int) -> mi.Sampler:
    """A sampler for `count` samples that belong to no pixel."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(1)
    sampler.set_samples_per_wavefront(1)
    sampler.seed(seed, count)
    return sampler
