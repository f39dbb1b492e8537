"""Executes time-tagged commands at their UTC, and the directives that add, delete and list them.

A command that is more than ten seconds late, because the board stood still say, is not executed but reported
as failed. So is any that falls due in SAFE: what follows then is for the ground to decide. Until telemetry
shows the mode a command waits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime

from flight.link.commands.errors import CommandError
from flight.link.commands.words import command_of_words
from flight.link.modes import Mode
from flight.link.process.directives import SCHEDULE, Deletion, Listing, Scheduled
from flight.link.process.timetable import HIGHEST, Entry, Timetable, TimetableError
from flight.link.process.verification import Report, Sent, Stage
from flight.link.telemetry.definitions import HEALTH, MODE
from flight.link.telemetry.packets import LAYOUTS
from hal.interfaces.wires import SECOND_NS

LATEST_NS = 10 * SECOND_NS
"""So late a command is still executed."""

_WITH_MODE = {
    LAYOUTS[packet.name].identifier.to_bytes(2, "big"): LAYOUTS[packet.name] for packet in (MODE, HEALTH)
}


class Scheduling:
    """The timetable of a link process. Times are UTC, ns since 1970."""

    def __init__(self, timetable: Timetable) -> None:
        self._timetable = timetable
        self._mode: int | None = None

    def beginning(self) -> list[Report]:
        """Return what is to be reported at the start."""
        text = "both copies of the schedule are lost: it is empty"
        return [Report(0, 0, Stage.FAILED, SCHEDULE.name, text)] if self._timetable.lost else []

    def followed(self, packet: bytes) -> None:
        """Take the mode from a packet of live telemetry."""
        layout = _WITH_MODE.get(packet[:2])
        if layout is not None:
            self._mode = int(layout.array(packet)[0]["mode"])

    def obey(self, directive: Scheduled | Deletion | Listing, done: Report, utc_ns: int) -> list[Report]:
        """Execute a directive; `done` is the report of its completion. Return all reports."""
        try:
            match directive:
                case Scheduled():
                    return [replace(done, text=self._add(directive, done, utc_ns))]
                case Deletion(number):
                    self._timetable.remove(number)
                    return [done]
                case Listing():
                    texts = [text_of(entry) for entry in self._timetable.entries]
                    lines = [replace(done, stage=Stage.STARTED, text=text) for text in texts]
                    return [*lines, replace(done, text=f"{len(lines)} scheduled")]
        except (CommandError, TimetableError) as error:
            return [replace(done, stage=Stage.FAILED, text=str(error))]

    def due(self, utc_ns: int) -> Iterator[Report | Sent]:
        """Yield each command that is due, removed durably before: to be handed over, or why it is not."""
        for entry in self._timetable.entries:
            unknown = self._mode is None and utc_ns - entry.at_ns <= LATEST_NS
            if entry.at_ns > utc_ns or unknown:
                return
            problem = self._problem(entry, utc_ns)
            try:
                self._timetable.remove(entry.number)
            except TimetableError as error:  # it might be executed again after a restart
                problem = str(error)
                self._timetable.forget(entry.number)
            if problem:
                text = f"not executed, {problem}: {text_of(entry)}"
                yield Report(entry.spi, entry.counter, Stage.FAILED, SCHEDULE.name, text)
            else:
                yield Sent(entry.spi, entry.counter, command_of_words(entry.command))

    def _problem(self, entry: Entry, utc_ns: int) -> str:
        """Return why a command that is due must not be executed, empty when it may be."""
        if utc_ns - entry.at_ns > LATEST_NS:
            return f"it is {_utc(utc_ns)}"
        if self._mode == Mode.SAFE:
            return "in SAFE the ground decides"
        try:
            command_of_words(entry.command)
        except CommandError as error:  # of another release's table
            return str(error)
        return ""

    def _add(self, scheduled: Scheduled, done: Report, utc_ns: int) -> str:
        at_ns = utc_of(scheduled.at)
        command_of_words(scheduled.words)
        if at_ns <= utc_ns:
            raise TimetableError(f"{scheduled.at} has passed: it is {_utc(utc_ns)}")
        return text_of(self._timetable.add(at_ns, done.spi, done.counter, scheduled.words))


def utc_of(text: str) -> int:
    """Return the ns since 1970 of a UTC in ISO 8601, up to 2262-04-11. Raises CommandError."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise CommandError(f"{text!r} is no UTC such as 2026-11-23T21:00:00") from error
    time = time.replace(tzinfo=UTC) if time.tzinfo is None else time
    utc_ns = round(time.timestamp()) * SECOND_NS
    if utc_ns > HIGHEST:
        raise CommandError(f"{text} is beyond {_utc(HIGHEST)}")
    return utc_ns


def text_of(entry: Entry) -> str:
    """Return an entry in words."""
    return f"{entry.number}: {_utc(entry.at_ns)} {entry.command}"


def _utc(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns * 1e-9, UTC):%Y-%m-%dT%H:%M:%SZ}"
