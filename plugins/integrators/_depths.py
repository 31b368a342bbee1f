"""How long the paths of an integrator are, as properties of its plugin and as attributes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rimlight.edge_sampling.refusals import InputError
from rimlight.transport.paths import Depths

from ._options import is_whole

#: What stands for paths of any length, as in Mitsuba.
ANY = 0xFFFFFFFF

#: What an integrator has until it is known what was asked for.
UNKNOWN = Depths(1, 1)


def checked_depths(who: str, max_depth: Any, rr_depth: Any, longest: int | None = None) -> Depths:
    """The lengths that were asked for; -1 stands for any length.

    who : name of the integrator. longest : of the paths that it can trace; None: there is none.

    Raises
    ------
    ValueError : one of them is not among those that the integrator can have.
    """
    if not is_whole(max_depth) or max_depth < -1:
        raise InputError(f'{who}: "max_depth" must be a whole number >= 0, or -1 for no limit, got {max_depth}')
    if not is_whole(rr_depth) or rr_depth < 1:
        raise InputError(f'{who}: "rr_depth" must be a whole number >= 1, got {rr_depth}')
    if longest is not None and not 0 <= max_depth <= longest:
        raise InputError(f'{who}: "max_depth" must be at most {longest}, got {max_depth}')
    return Depths(max_depth if max_depth >= 0 else ANY, rr_depth)


def attribute(key: str) -> property:
    """The attribute `max_depth` or `rr_depth` of an integrator.

    Mitsuba's integrators in Python have these attributes, and scripts set them between two steps, so that paths become
    longer in the course of an optimisation. What is set holds from the next call on.

    The integrator keeps both as its `depths`, which are None until they are known. Its class has `OPTIONS`, the names
    of its properties, and `LONGEST`: see `checked_depths`.

    Raises
    ------
    ValueError : it is set to what the integrator cannot have, or the integrator has no such property.
    """

    def get(self: Any) -> int:
        return getattr(self.depths or UNKNOWN, key)

    def put(self: Any, value: int) -> None:
        if self.depths is None:
            return  # The constructor of Mitsuba's base class sets a default of its own, and looks at it.
        if key not in self.OPTIONS:
            raise InputError(f'{self.name}: "{key}" cannot be set, since its paths end after direct illumination')
        depths = replace(self.depths, **{key: value})
        self.depths = checked_depths(self.name, depths.max_depth, depths.rr_depth, self.LONGEST)

    return property(get, put)
