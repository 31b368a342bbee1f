"""What a camera ray tells besides light: depth, position, texture coordinates, normals, masks. As Mitsuba's `aov`."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.first_points import seen_by_camera
from rimlight.edge_sampling.refusals import InputError

from .tracer import PathTracer

#: Types of channels, and the letters of their components. The first ones are Mitsuba's.
KINDS = {
    "albedo": "RGB",
    "depth": "T",
    "position": "XYZ",
    "uv": "UV",
    "geo_normal": "XYZ",
    "sh_normal": "XYZ",
    "dp_du": "XYZ",
    "dp_dv": "XYZ",
    "duv_dx": "UV",
    "duv_dy": "UV",
    "prim_index": "I",
    "shape_index": "I",
    "alpha": "A",
    "mask": "A",
}

#: Types that are names, not quantities: they have no derivative.
LABELS = frozenset({"prim_index", "shape_index"})

#: Types that may jump wherever two triangles meet, though these lie in one plane.
OF_TRIANGLES = frozenset({"dp_du", "dp_dv", "duv_dx", "duv_dy"})

#: Types that depend on the size of a pixel.
OF_FOOTPRINTS = frozenset({"duv_dx", "duv_dy"})


@dataclass(frozen=True)
class Channel:
    """One of the channels of `aovs`, which has one or several components.

    name : as the user has it. kind : one of `KINDS`. shape : the identifier that a mask asks for.
    """

    name: str
    kind: str
    shape: str = ""

    @property
    def components(self) -> tuple[str, ...]:
        """Their names in an image."""
        return tuple(f"{self.name}.{letter}" for letter in KINDS[self.kind])

    @staticmethod
    def parse(who: str, text: str) -> tuple[Channel, ...]:
        """Channels from a list of `name:type` pairs, and `name:mask:shape`, with commas or spaces between them.

        Raises
        ------
        ValueError : there are none, one is of another form or of an unknown type, or two have one name.
        """
        channels = []
        for token in text.replace(",", " ").split():
            name, _, rest = token.partition(":")
            kind, _, shape = rest.partition(":")
            if not name or not kind or (kind == "mask") != bool(shape):
                raise InputError(
                    f'{who}: "aovs" must consist of <name>:<type>, or <name>:mask:<id of a shape>, got "{token}"'
                )
            if kind not in KINDS:
                near = get_close_matches(kind, KINDS, n=1)
                remedy = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(KINDS)}."
                raise InputError(f'{who}: "{token}" in "aovs" has the unknown type "{kind}", {remedy}')
            channels.append(Channel(name, kind, shape))
        names = [c.name for c in channels]
        if not names or len(set(names)) < len(names):
            what = "has a name twice" if names else "is empty"
            raise InputError(f'{who}: "aovs" {what}, got "{text}"')
        return tuple(channels)


class ChannelTracer(PathTracer):
    """Finds the channels of an integrator along camera rays. Call it with gradients suspended.

    integrator : tells `channels` and `hide_emitters`.
    footprint : side of the square on the film for which the differentials of rays stand, pixels.
    """

    footprint = 1.0

    def __init__(self, scene: mi.Scene, integrator: mi.ad.common.ADIntegrator):
        super().__init__(scene, integrator)
        self.name, self.channels = integrator.name, integrator.channels
        self.count = sum(len(c.components) for c in self.channels)
        self.needs_differentials = any(c.kind in OF_FOOTPRINTS for c in self.channels)

    def sized(self, ray: mi.RayDifferential3f) -> mi.RayDifferential3f:
        """The ray, whose differentials are made to stand for the footprint."""
        if self.needs_differentials:
            with dr.resume_grad():
                ray.scale_differential(self.footprint)
        return ray

    def values(
        self,
        ray: mi.RayDifferential3f,
        active: mi.Bool,
        *,
        attached: bool,
        pi: mi.PreliminaryIntersection3f | None = None,
    ) -> list[mi.Float]:
        """One number for each component of each channel: mi.Float, (N,). Where no surface is seen they are 0.

        ray : of `sized`.
        attached : to the surface that a ray fixed on the film meets, and to the ray. Labels are never attached.
        pi : what the rays meet, if that is known.
        """
        pi = self.first_hit(ray, active) if pi is None else pi
        si = seen_by_camera(self.scene, ray, pi, active, attached=attached)
        with dr.resume_grad(when=attached):
            valid = active & si.is_valid()
            found = []
            for channel in self.channels:
                value = self._value(channel, si, pi, ray, valid)
                found += [dr.select(valid, mi.Float(v), 0) for v in value]
            return found

    def _value(self, channel: Channel, si, pi, ray, valid) -> list[mi.Float]:
        """The components of a channel, of any value where `valid` does not hold."""
        match channel.kind:
            case "albedo":
                return list(_colour(si.bsdf(ray).eval_diffuse_reflectance(si, valid), ray))
            case "depth":
                # Behind lamps that are hidden, `t` is counted from the lamp.
                return [dr.dot(si.p - ray.o, ray.d) if self.hide_emitters else si.t]
            case "position":
                return list(si.p)
            case "geo_normal":
                return list(si.n)
            case "sh_normal":
                return list(si.sh_frame.n)
            case "duv_dx" | "duv_dy":
                si.compute_uv_partials(ray)
                return list(getattr(si, channel.kind))
            case "prim_index":
                return [mi.Float(si.prim_index)]
            case "shape_index":
                return [mi.Float(dr.reinterpret_array(mi.UInt32, si.shape))]
            case "alpha":
                return [mi.Float(1)]
            case "mask":
                wanted = self._shape(channel)
                return [dr.select((pi.shape == wanted) | (pi.instance == wanted), mi.Float(1), 0)]
            case kind:
                return list(getattr(si, kind))

    def _shape(self, channel: Channel) -> mi.ShapePtr:
        """The shape that a mask asks for. (By way of an array of the scene, which frozen functions know.)

        Raises
        ------
        ValueError : the scene has no shape of this name.
        """
        ids = [s.id() for s in self.scene.shapes()]
        if channel.shape not in ids:
            near = get_close_matches(channel.shape, ids, n=1)
            listed = ", ".join(f'"{i}"' for i in ids if i)
            remedy = f'did you mean "{near[0]}"?' if near else f"it has {listed or 'none with an id'}."
            if "" in ids:
                remedy += " Mitsuba has merged meshes of equal materials: load the scene with optimize=False."
            raise InputError(
                f'{self.name}: the mask "{channel.name}" asks for the shape "{channel.shape}", which the scene does '
                f"not have; {remedy}"
            )
        return dr.gather(mi.ShapePtr, self.scene.shapes_dr(), mi.UInt32(ids.index(channel.shape)))


def _colour(spectrum: mi.Spectrum, ray: mi.Ray3f) -> mi.Color3f:
    """A reflectance as a colour, as Mitsuba's `aov` has it."""
    if mi.is_monochromatic:
        return mi.Color3f(spectrum.x)
    if mi.is_spectral:
        density = mi.pdf_rgb_spectrum(ray.wavelengths)
        return mi.spectrum_to_srgb(spectrum * dr.select(density != 0, dr.rcp(density), 0), ray.wavelengths)
    return spectrum
