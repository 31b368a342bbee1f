"""Docstrings of this project as reStructuredText: NumPy's sections, and lines of the form ``name : meaning``."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

RULE = re.compile(r"-{3,}\s*$")
ENTRY = re.compile(r"[A-Za-z_]\w*(, [A-Za-z_]\w*)*\s+: ")


def convert(lines: list[str]) -> list[str]:
    """Sections become rubrics, entries become definition lists. All else is kept, its symbols taken literally."""
    out: list[str] = []
    in_entry = False
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if RULE.match(line):
            continue
        if RULE.match(following):
            out += ["", f".. rubric:: {line}", ""]
            in_entry = False
        elif ENTRY.match(line):
            name, _, meaning = line.partition(" : ")
            names = ", ".join(f"``{n.strip()}``" for n in name.split(","))
            out += [*([] if in_entry or not out or not out[-1] else [""]), names, f"    {literal(meaning)}"]
            in_entry = True
        elif in_entry and line.strip() and line[0] == " ":
            out.append(f"    {literal(line.strip())}")
        else:
            if in_entry and line.strip():
                out.append("")
                in_entry = False
            out.append(literal(line))
    return out


def literal(line: str) -> str:
    """Escape what reStructuredText would take for markup, but for text between backticks."""
    parts = re.split(r"(`+[^`]*`+)", line)
    return "".join(p if p.startswith("`") else re.sub(r"([|*])|_\b|(?<=\w)_(?!\w)", _escape, p) for p in parts)


def _escape(match: re.Match[str]) -> str:
    return "\\" + match[0]


def _process(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    if lines and name.startswith("rimlight."):
        lines[:] = convert(lines)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", _process)
    return {"parallel_read_safe": True}
