"""The two sides of one CFDP transfer of class 2 (CCSDS 727.0-B-5): the sender and the receiver of a file.

The receiver writes data to disk before the record says so, and writes the record once a second. A killed
process therefore requests at most one second of data again. Each EOF is acknowledged, also a repeated one.
"""

from __future__ import annotations

import os
import zlib
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from flight.link.files.store import FileError, Incoming, Outgoing, Store, problem_of_name
from flight.link.files.units import (
    MOST_REQUESTS,
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
)

MODULAR, CRC32 = 0, 3
TYPES = (MODULAR, CRC32)
_PORTION = 1 << 20


class FileSum:
    """Checksum (CCSDS 727.0-B-5, 4.2.5) of the first `size` bytes of a file, one portion per `step`."""

    def __init__(self, path: Path, kind: int, size: int) -> None:
        """Begin a checksum of type `kind`, one of `TYPES`."""
        self._path, self._kind, self._left = path, kind, size
        self._at = self._value = 0

    def step(self) -> int | None:
        """Read a portion; return the checksum after the last portion, else None. Raises OSError."""
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
    """Return the checksum `value` continued over `data`; all pieces except the last are whole words."""
    if kind == CRC32:
        return zlib.crc32(data, value)
    words = np.frombuffer(data + bytes(-len(data) % 4), dtype=">u4")
    return (value + int(words.sum(dtype=np.uint64))) % (1 << 32)


