"""Plugin `distant_lights`: many lights at infinity, each a direction or a small disc."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.refusals import InputError

from ._rows import rows, tensor

#: Where the samples of a light lie, in scene units: beyond every scene. An emitter in Python is not told its size.
FAR = 1e12

#: Share of the random numbers that is spread evenly over the lights, and the least share of lights and of background:
#: lights that are black as yet have derivatives, too, and no light's interval of random numbers is lost in rounding.
EVEN = 0.1


class DistantLights(mi.Emitter):
    r"""
    .. _emitter-distant_lights:

    Distant lights (:monosp:`distant_lights`)
    -----------------------------------------

    .. pluginparameters::

     * - directions
       - |string|
       - Directions *towards* the lights, world space, of any length but zero: three numbers each, with commas between
         the lights. In Python also ``mi.TensorXf`` of shape (K, 3).
       - |exposed|, |differentiable|, |discontinuous|

     * - directions_file
       - |string|
       - Instead: a text file with three numbers a line, or a NumPy file (``.npy``) of shape (K, 3).

     * - irradiance
       - |string| or |spectrum|
       - Irradiance of a surface that faces the light, without what lies between: linear sRGB, three numbers for each
         light as above, or one colour or number for all. (Default: 1)
       - |exposed|, |differentiable|

     * - irradiance_file
       - |string|
       - Instead: a file, as above.

     * - angular_radius
       - |float| or |string|
       - Half of the angle that a light subtends, in degrees, from 0 to below 90; one for all lights or one for each.
         The sun has 0.267. Lights of radius 0 cast hard shadows, and keep that radius. (Default: 0)
       - |exposed|, |differentiable|, |discontinuous|

     * - background
       - |spectrum|
       - Radiance of the sky between them. (Default: none)
       - |exposed|, |differentiable|

    Up to thousands of lights at infinity in one emitter, as photometric stereo and light stages have them. A light of
    irradiance :math:`E` and angular radius :math:`a > 0` is a disc of uniform radiance :math:`E / (\pi \sin^2 a)`.
    Lights are sampled by their luminance, but a tenth of the samples is spread evenly, so that lights that are black as
    yet have a derivative.

    **Colour.** Monochromatic variants see the luminance of `irradiance`. In spectral variants the grey part of a colour
    has the spectrum of D65, and what exceeds it the spectra that Mitsuba gives to red, green and blue: colours are
    those of rgb, and derivatives exist. Polarised variants: the light is unpolarised.

    **Data sets.** The files ``light_directions.txt`` and ``light_intensities.txt`` of DiLiGenT (Shi et al. 2019) are
    read as they are, in their own coordinates: x to the right, y up, z towards the camera.

    **Derivatives** with ``direct_edge`` and ``prb_edge``: light samples follow the discs; scattered rays find discs in
    perfect mirrors and glass only, so in surfaces that are nearly mirrors, wide discs are noisy. The outline of a disc
    that moves, as seen directly or in a mirror, is a jump that lies on no edge: its derivative is not found.
    Mitsuba's own integrators hold light samples in place: right are their derivatives of `irradiance` and `background`.

    **Limits.** With discs or a background it is the environment of the scene, which can have only one. Emitters that
    are written in Python are not told the size of the scene: no rays can start here (``ptracer``).

    .. tabs::
        .. code-tab:: xml

            <emitter type="distant_lights">
                <string name="directions" value="0 0 1, 0.6 0 0.8, 0 -0.6 0.8"/>
                <string name="irradiance" value="1 1 1, 2 1.5 1, 0.5 1 2"/>
                <float name="angular_radius" value="0.267"/>
            </emitter>

        .. code-tab:: python

            'type': 'distant_lights',
            'directions': '0 0 1, 0.6 0 0.8, 0 -0.6 0.8',
            'irradiance': '1 1 1, 2 1.5 1, 0.5 1 2',
            'angular_radius': 0.267
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        who = props.plugin_name()
        directions = rows(props, "directions", 3)
        if directions is None:
            raise InputError(f'{who}: give "directions", three numbers for each light, or "directions_file"')
        zero = np.flatnonzero(~directions.any(1))
        if len(zero):
            raise InputError(f"{who}: the direction of light {zero[0] + 1} is zero")
        #: Number of lights. The background is none of them.
        self.light_count = len(directions)
        irradiance = self._for_each(who, "irradiance", rows(props, "irradiance", 3), np.ones((1, 3)))
        radius = self._for_each(who, "angular_radius", rows(props, "angular_radius", 1), np.zeros((1, 1)))[:, 0]
        if (irradiance < 0).any():
            k = np.flatnonzero((irradiance < 0).any(1))[0]
            raise InputError(f'{who}: "irradiance" must be >= 0, got {irradiance[k].tolist()} for light {k + 1}')
        if (radius < 0).any() or (radius >= 90).any():
            raise InputError(f'{who}: "angular_radius" must be from 0 to below 90 degrees, got {radius.tolist()}')
        self.background = props.get_emissive_texture("background") if "background" in props else None
        self._discs = bool(radius.any())

        self.directions = tensor(directions / np.linalg.norm(directions, axis=1, keepdims=True))
        self.irradiance = tensor(np.broadcast_to(irradiance, directions.shape))
        self.angular_radius = mi.Float(radius.tolist())
        self._colours = _primaries() if mi.is_spectral else []
        self.m_flags = int(mi.EmitterFlags.Infinite)
        if not self._discs and self.background is None:
            self.m_flags |= int(mi.EmitterFlags.DeltaDirection)
        self.parameters_changed()

    def _for_each(self, who: str, key: str, value: np.ndarray | None, default: np.ndarray) -> np.ndarray:
        value = default if value is None else value
        if len(value) not in (1, self.light_count):
            raise InputError(
                f'{who}: "{key}" has {len(value)} rows for {self.light_count} lights; give as many, or one'
            )
        return value

    # ---------------------- Parameters ----------------------

    @property
    def shows_discs(self) -> bool:
        """Are there discs that a camera may see?"""
        return self._discs

    def traverse(self, cb: mi.TraversalCallback) -> None:
        smooth, jumps = mi.ParamFlags.Differentiable, mi.ParamFlags.Discontinuous
        cb.put("directions", self.directions, smooth | jumps)
        cb.put("irradiance", self.irradiance, smooth)
        if self._discs:
            cb.put("angular_radius", self.angular_radius, smooth | jumps)
        if self.background is not None:
            cb.put("background", self.background, smooth)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        K = self.light_count
        for key, shape in {"directions": (K, 3), "irradiance": (K, 3)}.items():
            if tuple(getattr(self, key).shape) != shape:
                got = tuple(getattr(self, key).shape)
                raise InputError(f'distant_lights: "{key}" must keep its shape {shape}, got {got}')
        if dr.width(self.angular_radius) not in (1, K):
            got = dr.width(self.angular_radius)
            raise InputError(f'distant_lights: "angular_radius" must be 1 number or {K}, got {got}')
        with dr.suspend_grad():
            flux = mi.luminance(dr.abs(dr.unravel(mi.Color3f, dr.detach(self.irradiance.array))))
            total = dr.sum(flux)
            p = flux * ((1 - EVEN) * dr.rcp(dr.maximum(total, dr.smallest(mi.Float)))) + EVEN / K
            borders = dr.concat([mi.Float(0), dr.cumsum(p)])
            borders /= dr.gather(mi.Float, borders, K)
            if self.background is not None:
                sky = dr.pi * dr.abs(dr.detach(self.background.mean()))
                share = dr.select(sky + total > 0, sky / (sky + total), 0)
                borders *= 1 - dr.clip(share, EVEN, 1 - EVEN)
            #: Light k is chosen by random numbers in [borders[k], borders[k + 1]); the background by those beyond.
            self._borders = borders
            #: Axis and squared chord of each disc: d lies in it if |d − axis|² ≤ chord². Negative for radius 0.
            k = dr.arange(mi.UInt32, K)
            chord2 = dr.square(2 * dr.sin(self._half_angle(k, True)))
            axis, chord2 = dr.detach(self._axis(k, True)), dr.detach(dr.select(chord2 > 0, chord2, -1))
            self._caps = dr.ravel(mi.Vector4f(*axis, chord2))
        dr.make_opaque(self.directions, self.irradiance, self.angular_radius, self._borders, self._caps)

    def to_string(self) -> str:
        sky = "" if self.background is None else f", background={self.background}"
        return f"DistantLights[{self.light_count} lights{sky}]"

    # ---------------------- One light ----------------------

    def _axis(self, k: mi.UInt32, active: mi.Bool) -> mi.Vector3f:
        return dr.normalize(dr.gather(mi.Vector3f, self.directions.array, k, active))

    def _half_angle(self, k: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Half of the angular radius, in radians."""
        k = k if dr.width(self.angular_radius) > 1 else mi.UInt32(0)
        return dr.gather(mi.Float, self.angular_radius, k, active) * (dr.pi / 360)

    def _irradiance(self, k: mi.UInt32, active: mi.Bool) -> mi.Color3f:
        return dr.gather(mi.Color3f, self.irradiance.array, k, active)

    def _interval(self, k: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        with dr.suspend_grad():
            return dr.gather(mi.Float, self._borders, k), dr.gather(mi.Float, self._borders, k + 1)

    def light_sample(self, which: mi.UInt32, sample: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Random numbers for one light, see `rimlight.edge_sampling.lights.Lights`.

        which : mi.UInt32, (N,), number of the light, from 0.
        sample : mi.Point2f, (N,), uniform in [0, 1)²: the point of its disc.

        Returns
        -------
        sample : mi.Point2f, (N,), for `sample_direction`, which then chooses that light.
        probability : mi.Float, (N,), with which it chooses it otherwise.
        """
        with dr.suspend_grad():
            begin, end = self._interval(which)
            UInt = dr.uint_array_t(mi.Float)
            last = dr.reinterpret_array(mi.Float, dr.reinterpret_array(UInt, end) - 1)  # the number before `end`
            return mi.Point2f(dr.clip(dr.fma(sample.x, end - begin, begin), begin, last), sample.y), end - begin

    def of_light(self, ds: mi.DirectionSample3f) -> mi.Bool:
        """Which samples of `sample_direction`, of this or another emitter, are of one of its lights, not of its
        background: mi.Bool, (N,)."""
        return (ds.emitter == mi.EmitterPtr(self)) & (ds.uv.x > 0)

    # ---------------------- Mitsuba's interface ----------------------

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction to a light, at fixed random numbers attached to `directions` and `angular_radius`. The weight is
        the radiance of this light, or of the background, divided by its share of the density."""
        with dr.suspend_grad():
            K, x = self.light_count, dr.detach(sample.x)
            k = mi.UInt32(0)
            if K > 1:
                k = dr.binary_search(0, K - 1, lambda i: dr.gather(mi.Float, self._borders, i + 1, active) <= x)
            begin, end = self._interval(k)
            beyond = mi.Bool(False)
            if self.background is not None:
                beyond = x >= end
                begin, end = dr.select(beyond, end, begin), dr.select(beyond, 1, end)
            p = end - begin
            u = mi.Point2f(dr.clip((x - begin) / p, 0, dr.one_minus_epsilon(mi.Float)), dr.detach(sample.y))

        mine = active & ~beyond
        d, half = self._axis(k, mine), mi.Float(0)
        weight = self._irradiance(k, mine) / p
        if self._discs:
            half = self._half_angle(k, mine)
            q, s2 = mi.warp.square_to_uniform_disk_concentric(u), dr.square(dr.sin(half))
            # Uniform in solid angle: 1 - cos θ = |q|² (1 - cos a) with 1 - cos a = 2 sin² (a / 2).
            r2 = dr.squared_norm(q)
            q *= 2 * dr.sin(half) * dr.sqrt(1 - s2 * r2)
            d = mi.Frame3f(d).to_world(mi.Vector3f(q.x, q.y, 1 - 2 * s2 * r2))
            weight /= dr.square(dr.cos(half))
        weight = self._spectrum(weight, it.wavelengths)

        ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.delta = ~beyond & (half <= 0)
        pdf = dr.select(beyond, p * dr.inv_four_pi, p)
        if self.background is not None:
            d = dr.select(beyond, mi.warp.square_to_uniform_sphere(u), d)
            weight = dr.select(beyond, self._sky(it.wavelengths, active) * (4 * dr.pi / p), weight)
        if self._discs:
            # At the very border of a disc, rounding may lose it.
            least = dr.select(ds.delta | beyond, pdf, p * dr.inv_four_pi / dr.square(dr.sin(dr.detach(half))))
            pdf = dr.select(ds.delta, p, dr.maximum(least, self._density(d, active & ~ds.delta)))
        ds.p = dr.fma(d, FAR, it.p)
        ds.n, ds.d, ds.dist = -d, d, mi.Float(FAR)
        ds.uv = mi.Point2f(dr.select(beyond, 0, mi.Float(k) + 1), 0)  # see `of_light` and `eval_direction`
        ds.time = it.time
        ds.pdf = pdf
        ds.emitter = mi.EmitterPtr(self)
        return ds, mi.depolarizer(dr.select(active, weight, 0))

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density of `sample_direction` in solid angle, of all that has one: discs and background."""
        return self._density(ds.d, active)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance from `ds.d`, or the irradiance of the light of radius 0 that was sampled."""
        delta = active & ds.delta
        k = mi.UInt32(dr.maximum(dr.detach(ds.uv.x), 1) - 1)
        at_delta = self._spectrum(self._irradiance(k, delta), it.wavelengths)
        radiance = self._radiance(ds.d, it.wavelengths, active & ~ds.delta)
        return mi.depolarizer(dr.select(active, dr.select(ds.delta, at_delta, radiance), 0))

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance of discs and background from the direction `-si.wi`."""
        return mi.depolarizer(dr.select(active, self._radiance(-si.wi, si.wavelengths, active), 0))

    def eval_background(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Radiance of the background alone."""
        return mi.depolarizer(dr.select(active, self._sky(si.wavelengths, active), 0))

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        """Not supported: the weight is not a number."""
        mi.Log(mi.LogLevel.Warn, "distant_lights: no rays can start here, since the scene's size is unknown.")
        return dr.zeros(mi.Ray3f), mi.depolarizer(mi.UnpolarizedSpectrum(dr.nan))

    def sample_position(self, time, sample, active=True):
        """Not supported: the weight is not a number. (Calls that are recorded must not raise exceptions.)"""
        return dr.zeros(mi.PositionSample3f), mi.Float(dr.nan)

    def pdf_position(self, ps, active=True):
        return mi.Float(0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Of no extent: it lies at infinity."""
        return mi.ScalarBoundingBox3f()

    # ---------------------- All lights ----------------------

    def _density(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        with dr.suspend_grad():

            def of(k: mi.UInt32, chord2: mi.Float) -> mi.Float:
                begin, end = self._interval(k)
                return (end - begin) * dr.inv_pi / chord2  # solid angle 4π sin² (a / 2)

            density = self._over_discs(mi.Float(0), of, d, active)
            if self.background is not None:
                density += (1 - dr.gather(mi.Float, self._borders, self.light_count)) * dr.inv_four_pi
            return density

    def _radiance(self, d: mi.Vector3f, wavelengths: Any, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        sin2 = lambda k: dr.square(dr.sin(2 * self._half_angle(k, active)))
        of = lambda k, chord2: self._irradiance(k, active) * (dr.inv_pi / sin2(k))
        discs = self._over_discs(mi.Color3f(0), of, d, active)
        return self._spectrum(discs, wavelengths) + self._sky(wavelengths, active)

    def _over_discs(self, zero: Any, of: Callable[[mi.UInt32, mi.Float], Any], d: mi.Vector3f, active: mi.Bool) -> Any:
        """Sum of `of(k, chord²)` over the discs in which `d` lies, in the type of `zero`."""
        if not self._discs:
            return zero
        d = dr.detach(d)

        def term(k):
            x, y, z, chord2 = dr.gather(mi.Vector4f, self._caps, k, active)
            return dr.select(dr.squared_norm(d - mi.Vector3f(x, y, z)) <= chord2, of(k, chord2), 0)

        if self.light_count == 1:
            return term(mi.UInt32(0))
        return dr.while_loop(
            (mi.UInt32(0), zero, mi.Bool(active)),
            lambda k, total, active: active & (k < self.light_count),
            lambda k, total, active: (k + 1, total + term(k), active),
            label="discs",
            max_iterations=-1,  # a sum: its derivative needs no memory
        )[1]

    def _sky(self, wavelengths: Any, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        if self.background is None:
            return mi.UnpolarizedSpectrum(0)
        return self.background.eval(_at(wavelengths), active)

    def _spectrum(self, colour: mi.Color3f, wavelengths: Any) -> mi.UnpolarizedSpectrum:
        """What the variant makes of an rgb colour."""
        if mi.is_rgb:
            return colour
        if mi.is_monochromatic:
            return mi.UnpolarizedSpectrum(mi.luminance(colour))
        at = _at(wavelengths)
        grey = dr.min(colour)
        white, *primaries = self._colours
        return grey * white.eval(at) + sum(
            (c - grey) * primary.eval(at) for c, primary in zip(colour, primaries, strict=True)
        )


def _at(wavelengths: Any) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = wavelengths
    return si


def _primaries() -> list[mi.Texture]:
    """Spectra of emitters that are white, red, green and blue."""
    props = mi.Properties()
    for i, colour in enumerate(([1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1])):
        props[str(i)] = mi.ScalarColor3f(colour)
    return [props.get_emissive_texture(str(i)) for i in range(4)]


mi.register_emitter("distant_lights", DistantLights)
