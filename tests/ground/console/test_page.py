"""Tests of the console's page in Chromium.

`python -m tests.studies.console` measures the load of the console beside a flight process.
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from flight.link import events
from flight.link.commands import crc_of
from flight.link.telemetry.definitions import EVENT, FACTS, HEALTH, PARAMETER_FIELDS, PARAMETERS
from flight.link.telemetry.packets import Packer
from tests.flight.link.telemetry.samples import plain_contents
from tests.ground.report.synthetic import CURRENT, Recipe, make_run
from tests.support.answering_flight import Listener
from tests.support.browser import Page, another_origin, audit, browsing, missing, open_page, opened

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing() or "-")]
ROOT = Path(__file__).parents[3]
SIZES = ((1600, 900), (1024, 768), (390, 844))
FACTS_BIT = {name: 1 << bit for bit, name in FACTS}

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


_RED = """(() => {
  const canvas = document.querySelector('.panel:last-child canvas');
  const probe = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
  probe.canvas.width = canvas.width; probe.canvas.height = canvas.height; probe.drawImage(canvas, 0, 0);
  const wanted = getComputedStyle(document.documentElement).getPropertyValue('--bad').match(/[0-9a-f]{2}/gi);
  const [r, g, b] = wanted.map((part) => parseInt(part, 16));
  const { data } = probe.getImageData(0, 0, canvas.width, canvas.height);
  let found = 0;
  for (let k = 0; k < data.length; k += 4) {
    found += Math.hypot(data[k] - r, data[k + 1] - g, data[k + 2] - b) < 30 && data[k + 3] > 120;
  }
  return found > 0.3 * canvas.width;
})()"""
"""Script that returns whether the last plot has a dashed line in the colour of a fault."""


_KEEP_SOCKETS = """window.sockets = [];
window.WebSocket = class extends WebSocket {
  constructor(...words) { super(...words); sockets.push(this); }
};"""
"""Script that keeps the WebSockets of a page in the array `sockets`."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"), Recipe(duration=6.0, rate_hz=10.0, hold=3.0))


def _event(kind: events.EventKind, time_s: float, text: str) -> bytes:
    values = {"code": kind.code, "severity": int(kind.severity), "suppressed": 0, "name": kind.name}
    return Packer().pack(EVENT, round(time_s * 1e9), {**values, "text": text})


@pytest.fixture(scope="module")
def orbit_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of a satellite with 105 saturated frames, a gyro outage, and a parameter table."""
    near_elements_ns = 1_774_000_000 * 10**9  # the elements of config/orbit.yaml are from 2026-03-20
    recipe = Recipe(duration=6.0, rate_hz=10.0, hold=3.0, utc_ns=near_elements_ns)
    run = make_run(tmp_path_factory.mktemp("orbit"), recipe)
    shutil.copy(ROOT / "config/orbit.yaml", run / "config.yaml")
    values = [sum(field.valid) / 2.0 for field in PARAMETER_FIELDS if field.valid]
    table = {field.name: value for field, value in zip(PARAMETER_FIELDS, values, strict=True)}
    packets = [
        Packer().pack(PARAMETERS, 10**9, {**plain_contents(PARAMETERS), **table, "crc": crc_of(values)}),
        _event(events.IMU_SILENT, 2.0, "no byte for 0.12 s"),
        *(_event(events.CAMERA_SATURATED, 2.1 + 0.01 * k, f"frame {k} is saturated") for k in range(105)),
        _event(events.CAMERA_LATE, 3.0, "frame 7 is overdue"),
        _event(events.CAMERA_LOST, 3.0, "no frame for 9 s"),
        _event(events.IMU_RECOVERED, 5.0, "bytes arrive again"),
        Packer().pack(HEALTH, 6 * 10**9, {**plain_contents(HEALTH), "facts": FACTS_BIT["camera-lost"]}),
    ]
    with (run / "flight-0001.ccsds").open("ab") as file:
        file.write(b"".join(packets))
    return run


@contextmanager
def serving(folder: Path, *words: object, port: int = 0) -> Iterator[str]:
    """Run `knightcube console` on a run, and yield the address that the command prints."""
    command = [sys.executable, "-m", "flight", "console", folder, "--port", port, *words]
    with subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            found = re.search(r"http://\S+", server.stdout.readline())
            assert found is not None
            yield found[0]
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with browsing() as running:
        yield running.new_context(accept_downloads=True)


@pytest.fixture(scope="module")
def page(browser: Any, folder: Path) -> Iterator[Page]:
    with serving(folder) as url:
        yield open_page(browser, url)


@pytest.fixture(scope="module")
def orbit_url(browser: Any, orbit_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a console that sends commands to a socket, for a browser that is already authorised."""
    socket = tmp_path_factory.mktemp("to") / "commands"
    listener = Listener(socket)
    station = ("--station", "Berlin,52.5,13.4,30,10")
    with serving(orbit_folder, "--to", socket, *station) as url:
        open_page(browser, url).page.close()
        yield url.partition("?")[0]
    del listener


