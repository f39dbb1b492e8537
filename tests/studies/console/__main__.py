"""`python -m tests.studies.console`: fly, look at the page in Chromium, and measure what the page promises.

Live: how far the page is behind the log. A replayed moment shows what was live then. No complaints of the
browser, no request beyond loopback. Memory and processor time of the server beside a 40 Hz flight.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from ground.watch.tail import LogTail
from tests.studies.console.browser import Page, missing, opened

CONFIG = Path("config/step_demo.yaml")


@dataclass(frozen=True, slots=True)
class Figures:
    """What was measured: lag s, memory MiB, share of a core."""

    lag_s: float
    memory_mib: float
    processor: float
    complaints: list[str]
    strangers: list[str]
    replay_equal: bool
    commanded: str


ASKED = {"lag_s": 1.0, "memory_mib": 120.0, "processor": 0.15}
"""Issue: live within 1 s, 120 MB, 15 % of a core."""


def main() -> int:
    """Measure, print, and keep pictures where asked to; exit status 1 when a bound was missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.console", description=__doc__)
    parser.add_argument("--config", type=Path, default=CONFIG, help=f"to fly (default {CONFIG})")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="of flight (default 60)")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="where to put screenshots")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if lacks := missing():
        sys.stderr.write(f"{lacks}\n")
        return 1
    figures = measure(options.config, options.seconds, options.pictures)
    if options.json:
        sys.stdout.write(json.dumps(asdict(figures)) + "\n")
    else:
        for name, value in asdict(figures).items():
            asked = f"   (at most {ASKED[name]:g})" if name in ASKED else ""
            sys.stdout.write(f"{name:14} {value}{asked}\n")
    return 1 if missed(figures) else 0


def missed(figures: Figures) -> list[str]:
    """Return the names of the promises that were not kept."""
    wrong = [name for name, bound in ASKED.items() if not getattr(figures, name) <= bound]
    wrong += [name for name in ("complaints", "strangers") if getattr(figures, name)]
    wrong += [] if figures.replay_equal else ["replay_equal"]
    return wrong + ([] if figures.commanded.startswith("obeyed") else ["commanded"])


def measure(config: Path, seconds: float, pictures: Path | None) -> Figures:
    """Fly for `seconds` s and look at the page meanwhile."""
    with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
        run = Path(place) / "run"
        with _console(config, run) as (url, server), opened(url) as page:
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
            return Figures(
                lag, memory, share, page.complaints, page.strangers, replayed == (live, values), commanded
            )


@contextlib.contextmanager
def _console(config: Path, run: Path) -> Iterator[tuple[str, int]]:
    """Yield the console's address and its process."""
    words = [sys.executable, "-m", "flight", "console", str(run), "--fly", str(config), "--port", "0"]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        said = server.stdout.readline()
        found = re.search(r"http://\S+", said)
        if found is None:
            raise RuntimeError(f"the console did not start: {said}")
        yield found[0], server.pid
    finally:
        server.terminate()
        server.wait(timeout=30)


def _lag(page: Page, tail: LogTail, seconds: float) -> float:
    """Return the greatest distance of the page behind the log, s, of looks five times a second."""
    newest, worst, until = 0.0, 0.0, time.monotonic() + seconds
    while time.monotonic() < until:
        packets = tail.new()
        newest = max([newest, *(1e-9 * float(rows["time_ns"][-1]) for rows in packets.values() if len(rows))])
        shown = float(page.page.evaluate("document.body.dataset.time"))
        worst = max(worst, newest - shown)
        time.sleep(0.2)
    return worst


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