class Ranges:
    """Set of bytes of a file, stored as sorted, disjoint, half-open ranges."""

    def __init__(self, pairs: Iterable[tuple[int, int]] = ()) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []
        for begin, end in pairs:
            self.add(begin, end)

    def __bool__(self) -> bool:
        return bool(self._begins)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The ranges (begin, end), in order."""
        return list(zip(self._begins, self._ends, strict=True))

    @property
    def total(self) -> int:
        """Number of bytes in the set."""
        return sum(self._ends) - sum(self._begins)

    @property
    def end(self) -> int:
        """End of the last range, 0 for an empty set."""
        return self._ends[-1] if self._ends else 0

    def add(self, begin: int, end: int) -> None:
        """Add a range and merge it with adjacent ranges."""
        if begin >= end:
            return
        first = bisect_left(self._ends, begin)
        last = bisect_right(self._begins, end)
        if first < last:
            begin, end = min(begin, self._begins[first]), max(end, self._ends[last - 1])
        self._begins[first:last], self._ends[first:last] = [begin], [end]

    def take(self, most: int) -> tuple[int, int]:
        """Remove and return the first range, at most `most` bytes. Raises IndexError if the set is empty."""
        begin, end = self._begins[0], min(self._ends[0], self._begins[0] + most)
        self._begins[0] = end
        if end == self._ends[0]:
            del self._begins[0], self._ends[0]
        return begin, end

    def gaps(self, size: int) -> list[tuple[int, int]]:
        """Return the ranges of 0 to `size` that are not in the set."""
        edges = [0, *(edge for pair in self.pairs for edge in pair), size]
        between = [(edges[i], min(edges[i + 1], size)) for i in range(0, len(edges), 2)]
        return [(begin, end) for begin, end in between if begin < end]


_SOON = 4
_LONGEST_NS = 60_000_000_000


class Timer:
    """Retry timer: due after each silent period, which doubles after a few retries.

    The other end may be out of sight for long, so that retries become rare.

    Attributes:
        times: number of retries since the last unit of the other end.
    """

    def __init__(self, period_ns: int, now_ns: int) -> None:
        self._period_ns = period_ns
        self._since_ns = now_ns
        self.times = 0

    def due(self, now_ns: int) -> bool:
        """Return whether a retry is due."""
        longer = self._period_ns << max(0, min(self.times - _SOON + 1, 16))
        return now_ns - self._since_ns >= min(max(self._period_ns, _LONGEST_NS), longer)

    def asked(self, now_ns: int) -> None:
        """Count a retry and begin the next period."""
        self._since_ns = now_ns
        self.times += 1

    def heard(self, now_ns: int) -> None:
        """Reset the timer after a unit of the other end."""
        self._since_ns = now_ns
        self.times = 0


ASK_NS = 5_000_000_000
_EOF_TRIES = 20
"""Maximum number of EOF units that announce a cancelled transfer."""


class Sender:
    """Source side of one transfer.

    The file is sent once, then the ranges that the other end requests, until it has the whole file. A sender
    never gives up, because the other end may be out of sight. After a restart it sends only metadata and EOF,
    and the other end requests the missing ranges. The checksum is computed in portions while data are sent.

    Attributes:
        record: stored state of the transfer.
        condition: condition code of its end, None while it is open.
        said: text about its end.
    """

    def __init__(
        self, source: int, record: Outgoing, save: Callable[[Outgoing], None], now_ns: int, *, fresh: bool
    ) -> None:
        """Begin a transfer; without `fresh`, continue it by sending metadata and EOF only."""
        self.record = record
        self.transaction = Transaction(source, record.number, record.destination)
        self.condition: int | None = None
        self.said = ""
        self._save = save
        self._path = Path(record.path)
        self._wanted = Ranges([(0, record.size)] if fresh else [])
        self._once = record.size if fresh else 0
        self._sum = FileSum(self._path, record.kind, record.size) if record.checksum is None else None
        self._metadata_due = self._end_due = True
        self._acknowledged = False
        self._stopped: Condition | None = None
        self._timer = Timer(ASK_NS, now_ns)

    @property
    def sent(self) -> int:
        """Number of bytes that do not wait to be sent."""
        return self.record.size - self._wanted.total

    def again(self) -> None:
        """Send metadata and EOF again, because the receiver may have lost its state."""
        self._metadata_due = self._end_due = True
        self._acknowledged = False

    def cancel(self, condition: Condition = Condition.CANCELLED, why: str = "cancelled") -> None:
        """Cancel the transfer and announce it to the other end."""
        self._stopped, self.said = condition, why
        self._wanted = Ranges()
        self._metadata_due, self._end_due, self._acknowledged = False, True, False

    def take(self, content: Content, now_ns: int) -> list[Content]:
        """Process content of the other end; return the immediate answers."""
        self._timer.heard(now_ns)
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
                    self.said = "received whole" if complete else _words(condition)
                return [answer_to(content)]
            case _:
                pass
        return []

    def next(self, now_ns: int) -> Content | None:
        """Return the next content to send, None if none is due."""
        self._go_on_summing()
        if self._metadata_due:
            self._metadata_due = False
            name = self.record.name
            return Metadata(self.record.size, name, name, self.record.kind)
        if self._wanted:
            return self._piece(now_ns)
        if not self._end_due and self._timer.due(now_ns):
            self._end_due = True
        if self._end_due and (self._stopped is not None or self.record.checksum is not None):
            self._end_due = False
            self._timer.asked(now_ns)
            if self._stopped is not None and self._timer.times > _EOF_TRIES:
                self.condition = self._stopped
            return Eof(self._stopped or 0, self.record.checksum or 0, self.record.size)
        return None

    def _piece(self, now_ns: int) -> Content | None:
        begin, end = self._wanted.take(SEGMENT_BYTES)
        try:
            with self._path.open("rb") as file:
                file.seek(begin)
                data = file.read(end - begin)
        except OSError as error:
            data, reason = b"", error.strerror or str(error)
        else:
            reason = "it has become shorter"
        if len(data) < end - begin:
            self.cancel(Condition.FILESTORE_REJECTION, f"{self.record.name}: {reason}")
            return self.next(now_ns)
        return FileData(begin, data)

    def _go_on_summing(self) -> None:
        if self._sum is None or self._stopped is not None:
            return
        try:
            value = self._sum.step()
            if value is not None:
                self._sum = None
                self.record = msgspec.structs.replace(self.record, checksum=value)
                self._save(self.record)
        except (OSError, FileError) as error:
            self.cancel(Condition.FILESTORE_REJECTION, str(error))


def answer_to(finished: Finished) -> Ack:
    """Return the acknowledgement of a Finished, also for a transfer that is already closed."""
    return Ack(Code.FINISHED, finished.condition, 2)


def _words(condition: int) -> str:
    try:
        return Condition(condition).name.lower().replace("_", " ")
    except ValueError:
        return f"condition {condition}"


LACK_NS = 2_000_000_000
SILENT_NS = 10_000_000_000
FINISHED_NS = 5_000_000_000
_FINISHED_TRIES = 20
"""Maximum number of Finished units without acknowledgement; later requests are still answered."""

Accept = Callable[[Metadata], str]
"""Function that returns why a file is rejected, or an empty text if it is accepted."""


class Receiver:
    """Destination side of one transfer: stores data, requests missing ranges and checks the file.

    Attributes:
        record: state of the transfer, stored by `keep`.
        closed: whether the other end has acknowledged the end of the transfer or no longer answers.
        said: text about its end.
    """

    def __init__(self, store: Store, record: Incoming, accept: Accept, most: int, now_ns: int) -> None:
        """Begin a transfer or continue a stored one; a file of more than `most` bytes is rejected."""
        self.record = record
        self.closed = False
        self.said = ""
        self.heard_ns = now_ns
        self._store, self._accept, self._most = store, accept, most
        self._file = -1
        self._ranges = Ranges(record.ranges)
        self._dirty = True
        self._naks: deque[Nak] = deque()
        self._sum: FileSum | None = None
        self._finish = Timer(FINISHED_NS, now_ns - FINISHED_NS)
        self._lack = Timer(LACK_NS, now_ns - (LACK_NS if record.name is not None else 0))
        self._silence = Timer(SILENT_NS, now_ns - (SILENT_NS if record.name is not None else 0))
        if record.finished is not None and record.finished[1] and store.part(record).exists():
            self._place()

    @property
    def came(self) -> int:
        """Number of received bytes of the file."""
        whole = self.record.finished is not None and self.record.finished[1]
        return self.record.size if whole else self._ranges.total

    def take(self, content: Content, now_ns: int) -> list[Content]:
        """Process content of the sender; return the immediate answers."""
        self.heard_ns = now_ns
        self._lack.heard(now_ns)
        self._silence.heard(now_ns)
        match content:
            case Metadata() if self.record.name is None and self.record.finished is None:
                self._begin(content)
            case FileData(offset, data) if self.record.finished is None:
                self._keep_piece(offset, data)
            case Eof():
                return self._end(content, now_ns)
            case Ack(code=Code.FINISHED) if self.record.finished is not None:
                self.closed = True
            case _:
                pass
        return []

    def next(self, now_ns: int) -> Content | None:
        """Return the next content to send, None if none is due."""
        if self.record.finished is not None:
            return self._say_finished(now_ns)
        if self._whole():
            self._go_on_checking()
            return None
        timer = self._lack if self.record.end is not None else self._silence
        if not self._naks and timer.due(now_ns):
            timer.asked(now_ns)
            self._naks.extend(self._requests())
        return self._naks.popleft() if self._naks else None

    def keep(self) -> None:
        """Make received data durable, then the record of it. Raises FileError."""
        if not self._dirty:
            return
        if self._file >= 0:
            with suppress(OSError):
                os.fdatasync(self._file)
        self.record = msgspec.structs.replace(self.record, ranges=tuple(self._ranges.pairs))
        self._store.save(self.record)
        self._dirty = False

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

    def stop(self, condition: int, why: str) -> None:
        """End the transfer and reject further data."""
        kept = FileStatus.REJECTED if condition == Condition.FILESTORE_REJECTION else FileStatus.DISCARDED
        self._conclude(condition, complete=False, kept=kept, why=why)

    def _begin(self, metadata: Metadata) -> None:
        self.record = msgspec.structs.replace(
            self.record, name=metadata.name, size=metadata.size, kind=metadata.checksum_type
        )
        self._dirty = True
        problem = problem_of_name(metadata.name) or self._accept(metadata)
        if not problem and metadata.checksum_type not in TYPES:
            problem = f"checksums of type {metadata.checksum_type} are not known"
        if not problem and metadata.size > min(self._most, self._store.room()):
            problem = f"{metadata.size} bytes are too many"
        if problem:
            self.stop(Condition.FILESTORE_REJECTION, problem)

    def _keep_piece(self, offset: int, data: bytes) -> None:
        end = offset + len(data)
        known = self.record.size if self.record.name is not None else self._most
        if end > known:
            if self.record.name is not None:
                self.stop(Condition.SIZE_ERROR, f"bytes beyond the {known} of the file")
            return
        try:
            if self._file < 0:
                path = self._store.part(self.record)
                self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            if os.pwrite(self._file, data, offset) != len(data):
                return
        except OSError as error:
            self.stop(Condition.FILESTORE_REJECTION, error.strerror or str(error))
            return
        self._ranges.add(offset, end)
        self._dirty = True

    def _end(self, eof: Eof, now_ns: int) -> list[Content]:
        """Acknowledge an EOF; after the first EOF, begin to request missing ranges."""
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

    def _whole(self) -> bool:
        end = self.record.end
        return self.record.name is not None and end is not None and not self._ranges.gaps(end[1])

    def _requests(self) -> list[Nak]:
        size = self.record.end[1] if self.record.end is not None else self.record.size
        gaps = self._ranges.gaps(size)
        if self.record.name is None:
            gaps.insert(0, (0, 0))
        parts = [tuple(gaps[i : i + MOST_REQUESTS]) for i in range(0, len(gaps), MOST_REQUESTS)]
        return [Nak(part[0][0], part[-1][1], part) for part in parts]

    def _go_on_checking(self) -> None:
        assert self.record.end is not None
        checksum, size = self.record.end
        # Data that came before the metadata could not be compared with the size of the file.
        if size != self.record.size or self._ranges.end > size:
            self.stop(Condition.SIZE_ERROR, f"bytes up to {self._ranges.end}, {size} by its end")
            return
        if self._sum is None:
            self._naks.clear()
            with suppress(OSError):
                self._store.part(self.record).touch(0o600)
            self._sum = FileSum(self._store.part(self.record), self.record.kind, size)
        try:
            value = self._sum.step()
        except OSError as error:
            self.stop(Condition.FILESTORE_REJECTION, str(error))
            return
        if value is not None and value != checksum:
            self.stop(Condition.CHECKSUM_FAILURE, f"its checksum is {value:08x}, not {checksum:08x}")
        elif value is not None:
            self._conclude(Condition.NO_ERROR, complete=True, kept=FileStatus.RETAINED, why="whole")

    def _conclude(self, condition: int, *, complete: bool, kept: FileStatus, why: str) -> None:
        self.said = why
        self._naks.clear()
        self._dirty = True
        self.record = msgspec.structs.replace(self.record, finished=(condition, complete, kept))
        if complete:
            self._place()

    def _place(self) -> None:
        try:
            self.keep()  # before the file is placed, so that a killed process places it at its next start
            self.close()
            self._store.place(self.record)
        except FileError as error:
            self.stop(Condition.FILESTORE_REJECTION, str(error))

    def _say_finished(self, now_ns: int) -> Content | None:
        if not self._finish.due(now_ns):
            return None
        assert self.record.finished is not None
        self._finish.asked(now_ns)
        self.closed = self._finish.times > _FINISHED_TRIES
        return Finished(*self.record.finished)
