"""The cut between what a term is made of and where that comes from, in backward mode."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi

Array = TypeVar("Array")


class Cut:
    """Arrays that carry gradients of their own, to be passed on to where they come from once they are known.

    A sensor's parameters are a few numbers. The gradient of each is a sum over all samples, in a kernel of its own, and
    without the cut each of these kernels would trace all rays again. So it is with the vertices of meshes, whose
    gradient is divided among these. In forward mode, all stays as it is.
    """

    def __init__(self, mode: dr.ADMode):
        self._mode = mode
        self._cuts: list[tuple] = []

    def __call__(self, ray: mi.RayDifferential3f) -> mi.RayDifferential3f:
        """Camera rays."""
        with dr.resume_grad():
            if self._mode != dr.ADMode.Backward or not dr.grad_enabled(ray.o, ray.d):
                return ray
            cut = dr.detach(ray)
            cut.o, cut.d = self.array(ray.o), self.array(ray.d)
        return cut

    def array(self, x: Array) -> Array:
        """Any array."""
        with dr.resume_grad():
            if self._mode != dr.ADMode.Backward or not dr.grad_enabled(x):
                return x
            cut = dr.detach(x)
            dr.enable_grad(cut)
        self._cuts.append((x, cut))
        return cut

    def forward(self) -> None:
        """Give the arrays the derivative of what they come from once and for all: they may be differentiated
        repeatedly."""
        with dr.resume_grad():
            arrays = [array for array, _ in self._cuts]
            derivatives = dr.forward_to(arrays, flags=dr.ADFlag.ClearEdges) if arrays else []
            for (_, cut), derivative in zip(self._cuts, derivatives, strict=True):
                dr.set_grad(cut, dr.detach(derivative))

    @property
    def gradients(self) -> list:
        """What `backward` passes on, of each array."""
        return [dr.grad(cut) for _, cut in self._cuts]

    def backward(self) -> None:
        """Pass the gradients on."""
        gradients = self.gradients
        dr.eval(gradients)
        for (array, _), gradient in zip(self._cuts, gradients, strict=True):
            dr.accum_grad(array, gradient)  # it may be a parameter, which has a gradient from elsewhere
            dr.enqueue(dr.ADMode.Backward, array)
        dr.traverse(dr.ADMode.Backward)
