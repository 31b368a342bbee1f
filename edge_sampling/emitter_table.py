"""A number of each emitter, on the device."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


class EmitterTable:
    """Numbers that belong to emitters; 0 to all others. Made on the host, so not in frozen functions."""

    DRJIT_STRUCT = dict.fromkeys(("first", "numbers"))  # for `dr.freeze`

    def __init__(self, numbers: dict[mi.Emitter, float]):
        ids = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e))[0]) for e in numbers]
        #: Number that Dr.Jit gives to the first of them.
        self.first = min(ids)
        table = np.zeros(max(ids) - self.first + 1, np.float32)
        table[np.array(ids) - self.first] = list(numbers.values())
        # Not in NumPy's memory, for frozen functions.
        self.numbers = mi.Float(table) * dr.opaque(mi.Float, 1)
        dr.eval(self.numbers)

    def of(self, emitter: mi.EmitterPtr) -> mi.Float:
        """That of an emitter."""
        number, last = dr.reinterpret_array(mi.UInt32, emitter), self.first + dr.width(self.numbers) - 1
        known = (number >= self.first) & (number <= last)
        found = dr.gather(mi.Float, self.numbers, dr.clip(number, self.first, last) - self.first)
        return dr.select(known, found, 0)
