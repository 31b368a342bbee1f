"""The table of constants is complete: it lists the numbers of the estimators, and no others."""

from __future__ import annotations

import re

import cases
import mitsuba as mi
import numpy as np
import pytest
from constants import Number, numbers_in_source, numbers_in_table

from rimlight.checks import Motion, derivative_image

#: Modules that take no part in a derivative: checks and the reading of options.
OTHERS = {"__init__", "_finite", "_options"}


def in_code(root) -> set[Number]:
    """What numbers are exempt, `numbers_in_source` says."""
    folders = ("edge_sampling", "plugins/integrators", "plugins/terms", "plugins/transport")
    files = [p for folder in folders for p in sorted((root / folder).rglob("*.py"))]
    names = [(p.relative_to(root).as_posix(), p) for p in files if p.stem not in OTHERS]
    return set().union(*(numbers_in_source(name, p.read_text(encoding="utf-8")) for name, p in names))


def in_docs(root) -> list[Number]:
    return numbers_in_table((root / "docs" / "constants.md").read_text(encoding="utf-8"))


def test_the_table_lists_every_number(root):
    assert sorted(in_code(root) - set(in_docs(root))) == []


def test_the_table_lists_nothing_else(root):
    listed = in_docs(root)
    assert sorted(set(listed) - in_code(root)) == []
    assert len(listed) == len(set(listed))


def test_every_row_of_the_table_is_filled_in(root):
    rows = re.findall(r"^\|(.*)\|$", (root / "docs" / "constants.md").read_text(encoding="utf-8"), re.MULTILINE)
    cells = [[c.strip() for c in row.split("|")] for row in rows[2:]]
    assert len(cells) > 60
    assert all(len(row) == 6 and all(row[1:]) for row in cells)


def test_numbers_in_source():
    source = '''
"""A docstring with 17 in it."""
TOLERANCE, COUNT = 1e-5, 4
PART = 2 / 3
MARGIN = {False: 0.05, True: 7}
SMALL: float = 2.0**-16

class Kind(IntEnum):
    LAST = 9

class Thing:
    limit = 4
    LEVEL = -6

    def size(self, steps: int = 22):
        def inner(x):
            return 0.5 * x[11] + 3 * x - 1e-4
        return inner(steps << 5) ^ 0x9E3779B1 if steps > 10**7 else hash(8) & 15

f = lambda x: 1 - 1e-4 + True
'''
    found = numbers_in_source("a.py", source)
    assert {(n.where, n.value) for n in found} == {
        ("TOLERANCE", 1e-5),
        ("COUNT", 4),
        ("PART", 2 / 3),
        ("MARGIN", 0.05),
        ("MARGIN", 7),
        ("SMALL", 2**-16),
        ("Thing.LEVEL", -6),
        ("Thing.size()", 22),
        ("Thing.size()", 1e-4),
        ("Thing.size()", 10**7),
        ("Thing.size()", 8),
        ("f", 1 - 1e-4),
    }
    assert {n.file for n in found} == {"a.py"}


def test_numbers_in_table():
    text = """
| file | where | number | more |
|---|---|---|---|
| `a.py` | `PART` | `2 / 3` | text |
| | `Thing.size()` | `10**7` | text |

| other | table |
|---|---|
| 5 | 6 |
"""
    assert numbers_in_table(text) == [Number("a.py", "PART", 2 / 3), Number("a.py", "Thing.size()", 10**7)]
    with pytest.raises(ValueError, match="not a number"):
        numbers_in_table(text.replace("10**7", "many"))


@pytest.mark.parametrize("exponent", [-6, 10, 20])
def test_no_absolute_length_matters(exponent):
    """Where everything is larger, the derivative is the same. The noise of another seed is 2 % here."""

    def derivative(s: float) -> np.ndarray:
        scene = cases.shadow_blocker()()
        params = mi.traverse(scene)
        for key in params.keys():  # noqa: SIM118
            if key.endswith("vertex_positions"):
                params[key] = params[key] * s
        matrix = mi.Matrix4f(params["sensor.to_world"].matrix)
        for i in range(3):
            matrix[i, 3] = matrix[i, 3] * s
        params["sensor.to_world"] = mi.Transform4f(matrix)
        params["sensor.near_clip"] *= s
        params["sensor.far_clip"] *= s
        params.update()
        motion = Motion(scene, "blocker.vertex_positions", direction=[0, s, 0])
        return np.array(derivative_image(scene, mi.load_dict({"type": "direct_edge"}), motion, spp=256, seed=3))

    expected, found = derivative(1.0), derivative(2.0**exponent)
    assert np.abs(found - expected).sum() < 0.05 * np.abs(expected).sum()
