"""Where interpolated normals turn away from points of the scene: what such surfaces reflect to these jumps there.

At a point x, light arrives from the points y of a smooth-shaded mesh. Written over their area, it jumps where the
normal n that shades turns away from x, which is a curve inside of faces (`horizon.py`). As x, y and n move, what x
reflects gains

    ∫ f |cos θ_x| |cos θ_y| / r² · (L⁺ − L⁻) ġ δ(g) dA(y),        g = n · (x − y) / r

with the light L⁺ that is reflected where n just faces x, and L⁻ where it does not. As everywhere, y moves as the
interior derivative has it. On a curve p(s), the delta function leaves an integral over s, of which `HorizonPoint.area`
is the factor.

On fine meshes, these curves are close to outlines, where |cos θ_y| is small, and are left out: what is just inside of
an outline is taken for what faces the point (`turned`). The light that meshes *emit* does not jump there: see "Lamps
with smooth normals" in `docs/theory.md`.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.choice.sampling import EdgeSample, Reservoir
from rimlight.edge_sampling.geometry.meshes import Geometry, inner, is_met, pointer
from rimlight.edge_sampling.parametrisation import sliding_point
from rimlight.edge_sampling.rays import spawn_ray

from .fine_mirrors import mean_fringe
from .horizon import Horizon, HorizonPoint, Horizons
from .tracer import ShadingPoint, Tracer

#: How far the cosine between the normals of faces and vertices of a mesh may be below 1, on average over its bent
#: faces, without these jumps.
COARSE = 0.03

#: Faces of which one is kept, in proportion to what its curve contributes if nothing hides it.
CANDIDATES = 16


class HorizonsAtPoints:
    """Samples the curves in the faces of some meshes.

    geometry : the shapes.
    coarse : which of its meshes count.
    """

    DRJIT_STRUCT = dict.fromkeys(("_horizons", "_shapes"))  # for `dr.freeze`

    def __init__(self, geometry: Geometry, coarse: np.ndarray):
        self._geometry, self._horizons = geometry, Horizons(geometry, coarse)
        self._shapes = [pointer(m) for m, c in zip(geometry.meshes, coarse, strict=True) if c]

    @staticmethod
    def of(geometry: Geometry, turning: Sequence[bool]) -> HorizonsAtPoints | None:
        """Of the meshes that are coarse, and of those whose normals change, but not their vertices: of what the normals
        alone do to indirect light, much is at these jumps even where a mesh is fine. None if there are no such meshes.

        turning : of which meshes do only the normals change?
        """
        least = [0 if turns else COARSE for turns in turning]
        coarse = [mean_fringe(inner(m)) > off for m, off in zip(geometry.meshes, least, strict=True)]
        return HorizonsAtPoints(geometry, np.array(coarse)) if any(coarse) else None

    def are(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Which points are on these meshes?"""
        found = mi.Bool(False)
        for shape in self._shapes:
            found |= is_met(si, shape)
        return found

    def sample(self, tracer: Tracer, point: ShadingPoint, sampler: mi.Sampler) -> mi.Spectrum:
        """One sample of the integral at each point: mi.Spectrum, (N,), zero, with the gradient of the light that is
        reflected there."""
        scene, si = tracer.scene, point.si
        with dr.suspend_grad():
            at, bsdf = dr.detach(si), si.bsdf()
            active = point.active & at.is_valid() & tracer.scatters(point.depth + 1)
            kept, h = self._chosen(at, bsdf, sampler, active)
            # Mitsuba's rays start above the surface.
            ray = spawn_ray(scene, at, dr.normalize(h.p - at.p))
            ray.d = dr.normalize(h.p - ray.o)
            weight = self._weight(at, bsdf, h, active) / kept.density
            active &= (kept.density > 0) & dr.any(weight != 0)
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            active &= self._horizons.meets(kept.edge, h.p, ray, pi, active)
            jump = mi.Spectrum(0)
            for side in (1, -1):
                horizon = Horizon(mi.Float(side), h.p, mi.Bool(True), mi.Float(0))
                L = tracer.scattered(ray, pi, point.depth, sampler.clone(), active, horizon=horizon)
                jump += side * dr.select(active, L, 0)
            held = point.vicinity.around(bsdf).far(dr.square(pi.t))
        with dr.resume_grad():
            ray.o = dr.replace_grad(ray.o, si.p)
            y = sliding_point(scene, ray, pi, held, active)
            g = dr.dot(y.sh_frame.n, dr.normalize(ray.o - y.p))
            return weight * jump * dr.select(active, g - dr.detach(g), 0)

    def _chosen(
        self, at: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, sampler: mi.Sampler, active: mi.Bool
    ) -> tuple[EdgeSample, HorizonPoint]:
        """Of a few faces, each with a point of its curve, one."""
        positions, normals = dr.detach(self._geometry.positions()), dr.detach(self._geometry.normals())
        sums = dr.cumsum(self._horizons.weights(positions, normals))
        last = len(self._horizons) - 1
        total = dr.gather(mi.Float, sums, last)

        def look(k, reservoir, sampler):
            x = sampler.next_1d() * total
            face = dr.binary_search(0, last, lambda i: dr.gather(mi.Float, sums, i) <= x)
            before = dr.select(face > 0, dr.gather(mi.Float, sums, face - 1, face > 0), 0)
            p = (dr.gather(mi.Float, sums, face) - before) / total
            sample = EdgeSample(face, sampler.next_1d(), p)
            h = self._horizons.point(positions, normals, face, sample.t, at.p, False)
            target = dr.max(self._weight(at, bsdf, h, active))
            reservoir, _ = reservoir.take(sample, target, sampler, active)
            return k + 1, reservoir, sampler

        _, reservoir, _ = dr.while_loop(
            (dr.zeros(mi.Float, dr.width(active)), dr.zeros(Reservoir, dr.width(active)), sampler),
            lambda k, *_: active & (k < CANDIDATES),
            look,
            label="horizons",
        )
        kept = reservoir.kept(CANDIDATES)
        return kept, self._horizons.point(positions, normals, kept.edge, kept.t, at.p, False)

    @staticmethod
    def _weight(at: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, h: HorizonPoint, active: mi.Bool) -> mi.Spectrum:
        """What a point reflects of what jumps at a curve, over an interval of what is sampled and one of g."""
        d = h.p - at.p
        r2 = dr.squared_norm(d)
        ω = d * dr.rsqrt(r2)
        active = active & h.valid & (r2 > 0)
        f = bsdf.eval(mi.BSDFContext(), at, at.to_local(ω), active)
        weight = f * dr.abs_dot(h.front, ω) * h.area / r2
        return dr.select(active & dr.isfinite(dr.max(weight)), weight, 0)


def turned(horizons: HorizonsAtPoints | None, y: mi.SurfaceInteraction3f, beside_outline: mi.Bool) -> mi.Bool:
    """Just inside of which outlines normals that face away are turned to the viewer: those of meshes whose horizons are
    no jumps of their own."""
    return beside_outline if horizons is None else beside_outline & ~horizons.are(y)
