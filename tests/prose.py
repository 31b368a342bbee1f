"""Helper for tests of pages: the prose of a page of Markdown, without code, formulas and tables."""

from __future__ import annotations

import re

#: Directives whose body is prose. Of all others, the body is dropped.
PROSE = ("note", "tip", "warning", "important", "glossary", "admonition", "dropdown")

FENCE = re.compile(
    r"^(?P<indent> *)(?P<fence>`{3,}|:{3,}) *(?P<info>[^\n`]*)\n(?P<body>.*?)^ *(?P=fence) *$",
    re.DOTALL | re.MULTILINE,
)


def _fence(match: re.Match[str]) -> str:
    name = re.match(r"\{(\w+)\}", match["info"])
    if name and name[1] in PROSE:
        return "\n" + re.sub(r"^:[\w-]+:.*$", "", match["body"], flags=re.MULTILINE) + "\n"
    return "\n"


def prose(page: str) -> str:
    """Sentences of a page. Code in a line and formulas become one short word, so that the sentence stays whole; items
    of a list end with a full stop. Headings are left out."""
    text = re.sub(r"\A---\n.*?^---$", "", page, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    while (shorter := FENCE.sub(_fence, text)) != text:
        text = shorter
    text = re.sub(r"\$\$.*?\$\$(?: *\([\w-]+\))?", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"\\begin\{(\w+\*?)\}.*?\\end\{\1\}", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"^(?:\||#|\[\^[\w-]+\]:?$).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"\{cite\w*\}`[^`]*`", "", text)
    text = re.sub(r"\{doc\}`[\w/]+`", "page", text)
    text = re.sub(r"\{\w+\}`([^`<]*?)(?: *<[^`]*>)?`", r"\1", text)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "\n\n", text)
    text = re.sub(r"\[\^[\w-]+\]:? ?", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"(`+)(?:(?!\1).)+?\1|\$[^$\n]+\$", "code", text, flags=re.DOTALL)
    text = re.sub(r"<[^>\n]+>", "", text)
    paragraphs = re.split(r"\n\s*\n|\n(?= *(?:[*-]|\d+\.) )", text)
    sentences = []
    for paragraph in paragraphs:
        line = " ".join(re.sub(r"^(?:[*:-]|\d+\.) +", "", paragraph.strip()).split())
        line = re.sub(r"[*_]{1,2}(?=\S)|(?<=\S)[*_]{1,2}", "", line)
        if re.search(r"[A-Za-z]{2}", line):
            sentences.append(line if line[-1] in ".!?" else line.rstrip(":;,") + ".")
    return "\n".join(sentences)
