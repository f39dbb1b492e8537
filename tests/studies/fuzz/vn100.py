"""Mutated packets and sentences of the VN-100, in pieces of any size, through its parser and its driver.

Accepted corruption is: an item whose bytes with their checksum do not stand in what was sent, by a second
parser that looks at every byte and has its own checksums; a reading that is not finite or beyond the ranges
that the driver was given; a byte that is not accounted for. A packet that stood whole in the stream and did
not come out, though nothing else that came out covers it, is a finding too.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from hal.drivers.vn100.driver import Vn100
from hal.drivers.vn100.protocol import HEADER_LENGTHS, AsciiLine, BinaryPacket, StreamParser, layout_of_header
from tests.hal.vn100.bench_line import MISSION
from tests.manual_clock import ManualClock
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, chance, damage, integer
from tests.studies.fuzz.vn100_packets import LONGEST, checksum, good_packet, hostile, real_packets, sentence

_POOL = 400
_LINE = re.compile(rb"\$(VN[\x20-\x23\x25-\x29\x2b-\x7e]*)\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})\r?\n")


@dataclass(frozen=True, slots=True)
class Candidate:
    """A packet that stands in the stream with a right checksum."""

    start: int
    stop: int
    header: bytes
    values: str


def candidates(stream: bytes) -> list[Candidate]:
    """Return every stretch of a stream that is a packet, overlapping ones too."""
    found = []
    start = stream.find(b"\xfa")
    while start >= 0:
        length = HEADER_LENGTHS[stream[start + 1]] if start + 1 < len(stream) else 0
        header = stream[start + 1 : start + 1 + length]
        layout = layout_of_header(header) if length and len(header) == length else None
        if layout is not None and layout.length <= LONGEST and start + layout.length <= len(stream):
            raw = stream[start : start + layout.length]
            if checksum(raw[1:-2]) == int.from_bytes(raw[-2:], "big"):
                values = layout.payload.unpack(raw[1 + length : -2])
                found.append(Candidate(start, start + layout.length, header, repr(values)))
        start = stream.find(b"\xfa", start + 1)
    return found


def sentences(stream: bytes) -> set[str]:
    """Return the bodies of all sentences of a stream whose checksum holds."""
    found = set()
    for match in _LINE.finditer(stream):
        body, digits = match[1], match[2]
        parity = 0
        for byte in body:
            parity ^= byte
        if int(digits, 16) == (parity if len(digits) == 2 else checksum(body)):
            found.add(body.decode("ascii"))
    return found


class ScriptedPort:
    """A serial line that gives what it was given."""

    baud_rate = 115_200

    def __init__(self) -> None:
        self.chunks: list[tuple[int, bytes]] = []

    def receive(self) -> list[tuple[int, bytes]]:
        """Return what has come."""
        chunks, self.chunks = self.chunks, []
        return chunks

    def send(self, data: bytes) -> None:
        """Take no notice."""

    def set_baud_rate(self, baud_rate: int) -> None:
        """Take no notice."""

    def close(self) -> None:
        """Close nothing."""


class Vn100Bytes:
    """The target."""

    def __init__(self) -> None:
        draw = np.random.default_rng(20260115)
        self._packets = real_packets() + [good_packet(draw) for _ in range(_POOL)]
        self._lines = [sentence(draw) for _ in range(_POOL)]
        self._stream = b""
        self._settings = replace(MISSION, configure=False)

    def last(self) -> str:
        """Return the last stream in hexadecimal."""
        return self._stream.hex()

    def attempt(self, draw: Draw) -> Counter[str]:
        """Feed one stream of some packets, some of them damaged."""
        pieces = [self._piece(draw) for _ in range(integer(draw, 1, 10))]
        # Zeros end every candidate that is still open.
        self._stream = stream = b"".join(data for data, _ in pieces) + bytes(LONGEST + 300)
        chunks = _chunks(draw, stream)
        tally = self._parse(stream, chunks, pieces)
        tally["readings"] = self._drive(chunks)
        return tally

    def _piece(self, draw: Draw) -> tuple[bytes, bool]:
        """Return a stretch of the stream, and whether it is a packet that nothing has happened to."""
        pool = self._lines if chance(draw, 0.15) else self._packets
        data = pool[integer(draw, 0, len(pool) - 1)]
        fate = draw.random()
        if fate < 0.4:
            return data, pool is self._packets
        if fate < 0.5:
            return draw.bytes(integer(draw, 1, 60)), False
        if fate < 0.6 and pool is self._packets:
            return hostile(draw, data), False
        for _ in range(integer(draw, 1, 3)):
            data = damage(draw, data)
        return data, False

    def _parse(
        self, stream: bytes, chunks: list[tuple[int, bytes]], pieces: list[tuple[bytes, bool]]
    ) -> Counter[str]:
        parser = StreamParser(86_806.0, LONGEST)
        items = [item for arrival_ns, chunk in chunks for item in parser.feed(arrival_ns, chunk)]
        known, bodies = candidates(stream), sentences(stream)
        taken: list[Candidate] = []
        accounted = parser.discarded_bytes
        at = 0
        for item in items:
            if isinstance(item, BinaryPacket):
                accounted += item.layout.length
                match = _next(known, at, item)
                if match is None:
                    raise Finding(f"packet {item.layout.header.hex()} that nobody sent")
                taken.append(match)
                at = match.stop
            else:
                accounted += item.length
                if _body(item) not in bodies:
                    raise Finding(f"sentence {_body(item)!r} that nobody sent")
        if not 0 <= parser.bytes_received - accounted <= LONGEST or parser.bytes_received != len(stream):
            raise Finding(f"{accounted} of {len(stream)} bytes accounted for")
        whole = _whole_places(pieces)
        for start, stop in whole:
            if not any(c.start < stop and start < c.stop for c in taken):
                raise Finding(f"the whole packet at byte {start} did not come out")
        return Counter(
            bytes=sum(len(data) for data, _ in pieces),
            packets=len(taken),
            lines=len(items) - len(taken),
            whole=len(whole),
        )

    def _drive(self, chunks: list[tuple[int, bytes]]) -> int:
        """Have the driver read the stream; returns the readings it gave."""
        port, settings = ScriptedPort(), self._settings
        driver = Vn100(port, ManualClock(), settings)
        port.chunks = chunks
        readings = driver.poll()
        for reading in readings:
            values = np.concatenate([reading.quaternion, reading.rate, reading.field, reading.acceleration])
            if not np.isfinite(values).all():
                raise Finding("a reading that is not finite")
            if (
                abs(np.linalg.norm(reading.quaternion) - 1.0) > 1e-12
                or np.max(np.abs(reading.rate)) > settings.rate_range
                or np.max(np.abs(reading.field)) > settings.field_range * (1.0 + 1e-12)
                or np.max(np.abs(reading.acceleration)) > settings.acceleration_range
            ):
                raise Finding("a reading beyond the ranges of the unit")
        link = driver.link()
        if len(readings) + link.out_of_range + link.not_finite > link.packets:
            raise Finding("more readings than packets")
        return len(readings)


def _next(known: list[Candidate], at: int, item: BinaryPacket) -> Candidate | None:
    values = repr(item.values)
    return next(
        (c for c in known if c.start >= at and c.header == item.layout.header and c.values == values), None
    )


def _body(line: AsciiLine) -> str:
    return ",".join(("VN" + line.sentence.command, *line.sentence.fields))


def _whole_places(pieces: list[tuple[bytes, bool]]) -> list[tuple[int, int]]:
    places, position = [], 0
    for data, whole in pieces:
        if whole:
            places.append((position, position + len(data)))
        position += len(data)
    return places


def _chunks(draw: Draw, stream: bytes) -> list[tuple[int, bytes]]:
    """Return the stream in pieces, with times."""
    chunks, position, time_ns = [], 0, 1_000_000_000
    while position < len(stream):
        size = integer(draw, 1, 200 if chance(draw, 0.8) else 3)
        time_ns += size * 86_806
        chunks.append((time_ns, stream[position : position + size]))
        position += size
    return chunks
