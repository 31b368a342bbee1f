"""Plugin `blinn_phong`: diffuse and glossy reflection, differentiable with respect to all of its textures."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight import ggx
from rimlight.edge_sampling.refusals import InputError
from rimlight.ggx import GRAZING

#: Smallest roughness: at it, the half vector's tangent has a standard deviation of 0.007 along each axis.
SMOOTHEST = 1e-4

#: The order of the components, as in `roughplastic`.
GLOSSY, DIFFUSE = 0, 1

TEXTURES = "diffuse_reflectance", "specular_reflectance", "roughness"


class BlinnPhongBSDF(mi.BSDF):
    r"""
    .. _bsdf-blinn_phong:

    Blinn-Phong material (:monosp:`blinn_phong`)
    --------------------------------------------

    .. pluginparameters::

     * - diffuse_reflectance
       - |spectrum| or |texture|
       - Albedo below the surface, in [0, 1]. (Default: 0.5)
       - |exposed|, |differentiable|

     * - specular_reflectance
       - |spectrum| or |texture|
       - Of the surface at normal incidence, in [0, 1]: 0.04 for most things, the colour of a metal. (Default: 0.04)
       - |exposed|, |differentiable|

     * - roughness
       - |float| or |texture|
       - In (0, 1], the square of a microfacet model's ``alpha``. Where a texture or an optimiser leaves [0.0001, 1],
         the nearer end counts, and the derivative is zero. (Default: 0.1)
       - |exposed|, |differentiable|

    Of the kind in *Differentiable Monte Carlo Ray Tracing through Edge Sampling* (Li et al. 2018): Blinn-Phong with
    Schlick's approximation of Fresnel's reflectance, and three textures, with respect to all of which, and to the
    directions and normals, it is differentiable. Glossy and diffuse reflection are its components 0 and 1:

    .. math::

       f = \frac{F(h \cdot \omega_i)\, D(h)\, G(\omega_i, \omega_o)}{4 \cos\theta_i \cos\theta_o}
           + \frac{k_d\, (1 - k_s)}{\pi}\, \bigl(1 - (1 - \cos\theta_i)^5\bigr) \bigl(1 - (1 - \cos\theta_o)^5\bigr)

    with the half vector :math:`h`, the reflectances :math:`k_d` and :math:`k_s`, the roughness :math:`r`, and

    .. math::

       F(c) &= k_s + (1 - k_s) (1 - c)^5 \\
       D(h) &= \frac{\alpha + 2}{2 \pi} \cos^\alpha\theta_h, \qquad \alpha = 2 / r - 2 \\
       G &= \frac{2 \cos\theta_i \cos\theta_o}{\cos\theta_o\, s_i + \cos\theta_i\, s_o}, \qquad
            s^2 = \cos^2\theta + r \sin^2\theta

    * :math:`F`: Schlick 1994.
    * :math:`D`, and :math:`\alpha` from an ``alpha`` of :math:`\sqrt r`: Walter et al. 2007. At a roughness of 1,
      :math:`\alpha` is 0, and all microfacet normals are equally likely.
    * :math:`G`: Smith's shadowing and masking, correlated by height, in the closed form of the GGX distribution of
      ``alpha`` :math:`\sqrt r` (Walter et al. 2007; Heitz 2014), which at a roughness of 1 is the same distribution.
    * The diffuse term: Shirley et al. 1997, without their factor of 21/20, for which a rough surface leaves no room.

    **Energy.** No surface reflects more than it receives, whatever the roughness and the angle, if the reflectances are
    in [0, 1]. For this the diffuse term fades where the glossy one grows, and is 5 % darker than ``diffuse`` where
    :math:`k_s` is 0. As in all models with one reflection between microfacets, rough metals are too dark: at normal
    incidence, a white one reflects 98 % at a roughness of 0.1, 55 % at 0.5 and 31 % at 1.

    **Sampling.** One of the components, in proportion to its reflectance; of the glossy one, the visible normals of the
    same GGX distribution (Dupuy and Benyoub 2023). White or not, samples weigh less than 3. They and their densities
    carry no gradients.

    **Limits.** The back of a surface is black: put this into a ``twosided``. Nothing is transmitted. Bitmaps of
    roughness should be ``raw``. Polarised variants are refused. redner, the renderer of Li et al., has the same
    :math:`D`, :math:`F` and :math:`\alpha`, but its diffuse term is Lambertian, and its :math:`G` fits another
    distribution: there a white metal of roughness 1 reflects up to 133 % at grazing angles.

    .. tabs::
        .. code-tab:: xml

            <bsdf type="twosided">
                <bsdf type="blinn_phong">
                    <rgb name="diffuse_reflectance" value="0.6, 0.2, 0.1"/>
                    <rgb name="specular_reflectance" value="0.04"/>
                    <float name="roughness" value="0.05"/>
                </bsdf>
            </bsdf>

        .. code-tab:: python

            'type': 'twosided',
            'bsdf': {
                'type': 'blinn_phong',
                'diffuse_reflectance': {'type': 'rgb', 'value': [0.6, 0.2, 0.1]},
                'specular_reflectance': {'type': 'rgb', 'value': 0.04},
                'roughness': 0.05,
            }
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        who = props.plugin_name()
        if mi.is_polarized:
            raise InputError(f"{who}: polarised variants are not supported, got {mi.variant()}")
        self.diffuse_reflectance = _texture(props, "diffuse_reflectance", 0.5)
        self.specular_reflectance = _texture(props, "specular_reflectance", 0.04)
        self.roughness = _texture(props, "roughness", 0.1, positive=True)
        flags, varying = mi.BSDFFlags, lambda *textures: any(t.is_spatially_varying() for t in textures)
        kd, ks, r = self.diffuse_reflectance, self.specular_reflectance, self.roughness
        glossy, diffuse = flags.GlossyReflection | flags.FrontSide, flags.DiffuseReflection | flags.FrontSide
        self.m_components = [
            glossy | flags.SpatiallyVarying if varying(ks, r) else glossy,
            diffuse | flags.SpatiallyVarying if varying(kd, ks) else diffuse,
        ]
        self.m_flags = self.m_components[GLOSSY] | self.m_components[DIFFUSE]

    # ---------------------- Mitsuba's interface ----------------------

    def traverse(self, cb: mi.TraversalCallback) -> None:
        for name in TEXTURES:
            cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def sample(self, ctx, si, sample1, sample2, active=True):
        glossy, diffuse = _enabled(ctx)
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si.wi))
        if not (glossy or diffuse):
            return bs, mi.Spectrum(0)
        textures, wi = self._eval_textures(si, active), dr.detach(si.wi)
        *_, r = dr.detach(textures)
        of_glossy = mi.Bool(sample1 < _glossy_share(*dr.detach(textures[:2]), wi, glossy, diffuse))
        reflected = mi.reflect(wi, ggx.sample_visible_normal(r, wi, sample2))
        bs.wo = dr.select(of_glossy, reflected, mi.warp.square_to_cosine_hemisphere(sample2))
        bs.eta = 1
        bs.sampled_type = dr.select(
            of_glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        )
        bs.sampled_component = dr.select(of_glossy, mi.UInt32(GLOSSY), mi.UInt32(DIFFUSE))
        active = active & (wi.z > 0) & (bs.wo.z > 0)
        pdf = _pdf(*textures, wi, bs.wo, glossy, diffuse)
        active &= pdf > 0
        bs.pdf = dr.select(active, pdf, 0)
        value = _eval(*textures, si.wi, bs.wo, glossy, diffuse)
        return bs, dr.select(active, value / dr.select(active, pdf, 1), 0)

    def eval(self, ctx, si, wo, active=True):
        active = active & (si.wi.z > 0) & (wo.z > 0)
        return dr.select(active, _eval(*self._eval_textures(si, active), si.wi, wo, *_enabled(ctx)), 0)

    def pdf(self, ctx, si, wo, active=True):
        active = active & (si.wi.z > 0) & (wo.z > 0)
        return dr.select(active, _pdf(*self._eval_textures(si, active), si.wi, wo, *_enabled(ctx)), 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        active = active & (si.wi.z > 0) & (wo.z > 0)
        arguments = (*self._eval_textures(si, active), si.wi, wo, *_enabled(ctx))
        return dr.select(active, _eval(*arguments), 0), dr.select(active, _pdf(*arguments), 0)

    def eval_diffuse_reflectance(self, si, active=True):
        return self.diffuse_reflectance.eval(si, active)

    def to_string(self) -> str:
        lines = ",\n".join(f"{name} = {getattr(self, name)}" for name in TEXTURES).replace("\n", "\n  ")
        return f"{type(self).__name__}[\n  {lines}\n]"

    def _eval_textures(self, si, active) -> tuple[mi.Spectrum, mi.Spectrum, mi.Float]:
        """Diffuse and specular reflectance, and roughness in its range: mi.Spectrum and mi.Float, (N,); attached."""
        return (
            self.diffuse_reflectance.eval(si, active),
            self.specular_reflectance.eval(si, active),
            dr.clip(self.roughness.eval_1(si, active), SMOOTHEST, 1),
        )


# ---------------------- The model ----------------------
# Directions: shading frame, unit length, away from the surface. `glossy`, `diffuse`: does the component count?


def _eval(kd, ks, r, wi, wo, glossy: bool, diffuse: bool) -> mi.Spectrum:
    """f · cos θₒ, per sr, of directions above the surface; finite, with its gradient, for others."""
    cos_i, cos_o = dr.maximum(wi.z, GRAZING), dr.maximum(wo.z, GRAZING)
    result = mi.Spectrum(0)
    if glossy:
        h = mi.Vector3f(wi.x + wo.x, wi.y + wo.y, cos_i + cos_o)
        # Blinn-Phong, Walter et al. 2007, Eq. 30, where 1 + tan² θ = 1 / cos² θ keeps its precision near to the normal.
        D = dr.exp((1 - dr.rcp(r)) * dr.log(1 + _tan2(h))) * dr.inv_pi / r
        # Smith's G / (4 cos θᵢ), without a division by what may vanish.
        G = cos_o * dr.rcp(2 * (cos_o * ggx.stretched(cos_i, r) + cos_i * ggx.stretched(cos_o, r)))
        # ωᵢ · h / |h| = |h| / 2
        F = ks + (1 - ks) * _schlick(0.5 * dr.norm(h))
        result += F * (D * G)
    if diffuse:
        fade = (1 - _schlick(cos_i)) * (1 - _schlick(cos_o))
        result += kd * (1 - ks) * (fade * cos_o * dr.inv_pi)  # Shirley et al. 1997, but for 21/20
    return result


def _pdf(kd, ks, r, wi, wo, glossy: bool, diffuse: bool) -> mi.Float:
    """Density of `BlinnPhongBSDF.sample`, per sr, of directions above the surface. Detached."""
    kd, ks, r, wi, wo = dr.detach((kd, ks, r, wi, wo))
    share = _glossy_share(kd, ks, wi, glossy, diffuse)
    result = share * ggx.reflected_density(r, wi, wo)
    return result + (1 - share) * dr.maximum(wo.z, GRAZING) * dr.inv_pi if diffuse else result


def _glossy_share(kd, ks, wi, glossy: bool, diffuse: bool) -> mi.Float:
    """Part of the samples that are for the glossy component. Reflectances may have left [0, 1], the result does not."""
    if not (glossy and diffuse):
        return mi.Float(1 if glossy else 0)
    schlick = _schlick(dr.maximum(wi.z, GRAZING))
    s = dr.mean(dr.abs(ks + (1 - ks) * schlick))
    d = dr.mean(dr.abs(kd * (1 - ks))) * (1 - schlick)
    return dr.select(s + d > 0, s / (s + d), 0.5)


def _tan2(h) -> mi.Float:
    return (dr.square(h.x) + dr.square(h.y)) / dr.square(h.z)


def _schlick(cos) -> mi.Float:
    """(1 - cos θ)⁵"""
    x = dr.maximum(1 - cos, 0)
    return dr.square(dr.square(x)) * x


def _enabled(ctx) -> tuple[bool, bool]:
    """Are the glossy and the diffuse component wanted?"""
    flags = mi.BSDFFlags
    return ctx.is_enabled(flags.GlossyReflection, GLOSSY), ctx.is_enabled(flags.DiffuseReflection, DIFFUSE)


def _texture(props: mi.Properties, name: str, default: float, positive: bool = False) -> mi.Texture:
    """A texture parameter. Numbers are checked: they must be in [0, 1], or (0, 1]."""
    value = props.get(name, default)
    if isinstance(value, (int, float)) and not (0 <= value <= 1 and (value > 0 or not positive)):
        interval = "(0, 1]" if positive else "[0, 1]"
        raise InputError(f'{props.plugin_name()}: "{name}" must be in {interval}, got {value:g}')
    return props.get_texture(name, default)


mi.register_bsdf("blinn_phong", BlinnPhongBSDF)
