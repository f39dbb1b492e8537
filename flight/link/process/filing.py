"""Files on board and their use: rules for files, selection of received files, and requests of renewals.

The satellite can send files in the folders `log/` (recorded runs) and `received/` to the ground. Each file
sent to the satellite belongs to one of the kinds `KINDS`. A received file has no effect until a command with
the file's SHA-256 selects the file. The selected file becomes `chosen/KIND/NAME`, replacing the selected file
of the same kind (docs/fly/files.md).

Updates of release or configuration in orbit (docs/fly/renewal.md) are executed by the privileged program
`deploy/renewal.py`. The program reads the requests and the record `contact` in the folder of `Renewal`, and
writes the status file that `Renewal` reads.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from flight.link.commands import CommandError
from flight.link.events import CONFIG_DAMAGED, Mode, Severity
from flight.link.files.store import (
    FileError,
    Store,
    line_of,
    make_folder,
    make_lasting,
    overwrite,
    problem_of_name,
    read_regular,
    remove_unfinished,
    to_record,
    write_whole,
)
from flight.link.files.transfer import (
    CRC32,
    FOREIGN,
    LONGEST_FILE,
    MODULAR,
    SATELLITE,
    Entity,
    Origin,
    Progress,
)
from flight.link.files.units import DOWN, Metadata, PduError, UnitPacker, unit_of
from flight.link.process.commanding import Report, Request, Stage
from flight.link.process.directives import (
    KINDS,
    PARTS,
    SEND_FILE,
    Activate,
    CancelFile,
    DeleteFile,
    FileDirective,
    ListFiles,
    Privileged,
    Restart,
    ResumeFile,
    SendFile,
    SuspendFile,
    UseFile,
)
from flight.link.telemetry.definitions import EVENT, FIX, MODE
from flight.link.telemetry.packets import row_of, to_text
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import UsageError

LARGEST_UP = 64 << 20
"""Maximum size (bytes) of a received file."""
MOST_RECEIVED = 256 << 20
"""Maximum total size (bytes) of all received files."""
LISTING = "listing.json"
_PORTION = 1 << 20
MOST_WAITING = 16
"""Maximum numbers of files that wait for their check, and of requests that wait for the renewal program."""


class Filing:
    """Executes the file commands and manages the file transfers on board. Not thread-safe."""

    def __init__(self, folder: Path, log: Path, now_ns: int) -> None:
        """Continue the transfers in `folder`; `log` contains the recorded runs.

        Raises UsageError if the folder cannot be used.
        """
        self._folder = folder
        self._store = Store(folder)
        remove_unfinished(folder)
        self._roots = {"log": log, "received": self._store.received}
        self._checks: list[tuple[Report, Iterator[str | None]]] = []
        self._units = UnitPacker(DOWN)
        self._problem = self._said = ""
        try:
            self._entity = Entity(SATELLITE, self._store, self._may_come, LARGEST_UP, now_ns)
        except FileError as error:
            raise UsageError(str(error)) from error

    def take(self, packet: bytes, now_ns: int) -> None:
        """Process a packet with a CFDP PDU. Raises CommandError for an invalid PDU or if the disk fails."""
        try:
            self._entity.take(unit_of(packet), now_ns)
        except (PduError, FileError, OSError) as error:
            raise CommandError(str(error)) from error

    def packet(self, now_ns: int, time_ns: int) -> bytes | None:
        """Return the next packet for the ground at mission time `time_ns` (ns), None if no packet is due."""
        unit = self._entity.unit(now_ns)
        return None if unit is None else self._units.pack(unit, time_ns)

    def turn(self, now_ns: int) -> list[Report]:
        """Execute one step of each long operation and return the reports of finished operations."""
        try:
            self._entity.work(now_ns)
            self._entity.keep(now_ns)
            self._problem = ""
        except (FileError, OSError) as error:
            self._problem = str(error)
        reports = [*self._go_on_checking()]
        if self._problem and self._problem != self._said:
            reports.append(Report(0, 0, Stage.FAILED, SEND_FILE.name, self._problem))
        self._said = self._problem
        return reports

    def status(self) -> list[Progress]:
        """Return the progress of all open transfers."""
        return self._entity.transfers()

    def ended(self) -> Iterator[tuple[Progress, Report | None]]:
        """Yield each ended transfer with the final report of the command that started the transfer."""
        while self._entity.ended:
            one = self._entity.ended.popleft()
            report = None
            if one.outgoing and one.origin != Origin():
                spi, counter, packet, sequence = one.origin
                stage = Stage.COMPLETED if one.condition == 0 else Stage.FAILED
                text = f"{one.name}: {one.said}"
                report = Report(spi, counter, stage, SEND_FILE.name, text, Request(packet, sequence))
            yield one, report

    def obey(self, directive: FileDirective, done: Report, utc_ns: int, now_ns: int) -> list[Report]:
        """Execute a file directive and return the reports due now; `done` is the report of completion."""
        try:
            match directive:
                case ListFiles(entity=entity, under=under):
                    path = self._write_listing(under)
                    return self._send(path, LISTING, entity, done, utc_ns, now_ns)
                case SendFile(entity=entity, name=name):
                    return self._send(self._path(name), name, entity, done, utc_ns, now_ns)
                case CancelFile(source, number):
                    self._entity.cancel(source, number)
                case SuspendFile(source, number):
                    self._entity.suspend(source, number, suspended=True)
                case ResumeFile(source, number):
                    self._entity.suspend(source, number, suspended=False)
                case DeleteFile(name):
                    self._received(name).unlink()
                case UseFile():
                    return self.select(directive, done, str)
        except (FileError, OSError) as error:
            return [replace(done, stage=Stage.FAILED, text=str(error))]
        return [done]

    def select(self, use: UseFile, done: Report, then: Callable[[], str]) -> list[Report]:
        """Check and select a received file in steps, and report `done` if the function `then` succeeds.

        The function `then` returns the reason for a failure, or an empty text. Returns the reports due now.
        """
        try:
            path = self._received(use.name)
            if len(self._checks) >= MOST_WAITING:
                raise FileError(f"{MOST_WAITING} files wait for their check: send the command again later")
            if path.stat().st_size > self._store.room(copy=True):
                raise FileError("the disk has no room for the selected copy: delete files")
        except (FileError, OSError) as error:
            return [replace(done, stage=Stage.FAILED, text=str(error))]
        self._checks.append((done, self._choosing(path, use.name, use.sum, then)))
        return []

    def close(self, now_ns: int) -> None:
        """Store the received data and close all files. Raises FileError if the disk fails."""
        self._entity.close(now_ns)

    def _send(
        self, path: Path, name: str, entity: int, done: Report, utc_ns: int, now_ns: int
    ) -> list[Report]:
        origin = Origin(done.spi, done.counter, *done.request)
        kind = MODULAR if entity == FOREIGN else CRC32  # other ground stations may not support CRC-32
        one = self._entity.send(path, name, entity, kind, utc_ns, now_ns, origin)
        text = f"{name}: {one.size} bytes, transfer {one.number}"
        return [replace(done, stage=Stage.STARTED, text=text)]

    def _path(self, name: str) -> Path:
        """Return the path of a file. Raises FileError for a file outside `log/` and `received/`."""
        root, _, rest = name.partition("/")
        if (problem := problem_of_name(name)) or root not in self._roots:
            raise FileError(problem or f"{name}: names begin with {' or '.join(self._roots)}")
        # Path.resolve raises RuntimeError for a loop of symbolic links.
        place, path = (Path(os.path.realpath(one)) for one in (self._roots[root], self._roots[root] / rest))
        if not path.is_relative_to(place) or not path.is_file():
            raise FileError(f"{name}: there is no such file")
        return path

    def _received(self, name: str) -> Path:
        if not name.startswith("received/"):
            raise FileError(f"{name}: use the name of a received file, which begins with received/")
        return self._path(name)

    def _may_come(self, metadata: Metadata) -> str:
        """Return why an incoming file is rejected, or an empty text if it is accepted."""
        kind, _, rest = metadata.name.partition("/")
        if kind not in KINDS or not rest or "/" in rest:
            return f"{metadata.name}: use a name KIND/NAME with KIND one of {', '.join(KINDS)}"
        if (self._store.received / metadata.name).exists():
            return "exists on board: put it with --replace, or delete it first"
        taken = sum(path.stat().st_size for path in self._store.received.rglob("*") if path.is_file())
        if taken + metadata.size > MOST_RECEIVED:
            return f"{taken} of {MOST_RECEIVED} bytes are in use: delete files that are not needed"
        return ""

    def _write_listing(self, under: str) -> Path:
        """Write the list of files, sorted by name, and return its path. Raises FileError on a disk error."""
        files = []
        for name, root in self._roots.items():
            for path in root.rglob("*"):
                full = f"{name}/{path.relative_to(root).as_posix()}"
                if full.startswith(under) and path.is_file() and not problem_of_name(full):
                    facts = path.stat()
                    files.append({"name": full, "bytes": facts.st_size, "modified": round(facts.st_mtime)})
        files = sorted(
            (file for file in files if int(str(file["bytes"])) <= LONGEST_FILE), key=itemgetter("name")
        )
        free = shutil.disk_usage(self._folder).free
        path = self._folder / LISTING
        write_whole(path, json.dumps({"free": free, "files": files}).encode())
        return path

    def _choosing(
        self, path: Path, name: str, wanted: bytes, then: Callable[[], str]
    ) -> Iterator[str | None]:
        """Copy a received file in steps, check the SHA-256 of the copied bytes and select the copy.

        The received file may change during the check, but the selected file is the checked copy. Yields None
        after each step, and at the end the problem or an empty text.
        """
        digest = hashlib.sha256()
        kind, _, own = name.removeprefix("received/").partition("/")
        folder = self._folder / "chosen" / kind
        make_folder(folder)
        beside = folder.with_name(f"{kind}~")
        try:
            with path.open("rb") as file, beside.open("wb") as copy:
                while data := file.read(_PORTION):
                    digest.update(data)
                    copy.write(data)
                    yield None
                copy.flush()
                os.fsync(copy.fileno())
        except OSError:
            beside.unlink(missing_ok=True)
            raise
        if digest.digest() != wanted:
            beside.unlink()
            yield f"{name}: its SHA-256 is {digest.hexdigest()}"
            return
        os.replace(beside, folder / own)
        make_lasting(folder)
        for other in folder.iterdir():
            if other.name != own:
                other.unlink()
        yield then()

    def _go_on_checking(self) -> Iterator[Report]:
        """Continue the oldest check. Two checks at once would copy into the same file."""
        for check in self._checks[:1]:
            done, steps = check
            try:
                problem = next(steps)
            except OSError as error:
                problem = str(error)
            if problem is not None:
                self._checks.remove(check)
                yield replace(done, stage=Stage.FAILED, text=problem) if problem else done


def values_of(progress: Progress) -> dict[str, Any]:
    """Return the values of the packet `transfer` for the progress of a file transfer."""
    return {
        "down": int(progress.outgoing),
        "source": progress.source,
        "number": progress.number,
        "name": progress.name,
        "size": progress.size,
        "done": progress.done,
        "open": int(progress.condition is None),
        "condition": progress.condition or 0,
        "text": progress.said,
    }


STATUS = Path("/var/lib/knightcube-renewal/status")
CONTACT_NS = 10 * SECOND_NS
"""Minimum time (ns) between two records of the contact with the ground."""
_LARGEST = 1 << 16
_REACTION = "reaction safe"  # trigger in the mode packet after an event (flight.loop.modes)
_STAGES = {"started": Stage.STARTED, "completed": Stage.COMPLETED, "failed": Stage.FAILED}
_DAMAGED = (ValueError, TypeError, AttributeError, LookupError, RecursionError)


def encoded(values: object) -> bytes:
    """Return values as a line of JSON with a checksum."""
    return to_record(json.dumps(values, sort_keys=True).encode())


def decoded(data: bytes) -> Any:
    """Return the values in a line of JSON with a checksum. Raises ValueError if the line is damaged."""
    return json.loads(line_of(data) or b"")


class Renewal:
    """Interface to the privileged program `deploy/renewal.py`, with which it exchanges files."""

    def __init__(self, folder: Path, status: Path, command_loss: float) -> None:
        """Write requests to `folder` with the limit `command_loss` (s), and read reports in `status`."""
        self._folder, self._status = folder, status
        self._limit = command_loss
        self._session = os.urandom(8).hex()
        self._fault = ""
        self._utc_offset_ns: int | None = None  # receiver's UTC minus the time of the host's clock
        self._recorded = ("", "")
        self._due_ns = self._modified_ns = self._reported = 0
        remove_unfinished(folder)
        with suppress(OSError, *_DAMAGED):
            self._reported = int(decoded(read_regular(folder / "reported", _LARGEST) or b""))

    def request(self, directive: Privileged, done: Report, now_ns: int) -> str:
        """Store a request for the privileged part. Return the reason for a failure, or an empty text.

        The request to activate an artefact contains the UTC (s) from the GPS receiver, if a fix was used
        since the start of the link. The host's clock may be wrong, so expiry dates are not compared with it.
        """
        if not os.path.exists(self._status):
            return "the renewal service is not installed on this board: run deploy/install.sh"
        name = f"{done.spi}-{done.counter}-{done.request.packet}-{done.request.sequence}"
        values: dict[str, Any] = {"do": type(directive).__name__.lower()}
        if isinstance(directive, Activate):
            kind, _, own = directive.name.removeprefix("received/").partition("/")
            values |= {"kind": kind, "name": own, "sum": directive.sum.hex(), "hours": directive.hours}
            values["despite_faults"] = bool(directive.despite_faults)
            if self._utc_offset_ns is not None:
                values["utc"] = (now_ns + self._utc_offset_ns) // SECOND_NS
        elif isinstance(directive, Restart):
            values["part"] = PARTS[directive.part]
        else:
            values["kind"] = KINDS[directive.kind]
        with suppress(OSError, FileError):
            self._folder.mkdir(mode=0o700, exist_ok=True)
            # The other files of the folder are `contact`, `reported` and files of interrupted writes.
            if sum(other[-1:].isdigit() for other in os.listdir(self._folder)) >= MOST_WAITING:
                return f"{MOST_WAITING} requests wait for the renewal program, which executes one every 10 s"
            write_whole(self._folder / name, encoded(values))  # the program never reads an incomplete request
            return ""
        return "the request could not be stored"

    def followed(self, packet: bytes, now_ns: int, *, live: bool) -> None:
        """Note the fault, refused configuration or automatic change to SAFE that a telemetry packet reports.

        If `live` is true, the packet was just written, and the time of a GPS fix in use is also recorded.
        """
        if (row := row_of(MODE, packet)) is not None:
            if row["mode"] == Mode.SAFE and to_text(row["trigger"]) == _REACTION:
                self._fault = to_text(row["reason"])[:64] or _REACTION
        elif (row := row_of(EVENT, packet)) is not None:
            # A flight that refuses the new configuration uses its last valid configuration.
            fails = row["severity"] == Severity.FAULT or row["code"] == CONFIG_DAMAGED.code
            if fails and not self._fault:
                self._fault = f"{to_text(row['name'])}: {to_text(row['text'])}"[:64]
        elif live and (row := row_of(FIX, packet)) is not None and row["used"]:
            self._utc_offset_ns = int(row["utc_ns"]) - now_ns

    def turn(self, admitted: int, now_ns: int) -> list[Report]:
        """Record the number `admitted` of authentic frames so far, and return new reports of the program."""
        contact = (str(admitted), self._fault)
        if contact != self._recorded and now_ns >= self._due_ns and os.path.exists(self._status.parent):
            self._due_ns = now_ns + CONTACT_NS
            values = {"session": self._session, "frames": contact[0], "fault": contact[1]}
            if self._write("contact", encoded(values | {"limit_s": self._limit})):
                self._recorded = contact
        with suppress(OSError, *_DAMAGED):
            modified_ns = self._status.stat().st_mtime_ns
            if modified_ns != self._modified_ns:
                entries = decoded(read_regular(self._status, _LARGEST) or b"")["reports"]
                self._modified_ns = modified_ns
                return self._reports(entries)
        return []

    def _reports(self, entries: list[list[Any]]) -> list[Report]:
        """Return the reports that were not sent before, and store the number of the newest report."""
        found = []
        for number, request, result, name, text in entries:
            if number > self._reported:
                spi, counter, packet, sequence = map(int, request.split("-")) if request else (0, 0, 0, 0)
                stage = _STAGES[result]
                found.append(Report(spi, counter, stage, name, text, Request(packet, sequence)))
        newest = max((int(entry[0]) for entry in entries), default=0)
        if newest != self._reported:
            self._reported = newest
            self._write("reported", encoded(newest))
        return found

    def _write(self, name: str, data: bytes) -> bool:
        with suppress(OSError):
            self._folder.mkdir(mode=0o700, exist_ok=True)
        return overwrite(self._folder / name, data)