@pytest.fixture(scope="module")
def satellite(browser: Any, orbit_url: str) -> Page:
    return open_page(browser, orbit_url)


def test_a_page_of_a_restarted_console_states_that_it_is_stale(folder: Path) -> None:
    with ExitStack() as first, ExitStack() as second:
        url = first.enter_context(serving(folder))
        page = second.enter_context(opened(url))
        port = urlsplit(url).port
        assert port
        assert page.page.url == f"http://127.0.0.1:{port}/", "the used token is not left in the address"
        page.page.reload()
        page.wait("document.body.dataset.time !== undefined")
        first.close()
        with serving(folder, port=port):
            page.wait("document.getElementById('light').textContent === 'address stale'", 60.0)
            assert "open the newest address that it printed" in page.text("#trouble")
            page.page.reload()
            assert "open the newest address" in page.text("body")


def test_a_page_that_is_connected_again_stays_live(folder: Path) -> None:
    with serving(folder) as url, browsing() as chromium:
        context = chromium.new_context()
        context.add_init_script(_KEEP_SOCKETS)
        page = open_page(context, f"{url}#at=2")
        page.wait("document.body.dataset.time === '2'")
        page.page.click("#live")
        page.wait("Number(document.body.dataset.time) > 5")
        page.page.evaluate("sockets[0].close()")
        page.wait("sockets.length === 2 && sockets[1].readyState === WebSocket.OPEN")
        page.page.wait_for_timeout(500)
        assert float(page.page.evaluate("document.body.dataset.time")) > 5.0
        assert page.text("#light").startswith("no telemetry for")


def test_another_page_can_neither_frame_the_console_nor_read_its_data(folder: Path) -> None:
    """A page on another port can neither embed the console nor read its data, even in an authorised browser.

    The console and the other page have the same host, so the browser sends the cookies of the console.
    """
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


def test_the_page_shows_the_end_of_a_log_a_past_instant_and_the_state_of_the_telemetry(
    page: Page, folder: Path
) -> None:
    page.wait("document.getElementById('light').textContent.startsWith('no telemetry for')")
    page.wait("document.querySelectorAll('.uplot').length === 4")
    page.wait("document.querySelectorAll('#events tr').length >= 1")
    live, values = page.shown
    assert live == pytest.approx(6.0, abs=0.2)
    assert not page.page.is_visible("#command"), "the console is read-only"
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
    page.wait("document.getElementById('health').textContent.includes('conditionshot, too-hot')")
    assert page.page.locator(".card:has-text('conditions') b").get_attribute("class") == "bad"
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


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_each_size_and_theme_fits_shows_the_commands_and_has_no_violation(
    browser: Any, orbit_url: str, theme: str
) -> None:
    shown = open_page(browser, orbit_url, theme=theme)
    shown.wait("document.querySelectorAll('#events tbody tr').length > 0")
    for width, height in SIZES:
        shown.page.set_viewport_size({"width": width, "height": height})
        shown.page.evaluate("scrollTo(0, 0)")
        for name in ("#which", "#send-form", "#safe"):
            box = shown.page.locator(name).bounding_box()
            assert 0 <= box["x"] <= box["x"] + box["width"] <= width
            assert 0 <= box["y"] <= box["y"] + box["height"] <= height
        shown.page.wait_for_timeout(200)
        shown.page.evaluate("for (const fold of document.querySelectorAll('details')) fold.open = true")
        assert shown.page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    assert shown.page.evaluate("document.documentElement.dataset.theme") == theme
    shown.page.evaluate("document.getElementById('all').open = false")
    assert audit(shown) == []
    assert shown.complaints == []
    shown.page.close()


