"""The cut between camera rays and their sensor, in backward mode."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class CutRays:
    """Camera rays that carry gradients of their own, to be passed on to the sensor once they are known.

    A sensor's parameters are a few numbers. The gradient of each is a sum over all samples, in a kernel of its own, and
    without the cut each of these kernels would trace all rays again. In forward mode, rays stay as they are.
    """

    def __init__(self, mode: dr.ADMode):
        self._mode = mode
        self._cuts: list[tuple] = []

    def __call__(self, ray: mi.RayDifferential3f) -> mi.RayDifferential3f:
        with dr.resume_grad():
            if self._mode != dr.ADMode.Backward or not dr.grad_enabled(ray.o, ray.d):
                return ray
            cut = dr.detach(ray)
            dr.enable_grad(cut.o, cut.d)
        self._cuts += [(ray.o, cut.o), (ray.d, cut.d)]
        return cut

    def forward(self) -> None:
        """Give the rays the derivative of the sensor's once and for all: they may be differentiated repeatedly."""
        with dr.resume_grad():
            rays = [ray for ray, _ in self._cuts]
            derivatives = dr.forward_to(rays, flags=dr.ADFlag.ClearEdges) if rays else []
            for (_, cut), derivative in zip(self._cuts, derivatives, strict=True):
                dr.set_grad(cut, dr.detach(derivative))

    def backward(self) -> None:
        """Pass the gradients on."""
        gradients = [dr.grad(cut) for _, cut in self._cuts]
        dr.eval(gradients)
        for (ray, _), gradient in zip(self._cuts, gradients, strict=True):
            dr.set_grad(ray, gradient)
            dr.enqueue(dr.ADMode.Backward, ray)
        dr.traverse(dr.ADMode.Backward)
