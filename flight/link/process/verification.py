"""What becomes of a command: accepted or refused, started, completed or failed (PUS service 1).

The control process answers a command when it has obeyed it. A command that ends in a mode is completed when
the mode packet of the live telemetry shows that mode; it has failed once the mode is SAFE, or when another
command takes its place. A slew is completed when it has arrived, and has failed in any other mode.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from flight.link.commands.values import ChangeMode, Command, Point, Slew
from flight.link.modes import Mode
from flight.link.telemetry.definitions import COMMAND, MODE
from flight.link.telemetry.packets import LAYOUTS, to_text
from flight.link.telemetry.walk import walk

_ARRIVED = "arrived"  # the trigger of the mode packet (flight.loop.modes)


class Stage(IntEnum):
    """The values of the verification packet."""

    ACCEPTED = 1
    REFUSED = 2
    STARTED = 3
    COMPLETED = 4
    FAILED = 5

    @property
    def final(self) -> bool:
        """Whether nothing follows."""
        return self in {Stage.REFUSED, Stage.COMPLETED, Stage.FAILED}


class Request(NamedTuple):
    """How whoever sent a packet knows it: its first 16 bits and its sequence count."""

    packet: int
    sequence: int


UNREAD = Request(0, 0)
"""Of a frame whose packet was not read."""


def request_of(packet: bytes) -> Request:
    """Return what identifies a command's packet."""
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
    """Return the report of a stage."""
    return Report(sent.spi, sent.counter, stage, sent.command.packet.name, text, sent.request)


def final_mode(command: Command) -> Mode | None:
    """Return the mode in which a command is completed, None for one that is completed at once."""
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
    """Follows the commands that were handed over."""

    def __init__(self) -> None:
        self._open: tuple[Sent, Mode, int] | None = None  # with the mode it ends in, and since when

    def answered(self, sent: Sent, answer: bytes) -> list[Report]:
        """Return the reports of the control process's answer, b"" when none came."""
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
        """Return the reports of a packet of live telemetry."""
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
