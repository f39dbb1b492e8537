"""Debian's Chromium, controlled by playwright, with a record of the errors and requests of a page."""

from __future__ import annotations

import contextlib
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

HOST = "127.0.0.1"


@dataclass  # no slots, because playwright sets attributes on objects whose methods it calls
class Page:
    """A page of the console in the browser.

    `complaints` are errors and warnings of the browser's console. `strangers` are requested addresses other
    than loopback.
    """

    page: Any
    complaints: list[str] = field(default_factory=list)
    strangers: list[str] = field(default_factory=list)

    def heard(self, said: Any) -> None:
        """Record an error or a warning in the browser's console."""
        if said.type in ("error", "warning"):
            self.complaints.append(said.text)

    def failed(self, error: Any) -> None:
        """Record an uncaught error."""
        self.complaints.append(str(error))

    def asked(self, request: Any) -> None:
        """Record a request to an address other than loopback."""
        if urlsplit(request.url).hostname not in (HOST, None):
            self.strangers.append(request.url)

    def wait(self, condition: str, patience: float = 30.0) -> None:
        """Wait until a JavaScript expression is true.

        Playwright's own function uses `eval`, which the page's security policy forbids.
        """
        until = time.monotonic() + patience
        while not self.page.evaluate(condition):
            assert time.monotonic() < until, f"not within {patience:g} s: {condition}"
            self.page.wait_for_timeout(50)

    def text(self, place: str) -> str:
        """Return the text of an element by its CSS selector."""
        return str(self.page.inner_text(place))

    @property
    def shown(self) -> tuple[float, str]:
        """Time (s) that the page shows, and packet values that it shows for this time."""
        self.page.evaluate("document.getElementById('all').open = true")
        self.page.wait_for_timeout(300)
        both = "[document.body.dataset.time, document.getElementById('packets').textContent]"
        time, values = self.page.evaluate(both)
        return float(time), values

    def fill(self, name: str, **values: str) -> None:
        """Select a command, and fill in its form. The values are given by the name of their input."""
        self.page.select_option("#which", name)
        for label, value in values.items():
            self.fill_one(label, value)

    def fill_one(self, label: str, value: str) -> None:
        """Fill in one visible input in the form of the selected command."""
        place = self.page.locator(f"#inputs label:visible:has-text('{label}')").first
        if place.locator("select").count():
            place.locator("select").select_option(label=value)
        else:
            place.locator("input").fill(value)

    def command(self, name: str, **values: str) -> str:
        """Fill in and confirm the form of a command, and return the reply that the page shows."""
        self.fill(name, **values)
        self.page.click("#send-form")
        self.page.wait_for_selector("#confirm[open]")
        self.page.click("#send")
        self.wait("['answer', 'error'].includes(document.getElementById('answer').className)")
        return self.text("#answer")


def missing() -> str:
    """Return a message about a missing package of the browser tests, or an empty string."""
    try:
        import playwright.sync_api  # noqa: F401, PLC0415 - an extra of the tests
    except ModuleNotFoundError:
        return "playwright is not installed"
    return "" if _chromium() else "chromium is not installed (Debian's package chromium)"


@contextlib.contextmanager
def opened(url: str, width: int = 1600, height: int = 1150) -> Iterator[Page]:
    """Open a page of the console, and yield the page once it shows a time."""
    with browsing() as browser:
        yield open_page(browser, url, width, height)


def open_page(context: Any, url: str, width: int = 1600, height: int = 1150, theme: str = "dark") -> Page:
    """Open a page of the console in a browser or context, and return the page once it shows a time."""
    page = context.new_page()
    page.set_viewport_size({"width": width, "height": height})
    page.emulate_media(color_scheme=theme)
    found = Page(page)
    page.on("console", found.heard)
    page.on("pageerror", found.failed)
    page.on("request", found.asked)
    page.goto(url)
    found.wait("document.body.dataset.time !== undefined")
    return found


def audit(page: Page) -> list[str]:
    """Return the violations of WCAG 2.1 A and AA that axe-core finds, each with its first element."""
    source = files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")
    page.page.evaluate(source)
    rules = '["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]'
    result = page.page.evaluate(f"axe.run(document, {{ runOnly: {rules} }})")
    return [f"{found['id']}: {found['nodes'][0]['html']}" for found in result["violations"]]


@contextlib.contextmanager
def browsing(*arguments: str) -> Iterator[Any]:
    """Yield a running Chromium, started by playwright with additional `arguments`."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=_chromium(), args=["--no-sandbox", *arguments])
        try:
            yield browser
        finally:
            browser.close()


@contextlib.contextmanager
def another_origin(text: str = "<!doctype html><title>another page</title>") -> Iterator[str]:
    """Serve a page from another origin, another port of loopback, and yield its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer((HOST, 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://{HOST}:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


def _chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser")
