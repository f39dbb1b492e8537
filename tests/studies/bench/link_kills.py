"""Link killed between accepting, storing and forwarding commands.

In each run, a link process receives the commands of a ground station while an attacker replays all old
frames. The link process is killed (SIGKILL) before or after one of its calls that write to the disk or to the
socket of the flight. In some runs, the last write before the kill is cut in the middle. The ground's sender
is killed in the same way. The benchmark counts commands that the flight received twice, and frame counters
that were used twice.

With `--scheduled` the commands are in the link's schedule and fall due while the link process is killed. A
second process, which is not killed, continues. The benchmark counts commands that the flight received twice,
commands that it never received (each kill may cost one), and schedules without an intact copy.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flight.link.commands import CommandPacker, DatagramChannel, Ping, open_unix, unpack
from flight.link.events import Mode
from flight.link.frames import TELECOMMAND_HEADER, TELEMETRY_HEADER
from flight.link.process.commanding import ControlLine, Sent, Timetable
from flight.link.process.downlink import LogFollower
from flight.link.process.station import TURN_NS, Station, StationSettings
from flight.link.security import Vault
from flight.link.telemetry.definitions import MODE
from flight.link.telemetry.packets import Packer
from ground.link.terminal import Terminal, TerminalSettings, make_keys
from tests.flight.link.process.both_ends import SETTINGS, GroundWire, Wire
from tests.manual_clock import ManualClock
from tests.studies.command import Seed, command, say, scratch

_AT_ONCE = 3
_SENDER_POINTS = 5 * _AT_ONCE + 1
_LINK_POINTS = 5 * _AT_ONCE + 8
"""Number of calls that write: five for each command, and the calls for telemetry."""

_OLD = 40
_RATE = 1e6


@dataclass
class Findings:
    """Counts of commands, frames and schedules after the kills.

    Attributes:
        kills: processes that were killed.
        scheduled: commands that were put into the schedule.
        schedules_lost: schedules of which no intact copy remained.
        counters_twice: counter values, in either direction, with which two different frames were sent.
        seen: sent frames by SPI and IV.
        obeyed: how often the flight received each command, by the number in the command `ping`.
    """

    kills: int = 0
    scheduled: int = 0
    schedules_lost: int = 0
    counters_twice: int = 0
    seen: dict[bytes, bytes] = field(default_factory=dict)
    obeyed: Counter[int] = field(default_factory=Counter)

    @property
    def obeyed_twice(self) -> int:
        """Number of commands that the flight received although it had received them before."""
        return self.obeyed.total() - len(self.obeyed)

    @property
    def never(self) -> int:
        """Number of scheduled commands that the flight never received."""
        return self.scheduled - len(self.obeyed)

    def note(self, frames: Sequence[bytes], header_bytes: int) -> None:
        """Record the counters of frames."""
        for frame in frames:
            identifier = frame[header_bytes : header_bytes + 14]  # SPI and IV
            known = self.seen.setdefault(identifier, frame)
            self.counters_twice += known != frame

    def receive(self, flight: DatagramChannel) -> None:
        """Record the commands that the flight has received since the last call."""
        while got := flight.poll():
            commands = [unpack(data) for data, _ in got]
            self.obeyed.update(command.number for command in commands if isinstance(command, Ping))


@command
def main(
    *,
    kills: Annotated[int, "of the link"] = 1000,
    seed: Seed = 1,
    scheduled: Annotated[bool, "kill while scheduled commands fall due"] = False,
) -> int:
    """Kill the processes and print the counts.

    Returns 0 if the flight received no command twice and each kill cost at most one command.
    """
    with scratch() as place:
        found = (measure_scheduled if scheduled else measure)(place, kills, seed)
    facts: dict[str, Any]
    if scheduled:
        facts = {"scheduled": found.scheduled, "never": found.never, "schedules_lost": found.schedules_lost}
    else:
        facts = {"frames": len(found.seen), "counters_twice": found.counters_twice}
    say(kills=found.kills, commands=len(found.obeyed), obeyed_twice=found.obeyed_twice, **facts)
    twice = found.obeyed_twice + found.counters_twice + found.schedules_lost
    return int(twice > 0 or found.never > found.kills or not found.obeyed)


def measure(place: Path, kills: int, seed: int) -> Findings:
    """Kill the link and the sender alternately, `kills` times each."""
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
        served = killed(partial(_serve, place, [*first, *shuffled], 20), point, torn)
        found.note(served, TELEMETRY_HEADER.size)
        found.receive(flight)
        found.kills += 2
    flight.close()
    return found


def measure_scheduled(place: Path, kills: int, seed: int) -> Findings:
    """Schedule three commands and kill the link that executes them, `kills` times. Returns the counts."""
    make_keys(place / "keys")
    run = place / "run-000001"
    run.mkdir()
    fields = {"before": 0, "mode": int(Mode.HOLD), "trigger": "start", "reason": "", "target_q2": 0.0}
    (run / "flight-0001.ccsds").write_bytes(Packer().pack(MODE, 1, fields))
    folder, flight = Vault(place / "keys" / "satellite").folder, open_unix(place / "commands")
    draw, found = np.random.default_rng(seed), Findings()
    due_ns = ManualClock().utc_ns() + 2 * TURN_NS
    for _ in range(kills):
        table = Timetable(folder)
        found.schedules_lost += table.lost
        for _ in range(_AT_ONCE):
            table.add(due_ns, 1, 0, f"ping {found.scheduled}")
            found.scheduled += 1
        killed(partial(_serve, place, None, 6), int(draw.integers(0, _LINK_POINTS)), bool(draw.integers(2)))
        found.kills += 1
        found.receive(flight)
        killed(partial(_serve, place, None, 6), sys.maxsize, torn=False)
        found.receive(flight)
    flight.close()
    return found


class Way:
    """Wrapper of the writing calls of a process, which kills the process at one of them."""

    def __init__(self, point: int, torn: bool, writer: socket.socket) -> None:
        self._left = point
        self._torn = torn
        self._writer = writer

    def arm(self) -> None:
        """Replace the writing calls of this process, so that `call` counts them."""
        pwrite, fsync, sendto = os.pwrite, os.fsync, socket.socket.sendto

        def written(file: int, data: bytes, offset: int) -> Any:
            part = data[: len(data) // 2] if self._torn else data
            return self.call(partial(pwrite, file, data, offset), partial(pwrite, file, part, offset))

        def sent(line: socket.socket, data: bytes, address: str) -> Any:
            send = partial(sendto, line, data, address)
            return self.call(send, send if self._torn else None)

        os.pwrite = written  # type: ignore[assignment]  # of this process alone
        os.fsync = lambda fd: self.call(partial(fsync, fd))
        socket.socket.sendto = sent  # type: ignore[method-assign, assignment]  # of this process alone

    def call(self, whole: Callable[[], Any], last: Callable[[], Any] | None = None) -> Any:
        """Make a call; if a kill is due, make the call `last` and end the process as kill -9 does."""
        self._left -= 1
        if self._left < 0:
            if last is not None:
                last()
            os.kill(os.getpid(), signal.SIGKILL)
        return whole()

    def put(self, frame: bytes) -> None:
        """Send a frame over the air; if a kill is due, the frame is not sent."""
        self.call(partial(self._writer.send, frame))


class _SkyWire(Wire):
    """Line of the link that sends each frame to the parent process."""

    def __init__(self, way: Way, frames: list[bytes]) -> None:
        super().__init__()
        self.up = frames
        self._way = way

    def send(self, frames: Sequence[bytes], now_ns: int) -> int:
        for frame in frames:
            self._way.put(frame)
        return len(frames)


class _GroundOut(GroundWire):
    """Line of the ground station that sends each frame to the parent process."""

    def __init__(self, way: Way) -> None:
        super().__init__(Wire())
        self._way = way

    def send(self, frame: bytes) -> None:
        self._way.put(frame)


def killed(work: Callable[[Way], None], point: int, torn: bool) -> list[bytes]:
    """Run `work` in a process that is killed at its call `point`; return the frames that it sent before.

    Calls that write to the disk or send are counted. With `torn` the last write is cut in the middle.
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
        sent = number * _AT_ONCE + count
        terminal.send(CommandPacker().pack(Ping(sent), sent))


def _serve(place: Path, frames: list[bytes] | None, turns: int, way: Way) -> None:
    """Run the link process for a number of rounds, in which it receives `frames`."""
    control: ControlLine[Sent] = ControlLine(place / "commands", place)
    clock = ManualClock()
    settings = StationSettings(SETTINGS.spacecraft, SETTINGS.frame_bytes, _RATE)
    vault = Vault(place / "keys" / "satellite")
    wires = [_SkyWire(way, frames)] if frames is not None else []
    station = Station(settings, vault, wires, control, LogFollower(place), clock)
    for _ in range(turns):
        station.turn()
        clock.advance(TURN_NS)
