"""Shadows in the light of lights without size, where perfect mirrors or glass show them to the camera.

Behind a chain of mirrors, no shadow can be projected on to the film. So its border is looked for, as all that mirrors
show (`terms/bisection.py`): a ray to the light tells on which side of it a point is. As things move, the border follows
so that this ray goes on touching the outline of what hides the light (`touch.py`).

One of these lights is chosen for each segment of the film that is searched; its shadows count for those of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.beside import rounding
from rimlight.edge_sampling.lights import Lights
from rimlight.edge_sampling.rays import spawn_ray_to_light, starts_in

from .shadow_boundary import throws_shadows
from .touch import Touch, touch_outline

#: A ray to a light touches an outline if it passes it within so many times the distance of the two points beside the
#: border of the shadow, besides rounding.
REACH = 4


@dataclass(frozen=True)
class Border:
    """Where two points next to each other are on both sides of the border of a shadow.

    touch : what a ray to the light touches there. jump : mi.Spectrum, light that the first point reflects less that of
    the second. light, numbers : see `ShownShadows`. found : mi.Bool, is it known?
    """

    touch: Touch
    jump: mi.Spectrum
    light: mi.UInt32
    numbers: mi.Point2f
    found: mi.Bool


class ShownShadows:
    """The shadows of the lights of a scene that have no size.

    choice : mi.UInt32 in all methods, a random number, which chooses the light, and the random numbers with which it is
        sampled, where it consists of several ones.
    """

    DRJIT_STRUCT = dict.fromkeys(("lights", "chosen"))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        self.lights = Lights(scene)
        on_surface = [bool(e.flags() & mi.EmitterFlags.Surface) for e in scene.emitters()]
        counts = [throws_shadows(e) and not s for e, s in zip(scene.emitters(), on_surface, strict=True)]
        self.chosen = mi.UInt32([k for k, i in enumerate(self.lights.emitter) if counts[i]])

    def __len__(self) -> int:
        """Number of lights."""
        return dr.width(self.chosen)

    def hidden(self, scene: mi.Scene, si: mi.SurfaceInteraction3f, choice: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Is a point in the shadow?"""
        return scene.ray_test(self._ray(scene, si, *self._light(choice), active), active)

    def border(
        self,
        scene: mi.Scene,
        a: mi.SurfaceInteraction3f,
        b: mi.SurfaceInteraction3f,
        choice: mi.UInt32,
        active: mi.Bool,
        cast: mi.Bool,
    ) -> Border:
        """The border between two points of a surface. Detached, but for what is touched.

        cast : mi.Bool, is a shadow cast there? Otherwise it begins at an edge, and touches nothing.
        """
        light, numbers = self._light(choice)
        rays = [self._ray(scene, si, light, numbers, active) for si in (a, b)]
        met = [scene.ray_intersect_preliminary(ray, active=active) for ray in rays]
        a_is_dark = met[0].is_valid()
        active = active & (a_is_dark != met[1].is_valid())
        first, second = ((ray, pi) for ray, pi in zip(rays, met, strict=True))
        near, far = (
            tuple(dr.select(a_is_dark, x, y) for x, y in zip(p, q, strict=True))
            for p, q in ((first, second), (second, first))
        )
        reach = dr.norm(a.p - b.p)
        touch = touch_outline(scene, near[0], near, far, reach, active)
        past = dr.abs(dr.detach(touch.moved) - dr.dot(touch.n, near[0](touch.t)))
        touches = past <= REACH * reach + rounding(near[0].o, near[0](touch.t))
        active &= ~cast | (touches & ~starts_in(scene, near[0], near[1].t))
        jump = mi.Spectrum(0)
        for sign, si, lit in ((1, a, ~a_is_dark), (-1, b, a_is_dark)):
            ds, weight = self.lights.sample_direction(scene, light, si, numbers, active & lit)
            f = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), active & lit)
            jump += dr.select(active & lit, sign * f * weight, 0)
        return Border(touch, jump * len(self), light, numbers, active)

    def across(self, scene: mi.Scene, border: Border, si: mi.SurfaceInteraction3f) -> mi.Float:
        """What is 0 at the border, but for a constant: attached to `si`, to the light, and to what is touched."""
        ds, _ = self.lights.sample_direction(scene, border.light, si, border.numbers, border.found)
        return border.touch.moved - dr.dot(border.touch.n, si.p + border.touch.t * ds.d)

    def _light(self, choice: mi.UInt32) -> tuple[mi.UInt32, mi.Point2f]:
        """The number of a light, and random numbers for it."""
        a, b = mi.sample_tea_32(choice, 0)
        number = dr.minimum(mi.UInt32(mi.sample_tea_float32(choice, 0) * len(self)), len(self) - 1)
        numbers = mi.Point2f(mi.sample_tea_float32(a, 0), mi.sample_tea_float32(b, 0))
        return dr.gather(mi.UInt32, self.chosen, number), numbers

    def _ray(self, scene: mi.Scene, si: mi.SurfaceInteraction3f, light, numbers, active: mi.Bool) -> mi.Ray3f:
        ds, _ = self.lights.sample_direction(scene, light, si, numbers, active)
        return spawn_ray_to_light(scene, si, ds)
