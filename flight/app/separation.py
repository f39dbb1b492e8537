"""Separation inhibit: coils and transmitter stay off for a configured time after the first power-up.

Launch providers require this time. The CubeSat Design Specification allows no transmission within 45 minutes
after the deployment. The time with power is counted in a file, so that a restart neither ends the inhibit nor
begins it again. Flight and link count separately, each in its own folder.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from pathlib import Path

from flight.link.regular_files import read_regular
from flight.loop.state import LinuxFiles, replace_file
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.errors import FlightError

_LARGEST_FILE = 64


class InhibitedError(FlightError):
    """Raised while the separation inhibit lasts. The error text states the remaining time."""


class SeparationInhibit:
    """Counter of the time with power since the first power-up.

    A damaged or missing file counts as the first power-up, because coils that are off too long are the
    smaller harm.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._counted_ns = clock.now_ns()
        self._elapsed: float | None = None

    def check(self, folder: Path, seconds: float) -> None:
        """Raise InhibitedError unless the satellite has had power for `seconds` s.

        The counted time is stored in `folder` at each call until it is complete.
        """
        if seconds == 0.0:
            return
        path = folder / "powered"
        if self._elapsed is None:
            self._elapsed = _stored(path)
        now_ns = self._clock.now_ns()
        stored = self._elapsed
        self._elapsed += (now_ns - self._counted_ns) / SECOND_NS
        self._counted_ns = now_ns
        if stored < seconds:
            with suppress(OSError):  # a disk that cannot be written only prolongs the inhibit at a restart
                folder.mkdir(parents=True, exist_ok=True)
                replace_file(LinuxFiles(), path, _record(self._elapsed))
        if (left := seconds - self._elapsed) > 0.0:
            raise InhibitedError(f"separation inhibit of {seconds:g} s: {left:.0f} s with power are left")


def _record(elapsed: float) -> bytes:
    text = f"{elapsed:.1f}".encode()
    return text + b" %08x\n" % zlib.crc32(text)


def _stored(path: Path) -> float:
    """Return the stored time with power, s, or 0 if the file is missing or damaged."""
    with suppress(OSError, ValueError):
        text, _, crc = (read_regular(path, _LARGEST_FILE) or b"").partition(b" ")
        if crc == b"%08x\n" % zlib.crc32(text):
            return float(text)
    return 0.0
