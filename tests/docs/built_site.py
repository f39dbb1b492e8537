"""Checks the built site by `python -m tests.docs.built_site build/site`.

The exit status is 1 if a fault is found. The pages must be readable without a network, so no page may load a
file from another host. Links are allowed. If Chromium is installed, the search of the site is tested on a
page that is opened as a file and on a page from a server. The search must list guides before pages of
modules.
"""

from __future__ import annotations

import argparse
import re
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from tests.support import browser

FIRST_FOUND = {
    "star tracker": "library/star-tracker.html",
    "add a device": "extending/device.html",
    "own satellite": "fly/my-satellite.html",
    "campaigns": "fly/simulation.html",
    "renewal": "fly/renewal.html",
    "day of operations": "fly/day-of-operations.html",
    "tutorial": "tutorial.html",
    "install on a board": "fly/board.html",
    "detumble": "fly/orbit.html",
    "solve pictures": "library/star-tracker.html",
}
"""Search words, and the page that must be the first result."""
_LATEST_MS = 180_000
"""Timeout (ms) for a page. A busy machine needs half a minute to load the search index."""
_LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href", "object": "data"}
_OTHER_HOST = re.compile(r"^(https?:)?//")
_STYLE_URL = re.compile(r"(?:url\(|@import)\s*[\"']?((?:https?:)?//[^\"')\s]+)")
_PLACEHOLDER = re.compile(r"to be filled by|\b(?:TODO|TBD|FIXME)\b")
_STILL_OPEN = {"decisions/libraries-tried.html", "search/search_index.json"}


class _Loads(HTMLParser):
    """Parser that collects the files that a page loads, and the code blocks that only a script can render."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        address = values.get(_LOADED.get(tag, "")) or ""
        if _OTHER_HOST.match(address) and values.get("rel") != "canonical":
            self.found.append(f"<{tag}> loads {address}")
        if "mermaid" in (values.get("class") or ""):
            self.found.append("a mermaid drawing loads a script")


def problems_of(site: Path) -> list[str]:
    """Return the problems of a site, with one text per problem."""
    found: list[str] = []
    for page in sorted(site.rglob("*.html")):
        name, text = str(page.relative_to(site)), page.read_text(encoding="utf-8")
        loads = _Loads()
        loads.feed(text)
        found += [f"{name}: {load}" for load in loads.found]
        if name not in _STILL_OPEN and (match := _PLACEHOLDER.search(text)):
            found.append(f"{name}: placeholder {match[0]!r}")
    for style in sorted(site.rglob("*.css")):
        urls = _STYLE_URL.findall(style.read_text(encoding="utf-8"))
        found += [f"{style.relative_to(site)}: loads {url}" for url in urls]
    return found


class _Quiet(SimpleHTTPRequestHandler):
    """HTTP request handler that does not log requests."""

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def _served(site: Path) -> Iterator[str]:
    """Yield the address of a web server on this machine that serves the site."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(site))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def wrong_searches(site: Path, first_found: Mapping[str, str] = FIRST_FOUND) -> list[str]:
    """Return a text for each search whose first result is not the expected page.

    The check of the search needs Chromium. On a page that is opened as a file, all entries of `first_found`
    are searched. On a page from a server, only the first three entries are searched.
    """
    found: list[str] = []
    item = "li.md-search-result__item > a.md-search-result__link"
    with browser.browsing() as chromium, _served(site) as served:
        page = chromium.new_page()
        page.set_default_timeout(_LATEST_MS)
        for address, most in ((site.resolve().as_uri(), None), (served, 3)):
            for words, right in list(first_found.items())[:most]:
                page.goto(f"{address}/index.html")
                page.click(".md-search__input")
                # All words are entered at once. If words were typed, results of the first letters could
                # remain on the page.
                page.fill(".md-search__input", words)
                page.keyboard.press("End")  # the page reads the search words when a key is released
                page.wait_for_selector(item)
                first = str(page.get_attribute(item, "href")).partition("?")[0]
                if not first.endswith(f"/{right}"):
                    found.append(f"search {words!r}: the first result is {first}, not {right}")
    return found


def main() -> int:
    """Check a site; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.docs.built_site", description=__doc__)
    parser.add_argument("site", type=Path)
    site = parser.parse_args().site
    pages = len(list(site.rglob("*.html")))
    found = problems_of(site) if pages else [f"{site}: no pages"]
    if pages and (missing := browser.missing()):
        sys.stderr.write(f"documentation: the search was not tried, because {missing}\n")
    elif pages:
        found += wrong_searches(site)
    for line in found:
        sys.stderr.write(f"{line}\n")
    sys.stdout.write(f"documentation: {pages} pages in {site}, {len(found)} problems\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
