"""Borders of beams in indirect light: what spots and projectors do by the jumps of what they throw on surfaces that
light others.

They are boundaries as the shadows of `indirect_shadows.py` are, with a line of the beam in place of an edge: it lies in
the directions from the light, and both of its sides may be lit. (Where the camera sees such a line, bisection finds it:
`rimlight/terms/bisection.py`.)
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.sampling import EdgeSample
from rimlight.edge_sampling.choice.silhouettes import Placement, Silhouettes
from rimlight.edge_sampling.geometry.beams import ROUNDING
from rimlight.edge_sampling.geometry.beside import rounding
from rimlight.edge_sampling.geometry.texture_lines import lines_of_beam

from .beam_lines import BeamLines
from .fallen_shadow import LightPoint, LitEdge, SeenShadow, Shadow
from .indirect_shadows import IndirectShadows
from .tracer import Tracer

#: How far beside a line its sides are looked at, in units in the last place of the place on the picture.
BESIDE_LINE = 64


class IndirectBeams(IndirectShadows):
    """Samples the lines of beams that points of paths see."""

    DRJIT_STRUCT = IndirectShadows.DRJIT_STRUCT | {"lines": None}  # for `dr.freeze`

    def __init__(
        self, scene: mi.Scene, silhouettes: Silhouettes, moving: list[mi.Shape] | None = None, *, hidden: bool = False
    ):
        super().__init__(scene, silhouettes, moving, hidden=hidden)
        self.lines = BeamLines(scene, self.lights)

    def counts(self, emitter: mi.Emitter) -> bool:
        return bool(lines_of_beam(emitter))

    # ---------------------- From a light to a line ----------------------

    def _edge(self, placement: Placement, light: LightPoint, sampler: mi.Sampler) -> LitEdge:
        """A point of a line of the beam, in place of one of an edge."""
        return self._edge_at(placement, light, EdgeSample(*self.lines.choose(light.light, light.choice, sampler)))

    def _edge_at(self, placement: Placement, light: LightPoint, e: EdgeSample) -> LitEdge:
        uv, tangent, normal = self._on_picture(e)
        d = self.lines.ray(light.light, uv)[1]
        # These directions are affine functions of the place in the picture.
        along, across = (self.lines.ray(light.light, uv + v)[1] - d for v in (tangent, normal))
        ω = dr.normalize(d)
        lit = dr.normalize(dr.cross(ω, along))
        lit = dr.mulsign(lit, dr.dot(lit, across))
        active = (e.density > 0) & dr.isfinite(dr.squared_norm(lit))
        # The light may lie on a surface, which throws no shadow on what it faces.
        return LitEdge(e, light.y + ω * rounding(light.y, light.y), along, lit, d, ω, active)

    def _moves(self, edge: LitEdge, shadow: Shadow) -> mi.Float:
        return mi.Float(1)

    def _on_picture(self, e: EdgeSample) -> tuple[mi.Point2f, mi.Vector2f, mi.Vector2f]:
        """Place, tangent, and unit normal of a point of a line, in the picture of the light."""
        uv, tangent = self.lines.at(e.edge, e.t)
        return uv, tangent, dr.normalize(mi.Vector2f(-tangent.y, tangent.x))

    def _past(
        self, scene: mi.Scene, placement: Placement, light: LightPoint, edge: LitEdge, shadow: Shadow, met, active
    ) -> tuple[mi.Point3f, mi.Vector3f]:
        return self.lines.ray(light.light, self._on_picture(edge.sample)[0])

    # ---------------------- What arrives where it falls ----------------------

    def _arriving(
        self, tracer: Tracer, light: LightPoint, edge: LitEdge, shadow: Shadow, view: SeenShadow, share
    ) -> tuple[None, mi.Spectrum, mi.Bool]:
        si = view.si
        f = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(-edge.ω), view.active)
        jump = self._difference(tracer.scene, light, edge, shadow, si.wavelengths, view.active)
        return None, dr.select(view.active, f * jump * view.weight, 0), view.active

    def _difference(self, scene: mi.Scene, light, edge: LitEdge, shadow: Shadow, wavelengths, active) -> mi.Spectrum:
        """What arrives on the one side of the line, less what arrives on the other, from the light and for a surface at
        right angles to it."""
        uv, _, normal = self._on_picture(edge.sample)
        away = shadow.x - light.y
        distance = dr.norm(away)
        reach = dr.max(dr.maximum(dr.abs(shadow.x), dr.abs(light.y)))
        per_unit = dr.norm(self.lines.ray(light.light, uv + normal)[1] - edge.d) * dr.rsqrt(dr.squared_norm(edge.d))
        beside = BESIDE_LINE * dr.epsilon(mi.Float) * (ROUNDING + reach / (distance * per_unit))
        it = dr.zeros(mi.SurfaceInteraction3f, dr.width(active))
        it.time, it.wavelengths = light.time, wavelengths
        jump = mi.Spectrum(0)
        for sign in (1, -1):
            it.p = light.y + dr.normalize(self.lines.ray(light.light, uv + sign * beside * normal)[1]) * distance
            jump += sign * self.lights.sample_direction(scene, light.light, it, mi.Point2f(0.5), active)[1]
        return dr.select(active, jump, 0)

    def _unshadowed(
        self, scene: mi.Scene, z: mi.SurfaceInteraction3f | None, light: LightPoint, edge, shadow: Shadow, active
    ) -> mi.Float:
        active = active & shadow.active
        wavelengths = shadow.ray.wavelengths if z is None else z.wavelengths
        arrives = dr.max(dr.abs(self._difference(scene, light, edge, shadow, wavelengths, active)))
        return self._reflected(z, light, edge, shadow, arrives * dr.abs_dot(shadow.facing, edge.ω), active)
