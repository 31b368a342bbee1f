"""What a reconstruction will take, roughly, before it begins: memory and time."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import psutil

from .direct import SAMPLED
from .reconstruction import Options

#: Bytes of the program; for each value, which is that of a pixel in an image, of reading; of a reconstruction at full
#: size, for each value and for each pixel; more for each value with near lights; and for each pixel of the full images,
#: if means over some of them are read. Measured.
FIXED, READING, OF_VALUE, OF_PIXEL, NEAR, OF_FULL = 7e8, 28, 47, 1500, 20, 150

#: Seconds of one alternation: of any; on one core, for each value; and for each of those from which it fits the BSDF.
#: Measured.
OF_ALL, OF_VALUES, OF_BSDF = 0.3, 1e-6, 7e-6

#: Of control groups, version 2 and 1: files of their limit, of what is used, and of the part of that which the system
#: takes back when it needs it. psutil looks at the machine alone.
GROUPS = tuple(
    tuple(f"/sys/fs/cgroup/{name}" for name in names)
    for names in (
        ("memory.max", "memory.current", "memory.stat"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
    )
)


def memory(pixels: int, images: int, options: Options, *, near: bool = False, reduce: int = 1) -> float:
    """Bytes, at most. near : have the lights positions? They may also get some. reduce : as of `dataset.read`."""
    whole = pixels * OF_FULL if reduce > 1 else 0
    pixels = pixels / reduce**2
    values, finest = pixels * images, max(options.resolutions) ** 2
    of_value = OF_VALUE + NEAR * (near or options.near_lights)
    return FIXED + whole + values * READING + finest * (values * of_value + pixels * OF_PIXEL)


def seconds(pixels: int, images: int, options: Options, cores: int | None = None) -> float:
    """Without descent, if no alternation is spared. Right within a factor of about three.

    cores : default: as many as Dr.Jit has threads.
    """
    cores = cores or dr.thread_count()
    counts = list(options.iterations)
    for level, others in zip((0, -1), options.others(), strict=True):
        counts[level] += others
    total = 0.0
    for size, count in zip(options.resolutions, counts, strict=True):
        seen = pixels * size**2
        total += count * (OF_ALL + images * (OF_VALUES * seen / cores + OF_BSDF * min(seen, SAMPLED)))
    return total


def available_memory() -> int:
    """Bytes that this process may still take: of its machine, and of its control group, such as a container or a job of
    SLURM, where that has a limit."""
    free = psutil.virtual_memory().available
    for limit, used, cached in GROUPS:
        try:
            given, taken = (int(Path(file).read_text(encoding="ascii")) for file in (limit, used))
            facts = dict(line.split() for line in Path(cached).read_text(encoding="ascii").splitlines())
        except (OSError, ValueError):  # there is no such group, or its limit is "max"
            continue
        free = min(free, given - taken + int(facts.get("inactive_file", 0)))
    return free
