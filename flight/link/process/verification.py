"""Hand-over of commands to the control process, and verification of each command (PUS service 1).

A command is accepted or refused, started, and completed or failed. Each command is sent from a socket of
its own, so that no answer can be assigned to another command. The control process answers a command when it
has obeyed it. A command that ends in a mode is completed when the mode packet of the live telemetry shows
that mode. It has failed if the mode becomes SAFE or if another command replaces it. A slew is completed
when it has arrived, and has failed in any other mode.
"""

from __future__ import annotations

import socket
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from flight.link.commands.codec import ChangeMode, Command, Point, Slew
from flight.link.modes import Mode
from flight.link.telemetry.definitions import COMMAND, MODE
from flight.link.telemetry.packets import LAYOUTS, LONGEST_PACKET, to_text, walk

_ARRIVED = "arrived"  # the trigger of the mode packet (flight.loop.modes)


class Stage(IntEnum):
    """Stage of a command; the numbers are those of the verification packet."""

    ACCEPTED = 1
    REFUSED = 2
    STARTED = 3
    COMPLETED = 4
    FAILED = 5

    @property
    def final(self) -> bool:
        """Whether this is the last stage of a command."""
        return self in {Stage.REFUSED, Stage.COMPLETED, Stage.FAILED}


class Request(NamedTuple):
    """Identification of a command packet for its sender: the first 16 bits and the sequence count."""

    packet: int
    sequence: int


UNREAD = Request(0, 0)
"""Request of a frame whose packet was not read."""


def request_of(packet: bytes) -> Request:
    """Return the identification of a command packet."""
    return Request(int.from_bytes(packet[:2], "big"), int.from_bytes(packet[2:4], "big") & 0x3FFF)


@dataclass(frozen=True, slots=True)
class Sent:
    """A command that was handed over, with SPI and counter of its frame."""

    spi: int
    counter: int
    command: Command
    request: Request = UNREAD


@dataclass(frozen=True, slots=True)
class Report:
    """The fields of a verification packet."""

    spi: int
    counter: int
    stage: Stage
    name: str
    text: str
    request: Request = UNREAD


def report(sent: Sent, stage: Stage, text: str) -> Report:
    """Return the report that a command has reached a stage."""
    return Report(sent.spi, sent.counter, stage, sent.command.packet.name, text, sent.request)


def final_mode(command: Command) -> Mode | None:
    """Return the mode in which a command is completed, None if it is completed at once."""
    match command:
        case ChangeMode(mode):
            return mode
        case Slew():
            return Mode.HOLD
        case Point():
            return Mode.POINT
        case _:
            return None


class Verification:
    """Follows the stages of commands that were handed over."""

    def __init__(self) -> None:
        self._open: tuple[Sent, Mode, int] | None = None  # with the mode it ends in, and since when

    def answered(self, sent: Sent, answer: bytes) -> list[Report]:
        """Return the reports for an answer of the control process; b"" stands for a missing answer."""
        found = [answer[begin:end] for layout, begin, end in walk(answer) if layout.packet is COMMAND]
        if not found:
            return [report(sent, Stage.FAILED, "the flight did not answer")]
        (row,) = LAYOUTS[COMMAND.name].array(found[0])
        text = to_text(row["text"])
        if not row["obeyed"]:
            return [report(sent, Stage.FAILED, text)]
        reports = [report(sent, Stage.STARTED, text)]
        wanted = final_mode(sent.command)
        if wanted is None:
            return [*reports, report(sent, Stage.COMPLETED, sent.command.text)]
        if self._open is not None:
            reports.append(report(self._open[0], Stage.FAILED, f"then came: {sent.command.text}"))
        self._open = (sent, wanted, int(row["time_ns"]))
        if int(row["mode"]) == wanted and not isinstance(sent.command, Slew):
            reports += self._close(Stage.COMPLETED, f"mode {wanted.label}")
        return reports

    def followed(self, packet: bytes) -> list[Report]:
        """Return the reports that a packet of live telemetry causes."""
        layout = LAYOUTS[MODE.name]
        if self._open is None or packet[:2] != layout.identifier.to_bytes(2, "big"):
            return []
        (row,) = layout.array(packet)
        sent, wanted, since_ns = self._open
        slews, trigger = isinstance(sent.command, Slew), to_text(row["trigger"])
        if row["time_ns"] <= since_ns:
            return []
        if row["mode"] == wanted and (not slews or trigger == _ARRIVED):
            return self._close(Stage.COMPLETED, f"mode {wanted.label}")
        if row["mode"] in {Mode.SAFE, Mode.BOOT} or (slews and row["mode"] != Mode.SLEW):
            return self._close(Stage.FAILED, f"{trigger}: {to_text(row['reason'])}")
        return []

    def _close(self, stage: Stage, text: str) -> list[Report]:
        assert self._open is not None
        sent, self._open = self._open[0], None
        return [report(sent, stage, text)]


AT_MOST = 8
"""Maximum number of commands that wait for an answer."""

PATIENCE_NS = 5_000_000_000
"""Timeout (ns) for an answer of the control process, whose command cycle is 0.1 s."""

T = TypeVar("T")


@dataclass(slots=True)
class _Waiting(Generic[T]):
    command: T
    line: socket.socket
    path: Path
    until_ns: int


class ControlLine(Generic[T]):
    """Client of the command socket of the control process. T identifies a command to the caller."""

    def __init__(self, target: Path, folder: Path) -> None:
        """Create the sockets for answers in `folder`, which the control process must be able to enter."""
        self._target = str(target)
        self._folder = folder
        self._waiting: list[_Waiting[T]] = []
        self._count = 0

    def send(self, command: T, data: bytes, now_ns: int) -> str:
        """Hand over a command without waiting; return the problem, or an empty text on success."""
        if len(self._waiting) >= AT_MOST:
            return f"{AT_MOST} commands wait for their answers already"
        self._count += 1
        path = self._folder / f"answer-{self._count}"
        with ExitStack() as stack:
            try:
                line = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
                line.setblocking(False)
                stack.callback(_remove, path)
                path.unlink(missing_ok=True)
                line.bind(str(path))
                path.chmod(0o660)
                line.sendto(data, self._target)
            except OSError as error:
                return f"no flight listens: {error.strerror or error}"
            stack.pop_all()
        self._waiting.append(_Waiting(command, line, path, now_ns + PATIENCE_NS))
        return ""

    def answers(self, now_ns: int) -> list[tuple[T, bytes]]:
        """Return the received answers; b"" stands for an answer that timed out."""
        found, still = [], []
        for waiting in self._waiting:
            try:
                data = waiting.line.recv(LONGEST_PACKET)
            except OSError:
                if now_ns < waiting.until_ns:
                    still.append(waiting)
                    continue
                data = b""
            self._end(waiting)
            found.append((waiting.command, data))
        self._waiting = still
        return found

    def close(self) -> None:
        """Stop waiting for all answers."""
        for waiting in self._waiting:
            self._end(waiting)
        self._waiting = []

    def _end(self, waiting: _Waiting[T]) -> None:
        waiting.line.close()
        _remove(waiting.path)


def _remove(path: Path) -> None:
    """Remove the file of a socket; `send` later removes a file that cannot be removed now."""
    with suppress(OSError):
        path.unlink(missing_ok=True)
