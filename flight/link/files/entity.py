"""CFDP entity of class 2: one end of all file transfers.

The owner requests a unit whenever the line has room for one. Replies come first, then units of the
transfers in turn. An entity never waits and has no clock. The store holds the state that survives a restart
of the process.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

from flight.link.files.store import Ending, FileError, Incoming, Outgoing, Store, problem_of_name
from flight.link.files.transfer import Accept, Receiver, Sender, answer_to
from flight.link.files.units import (
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
    TransactionStatus,
    pack,
    unpack,
)
from knightcube.errors import UsageError

SATELLITE, GROUND, FOREIGN = 1, 2, 3
"""Entity numbers of the satellite, of our ground station and of a foreign one (`ground.yamcs`)."""
MOST_OPEN = 8
"""Maximum number of open transfers in each direction."""
LONGEST_FILE = (1 << 32) - 1
_KEEP_NS = 1_000_000_000
_MOST_REPLIES = 64


class Origin(NamedTuple):
    """Command that caused a transfer: SPI and counter of its frame, packet and sequence; zeros for none."""

    spi: int = 0
    counter: int = 0
    packet: int = 0
    sequence: int = 0


NOBODY = Origin()


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a transfer; `condition` is None while it is open, and `said` is the text about its end."""

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
    """Transfers of one end of the link. Not thread-safe.

    Attributes:
        number: number of this entity.
        ended: transfers that have ended; the owner removes them.
    """

    def __init__(self, number: int, store: Store, accept: Accept, most: int, now_ns: int) -> None:
        """Continue the open transfers of the store; a file of more than `most` bytes is rejected."""
        self.number = number
        self.ended: deque[Progress] = deque(maxlen=_MOST_REPLIES)
        self._store, self._accept, self._most = store, accept, most
        self._replies: deque[bytes] = deque(maxlen=_MOST_REPLIES)
        self._out = {
            record.number: Sender(number, record, store.save, now_ns, fresh=False)
            for record in store.outgoing()
        }
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
        """Begin or continue to send a file with a checksum of type `kind`. Raises FileError.

        If the transfer of the file is already open, metadata and EOF are sent again, so that the other end
        requests its missing ranges.
        """
        try:
            facts = path.stat()
        except OSError as error:
            raise FileError(f"{name}: {error.strerror or error}") from error
        if problem := problem_of_name(name):
            raise FileError(problem)
        if not path.is_file() or facts.st_size > LONGEST_FILE:
            raise FileError(f"{name}: no file, or one of more than {LONGEST_FILE} bytes")
        same = self._open(str(path), name, destination)
        # A file that only grows is the same up to the size that is sent.
        if same is not None and (
            facts.st_mtime_ns == same.record.modified_ns or facts.st_size > same.record.size
        ):
            same.record = msgspec.structs.replace(same.record, origin=origin)
            self._store.save(same.record)
            same.again()
            return _of_sender(same)
        if same is not None:
            same.cancel(why="the file has changed")
        if len(self._out) >= MOST_OPEN:
            raise FileError(f"{MOST_OPEN} files are sent already: cancel one")
        number = self._store.new_number(utc_ns)
        record = Outgoing(
            number, destination, str(path), name, facts.st_size, facts.st_mtime_ns, kind, None, origin
        )
        self._store.save(record)
        self._out[number] = Sender(self.number, record, self._store.save, now_ns, fresh=True)
        return _of_sender(self._out[number])

    def cancel(self, source: int, number: int) -> None:
        """Cancel a transfer of either direction. Raises FileError if there is no such transfer."""
        if source == self.number and number in self._out:
            self._out[number].cancel()
        elif (source, number) in self._in:
            self._in[source, number].stop(Condition.CANCELLED, "cancelled")
        else:
            raise FileError(f"no transfer {number} of entity {source} is open")

    def take(self, unit: bytes, now_ns: int) -> None:
        """Process a received unit; units for other entities are ignored. Raises PduError, FileError."""
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
        """Return the next unit to send, None if none is due."""
        if self._replies:
            return self._replies.popleft()
        for _ in range(len(self._out) + len(self._in)):
            sides: list[Sender | Receiver] = [*self._out.values(), *self._in.values()]
            self._turn = (self._turn + 1) % len(sides)
            side = sides[self._turn]
            content = side.next(now_ns)
            if content is not None:
                found = pack(self._transaction(side), content)
                self._clear()
                return found
        self._clear()
        return None

    def keep(self, now_ns: int, *, at_once: bool = False) -> None:
        """Make received data durable once a second. Raises FileError."""
        if at_once or now_ns - self._kept_ns >= _KEEP_NS:
            self._kept_ns = now_ns
            for receiver in self._in.values():
                receiver.keep()

    def close(self, now_ns: int) -> None:
        """Make received data durable and close the files. Raises FileError."""
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
            case Nak():  # for an unknown transfer, so that its receiver stops waiting
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
        """Open an incoming transfer; beyond the maximum number, cancel the one that was silent longest."""
        if len(self._in) >= MOST_OPEN:
            stalest = min(self._in.values(), key=lambda receiver: receiver.heard_ns)
            stalest.stop(Condition.CANCELLED, "given up for a newer one")
            stalest.closed = True
            self._clear()
        found = self._in[record.source, record.number] = self._receiver(record, now_ns)
        return found

    def _receiver(self, record: Incoming, now_ns: int) -> Receiver:
        return Receiver(self._store, record, self._accept, self._most, now_ns)

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
        """Remove the transfers that have ended."""
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


def open_entity(number: int, folder: Path, accept: Accept, most: int, now_ns: int) -> Entity:
    """Return the entity of a folder. Raises UsageError if the folder cannot be written."""
    try:
        return Entity(number, Store(folder), accept, most, now_ns)
    except FileError as error:
        raise UsageError(str(error)) from error


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
        sender.said,
        Origin(*record.origin),
    )


def _of_receiver(receiver: Receiver) -> Progress:
    record = receiver.record
    condition = None if record.finished is None else record.finished[0]
    name = record.name or ""
    return Progress(
        False, record.source, record.number, name, record.size, receiver.came, condition, receiver.said
    )
