"""The destination side of one transfer: keeps what comes, asks for what lacks, checks the whole, and says so.

What came is on disk before the record says so, and the record is written once a second: whatever is killed
asks again for that second at most. Each EOF is acknowledged, also a repeated one.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from contextlib import suppress

import msgspec

from flight.link.files.checksum import TYPES, FileSum
from flight.link.files.pdu import (
    MOST_REQUESTS,
    Ack,
    Code,
    Condition,
    Content,
    Eof,
    FileData,
    Finished,
    Kept,
    Metadata,
    Nak,
    Status,
)
from flight.link.files.ranges import Ranges
from flight.link.files.store import FileError, Incoming, Store, problem_of_name
from flight.link.files.timer import Timer

LACK_NS = 2_000_000_000
SILENT_NS = 10_000_000_000
FINISHED_NS = 5_000_000_000
_TRIES = 20
"""To say that a file is whole; who asks later is answered then."""

Accept = Callable[[Metadata], str]
"""Returns why a file must not come, empty when it may."""


class Receiver:
    """One file on its way in.

    Attributes:
        record: what is known of it; on disk as of the last `keep`.
        closed: whether the other end knows how it ended, or does not ask any more.
        said: the words of its end.
    """

    def __init__(self, store: Store, record: Incoming, accept: Accept, most: int, now_ns: int) -> None:
        """Begin, or go on with what is on disk; no file of more than `most` bytes is taken."""
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
        """How many bytes of the file are there."""
        whole = self.record.finished is not None and self.record.finished[1]
        return self.record.size if whole else self._ranges.total

    def take(self, content: Content, now_ns: int) -> list[Content]:
        """Take what the sender says; return what is to be answered at once."""
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
        """Return what is to be sent now, None for nothing."""
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
        """Make what came durable, then the record of it. Raises FileError."""
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
        """Take no more of the file."""
        kept = Kept.REJECTED if condition == Condition.FILESTORE_REJECTION else Kept.DISCARDED
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
        """Acknowledge an EOF; at the first, begin to ask for what lacks."""
        if self.record.finished is None:
            if eof.condition != Condition.NO_ERROR:
                self.stop(eof.condition, "the sender has cancelled it")
            elif self.record.name is not None and eof.size != self.record.size:
                self.stop(Condition.SIZE_ERROR, f"{eof.size} bytes instead of {self.record.size}")
            elif self.record.end is None:
                self.record = msgspec.structs.replace(self.record, end=(eof.checksum, eof.size))
                self._dirty = True
                self._lack = Timer(LACK_NS, now_ns - LACK_NS)
        return [Ack(Code.EOF, eof.condition, Status.ACTIVE)]

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
        # Of what came before the metadata nobody knew yet where the file ends.
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
            self._conclude(Condition.NO_ERROR, complete=True, kept=Kept.RETAINED, why="whole")

    def _conclude(self, condition: int, *, complete: bool, kept: Kept, why: str) -> None:
        self.said = why
        self._naks.clear()
        self._dirty = True
        self.record = msgspec.structs.replace(self.record, finished=(condition, complete, kept))
        if complete:
            self._place()

    def _place(self) -> None:
        try:
            self.keep()  # before the file is placed: after a kill between the two it is placed then
            self.close()
            self._store.place(self.record)
        except FileError as error:
            self.stop(Condition.FILESTORE_REJECTION, str(error))

    def _say_finished(self, now_ns: int) -> Content | None:
        if not self._finish.due(now_ns):
            return None
        assert self.record.finished is not None
        self._finish.asked(now_ns)
        self.closed = self._finish.times > _TRIES
        return Finished(*self.record.finished)
