"""Directives: commands that the link process executes itself (playback, keys, schedule, file transfers)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from flight.link.commands import CommandError
from flight.link.files.store import LONGEST_NAME
from flight.link.files.transfer import FOREIGN, GROUND
from flight.link.security import KEY_BYTES
from flight.link.telemetry.definitions import Field, Packet
from flight.link.telemetry.packets import (
    HEADER_BYTES,
    Layout,
    Packer,
    TelemetryError,
    compile_layouts,
    crc16,
    to_text,
)

SUM_BYTES = 32
_NAME = f"S{LONGEST_NAME}"
_TO = Field(
    "entity", "u2", "-", "receiving entity", states=((GROUND, "ground"), (FOREIGN, "another-ground-station"))
)

LIST_FILES = Packet(
    "list-files",
    0x223,
    "at will",
    "Send the list of files on board, as the file listing.json",
    (_TO, Field("under", _NAME, "-", "beginning of the listed names; empty lists all files")),
    telecommand=True,
)
SEND_FILE = Packet(
    "send-file",
    0x224,
    "at will",
    "Send a file down, or the missing parts of it",
    (_TO, Field("name", _NAME, "-", "name in the list of files")),
    telecommand=True,
)
CANCEL_FILE = Packet(
    "cancel-file",
    0x225,
    "at will",
    "End a transfer and delete the received part of the file",
    (
        Field("source", "u2", "-", "sending entity, as in the packet transfer"),
        Field("number", "u4", "-", "number of the transfer at the sending entity"),
    ),
    telecommand=True,
)
USE_FILE = Packet(
    "use-file",
    0x226,
    "at will",
    "Check the SHA-256 of a received file and select it for use by the board",
    (
        Field("name", _NAME, "-", "name in the list, such as received/configuration/flight.yaml"),
        Field("sum", "u1", "-", "SHA-256 of the file", SUM_BYTES),
    ),
    telecommand=True,
    hazard="the board may use the file from now on",
)
DELETE_FILE = Packet(
    "delete-file",
    0x227,
    "at will",
    "Delete a received file",
    (Field("name", _NAME, "-", "name in the list of files"),),
    telecommand=True,
    hazard="deletes the file",
)
FILE_PACKETS: tuple[Packet, ...] = (LIST_FILES, SEND_FILE, CANCEL_FILE, USE_FILE, DELETE_FILE)


@dataclass(frozen=True, slots=True)
class ListFiles:
    """Send the list of files to an entity."""

    under: str = ""
    entity: int = GROUND

    def __str__(self) -> str:
        return f"list files {self.under}".rstrip()


@dataclass(frozen=True, slots=True)
class SendFile:
    """Send a file to an entity."""

    name: str
    entity: int = GROUND

    def __str__(self) -> str:
        return f"send {self.name}"


@dataclass(frozen=True, slots=True)
class CancelFile:
    """End transfer `number` of entity `source`."""

    source: int
    number: int

    def __str__(self) -> str:
        return f"cancel transfer {self.number} of entity {self.source}"


@dataclass(frozen=True, slots=True)
class UseFile:
    """Choose a received file with this SHA-256."""

    name: str
    sum: bytes

    def __str__(self) -> str:
        return f"use {self.name}"


@dataclass(frozen=True, slots=True)
class DeleteFile:
    """Delete a received file."""

    name: str

    def __str__(self) -> str:
        return f"delete {self.name}"


FileDirective = ListFiles | SendFile | CancelFile | UseFile | DeleteFile
_FILE_PACKET_OF: dict[type[Any], Packet] = {
    ListFiles: LIST_FILES,
    SendFile: SEND_FILE,
    CancelFile: CANCEL_FILE,
    UseFile: USE_FILE,
    DeleteFile: DELETE_FILE,
}


def _file_fields(directive: FileDirective) -> dict[str, Any]:
    """Return the fields of a directive's packet. Raises CommandError for values that do not fit."""
    fields: dict[str, Any] = {name: getattr(directive, name) for name in type(directive).__slots__}
    if isinstance(directive, UseFile):
        fields["sum"] = list(directive.sum)
    for text in (value for value in fields.values() if isinstance(value, str)):
        if len(text.encode()) >= LONGEST_NAME:
            raise CommandError(f"{text}: names have less than {LONGEST_NAME} bytes")
    return fields


