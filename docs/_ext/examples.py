"""Which pages show a function or class at work: read off the Python that they hold, which the tests run, and off the
links to it that stand beside such code.

"Examples: ..." with links to these pages is added to each entry of the API page.
"""

from __future__ import annotations

import ast
import re
import textwrap
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the tests of this file need no Sphinx
    from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parent.parent

BLOCK = re.compile(r"^( *)```(?:python|\{code-cell\})\n(?::tags: [^\n]*\n)?(.*?)^ *```$", re.DOTALL | re.MULTILINE)

#: A link to an entry of the API page.
LINK = re.compile(r"\{py:\w+\}`([\w.]+)`")

#: Pages that an entry links to at most.
MOST = 3


def used(code: str) -> set[str]:
    """Full names of what a piece of Python takes from rimlight, such as ``rimlight.inverse.fit``."""
    tree = ast.parse(code)
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {a.asname or a.name.partition(".")[0]: a.name if a.asname else a.name.partition(".")[0]
                      for a in node.names}  # fmt: skip
        elif isinstance(node, ast.ImportFrom):
            names |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    found = set()
    for node in ast.walk(tree):
        parts = []
        while isinstance(node, ast.Attribute):
            parts.append(node.attr)
            node = node.value
        if isinstance(node, ast.Name) and (start := names.get(node.id, "")).partition(".")[0] == "rimlight":
            found.add(".".join([start, *reversed(parts)]))
    return found


@cache
def pages() -> dict[str, set[str]]:
    """Pages and programs of the documentation, without their endings: what they use."""
    found = {}
    for page in sorted(DOCS.rglob("*.md")):
        if "_build" not in page.parts and "performance" not in page.parts:
            text = page.read_text("utf-8")
            code = "\n".join(textwrap.dedent(m[2]) for m in BLOCK.finditer(text))
            if code:
                found[page.relative_to(DOCS).with_suffix("").as_posix()] = used(code) | {*LINK.findall(text)}
    for program in sorted((DOCS / "programs").glob("*.py")):
        found[f"programs/{program.stem}"] = used(program.read_text("utf-8"))
    return found


def examples(name: str) -> list[str]:
    """Pages that use this function or class, or one of its attributes. name : in full, as the API page has it."""
    return [page for page, names in pages().items() if any(n == name or n.startswith(f"{name}.") for n in names)]


def _process(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    if what in ("function", "class", "exception", "method") and (found := examples(name)):
        first = [page for page in ("recipes", *found) if page in found]  # the shortest ones first
        links = (f":doc:`/{page}`" if not page.startswith("programs/") else f"``docs/{page}.py``" for page in first)
        lines += ["", f"*Examples:* {', '.join([*dict.fromkeys(links)][:MOST])}", ""]


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", _process, priority=900)  # after the docstrings are converted
    return {"parallel_read_safe": True}
