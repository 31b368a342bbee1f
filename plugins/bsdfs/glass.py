"""Plugin `glass`: smooth glass whose index of refraction can be fitted."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.refusals import InputError

#: The order of the components, as in `dielectric`.
REFLECTION, TRANSMISSION = 0, 1

#: Indices of refraction that are accepted, relative to the outside.
LEAST, MOST = 0.2, 5.0


class GlassBSDF(mi.BSDF):
    r"""
    .. _bsdf-glass:

    Glass (:monosp:`glass`)
    -----------------------

    .. pluginparameters::

     * - eta
       - |float|
       - Index of refraction inside, over that outside, from 0.2 to 5 but not 1. (Default: 1.5046, of BK7 in air)
       - |exposed|, |differentiable|, |discontinuous|

    Reflects and refracts perfectly, as Mitsuba's ``dielectric``: with the same index, it makes the same image. But in
    Mitsuba 3.9 the index of ``dielectric`` is a number of the host, which has no derivative. Here it has one: with it
    change both the directions of the rays that are refracted, so that all that is seen through the glass slides, its
    jumps included, and what is reflected (Fresnel's equations).

    **Limits.** The index is the same for all wavelengths. Polarised variants are refused.

    .. tabs::
        .. code-tab:: xml

            <bsdf type="glass">
                <float name="eta" value="1.45"/>
            </bsdf>

        .. code-tab:: python

            'type': 'glass',
            'eta': 1.45
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        if mi.is_polarized:
            raise InputError(f"glass: polarised variants are not supported, got {mi.variant()}")
        eta = props.get("eta", 1.5046)
        if not (isinstance(eta, (int, float)) and LEAST <= eta <= MOST and eta != 1):
            raise InputError(f'glass: "eta" must be from {LEAST} to {MOST:g}, but not 1, got {eta}')
        self.eta = mi.Float(eta)
        flags = mi.BSDFFlags
        both = flags.FrontSide | flags.BackSide
        self.m_components = [flags.DeltaReflection | both, flags.DeltaTransmission | both | flags.NonSymmetric]
        self.m_flags = self.m_components[REFLECTION] | self.m_components[TRANSMISSION]
        self.parameters_changed()

    @property
    def turns(self) -> bool:
        """Does the index, and with it the direction of what is refracted, carry a gradient?"""
        return dr.grad_enabled(self.eta)

    # ---------------------- Mitsuba's interface ----------------------

    def traverse(self, cb: mi.TraversalCallback) -> None:
        cb.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        dr.make_opaque(self.eta)  # lest each value be a part of the kernels

    def sample(self, ctx, si, sample1, sample2, active=True):
        reflects = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, REFLECTION)
        transmits = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, TRANSMISSION)
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si.wi))
        if not (reflects or transmits):
            return bs, mi.Spectrum(0)
        active = active & (si.wi.z != 0)
        reflected, cos_t, eta_it, eta_ti = mi.fresnel(si.wi.z, self.eta)
        p = dr.detach(reflected) if reflects and transmits else mi.Float(reflects)
        mirrored = mi.Bool(sample1 <= p) if reflects else mi.Bool(False)
        bs.wo = dr.select(mirrored, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
        bs.eta = dr.select(mirrored, 1, dr.detach(eta_it))
        bs.pdf = dr.select(active, dr.select(mirrored, p, 1 - p), 0)
        bs.sampled_component = dr.select(mirrored, mi.UInt32(REFLECTION), mi.UInt32(TRANSMISSION))
        kinds = (mi.UInt32(+kind) for kind in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission))
        bs.sampled_type = dr.select(mirrored, *kinds)
        # Radiance, but not importance, is compressed into the smaller solid angle.
        compressed = dr.square(eta_ti) if ctx.mode == mi.TransportMode.Radiance else mi.Float(1)
        value = dr.select(mirrored, reflected, (1 - reflected) * compressed)
        active &= bs.pdf > 0
        return bs, mi.Spectrum(dr.select(active, value / dr.select(active, bs.pdf, 1), 0))

    def eval(self, ctx, si, wo, active=True):
        return mi.Spectrum(0)

    def pdf(self, ctx, si, wo, active=True):
        return mi.Float(0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return mi.Spectrum(0), mi.Float(0)

    def to_string(self) -> str:
        return f"GlassBSDF[eta = {self.eta}]"


mi.register_bsdf("glass", GlassBSDF)
