"""File transfers by CFDP class 2 (CCSDS 727.0-B-5): sender, receiver, and the entity that manages them.

Once a second, the receiver syncs the received data to disk and then stores the record of received ranges. If
the process is killed, at most one second of data is requested again. Each EOF is acknowledged, including
repeated EOFs.

A CFDP entity handles all file transfers at one end of the link. The caller asks the entity for the next
protocol data unit (PDU) whenever one can be sent, and regularly lets the entity check and store complete
files. Replies are sent first, followed by PDUs of the open transfers in round-robin order. No method of an
entity waits, and the caller states the current time. State that must survive a restart of the process is
stored on disk (`flight.link.files.store`).
"""

from __future__ import annotations

import errno
import os
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from fastcrc import crc32

from flight.link.files.store import Ending, FileError, Incoming, Outgoing, Ranges, Store, problem_of_name
from flight.link.files.units import (
    FILE_DATA_OVERHEAD,
    LONGEST_UNIT,
    MOST_REQUESTS,
    NAK_OVERHEAD,
    REQUEST_BYTES,
    SEGMENT_BYTES,
    Ack,
    Code,
    Condition,
    Content,
    Eof,
    FileData,
    FileStatus,
    Finished,
    Metadata,
    Nak,
    Transaction,
    TransactionStatus,
    pack,
    unpack,
)
from flight.link.telemetry.log import SUFFIX

MODULAR, CRC32C, CRC32, NO_CHECKSUM = 0, 2, 3, 15
TYPES = (MODULAR, CRC32C, CRC32, NO_CHECKSUM)
"""Supported checksum types (SANA registry of CFDP checksum identifiers)."""
_PORTION = 1 << 20
"""Number of bytes of a file that one step of its checksum processes."""


class FileSum:
    """Checksum of a file (CCSDS 727.0-B-5, 4.2.5), computed in steps of limited duration."""

    def __init__(self, path: Path, kind: int, size: int) -> None:
        """Prepare the checksum of type `kind` of the first `size` bytes of the file."""
        self._path, self._kind, self._left = path, kind, 0 if kind == NO_CHECKSUM else size
        self._at = self._value = 0

    def step(self) -> int | None:
        """Process the next 1 MiB; return the checksum after the last step, else None. Raises OSError."""
        if self._left:
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read(min(_PORTION, self._left))
            if not data:
                raise OSError(f"{self._path.name} ends before its size")
            self._value = add(self._kind, self._value, data)
            self._at += len(data)
            self._left -= len(data)
        return None if self._left else self._value


def add(kind: int, value: int, data: bytes) -> int:
    """Return the checksum `value` updated by `data`.

    For the modular checksum, the length of all blocks except the last must be a multiple of 4 bytes.
    """
    if kind == CRC32:
        return zlib.crc32(data, value)
    if kind == CRC32C:
        return crc32.iscsi(data, value)
    words = np.frombuffer(data + bytes(-len(data) % 4), dtype=">u4")
    return (value + int(words.sum(dtype=np.uint64))) % (1 << 32)


_SOON = 4
"""Number of the first retry after which the period of a timer is doubled."""
_LONGEST_NS = 60_000_000_000
"""Longest period (ns) of a timer, unless its first period is longer."""


class Timer:
    """Retry timer, which expires if nothing is received for one period.

    After a few retries the period doubles with each retry, up to one minute, because the other end may be out
    of radio contact for hours. The attribute `times` counts the retries since the other end last sent a PDU.
    """

    def __init__(self, period_ns: int, now_ns: int) -> None:
        self._period_ns = period_ns
        self._since_ns = now_ns
        self.times = 0

    def due(self, now_ns: int) -> bool:
        """Return whether a retry is due."""
        longer = self._period_ns << max(0, min(self.times - _SOON + 1, 16))
        return now_ns - self._since_ns >= min(max(self._period_ns, _LONGEST_NS), longer)

    def retried(self, now_ns: int) -> None:
        """Count a retry and restart the period."""
        self._since_ns = now_ns
        self.times += 1

    def reset(self, now_ns: int) -> None:
        """Reset the timer because a PDU was received from the other end."""
        self._since_ns = now_ns
        self.times = 0


