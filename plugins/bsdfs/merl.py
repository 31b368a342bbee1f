"""Plugin `merl`: measured isotropic reflectance, differentiable with respect to its table and to directions."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight import merl_tables
from rimlight.edge_sampling.refusals import InputError

N_H, N_D, N_P, _ = merl_tables.SHAPE

#: Sampled half vectors are tabulated for this many angles of incidence and azimuths, and for the table's own θ_h.
INCIDENCES, AZIMUTHS = 32, 32

#: Part of the samples that is spread by the cosine instead, lest any weigh much where those cells are too coarse.
COSINE = 0.05

#: Reflectance, 1/sr, that sampling adds to the table's, so that a black one has a distribution, too.
DARKEST = 1e-6


class MERLBSDF(mi.BSDF):
    r"""
    .. _bsdf-merl:

    Measured isotropic material (:monosp:`merl`)
    --------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A table of the MERL database, ``.binary``. (Default: none)

     * - table
       - |tensor|
       - Instead of it, in Python: ``mi.TensorXf`` of shape (90, 90, 180, 3), the reflectance :math:`f` in 1/sr (without
         the cosine), linear RGB, by :math:`\theta_h`, :math:`\theta_d` and :math:`\phi_d`.
       - |exposed|, |differentiable|

    Reflectance as it was measured, for example of the hundred materials of *A Data-Driven Reflectance Model* (Matusik
    et al. 2003). It is tabulated by half and difference angles (Rusinkiewicz 1998): :math:`\theta_h` between the normal
    and the half vector, :math:`\theta_d` between the half vector and either direction, and the azimuth :math:`\phi_d`
    of a direction about the half vector. Entry :math:`(i, j, k)`, counted from 0, is for

    .. math::

       \theta_h = \Bigl(\frac{i + 1/2}{90}\Bigr)^2 \frac{\pi}{2}, \qquad
       \theta_d = \frac{j + 1/2}{90}\, \frac{\pi}{2}, \qquad
       \phi_d = \frac{k + 1/2}{180}\, \pi .

    Between entries, :math:`f` is linear in :math:`\sqrt{\theta_h}`, :math:`\theta_d` and :math:`\phi_d`, and goes on
    around :math:`\phi_d = \pi`. It is reciprocal without any error, since exchanged directions differ by :math:`\pi` in
    :math:`\phi_d`. It is differentiable with respect to the table, and piecewise with respect to directions and
    normals. ``rimlight.merl_tables`` reads and writes tables.

    **Horizon.** Entries one of whose directions is below the horizon do not count: in their place stands the last
    above, at the same :math:`\theta_h` and :math:`\phi_d`. Files have -1 there, and some have it at grazing angles: a
    negative number within 5 degrees of the horizon, or below it, is read as 0. Elsewhere it is damage, for which the
    table is refused, as it is for numbers that are not finite. Where an optimiser makes :math:`f` negative, it is 0,
    without a derivative.

    **Energy.** Nothing is rescaled. A measured surface may reflect more than it receives, at grazing angles most of
    all, where measurements are few and noisy; light between such surfaces need not fade.

    **Sampling.** Half vectors, from a distribution that is made of the table, and made anew when it changes: for 32
    angles of incidence, :math:`f` times the cosine in cells of the table's own :math:`\theta_h` and 32 azimuths. A
    twentieth of the samples is spread by the cosine. For fabrics, paints, plastics and metals, the variance of a
    sample's weight is at most about a tenth of its squared mean, and its largest value four times the mean, at any
    angle of incidence. Samples and their densities carry no gradients.

    **Limits.** The back of a surface is black: put this into a ``twosided``. Monochromatic variants see the luminance.
    Spectral variants are refused, since tables have three colours only; so are polarised ones. Highlights may be
    as small as a hundredth of a degree, but far from the normal, half vectors are told apart by 2 degrees at best.
    Each table takes 18 MB.

    .. tabs::
        .. code-tab:: xml

            <bsdf type="twosided">
                <bsdf type="merl">
                    <string name="filename" value="gray-plastic.binary"/>
                </bsdf>
            </bsdf>

        .. code-tab:: python

            'type': 'twosided',
            'bsdf': {
                'type': 'merl',
                'filename': 'gray-plastic.binary',
            }
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        who = props.plugin_name()
        if mi.is_polarized:
            raise InputError(f"{who}: polarised variants are not supported, got {mi.variant()}")
        if mi.is_spectral:
            raise InputError(
                f"{who}: spectral variants are not supported, got {mi.variant()}: tables are RGB; use an rgb variant"
            )
        if ("filename" in props) == ("table" in props):
            raise InputError(f'{who}: give either "filename" or "table"')
        if "filename" in props:
            table = merl_tables.read_merl(str(mi.file_resolver().resolve(props["filename"])))
        else:
            table = _array(props["table"], f'{who}: "table"')
        self.table = mi.TensorXf(np.float32(table))
        #: For each θ_h and φ_d, the last θ_d above the horizon: all before it are, too.
        self._last = mi.Float(np.float32((merl_tables.elevation() > 0).sum(1) - 1).ravel())
        flags = mi.BSDFFlags
        self.m_components = [flags.DiffuseReflection | flags.GlossyReflection | flags.FrontSide]
        self.m_flags = self.m_components[0]
        self.parameters_changed()

    # ---------------------- Parameters ----------------------

    def traverse(self, cb: mi.TraversalCallback) -> None:
        cb.put("table", self.table, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        if tuple(self.table.shape) != merl_tables.SHAPE:
            got = tuple(self.table.shape)
            raise InputError(f'merl: "table" must keep its shape {merl_tables.SHAPE}, got {got}')
        dr.make_opaque(self.table, self._last)
        with dr.suspend_grad():
            self._tabulate_half_vectors()

    def to_string(self) -> str:
        return f"{type(self).__name__}[table={tuple(self.table.shape)}]"

    # ---------------------- Mitsuba's interface ----------------------

    def sample(self, ctx, si, sample1, sample2, active=True):
        wi = dr.detach(si.wi)
        half = mi.reflect(wi, self._sample_half_vector(wi, (sample1 - COSINE) / (1 - COSINE), sample2))
        bs = dr.zeros(mi.BSDFSample3f, dr.width(wi))
        bs.wo = dr.detach(dr.select(sample1 < COSINE, mi.warp.square_to_cosine_hemisphere(sample2), half))
        bs.eta = 1
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        active = _active(ctx, si, bs.wo, active)
        bs.pdf = dr.select(active, self._pdf(wi, bs.wo), 0)
        active &= bs.pdf > 0
        value = self._reflectance(si.wi, bs.wo, active) * bs.wo.z
        return bs, dr.select(active, _spectrum(value) / dr.select(active, bs.pdf, 1), 0)

    def eval(self, ctx, si, wo, active=True):
        active = _active(ctx, si, wo, active)
        return dr.select(active, _spectrum(self._reflectance(si.wi, wo, active) * wo.z), 0)

    def pdf(self, ctx, si, wo, active=True):
        return dr.select(_active(ctx, si, wo, active), self._pdf(si.wi, wo), 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    # ---------------------- The table ----------------------

    def _reflectance(self, wi: mi.Vector3f, wo: mi.Vector3f, active: mi.Bool | bool) -> mi.Color3f:
        """f, 1/sr; attached to the table and the directions."""
        h, d, p = _coordinates(wi, wo)
        h0 = dr.minimum(mi.UInt32(h), N_H - 2)
        h_weight = h - mi.Float(h0)
        p_floor = dr.floor(p)
        p_weight = p - p_floor
        p0 = dr.select(p_floor < 0, N_P - 1, dr.minimum(mi.UInt32(p_floor), N_P - 1))
        p1 = dr.select(p0 == N_P - 1, 0, p0 + 1)
        f = mi.Color3f(0)
        for i, i_weight in ((h0, 1 - h_weight), (h0 + 1, h_weight)):
            for k, k_weight in ((p0, 1 - p_weight), (p1, p_weight)):
                d_above = dr.minimum(d, dr.gather(mi.Float, self._last, i * N_P + k, active))
                j = dr.minimum(mi.UInt32(d_above), N_D - 2)
                entry = (i * N_D + j) * N_P + k
                near, far = (dr.gather(mi.Color3f, self.table.array, entry + m * N_P, active) for m in (0, 1))
                f += dr.lerp(near, far, d_above - mi.Float(j)) * (i_weight * k_weight)
        return dr.select(f < 0, 0, f)

    # ---------------------- Sampling of half vectors ----------------------
    # Cell (n, i, a): incidence n, interval i of θ_h, azimuth a about the normal from that of `wi` on. In a cell, half
    # vectors are uniform in solid angle; between two incidences, their distributions are mixed.

    def _tabulate_half_vectors(self) -> None:
        corner = dr.arange(mi.UInt32, INCIDENCES * (N_H + 1) * AZIMUTHS)
        azimuth, row = corner % AZIMUTHS, corner // AZIMUTHS
        sin, cos = dr.sincos(mi.Float(row // (N_H + 1)) * (dr.pi / 2 / (INCIDENCES - 1)))
        wi = mi.Vector3f(sin, 0, dr.maximum(cos, 1e-4))
        h = _half_vector(_border(row % (N_H + 1)), mi.Float(azimuth) / AZIMUTHS)
        wo = mi.reflect(wi, h)
        f = dr.mean(self._reflectance(wi, wo, True)) + DARKEST
        # f cos θₒ dωₒ, with dωₒ = 4 (ωᵢ · h) dω_h: the mean of a cell's corners, but for constants
        value = f * (dr.maximum(wo.z, 0) * dr.maximum(dr.dot(wi, h), 0))

        cell = dr.arange(mi.UInt32, INCIDENCES * N_H * AZIMUTHS)
        azimuth, row = cell % AZIMUTHS, cell // AZIMUTHS
        following = dr.select(azimuth == AZIMUTHS - 1, 0, azimuth + 1)
        solid_angle = _border(row % N_H + 1) - _border(row % N_H)  # but for a constant
        row += row // N_H  # there is a row of corners more than of cells for each incidence
        weight = mi.Float(0)
        for c in (azimuth, following, azimuth + AZIMUTHS, following + AZIMUTHS):
            weight += dr.gather(mi.Float, value, row * AZIMUTHS + c) * solid_angle
        #: Cumulative probabilities of the azimuths in each row, and of the rows in each incidence.
        self._azimuths, weight = _cumulate(weight, AZIMUTHS)
        self._rows, _ = _cumulate(weight, N_H)
        #: Density of half vectors in each cell, per sr.
        p = dr.repeat(_differences(self._rows, N_H), AZIMUTHS) * _differences(self._azimuths, AZIMUTHS)
        self._density = p / (solid_angle * (4 * dr.pi / AZIMUTHS))
        dr.make_opaque(self._azimuths, self._rows, self._density)

    def _sample_half_vector(self, wi: mi.Vector3f, sample1: mi.Float, sample2: mi.Point2f) -> mi.Vector3f:
        incidence, mixture = _incidence(wi)
        incidence += dr.select(sample1 < mixture, mi.UInt32(1), 0)
        i, u = _invert(self._rows, incidence * N_H, N_H, sample2.x)
        a, v = _invert(self._azimuths, (incidence * N_H + i) * AZIMUTHS, AZIMUTHS, sample2.y)
        h = _half_vector(dr.lerp(_border(i), _border(i + 1), u), (mi.Float(a) + v) / AZIMUTHS)
        cos, sin = _azimuth(wi)
        return mi.Vector3f(cos * h.x - sin * h.y, sin * h.x + cos * h.y, h.z)

    def _pdf(self, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Float:
        """Density of `sample`, per sr, of directions above the surface. Detached."""
        wi, wo = dr.detach(wi), dr.detach(wo)
        h = dr.normalize(wi + wo)
        cos, sin = _azimuth(wi)
        phi = dr.atan2(cos * h.y - sin * h.x, cos * h.x + sin * h.y) * (0.5 * dr.inv_pi)
        a = dr.minimum(mi.UInt32(dr.select(phi < 0, phi + 1, phi) * AZIMUTHS), AZIMUTHS - 1)
        theta_h = dr.atan2(dr.sqrt(dr.square(h.x) + dr.square(h.y)), h.z)
        i = dr.minimum(mi.UInt32(dr.sqrt(theta_h * (2 * dr.inv_pi)) * N_H), N_H - 1)
        incidence, mixture = _incidence(wi)
        cell = (incidence * N_H + i) * AZIMUTHS + a
        low, high = (dr.gather(mi.Float, self._density, cell + m * (N_H * AZIMUTHS)) for m in (0, 1))
        of_half = dr.lerp(low, high, mixture) / (4 * dr.maximum(dr.dot(wi, h), 1e-6))
        return dr.lerp(of_half, wo.z * dr.inv_pi, COSINE)


# ---------------------- Angles ----------------------


def _coordinates(wi: mi.Vector3f, wo: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Where directions are in the table, in entries: 0 is the first. As `merl_tables.half_difference`; attached.

    Exchanged directions give the same numbers, bit for bit: all that changes is the sign of `e`, which `turn` undoes.
    """
    s, e = wi + wo, wi - wo
    theta_h = dr.atan2(dr.norm(mi.Vector2f(s.x, s.y)), s.z)
    theta_d = dr.atan2(dr.norm(e), dr.norm(s))
    x, y = -e.z * dr.norm(s), e.y * s.x - e.x * s.y
    turn = dr.select((y < 0) | ((y == 0) & (x < 0)), mi.Float(-1), 1)
    phi_d = dr.atan2(y * turn, x * turn)
    h = dr.sqrt(theta_h * (2 * dr.inv_pi)) * N_H - 0.5
    d = theta_d * (2 * dr.inv_pi * N_D) - 0.5
    p = phi_d * (dr.inv_pi * N_P) - 0.5
    # Towards θ_h = 0 and θ_d = 0, the derivative of φ_d grows without bound and that of f along it vanishes: their
    # product is rounding
    p = dr.select((h < 0) | (d < 0), dr.detach(p), p)
    return dr.clip(h, 0, N_H - 1), dr.clip(d, 0, N_D - 1), p


def _border(i: mi.UInt32) -> mi.Float:
    """sin² (θ_h / 2) = (1 - cos θ_h) / 2 where interval i of θ_h begins. Solid angles are differences of it."""
    return dr.square(dr.sin(dr.square(mi.Float(i) / N_H) * (dr.pi / 4)))


def _half_vector(sin2: mi.Float, turn: mi.Float) -> mi.Vector3f:
    """Of sin² (θ_h / 2), and of an azimuth in full turns."""
    sin, cos = dr.sincos(dr.two_pi * turn)
    radius = 2 * dr.sqrt(sin2 * (1 - sin2))
    return mi.Vector3f(radius * cos, radius * sin, 1 - 2 * sin2)


def _azimuth(w: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Cosine and sine of the azimuth of `w`; 1 and 0 for the normal."""
    r = dr.sqrt(dr.square(w.x) + dr.square(w.y))
    tilted = r > 1e-7
    return dr.select(tilted, w.x / r, 1), dr.select(tilted, w.y / r, 0)


def _incidence(wi: mi.Vector3f) -> tuple[mi.UInt32, mi.Float]:
    """The tabulated incidence before that of `wi`, and how much of the distribution is that of the next one."""
    t = dr.safe_acos(wi.z) * ((INCIDENCES - 1) * 2 * dr.inv_pi)
    n = dr.minimum(mi.UInt32(t), INCIDENCES - 2)
    return n, dr.clip(t - mi.Float(n), 0, 1)


# ---------------------- Discrete distributions, many in one array ----------------------


def _cumulate(weight: mi.Float, size: int) -> tuple[mi.Float, mi.Float]:
    """Cumulative probabilities in each block of `size`; and the blocks' sums."""
    sums = dr.block_prefix_sum(weight, size, exclusive=False)
    total = dr.gather(mi.Float, sums, dr.arange(mi.UInt32, dr.width(weight) // size) * size + (size - 1))
    return sums / dr.maximum(dr.repeat(total, size), dr.smallest(mi.Float)), total


def _differences(cumulated: mi.Float, size: int) -> mi.Float:
    """The probabilities that `_invert` has, to the last bit."""
    k = dr.arange(mi.UInt32, dr.width(cumulated))
    return dr.maximum(cumulated - dr.gather(mi.Float, cumulated, k - 1, k % size > 0), 0)


def _invert(cumulated: mi.Float, first: mi.UInt32, size: int, sample: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Which one of the block from `first` on is chosen; and what is left of the random number, in [0, 1]."""
    k = dr.binary_search(0, size - 1, lambda k: dr.gather(mi.Float, cumulated, first + k) <= sample)
    begin = dr.gather(mi.Float, cumulated, first + k - 1, k > 0)
    end = dr.gather(mi.Float, cumulated, first + k)
    return k, dr.clip((sample - begin) / dr.maximum(end - begin, dr.smallest(mi.Float)), 0, 1)


# ---------------------- Small things ----------------------


def _active(ctx, si, wo, active) -> mi.Bool:
    flags = mi.BSDFFlags
    enabled = ctx.is_enabled(flags.DiffuseReflection, 0) or ctx.is_enabled(flags.GlossyReflection, 0)
    return mi.Bool(active) & enabled & (si.wi.z > 0) & (wo.z > 0)


def _spectrum(value: mi.Color3f) -> mi.Spectrum:
    return mi.Spectrum(mi.luminance(value)) if mi.is_monochromatic else value


def _array(value, what: str) -> np.ndarray:
    """A table that is given in Python, negative numbers below the horizon as 0."""
    try:
        table = np.array(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{what} must be mi.TensorXf of shape {merl_tables.SHAPE}, got {type(value).__name__}"
        ) from None
    merl_tables.check(table, what, "see rimlight.merl_tables")
    return np.maximum(table, 0)


mi.register_bsdf("merl", MERLBSDF)
