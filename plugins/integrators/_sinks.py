"""What becomes of the light at the vertices of `LightPaths`.

It is added to the layers (`Splat`), compared with gradients that the layers hold (`Measure`), or differentiated in
either mode (`Forward`, `Backward`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.transport.cut import Cut

from ._layers import Layers


class Splat:
    """Adds the radiance to the layers."""

    attached = False

    def __init__(self, layers: Layers):
        self.layers = layers

    def start(self, ray: mi.Ray3f) -> mi.Ray3f:
        """Camera rays as the paths shall see them."""
        return ray

    def emission(self, light, value, place, active) -> None:
        self.layers.add(self.layers.footprint(place.u, active), light, place.β * value, active)

    def direct(self, scattering, place, active) -> None:
        place, active, _ = place.in_front(active)
        si = place.surface(scattering, active)
        bsdf, at = si.bsdf(place.ray), self.layers.footprint(place.u, active)

        def step(light):
            value = scattering.direct(si, bsdf, light, place.sample, active)
            self.layers.add(at, light, place.β * value, active & dr.any(value != 0))
            return ()

        scattering.each(step, (), place.choice, active)

    def bounce(self, light, emitted, weight, place, active) -> None:
        if light is not None:
            self.emission(light, emitted, place, active)


class Measure(Splat):
    """The radiance times the gradient that the layers hold, summed over the lights.

    total : mi.Float, (N,), for each path.
    """

    def __init__(self, layers: Layers):
        super().__init__(layers)
        self.total = mi.Float(0)

    def emission(self, light, value, place, active) -> None:
        δ = self.layers.at(self.layers.footprint(place.u, active), light, active)
        self.total += dr.select(active, dr.sum(δ * place.β * value), 0)

    def direct(self, scattering, place, active) -> None:
        place, active, index = place.in_front(active)
        si = place.surface(scattering, active)
        bsdf, at = si.bsdf(place.ray), self.layers.footprint(place.u, active)

        def step(light, total):
            value = scattering.direct(si, bsdf, light, place.sample, active)
            return (total + dr.sum(self.layers.at(at, light, active) * place.β * value),)

        total = scattering.each(step, (dr.zeros(mi.Float, dr.width(active)),), place.choice, active)[0]
        self.total += _back(total, index, active)


class Forward:
    """Adds the derivative of the radiance to the layers.

    tangent : mi.Spectrum, (N,), derivative of the throughput.
    """

    attached = True

    def __init__(self, layers: Layers):
        self.layers = layers
        self.tangent = mi.Spectrum(0)

    def start(self, ray: mi.Ray3f) -> mi.Ray3f:
        rays = Cut(dr.ADMode.Backward)
        cut = rays(ray)
        rays.forward()
        return cut

    def emission(self, light, value, place, active) -> None:
        with dr.resume_grad():
            (derivative,) = _derivatives([value])
        self.layers.add(self.layers.footprint(place.u, active), light, place.β * derivative, active)

    def direct(self, scattering, place, active) -> None:
        before = wide(self.tangent, active)
        place, active, index = place.in_front(active)
        tangent = dr.gather(mi.Spectrum, before, index, active)
        si = place.surface(scattering, active)
        with dr.resume_grad():
            attached = _attached(si)
            which, derivatives = list(attached), _derivatives(list(attached.values()))
        del attached
        si = dr.detach(si)
        bsdf, at = si.bsdf(place.ray), self.layers.footprint(place.u, active)

        def step(light):
            with dr.resume_grad():
                local, fields = _local(si, which)
                for field, derivative in zip(fields, derivatives, strict=True):
                    dr.set_grad(field, derivative)
            value = scattering.direct(local, bsdf, light, place.sample, active)
            with dr.resume_grad():
                (derivative,) = _derivatives([value])
            derivative = tangent * dr.detach(value) + place.β * derivative
            self.layers.add(at, light, derivative, active & dr.any(derivative != 0))
            return ()

        scattering.each(step, (), place.choice, active)

    def bounce(self, light, emitted, weight, place, active) -> None:
        with dr.resume_grad():
            derivatives = _derivatives([emitted, weight])
        if light is not None:
            derivative = self.tangent * dr.detach(emitted) + place.β * derivatives[0]
            self.layers.add(self.layers.footprint(place.u, active), light, derivative, active)
        self.tangent = self.tangent * dr.detach(weight) + place.β * derivatives[1]


class Backward:
    """Propagates the gradient that the layers hold to the parameters, `finish` included."""

    attached = True

    def __init__(self, layers: Layers):
        self.layers = layers
        self.light: list[mi.Spectrum] = []  # of each vertex, times its throughput and its gradient
        self.weights: list[mi.Spectrum] = []  # of the step after each vertex; attached
        self.emitted = mi.Float(0)  # attached
        self.start = self.rays = Cut(dr.ADMode.Backward)

    def emission(self, light, value, place, active) -> None:
        δ = self.layers.at(self.layers.footprint(place.u, active), light, active) * place.β
        if self.light:
            self.light[-1] += dr.select(active, δ * dr.detach(value), 0)
        with dr.resume_grad():
            self.emitted += dr.select(active, dr.sum(δ * value), 0)

    def direct(self, scattering, place, active) -> None:
        place, active, index = place.in_front(active)
        si = place.surface(scattering, active)
        with dr.resume_grad():
            attached = _attached(si)
        bsdf, at = si.bsdf(place.ray), self.layers.footprint(place.u, active)

        def step(light, total, *gradients):
            δ = self.layers.at(at, light, active) * place.β
            with dr.resume_grad():
                local, fields = _local(si, attached)
            value = scattering.direct(local, bsdf, light, place.sample, active)
            with dr.resume_grad():
                value = δ * value
                dr.backward_from(dr.sum(value), flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
                gradients = [g + dr.grad(field) for g, field in zip(gradients, fields, strict=True)]
            return total + dr.detach(value), *gradients

        # The surface gets its gradient once, not once for each light.
        width = dr.width(active)
        state = [dr.zeros(mi.Spectrum, width), *(dr.zeros(type(field), width) for field in attached.values())]
        total, *gradients = scattering.each(step, tuple(state), place.choice, active)
        with dr.resume_grad():
            for field, gradient in zip(attached.values(), gradients, strict=True):
                dr.set_grad(field, gradient)
                dr.enqueue(dr.ADMode.Backward, field)
            dr.traverse(dr.ADMode.Backward)
        self.light.append(_back(total, index, active))
        dr.eval(self.light)

    def bounce(self, light, emitted, weight, place, active) -> None:
        if light is not None:
            self.emission(light, emitted, place, active)
        self.weights.append(weight)

    def finish(self) -> None:
        """The throughput of each vertex is a product: of a factor's gradient, all vertices beyond it have a share."""
        beyond = mi.Spectrum(0)
        with dr.resume_grad():
            total = self.emitted
            for light, weight in zip(
                reversed(self.light[1:]), reversed(self.weights[: len(self.light) - 1]), strict=True
            ):
                beyond += light
                now = dr.detach(weight)
                total += dr.sum(dr.select(now != 0, beyond * weight / now, 0))
            dr.backward_from(total, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            self.rays.backward()


# ---------------------- Gradients of a surface interaction ----------------------


def _fields(si: mi.SurfaceInteraction3f) -> list:
    frame = si.sh_frame
    return [si.p, si.n, si.uv, si.wi, frame.s, frame.t, frame.n, si.dp_du, si.dp_dv, si.dn_du, si.dn_dv]


def _attached(si: mi.SurfaceInteraction3f) -> dict:
    """Its fields that carry a gradient, by their number."""
    return {i: field for i, field in enumerate(_fields(si)) if dr.grad_enabled(field)}


def _local(si: mi.SurfaceInteraction3f, which: Iterable[int]) -> tuple[mi.SurfaceInteraction3f, list]:
    """A copy that depends on nothing, and those of its fields that shall carry a gradient."""
    local = dr.detach(si)
    fields = [_fields(local)[i] for i in which]
    dr.enable_grad(fields)
    return local, fields


def _derivatives(values: list) -> list:
    """Of what is attached, along the gradients of the parameters; detached. What shares a graph goes in one call."""
    found = dr.forward_to(values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad) if values else []
    return [dr.detach(value) for value in found]


def wide(value: Any, active: mi.Bool) -> Any:
    """As many lanes as `active` has, with zeros where it is not."""
    return dr.select(active, value, dr.zeros(type(value)))


def _back(value: Any, index: mi.UInt32, active: mi.Bool) -> Any:
    """Undo `Place.in_front`."""
    result = dr.zeros(type(value), dr.width(active))
    dr.scatter(result, value, index, active, mode=dr.ReduceMode.Permute)
    return result
