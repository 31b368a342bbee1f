"""The programs of the documentation run, and are short."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAMS = sorted((Path(__file__).resolve().parents[2] / "docs" / "programs").glob("*.py"))

#: Lines of a program, at most.
LONGEST = 40


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda p: p.stem)
def test_programs_run(path, tmp_path):
    text = path.read_text("utf-8")
    assert len(text.splitlines()) <= LONGEST
    if "import torch" in text:
        pytest.importorskip("torch")
    command = [sys.executable, "-W", "error", str(path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, env=dict(os.environ))
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout


def test_the_page_shows_all_programs(root):
    page = (root / "docs" / "fits_in_python.md").read_text("utf-8")
    assert len(PROGRAMS) == 5
    for path in PROGRAMS:
        assert f"programs/{path.name}" in page
