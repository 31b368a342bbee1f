"""The documentation in a real browser:  make browse,  or  python tests/browse.py docs/_build/html [FOLDER]

Every page is opened in light and dark colours, as wide as a desk and as narrow as a phone. Each has to pass the rules
of axe-core for accessibility, to fit into the width, and to show all of its pictures. Then words that newcomers may
type are searched for. With a FOLDER, a picture of each page is written there. Nothing is downloaded: requests to other
machines fail, so that formulas, which MathJax draws, are checked as they are written.

Where there is no browser, or no `axe-playwright-python` (the extra `browse`), this says so and checks nothing.
"""

from __future__ import annotations

import functools
import http.server
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pages import BROWSERS

#: Colours and widths in pixels that pages are opened in.
VIEWS = [(scheme, width) for scheme in ("light", "dark") for width in (1280, 390)]

#: What newcomers may type, and a page that has to be among the first FIRST results.
SEARCHES = {
    "install": "getting_started",
    "LLVM": "troubleshooting",
    "shadow": "notebooks/shape_from_shadows",
    "camera": "notebooks/camera_calibration",
    "mirror": "notebooks/object_in_a_mirror",
    "depth": "channels",
    "prb_projective": "from_mitsuba",
    "redner": "from_mitsuba",
    "freeze": "getting_started",
    "optimiser": "fits_in_python",
    "spp": "glossary",
    "finite differences": "finite_differences",
}
FIRST = 8

#: Until a page has followed a new view, or a search its words, in milliseconds.
PAUSE = 300

#: Of a page that is as wide as its window, in pixels.
TOO_WIDE = "document.scrollingElement.scrollWidth - document.documentElement.clientWidth"
BROKEN = "[...document.images].filter(i => i.complete && !i.naturalWidth).map(i => i.src)"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of these files, on this machine alone."""
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def faults(page: Any, axe: Any) -> list[str]:
    """Of an open page."""
    found = []
    for violation in axe.run(page).response["violations"]:
        for node in violation["nodes"]:
            summary = " ".join(node["failureSummary"].split())
            found.append(f"{violation['id']}: {' '.join(map(str, node['target']))}: {summary}")
    if (more := page.evaluate(TOO_WIDE)) > 0:
        found.append(f"wider than the window by {more} pixels")
    return found + [f"no picture: {source}" for source in page.evaluate(BROKEN)]


def look(browser: Any, axe: Any, address: str, names: list[str], pictures: Path | None) -> list[str]:
    """Open every page in every view. Returns lines that say what is wrong."""
    found = []
    context = browser.new_context()
    context.route(lambda url: not url.startswith(address), lambda route: route.abort())
    page = context.new_page()
    for name in names:
        page.goto(f"{address}/{name}", wait_until="load")
        for scheme, width in VIEWS:
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size({"width": width, "height": 900})
            page.wait_for_timeout(PAUSE)
            found += [f"{name} ({scheme}, {width}): {fault}" for fault in faults(page, axe)]
            if pictures:
                file = name.replace("/", "_").replace(".html", f"_{scheme}_{width}.png")
                page.screenshot(path=pictures / file, full_page=True)
    context.close()
    return found


def search(browser: Any, address: str) -> list[str]:
    """Type each of SEARCHES into the field of the front page. Returns lines that say what was not found."""
    found = []
    page = browser.new_page()
    for words, expected in SEARCHES.items():
        page.goto(f"{address}/index.html")
        page.fill(".sidebar-search", words)
        page.press(".sidebar-search", "Enter")
        page.wait_for_selector("ul.search li > a")
        page.wait_for_timeout(PAUSE)
        links = page.eval_on_selector_all("ul.search li > a", "links => links.map(a => a.pathname.slice(1))")
        if f"{expected}.html" not in links[:FIRST]:
            found.append(f'search "{words}": {expected} is not among the first: {links[:FIRST]}')
    page.close()
    return found


def main(arguments: list[str]) -> int:
    folder, *pictures = map(Path, arguments)
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from axe_playwright_python.sync_playwright import Axe
        from playwright.sync_api import sync_playwright
    except ImportError:
        program = None
    if program is None:
        print("skipped: needs Chromium or a relative of it, and the extra `browse`")
        return 0
    for each in pictures:
        each.mkdir(parents=True, exist_ok=True)
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*.html") if "_static" not in p.parts)
    with served(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        found = look(browser, Axe(), address, names, next(iter(pictures), None)) + search(browser, address)
        browser.close()
    print(*found, sep="\n")
    print(f"{len(names)} pages in {len(VIEWS)} views, {len(SEARCHES)} searches: {len(found)} faults")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
