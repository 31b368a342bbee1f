"""An image with a layer for each light, as a sum over samples of the film."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.refusals import InputError, Refusal


@dataclass(frozen=True)
class LayerSamples:
    """Samples of the film that belong to one light each. Their sum is the image, or its derivative.

    position : mi.Point2f, (N,), pixels, on the whole film.
    light : mi.UInt32, (N,), whose layer.
    value : mi.Spectrum, (N,), integrated over the film in pixels²; attached where the derivative is wanted.
    """

    position: mi.Point2f
    light: mi.UInt32
    value: mi.Spectrum


class Layers:
    """The layers of all lights: radiance, its derivative, or the gradient of a loss with respect to them.

    A pixel p is the ratio of Σ w_p(u) L and Σ w_p(u) over all samples u of its layer, w being the reconstruction
    filter, as in Mitsuba's films. Samples that are no camera paths have no part in the second sum.

    Parameters
    ----------
    film : mi.Film; its pixel format does not matter.
    lights : their number, K.
    position : mi.Point2f, (N,), pixels; all film samples of the camera paths.
    spp : camera paths per pixel.
    data : mi.TensorXf, (H, W, C K), what the layers hold. Default: zeros. C is 3, or 1 in monochrome variants.

    Raises
    ------
    ValueError : `data` is of another shape.
    RuntimeError : there are too many pixels.
    """

    def __init__(self, film: mi.Film, lights: int, position: mi.Point2f, spp: int, data: mi.TensorXf | None = None):
        self.offset, self.size = mi.ScalarPoint2i(film.crop_offset()), mi.ScalarVector2i(film.crop_size())
        self.channels = 1 if mi.is_monochromatic else 3
        self.stride = lights * self.channels
        self.shape = (self.size[1], self.size[0], self.stride)
        length = self.shape[0] * self.shape[1] * self.shape[2]
        if length >= 2**32:
            raise Refusal(f"rig: an image of {self.shape} has more than 2^32 numbers; use a crop window")
        if data is not None and tuple(data.shape) != self.shape:
            raise InputError(f"rig: the gradient must be of the image's shape {self.shape}, got {tuple(data.shape)}")
        self.data = dr.zeros(mi.Float, length) if data is None else data.array
        self.filter = None if film.rfilter().is_box_filter() else film.rfilter()
        self.scale = None
        if self.filter is not None:
            weight = dr.zeros(mi.Float, self.shape[0] * self.shape[1])
            for pixel, w, inside in self.footprint(position):
                dr.scatter_add(weight, w, pixel, inside)
            self.scale = dr.select(weight != 0, spp / weight, 0)
            dr.eval(self.scale)

    def footprint(self, position: mi.Point2f, active: mi.Bool | bool = True) -> list[tuple]:
        """Pixels to which samples contribute: indices, weights such that samples of equal density ρ per pixel sum up to
        ρ, and which of them lie on the film."""
        u = mi.Point2f(position) - mi.Point2f(self.offset)
        if self.filter is None:
            return [self._pixel(mi.Point2i(dr.floor(u)), mi.Float(1), active)]
        radius = self.filter.radius()
        first = mi.Point2i(dr.ceil(u - radius - 0.5))
        span = range(int(-(-2 * radius // 1)))
        weights = [[self.filter.eval(mi.Float(first[a] + i) + 0.5 - u[a]) for i in span] for a in (0, 1)]
        found = [
            self._pixel(first + mi.Point2i(i, j), weights[0][i] * weights[1][j], active) for j in span for i in span
        ]
        if self.scale is not None:
            found = [(p, w * dr.gather(mi.Float, self.scale, p, inside), inside) for p, w, inside in found]
        return found

    def _pixel(self, p: mi.Point2i, weight: mi.Float, active) -> tuple:
        inside = active & dr.all((p >= 0) & (p < mi.Point2i(self.size)))
        return mi.UInt32(p.y * self.size[0] + p.x), weight, inside

    def add(self, footprint: list[tuple], light: mi.UInt32, value: mi.Spectrum, active: mi.Bool | bool = True) -> None:
        """Add the `value` of a light at footprints."""
        for pixel, weight, inside in footprint:
            for c in range(self.channels):
                index = pixel * self.stride + light * self.channels + c
                dr.scatter_add(self.data, value[c] * weight, index, inside & active)

    def at(self, footprint: list[tuple], light: mi.UInt32, active: mi.Bool | bool = True) -> mi.Spectrum:
        """What `add` would have multiplied the values by, if the layers hold the gradient of a loss: the adjoint."""
        δ = mi.Spectrum(0)
        for pixel, weight, inside in footprint:
            for c in range(self.channels):
                index = pixel * self.stride + light * self.channels + c
                δ[c] += weight * dr.gather(mi.Float, self.data, index, inside & active)
        return δ

    def forward(self, samples: LayerSamples) -> None:
        """Add the derivative of samples."""
        with dr.resume_grad():
            value = dr.forward_to(samples.value, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
        self.add(self.footprint(samples.position), samples.light, dr.detach(value))

    def backward(self, samples: LayerSamples) -> None:
        """Propagate the gradient that the layers hold to the value of samples, and on to the parameters."""
        δ = self.at(self.footprint(samples.position), samples.light)
        with dr.resume_grad():
            dr.backward_from(dr.sum(δ * samples.value), flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)

    def image(self) -> mi.TensorXf:
        return mi.TensorXf(self.data, self.shape)
