"""Checks in Chromium that the console's page meets its requirements.

The study measures the lag of the page behind the log, and the memory and processor time of the server beside
a 40 Hz flight. It checks that a replayed instant shows the same as live, that the browser reports no errors
and makes no request beyond loopback, and that the status light turns red when telemetry stops.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from ground.console.server import PAGE
from ground.watch import LogTail
from tests.studies.command import Json, command, say, scratch
from tests.support.browser import Page, missing, opened
from tests.support.flooded_flight import free_port, process, wait_for
from tests.support.linked_board import write_linked_config

CONFIG = Path("config/step_demo.yaml")


@dataclass(frozen=True, slots=True)
class Figures:
    """Measured lag (s), memory (MiB), share of a core, and time (s) from the last telemetry to the red light.

    `weight_kb` is the size of all files of the page. `filed` is the page's error when it uploads, lists and
    downloads a file, or empty.
    """

    weight_kb: float
    lag_s: float
    memory_mib: float
    processor: float
    complaints: list[str]
    strangers: list[str]
    replay_equal: bool
    commanded: str
    red_s: float
    filed: str


ASKED = {"weight_kb": 250.0, "lag_s": 0.5, "memory_mib": 120.0, "processor": 0.15, "red_s": 3.0}
"""Required limits: page of 250 kB, lag of 0.5 s, memory of 120 MB, 15 % of a core, red light within 3 s."""


@command
def main(
    *,
    config: Annotated[Path, "to fly"] = CONFIG,
    seconds: Annotated[float, "of flight"] = 60.0,
    by_link: Annotated[bool, "telemetry and commands by protected frames"] = False,
    pictures: Annotated[Path | None, "where to put screenshots"] = None,
    json: Json = False,
) -> int:
    """Measure, print, and save pictures if requested. Returns 1 if a limit is exceeded."""
    if lacks := missing():
        sys.stderr.write(f"{lacks}\n")
        return 1
    figures = measure(config, seconds, pictures, by_link)
    if json:
        say(**asdict(figures))
    else:
        for name, value in asdict(figures).items():
            asked = f"   (at most {ASKED[name]:g})" if name in ASKED else ""
            sys.stdout.write(f"{name:14} {value}{asked}\n")
    return 1 if missed(figures, by_link) else 0


def missed(figures: Figures, by_link: bool) -> list[str]:
    """Return the names of the results that exceed their limits.

    Over a link, packets of one instant may arrive in two frames; for a moment, the page may then show only
    the packets of the first frame.
    """
    wrong = [name for name, bound in ASKED.items() if not getattr(figures, name) <= bound]
    wrong += [name for name in ("complaints", "strangers", "filed") if getattr(figures, name)]
    wrong += [] if figures.replay_equal or by_link else ["replay_equal"]
    return wrong + ([] if figures.commanded.startswith("executed") else ["commanded"])


def measure(config: Path, seconds: float, pictures: Path | None, by_link: bool = False) -> Figures:
    """Run a flight for `seconds` s, and examine the page."""
    with scratch() as place:
        run, way = place / "run", _linked if by_link else _flown
        with way(config, run) as (url, server, source), opened(url) as page:
            begun, spent = time.monotonic(), _processor_s(server)
            lag = _lag(page, LogTail(run), seconds)
            share = (_processor_s(server) - spent) / (time.monotonic() - begun)
            memory = _resident_mib(server)
            live, values = page.shown
            _picture(page, pictures, "live")
            commanded = page.command("ping", number="7")
            page.page.goto(f"{url}#at={live!r}")
            page.wait(f"Number(document.body.dataset.time) === {live!r}")
            replayed = page.shown
            _picture(page, pictures, "replay")
            equal, red = replayed == (live, values), _red(page, source)
            filed = _filed(page, place) if by_link else ""
            others = (page.complaints, page.strangers, equal, commanded, red, filed)
            return Figures(_weight_kb(), lag, memory, share, *others)


def _filed(page: Page, place: Path) -> str:
    """Upload, list and download a file through the page; return the error, or an empty string."""
    sent, got = place / "tle.txt", place / "got.txt"
    sent.write_bytes(bytes(range(256)) * 40)
    page.page.evaluate("document.getElementById('files').open = true")
    page.page.set_input_files("#files [name=file]", str(sent))
    page.page.select_option("#files [name=kind]", "elements")
    page.page.click("#files button[type=submit]")
    page.wait("/on board|refused|no /.test(document.querySelector('#files p').textContent)", 60.0)
    if "on board" not in page.text("#files p"):
        return page.text("#files p")
    page.page.click("#files [name=list]")
    page.wait("document.querySelectorAll('#files tbody tr').length > 0", 60.0)
    with page.page.expect_download() as download:
        page.page.get_by_label("get received/elements/tle.txt").click()
    download.value.save_as(got)
    return "" if got.read_bytes() == sent.read_bytes() else "another content came down"


def _weight_kb() -> float:
    return 1e-3 * sum(path.stat().st_size for path in PAGE.rglob("*") if path.is_file())


@contextlib.contextmanager
def _flown(config: Path, run: Path) -> Iterator[tuple[str, int, int]]:
    """Yield the address and the process of a console that starts a flight, and the process of its flight."""
    with _started("console", run, "--fly", config, "--port", "0") as server:
        url = _address(server)
        children = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text(encoding="ascii").split()
        yield url, server.pid, int(children[0])


@contextlib.contextmanager
def _linked(config: Path, run: Path) -> Iterator[tuple[str, int, int]]:
    """Yield address and process of a console that is connected to the link alone, and the link's process."""
    address, place = f"127.0.0.1:{free_port()}", run.parent
    own = write_linked_config(place, base=config, udp=address, rate=100_000)
    with process("run", own, "--realtime", "--out", run):
        wait_for(run / "flight-0001.ccsds")
        words = ("--link", address, "--keys", place / "keys" / "ground", "--config", own, "--port", "0")
        with process("link", own, "--log", run) as link, _started("console", *words) as server:
            yield _address(server), server.pid, link.pid


