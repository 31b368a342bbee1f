"""Which light a sample goes to, where there are many: in proportion to what each may contribute."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.smooth_lamps import SmoothLamps

#: Up to so many lights, all are equally likely, as in Mitsuba.
FEW = 8

#: Rays that leave each light, by which its power, place and direction are known: the square of a whole number.
RAYS = 16

#: Probability with which a light at a finite place is chosen whatever it seems to contribute, relative to that with
#: which all lights are equally likely.
ALIKE = 0.1

#: Least weight of a light that seems to shine or to lie behind something, relative to one straight ahead.
BEHIND = 0.05

#: Emitters at finite places that are known to send rays.
KNOWN = ("AreaLight", "PointLight", "SpotLight")


@dataclass
class ChosenLight:
    """A light for each point. Detached.

    emitter : mi.EmitterPtr, (N,). number : mi.UInt32, of the emitter in the scene.
    p : mi.Float, with which probability it was chosen.
    left : mi.Float, what is left of the random number, uniform in [0, 1).
    x, facing, total : the points, see `LightChoice.weight`, and the sum of the weights there.
    """

    emitter: mi.EmitterPtr
    number: mi.UInt32
    p: mi.Float
    left: mi.Float
    x: mi.Point3f
    facing: mi.Vector3f
    total: mi.Float


class LightChoice:
    """Chooses among the emitters of a scene, as a point x sees them.

    The weight of an emitter at a finite place c is Φ g / (|x − c|² + R²), with its power Φ, the root mean square R of
    its extent, and a factor g for the directions in which it shines and from which x is lit. All are estimated with a
    few rays that leave it. Environments, and lights at infinity, are chosen as often as without this.
    """

    _ARRAYS = ("emitters", "_order", "_index", "_place", "_shine")
    DRJIT_STRUCT = dict.fromkeys(("count", "near", "first", *_ARRAYS))  # for `dr.freeze`

    @staticmethod
    def of(scene: mi.Scene) -> LightChoice | None:
        """None where lights are few, have weights of their own, or are of kinds that it does not know; and where what
        Mitsuba renders depends on how it chooses (`SmoothLamps`)."""
        known = lambda e: bool(e.flags() & mi.EmitterFlags.Infinite) or e.class_name() in KNOWN
        emitters = scene.emitters()
        plain = all(known(e) and e.sampling_weight() == 1 and not hasattr(e, "light_count") for e in emitters)
        near = sum(not e.flags() & mi.EmitterFlags.Infinite for e in emitters)
        return LightChoice(scene) if near > FEW and plain and not len(SmoothLamps(scene)) else None

    def __init__(self, scene: mi.Scene):
        infinite = [bool(e.flags() & mi.EmitterFlags.Infinite) for e in scene.emitters()]
        self.count, self.near = len(infinite), infinite.count(False)
        # Those at finite places first.
        order = np.argsort(infinite, kind="stable")
        self._order = _kept(order)
        self.emitters = dr.gather(mi.EmitterPtr, scene.emitters_dr(), self._order)
        # From the number that Dr.Jit gives to an emitter to its place in this order.
        numbers = np.array(dr.reinterpret_array(mi.UInt32, self.emitters)).astype(np.int64)
        self.first = int(numbers.min())
        index = np.zeros(numbers.max() - self.first + 1)
        index[numbers - self.first] = np.arange(self.count)
        self._index = _kept(index)
        self.refit()

    def refit(self) -> None:
        """Follow the lights. To be called before sampling."""
        with dr.suspend_grad():
            k = dr.arange(mi.UInt32, self.near * RAYS)
            emitter = dr.gather(mi.EmitterPtr, self.emitters, k // RAYS)
            side, k = round(RAYS**0.5), k % RAYS
            place = mi.Point2f((mi.Float(k % side) + 0.5) / side, (mi.Float(k // side) + 0.5) / side)
            direction = mi.Point2f((mi.Float(7 * k % RAYS) + 0.5) / RAYS, (mi.Float(11 * k % RAYS) + 0.5) / RAYS)
            ray, power = emitter.sample_ray(0.0, 0.5, place, direction)
            mean = lambda x: dr.block_sum(x, RAYS) / RAYS
            c, m = ([mean(v[i]) for i in range(3)] for v in (ray.o, ray.d))
            spread = sum(mean(dr.square(ray.o[i])) - dr.square(c[i]) for i in range(3))
            power = dr.maximum(mean(dr.max(mi.unpolarized_spectrum(power))), 1e-20)
            self._place = dr.ravel(mi.Vector4f(*c, dr.maximum(spread, 0)))
            self._shine = dr.ravel(mi.Vector4f(*m, power))
            dr.eval(self._place, self._shine)

    def weight(self, light: mi.UInt32, x: mi.Point3f, facing: mi.Vector3f) -> mi.Float:
        """About what a light at a finite place contributes at x.

        facing : normal on the side from which x is lit; 0: both sides are.
        """
        place, shine = (dr.gather(mi.Vector4f, a, light) for a in (self._place, self._shine))
        m, d = mi.Vector3f(shine.x, shine.y, shine.z), mi.Vector3f(x) - mi.Vector3f(place.x, place.y, place.z)
        r2 = dr.squared_norm(d) + place.w
        r = dr.rsqrt(r2)
        # The mean direction of what shines everywhere is 0, that of a lamp 2/3 of its normal.
        shines = dr.maximum(1 - dr.norm(m) + dr.dot(m, d) * r, BEHIND)
        lit = dr.maximum((dr.sqrt(place.w) - dr.dot(facing, d)) * r, BEHIND)
        w = shine.w * shines * dr.select(dr.all(facing == 0), 1, lit) / r2
        return dr.select(dr.isfinite(w), w, 0)

    def choose(self, x: mi.Point3f, facing: mi.Vector3f, u: mi.Float, active: mi.Bool) -> ChosenLight:
        """One for each point. u : uniform random numbers."""

        def look(i, total, kept, left):
            w = self.weight(i, x, facing)
            total += w
            p = dr.select(total > 0, w / total, 0)
            taken = left < p
            left = dr.select(taken, left / p, (left - p) / (1 - p))
            return i + 1, total, dr.select(taken, i, kept), left

        last, by_weight = dr.one_minus_epsilon(mi.Float), self._by_weight
        width = dr.width(u)
        zero, first = dr.zeros(mi.Float, width), dr.zeros(mi.UInt32, width)
        _, total, light, left = dr.while_loop(
            (first, zero, mi.UInt32(first), dr.clip(u / by_weight, 0, last)),
            lambda i, *_: active & (i < self.near),
            look,
            label="choice of a light",
        )
        # Among those whose weight does not matter.
        rest = dr.clip((u - by_weight) / (1 - by_weight), 0, last) * (self.near * ALIKE + self.count - self.near)
        is_near = rest < self.near * ALIKE
        rest = dr.select(is_near, rest / ALIKE, rest - self.near * (ALIKE - 1))
        other = dr.minimum(mi.UInt32(rest), self.count - 1)
        weighed = u < by_weight
        light = dr.select(weighed, light, other)
        left = dr.clip(dr.select(weighed, left, rest - other), 0, last)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, light, active)
        number = dr.gather(mi.UInt32, self._order, light, active)
        return ChosenLight(emitter, number, self._probability(light, x, facing, total), left, x, facing, total)

    def probability(self, emitter: mi.EmitterPtr, at: ChosenLight) -> mi.Float:
        """With which an emitter would have been chosen at the points of `at`."""
        number = dr.maximum(dr.reinterpret_array(mi.UInt32, emitter), self.first) - self.first
        light = dr.gather(mi.UInt32, self._index, dr.minimum(number, dr.width(self._index) - 1))
        return self._probability(light, at.x, at.facing, at.total)

    @property
    def _by_weight(self) -> float:
        return self.near / self.count * (1 - ALIKE)

    def _probability(self, light, x, facing, total) -> mi.Float:
        is_near = light < self.near
        w = self.weight(dr.minimum(light, self.near - 1), x, facing)
        near = self._by_weight * dr.select(total > 0, w / total, 0) + ALIKE / self.count
        return dr.select(is_near, near, 1 / self.count)


def _kept(numbers: np.ndarray) -> mi.UInt32:
    """Not in NumPy's memory, for frozen functions."""
    kept = mi.UInt32(np.asarray(numbers, np.uint32)) + dr.opaque(mi.UInt32, 0)
    dr.eval(kept)
    return kept