_DISK_NS = 2_000_000_000
_DISK_TRIES = 6
"""Number of repeated attempts after a failed access to the disk; the attempts take about half a minute."""
_LASTING = {None, errno.ENOENT, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
"""Error numbers (errno) of permanent failures, for which a further attempt is useless. None stands for a file
that is too short."""


class DiskTimer(Timer):
    """Timer of repeated attempts to read or write a file after a failed access."""

    def __init__(self, now_ns: int) -> None:
        super().__init__(_DISK_NS, now_ns)

    def waits(self, now_ns: int) -> bool:
        """Return whether an access has failed and the next attempt is not due yet."""
        return self.times > 0 and not self.due(now_ns)

    def failed(self, error: BaseException | None, now_ns: int) -> bool:
        """Count a failed access, at most once a period. Return whether the transfer must be given up."""
        if not self.waits(now_ns):
            self.retried(now_ns)
        return getattr(error, "errno", None) in _LASTING or self.times > _DISK_TRIES


ASK_NS = 5_000_000_000
"""Period (ns) after which an unacknowledged EOF is repeated."""
_EOF_TRIES = 20
"""Maximum number of unacknowledged EOF PDUs that a sender sends for a cancelled transfer."""


class Sender:
    """Sending side of one file transfer.

    The sender sends the whole file once, and then each range that the receiver requests, until the receiver
    has the whole file. A sender never gives up, because the receiver may be out of radio contact. After a
    restart the sender sends only metadata and EOF, and the receiver requests the missing ranges. The checksum
    of the file is computed in steps while data are sent.

    Attributes:
        record: stored state of the transfer.
        condition: condition code with which the transfer ended, or None while it is open.
        said: description of the end of the transfer.
    """

    def __init__(
        self,
        source: int,
        record: Outgoing,
        save: Callable[[Outgoing], None],
        now_ns: int,
        *,
        fresh: bool,
        segment_bytes: int = SEGMENT_BYTES,
    ) -> None:
        """Begin a transfer if `fresh`, or continue it; PDUs contain at most `segment_bytes` file bytes."""
        self._segment_bytes, self.record = segment_bytes, record
        self.transaction = Transaction(source, record.number, record.destination)
        self.condition: int | None = None
        self.said = ""
        self._save = save
        self._path = Path(record.path)
        self._wanted = Ranges([(0, record.size)] if fresh else [])
        self._reached = 0 if fresh else record.size  # end of the data that may have been transmitted
        self._sum = FileSum(self._path, record.kind, record.size) if record.checksum is None else None
        self._metadata_due = self._end_due = True
        self._acknowledged = False
        self._stopped: Condition | None = None
        self._sum_of_sent = 0  # checksum of the transmitted data of a cancelled transfer
        self._timer = Timer(ASK_NS, now_ns)
        self._data_disk, self._sum_disk = DiskTimer(now_ns), DiskTimer(now_ns)

    @property
    def sent(self) -> int:
        """Number of bytes that were sent and are not requested again."""
        return self.record.size - self._wanted.total

    def resume(self) -> None:
        """Send metadata and EOF again, because the receiver may have lost its state."""
        self._metadata_due = self._end_due = True
        self._acknowledged = False

    def cancel(self, condition: Condition = Condition.CANCELLED, why: str = "cancelled") -> None:
        """Cancel the transfer and notify the receiver by an EOF with the checksum of the transmitted data."""
        self._stopped, self.said = condition, why
        self._sum = FileSum(self._path, self.record.kind, self._reached)
        self._wanted = Ranges()
        self._metadata_due, self._end_due, self._acknowledged = False, True, False

    def suspend(self, suspended: bool) -> None:
        """Suspend or resume the transfer. Raises FileError if the disk cannot be written."""
        self.record = msgspec.structs.replace(self.record, suspended=suspended)
        self._save(self.record)

    def take(self, content: Content, now_ns: int) -> list[Content]:
        """Process a PDU from the receiver and return the immediate answers."""
        self._timer.reset(now_ns)
        match content:
            case Nak(gaps=gaps) if self._stopped is None:
                for begin, end in gaps:
                    self._metadata_due |= begin == end == 0
                    self._wanted.add(begin, min(end, self.record.size))
                self._end_due |= not self._acknowledged
            case Ack(code=Code.EOF):
                self._acknowledged = True
                if self._stopped is not None:
                    self.condition = self._stopped
            case Finished(condition, complete, _):
                self.condition = condition if self._stopped is None else self._stopped
                if not self.said:
                    self.said = "received completely" if complete else _condition_text(condition)
                return [answer_to(content)]
            case _:
                pass
        return []

    def next(self, now_ns: int) -> Content | None:
        """Return the content of the next PDU to send, or None if no PDU is due."""
        self._continue_checksum(now_ns)
        if self.record.suspended and self._stopped is None:
            return None
        if self._metadata_due:
            self._metadata_due = False
            name = self.record.name
            return Metadata(self.record.size, name, name, self.record.kind)
        if self._wanted:
            return None if self._data_disk.waits(now_ns) else self._segment(now_ns)
        if not self._end_due and self._timer.due(now_ns):
            self._end_due = True
        if self._end_due and self._sum is None:
            self._end_due = False
            self._timer.retried(now_ns)
            if self._stopped is not None:
                if self._timer.times > _EOF_TRIES:
                    self.condition = self._stopped
                return Eof(self._stopped, self._sum_of_sent, self._reached)
            return Eof(Condition.NO_ERROR, self.record.checksum or 0, self.record.size)
        return None

    def _segment(self, now_ns: int) -> Content | None:
        begin, end = self._wanted.take(self._segment_bytes)
        try:
            with self._path.open("rb") as file:
                file.seek(begin)
                data = file.read(end - begin)
        except OSError as error:
            if not self._data_disk.failed(error, now_ns):
                self._wanted.add(begin, end)
                return None
            data, reason = b"", error.strerror or str(error)
        else:
            self._data_disk.reset(now_ns)
            reason = "it has become shorter"
        if len(data) < end - begin:
            self.cancel(Condition.FILESTORE_REJECTION, f"{self.record.name}: {reason}")
            return self.next(now_ns)
        self._reached = max(self._reached, end)
        return FileData(begin, data)

    def _continue_checksum(self, now_ns: int) -> None:
        if self._sum is None or (self._stopped is None and self._sum_disk.waits(now_ns)):
            return
        try:
            value = self._sum.step()
            self._sum_disk.reset(now_ns)
            if value is None:
                return
            self._sum = None
            if self._stopped is not None:
                self._sum_of_sent = value
                return
            self.record = msgspec.structs.replace(self.record, checksum=value)
            with suppress(FileError):  # after a restart, the checksum is computed again
                self._save(self.record)
        except OSError as error:
            if self._stopped is None:
                if not self._sum_disk.failed(error, now_ns):
                    return
                self.cancel(Condition.FILESTORE_REJECTION, str(error))
            self._sum = None  # the transmitted data can no longer be read


def answer_to(finished: Finished) -> Ack:
    """Return the acknowledgement of a Finished PDU. A closed transfer is acknowledged as well."""
    return Ack(Code.FINISHED, finished.condition, 2)


def _condition_text(condition: int) -> str:
    try:
        return Condition(condition).name.lower().replace("_", " ")
    except ValueError:
        return f"condition {condition}"


LACK_NS, SILENT_NS = 2_000_000_000, 10_000_000_000
"""Times (ns) without a PDU after which missing ranges are requested: if the EOF has been received, and if it
has not."""
FINISHED_NS = 5_000_000_000
"""Period (ns) after which an unacknowledged Finished PDU is repeated."""
_FINISHED_TRIES = 20
"""Maximum number of unacknowledged Finished PDUs before the receiver closes the transfer."""

Accept = Callable[[Metadata], str]
"""Function that returns why a file is rejected, or an empty text if the file is accepted."""


class Receiver:
    """Receiving side of one file transfer, which stores data, requests missing ranges and checks the file.

    Attributes:
        record: state of the transfer, which `keep` writes to disk.
        closed: whether the sender has acknowledged the end of the transfer or no longer answers.
        said: description of the end of the transfer.
        unplaced: whether the file is complete but not yet moved to its final path.
    """

    def __init__(
        self,
        store: Store,
        record: Incoming,
        accept: Accept,
        most: int,
        now_ns: int,
        most_requests: int = MOST_REQUESTS,
    ) -> None:
        """Begin or continue a transfer of at most `most` bytes; a NAK has up to `most_requests` ranges."""
        self._most_requests, self.record = most_requests, record
        self.closed = False
        self.said = ""
        self.received_ns = now_ns
        self._store, self._accept, self._most = store, accept, most
        self._file = -1
        self._ranges = Ranges(record.ranges)
        self._dirty = True
        self._requested_to: int | None = None  # offset up to which gaps are requested in the current round
        self._sum: FileSum | None = None
        self._finish = Timer(FINISHED_NS, now_ns - FINISHED_NS)
        self._data_disk, self._disk = DiskTimer(now_ns), DiskTimer(now_ns)  # for data, for the complete file
        self.unplaced = False
        # A transfer that continues after a restart requests its missing ranges at once.
        age_ns = SILENT_NS if record.name is not None else 0
        self._lack, self._silence = (Timer(period, now_ns - age_ns) for period in (LACK_NS, SILENT_NS))
        if record.finished is not None and record.finished[1] and store.has_file(record):
            self._place(now_ns)

    @property
    def received(self) -> int:
        """Number of received bytes of the file."""
        whole = self.record.finished is not None and self.record.finished[1]
        return self.record.size if whole else self._ranges.total

    def take(self, content: Content, now_ns: int) -> list[Content]:
        """Process a PDU from the sender and return the immediate answers."""
        self.received_ns = now_ns
        self._lack.reset(now_ns)
        self._silence.reset(now_ns)
        match content:
            case Metadata() if self.record.name is None and self.record.finished is None:
                self._begin(content)
            case FileData(offset, data) if self.record.finished is None:
                self._store_segment(offset, data, now_ns)
            case Eof():
                return self._end(content, now_ns)
            case Ack(code=Code.FINISHED) if self.record.finished is not None and not self.unplaced:
                self.closed = True
            case _:
                pass
        return []

    def next(self, now_ns: int) -> Content | None:
        """Return the content of the next PDU to send, or None if no PDU is due."""
        if self.record.finished is not None and not self.unplaced:
            return self._next_finished(now_ns)
        if self.unplaced or self._is_complete() or self.record.suspended:
            return None
        timer = self._lack if self.record.end is not None else self._silence
        if self._requested_to is None and timer.due(now_ns):
            timer.retried(now_ns)
            self._requested_to = 0
        return None if self._requested_to is None else self._next_request(self._requested_to)

    def work(self, now_ns: int) -> bool:
        """Execute one step of the check or storage of a complete file. Return whether a step was due."""
        due = self.unplaced or (self.record.finished is None and self._is_complete())
        if not due or self._disk.waits(now_ns):
            return False
        (self._place if self.unplaced else self._continue_check)(now_ns)
        return True

    def suspend(self, suspended: bool) -> None:
        """Suspend or resume the requests for missing data. Raises FileError if the disk cannot be written."""
        self.record = msgspec.structs.replace(self.record, suspended=suspended)
        self._dirty = True
        self._store.save(self.record)

    def keep(self, now_ns: int) -> None:
        """Sync the received data to disk, and then store the record of received ranges.

        Raises FileError if data or record cannot be stored. Data that were not synced are requested again. A
        sync without new ranges does not reset the timer of the attempts, because the kernel reports a failed
        write only once.
        """
        if not self._dirty:
            return
        try:
            if self._file >= 0:
                os.fdatasync(self._file)
        except OSError as error:  # the kernel may have discarded all data since the last sync
            self._ranges = Ranges(self.record.ranges)
            if self._data_disk.failed(error, now_ns):
                self.stop(Condition.FILESTORE_REJECTION, error.strerror or str(error))
            raise FileError(f"{self.record.name}: cannot be stored: {error.strerror}") from error
        ranges = tuple(self._ranges.pairs)
        if ranges != self.record.ranges:
            self._data_disk.reset(now_ns)
        self.record = msgspec.structs.replace(self.record, ranges=ranges)
        self._store.save(self.record)
        self._dirty = False

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, -1
        if file >= 0:
            with suppress(OSError):  # the data have been synced, or are requested again
                os.close(file)

    def stop(self, condition: int, why: str) -> None:
        """End the transfer and reject further data. A transfer that has ended keeps its result."""
        if self.record.finished is None:
            kept = FileStatus.REJECTED if condition == Condition.FILESTORE_REJECTION else FileStatus.DISCARDED
            self._conclude(condition, complete=False, kept=kept, why=why)

    def give_up(self, why: str) -> None:
        """Close the transfer. A complete file that has not been moved to its final path is rejected."""
        if self.unplaced:
            self._reject(why)
        self.stop(Condition.CANCELLED, why)
        self.closed = True

    def _begin(self, metadata: Metadata) -> None:
        # If the disk fails here, nothing is recorded, and the metadata are requested again.
        problem = problem_of_name(metadata.name) or self._accept(metadata)
        room = min(self._most, self._store.room())
        self.record = msgspec.structs.replace(
            self.record, name=metadata.name, size=metadata.size, kind=metadata.checksum_type
        )
        self._dirty = True
        if not problem and metadata.checksum_type not in TYPES:
            problem = f"checksums of type {metadata.checksum_type} are not known"
            self.stop(Condition.UNSUPPORTED_CHECKSUM, problem)
            return
        if not problem and metadata.size > room:
            problem = f"{metadata.size} bytes exceed the permitted {room} bytes"
        if problem:
            self.stop(Condition.FILESTORE_REJECTION, problem)

    def _store_segment(self, offset: int, data: bytes, now_ns: int) -> None:
        """Store data of the file. After a failed access to the disk the data are requested again."""
        end = offset + len(data)
        known = self.record.size if self.record.name is not None else self._most
        if end > known:
            if self.record.name is not None:
                self.stop(Condition.SIZE_ERROR, f"received data beyond the {known} bytes of the file")
            return
        if self._is_complete():  # a failure must not damage data that are checked
            return
        try:
            if self._file < 0:
                path = self._store.part(self.record)
                self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            if os.pwrite(self._file, data, offset) != len(data):
                return
        except OSError as error:
            if self._data_disk.failed(error, now_ns):
                self.stop(Condition.FILESTORE_REJECTION, error.strerror or str(error))
            return
        self._ranges.add(offset, end)
        self._dirty = True

    def _end(self, eof: Eof, now_ns: int) -> list[Content]:
        """Acknowledge an EOF and begin to request missing ranges after the first EOF."""
        if self.record.finished is None:
            if eof.condition != Condition.NO_ERROR:
                self.stop(eof.condition, "the sender has cancelled it")
            elif self.record.name is not None and eof.size != self.record.size:
                self.stop(Condition.SIZE_ERROR, f"{eof.size} bytes instead of {self.record.size}")
            elif self.record.end is None:
                self.record = msgspec.structs.replace(self.record, end=(eof.checksum, eof.size))
                self._dirty = True
                self._lack = Timer(LACK_NS, now_ns - LACK_NS)
        return [Ack(Code.EOF, eof.condition, TransactionStatus.ACTIVE)]

    def _is_complete(self) -> bool:
        end = self.record.end
        return self.record.name is not None and end is not None and self._ranges.cover(end[1])

    def _next_request(self, begin: int) -> Nak | None:
        """Return the request for the next gaps from offset `begin`, or None at the end of the file."""
        size = self.record.end[1] if self.record.end is not None else self.record.size
        gaps = self._ranges.gaps(begin, size, self._most_requests - 1)
        self._requested_to = gaps[-1][1] if gaps and gaps[-1][1] < size else None
        if self.record.name is None and begin == 0:
            gaps.insert(0, (0, 0))
        return Nak(gaps[0][0], gaps[-1][1], tuple(gaps)) if gaps else None

    def _continue_check(self, now_ns: int) -> None:
        assert self.record.end is not None
        checksum, size = self.record.end
        # Data may have arrived before the metadata, which state the size of the file.
        if size != self.record.size or self._ranges.end > size:
            why = f"received bytes up to {self._ranges.end}, but the EOF states {size}"
            self.stop(Condition.SIZE_ERROR, why)
            return
        try:
            if self._sum is None:
                self.keep(now_ns)
                self._store.part(self.record).touch(0o600)
                self._sum = FileSum(self._store.part(self.record), self.record.kind, size)
            value = self._sum.step()
        except (FileError, OSError) as error:
            if self._disk.failed(error.__cause__ or error, now_ns):
                self.stop(Condition.FILESTORE_REJECTION, str(error))
            return
        self._disk.reset(now_ns)
        if value is not None and value != checksum:
            self.stop(Condition.CHECKSUM_FAILURE, f"its checksum is {value:08x}, not {checksum:08x}")
        elif value is not None:
            self._conclude(Condition.NO_ERROR, complete=True, kept=FileStatus.RETAINED, why="whole")
            self._place(now_ns)

    def _conclude(self, condition: int, *, complete: bool, kept: FileStatus, why: str) -> None:
        self.said = why
        self._dirty = True
        self.record = msgspec.structs.replace(self.record, finished=(condition, complete, kept))

    def _place(self, now_ns: int) -> None:
        """Move the received file to its final path, or try again later after a failed access to the disk."""
        self.unplaced = True
        try:
            self.keep(now_ns)  # the record is stored first, so that a restart can move the file
            self.close()
            self._store.place(self.record)
            self.unplaced = False
        except FileError as error:
            if not self._disk.failed(error.__cause__, now_ns):
                return
            self._reject(str(error))

    def _reject(self, why: str) -> None:
        """End the transfer of a complete file that cannot be moved to its final path."""
        self.unplaced = False
        condition, kept = Condition.FILESTORE_REJECTION, FileStatus.REJECTED
        self._conclude(condition, complete=False, kept=kept, why=why)

    def _next_finished(self, now_ns: int) -> Content | None:
        if not self._finish.due(now_ns):
            return None
        assert self.record.finished is not None
        self._finish.retried(now_ns)
        self.closed = self._finish.times > _FINISHED_TRIES
        return Finished(*self.record.finished)


SATELLITE, GROUND, FOREIGN = 1, 2, 3
"""CFDP entity numbers of the satellite, the project's ground station and an external station (Yamcs)."""
MOST_OPEN = 8
"""Maximum number of open transfers in each direction."""
LONGEST_FILE = (1 << 32) - 1
_KEEP_NS = 1_000_000_000
_MOST_REPLIES = 64
_SUSPENDED = "suspended"


class Origin(NamedTuple):
    """Frame and packet (first 16 bits, sequence count) of the command that began a transfer, or zeros."""

    spi: int = 0
    counter: int = 0
    packet: int = 0
    sequence: int = 0


NOBODY = Origin()


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a file transfer, open if `condition` is None; `said` describes the end or suspension."""

    outgoing: bool
    source: int
    number: int
    name: str
    size: int
    done: int
    condition: int | None = None
    said: str = ""
    origin: Origin = NOBODY


class Entity:
    """CFDP entity: all transfers of one end of the link; the caller empties `ended`. Not thread-safe."""

    def __init__(
        self,
        number: int,
        store: Store,
        accept: Accept,
        most: int,
        now_ns: int,
        unit_bytes: int = LONGEST_UNIT,
    ) -> None:
        """Continue the stored transfers. Files have at most `most` bytes, PDUs at most `unit_bytes` bytes."""
        self.number = number
        self._segment_bytes = min(SEGMENT_BYTES, (unit_bytes - FILE_DATA_OVERHEAD) // 4 * 4)
        self._most_requests = min(MOST_REQUESTS, (unit_bytes - NAK_OVERHEAD) // REQUEST_BYTES)
        self.ended: deque[Progress] = deque(maxlen=_MOST_REPLIES)
        self._store, self._accept, self._most = store, accept, most
        self._replies: deque[bytes] = deque(maxlen=_MOST_REPLIES)
        self._out = {record.number: self._sender(record, now_ns, fresh=False) for record in store.outgoing()}
        self._in = {
            (record.source, record.number): self._receiver(record, now_ns) for record in store.incoming()
        }
        self._turn = 0
        self._kept_ns = now_ns

    def transfers(self) -> list[Progress]:
        """Return the progress of each open transfer."""
        return [*map(_of_sender, self._out.values()), *map(_of_receiver, self._in.values())]

    def send(
        self, path: Path, name: str, destination: int, kind: int, utc_ns: int, now_ns: int, origin: Origin
    ) -> Progress:
        """Begin to send a file with a checksum of type `kind`. Raises FileError if the file cannot be sent.

        An open transfer of this file is resumed by sending metadata and EOF, so that the receiver requests
        the missing ranges. A transfer of a file that has changed, other than by growth of a log, is
        cancelled.
        """
        try:
            facts = path.stat()
        except OSError as error:
            raise FileError(f"{name}: {error.strerror or error}") from error
        if problem := problem_of_name(name):
            raise FileError(problem)
        if not path.is_file() or facts.st_size > LONGEST_FILE:
            raise FileError(f"{name}: not a file, or longer than {LONGEST_FILE} bytes")
        same = self._open(str(path), name, destination)
        # A log file only grows, so its first bytes up to the announced size are unchanged.
        grown = name.endswith(SUFFIX) and same is not None and facts.st_size > same.record.size
        if same is not None and (grown or facts.st_mtime_ns == same.record.modified_ns):
            same.record = msgspec.structs.replace(same.record, origin=origin, suspended=False)
            self._store.save(same.record)
            same.resume()
            return _of_sender(same)
        if same is not None:
            same.cancel(why="the file has changed")
        if len(self._out) >= MOST_OPEN:
            raise FileError(f"{MOST_OPEN} files are already being sent: cancel one")
        number = self._store.new_number(utc_ns)
        record = Outgoing(
            number, destination, str(path), name, facts.st_size, facts.st_mtime_ns, kind, None, origin
        )
        self._store.save(record)
        self._out[number] = self._sender(record, now_ns, fresh=True)
        return _of_sender(self._out[number])

    def cancel(self, source: int, number: int) -> None:
        """Cancel an incoming or outgoing transfer. Raises FileError for an unknown transfer."""
        side = self._transfer(source, number)
        if isinstance(side, Sender):
            side.cancel()
        else:
            side.stop(Condition.CANCELLED, "cancelled")

    def suspend(self, source: int, number: int, suspended: bool) -> None:
        """Suspend or resume a transfer. Raises FileError for an unknown transfer."""
        self._transfer(source, number).suspend(suspended)

    def _transfer(self, source: int, number: int) -> Sender | Receiver:
        """Return an open transfer. Raises FileError for an unknown transfer."""
        side = self._out.get(number) if source == self.number else self._in.get((source, number))
        if side is None:
            raise FileError(f"no transfer {number} of entity {source} is open")
        return side

    def take(self, unit: bytes, now_ns: int) -> None:
        """Process a received PDU. Raises PduError for an invalid PDU, and FileError if the disk fails."""
        transaction, content = unpack(unit)
        if transaction.source == self.number:
            replies = self._take_as_sender(transaction, content, now_ns)
        elif transaction.destination == self.number:
            replies = self._take_as_receiver(transaction, content, now_ns)
        else:
            return
        self._replies.extend(pack(transaction, reply) for reply in replies)
        self._clear()

    def unit(self, now_ns: int) -> bytes | None:
        """Return the next PDU to send, or None if no PDU is due."""
        if self._replies:
            return self._replies.popleft()
        sides: list[Sender | Receiver] = [*self._out.values(), *self._in.values()]
        for _ in sides:
            self._turn = (self._turn + 1) % len(sides)
            side = sides[self._turn]
            content = side.next(now_ns)
            if content is not None:
                return pack(self._transaction(side), content)
        return None

    def work(self, now_ns: int) -> None:
        """Execute one step of the check or storage of a received file, and close ended transfers.

        The method must be called regularly, also while no PDU can be sent.
        """
        any(receiver.work(now_ns) for receiver in self._in.values())
        self._clear()

    def keep(self, now_ns: int, *, at_once: bool = False) -> None:
        """Store received data durably, once a second or `at_once`. Raises FileError if the disk fails."""
        if at_once or now_ns - self._kept_ns >= _KEEP_NS:
            self._kept_ns = now_ns
            with ExitStack() as stack:  # if one transfer cannot be stored, the others still are
                for receiver in self._in.values():
                    stack.callback(receiver.keep, now_ns)

    def close(self, now_ns: int) -> None:
        """Store received data durably and close the files. Raises FileError if the disk fails."""
        try:
            self.keep(now_ns, at_once=True)
        finally:
            for receiver in self._in.values():
                receiver.close()

    def _take_as_sender(self, transaction: Transaction, content: Content, now_ns: int) -> list[Content]:
        sender = self._out.get(transaction.number)
        if sender is not None and sender.transaction == transaction:
            return sender.take(content, now_ns)
        match content:
            case Finished():
                return [answer_to(content)]
            case Nak():  # the receiver of an unknown transfer must stop waiting
                return [Eof(Condition.CANCELLED, 0, 0)]
            case _:
                return []

    def _take_as_receiver(self, transaction: Transaction, content: Content, now_ns: int) -> list[Content]:
        key = (transaction.source, transaction.number)
        receiver = self._in.get(key)
        if receiver is None:
            ended = next((end for end in self._store.endings if (end.source, end.number) == key), None)
            match content:
                case Eof(condition) if ended is not None:
                    said = Finished(ended.condition, ended.complete, ended.kept)
                    return [Ack(Code.EOF, condition, TransactionStatus.TERMINATED), said]
                case Eof(condition) if condition != Condition.NO_ERROR:
                    return [Ack(Code.EOF, condition, TransactionStatus.UNRECOGNIZED)]
                case Metadata() | FileData() | Eof() if ended is None:
                    receiver = self._begin(Incoming(*key), now_ns)
                case _:
                    return []
        return receiver.take(content, now_ns)

    def _begin(self, record: Incoming, now_ns: int) -> Receiver:
        """Open an incoming transfer; if too many are open, end the least recently active transfer.

        A transfer whose complete file still waits to be stored is ended only if this applies to all open
        transfers.
        """
        if len(self._in) >= MOST_OPEN:
            oldest = min(self._in.values(), key=lambda one: (one.unplaced, one.received_ns))
            oldest.give_up("abandoned for a newer transfer")
            self._clear()
        found = self._in[record.source, record.number] = self._receiver(record, now_ns)
        return found

    def _sender(self, record: Outgoing, now_ns: int, *, fresh: bool) -> Sender:
        segment = self._segment_bytes
        return Sender(self.number, record, self._store.save, now_ns, fresh=fresh, segment_bytes=segment)

    def _receiver(self, record: Incoming, now_ns: int) -> Receiver:
        return Receiver(self._store, record, self._accept, self._most, now_ns, self._most_requests)

    def _open(self, path: str, name: str, destination: int) -> Sender | None:
        wanted = (path, name, destination)
        for sender in self._out.values():
            record = sender.record
            if (record.path, record.name, record.destination) == wanted and not sender.said:
                return sender
        return None

    def _transaction(self, side: Sender | Receiver) -> Transaction:
        if isinstance(side, Sender):
            return side.transaction
        return Transaction(side.record.source, side.record.number, self.number)

    def _clear(self) -> None:
        """Move ended transfers from the open transfers to the queue of ended transfers."""
        for sender in [sender for sender in self._out.values() if sender.condition is not None]:
            del self._out[sender.record.number]
            self._store.remove(sender.record)
            self.ended.append(_of_sender(sender))
        for key, receiver in [item for item in self._in.items() if item[1].closed]:
            assert receiver.record.finished is not None
            condition, complete, kept = receiver.record.finished
            self._store.add_ending(Ending(*key, condition, complete, kept))
            receiver.close()
            del self._in[key]
            self._store.remove(receiver.record)
            self.ended.append(_of_receiver(receiver))


def _of_sender(sender: Sender) -> Progress:
    record = sender.record
    return Progress(
        True,
        sender.transaction.source,
        record.number,
        record.name,
        record.size,
        sender.sent,
        sender.condition,
        sender.said or (_SUSPENDED if record.suspended else ""),
        Origin(*record.origin),
    )


def _of_receiver(receiver: Receiver) -> Progress:
    record = receiver.record
    condition = None if record.finished is None else record.finished[0]
    name = record.name or ""
    said = receiver.said or (_SUSPENDED if record.suspended else "")
    return Progress(
        False, record.source, record.number, name, record.size, receiver.received, condition, said
    )
