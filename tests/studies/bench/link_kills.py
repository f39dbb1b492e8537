"""The link killed between accepting, storing and handing over: python -m tests.studies.bench link_kills.

Each time a link process takes the commands of a ground while an attacker sends every old frame again, and is
killed (SIGKILL) before or after one of its calls that write to the disk or to the socket of the flight;
some of the writes are cut in the middle first. The ground's sender is killed in the same way. Counted
are commands that the flight got twice, and counters that two frames have.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from flight.link.commands import CommandPacker, Ping, open_unix
from flight.link.frames import TELECOMMAND_HEADER, TELEMETRY_HEADER
from flight.link.process.commanding import ControlLine, Sent
from flight.link.process.downlink import LogFollower
from flight.link.process.station import TURN_NS, Station, StationSettings
from flight.link.security import Vault
from ground.link.terminal import Terminal, TerminalSettings, make_keys
from tests.flight.link.process.both_ends import SETTINGS, GroundWire, Wire
from tests.manual_clock import ManualClock

_AT_ONCE = 3
_SENDER_POINTS = 5 * _AT_ONCE + 1
_LINK_POINTS = 5 * _AT_ONCE + 8
"""Calls that write: per command two copies with two calls each and a send; the same of telemetry."""

_OLD = 40
_RATE = 1e6


@dataclass
class Findings:
    """What came of the kills.

    Attributes:
        kills: of the link and of the sender.
        counters_twice: counters, of either direction, under which two different frames were seen.
        seen: frames by SPI and IV.
        obeyed: how often the flight got each command.
    """

    kills: int = 0
    counters_twice: int = 0
    seen: dict[bytes, bytes] = field(default_factory=dict)
    obeyed: Counter[bytes] = field(default_factory=Counter)

    @property
    def obeyed_twice(self) -> int:
        """How often the flight got a command that it had got before."""
        return self.obeyed.total() - len(self.obeyed)

    def note(self, frames: Sequence[bytes], header_bytes: int) -> None:
        """Take note of the counters of frames."""
        for frame in frames:
            identifier = frame[header_bytes : header_bytes + 14]  # SPI and IV
            known = self.seen.setdefault(identifier, frame)
            self.counters_twice += known != frame


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill, count, print; return 0 when nothing was obeyed or used twice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000, metavar="N", help="of the link (default 1000)")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
        found = measure(Path(place), options.kills, options.seed)
    facts = {
        "kills": found.kills,
        "commands": len(found.obeyed),
        "obeyed_twice": found.obeyed_twice,
        "frames": len(found.seen),
        "counters_twice": found.counters_twice,
    }
    sys.stdout.write(json.dumps(facts) + "\n")
    return int(found.obeyed_twice + found.counters_twice > 0 or not found.obeyed)


def measure(place: Path, kills: int, seed: int) -> Findings:
    """Kill the link and the sender `kills` times each, in turn."""
    make_keys(place / "keys")
    flight = open_unix(place / "commands")
    draw, found, frames = np.random.default_rng(seed), Findings(), list[bytes]()
    for number in range(kills):
        point, torn = int(draw.integers(0, _SENDER_POINTS)), bool(draw.integers(2))
        new = killed(partial(_send, place, number), point, torn)
        found.note(new, TELECOMMAND_HEADER.size)
        frames = (frames + new)[-_OLD:]
        shuffled = [frames[index] for index in draw.permutation(len(frames)).tolist()]
        point, torn = int(draw.integers(0, _LINK_POINTS)), bool(draw.integers(2))
        first = new if draw.integers(2) else []
        found.note(killed(partial(_serve, place, [*first, *shuffled]), point, torn), TELEMETRY_HEADER.size)
        while got := flight.poll():
            found.obeyed.update(data for data, _ in got)
        found.kills += 2
    flight.close()
    return found


class Way:
    """The calls of a process that is killed at one of them."""

    def __init__(self, point: int, torn: bool, writer: socket.socket) -> None:
        self._left = point
        self._torn = torn
        self._writer = writer
        self._pwrite, self._fsync, self._sendto = os.pwrite, os.fsync, socket.socket.sendto

    def arm(self) -> None:
        """Have the calls of this process go this way."""
        os.pwrite, os.fsync = self.pwrite, self.fsync  # type: ignore[assignment]  # of this process alone
        way = self

        def sendto(line: socket.socket, data: bytes, address: str) -> int:
            if way.ends():
                if way._torn:
                    way._sendto(line, data, address)
                way.die()
            return way._sendto(line, data, address)

        socket.socket.sendto = sendto  # type: ignore[method-assign, assignment]  # of this process alone

    def ends(self) -> bool:
        """Return whether this call is the last."""
        self._left -= 1
        return self._left < 0

    def die(self) -> None:
        """End as kill -9 ends a process."""
        os.kill(os.getpid(), signal.SIGKILL)

    def pwrite(self, file: int, data: bytes, offset: int) -> int:
        """Write, or write half or all and die."""
        if self.ends():
            self._pwrite(file, data[: len(data) // 2] if self._torn else data, offset)
            self.die()
        return self._pwrite(file, data, offset)

    def fsync(self, file: int) -> None:
        """Sync, or die before."""
        if self.ends():
            self.die()
        self._fsync(file)

    def put(self, frame: bytes) -> None:
        """Send a frame over the air, or die before."""
        if self.ends():
            self.die()
        self._writer.send(frame)


class _SkyWire(Wire):
    """The link's line, whose frames leave the process one by one."""

    def __init__(self, way: Way, frames: list[bytes]) -> None:
        super().__init__()
        self.up = frames
        self._way = way

    def send(self, frames: Sequence[bytes], now_ns: int) -> None:
        for frame in frames:
            self._way.put(frame)


class _GroundOut(GroundWire):
    """The ground's line, whose frames also leave the process one by one."""

    def __init__(self, way: Way) -> None:
        super().__init__(Wire())
        self._way = way

    def send(self, frame: bytes) -> None:
        self._way.put(frame)


def killed(work: Callable[[Way], None], point: int, torn: bool) -> list[bytes]:
    """Do work in a process that is killed at its call number `point`; return the frames that left it before.

    Calls are those that write to the disk or send; `torn` cuts a write in the middle.
    """
    reader, writer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    child = os.fork()
    if child == 0:
        try:
            way = Way(point, torn, writer)
            way.arm()
            work(way)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    writer.close()
    frames = []
    while data := reader.recv(1 << 12):
        frames.append(data)
    reader.close()
    os.waitpid(child, 0)
    return frames


def _send(place: Path, number: int, way: Way) -> None:
    """Send three commands from the ground."""
    terminal = Terminal(_GroundOut(way), Vault(place / "keys" / "ground"), TerminalSettings())
    for count in range(_AT_ONCE):
        terminal.send(CommandPacker().pack(Ping(count), number * _AT_ONCE + count))


def _serve(place: Path, frames: list[bytes], way: Way) -> None:
    """Serve as the link for a moment, with these frames coming in."""
    control: ControlLine[Sent] = ControlLine(place / "commands", place)
    clock = ManualClock()
    settings = StationSettings(SETTINGS.spacecraft, SETTINGS.frame_bytes, _RATE)
    vault = Vault(place / "keys" / "satellite")
    station = Station(settings, vault, [_SkyWire(way, frames)], control, LogFollower(place), clock)
    for _ in range(20):
        station.turn()
        clock.advance(TURN_NS)


if __name__ == "__main__":
    raise SystemExit(main())
