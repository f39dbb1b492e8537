"""Damaged segments of a flight log through scanner, reader and report.

Accepted corruption is a packet that was never written. A CRC of 16 bits lets one in 65,536 of the packets
through that are damaged beyond four bits: such a packet is recognised by a CRC of this module's own, counted,
and the campaign fails when there are more of them than chance allows. So that the report meets wrong values
too, some packets carry random ones under a right CRC: those were written.
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import tempfile
import weakref
from collections import Counter
from pathlib import Path
from unittest import mock

from flight.link.telemetry.packets import LAYOUTS
from ground import report as reporting
from ground.telemetry import Run, ScanResult, read_run, scan
from knightcube.errors import UsageError
from tests.ground.report.synthetic import Recipe, make_run
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, chance, damage, integer
from tests.studies.fuzz.vn100_packets import checksum

_DRAWN, _SAVED = 0.004, 0.05

STEMS = ("flight", "truth", "performance")
_RECIPES = (
    Recipe(duration=12.0, planned=12.0, hold=3.0, rate_hz=4.0),
    Recipe(duration=30.0, hold=10.0, rate_hz=1.0, truth=False),
    Recipe(duration=5.0, hold=2.0, rate_hz=10.0, identity=False, performance=False),
)


def ccitt(data: bytes) -> int:
    """Return the CRC-16 of CCSDS 232.0-B: the VN-100's, but for its preset."""
    return checksum(data, 0xFFFF)


def split(data: bytes) -> list[bytes]:
    """Return the packets of an undamaged log."""
    packets, position = [], 0
    while position < len(data):
        length = int.from_bytes(data[position + 4 : position + 6], "big") + 7
        packets.append(data[position : position + length])
        position += length
    return packets


class Logs:
    """The target."""

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as place:
            runs = [make_run(Path(place) / str(i), recipe) for i, recipe in enumerate(_RECIPES)]
            self._logs = [
                {stem: split(b"".join(path.read_bytes() for path in run.glob(f"{stem}-*"))) for stem in STEMS}
                for run in runs
            ]
        self._folder = Path(tempfile.mkdtemp())
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._data: dict[str, bytes] = {}

    def last(self) -> str:
        """Return the last flight log in hexadecimal."""
        return self._data.get("flight", b"").hex()

    def attempt(self, draw: Draw) -> Counter[str]:
        """Read and report one damaged run."""
        logs = self._logs[integer(draw, 0, len(self._logs) - 1)]
        results, tally = {}, Counter[str]()
        for stem in STEMS:
            self._data[stem], written, damaged = _damaged(draw, logs[stem])
            results[stem] = scan(self._data[stem])
            tally += _judge(results[stem], written)
            tally += Counter(bytes=len(self._data[stem]), damaged=damaged)
        if chance(draw, 0.05):
            tally += self._read(draw)
        run = Run(self._folder / "none", results["flight"], results["truth"], results["performance"])
        summary = reporting.summarise(run)
        json.dumps(summary, allow_nan=False)
        text = reporting.format_report(summary)
        if not text.endswith("\n") or "Log integrity" not in text:
            raise Finding("a report without its end")
        if chance(draw, _DRAWN):
            tally += self._draw(draw, run)
        return tally + Counter(reports=1)

    def _draw(self, draw: Draw, run: Run) -> Counter[str]:
        """Have the pictures drawn; most are not saved, which is matplotlib's work and takes long."""
        saved = chance(draw, _SAVED)
        unsaved = mock.patch("matplotlib.figure.Figure.savefig")
        with contextlib.nullcontext() if saved else unsaved:
            pictures = reporting.draw(run, self._folder / "figures")
        shutil.rmtree(self._folder / "figures")
        return Counter(drawn=len(pictures), saved=len(pictures) * saved)

    def _read(self, draw: Draw) -> Counter[str]:
        """Have the reader read the run from segments cut anywhere; it finds what the scanner found."""
        for old in self._folder.glob("*"):
            old.unlink()
        cut = integer(draw, 0, len(self._data["flight"]))
        for number, part in enumerate((self._data["flight"][:cut], self._data["flight"][cut:])):
            (self._folder / f"flight-{number + 1:04d}.ccsds").write_bytes(part)
        with contextlib.suppress(UsageError):  # not one valid packet
            if read_run(self._folder).flight.counts != scan(self._data["flight"]).counts:
                raise Finding("segments read otherwise than the bytes in them")
        return Counter(read=1)


def _damaged(draw: Draw, packets: list[bytes]) -> tuple[bytes, set[bytes], int]:
    """Return a stretch of a log with damage, what was written, and how many packets were damaged."""
    first = integer(draw, 0, max(len(packets) - 5, 0)) if chance(draw, 0.5) else 0
    pieces = packets[first : first + integer(draw, 0, 60)]
    pieces = [hostile(draw, piece) if chance(draw, 0.05) else piece for piece in pieces]
    written = set(pieces)
    damaged = 0
    rate = (0.0, 0.02, 0.3)[integer(draw, 0, 2)]
    for index, piece in enumerate(pieces):
        if chance(draw, rate):
            pieces[index] = damage(draw, piece)
            damaged += 1
    if chance(draw, 0.2):
        draw.shuffle(pieces)
    data = b"".join(pieces)
    if chance(draw, 0.5):
        data = damage(draw, data)
        damaged += 2
    return data, written, damaged


def hostile(draw: Draw, packet: bytes) -> bytes:
    """Return a packet with wrong values, or of another version, under a right CRC."""
    body = bytearray(packet[:-2])
    start = integer(draw, 6, len(body) - 1)
    worst = (
        b"\x7f\xf8\0\0\0\0\0\0",
        b"\x7f\xf0\0\0\0\0\0\0",
        b"\xff" * 8,
        bytes(8),
        b"\x80" + bytes(7),
        draw.bytes(8),
    )
    value = worst[integer(draw, 0, len(worst) - 1)]
    body[start : start + 8] = value[: len(body) - start]
    return bytes(body) + ccitt(bytes(body)).to_bytes(2, "big")


def _judge(result: ScanResult, written: set[bytes]) -> Counter[str]:
    """Compare what was found with what was written."""
    claimed = sum(len(array) * LAYOUTS[name].length for name, array in result.packets.items())
    others = result.total_bytes - claimed - result.skipped_bytes - result.truncated_bytes
    if min(result.skipped_bytes, result.truncated_bytes, others) < 0 or (others == 0) != (
        result.other_versions == 0
    ):
        raise Finding("bytes that are not accounted for")
    collisions = found = 0
    for name, array in result.packets.items():
        raw = array.tobytes()
        length = LAYOUTS[name].length
        for start in range(0, len(raw), length):
            packet = raw[start : start + length]
            found += 1
            if packet not in written:
                if ccitt(packet) != 0:
                    raise Finding(f"a {name} packet with a wrong CRC")
                collisions += 1
    return Counter(packets=found, collisions=collisions)


def collisions_allowed(damaged: int) -> float:
    """Return how many damaged packets may pass a CRC of 16 bits, five standard deviations included.

    Each damaged packet may be tried at several places in a damaged stretch: twice is counted.
    """
    expected = 2.0 * damaged / 65_536.0
    return expected + 5.0 * math.sqrt(expected) + 1.0