@contextlib.contextmanager
def _started(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Run a command of `flight` until the block ends."""
    command = [sys.executable, "-m", "flight", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=30)


def _address(server: subprocess.Popen[str]) -> str:
    assert server.stdout is not None
    said = server.stdout.readline()
    found = re.search(r"http://\S+", said)
    if found is None:
        raise RuntimeError(f"the console did not start: {said}")
    return found[0]


def _lag(page: Page, tail: LogTail, seconds: float) -> float:
    """Return the largest lag (s) of the page behind the log, sampled five times a second."""
    newest, worst, until = 0.0, 0.0, time.monotonic() + seconds
    while time.monotonic() < until:
        packets = tail.new()
        newest = max([newest, *(1e-9 * float(rows["time_ns"][-1]) for rows in packets.values() if len(rows))])
        shown = float(page.page.evaluate("document.body.dataset.time"))
        worst = max(worst, newest - shown)
        time.sleep(0.2)
    return worst


def _red(page: Page, source: int) -> float:
    """Stop the process that sends telemetry; return the time (s) until the light turns red."""
    page.page.click("#live")
    page.wait("document.getElementById('light').classList.contains('alive')")
    os.kill(source, signal.SIGSTOP)
    stopped = time.monotonic()
    page.wait("document.getElementById('light').classList.contains('dead')")
    os.kill(source, signal.SIGCONT)
    return time.monotonic() - stopped


def _picture(page: Page, folder: Path | None, name: str) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        page.page.wait_for_timeout(1500)
        page.page.evaluate("document.getElementById('all').open = false")
        page.page.screenshot(path=str(folder / f"console_{name}.png"), full_page=True)


def _processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident_mib(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(r"VmRSS:\s+(\d+) kB", status)
    return int(found[1]) / 1024.0 if found else float("nan")


if __name__ == "__main__":
    raise SystemExit(main())