def test_the_form_offers_the_commands_of_a_satellite_and_refuses_wrong_values_before_sending(
    satellite: Page,
) -> None:
    offered = satellite.page.locator("#which option").all_inner_texts()
    assert "point" in offered
    assert "slew" not in offered, "a satellite slews by `point`"
    satellite.fill("mode", mode="sun")
    assert "hold" not in satellite.text("#inputs")
    satellite.fill("point", goal="ground", latitude="95", longitude="13.4")
    satellite.wait("document.getElementById('answer').textContent === 'latitude = 95: give -90 to 90 deg'")
    assert satellite.page.get_attribute("#answer", "class") == "error"
    satellite.page.click("#send-form")
    satellite.page.wait_for_timeout(300)
    assert not satellite.page.is_visible("#confirm")
    satellite.fill("point", goal="inertial")
    shown = satellite.page.locator("#inputs label:visible").all_inner_texts()
    assert [text.strip() for text in shown[1:]] == [f"quaternion {axis}" for axis in "xyzw"]
    for axis in "xyzw":
        satellite.fill_one(f"quaternion {axis}", "0.4")
    satellite.wait("document.getElementById('answer').textContent.includes('length 0.8')")
    assert satellite.command("point", goal="ground", latitude="90", longitude="13.4", roll="") == (
        "executed: as commanded"
    )


