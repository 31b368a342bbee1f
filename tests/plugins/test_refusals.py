"""What is refused is told from a defect by its type."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from rimlight.cli import _commands, main
from rimlight.edge_sampling.refusals import InputError, Refusal

#: They run before anything of the package can be imported, or say what is amiss with the machine.
BEFORE_ALL = {"_llvm.py", "sys_info.py"}


def test_nothing_else_is_raised_on_purpose(root: Path) -> None:
    for folder in ("plugins", "edge_sampling", "inverse"):
        for file in (root / folder).rglob("*.py"):
            if file.name in BEFORE_ALL:
                continue
            for node in ast.walk(ast.parse(file.read_text("utf-8"))):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                    assert getattr(node.exc.func, "id", "") not in ("ValueError", "RuntimeError"), (file, node.lineno)


@pytest.mark.parametrize("error", [InputError("who: what"), Refusal("who: what"), ValueError("who: what")])
def test_refusals_are_one_line_and_defects_are_not(monkeypatch, capsys, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(_commands.PlanCommand, "run", fail)
    arguments = ["plan", "scenes/cube.xml"]
    if type(error) is ValueError:
        with pytest.raises(ValueError, match="who: what"):
            main(arguments)
        return
    assert main(arguments) == 2
    assert capsys.readouterr().err == "rimlight: error: who: what\n"


@pytest.mark.parametrize("kind", [InputError, Refusal])
def test_refusals_of_plugins_reach_the_user_without_their_class(kind):
    """Mitsuba wraps what their constructors raise into a text."""
    from rimlight.loading import one_line

    error = RuntimeError(
        f'[a.cpp:1] At "x": Traceback (most recent call last):\n  File "y"\n{kind.__name__}: who: what\n'
    )
    assert one_line(error) == 'At "x": who: what'
