"""A simulated flight of the console's own, on the machine's clock; the page commands it."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from flight.link.telemetry.log import find_segments
from flight.schema.document import read_text
from flight.schema.reader import parse
from flight.schema.sections import Commands
from knightcube.errors import FlightError, UsageError

_START_S, _END_S = 60.0, 15.0
_FRAMES = 60
"""That the flight keeps for the page."""
_CAMERA = re.compile(r"(?m)^(camera:[^\n]*)$(?!(?:\n[ #][^\n]*)*?\n  keep_frames:)(?=\n  )")
"""The head of a camera's section that does not say how many."""


@contextlib.contextmanager
def flying(config: Path, out: Path) -> Iterator[str]:
    """Fly a simulated configuration into `out`, and yield its command socket; leaving ends the flight.

    Raises FlightError.
    """
    text = read_text(config)
    parsed = parse(text, str(config))
    if parsed.simulation is None:
        raise UsageError(f"{config}: flies real devices; start it by itself, and give the console its run")
    with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
        socket = f"{place}/commands"
        if parsed.commands != Commands():
            raise UsageError(f"{config}: has `commands`; start it by itself, and give the console --to")
        own = Path(place) / config.name
        text = _CAMERA.sub(rf"\1\n  keep_frames: {_FRAMES}", text)
        own.write_text(f"{text}\ncommands: {{socket: {socket}}}\n", encoding="utf-8")
        words = [sys.executable, "-m", "flight", "run", str(own), "--realtime", "--out", str(out)]
        flight = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            _wait_for_log(flight, out)
            yield socket
        finally:
            flight.send_signal(signal.SIGTERM)
            try:
                flight.communicate(timeout=_END_S)
            except subprocess.TimeoutExpired:
                flight.kill()
                flight.communicate()


def _wait_for_log(flight: subprocess.Popen[str], out: Path) -> None:
    until = time.monotonic() + _START_S
    while not (out.is_dir() and find_segments(out, "flight")):
        if flight.poll() is not None:
            raise FlightError(f"the flight did not start: {flight.communicate()[1].strip()}")
        if time.monotonic() > until:
            raise FlightError(f"{out}: no flight log after {_START_S:g} s")
        time.sleep(0.05)
