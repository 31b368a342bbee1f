"""Plugin `ggx_dictionary`: a weighted sum of fixed GGX lobes and diffuse ones, differentiable in its weights."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight import ggx
from rimlight.edge_sampling.refusals import InputError

#: The order of the components, as in `roughplastic`.
GLOSSY, DIFFUSE = 0, 1

#: Samples are for at most so many different alphas, which stand for those near to them.
SAMPLED_ALPHAS = 5

#: Share of the samples that is spread evenly over these alphas and the diffuse lobes: what weighs nothing as yet has a
#: derivative, too.
EVEN = 0.1

#: What the base is taken to reflect, when lobes are chosen: only the number of samples depends on it.
BASE = 0.5


class GGXDictionaryBSDF(mi.BSDF):
    r"""
    .. _bsdf-ggx_dictionary:

    Dictionary of GGX lobes (:monosp:`ggx_dictionary`)
    --------------------------------------------------

    .. pluginparameters::

     * - weights
       - |tensor|
       - Of the lobes, in Python: ``mi.TensorXf`` of shape (B, 3), linear sRGB, or (B, 1) for grey. Not negative, and
         each colour sums to at most 1; the rest is black.
       - |exposed|, |differentiable|

     * - alpha, eta
       - |tensor|
       - Roughness of the lobes, in (0, 1], and their index of refraction, above 1: ``mi.Float`` of B numbers each. A
         lobe without alpha (NaN) is diffuse: Lambertian, of albedo 1, without eta either, else under a smooth coat.
         (Default: the dictionary of the package)

     * - filename
       - |string|
       - Instead: a JSON file of lobes and their weights, see :doc:`/reflectance`.

     * - material
       - |string|
       - Instead: one of the 100 materials that the dictionary of the package was made for, such as ``gray-plastic``,
         see :doc:`/reflectance`; with `filename`, a material of that dictionary.

     * - scale
       - |float| or |texture|
       - Grey factor of all lobes, such as a ``mesh_attribute`` of one channel. Not negative; the surface reflects no
         more than it receives if it is at most 1 over the largest sum of weights. (Default: 1)
       - |exposed|, |differentiable|

     * - base
       - |spectrum| or |texture|
       - Of a diffuse lobe more, the colour, to which `scale` does not apply: what lies under a glaze, and varies
         where the glaze does not. Such as a ``mesh_attribute`` of three channels. (Default: none)
       - |exposed|, |differentiable|

     * - base_eta
       - |float|
       - The index of refraction of the smooth coat over it. (Default: none, it is Lambertian)

    The reflectance model of *Towards Shape Reconstruction through Differentiable Rendering* (Bangaru 2019, chapter 3):
    a combination of B fixed lobes, in which only the weights :math:`\theta` are unknown,

    .. math::

       f(\omega_i, \omega_o) = \sum_{b=1}^B \theta_b\, f_b(\omega_i, \omega_o), \qquad
       \theta_b \ge 0, \quad \sum_b \theta_b \le 1.

    A lobe is Lambertian, :math:`1 / \pi`, or

    .. math::

       f_b &= \frac{F(h \cdot \omega_i)\, D(h)\, G_1(\omega_i)\, G_1(\omega_o)}{4 \cos\theta_i \cos\theta_o} \\
       D(h) &= \frac{\alpha^2}{\pi\, (\cos^2\theta_h\, (\alpha^2 - 1) + 1)^2} \\
       G_1(\omega) &= \frac{2 \cos\theta}{\cos\theta + \sqrt{\alpha^2 + (1 - \alpha^2) \cos^2\theta}} \\
       F(c) &= \frac{1}{2} \left( \frac{g - c}{g + c} \right)^2
               \left( 1 + \left( \frac{(g + c)\, c - 1}{(g - c)\, c + 1} \right)^2 \right), \qquad
               g = \sqrt{\eta^2 + c^2 - 1}

    with the half vector :math:`h`: GGX (Walter et al. 2007) with separable shadowing, and the Fresnel term of Cook and
    Torrance 1982. Or it is diffuse under a smooth coat,

    .. math::

       f_b = \frac{(1 - F(\cos\theta_i))\, (1 - F(\cos\theta_o))}{\pi\, (1 - \bar F)}, \qquad
       \bar F = 2 \int_0^1 F(c)\, c\, dc,

    and reflects :math:`1 - F(\cos\theta_i)` (Shirley et al. 1997, with this Fresnel term). All of them are reciprocal,
    and reflect no more than they receive. They are differentiable with respect to `weights`, `scale`, and the
    directions and normals.

    **Cost.** Lobes that share their ``alpha`` share :math:`D` and :math:`G`, and those that share their ``eta`` share
    :math:`F`. The 40 lobes of the package, with 12 and 8 different ones, take half of the time of 40 others, and three
    times that of 4, see :doc:`/performance`. Lobes are part of the compiled kernel; the weights are not.

    **Sampling.** A lobe in proportion to what it reflects at this angle: diffuse ones by the cosine, the others
    by the visible normals (Dupuy and Benyoub 2023) of the nearest of five alphas. A tenth of the samples is spread
    evenly. Samples and their densities carry no gradients.

    **Optimisers.** When the parameters are set, only the shape of `weights` is checked. Whatever is finite has a finite
    result, and a weight that is not finite shows; sampling takes negative weights for positive ones. Keep them in their
    range, by projection for example.

    **Colour.** Monochromatic variants see the luminance, and hold it as the parameter, of shape (B, 1).

    **Limits.** The back of a surface is black: put this into a ``twosided``. Nothing is transmitted. But for `scale`
    and `base`, a surface is the same everywhere. Spectral and polarised variants are refused. Sums of weights may
    exceed 1 by 0.00001, since files round them; and with a `base`, a surface may reflect more than it receives.

    .. tabs::
        .. code-tab:: xml

            <bsdf type="ggx_dictionary">
                <string name="material" value="gray-plastic"/>
            </bsdf>

        .. code-tab:: python

            'type': 'ggx_dictionary',
            'weights': mi.TensorXf([0.05, 0.05, 0.05, 0.6, 0.2, 0.1], shape=(2, 3)),
            'alpha': mi.Float(0.1, float('nan')),
            'eta': mi.Float(1.5, float('nan'))
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        who = props.plugin_name()
        if mi.is_polarized or mi.is_spectral:
            raise InputError(f"{who}: spectral and polarised variants are not supported, got {mi.variant()}")
        try:
            #: The lobes, which do not change.
            self.lobes, weights = _lobes_and_weights(props)
        except ValueError as error:
            raise InputError(f"{who}: {error}") from None
        if mi.is_monochromatic and weights.shape[1] == 3:
            weights = np.array(mi.luminance(mi.Color3f(np.float32(weights.T)))).reshape(-1, 1)
        weights = np.broadcast_to(weights, (len(weights), dr.size_v(mi.UnpolarizedSpectrum)))
        scale = props.get("scale", 1.0)
        if isinstance(scale, int | float) and not scale >= 0:
            raise InputError(f'{who}: "scale" must be >= 0, got {scale}')
        self.scale = props.get_texture("scale") if "scale" in props else None
        self.base = props.get_texture("base") if "base" in props else None
        self._base_eta = props.get("base_eta", float("nan"))
        if not (np.isnan(self._base_eta) or self._base_eta > 1):
            raise InputError(f'{who}: "base_eta" must be > 1, got {self._base_eta}')
        # In Dr.Jit's own memory: `dr.freeze` does not go with NumPy's
        self.weights = mi.TensorXf(mi.Float(weights.ravel().tolist()), shape=weights.shape)
        self._alphas, nearest = _few_alphas(self.lobes)
        #: For each lobe, the entry of `_shares` to which it adds: its alpha's, or behind them the diffuse ones'.
        self._entry = mi.UInt32(nearest)
        self._normal_reflectance = mi.Float(self.lobes.normal_reflectance.tolist())
        flags = mi.BSDFFlags
        both = flags.FrontSide
        if any(texture is not None and texture.is_spatially_varying() for texture in (self.scale, self.base)):
            both |= flags.SpatiallyVarying
        self.m_components = [flags.GlossyReflection | both, flags.DiffuseReflection | both]
        self.m_flags = self.m_components[GLOSSY] | self.m_components[DIFFUSE]
        self.parameters_changed()

    # ---------------------- Parameters ----------------------

    def traverse(self, cb: mi.TraversalCallback) -> None:
        cb.put("weights", self.weights, mi.ParamFlags.Differentiable)
        if self.scale is not None:
            cb.put("scale", self.scale, mi.ParamFlags.Differentiable)
        if self.base is not None:
            cb.put("base", self.base, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        shape = len(self.lobes), dr.size_v(mi.UnpolarizedSpectrum)
        if tuple(self.weights.shape) != shape:
            raise InputError(f'ggx_dictionary: "weights" must keep its shape {shape}, got {tuple(self.weights.shape)}')
        with dr.suspend_grad():
            grey = dr.mean(dr.abs(dr.unravel(mi.UnpolarizedSpectrum, dr.detach(self.weights.array))))
            grey = dr.select(dr.isfinite(grey), grey, 0)
            count = len(self._alphas) + 1
            #: What each alpha's lobes, and the diffuse ones, reflect at normal incidence; then the same at grazing.
            self._shares = dr.zeros(mi.Float, 2 * count)
            dr.scatter_add(self._shares, grey * self._normal_reflectance, self._entry)
            dr.scatter_add(self._shares, grey, self._entry + count)
            if self.base is not None:
                last = mi.UInt32(count - 1, 2 * count - 1)
                dr.scatter_add(self._shares, mi.Float(BASE), last)
        dr.make_opaque(self.weights, self._shares)

    def to_string(self) -> str:
        return f"GGXDictionaryBSDF[{len(self.lobes)} lobes, weights={self.weights}]"

    # ---------------------- Mitsuba's interface ----------------------

    def sample(self, ctx, si, sample1, sample2, active=True):
        bs = dr.zeros(mi.BSDFSample3f, dr.width(si.wi))
        wi = dr.detach(si.wi)
        probabilities = self._probabilities(ctx, wi)
        if not probabilities:
            return bs, mi.Spectrum(0)
        # The last alpha whose interval of random numbers begins before `sample1`
        begin, alpha, diffuse = mi.Float(0), mi.Float(1), mi.Bool(False)
        for k, p in probabilities.items():
            here = sample1 >= begin
            if k == len(self._alphas):
                diffuse = here
            else:
                alpha = dr.select(here, self._alphas[k], alpha)
            begin += p
        reflected = mi.reflect(wi, ggx.sample_visible_normal(dr.square(alpha), wi, sample2))
        bs.wo = dr.select(diffuse, mi.warp.square_to_cosine_hemisphere(sample2), reflected)
        bs.eta = 1
        flags = mi.BSDFFlags
        bs.sampled_type = dr.select(diffuse, mi.UInt32(+flags.DiffuseReflection), mi.UInt32(+flags.GlossyReflection))
        bs.sampled_component = dr.select(diffuse, mi.UInt32(DIFFUSE), mi.UInt32(GLOSSY))
        value, pdf = self.eval_pdf(ctx, si, bs.wo, active)
        bs.pdf = pdf
        return bs, dr.select(pdf > 0, value / dr.select(pdf > 0, pdf, 1), 0)

    def eval(self, ctx, si, wo, active=True):
        glossy, diffuse = _enabled(ctx)
        # A single index for all directions is cheaper, but its adjoint would be many sums over whole arrays
        zero = dr.zeros(mi.UInt32, dr.width(si.wi, wo) if dr.grad_enabled(self.weights) else 1)
        weight = lambda i: dr.gather(mi.UnpolarizedSpectrum, self.weights.array, zero + i)
        result = mi.UnpolarizedSpectrum(0)
        for alpha, factor, members in ggx.terms(self.lobes, si.wi, wo):
            if diffuse if np.isnan(alpha) else glossy:
                result += factor * sum(weight(i) * F for i, F in members)
        if self.scale is not None:
            result *= self.scale.eval_1(si, active)
        if self.base is not None and diffuse:
            result += self.base.eval(si, active) * ggx.diffuse(self._base_eta, si.wi.z, wo.z)
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), result * wo.z, 0)

    def pdf(self, ctx, si, wo, active=True):
        wi, wo = dr.detach(si.wi), dr.detach(wo)
        result = mi.Float(0)
        for k, p in self._probabilities(ctx, wi).items():
            diffuse = k == len(self._alphas)
            result += p * (wo.z * dr.inv_pi if diffuse else ggx.reflected_density(self._alphas[k] ** 2, wi, wo))
        return dr.select(active & (wi.z > 0) & (wo.z > 0), result, 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def eval_diffuse_reflectance(self, si, active=True):
        """Of the diffuse lobes."""
        result = mi.UnpolarizedSpectrum(0)
        for i in np.flatnonzero(np.isnan(self.lobes.alpha)).tolist():
            result += dr.gather(mi.UnpolarizedSpectrum, self.weights.array, dr.full(mi.UInt32, i, dr.width(si.wi)))
        if self.scale is not None:
            result *= self.scale.eval_1(si, active)
        if self.base is not None:
            result += self.base.eval(si, active)
        return dr.select(active, result, 0)

    def _probabilities(self, ctx: mi.BSDFContext, wi: mi.Vector3f) -> dict[int, mi.Float]:
        """With which the alphas, and behind them the diffuse lobes, are sampled, of those that are wanted."""
        glossy, diffuse = _enabled(ctx)
        count = len(self._alphas) + 1
        schlick = dr.power(dr.clip(1 - wi.z, 0, 1), 5)
        load = lambda i: dr.gather(mi.Float, self._shares, i)
        shares = {
            k: dr.lerp(load(k), load(k + count), schlick)
            for k in range(count)
            if (diffuse if k == len(self._alphas) else glossy)
        }
        if not shares:
            return {}
        even = 1 / len(shares)
        total = sum(shares.values())
        scale = dr.select(total > 0, (1 - EVEN) / total, 0)
        rest = dr.select(total > 0, EVEN * even, even)
        return {k: dr.fma(share, scale, rest) for k, share in shares.items()}


def _few_alphas(lobes: ggx.Lobes) -> tuple[list[float], list[int]]:
    """At most `SAMPLED_ALPHAS`, from the smallest to the largest; and for each lobe the number of the nearest. A
    diffuse lobe has the number behind the last."""
    alpha = np.log(np.array(lobes.alpha))
    distinct = np.unique(alpha[~np.isnan(alpha)])
    if len(distinct) > SAMPLED_ALPHAS:
        distinct = np.linspace(distinct[0], distinct[-1], SAMPLED_ALPHAS)
    nearest = [len(distinct) if np.isnan(a) else int(np.abs(distinct - a).argmin()) for a in alpha]
    return np.exp(distinct).tolist(), nearest


def _enabled(ctx: mi.BSDFContext) -> tuple[bool, bool]:
    """Are the glossy lobes and the diffuse ones wanted?"""
    flags = mi.BSDFFlags
    return ctx.is_enabled(flags.GlossyReflection, GLOSSY), ctx.is_enabled(flags.DiffuseReflection, DIFFUSE)


def _lobes_and_weights(props: mi.Properties) -> tuple[ggx.Lobes, np.ndarray]:
    """From numbers, or from a file or the package."""
    given = {key for key in ("weights", "alpha", "eta", "filename", "material") if key in props}
    if given in ({"weights"}, {"weights", "alpha", "eta"}):
        if "alpha" in given:
            lobes = ggx.Lobes(*(tuple(_array(props, key).ravel().tolist()) for key in ("alpha", "eta")))
        else:
            lobes, _ = ggx.read_dictionary()
        weights = _array(props, "weights")
        ggx.check_weights(weights, lobes)
        return lobes, weights
    path = str(mi.file_resolver().resolve(props["filename"])) if "filename" in given else ggx.SHIPPED
    if given == {"filename"}:
        return ggx.read(path)
    if given - {"filename"} != {"material"}:
        raise InputError(
            'give either "weights", or both "alpha" and "eta" with them, or "filename" or "material" or both; '
            f"got {', '.join(sorted(given)) or 'nothing'}"
        )
    lobes, materials = ggx.read_dictionary(path)
    if (name := props["material"]) not in materials:
        close = difflib.get_close_matches(name, materials, n=1) or [f"one of {', '.join(materials)}"]
        raise InputError(f'unknown "material" {name}, did you mean {close[0]}?')
    return lobes, materials[name]


def _array(props: mi.Properties, key: str) -> np.ndarray:
    try:
        return np.array(props[key], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f'"{key}" must be numbers, such as an mi.TensorXf, got {type(props[key]).__name__}') from None


mi.register_bsdf("ggx_dictionary", GGXDictionaryBSDF)
