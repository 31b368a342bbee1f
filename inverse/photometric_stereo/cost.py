"""What a reconstruction will take, roughly, before it begins: memory and time."""

from __future__ import annotations

import os
from pathlib import Path

from .direct import SAMPLED
from .reconstruction import Options

#: Bytes of the program; for each value, which is that of a pixel in an image, of reading; of a reconstruction at full
#: size, for each value and for each pixel; and more for each value with near lights. Measured.
FIXED, READING, OF_VALUE, OF_PIXEL, NEAR = 7e8, 28, 47, 1500, 20

#: Seconds of one alternation: of any; on one core, for each value; and for each of those from which it fits the BSDF.
#: Measured.
OF_ALL, OF_VALUES, OF_BSDF = 0.5, 5e-6, 1.2e-4


def memory(pixels: int, images: int, options: Options, *, near: bool = False) -> float:
    """Bytes, at most. near : have the lights positions?"""
    values, finest = pixels * images, max(options.resolutions) ** 2
    return FIXED + values * READING + finest * (values * (OF_VALUE + NEAR * near) + pixels * OF_PIXEL)


def seconds(pixels: int, images: int, options: Options, cores: int | None = None) -> float:
    """Without descent, if no alternation is spared. Right within a factor of about three. cores : default: all."""
    cores = cores or os.cpu_count() or 1
    counts = list(options.iterations)
    for level, others in zip((0, -1), options.others(), strict=True):
        counts[level] += others
    total = 0.0
    for size, count in zip(options.resolutions, counts, strict=True):
        seen = pixels * size**2
        total += count * (OF_ALL + images * (OF_VALUES * seen / cores + OF_BSDF * min(seen, SAMPLED)))
    return total


def available_memory() -> int | None:
    """Bytes, where the system tells it."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    return found[0] if found else None
