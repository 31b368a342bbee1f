"""The deliberate faults can be made: what they change is where they look for it. Whether tests notice them is for
``make mutants``."""

from __future__ import annotations

import ast

import pytest
from mutants import MUTANTS, changed


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: m.fault)
def test_fault_can_be_made(root, mutant):
    text = (root / mutant.file).read_text(encoding="utf-8")
    assert ast.dump(ast.parse(changed(mutant, text))) != ast.dump(ast.parse(text))
