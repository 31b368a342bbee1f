"""The lights of a scene, one by one."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class Lights:
    """The lights of a scene: every emitter, or where an emitter consists of several lights, each of these.

    An emitter of several lights is written in Python, and has besides Mitsuba's interface:

    light_count : int, the number of its lights.
    light_sample : maps (which: mi.UInt32, sample: mi.Point2f) to (mi.Point2f, mi.Float): the random numbers with which
        its `sample_direction` chooses the light `which`, and the point `sample` of this; and the probability with which
        uniform random numbers choose that light. Detached.

    Parameters
    ----------
    scene : mi.Scene
    """

    DRJIT_STRUCT = dict.fromkeys(("emitter", "part", "delta", "several"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        emitters = scene.emitters()
        counts = [getattr(e, "light_count", 1) for e in emitters]
        firsts = [sum(counts[:i]) for i in range(len(counts))]
        #: Emitter of each light, and which of its lights it is.
        self.emitter = _runs([(i, 0, n) for i, n in enumerate(counts)])
        self.part = _runs([(0, 1, n) for n in counts])
        #: Numbers of the lights without size (or with little, where an emitter consists of several). None: none.
        delta = [(k, 1, n) for k, n, e in zip(firsts, counts, emitters, strict=True) if _may_be_delta(e)]
        self.delta = _runs(delta) if delta else None
        #: Emitters that consist of several lights, by their number in the scene.
        self.several = {i: e for i, e in enumerate(emitters) if hasattr(e, "light_count")}

    def __len__(self) -> int:
        return dr.width(self.emitter)

    def sample_direction(
        self, scene: mi.Scene, light: mi.UInt32, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction towards a light, and the radiance that arrives from there divided by its density: Mitsuba's
        `Emitter.sample_direction` for this light alone.

        light : mi.UInt32, (N,), number of the light.
        """
        emitter = dr.gather(mi.UInt32, self.emitter, light, active)
        probability = mi.Float(1)
        for i, several in self.several.items():
            with dr.suspend_grad():
                mine = active & (emitter == i)
                chosen, p = several.light_sample(dr.gather(mi.UInt32, self.part, light, mine), sample)
                sample, probability = dr.select(mine, chosen, sample), dr.select(mine, p, probability)
        ds, weight = dr.gather(mi.EmitterPtr, scene.emitters_dr(), emitter, active).sample_direction(it, sample, active)
        ds.pdf /= probability
        return ds, weight * probability

    def places(self, scene: mi.Scene) -> mi.Vector4f | None:
        """Where the lights without size are: mi.Vector4f, (M,), homogeneous coordinates, world space: (position, 1), or
        (direction towards it, 0) at infinity. Detached. None: there are none."""
        light = self.delta
        if light is None:
            return None
        with dr.suspend_grad():
            it = dr.zeros(mi.SurfaceInteraction3f, dr.width(light))
            ds, _ = self.sample_direction(scene, light, it, mi.Point2f(0.5), mi.Bool(True))
            emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.emitter, light))
            far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
            place = dr.select(far, mi.Point3f(ds.d), ds.p)
            return mi.Vector4f(place.x, place.y, place.z, dr.select(far, mi.Float(0), 1))


def _runs(runs: list[tuple[int, int, int]]) -> mi.UInt32:
    """first, first + step, ..., of each (first, step, count). Made on the device: `dr.freeze` refuses arrays that come
    from the host."""
    joined: list[tuple[int, int, int]] = []
    for first, step, count in runs:
        before, increment, n = joined[-1] if joined else (0, 0, 0)
        increment = first - before if n == 1 else increment
        if n and increment in (0, 1) and first == before + increment * n and (count == 1 or step == increment):
            joined[-1] = before, increment, n + count
        else:
            joined.append((first, step, count))
    i, start = dr.arange(mi.UInt32, sum(count for *_, count in runs)), 0
    numbers = i
    for first, step, count in joined:
        numbers = dr.select(i >= start, first + step * (i - start), numbers)
        start += count
    return numbers


def _may_be_delta(emitter: mi.Emitter) -> bool:
    return bool(emitter.flags() & mi.EmitterFlags.Delta) or hasattr(emitter, "light_count")
