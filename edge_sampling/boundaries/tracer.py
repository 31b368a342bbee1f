"""What the boundaries ask of the one who traces paths for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mitsuba as mi

from rimlight.edge_sampling.choice.light_choice import LightChoice
from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.first_points import FirstPoints
from rimlight.edge_sampling.parametrisation import Turning, Vicinity

from .crease import Directions
from .horizon import Horizon
from .lune import Lune
from .veils import Before


@dataclass(frozen=True)
class ShadingPoint:
    """Points at which light is reflected towards the sensor, one of each path.

    si : mi.SurfaceInteraction3f, (N,). Its `p` and `n` are attached to whatever moves them.
    depth : mi.UInt32, number along the path; 1 is what the sensor sees.
    β : mi.Spectrum, throughput up to there, over the probability of this point among those of its path. Detached.
    active : mi.Bool, is there one?
    slides : mi.Bool, may it move with the vertices before, though its surface stands still?
    vicinity : that of its path.
    density : mi.Float, by area, with which it was found from the vertex before; infinite if that is a mirror. Detached.
    turning : with which directions turn there; attached. None: with nothing.
    """

    si: mi.SurfaceInteraction3f
    depth: mi.UInt32
    β: mi.Spectrum
    active: mi.Bool
    slides: mi.Bool
    vicinity: Vicinity
    density: mi.Float
    turning: Turning | None = None


class Tracer(Protocol):
    """Traces paths in a scene. All that is returned is detached.

    scene : mi.Scene
    lights : chooses one of many lights; None: all are equally likely.
    lamps : how their light is divided; None: it is held at points of the lamps.
    held : what is held where the sensor sees it; None: nothing.
    shares_directions : may it be told in which directions to look for the light that a crease reflects?
    """

    scene: mi.Scene
    lights: LightChoice | None
    lamps: DividedLight | None
    held: FirstPoints | None
    shares_directions: bool

    def scatters(self, depth: mi.UInt32 | int) -> mi.Bool | bool:
        """May a vertex of this number reflect direct light?"""

    def first_hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """What the sensor sees along camera rays."""

    def seen(
        self,
        ray: mi.Ray3f,
        pi: mi.PreliminaryIntersection3f,
        sampler: mi.Sampler,
        active: mi.Bool,
        horizon: Horizon | None,
        directions: Directions | None,
        before: Before | None = None,
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Radiance and alpha along camera rays, of which the first hit, `pi`, is on a side of a horizon. Where there is
        a lune, only light from there need be reflected: what else there is does not jump. At a crease, light is looked
        for in its directions. Of veils before an outline, only what they let through."""

    def scattered(
        self,
        ray: mi.Ray3f,
        pi: mi.PreliminaryIntersection3f,
        depth: mi.UInt32,
        sampler: mi.Sampler,
        active: mi.Bool,
        beside_outline: mi.Bool | None = None,
        directions: Lune | None = None,
        found: mi.Float | None = None,
        horizon: Horizon | None = None,
    ) -> mi.Spectrum:
        """Light that is scattered, by what a ray from a vertex meets, back to this vertex of number `depth`.

        beside_outline : is it met just inside of its outline? Then interpolated normals that face away are turned.
        directions : where it is active, only light from there need be scattered.
        horizon : on which side of a horizon this is; None: as it is.
        found : density with which this is found so, over that with which it is by `DeepShadows`: infinite, never.
        """


@dataclass
class Sender:
    """A vertex of a light subpath, which sends light on. (A Dr.Jit structure: not frozen.)

    si : the surface there. power : arrives there, see `LightVertex.β`. one, more : see `Shorter`.
    facing : mi.Vector3f, normal on the side to which it sends light; 0: to both, `through`.
    """

    si: mi.SurfaceInteraction3f
    power: mi.Spectrum
    one: mi.Float
    more: mi.Float
    facing: mi.Vector3f
    through: mi.Bool
    active: mi.Bool


class LightTracer(Tracer, Protocol):
    """Traces paths from lights, too. All that is returned is detached."""

    def sender(self, count: int, depth: mi.UInt32, active: mi.Bool) -> Sender:
        """One for each of `count` points of this number along their paths, which are to be lit by it."""

    def sent(self, sender: Sender, d: mi.Vector3f, found: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """What it sends in a direction, by area across it, weighted. d : unit vector, world space. found : see
        `Tracer.scattered`."""
