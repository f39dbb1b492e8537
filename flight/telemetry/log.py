"""The flight log: packets queued by the control thread, put on disk beside it.

`write` appends to a bounded queue and never waits; a ticker of the clock drains the queue into the segments.
What cannot be kept is counted and told: packets lost, segments dropped.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from flight.errors import UsageError
from flight.telemetry.segments import SegmentFile, SegmentStore, find_segments, open_segment
from hal.interfaces.wires import Clock

_HUNG_DISK_S = 5.0


class FlightLog:
    """One log of one folder. One thread writes; the clock's ticker drains.

    The bytes on disk depend on the packets alone, not on when they were drained.
    """

    def __init__(
        self,
        folder: Path,
        stem: str = "flight",
        *,
        clock: Clock,
        segment_bytes: int = 16 << 20,
        budget_bytes: int = 1 << 30,
        queue_packets: int = 20_000,
        drain_period_ns: int = 250_000_000,
        sync_period_ns: int | None = 1_000_000_000,
        overwrite: bool = False,
        opener: Callable[[Path], SegmentFile] = open_segment,
    ) -> None:
        """Begin a new log.

        `sync_period_ns` None leaves fsync to the end of each segment: right for lock-step simulation, where
        seconds are short. Raises UsageError when the folder holds such a log already and `overwrite` is not
        set, when it cannot be written, or when the sizes make no sense.
        """
        if not 0 < segment_bytes <= budget_bytes // 2:
            raise UsageError(
                f"log budget of {budget_bytes} bytes: it must hold two segments of {segment_bytes} bytes"
            )
        self._stem = stem
        self._clock = clock
        self._queue_packets = queue_packets
        self._sync_period_ns = sync_period_ns
        self._queue: deque[bytes] = deque()
        self._refused = 0  # packets lost by the writer
        self._unwritten = 0  # packets lost by the drainer
        self._failure = ""
        self._closed = False
        self._draining = threading.Lock()  # held by whoever drains, never asked for by write()
        try:
            _clear(folder, stem, overwrite)
            self._store = SegmentStore(folder, stem, segment_bytes, budget_bytes, opener)
        except OSError as error:
            raise UsageError(f"{folder}: no log can be written there: {error.strerror or error}") from error
        self._synced_ns = clock.now_ns()
        self._ticker = clock.ticker(f"log-{stem}", drain_period_ns, self._drain)

    def write(self, packet: bytes) -> None:
        """Take one packet. Never waits: what does not fit in the queue is lost and counted."""
        if self._closed or self._failure or len(self._queue) >= self._queue_packets:
            self._refused += 1
        else:
            self._queue.append(packet)

    @property
    def lost(self) -> int:
        """Packets given to `write` that are not on disk and will not be."""
        return self._refused + self._unwritten

    @property
    def dropped_segments(self) -> int:
        """Oldest segments deleted to keep the budget."""
        return self._store.dropped

    def error(self) -> str:
        """Return what is wrong and how many packets it has cost so far, empty while nothing is."""
        problem = self._failure or ("the queue was full or the log closed" if self._refused else "")
        return f"log {self._stem}: {problem}; {self.lost} packets lost" if problem else ""

    def close(self) -> None:
        """Put the queue on disk, sync and close. Safe to call twice; never waits long for a hung disk."""
        if self._closed:
            return
        self._ticker.stop()
        if not self._draining.acquire(timeout=_HUNG_DISK_S):
            self._closed = True
            self._failure = "the disk does not answer"
            self._unwritten += len(self._queue)
            return
        try:
            self._closed = True
            self._write_queue()
            self._store.close()
        except OSError as error:
            self._failure = self._failure or _reason(error)
        finally:
            self._draining.release()

    def _drain(self) -> None:
        """Put the queue on disk and sync when it is time: the ticker's job."""
        with self._draining:
            if self._closed:
                return
            self._write_queue()
            now = self._clock.now_ns()
            due = self._sync_period_ns is not None and now - self._synced_ns >= self._sync_period_ns
            if due and not self._failure:
                self._synced_ns = now
                try:
                    self._store.sync()
                except OSError as error:
                    self._failure = _reason(error)

    def _write_queue(self) -> None:
        """Write the packets queued now; after a failure they are only counted."""
        packets = [self._queue.popleft() for _ in range(len(self._queue))]
        before = self._store.packets
        if not self._failure:
            try:
                self._store.append(packets)
            except OSError as error:
                self._failure = _reason(error)
        self._unwritten += len(packets) - (self._store.packets - before)


def _reason(error: OSError) -> str:
    return f"writing stopped: {error.strerror or error}"


def _clear(folder: Path, stem: str, overwrite: bool) -> None:
    """Make the folder and see to a log that is there already. Raises UsageError, OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    old = find_segments(folder, stem)
    if old and not overwrite:
        raise UsageError(f"{old[0]} exists: give another folder, or ask for it to be overwritten")
    for path in old:
        path.unlink()
