"""Derivative images against finite differences: every case of `cases.py`.

`make test` takes few samples, which tell much where pixels are pooled; `make test-full` many, and it writes a page of
pictures.
"""

import json
import os

import cases
import gallery
import pytest

from rimlight.checks import FiniteDifferences, compare

#: At least so many samples per pixel, for releases.
LEAST = 1024 if "RIMLIGHT_FULL" in os.environ else 0

#: Noise, relative to the L1 norm, at most so many times what `references/make.py --noise` has found.
MORE_NOISE = 1.5


@pytest.mark.parametrize("case", cases.CASES, ids=lambda c: c.name)
def test_agrees_with_finite_differences(case):
    if case.needs and not case.needs.exists():
        pytest.skip(f"needs {case.needs}")
    derivatives, reference = case.derivatives(LEAST), FiniteDifferences.read(case.reference)
    agreement = compare(derivatives, reference)
    faults = agreement.faults(noise=MORE_NOISE * json.loads(cases.NOISE.read_text())[case.name])
    print(f"{case.name}: {agreement}")
    if gallery.wanted():
        gallery.keep(case.name, case.image(), derivatives, reference, agreement, faults)
    assert not agreement.zero
    assert not faults
