"""Directives: commands executed by the link process, for playback, keys, schedule and file transfers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from flight.link.commands import CommandError, command_of_words, telecommand
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

KINDS = ("configuration", "elements", "catalogue", "release")
"""Kinds of files that the satellite receives. The name of a kind is also the name of a folder."""
SUM_BYTES = 32
LONGEST_COMMAND = 96
"""Maximum length (bytes) of a command in words, including the terminating zero byte."""
_LONGEST_UTC = 32
_PORTION_BYTES, _MOST_PORTIONS = 72, 8
"""Bytes of a packet in one segment (class `Portion`), so that the segment fits into a frame of 128 bytes, and
maximum number of segments."""
LONGEST_IN_PORTIONS = _PORTION_BYTES * _MOST_PORTIONS
"""Length (bytes) of the longest packet that can be sent in segments."""

_ENTITY = Field(
    "entity", "u2", "-", "receiving entity", states=((GROUND, "ground"), (FOREIGN, "another-ground-station"))
)
_NAME = Field("name", f"S{LONGEST_NAME}", "-", "name in the list of files, such as received/elements/tle.txt")
_KIND = Field("kind", "u1", "-", "kind of the artefact", states=tuple(enumerate(KINDS)))
PARTS = ("flight", "link", "board")
_RESTARTS = "restarts flight and link with another configuration or release"


class _Directive:
    """A directive, whose attributes have the names of the packet's fields.

    The template `says` yields the directive's text; the placeholder `{0}` stands for the directive.
    """

    __slots__ = ()
    packet: ClassVar[Packet]
    says: ClassVar[str]

    def __str__(self) -> str:
        return self.says.format(self)


@dataclass(frozen=True, slots=True)
class Play(_Directive):
    """Directive to play back the telemetry of a run from mission time `begin` to `end`, s."""

    run: int
    begin: float
    end: float
    packet = telecommand(
        "play",
        0x2A0,
        "Play back an interval of the archive",
        Field("run", "u4", "-", "number of the run; 0 for the newest"),
        Field("begin", "f8", "s", "mission time of the first packet"),
        Field("end", "f8", "s", "mission time of the last packet"),
    )

    def __str__(self) -> str:
        run = f"run {self.run}" if self.run else "the newest run"
        return f"play {run} from {self.begin:g} to {self.end:g} s"


@dataclass(frozen=True, slots=True)
class Stop(_Directive):
    """Directive to stop the playback."""

    packet = telecommand("stop-playback", 0x2A1, "End the playback")
    says = "stop playback"


NEW_KEY = telecommand(
    "new-key",
    0x2A2,
    "Change the key of an SPI and reset its counter to 0",
    Field("spi", "u2", "-", "SPI of the key, 1 to 4"),
    Field("generation", "u4", "-", "generation of the new key, one above the old generation"),
    Field("key", "u1", "-", "new key of AES-256", KEY_BYTES),
)


@dataclass(frozen=True, slots=True)
class NewKey(_Directive):
    """Directive to change the key of an SPI (security parameter index)."""

    spi: int
    generation: int
    key: bytes = field(repr=False)
    packet = NEW_KEY
    says = "new key of SPI {0.spi}, generation {0.generation}"


PORTION = telecommand(
    "portion",
    0x2A3,
    "Transfer a portion of a packet that is too long for one frame",
    Field("total", "u1", "-", "number of portions of the packet, 2 to 8"),
    Field("number", "u1", "-", "number of this portion, 1 to `total`, in this order"),
    Field("data", "u1", "-", "bytes of the packet; zeros fill the last portion", _PORTION_BYTES),
)


@dataclass(frozen=True, slots=True)
class Portion(_Directive):
    """Directive that carries one segment of a packet: the segment `number` of `total` segments."""

    total: int
    number: int
    data: bytes
    packet = PORTION
    says = "portion {0.number} of {0.total}"


class Joiner:
    """Buffer that joins the segments of a packet."""

    def __init__(self) -> None:
        self._portions: list[Portion] = []

    def add(self, portion: Portion) -> bytes:
        """Return the packet after its last segment, else b"". Raises CommandError for a missing segment."""
        before, self._portions = self._portions, []
        if portion.number == 1 and 2 <= portion.total <= _MOST_PORTIONS:
            before = []
        elif not before or (portion.total, portion.number) != (before[0].total, len(before) + 1):
            raise CommandError(f"{portion}: an earlier portion is missing: send the command again")
        if portion.number < portion.total:
            self._portions = [*before, portion]
            return b""
        whole = b"".join(one.data for one in (*before, portion))
        return whole[: int.from_bytes(whole[4:HEADER_BYTES], "big") + HEADER_BYTES + 1]


_WORDS = "command in words, such as slew 0.2 or point ground 52.5deg 13.4deg roll 90deg"
SCHEDULE = telecommand(
    "schedule",
    0x220,
    "Execute a command at a time in UTC, also after a restart",
    Field("at", f"S{_LONGEST_UTC}", "-", "time in UTC, such as 2026-11-23T21:00:00"),
    Field("words", f"S{LONGEST_COMMAND}", "-", _WORDS),
    hazard="executes the command later",
)


@dataclass(frozen=True, slots=True)
class Scheduled(_Directive):
    """Directive to execute a command, given in words, at a UTC in ISO 8601 format."""

    at: str
    words: str
    packet = SCHEDULE

    def __str__(self) -> str:
        try:
            text = command_of_words(self.words).text
        except CommandError:  # the report of the refusal gives the reason
            text = self.words
        return f"at {self.at}: {text}"


@dataclass(frozen=True, slots=True)
class Deletion(_Directive):
    """Directive to delete a scheduled command. The number 0 deletes all scheduled commands."""

    number: int
    packet = telecommand(
        "unschedule",
        0x221,
        "Delete a scheduled command",
        Field("number", "u4", "-", "number of the command in the list; 0 deletes all"),
    )

    def __str__(self) -> str:
        return f"delete scheduled command {self.number}" if self.number else "delete all scheduled commands"


LIST = telecommand("list-schedule", 0x222, "Report each scheduled command")


@dataclass(frozen=True, slots=True)
class Listing(_Directive):
    """Directive to report all scheduled commands."""

    packet = LIST
    says = "list scheduled commands"


@dataclass(frozen=True, slots=True)
class ListFiles(_Directive):
    """Directive to send the list of files to a CFDP entity."""

    under: str = ""
    entity: int = GROUND
    packet = telecommand(
        "list-files",
        0x223,
        "Send the list of files on board, as the file listing.json",
        _ENTITY,
        Field(
            "under", f"S{LONGEST_NAME}", "-", "prefix of the listed names; an empty prefix lists all files"
        ),
    )

    def __str__(self) -> str:
        return f"list files {self.under}".rstrip()


SEND_FILE = telecommand("send-file", 0x224, "Send a file down, or the missing parts of it", _ENTITY, _NAME)


@dataclass(frozen=True, slots=True)
class SendFile(_Directive):
    """Directive to send a file to a CFDP entity."""

    name: str
    entity: int = GROUND
    packet = SEND_FILE
    says = "send {0.name}"


@dataclass(frozen=True, slots=True)
class _OnTransfer(_Directive):
    """Directive about a file transfer, identified by sending entity and transaction number."""

    source: int
    number: int


class CancelFile(_OnTransfer):
    """Directive to cancel a file transfer."""

    packet = telecommand(
        "cancel-file",
        0x225,
        "End a transfer and delete the received part of the file",
        Field("source", "u2", "-", "sending entity, as in the packet transfer"),
        Field("number", "u4", "-", "number of the transfer at the sending entity"),
    )
    says = "cancel transfer {0.number} of entity {0.source}"


class SuspendFile(_OnTransfer):
    """Directive to suspend a file transfer."""

    packet = telecommand(
        "suspend-file",
        0x229,
        "Suspend a transfer until it is resumed, even across restarts",
        *CancelFile.packet.fields,
    )
    says = "suspend transfer {0.number} of entity {0.source}"


class ResumeFile(_OnTransfer):
    """Directive to resume a suspended file transfer."""

    packet = telecommand("resume-file", 0x22A, "Resume a suspended transfer", *CancelFile.packet.fields)
    says = "resume transfer {0.number} of entity {0.source}"


@dataclass(frozen=True, slots=True)
class UseFile(_Directive):
    """Directive to select a received file for use if its SHA-256 is `sum`."""

    name: str
    sum: bytes
    packet = telecommand(
        "use-file",
        0x226,
        "Check the SHA-256 of a received file and select it for use by the board",
        _NAME,
        Field("sum", "u1", "-", "SHA-256 of the file", SUM_BYTES),
        hazard="the board may use the file from now on",
    )
    says = "use {0.name}"


@dataclass(frozen=True, slots=True)
class DeleteFile(_Directive):
    """Directive to delete a received file."""

    name: str
    packet = telecommand("delete-file", 0x227, "Delete a received file", _NAME, hazard="deletes the file")
    says = "delete {0.name}"


@dataclass(frozen=True, slots=True)
class Activate(_Directive):
    """Directive to start the trial of the signed software in bundle `name` (docs/fly/renewal.md)."""

    name: str
    sum: bytes
    hours: float
    despite_faults: int
    packet = telecommand(
        "activate",
        0x2B0,
        "Start the trial of a received, signed artefact; "
        "unless it is confirmed, the previous artefact returns",
        _NAME,
        Field("sum", "u1", "-", "SHA-256 of the bundle", SUM_BYTES),
        Field("hours", "f4", "h", "powered time within which the ground must confirm"),
        Field("despite_faults", "u1", "-", "1 if the trial continues after a fault that the flight reports"),
        hazard=_RESTARTS,
    )
    says = "activate {0.name} for {0.hours:g} h"


@dataclass(frozen=True, slots=True)
class _OnRenewal(_Directive):
    """Directive about the trial of an update. The attribute `kind` is an index of `KINDS`."""

    kind: int

    def __str__(self) -> str:
        return f"{type(self).__name__.lower()} {KINDS[self.kind]}"


class Confirm(_OnRenewal):
    """Directive to end a trial and keep the new artefact."""

    packet = telecommand("confirm", 0x2B1, "End the trial of an artefact and keep the artefact", _KIND)


class Withdraw(_OnRenewal):
    """Directive to return to the previous configuration or release."""

    packet = telecommand(
        "withdraw",
        0x2B2,
        "End the trial of an artefact, or return to the previous configuration or release",
        _KIND,
        hazard=_RESTARTS,
    )


@dataclass(frozen=True, slots=True)
class Restart(_Directive):
    """Directive to restart a part of the satellite. The attribute `part` is an index of `PARTS`."""

    part: int
    packet = telecommand(
        "restart",
        0x2B3,
        "Restart the flight, the link or the whole board within 10 s",
        Field("part", "u1", "-", "part to restart", states=tuple(enumerate(PARTS))),
        hazard="ends the running flight or the link; after a restart of the board both begin again",
    )

    def __str__(self) -> str:
        return f"restart {PARTS[self.part]}"


FileDirective = ListFiles | SendFile | CancelFile | SuspendFile | ResumeFile | UseFile | DeleteFile
Privileged = Activate | Confirm | Withdraw | Restart
"""Directives that the privileged program `deploy/renewal.py` executes."""
Executable = Play | Stop | NewKey | Scheduled | Deletion | Listing | Privileged | FileDirective
Directive = Portion | Executable

_CLASSES: tuple[type[Directive], ...] = (
    Play, Stop, NewKey, Portion, Scheduled, Deletion, Listing, ListFiles, SendFile, CancelFile, SuspendFile,
    ResumeFile, UseFile, DeleteFile, Activate, Confirm, Withdraw, Restart,
)  # fmt: skip
_BY_NAME = {kind.packet.name: kind for kind in _CLASSES}

DIRECTIVES: tuple[Packet, ...] = tuple(kind.packet for kind in _CLASSES)
LAYOUTS: dict[str, Layout] = compile_layouts(DIRECTIVES)
_BY_IDENTIFIER = {layout.identifier: layout for layout in LAYOUTS.values()}


def _check(directive: Directive) -> None:
    """Raise CommandError for values that cannot be executed."""
    if not isinstance(directive, Play):
        return
    begin, end = directive.begin, directive.end
    if math.isnan(begin) or math.isnan(end):
        raise CommandError(f"playback from {begin:g} to {end:g} s: give two numbers")
    if begin > end:
        raise CommandError(f"the end {end:g} s must not be before the begin {begin:g} s")


def pack(directive: Directive, utc_ns: int) -> bytes:
    """Return a directive encoded as a packet. Raises CommandError for values out of range."""
    packet, values = directive.packet, dict[str, Any]()
    for one in packet.fields:
        value = getattr(directive, one.name)
        if isinstance(value, str) and len(value.encode()) >= int(one.kind[1:]):
            raise CommandError(f"{value}: too long, {one.name} must have fewer than {one.kind[1:]} bytes")
        values[one.name] = list(value) if isinstance(value, bytes) else value
    _check(directive)
    try:
        return Packer(LAYOUTS).pack(packet, utc_ns, values)
    except TelemetryError as error:
        raise CommandError(str(error)) from error


def portions(packet: bytes, utc_ns: int) -> Iterator[bytes]:
    """Yield the segments of a packet as packets, with the times `utc_ns`, `utc_ns` + 1 and so on.

    Raises CommandError if the packet is longer than `LONGEST_IN_PORTIONS`.
    """
    total = -(-len(packet) // _PORTION_BYTES)
    if len(packet) > LONGEST_IN_PORTIONS:
        raise CommandError(f"{len(packet)} bytes exceed the longest command")
    for number in range(total):
        data = packet[_PORTION_BYTES * number : _PORTION_BYTES * (number + 1)]
        portion = Portion(total, number + 1, data.ljust(_PORTION_BYTES, b"\0"))
        yield pack(portion, utc_ns + number)


def unpack(data: bytes) -> Directive | None:
    """Return the directive in a packet, or None. Raises CommandError for a damaged or invalid packet."""
    layout = _BY_IDENTIFIER.get(int.from_bytes(data[:2], "big"))
    if layout is None:
        return None
    if len(data) != layout.length or crc16(data) != 0 or data[HEADER_BYTES] != layout.packet.version:
        raise CommandError(f"its length, CRC or version is not that of {layout.packet.name}")
    row, values = layout.array(data)[0], dict[str, Any]()
    for one in layout.packet.fields:
        raw = row[one.name]
        if one.kind.startswith("S"):
            values[one.name] = to_text(raw)
        else:
            values[one.name] = bytes(raw.tolist()) if one.count > 1 else raw.item()
    directive: Directive = _BY_NAME[layout.packet.name](**values)
    _check(directive)
    if values.get("part", 0) >= len(PARTS):
        raise CommandError(f"part {values['part']} is unknown")
    if values.get("kind", 0) >= len(KINDS):
        raise CommandError(f"kind {values['kind']} is unknown")
    if values.get("entity", GROUND) not in dict(_ENTITY.states):
        raise CommandError(f"entity {values['entity']} does not receive files")
    return directive
