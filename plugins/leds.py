"""Tables of LEDs: CSV files with a light a row, as photometric rigs are described by.

The header names the columns, in any order: ``x,y,z`` (position), ``ax,ay,az`` (axis), ``mu`` (anisotropy), ``r,g,b``
(radiant intensity on the axis). World space, scene units, linear sRGB; see the plugin ``led``::

    rig = leds.read_leds("rig.csv")
    scene = mi.load_dict({"type": "scene", **leds.emitters(rig), ...})
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rimlight.edge_sampling.refusals import InputError

COLUMNS = ("x", "y", "z", "ax", "ay", "az", "mu", "r", "g", "b")


@dataclass(frozen=True)
class Led:
    """One light.

    Raises
    ------
    ValueError : a number is not finite; the axis is zero; `mu` or an intensity is negative.
    """

    #: World space, scene units.
    position: tuple[float, float, float]
    #: In which it shines, away from the light; world space, of any length but zero.
    axis: tuple[float, float, float]
    #: Anisotropy: the intensity falls off with cos^mu. At least 0.
    mu: float
    #: Radiant intensity on the axis, linear sRGB. At least 0.
    intensity: tuple[float, float, float]

    def __post_init__(self) -> None:
        for column, value in zip(COLUMNS, self.row(), strict=True):
            if not math.isfinite(value):
                raise InputError(f'column "{column}": expected a finite number, got {value}')
            if column in ("mu", "r", "g", "b") and value < 0:
                raise InputError(f'column "{column}": expected a number >= 0, got {value}')
        if not any(self.axis):
            raise InputError('columns "ax", "ay", "az": the axis is zero')

    def row(self) -> tuple[float, ...]:
        """Its numbers, in the order of `COLUMNS`."""
        return (*self.position, *self.axis, self.mu, *self.intensity)

    def to_dict(self) -> dict[str, Any]:
        """For `mi.load_dict`."""
        rgb = {"type": "rgb", "value": list(self.intensity)}
        return {
            "type": "led",
            "position": list(self.position),
            "axis": list(self.axis),
            "mu": self.mu,
            "intensity": rgb,
        }


def emitters(leds: Iterable[Led], name: str = "led") -> dict[str, dict]:
    """Lights as members of a scene's dictionary: ``led0``, ``led1``, ..., in the order of the table."""
    return {f"{name}{i}": led.to_dict() for i, led in enumerate(leds)}


def read_leds(path: Path | str) -> list[Led]:
    """Read a table. Errors name file, line and column.

    Raises
    ------
    ValueError : a column is missing, unknown or there twice; a value is missing, no finite number, or impossible.
    FileNotFoundError
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file, skipinitialspace=True)
        header = [name.strip() for name in next(reader, [])]
        if sorted(header) != sorted(COLUMNS):
            missing = [c for c in COLUMNS if c not in header]
            wrong = [c for c in header if c not in COLUMNS or header.count(c) > 1]
            what = [f"missing {', '.join(missing)}"] * bool(missing) + [f"unknown or twice {', '.join(wrong)}"] * bool(
                wrong
            )
            raise InputError(f"{path}, line 1: the columns must be {','.join(COLUMNS)}; {'; '.join(what)}")
        return [_led(header, row, f"{path}, line {reader.line_num}") for row in reader if any(map(str.strip, row))]


def _led(header: list[str], row: list[str], where: str) -> Led:
    if len(row) > len(header):
        raise InputError(f"{where}: {len(row)} values for {len(header)} columns")
    values = {}
    for column, text in zip(header, [*row, *[""] * (len(header) - len(row))], strict=True):
        try:
            values[column] = float(text)
        except ValueError:
            raise InputError(f'{where}, column "{column}": expected a number, got "{text.strip()}"') from None
    x, y, z, ax, ay, az, mu, r, g, b = (values[c] for c in COLUMNS)
    try:
        return Led((x, y, z), (ax, ay, az), mu, (r, g, b))
    except ValueError as error:
        raise InputError(f"{where}, {error}") from None


def write_leds(path: Path | str, leds: Iterable[Led]) -> None:
    """Write a table. `read_leds` reads exactly the same numbers."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([repr(float(value)) for value in led.row()] for led in leds)
