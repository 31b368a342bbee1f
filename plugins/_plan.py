"""What a derivative of a scene needs: which terms, of how many edges, at what cost."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.meshes import is_positions_key
from rimlight.edge_sampling.refusals import InputError

#: Most names that a message lists.
MOST = 5


@dataclass(frozen=True)
class PlannedTerm:
    """A term of the derivative.

    name : what it is.
    samples : number in one derivative, 0 if the term is left out.
    rays : that a sample traces, at most.
    reason : why it is needed, or not.
    """

    name: str
    samples: int
    rays: int
    reason: str


@dataclass(frozen=True)
class Plan:
    """What an integrator will do for a derivative. `print` it.

    integrator : its plugin.
    moving : names of the meshes that move.
    camera_moves, lights_move : do they?
    edges : number of edges of all meshes.
    tree : number of leaves of the tree over the edges, 0 where none is built.
    terms : of the derivative.
    limits : what the derivative will lack.
    """

    integrator: str
    moving: tuple[str, ...]
    camera_moves: bool
    lights_move: bool
    edges: int
    tree: int
    terms: tuple[PlannedTerm, ...]
    limits: tuple[str, ...] = ()

    def term(self, name: str) -> PlannedTerm:
        return next(t for t in self.terms if t.name == name)

    @property
    def rays(self) -> int:
        """Rays of one derivative, at most."""
        return sum(t.samples * t.rays for t in self.terms)

    def __str__(self) -> str:
        moves = [*(["the camera"] if self.camera_moves else []), *self.moving]
        lines = [
            f"{self.integrator}: {listed(moves) or 'nothing'} move{'s' if len(moves) < 2 else ''}"
            + (", lights among them" if self.lights_move else ""),
            f"{self.edges} edges; " + (f"tree of {self.tree} leaves" if self.tree else "no tree"),
        ]
        width = max(len(t.name) for t in self.terms)
        for t in self.terms:
            cost = f"{t.samples:>12,} samples of up to {t.rays:>3} rays" if t.samples else f"{'left out':>37}"
            lines.append(f"  {t.name:<{width}} {cost:<37}  {t.reason}")
        lines.append(f"up to {self.rays:,} rays")
        return "\n".join(lines + [f"Lacking: {limit}" for limit in self.limits])


def plan(
    scene: mi.Scene,
    params: mi.SceneParameters | Iterable[str] | None = None,
    *,
    integrator: mi.Integrator | None = None,
    sensor: int | mi.Sensor = 0,
    spp: int = 0,
) -> Plan:
    """What a derivative of this scene with respect to these parameters needs. The integrators follow the same plan.

    Parameters
    ----------
    params : parameters, or names of parameters that will carry gradients. Default: what carries one now.
    integrator : `direct_edge` or `prb_edge`. Default: the scene's own if it is one of these, or else `prb_edge`.
    spp : samples per pixel. Default: as the integrator and the sampler have it.

    Raises
    ------
    ValueError : a name is unknown, or the integrator is another one.
    RuntimeError : the derivative is refused, as it would be when rendering.
    """
    integrator = integrator or scene.integrator()
    if not hasattr(integrator, "plan"):
        integrator = mi.load_dict({"type": "prb_edge"})
    if params is None or isinstance(params, mi.SceneParameters):
        return integrator.plan(scene, sensor, spp)
    keys, known = list(params), mi.traverse(scene)
    unknown = [k for k in keys if k not in known]
    if unknown:
        raise InputError("plan: " + no_parameter(known, unknown[0]))
    # Copies, since `known` hands out what the scene itself holds. Where positions are set, Mitsuba makes normals anew.
    copy = lambda names: {k: type(known[k])(known[k]) for k in names if k in known}
    before, normals = copy(keys), copy(k.removesuffix("positions") + "normals" for k in keys if is_positions_key(k))
    try:
        for k in keys:
            known[k] = type(before[k])(dr.detach(before[k]))
            dr.enable_grad(known[k])
        known.update()
        return integrator.plan(scene, sensor, spp)
    finally:
        for values in (before, normals):
            for k, value in values.items():
                known[k] = value
            known.update()


def no_parameter(known: mi.SceneParameters, key: str) -> str:
    """A message: the scene has no such parameter, but these that are like it, and why it may be gone."""
    keys = list(known.keys())
    close = difflib.get_close_matches(key, keys, n=3, cutoff=0.4)
    message = f'the scene has no parameter "{key}"' + (f", did you mean {' or '.join(close)}?" if close else "")
    if any(k.startswith("object_") for k in keys):
        message += (
            ' What has no "id" is named by its address. Mitsuba makes one mesh of all those with equal materials, '
            "whose ids are lost, unless the scene is loaded with optimize=False."
        )
    return message


def counted(number: int, what: str) -> str:
    """A number of things, for messages."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def listed(names: Iterable[str]) -> str:
    """Names in a message: the first `MOST` of them, and how many more there are."""
    every = list(names)
    more = len(every) - MOST
    # One more name is no longer than the words that would stand in its place.
    return ", ".join(every) if more <= 1 else f"{', '.join(every[:MOST])}, and {more} more"


def names(shapes: Iterable[Any]) -> tuple[str, ...]:
    """Names of shapes, for messages."""
    return tuple(f'"{s.id()}"' if s.id() else f"a {s.class_name()} without an id" for s in shapes)
