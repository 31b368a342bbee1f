"""Plugin `led`: a near light whose intensity falls off with a power of the cosine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.refusals import InputError


class Led(mi.Emitter):
    r"""
    .. _emitter-led:

    Light-emitting diode (:monosp:`led`)
    ------------------------------------

    .. pluginparameters::

     * - position
       - |point|
       - Where the light is, world space. (Default: the origin)
       - |exposed|, |differentiable|, |discontinuous|

     * - axis
       - |vector|
       - Direction in which it shines, *away* from the light, world space, of any length but zero. (Default: +z)
       - |exposed|, |differentiable|

     * - to_world
       - |transform|
       - Instead of both: of a light at the origin that shines along +z.

     * - intensity
       - |spectrum|
       - Radiant intensity on the axis: power per solid angle. (Default: 1)
       - |exposed|, |differentiable|

     * - mu
       - |float|
       - Anisotropy, at least 0. For a light of half its intensity at the angle :math:`\theta`, it is
         :math:`-\log 2 / \log\cos\theta`: 1 for 60 degrees. (Default: 1)
       - |exposed|, |differentiable|

    A point light of the intensity :math:`I(\theta) = I_0 \cos^\mu \theta` at the angle :math:`\theta` from its axis,
    and none backwards: the model of photometric stereo with near lights (Quéau et al. 2018). With :math:`\mu = 1` it is
    a small Lambertian surface.

    At :math:`\mu = 0` the light is isotropic: Mitsuba's ``point``, which shines backwards as well. There is a jump
    between this and the smallest :math:`\mu > 0`, behind the light: the derivative with respect to `mu` at 0 is that of
    the light in front. Below 1, the derivative of what is lit edge-on has no bound, but an integral.

    Tables of such lights are read and written by ``rimlight.leds``. Polarised variants: the light is unpolarised.

    .. tabs::
        .. code-tab:: xml

            <emitter type="led">
                <point name="position" value="0.2, 0.1, 0.5"/>
                <vector name="axis" value="0, 0, -1"/>
                <rgb name="intensity" value="1, 0.9, 0.8"/>
                <float name="mu" value="1.5"/>
            </emitter>

        .. code-tab:: python

            'type': 'led',
            'position': [0.2, 0.1, 0.5],
            'axis': [0, 0, -1],
            'intensity': {'type': 'rgb', 'value': [1, 0.9, 0.8]},
            'mu': 1.5
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        who = props.plugin_name()
        if "to_world" in props:
            if "position" in props or "axis" in props:
                raise InputError(f'{who}: give either "to_world", or "position" and "axis"')
            to_world = np.array(props["to_world"].matrix)
            position, axis = to_world[:3, 3], to_world[:3, 2]
        else:
            position, axis = props.get("position", [0, 0, 0]), props.get("axis", [0, 0, 1])
        position, axis = _vector(who, "position", position), _vector(who, "axis", axis)
        if not any(axis):
            raise InputError(f'{who}: "axis" must not be zero')
        mu = props.get("mu", 1.0)
        if isinstance(mu, bool) or not isinstance(mu, int | float) or not 0 <= mu < np.inf:
            raise InputError(f'{who}: "mu" must be a number >= 0, got {mu}')
        self.intensity = props.get_emissive_texture("intensity", 1.0)
        self.position, self.axis, self.mu = mi.Point3f(position), mi.Vector3f(axis), mi.Float(mu)
        self.m_flags = mi.EmitterFlags.DeltaPosition
        self.parameters_changed()

    def traverse(self, cb: mi.TraversalCallback) -> None:
        smooth = mi.ParamFlags.Differentiable
        cb.put("position", self.position, smooth | mi.ParamFlags.Discontinuous)
        cb.put("axis", self.axis, smooth)
        cb.put("intensity", self.intensity, smooth)
        cb.put("mu", self.mu, smooth)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        dr.make_opaque(self.position, self.axis, self.mu)

    def to_string(self) -> str:
        return f"Led[position={self.position}, axis={self.axis}, mu={self.mu}, intensity={self.intensity}]"

    # ---------------------- Mitsuba's interface ----------------------

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.p = self.position
        to_light = self.position - it.p
        ds.dist = dr.norm(to_light)
        ds.d = to_light / ds.dist
        ds.time = it.time
        ds.pdf = mi.Float(1)
        ds.delta = mi.Bool(True)
        ds.emitter = mi.EmitterPtr(self)
        return ds, self.eval_direction(it, ds, active)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Irradiance at `it.p` of a surface that faces the light."""
        cos = -dr.dot(ds.d, dr.normalize(self.axis))
        front = cos > 0
        # Quéau et al. 2018: I₀ cos^μ θ. Its derivative is that of the front, and zero behind.
        falloff = dr.select(front, dr.power(dr.select(front, cos, 1), self.mu), dr.select(self.mu > 0, 0, 1))
        intensity = self.intensity.eval(_at(it.wavelengths), active)
        return mi.depolarizer(dr.select(active, intensity * (falloff / dr.square(ds.dist)), 0))

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        return mi.Float(0)

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(0)

    def sample_ray(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray from the light: its direction has the density of the intensity."""
        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        isotropic = self.mu == 0
        cos = dr.select(isotropic, 1 - 2 * sample3.y, dr.power(1 - sample3.y, dr.rcp(self.mu + 1)))
        sin, φ = dr.safe_sqrt(1 - dr.square(cos)), 2 * dr.pi * sample3.x
        local = mi.Vector3f(sin * dr.cos(φ), sin * dr.sin(φ), cos)
        d = mi.Frame3f(dr.normalize(self.axis)).to_world(local)
        solid_angle = dr.select(isotropic, 4 * dr.pi, 2 * dr.pi / (self.mu + 1))
        return mi.Ray3f(self.position, d, time, wavelengths), weight * solid_angle

    def sample_wavelengths(self, si: mi.SurfaceInteraction3f, sample: mi.Float, active: mi.Bool = True) -> Any:
        if mi.is_spectral:
            wavelengths, weight = self.intensity.sample_spectrum(si, mi.sample_shifted(sample), active)
            return wavelengths, mi.depolarizer(weight)
        return si.wavelengths, mi.depolarizer(self.intensity.eval(si, active))

    def sample_position(self, time, sample, active=True):
        """Not supported: the weight is not a number. (Calls that are recorded must not raise exceptions.)"""
        return dr.zeros(mi.PositionSample3f), mi.Float(dr.nan)

    def pdf_position(self, ps, active=True):
        return mi.Float(0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """The light's position."""
        p = mi.ScalarPoint3f(np.array(dr.detach(self.position)).ravel().tolist())
        return mi.ScalarBoundingBox3f(p, p)


def _vector(who: str, key: str, value: Any) -> list[float]:
    try:
        vector = np.array(value, dtype=np.float64).reshape(3).tolist()
    except (TypeError, ValueError):
        raise InputError(f'{who}: "{key}" must be three numbers, got {value}') from None
    if not np.isfinite(vector).all():
        raise InputError(f'{who}: "{key}" must be finite, got {vector}')
    return vector


def _at(wavelengths: Any) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = wavelengths
    return si


mi.register_emitter("led", Led)
