"""Which part of the light of lamps is held at points of the lamp, and which in its direction.

Of a point on a lamp that is held, the light changes fast in two cases as x, where it arrives, moves: close to the lamp
(`close_lamps.py`), and in a narrow lobe of a BSDF. A polished floor reflects light from few directions; a lamp that
leaves them soon does not shine there any more. So in narrow lobes the direction is held, relative to the lobe: as its
axis turns, so does the direction, and what is seen past the outline of the lamp counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from .close_lamps import CloseLamps, divisible
from .emitter_table import EmitterTable
from .geometry.meshes import inner, surfaces
from .parametrisation import Division, Turning, Vicinity

#: Largest width of a narrow lobe, radians: twice the roughness of a microfacet BSDF.
NARROW = 0.3

#: How far from the axis of a lobe its density is compared, relative to the width of a lobe that has all samples.
ASIDE = 0.25

#: Places of a texture, and cosines of the direction to the viewer, at which BSDFs are probed for narrow lobes.
PROBES, COSINES = 256, (1.0, 0.7)


@dataclass(frozen=True)
class DividedLight:
    """How the light of the lamps of a scene is divided.

    close : the lamps that are close to what they light. lobes : narrow ones of BSDFs. None: there are none.
    """

    close: CloseLamps | None
    lobes: NarrowLobes | None

    DRJIT_STRUCT = dict.fromkeys(("close", "lobes"))  # for `dr.freeze`

    @staticmethod
    def of(scene: mi.Scene, moving: Sequence[mi.Shape] | None = None) -> DividedLight | None:
        """None where all light is held at its points. On the host, so not in frozen functions.

        moving : the shapes of which lobes may turn: by their own motion, or that of what looks at them. None: all.
        """
        found = DividedLight(CloseLamps.of(scene), NarrowLobes.of(scene, moving))
        return found if found.close is not None or found.lobes is not None else None

    @property
    def shapes(self) -> list[mi.Shape]:
        """The lamps of which a part is held in its direction: their borders with other shapes are boundaries."""
        close = [] if self.close is None else self.close.shapes
        return close if self.lobes is None else [*close, *self.lobes.lamps]

    def near(self, emitter: mi.EmitterPtr) -> Vicinity:
        """That in which directions to an emitter are held, whatever scatters the light."""
        return Vicinity(mi.Float(0)) if self.close is None else self.close.vicinity(emitter)

    def turning(self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> Turning | None:
        """What turns with the lobes of a BSDF; None: nothing does in this scene."""
        return None if self.lobes is None else self.lobes.at(si, bsdf, active)

    def at(self, turning: Turning | None, emitter: mi.EmitterPtr) -> Division:
        """How the light of an emitter is divided, where directions turn so."""
        if turning is not None:
            turning = replace(turning, size=self.lobes.sizes.of(emitter))
        return Division(self.near(emitter), turning)


def division_of(lamps: DividedLight | None, turning: Turning | None, emitter: mi.EmitterPtr) -> Division:
    """How the light of an emitter is divided, if it is: see `DividedLight.at`."""
    return Division(Vicinity(mi.Float(0))) if lamps is None else lamps.at(turning, emitter)


class NarrowLobes:
    """The narrow lobes of the BSDFs of a scene. They are known by the density of samples around their axis; any width
    is right.

    sizes : of the emitters whose light is held in its direction there, the root of their areas; infinite, if they are
        infinitely far away. (Lamps with textures or interpolated normals have more edges than their outline, and are
        none of them.)
    lamps : those of them that are shapes.
    """

    DRJIT_STRUCT = dict.fromkeys(("sizes",))  # for `dr.freeze`

    @staticmethod
    def of(scene: mi.Scene, moving: Sequence[mi.Shape] | None = None) -> NarrowLobes | None:
        """None where there are none, or none that may turn. On the host, so not in frozen functions.

        moving : see `DividedLight.of`.
        """
        sizes = {e: size_of(e) for e in scene.emitters() if turns(e)}
        if not sizes:
            return None
        moves = surfaces(scene) if moving is None else [inner(s) for s in moving]
        lobes = NarrowLobes(EmitterTable(sizes), [e.get_shape() for e, size in sizes.items() if size < np.inf])
        return lobes if any(lobes.found_in(b) for b in dict.fromkeys(s.bsdf() for s in moves)) else None

    def __init__(self, sizes: EmitterTable, lamps: list[mi.Shape]):
        self.sizes, self.lamps = sizes, lamps

    def found_in(self, bsdf: mi.BSDF | None) -> bool:
        """Has a BSDF a narrow lobe anywhere?"""
        if bsdf is None or not bsdf.flags() & mi.BSDFFlags.GlossyReflection:
            return False
        with dr.suspend_grad():
            sampler = mi.load_dict({"type": "independent", "sample_count": 1})
            sampler.seed(0, PROBES)
            si = dr.zeros(mi.SurfaceInteraction3f, PROBES)
            si.t, si.uv = 1, sampler.next_2d()
            si.n, si.dp_du, si.dp_dv = mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
            si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
            narrow = mi.Bool(False)
            for cosine in COSINES:
                si.wi = mi.Vector3f((1 - cosine**2) ** 0.5, 0, cosine)
                narrow |= self.at(si, mi.BSDFPtr(bsdf), mi.Bool(True)).anywhere
            return bool(dr.any(narrow)[0])

    def at(self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> Turning:
        """That of the BSDF at a point, around the direction of mirror reflection; its axis follows `si`."""
        with dr.suspend_grad():
            at = dr.detach(si)
            mirrored = mi.Vector3f(-at.wi.x, -at.wi.y, at.wi.z)
            width = width_of(at, bsdf, mirrored, active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection))
        return Turning(axis_of(si), width, mi.Float(dr.inf))


def axis_of(si: mi.SurfaceInteraction3f) -> mi.Vector3f:
    """The direction of mirror reflection at a point, about the shading normal: a unit vector, world space. It follows
    `si`."""
    n, v = mi.Vector3f(si.sh_frame.n), si.to_world(si.wi)
    return 2 * dr.dot(n, v) * n - v


def width_of(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, axis: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """Width w of a lobe that has this axis, in the frame of `si`; 0, if it is not narrow.

    By the density of samples on the axis and a little aside, as if it was (1 + (θ / w)²)⁻² as for a microfacet BSDF
    (Walter et al. 2007).
    """
    pdf = bsdf.pdf(mi.BSDFContext(), si, axis, active)
    aside = ASIDE * dr.rsqrt(dr.pi * dr.maximum(pdf, 1e-3))
    # Between the plane of reflection, and across it.
    up = mi.Vector3f(0, 0, 1)
    across = dr.cross(axis, up)
    across = dr.select(dr.squared_norm(across) > 1e-6, dr.normalize(across), mi.Vector3f(1, 0, 0))
    diagonal = dr.sqrt(0.5) * (across + dr.cross(axis, across))
    beside = bsdf.pdf(mi.BSDFContext(), si, dr.normalize(axis + aside * diagonal), active)
    falls = dr.sqrt(pdf / dr.maximum(beside, 1e-3)) - 1
    width = aside * dr.rsqrt(dr.maximum(falls, 1e-3))
    return dr.select(active & (width < NARROW), width, 0)


def turns(emitter: mi.Emitter) -> bool:
    """May the light of an emitter be held in directions that turn? So it may if it has no edge but its outline."""
    if emitter.flags() & mi.EmitterFlags.Surface:
        return divisible(emitter.get_shape())
    return emitter.class_name() in ("ConstantBackgroundEmitter", "EnvironmentMapEmitter")


def size_of(emitter: mi.Emitter) -> float:
    """Root of the area of a lamp; infinite, if it is infinitely far away."""
    if not emitter.flags() & mi.EmitterFlags.Surface:
        return np.inf
    return float(np.ravel(dr.detach(emitter.get_shape().surface_area()))[0]) ** 0.5
