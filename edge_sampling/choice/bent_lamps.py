"""Points of lamps that do not face one way: cubes, balls and tubes that shine.

Mitsuba chooses a point of a mesh by area. As a shaded point sees a closed mesh, half of these points face away, and
many of the others are seen at a slant. So of a few candidates one is kept, by how much light it sends (Talbot et al.
2005, "Importance Resampling for Global Illumination").
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

#: Points of a lamp from which one is kept.
CANDIDATES = 8

#: Probability with which they are kept alike, whatever light they send: it bounds what a sample may count.
ALIKE = 0.02

#: A mesh of so many faces is taken to be flat: that of a square.
FLAT = 2

#: Where more lamps than these are bent, all lamps are taken to be.
FEW = 8

#: From one candidate to the next, modulo 1: the powers of 1 / 1.3247…, so that they are spread over the square.
SHIFT = (0.7548776662466927, 0.5698402909980532)


class BentLamps:
    """The lamps of a scene whose points do not all face one way: meshes and cylinders. (Spheres are sampled by the
    directions that they subtend. Of a lamp with a texture, what is dark may become brighter: it is none of them.)"""

    DRJIT_STRUCT = dict.fromkeys(("_lamps",))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        self._lamps = [mi.EmitterPtr(e) for e in scene.emitters() if is_bent(e)]

    def __len__(self) -> int:
        return len(self._lamps)

    def are(self, emitter: mi.EmitterPtr) -> mi.Bool:
        """Is an emitter one of them? Where they are many, all lamps are taken to be, which is as right."""
        if len(self) > FEW:
            return mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        found = mi.Bool(False)
        for lamp in self._lamps:
            found |= emitter == lamp
        return found

    def resample(
        self, emitter: mi.EmitterPtr, look: Callable[[mi.Point2f, mi.Bool], mi.Spectrum], u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float]:
        """Random numbers for a point of a light, and the factor of the light that is found with them. Detached. Of
        lights that are none of these lamps, the numbers stay, and the factor is 1.

        The candidates are a lattice that is shifted by `u`, so each of them is uniform by itself. The factor is the
        mean of their weights over that of the one that is kept: its expectation, with any weight of multiple importance
        sampling for the density by area, is that of one point that was chosen by area.

        emitter : (N,). look : the light that arrives from a point of the emitter, over its density; visibility is not
        tested. u : mi.Point2f, (N,), uniform random numbers.
        """
        with dr.suspend_grad():
            active, u = active & self.are(emitter), dr.detach(u)
            kept, weights = mi.Point2f(u), []
            for k in range(CANDIDATES):
                # By its root: how much light changes as something moves is not in proportion to it.
                light = dr.sqrt(dr.max(mi.unpolarized_spectrum(look(_candidate(u, k), active))))
                weights.append(dr.select(active & dr.isfinite(light), light, 0))
            total = sum(weights)
            mean = total / CANDIDATES
            # It depends on where the point is alone, so that both sides of an edge keep the same one.
            choice = _hashed(u) * CANDIDATES
            weight, below = mi.Float(1), mi.Float(0)
            for k, light in enumerate(weights):
                relative = dr.select(mean > 0, dr.lerp(light / mean, 1, ALIKE), 1)
                taken = choice >= below
                kept = dr.select(taken, _candidate(u, k), kept)
                weight = dr.select(taken, relative, weight)
                below += relative
            return dr.select(active, kept, u), dr.select(active, dr.rcp(weight), 1)


def _candidate(u: mi.Point2f, k: int) -> mi.Point2f:
    shifted = mi.Point2f(u.x + k * SHIFT[0] % 1, u.y + k * SHIFT[1] % 1)
    return dr.minimum(shifted - dr.floor(shifted), dr.one_minus_epsilon(mi.Float))


def _hashed(u: mi.Point2f) -> mi.Float:
    """A uniform random number that is independent of two others, as far as it matters."""
    return mi.sample_tea_float32(*(dr.reinterpret_array(mi.UInt32, mi.Float(x)) for x in (u.x, u.y)))


def is_bent(emitter: mi.Emitter) -> bool:
    """Does it shine alike from all points of a surface that may not be flat?"""
    if emitter.class_name() != "AreaLight" or emitter.flags() & mi.EmitterFlags.SpatiallyVarying:
        return False
    shape = emitter.get_shape()
    return shape.face_count() > FLAT if shape.is_mesh() else shape.class_name() == "Cylinder"
