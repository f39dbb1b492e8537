"""Commands for files on board, which the link process executes: list, send, cancel, choose, delete."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flight.link.commands.errors import CommandError
from flight.link.files.entity import FOREIGN, GROUND
from flight.link.files.store import LONGEST_NAME
from flight.link.telemetry.form import Field, Packet
from flight.link.telemetry.packets import to_text

SUM_BYTES = 32
_NAME = f"S{LONGEST_NAME}"
_TO = Field(
    "entity", "u2", "-", "who gets it", states=((GROUND, "ground"), (FOREIGN, "another-ground-station"))
)

LIST_FILES = Packet(
    "list-files",
    0x223,
    "at will",
    "Send the list of files on board, as the file listing.json",
    (_TO, Field("under", _NAME, "-", "names that begin so, empty for all")),
    telecommand=True,
)
SEND_FILE = Packet(
    "send-file",
    0x224,
    "at will",
    "Send a file down, or what its receiver lacks of it",
    (_TO, Field("name", _NAME, "-", "as the list has it")),
    telecommand=True,
)
CANCEL_FILE = Packet(
    "cancel-file",
    0x225,
    "at will",
    "End a transfer; what came of the file is deleted",
    (
        Field("source", "u2", "-", "entity that sends, as in the packet transfer"),
        Field("number", "u4", "-", "of the transfer there"),
    ),
    telecommand=True,
)
USE_FILE = Packet(
    "use-file",
    0x226,
    "at will",
    "Choose a received file, whose SHA-256 is checked, as the one of its kind that the board shall take",
    (
        Field("name", _NAME, "-", "as the list has it, such as received/configuration/flight.yaml"),
        Field("sum", "u1", "-", "its SHA-256", SUM_BYTES),
    ),
    telecommand=True,
    hazard="the board may fly with it from then on",
)
DELETE_FILE = Packet(
    "delete-file",
    0x227,
    "at will",
    "Delete a received file",
    (Field("name", _NAME, "-", "as the list has it"),),
    telecommand=True,
    hazard="the file is gone",
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
PACKETS: dict[type[Any], Packet] = {
    ListFiles: LIST_FILES,
    SendFile: SEND_FILE,
    CancelFile: CANCEL_FILE,
    UseFile: USE_FILE,
    DeleteFile: DELETE_FILE,
}


def fields_of(directive: FileDirective) -> dict[str, Any]:
    """Return the fields of a directive's packet. Raises CommandError for values that are none."""
    fields: dict[str, Any] = {name: getattr(directive, name) for name in type(directive).__slots__}
    if isinstance(directive, UseFile):
        fields["sum"] = list(directive.sum)
    for text in (value for value in fields.values() if isinstance(value, str)):
        if len(text.encode()) >= LONGEST_NAME:
            raise CommandError(f"{text}: names have less than {LONGEST_NAME} bytes")
    return fields


def directive_of(name: str, row: Any) -> FileDirective:
    """Return the directive of a packet's row. Raises CommandError."""
    kind = next(kind for kind, packet in PACKETS.items() if packet.name == name)
    values: dict[str, Any] = {}
    for field in PACKETS[kind].fields:
        raw = row[field.name]
        text = field.kind.startswith("S")
        values[field.name] = to_text(raw) if text else bytes(raw.tolist()) if field.count > 1 else int(raw)
    if values.get("entity", GROUND) not in dict(_TO.states):
        raise CommandError(f"entity {values['entity']} is none that files are sent to")
    directive: FileDirective = kind(**values)
    return directive
