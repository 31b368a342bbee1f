"""By the numbers that Dr.Jit gives to shapes: which of the meshes of a `Geometry` they are."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .grids import is_grid
from .meshes import Geometry, number_of


def first_meshes(geometry: Geometry) -> mi.UInt32:
    """By the number that Dr.Jit gives to a shape: that of its mesh, or of an instance's first one, plus 1. Else 0."""
    numbers = [0 if is_grid(m) else number_of(getattr(m, "instance", m)) for m in geometry.meshes]
    table = np.zeros(max(numbers, default=0) + 1, np.uint32)
    table[numbers[::-1]] = np.arange(len(numbers), 0, -1)
    table[0] = 0
    return mi.UInt32(table)


def numbers_in_groups(geometry: Geometry) -> mi.UInt32:
    """By the number that Dr.Jit gives to a shape in a group: which of the meshes of its group it is."""
    inner = [(id(m.instance), number_of(m.inner)) for m in geometry.meshes if hasattr(m, "instance")]
    table = np.zeros(max((number for _, number in inner), default=0) + 1, np.uint32)
    seen: dict[int, int] = {}
    for instance, number in inner:
        table[number] = seen[instance] = seen.get(instance, -1) + 1
    return mi.UInt32(table)
