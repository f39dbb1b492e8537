"""The page in Chromium; `python -m tests.studies.console` measures it beside a flight."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from flight.link import events
from flight.link.telemetry.definitions import EVENT, HEALTH
from flight.link.telemetry.packets import Packer
from flight.link.telemetry.states import FACTS
from tests.flight.link.telemetry.samples import plain_contents
from tests.ground.report.synthetic import Recipe, make_run
from tests.studies.console.browser import Page, missing, opened

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing() or "-")]

FACTS_BIT = {name: 1 << bit for bit, name in FACTS}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


@pytest.fixture(scope="module")
def page(folder: Path) -> Iterator[Page]:
    words = [sys.executable, "-m", "flight", "console", str(folder), "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            found = re.search(r"http://\S+", server.stdout.readline())
            assert found is not None
            with opened(found[0]) as shown:
                yield shown
        finally:
            server.terminate()


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
    assert "<b>done</b>" in page.text("#events"), "a log's texts are no markup"
    assert page.text("#play") == "replay"
    page.page.click("#play")
    page.wait("document.getElementById('light').textContent === 'replay 1 x'")
    page.wait("Number(document.body.dataset.time) < 6")
    assert page.complaints == []
    assert page.strangers == []
