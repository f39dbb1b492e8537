"""The page in Chromium; `python -m tests.studies.console` measures it beside a flight."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from flight.link import events
from flight.link.telemetry.definitions import EVENT, FACTS, HEALTH
from flight.link.telemetry.packets import Packer
from tests.flight.link.telemetry.samples import plain_contents
from tests.ground.report.synthetic import Recipe, make_run
from tests.support.browser import Page, another_origin, browsing, missing, opened

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing() or "-")]

_FRAME = """(url) => new Promise((done) => {
  const frame = Object.assign(document.createElement("iframe"), { src: url, onload: done });
  document.body.append(frame);
})"""
_ASK = """async (url) => {
  const asked = await fetch(`${url}api/table`).then(() => "answered", () => "refused");
  const line = new WebSocket(`${url.replace("http", "ws")}api/live`);
  const live = new Promise((done) => {
    line.onmessage = () => done("answered");
    line.onclose = () => done("refused");
  });
  return [asked, await live];
}"""

FACTS_BIT = {name: 1 << bit for bit, name in FACTS}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


@contextmanager
def serving(folder: Path, port: int = 0) -> Iterator[str]:
    """Run `knightcube console` on a run, and yield the address that it prints."""
    words = [sys.executable, "-m", "flight", "console", str(folder), "--port", str(port)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            found = re.search(r"http://\S+", server.stdout.readline())
            assert found is not None
            yield found[0]
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def page(folder: Path) -> Iterator[Page]:
    with serving(folder) as url, opened(url) as shown:
        yield shown


def test_a_page_of_a_console_that_was_started_again_says_that_it_is_stale(folder: Path) -> None:
    with ExitStack() as first, ExitStack() as second:
        url = first.enter_context(serving(folder))
        page = second.enter_context(opened(url))
        port = urlsplit(url).port
        assert port
        assert page.page.url == f"http://127.0.0.1:{port}/", "the used token is not left in the address"
        page.page.reload()
        page.wait("document.body.dataset.time !== undefined")
        first.close()
        with serving(folder, port):
            page.wait("document.getElementById('light').textContent === 'address stale'", 60.0)
            assert "open the newest address that it printed" in page.text("#trouble")
            page.page.reload()
            assert "open the newest address" in page.text("body")


def test_another_page_neither_frames_the_console_nor_asks_it_anything(folder: Path) -> None:
    """Also in the browser that the console knows: both pages are of the same host, so cookies are sent."""
    with serving(folder) as url, another_origin() as foreign, browsing() as chromium:
        context = chromium.new_context()
        own, other = context.new_page(), context.new_page()
        complaints: list[str] = []
        other.on("console", lambda said: complaints.append(said.text))
        own.goto(url)
        other.goto(foreign)
        other.evaluate(_FRAME, own.url)
        other.wait_for_timeout(500)
        assert [frame.url for frame in other.frames[1:]] == ["chrome-error://chromewebdata/"]
        assert any("frame-ancestors" in text for text in complaints)
        statuses = other.evaluate(_ASK, own.url)
        assert statuses == ["refused", "refused"]
        assert own.evaluate("fetch('/api/table').then((answer) => answer.status)") == 200


def test_it_shows_a_log_to_its_end_a_moment_of_it_and_a_link_that_is_dead_or_over(
    page: Page, folder: Path
) -> None:
    page.wait("document.getElementById('light').textContent.startsWith('no telemetry for')")
    page.wait("document.querySelectorAll('.uplot').length === 4")
    page.wait("document.querySelectorAll('#events tr').length >= 1")
    live, values = page.shown
    assert live == pytest.approx(6.0, abs=0.2)
    assert page.page.locator("form.command").count() == 0, "this console only looks"
    page.page.evaluate("location.hash = '#at=2'")
    page.wait("document.body.dataset.time === '2'")
    page.wait("document.getElementById('light').textContent === 'replay, paused'")
    assert page.shown[1] != values
    page.page.click("#live")
    page.wait(f"Number(document.body.dataset.time) === {live!r}")
    assert page.shown == (live, values)
    found = FACTS_BIT["hot"] | FACTS_BIT["too-hot"]
    with (folder / "flight-0001.ccsds").open("ab") as file:
        file.write(Packer().pack(HEALTH, round(6.4e9), {**plain_contents(HEALTH), "facts": found}))
    page.wait("document.getElementById('health').textContent.includes('monitors findhot, too-hot')")
    assert page.page.locator(".card:has-text('monitors find') b").get_attribute("class") == "bad"
    stopped = {"code": 1, "severity": 0, "suppressed": 0, "name": events.STOPPED.name, "text": "<b>done</b>"}
    with (folder / "flight-0001.ccsds").open("ab") as file:
        file.write(Packer().pack(EVENT, round(6.5e9), stopped))
    page.wait("document.getElementById('light').textContent === 'flight ended'")
    assert "<b>done</b>" in page.text("#events"), "a text of a log must not be interpreted as markup"
    assert page.text("#play") == "replay"
    page.page.click("#play")
    page.wait("document.getElementById('light').textContent === 'replay 1 x'")
    page.wait("Number(document.body.dataset.time) < 6")
    assert page.complaints == []
    assert page.strangers == []
