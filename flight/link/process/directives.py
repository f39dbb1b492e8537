"""Commands that the link process executes itself: playback, new keys, the schedule, and those for files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from flight.link.commands.errors import CommandError
from flight.link.process import file_directives
from flight.link.process.file_directives import FILE_PACKETS, FileDirective
from flight.link.process.timetable import LONGEST_COMMAND
from flight.link.security.sdls import KEY_BYTES
from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import (
    HEADER_BYTES,
    Layout,
    Packer,
    TelemetryError,
    compile_layouts,
    crc16,
    to_text,
)

_LONGEST_UTC = 32

PLAY = Packet(
    "play",
    0x2A0,
    "at will",
    "Play a stretch of the archive back",
    (
        Field("run", "u4", "-", "number of the run, 0 the newest"),
        Field("begin", "f8", "s", "mission time"),
        Field("end", "f8", "s", "mission time"),
    ),
    telecommand=True,
)
STOP = Packet("stop-playback", 0x2A1, "at will", "End the playback", (), telecommand=True)
NEW_KEY = Packet(
    "new-key",
    0x2A2,
    "at will",
    "Change the key of an SPI; its counter begins at 0 again",
    (
        Field("spi", "u2", "-", "whose key: 1 to 4"),
        Field("generation", "u4", "-", "of the new key, one more than the old one's"),
        Field("key", "u1", "-", "AES-256", KEY_BYTES),
    ),
    telecommand=True,
)

SCHEDULE = Packet(
    "schedule",
    0x220,
    "at will",
    "Execute a command at a UTC, also after a restart",
    (
        Field("at", f"S{_LONGEST_UTC}", "-", "UTC, such as 2026-11-23T21:00:00"),
        Field(
            "words",
            f"S{LONGEST_COMMAND}",
            "-",
            "a command, such as slew 0.2; units as in its form",
        ),
    ),
    telecommand=True,
    hazard="does later what the command does",
)
UNSCHEDULE = Packet(
    "unschedule",
    0x221,
    "at will",
    "Delete a scheduled command",
    (Field("number", "u4", "-", "as the list has it; 0: all"),),
    telecommand=True,
)
LIST = Packet("list-schedule", 0x222, "at will", "Report each scheduled command", (), telecommand=True)

DIRECTIVES: tuple[Packet, ...] = (PLAY, STOP, NEW_KEY, SCHEDULE, UNSCHEDULE, LIST, *FILE_PACKETS)
LAYOUTS: dict[str, Layout] = compile_layouts(DIRECTIVES)
_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}


@dataclass(frozen=True, slots=True)
class Play:
    """Play back what run `run` (0: the newest) recorded from `begin` to `end` s of mission time."""

    run: int
    begin: float
    end: float

    def __str__(self) -> str:
        run = f"run {self.run}" if self.run else "the newest run"
        return f"play {run} from {self.begin:g} to {self.end:g} s"


@dataclass(frozen=True, slots=True)
class Stop:
    """End the playback."""

    def __str__(self) -> str:
        return "stop playback"


@dataclass(frozen=True, slots=True)
class NewKey:
    """Change a key."""

    spi: int
    generation: int
    key: bytes = field(repr=False)

    def __str__(self) -> str:
        return f"new key of SPI {self.spi}, generation {self.generation}"


@dataclass(frozen=True, slots=True)
class Scheduled:
    """Execute a command in words at a UTC in ISO 8601."""

    at: str
    words: str

    def __str__(self) -> str:
        return f"at {self.at}: {self.words}"


@dataclass(frozen=True, slots=True)
class Deletion:
    """Delete a scheduled command; 0 deletes all."""

    number: int

    def __str__(self) -> str:
        return f"delete scheduled command {self.number}" if self.number else "delete all scheduled commands"


@dataclass(frozen=True, slots=True)
class Listing:
    """Report each scheduled command."""

    def __str__(self) -> str:
        return "list scheduled commands"


Directive = Play | Stop | NewKey | Scheduled | Deletion | Listing | FileDirective


_PACKETS: dict[type[Any], Packet] = {
    Play: PLAY,
    Stop: STOP,
    NewKey: NEW_KEY,
    Scheduled: SCHEDULE,
    Deletion: UNSCHEDULE,
    Listing: LIST,
    **file_directives.PACKETS,
}


def name_of(directive: Directive) -> str:
    """Return the name of the packet that carries a directive."""
    return _PACKETS[type(directive)].name


def pack(directive: Directive, utc_ns: int) -> bytes:
    """Return the packet of a directive. Raises CommandError for values that are none."""
    try:
        return Packer(LAYOUTS).pack(_PACKETS[type(directive)], utc_ns, _fields(directive))
    except TelemetryError as error:
        raise CommandError("these values fit no directive of the link") from error


def _fields(directive: Directive) -> dict[str, Any]:
    """Return the fields of a directive's packet. Raises CommandError."""
    if isinstance(directive, FileDirective):
        return file_directives.fields_of(directive)
    fields = {name: getattr(directive, name) for name in type(directive).__slots__}
    match directive:
        case NewKey(key=key):
            fields["key"] = list(key)
        case Scheduled(at, words):
            if len(at.encode()) >= _LONGEST_UTC or len(words.encode()) >= LONGEST_COMMAND:
                raise CommandError(f"{at}: {words}: too long")
        case _:
            pass
    return fields


def unpack(data: bytes) -> Directive | None:
    """Return the directive that `data` is, None for a packet of another kind. Raises CommandError."""
    layout = _BY_IDENTIFIER.get(int.from_bytes(data[:2], "big"))
    if layout is None:
        return None
    if len(data) != layout.length or crc16(data) != 0 or data[HEADER_BYTES] != layout.packet.version:
        raise CommandError(f"its length, CRC or version is not that of {layout.packet.name}")
    return _directive_of(layout.packet.name, layout.array(data)[0])


def _directive_of(name: str, row: Any) -> Directive:
    """Return the directive of a packet's row. Raises CommandError."""
    directive: Directive
    match name:
        case PLAY.name:
            directive = Play(int(row["run"]), float(row["begin"]), float(row["end"]))
            if not directive.begin <= directive.end:  # NaN compares false
                raise CommandError(f"from {directive.begin:g} to {directive.end:g} s is no stretch of time")
        case NEW_KEY.name:
            directive = NewKey(int(row["spi"]), int(row["generation"]), bytes(row["key"].tolist()))
        case SCHEDULE.name:
            directive = Scheduled(to_text(row["at"]), to_text(row["words"]))
        case UNSCHEDULE.name:
            directive = Deletion(int(row["number"]))
        case LIST.name:
            directive = Listing()
        case STOP.name:
            directive = Stop()
        case _:
            directive = file_directives.directive_of(name, row)
    return directive