def _file_directive(name: str, row: Any) -> FileDirective:
    """Return the directive of a packet's row. Raises CommandError."""
    kind = next(kind for kind, packet in _FILE_PACKET_OF.items() if packet.name == name)
    values: dict[str, Any] = {}
    for item in _FILE_PACKET_OF[kind].fields:
        raw = row[item.name]
        text = item.kind.startswith("S")
        values[item.name] = to_text(raw) if text else bytes(raw.tolist()) if item.count > 1 else int(raw)
    if values.get("entity", GROUND) not in dict(_TO.states):
        raise CommandError(f"entity {values['entity']} is none that files are sent to")
    directive: FileDirective = kind(**values)
    return directive


_LONGEST_UTC = 32
LONGEST_COMMAND = 96
"""Bytes of a command in words, with the zero that ends it."""

PLAY = Packet(
    "play",
    0x2A0,
    "at will",
    "Play back an interval of the archive",
    (
        Field("run", "u4", "-", "number of the run; 0 for the newest"),
        Field("begin", "f8", "s", "mission time of the first packet"),
        Field("end", "f8", "s", "mission time of the last packet"),
    ),
    telecommand=True,
)
STOP = Packet("stop-playback", 0x2A1, "at will", "End the playback", (), telecommand=True)
NEW_KEY = Packet(
    "new-key",
    0x2A2,
    "at will",
    "Change the key of an SPI and reset its counter to 0",
    (
        Field("spi", "u2", "-", "SPI of the key, 1 to 4"),
        Field("generation", "u4", "-", "generation of the new key, one above the old generation"),
        Field("key", "u1", "-", "new key of AES-256", KEY_BYTES),
    ),
    telecommand=True,
)

SCHEDULE = Packet(
    "schedule",
    0x220,
    "at will",
    "Execute a command at a time in UTC, also after a restart",
    (
        Field("at", f"S{_LONGEST_UTC}", "-", "time in UTC, such as 2026-11-23T21:00:00"),
        Field(
            "words",
            f"S{LONGEST_COMMAND}",
            "-",
            "command in words, such as slew 0.2, with the units of its fields",
        ),
    ),
    telecommand=True,
    hazard="executes the command later",
)
UNSCHEDULE = Packet(
    "unschedule",
    0x221,
    "at will",
    "Delete a scheduled command",
    (Field("number", "u4", "-", "number in the list; 0 deletes all"),),
    telecommand=True,
)
LIST = Packet("list-schedule", 0x222, "at will", "Report each scheduled command", (), telecommand=True)

DIRECTIVES: tuple[Packet, ...] = (PLAY, STOP, NEW_KEY, SCHEDULE, UNSCHEDULE, LIST, *FILE_PACKETS)
LAYOUTS: dict[str, Layout] = compile_layouts(DIRECTIVES)
_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}


@dataclass(frozen=True, slots=True)
class Play:
    """Play back run `run` (0: the newest run) from `begin` to `end` (mission time, s)."""

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
    **_FILE_PACKET_OF,
}


def name_of(directive: Directive) -> str:
    """Return the name of the packet that carries a directive."""
    return _PACKETS[type(directive)].name


def pack(directive: Directive, utc_ns: int) -> bytes:
    """Return the packet of a directive. Raises CommandError for values that do not fit."""
    try:
        return Packer(LAYOUTS).pack(_PACKETS[type(directive)], utc_ns, _fields(directive))
    except TelemetryError as error:
        raise CommandError("these values fit no directive of the link") from error


def _fields(directive: Directive) -> dict[str, Any]:
    """Return the fields of a directive's packet. Raises CommandError."""
    if isinstance(directive, FileDirective):
        return _file_fields(directive)
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
    """Return the directive in a packet, None for a packet of another type. Raises CommandError."""
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
            directive = _file_directive(name, row)
    return directive
