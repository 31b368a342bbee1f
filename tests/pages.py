"""Helpers for tests of pages: what is in them, and how they work in a browser."""

from __future__ import annotations

import base64
import html
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge")

#: Why tests do not run without one. The summary of a test run says how many these are.
NO_BROWSER = "needs Chromium or a relative of it"

VOID = {"meta", "link", "img", "input", "br"}

WATCH = """<script>
const errors = [];
window.addEventListener("error", (event) => errors.push(String(event.message)), true);
document.addEventListener("securitypolicyviolation", (event) => errors.push(event.violatedDirective));
console.error = console.warn = (...words) => errors.push(words.join(" "));
</script>"""


class Page(HTMLParser):
    """What is in a page.

    elements : (tag, attributes). texts : what people read, outside of style and script.
    """

    def __init__(self, source: str):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(source)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(self.texts)

    def images(self) -> list[Image.Image]:
        uris = [attributes["src"] for tag, attributes in self.elements if tag == "img"]
        return [Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))) for uri in uris]


def in_browser(source: str, check: str, tmp_path: Path, width: int = 1200) -> Any:
    """Open a page, without a window. Skips the test where there is no browser.

    check : a script, as HTML, that sets the title to JSON; `errors` has what went wrong in the page. Returned decoded.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(NO_BROWSER)
    watched = source.replace("<title>", f"{WATCH}<title>", 1).replace("</body>", f"{check}</body>", 1)
    (tmp_path / "page.html").write_text(watched, "utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    options += [f"--window-size={width},900", "--virtual-time-budget=3000", "--dump-dom"]
    try:
        command = [browser, *options, (tmp_path / "page.html").as_uri()]
        run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"{NO_BROWSER}: {browser} does not run here: {error}")
    title = re.search(r"<title>(.*?)</title>", run.stdout, re.DOTALL)
    if title is None:
        pytest.skip(f"{NO_BROWSER}: {browser} does not run here: {run.stderr[-300:]}")
    return json.loads(html.unescape(title[1]))
