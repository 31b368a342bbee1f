"""What the sensor sees of light subpaths, as part of an image that camera paths make."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.projection.sensors import sampled_border
from rimlight.transport.found_light import Seen

#: Points at which a reconstruction filter is looked at along each pixel.
POINTS = 32


class LightImage:
    """An image of samples that fall anywhere on the film.

    A pixel of a film is a sum over samples, divided by the sum of the filter's weights for the camera's samples around
    it. That sum varies, and samples that are added here do not vary with it: so they are multiplied by it, and divided
    by its mean. (Otherwise, the image would be biased at few samples: the mean of 1 / x is not one over that of x.)

    per_pixel : camera samples of a pixel.
    """

    def __init__(self, film: mi.Film, per_pixel: int):
        self.film, self.per_pixel = film, per_pixel
        self.block = film.create_block()
        # Neighbours in a wavefront belong to different pixels.
        self.block.set_coalesce(False)
        self.has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)

    def nothing(self, count: int) -> tuple:
        """What `add` returns: all is in the image."""
        return ()

    def add(self, known: tuple, seen: Seen, L: mi.Spectrum, sampler: mi.Sampler, active: mi.Bool) -> tuple:
        """L : mi.Spectrum, (N,), so that the mean over all samples of the film is the radiance."""
        colour = [L.x, L.x, L.x] if mi.is_monochromatic else [L.x, L.y, L.z]
        self.block.put(seen.u, [*colour, *([mi.Float(0)] if self.has_alpha else []), mi.Float(0)], active)
        return known

    def add_to(self, camera: mi.ImageBlock) -> None:
        """Put both images on the film. camera : the block of the camera's samples."""
        self.film.put_block(camera)
        if self.film.rfilter().is_box_filter():
            self.film.put_block(self.block)
            return
        light, weights = self.block.tensor(), camera.tensor()
        height, width, channels = light.shape
        pixel = dr.arange(mi.UInt32, height * width)
        x, y = pixel % width, pixel // width
        mean = dr.gather(mi.Float, self._weights(0, width), x) * dr.gather(mi.Float, self._weights(1, height), y)
        now = dr.gather(mi.Float, weights.array, pixel * channels + channels - 1)
        factor = dr.select(mean != 0, now / (mean * self.per_pixel), 0)
        scaled = light.array * dr.gather(mi.Float, factor, dr.arange(mi.UInt32, len(light.array)) // channels)
        border = self.block.border_size() > 0
        block = mi.ImageBlock(
            mi.TensorXf(scaled, light.shape), self.block.offset(), self.film.rfilter(), border=border, coalesce=False
        )
        self.film.put_block(block)

    def _weights(self, axis: int, count: int) -> mi.Float:
        """Integral of the filter over what is sampled of the film along an axis, for each of the block's pixels."""
        rfilter, crop = self.film.rfilter(), self.film.crop_size()[axis]
        sampled = sampled_border(self.film)
        reach = math.ceil(rfilter.radius())
        along = dr.arange(mi.UInt32, count * 2 * reach * POINTS)
        pixel, point = along // (2 * reach * POINTS), along % (2 * reach * POINTS)
        t = (mi.Float(point) + 0.5) / POINTS - reach
        u = mi.Float(pixel) + 0.5 - self.block.border_size() + t
        inside = (u > -sampled) & (u < crop + sampled) & (dr.abs(t) < rfilter.radius())
        return dr.block_sum(dr.select(inside, rfilter.eval(t), 0), 2 * reach * POINTS) / POINTS
