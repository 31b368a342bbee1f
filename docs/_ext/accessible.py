"""What furo and Sphinx 9 write, so that it passes the rules of axe-core for accessibility (`make browse`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the tests of this file need no Sphinx
    from sphinx.application import Sphinx

#: Text of the pages, and what is written in its place. Each replacement may be done again to a page that has it.
REPLACEMENTS = {
    # A heading has a level
    '<p class="caption" role="heading">': '<p class="caption" role="heading" aria-level="2">',
    # Regions of the same kind have names
    '<aside class="sidebar-drawer">': '<aside class="sidebar-drawer" aria-label="All pages">',
    '<aside class="toc-drawer': '<aside aria-label="This page" class="toc-drawer',
    # A role that is no longer in use, and a list of such entries
    ' role="doc-biblioentry"': "",
    '<div role="list" class="citation-list">': '<div class="citation-list">',
    # The page of search results has a title
    '<div id="search-results"></div>': '<h1>Search</h1><div id="search-results" class="titled"></div>',
}


def mend(page: str) -> str:
    for old, new in REPLACEMENTS.items():
        page = page.replace(old, new)
    return page


def _finish(app: Sphinx, exception: Exception | None) -> None:
    if exception is None and app.builder.format == "html":
        for path in Path(app.outdir).rglob("*.html"):
            page = path.read_text("utf-8")
            if (mended := mend(page)) != page:
                path.write_text(mended, "utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("build-finished", _finish)
    return {"parallel_read_safe": True}
