"""The source side of one transfer: sends a file once, then what the other end lacks, until that has it all.

It never gives up: the other end may be out of sight. After a restart it sends metadata and EOF alone, and the
other end asks for what it lacks. The checksum is summed up in portions beside the sending.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from flight.link.files.checksum import FileSum
from flight.link.files.pdu import (
    SEGMENT_BYTES,
    Ack,
    Code,
    Condition,
    Content,
    Eof,
    FileData,
    Finished,
    Metadata,
    Nak,
    Transaction,
)
from flight.link.files.ranges import Ranges
from flight.link.files.store import FileError, Outgoing
from flight.link.files.timer import Timer

ASK_NS = 5_000_000_000
_TRIES = 20
"""To say that a transfer is cancelled."""


class Sender:
    """One file on its way out.

    Attributes:
        record: what is on disk of it.
        condition: how it ended, None while it is open.
        said: the words of its end.
    """

    def __init__(
        self, source: int, record: Outgoing, save: Callable[[Outgoing], None], now_ns: int, *, fresh: bool
    ) -> None:
        """Begin to send; without `fresh` only say that all was sent."""
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
        """How many bytes do not wait to be sent."""
        return self.record.size - self._wanted.total

    def again(self) -> None:
        """Say again what is sent: whoever asked for the file has perhaps lost what it knew."""
        self._metadata_due = self._end_due = True
        self._acknowledged = False

    def cancel(self, condition: Condition = Condition.CANCELLED, why: str = "cancelled") -> None:
        """Send no more, and say so."""
        self._stopped, self.said = condition, why
        self._wanted = Ranges()
        self._metadata_due, self._end_due, self._acknowledged = False, True, False

    def take(self, content: Content, now_ns: int) -> list[Content]:
        """Take what the other end says; return what is to be answered at once."""
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
        """Return what is to be sent now, None for nothing."""
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
            if self._stopped is not None and self._timer.times > _TRIES:
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
    """Return what a Finished is acknowledged by; also that of a transfer which is closed here."""
    return Ack(Code.FINISHED, finished.condition, 2)


def _words(condition: int) -> str:
    try:
        return Condition(condition).name.lower().replace("_", " ")
    except ValueError:
        return f"condition {condition}"
