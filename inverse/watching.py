"""A page on this machine that shows a fit while it runs."""

from __future__ import annotations

import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from . import report, result
from .fitting import Fit
from .progress import SHARE, Step

#: Seconds between two versions of the page, at least; and after which a browser asks for the next one.
PAUSE = 2.0


class Watch:
    """A page that shows a fit while it runs, at `url`. Only this machine can open it.

    with inverse.Watch(fit, title="My fit") as watch:
        print(watch.url)
        found = fit.run()

    port : 0 takes any that is free. Raises OSError : it is not free.
    """

    def __init__(self, fit: Fit, *, title: str, port: int = 0):
        self.fit, self.title = fit, title
        self._page, self._due, self._over = "", 0.0, False
        self._drawn: Any = None
        self._seen = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), self._handler())
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"
        fit.on_step(self)
        fit.shows = lambda: time.monotonic() >= self._due

    def __call__(self, step: Step) -> None:
        """Draw the page anew, unless that was done just now, or would take more than its share of the time."""
        began = time.monotonic()
        if self.fit.image is not self._drawn:
            self._draw()
            ended = time.monotonic()
            self._due = ended + max(PAUSE, (ended - began) / SHARE)

    def _draw(self) -> None:
        self._drawn = self.fit.image
        self._page = report.live(result.so_far(self.fit), title=self.title)

    def __enter__(self) -> Watch:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: Any) -> None:
        """The last page stays in the browser: wait until it has asked for it, if one is open."""
        opened, self._over = self._seen.is_set(), True
        if self.fit.image is not None:
            self._draw()
        self._seen.clear()
        if opened:
            self._seen.wait(2 * PAUSE)
        self._server.shutdown()
        self._server.server_close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        watch = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # Another name would be a page of somewhere else that asks for this one (DNS rebinding).
                if self.headers.get("Host") != watch.url.removeprefix("http://").rstrip("/") or self.path != "/":
                    self.send_error(404)
                    return
                body = (watch._page or "<p>The first step is not done yet.</p>").encode()
                self.send_response(200)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.send_header("Content-Length", str(len(body)))
                if not watch._over:
                    self.send_header("Refresh", f"{PAUSE:g}")
                self.end_headers()
                self.wfile.write(body)
                watch._seen.set()

            def log_message(self, *_: Any) -> None:
                """Nothing: the terminal shows the fit."""

        return Handler
