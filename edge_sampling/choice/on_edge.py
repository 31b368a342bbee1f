"""Points on an edge: densities that follow what a viewer wants of the directions."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.beside import EDGE_ON

from .edge_tree import Slot
from .views import Cone, Lobe, View

#: Added to the cosine of an edge: it stands for all of the edge, and the normal at a shading point may be that of the
#: face, not of the shading.
MARGIN = 0.05


@dataclass
class _Wide:
    """Density of a point on an edge in proportion to the angle under which it is seen.

    With s along the line from the foot of the perpendicular from the viewer, of length h: s = h tan φ.
    """

    foot: mi.Float
    h: mi.Float
    start: mi.Float
    angle: mi.Float
    total: mi.Float

    def sample(self, u: mi.Float) -> mi.Float:
        return self.foot + self.h * dr.tan(self.start + u * self.angle)

    def pdf(self, s: mi.Float) -> mi.Float:
        return self.h / (self.angle * (dr.square(self.h) + dr.square(s - self.foot)))


@dataclass
class _Narrow:
    """Density in proportion to (a² + s²)^(-3/2), with s along the line from where it comes closest to an axis. Its
    integral is s / (a² √(a² + s²)), in units of a."""

    closest: mi.Float
    a: mi.Float
    start: mi.Float
    extent: mi.Float
    total: mi.Float

    def sample(self, u: mi.Float) -> mi.Float:
        v = self.start + u * self.extent
        return self.closest + self.a * v * dr.rsqrt(dr.maximum(1 - v * v, 1e-7))

    def pdf(self, s: mi.Float) -> mi.Float:
        x = (s - self.closest) / self.a
        return falloff(x * x) / (self.a * self.extent)


def _on_line(a: mi.Vector3f, b: mi.Vector3f, view: View) -> list[_Wide | _Narrow]:
    """Densities on an edge from a to b, as seen from the viewer, by length along it, with their weights: that of all
    directions, and of each lobe."""
    e = b - a
    length = dr.norm(e)
    e = e / length
    foot = -dr.dot(a, e)
    nearest = dr.maximum(dr.norm(a), dr.norm(a + e * length))
    h = dr.maximum(dr.norm(a + foot * e), 1e-6 * nearest)
    start = dr.atan2(-foot, h)
    angle = dr.maximum(dr.atan2(length - foot, h) - start, 1e-7)
    middle = dr.normalize(a + 0.5 * length * e)
    cosine = dr.select(dr.all(view.n == 0), 1, dr.clip(dr.dot(view.n, middle), 0, 1) + MARGIN)
    wide = _Wide(foot, h, start, angle, view.wide * cosine * angle)
    return [wide, *(narrow(lobe, a, e, length, h) for lobe in view.lobes)]


def narrow(lobe: Lobe, a: mi.Vector3f, e: mi.Vector3f, length: mi.Float, h: mi.Float) -> _Narrow:
    """a : one end, seen from the viewer; e : direction of the edge; h : distance of its line."""
    across = lambda v: v - lobe.axis * dr.dot(lobe.axis, v)
    a_across, e_across = across(a), across(e)
    g2 = dr.maximum(dr.squared_norm(e_across), 1e-6)
    closest = dr.clip(-dr.dot(a_across, e_across) / g2, 0, length)
    c = a + closest * e
    r2 = dr.squared_norm(c)
    behind = dr.dot(lobe.axis, c) <= 0
    off2 = dr.select(behind, r2, dr.squared_norm(a_across + closest * e_across))
    A2 = dr.square(lobe.width) * r2
    k = dr.sqrt((A2 + off2) / g2)
    at = lambda s: (s - closest) / k * dr.rsqrt(1 + dr.square((s - closest) / k))
    start = at(mi.Float(0))
    extent = dr.maximum(at(length) - start, 1e-7)
    total = lobe.peak * A2 * dr.sqrt(A2) / (g2 * dr.sqrt(g2) * k * k) * extent * h / r2
    return _Narrow(closest, k, start, extent, dr.select(dr.isfinite(total), total, 0))


def sample_point(slot: Slot, view: View, choice: mi.Float, u: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Parameter t of a point on the edge, and its density."""
    a, b, start, end = part_in_view(slot, view)
    length = dr.norm(b - a)
    densities = _on_line(a, b, view)
    total = sum(d.total for d in densities)
    s, below = densities[0].sample(u), densities[0].total
    for d in densities[1:]:
        s = dr.select(choice * total < below, s, d.sample(u))
        below = below + d.total  # not in place: it is the total of a density
    s = dr.clip(s, 0, length)
    pdf = sum(d.total * d.pdf(s) for d in densities) / total
    t, pdf = dr.lerp(start, end, s / length), pdf * length / (end - start)
    return (t, pdf) if view.far is None else (dr.select(view.far, u, t), dr.select(view.far, 1, pdf))


