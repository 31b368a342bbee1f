"""The documentation can be read: short sentences, and terms that the glossary defines. `make lint` checks the spelling.

The grade is that of Flesch and Kincaid: years of school that a reader needs.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts and "performance" not in p.parts),
]

#: Of a page. An article of an encyclopedia has about as much.
GRADE = 12

#: Words fewer than these have no grade: a page that only lists others.
WORDS = 50


def prose(text: str) -> str:
    """A page without code, formulas, tables and markup; every line of code or formula within a sentence is one word."""
    for pattern, replacement in (
        (r"\A---\n.*?^---$", ""),
        (r"^ *```\{glossary\}$", ""),
        (r"^ *```.*?^ *```$", ""),
        (r"^\$\$.*?^\$\$", ""),
        (r"<!--.*?-->", ""),
        (r"^\|.*\|$", ""),
        (r"^\(?[\w-]+\)?=$", ""),
        (r"!\[[^\]]*\]\([^)]*\)", ""),
        (r"\[\^\w+\]:?", ""),
        (r"\[([^\]]*)\]\([^)]*\)", r"\1"),
        (r"\{cite(?::\w+)?\}`[^`]*`", ""),
        (r"\{[\w:]+\}`([^`<]*)(?:<[^>]*>)?`", r"\1"),
        (r"\$[^$]*\$|`[^`]*`", "x"),
        (r"^#+ (.*)$", r"\1."),
        (r"^ *[*\-] (.*)$", r"\n\1"),
        (r"[*_]", ""),
    ):
        text = re.sub(pattern, replacement, text, flags=re.DOTALL | re.MULTILINE if ".*?" in pattern else re.MULTILINE)
    return text


def grade(text: str) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pkg_resources
        textstat = pytest.importorskip("textstat")
    return textstat.flesch_kincaid_grade(text)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_pages_are_easy_to_read(page):
    text = prose(page.read_text("utf-8"))
    if len(text.split()) >= WORDS:
        assert grade(text) <= GRADE


def test_hard_sentences_are_noticed():
    """In simple words with code, which does not count; and in a sentence of a lawyer."""
    assert prose("# A title\n\n```python\nx = 1\n```\n\nThe `cube` is *grey*.\n").split() == (
        ["A", "title.", "The", "x", "is", "grey."]
    )
    assert grade("The cube is grey. It moves to the left. We see it in the mirror.") < 5
    hard = "Notwithstanding considerations regarding the applicability of aforementioned provisions, representatives "
    assert grade(hard + "undertaking responsibilities necessitating comprehensive documentation shall " * 3) > GRADE


def terms() -> set[str]:
    """What the glossary defines, in small letters."""
    text = (ROOT / "docs" / "glossary.md").read_text("utf-8")
    body = re.search(r"```\{glossary\}\n(?::\w+:[^\n]*\n)*(.*?)^```", text, re.DOTALL | re.MULTILINE)[1]
    return {line.strip().lower() for line in body.splitlines() if line.strip() and not line.startswith(" ")}


def test_the_glossary_covers_the_terms():
    """Every {term} that a page refers to, and every term that the README links to the glossary."""
    known, missing = terms(), []
    for page in PAGES:
        for name, target in re.findall(r"\{term\}`([^`<]*?)\s*(?:<([^>]*)>)?`", page.read_text("utf-8")):
            if (target or name).lower() not in known:
                missing.append((page.name, target or name))
    assert not missing
    assert {"edge", "silhouette", "interior term", "boundary term", "jump"} <= known


#: Ordinary words that stand in bold because they matter in their sentence.
STRESSED = {
    "affine in", "affine in the point", "as seen on the film", "away from", "every", "long", "ours", "part", "short",
    "towards", "point in the world",
}  # fmt: skip

#: What follows a term that is explained where it stands, as the head of a row, a list or a sentence.
EXPLAINED = re.compile(r":| is | are | means| \||, ")


def unexplained(text: str, known: set[str]) -> list[str]:
    """Terms in bold (in small letters: titles and labels begin with a capital) that the glossary does not have."""
    found = []
    for match in re.finditer(r"(?<!\*)\*\*([a-z][a-z -]+)\*\*", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        name, rest = match[1], match.string[match.end() :]
        forms = {name, name.removesuffix("s"), f"{name} term", name.replace("welded by position", "welding")}
        if not (forms & known or name in STRESSED or EXPLAINED.match(rest)):
            found.append(name)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_terms_in_bold_are_in_the_glossary(page):
    if page.name != "random_scenes.md":  # a list of what is random
        assert not unexplained(page.read_text("utf-8"), terms())


def test_unexplained_terms_are_noticed():
    assert unexplained(
        "A **flux capacitor** and a **silhouette**. A **rim**: the border. **Why.**", {"silhouette"}
    ) == (["flux capacitor"])
