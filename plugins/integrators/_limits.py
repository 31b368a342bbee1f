"""What Mitsuba's materials and lights do that derivatives lack."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling import objects_below

#: What perfect mirrors and glass do.
MIRRORS = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission

#: Parameters that Mitsuba 3.9 does not differentiate, or only in part, by the name of their class: from some, it makes
#: tables, or the probability with which it samples one lobe or another.
PARTIAL = {
    "RoughPlastic": ("alpha", "eta"),
    "SunskyEmitter": ("turbidity", "sun_direction"),
}


def lets_through(shape: mi.Shape) -> bool:
    """Can rays go through the shape as if nothing was there? (Mitsuba's `hair` says so, but they never do.)"""
    bsdf = shape.bsdf()
    return bsdf is not None and bool(bsdf.flags() & mi.BSDFFlags.Null) and bsdf.class_name() != "Hair"


def is_mirror(shape: mi.Shape) -> bool:
    """Does the shape reflect or refract perfectly?"""
    return shape.bsdf() is not None and bool(shape.bsdf().flags() & MIRRORS)


def divides_by_density(bsdf: mi.BSDF) -> bool:
    """Must the weight f / p of a perfect reflection be multiplied by its attached probability p, over the present p, to
    have the gradient of f? (In Mitsuba 3.9, the weights of other BSDFs have that already.)"""
    if not bsdf.flags() & mi.BSDFFlags.Delta:
        return False
    if bsdf.class_name() == "TwoSidedBRDF":
        return any(divides_by_density(b) for b in objects_below(bsdf).values() if isinstance(b, mi.BSDF) and b != bsdf)
    return bsdf.class_name() in ("SmoothPlastic", "ThinDielectric")


class PartialParameters:
    """The parameters of a scene that Mitsuba differentiates in part only."""

    def __init__(self, scene: mi.Scene):
        self.found: list[tuple[str, Any, tuple[str, ...]]] = []
        for name, o in objects_below(scene).items():
            keys = PARTIAL.get(o.class_name(), ())
            if o.class_name() == "BlendBSDF" and o.flags() & MIRRORS:
                keys = ("weight.value", "weight.data")
            if keys:
                self.found.append((name, o, keys))

    def limits(self) -> list[str]:
        """What the derivative lacks with respect to those that carry a gradient now."""
        changing = []
        for name, o, keys in self.found:
            params = mi.traverse(o)
            changing += [f'"{name}.{k}" ({o.class_name()})' for k in keys if k in params and dr.grad_enabled(params[k])]
        return [
            f"the derivative lacks part of what {c} does, since Mitsuba does not differentiate it." for c in changing
        ]