def is_silhouette(slot: Slot, view: View) -> mi.Bool:
    """Do the faces of an edge lie on either side of the plane through it and the viewer, or is it one from anywhere?"""
    y = mi.Vector4f(view.p.x, view.p.y, view.p.z, -view.w)
    signs = [dr.dot(q, y) for q in slot.planes]
    edge_on = 4 * EDGE_ON * dr.norm(view.w * slot.a - view.p)
    return (signs[0] * signs[1] <= 0) | (dr.abs(signs[0]) <= edge_on) | (dr.abs(signs[1]) <= edge_on)


def part_in_view(slot: Slot, view: View) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Float]:
    """The part of an edge that counts in a view: inside of its cone, and of its vicinity if the edge is no silhouette.
    Its ends, seen from the viewer, and its interval of t. Where there is none, the ends are equal."""
    a, b = view.w * slot.a - view.p, view.w * slot.b - view.p
    e = b - a
    start, end = (mi.Float(0), mi.Float(1)) if view.cone is None else _in_cone(a, e, view.cone)
    if view.vicinity is not None:
        near, far = _in_ball(a, e, view.vicinity.radius)
        everywhere = is_silhouette(slot, view)
        start, end = (
            dr.select(everywhere, start, dr.maximum(start, near)),
            dr.select(everywhere, end, dr.minimum(end, far)),
        )
        end = dr.maximum(start, end)
    if view.cone is None and view.vicinity is None:
        return a, b, start, end
    return a + start * e, a + end * e, start, end


def _in_ball(a: mi.Vector3f, e: mi.Vector3f, radius: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Where a + t e is within a ball about the origin: an interval in [0, 1]; with equal ends if nowhere."""
    e2 = dr.squared_norm(e)
    middle = -dr.dot(a, e) / e2
    half2 = (dr.square(radius) - dr.squared_norm(a + middle * e)) / e2
    half = dr.safe_sqrt(half2)
    start, end = dr.clip(middle - half, 0, 1), dr.clip(middle + half, 0, 1)
    return start, dr.select(half2 > 0, end, start)


def _in_cone(a: mi.Vector3f, e: mi.Vector3f, cone: Cone) -> tuple[mi.Float, mi.Float]:
    """Where a + t e is in a cone about the origin: an interval in [0, 1]; with equal ends if nowhere."""
    # In the cone, off² cos² - along² sin² <= 0 and along > 0. As a function of t, that is A t² + 2 B t + C.
    a_along, e_along = dr.dot(cone.axis, a), dr.dot(cone.axis, e)
    a_off, e_off = a - cone.axis * a_along, e - cone.axis * e_along
    cos2, sin2 = dr.square(cone.cos), dr.square(cone.sin)
    A = cos2 * dr.squared_norm(e_off) - sin2 * dr.square(e_along)
    B = cos2 * dr.dot(a_off, e_off) - sin2 * a_along * e_along
    C = cos2 * dr.squared_norm(a_off) - sin2 * dr.square(a_along)
    discriminant = B * B - A * C
    q = -(B + dr.mulsign(dr.safe_sqrt(discriminant), B))
    roots = q / A, dr.select(q != 0, C / q, 0)
    first, last = dr.minimum(*roots), dr.maximum(*roots)
    # A line that is less steep than the cone is inside between the roots; a steeper one beyond one of them.
    between = A > 0
    start = dr.select(between, first, dr.select(e_along > 0, last, -dr.inf))
    end = dr.select(between, last, dr.select(e_along > 0, dr.inf, first))
    before = -a_along / e_along
    start = dr.select(between & (e_along > 0), dr.maximum(start, before), start)
    end = dr.select(between & (e_along < 0), dr.minimum(end, before), end)
    nothing = between & ((discriminant < 0) | ((e_along == 0) & (a_along < 0)))
    start, end = dr.clip(start, 0, 1), dr.clip(end, 0, 1)
    end = dr.select(nothing, start, dr.maximum(start, end))
    return dr.select(cone.everything, 0, start), dr.select(cone.everything, 1, end)


def along_and_off(axis: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Part of d along an axis, and the square of its distance from the axis."""
    along = dr.dot(axis, d)
    return along, dr.squared_norm(d - axis * along)


def falloff(x: mi.Float) -> mi.Float:
    """(1 + x)^(-3/2)"""
    r = dr.rsqrt(1 + x)
    return r * r * r