def test_a_plot_has_titles_units_components_limits_zoom_and_exports(satellite: Page, tmp_path: Path) -> None:
    page = satellite.page
    page.fill("#add", "imu.field")
    page.dispatch_event("#add", "change")
    first = page.locator(".panel").last
    assert first.locator("h3").inner_text() == "Magnetic field, body axes (µT)"
    satellite.wait(
        "document.querySelector('.panel:last-child .u-legend')?.textContent.match(/x.*y.*z/) != null"
    )
    page.fill("#add", "control.path_q2")
    page.dispatch_event("#add", "change")
    plot = page.locator(".panel").last
    plot.locator("input").fill("control.path_rate")
    plot.locator("input").dispatch_event("change")
    satellite.wait("document.querySelectorAll('.panel:last-child .u-axis').length === 3")
    assert "Current rate of the path (deg/s)" in plot.locator("h3").inner_text()
    assert plot.locator(".limits").inner_text() == "fault below -0.68, fault above 0.68"
    satellite.wait(_RED)
    over = plot.locator(".u-over")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 50, steps=4)
    page.mouse.up()
    satellite.wait("!document.getElementById('unzoom').disabled")
    page.wait_for_timeout(400)
    with page.expect_download() as table:
        plot.get_by_text("CSV").click()
    with page.expect_download() as picture:
        plot.get_by_text("PNG").click()
    table.value.save_as(tmp_path / "table.csv")
    rows = list(csv.reader((tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()))
    assert rows[0] == ["time [s]", "control.path_q2", "control.path_rate [deg/s]"]
    times = [float(row[0]) for row in rows[1:]]
    assert [times[0], times[-1]] == pytest.approx([1.5, 4.5], abs=0.2)
    assert len(times) == pytest.approx(30, abs=3), "each control cycle"
    picture.value.save_as(tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    page.keyboard.press("z")
    satellite.wait("document.getElementById('unzoom').disabled")


def test_events_of_one_cause_are_one_line_with_begin_and_end(satellite: Page) -> None:
    rows = satellite.page.locator("#events tbody tr")
    texts = [[cell.strip() for cell in row.split("\t")] for row in rows.all_inner_texts()]
    (saturated,) = [row for row in texts if "camera-saturated" in row[3]]
    assert saturated[:3] == ["2.1", "3.1", "warning"]
    assert "× 105: frame 104 is saturated" in saturated[3]
    (silent,) = [row for row in texts if "imu-silent" in row[3]]
    assert silent[:2] == ["2.0", "5.0"]
    assert "imu-recovered: bytes arrive again" in silent[3]
    (late,) = [row for row in texts if "camera-late" in row[3]]
    assert late[:2] == ["3.0", "6.0"], "its end was suppressed, and the health packet shows that it is over"
    (lost,) = [row for row in texts if "camera-lost" in row[3]]
    assert lost[:2] == ["3.0", "open"]
    satellite.page.fill("#filter", "frame 17 is")
    assert rows.filter(visible=True).count() == 1
    satellite.page.fill("#filter", "")


def test_parameters_have_units_and_ranges_and_are_loaded_as_a_whole(satellite: Page) -> None:
    satellite.page.click("#parameters-panel summary")
    line = satellite.page.locator("#parameters-panel tr", has_text="modes.arrived_angle")
    value = line.locator("input")
    assert float(value.input_value()) == pytest.approx(14.327, abs=1e-3)
    assert [line.locator("td").nth(k).inner_text() for k in (1, 2)] == ["deg", "0.00573 to 28.65"]
    value.fill("40")
    satellite.page.click("#parameters-panel button[type=submit]")
    assert "modes.arrived_angle = 40: give 0.00573 to 28.65 deg" in satellite.text(
        "#parameters-panel form > p"
    )
    assert not satellite.page.is_visible("#confirm")
    value.fill("2")
    satellite.page.click("#parameters-panel button[type=submit]")
    satellite.page.wait_for_selector("#confirm[open]")
    satellite.page.click("#send")
    satellite.wait("document.querySelector('#parameters-panel form > p').className === 'answer'")


def test_the_heat_of_the_coils_and_the_passes_with_their_schedule_are_shown(satellite: Page) -> None:
    heat = satellite.page.locator(".card:has-text('coil heat') b").inner_text()
    assert float(heat.split()[0]) == pytest.approx(1e3 * 23.0 * CURRENT**2, rel=0.02)
    satellite.page.click("#passes summary")
    satellite.wait("document.querySelectorAll('#passes tbody tr').length > 0")
    cells = satellite.page.locator("#passes tbody tr").first.locator("td").all_inner_texts()
    assert (cells[0], cells[4]) == ("Berlin", "10°")
    assert "satellite" in cells[6]
    assert re.search(r"T\d\d:\d\d:\d\dZ point ground latitude 52.5000, longitude 13.4000 deg", cells[7])
    assert "point nadir" in cells[7]


def test_a_file_of_the_run_is_got(satellite: Page, orbit_folder: Path, tmp_path: Path) -> None:
    satellite.page.click("#files summary")
    satellite.wait("document.querySelectorAll('#files tbody tr').length > 1")
    with satellite.page.expect_download() as got:
        satellite.page.get_by_label("get config.yaml").click()
    got.value.save_as(tmp_path / "config.yaml")
    assert (tmp_path / "config.yaml").read_bytes() == (orbit_folder / "config.yaml").read_bytes()


def test_keys_step_pause_and_focus_and_a_speed_does_not_start_a_paused_replay(satellite: Page) -> None:
    page = satellite.page
    page.evaluate("location.hash = '#at=2'")
    satellite.wait("document.getElementById('light').textContent === 'replay, paused'")
    assert page.is_disabled("#send-form"), "the past cannot be commanded"
    assert page.is_disabled("#parameters-panel [name=dump]")
    page.select_option("#speed", "5")
    page.wait_for_timeout(500)
    assert page.evaluate("document.body.dataset.time") == "2"
    assert satellite.text("#light") == "replay, paused"
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("ArrowRight")
    satellite.wait("document.body.dataset.time === '3'")
    page.keyboard.press(" ")
    satellite.wait("document.getElementById('light').textContent === 'replay 5 x'")
    page.keyboard.press("l")
    satellite.wait("document.getElementById('live').className === 'chosen'")
    satellite.wait("!document.getElementById('which').disabled")
    page.keyboard.press("c")
    assert page.evaluate("document.activeElement.id") == "which"
    page.evaluate("document.activeElement.blur()")
    before = page.evaluate("document.documentElement.dataset.theme")
    page.keyboard.press("t")
    assert page.evaluate("document.documentElement.dataset.theme") != before
    page.keyboard.press("t")
    page.keyboard.press("?")
    assert "pause or play" in satellite.text("#keys")
    page.keyboard.press("Escape")
    assert satellite.complaints == []
    assert satellite.strangers == []
