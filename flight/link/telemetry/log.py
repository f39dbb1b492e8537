"""Flight log: recorder that packs values, bounded queue, segment files, and the archive of runs.

`FlightLog.write` appends a packet to a bounded queue and never blocks. A periodic task (ticker) writes the
queue to numbered segment files without buffering, so that a killed process leaves at most one incomplete
packet. While the disk fails, packets remain in the queue. Packets that do not fit into the queue are lost,
and their number is reported. Measured execution times depend on the machine and are therefore written to a
separate performance log. The flight log of a lock-step simulation is reproducible bit for bit.

Each boot creates a new run folder such as `run-000042`, into which no later boot writes. Runs are ordered by
number, because the wall clock of the flight computer may be wrong. The oldest runs are deleted if the archive
exceeds its budget. If the disk has less than `LEAST_FREE_BYTES` free bytes, old runs and then the oldest
segments of the present run are deleted, because the link needs space for requests and files from the ground.
The newest earlier run is never deleted only to gain free space. If the disk cannot be written, the flight
continues without a log.
"""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import stat
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from flight.link.events import COMMANDED, EventKind
from flight.link.files.store import make_lasting
from flight.link.telemetry.definitions import ATTITUDE, CONTROL, EVENT, HEALTH, HOUSEKEEPING, RUN, Packet
from flight.link.telemetry.packets import Packer, TelemetryError
from hal.interfaces.wires import Clock
from knightcube.errors import UsageError

SUFFIX = ".ccsds"


class SegmentFile(Protocol):
    """Interface of the unbuffered binary file to which the log writes."""

    def write(self, data: bytes, /) -> int | None:
        """Append bytes and return the number of bytes written. Raises OSError."""

    def truncate(self, size: int, /) -> int:
        """Truncate the file to `size` bytes. Raises OSError."""

    def fileno(self) -> int:
        """Return the file descriptor."""

    def close(self) -> None:
        """Close the file. Raises OSError."""


def open_segment(path: Path) -> SegmentFile:
    """Create a segment file and sync its folder. Raises OSError if the file exists or cannot be created.

    The file is opened in append mode, so that a write after a truncation follows the last complete packet.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
    file = os.fdopen(os.open(path, flags, 0o644), "wb", buffering=0)
    try:
        make_lasting(path.parent)
    except OSError:  # remove the file, so that the next attempt can create it
        file.close()
        path.unlink(missing_ok=True)
        raise
    return file


def find_segments(folder: Path, stem: str) -> list[Path]:
    """Return the segment files of a log, oldest first, or an empty list if there are none."""
    pattern = re.compile(re.escape(stem) + r"-(\d+)" + re.escape(SUFFIX))
    matches = ((pattern.fullmatch(path.name), path) for path in folder.glob(f"{stem}-*{SUFFIX}"))
    return [path for _, path in sorted((int(match[1]), path) for match, path in matches if match)]


class SegmentStore:
    """Writer of packets to segment files `<stem>-0001.ccsds`, `<stem>-0002.ccsds`, ... in an existing folder.

    The content of the files depends only on the packets, not on how many packets each call appends.

    Attributes:
        packets: number of completely written packets.
        doubtful: number of written packets that are possibly lost because a sync to disk failed.
        dropped: number of segment files deleted because of the budget or of little free space.
    """

    def __init__(
        self,
        folder: Path,
        stem: str,
        segment_bytes: int,
        budget_bytes: int,
        opener: Callable[[Path], SegmentFile] = open_segment,
        spare_bytes: int = 0,
    ) -> None:
        """Create the first segment file. Raises OSError if the file cannot be created.

        The disk keeps `spare_bytes` free bytes, if that is possible by deleting segments and earlier runs.
        """
        self._folder, self._stem, self._segment_bytes = folder, stem, segment_bytes
        self._budget_bytes, self._opener, self._spare_bytes = budget_bytes, opener, spare_bytes
        self._finished: deque[tuple[Path, int]] = deque()  # paths and sizes (bytes), oldest first
        self._number = self.packets = self.doubtful = self.dropped = 0
        self._unsynced = 0  # written packets since the last sync
        self._open_next()

    def append(self, packets: Sequence[bytes]) -> None:
        """Write packets and begin a new segment file whenever the current file is full.

        Raises OSError if a write fails. After a failed write, the attribute `packets` counts the completely
        written packets, and the file is truncated after the last of them. Then `append` may be called again.
        """
        chunk: list[bytes] = []
        size = self._size
        for packet in packets:
            if size and size + len(packet) > self._segment_bytes:
                self._write(chunk)
                self._turn()
                chunk, size = [], 0
            chunk.append(packet)
            size += len(packet)
        self._write(chunk)

    def removed(self) -> bool:
        """Return whether another process has removed the current segment file. Raises OSError."""
        try:
            os.stat(self._path)
        except FileNotFoundError:
            return True
        return False

    def sync(self) -> None:
        """Sync the written packets to disk.

        Raises OSError and counts the packets since the last sync as doubtful, because after a failed sync
        Linux may drop their data without reporting another error.
        """
        unsynced, self._unsynced = self._unsynced, 0
        try:
            os.fsync(self._file.fileno())
        except OSError:
            self.doubtful += unsynced
            raise

    def close(self) -> None:
        """Sync and close the current segment file. Raises OSError."""
        try:
            self.sync()
        finally:
            self._file.close()

    def _open_next(self) -> None:
        """Begin the next segment file. If no file can be created, the current file remains in use."""
        path = self._folder / f"{self._stem}-{self._number + 1:04d}{SUFFIX}"
        try:
            self._file = self._opener(path)
        except FileExistsError:  # a failed attempt left this file, and it could not be removed
            self._number += 1
            raise
        self._path = path
        self._number += 1
        self._size = 0

    def _turn(self) -> None:
        """Finish the current segment file and begin the next file."""
        self.sync()
        old, finished = self._file, (self._path, self._size)
        self._open_next()
        self._finished.append(finished)
        old.close()

    def _write(self, chunk: list[bytes]) -> None:
        data = b"".join(chunk)
        self._make_room(len(data))
        written = 0
        try:
            while written < len(data):
                written += self._file.write(data[written:]) or 0
        except OSError:
            self._keep_whole(chunk, written)
            raise
        self._size += len(data)
        self.packets += len(chunk)
        self._unsynced += len(chunk)

    def _make_room(self, coming: int) -> None:
        """Delete old files until `coming` further bytes fit into the budget and leave `spare_bytes` free."""
        total = self._size + coming + sum(size for _, size in self._finished)
        while self._finished and total > self._budget_bytes:
            total -= self._drop_segment()
        while self._spare_bytes and _free(self._folder) < self._spare_bytes + coming:
            if self._drop_run():
                continue
            if not self._finished:
                break
            self._drop_segment()

    def _drop_segment(self) -> int:
        """Delete the oldest finished segment file, and return its size, bytes. Raises OSError."""
        path, size = self._finished.popleft()
        path.unlink(missing_ok=True)
        self.dropped += 1
        return size

    def _drop_run(self) -> bool:
        """Delete the oldest earlier run unless it is the only one. Return whether a run was deleted."""
        runs: list[Path] = []
        with suppress(OSError):
            runs = find_runs(self._folder.parent)
        earlier = runs[: runs.index(self._folder)] if self._folder in runs else []
        if len(earlier) < 2:
            return False
        _drop(earlier[0])
        return not os.path.lexists(earlier[0])

    def _keep_whole(self, chunk: list[bytes], written: int) -> None:
        """Count the packets of `chunk` that end within `written` bytes; truncate the file after them."""
        whole = 0
        for packet in chunk:
            if whole + len(packet) > written:
                break
            whole += len(packet)
            self.packets += 1
            self._unsynced += 1
        try:
            self._file.truncate(self._size + whole)
            self._size += whole
        except OSError:  # readers of the log skip the incomplete packet
            self._size += written


MOST_RUNS = 1000
"""Maximum number of runs, which limits the runs of a flight computer that crashes at every start."""

LEAST_FREE_BYTES = 256 << 20
"""Disk space (bytes) that the runs of an archive leave free, enough for the largest update in orbit."""

DISK_TROUBLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EUCLEAN, errno.EBADMSG})
"""Error numbers (errno) of a full, failing or damaged disk. Any other error number means that the path of the
log is wrong."""

_NAME = re.compile(r"run-(\d{6,})")


@dataclass(frozen=True, slots=True)
class NewRun:
    """Folder of a new run, which does not exist if the disk fails, and number of deleted old runs."""

    folder: Path
    dropped: int


def find_runs(archive: Path) -> list[Path]:
    """Return the run folders in an archive, oldest first, without folders that a failing disk hides."""
    return [path for _, path in _numbered(archive) if os.path.isdir(path) and not os.path.islink(path)]


def begin_run(archive: Path, budget_bytes: int, coming_bytes: int) -> NewRun:
    """Create the folder of the next run, and delete old runs to make room for the new run.

    All runs together have at most `budget_bytes` bytes, and the new run has at most `coming_bytes`. Only run
    folders are deleted. A full or failing disk raises no error here, because the log reports the failure.
    Raises UsageError if the budget is smaller than the new run or if the path is wrong.
    """
    if coming_bytes > budget_bytes:
        raise UsageError(
            f"archive budget of {budget_bytes} bytes is too small: one run needs {coming_bytes} bytes"
        )
    runs, taken = find_runs(archive), _numbered(archive)
    number = taken[-1][0] + 1 if taken else 1
    while os.path.lexists(folder := archive / f"run-{number:06d}"):  # a failing disk hides the earlier runs
        number += 1
    dropped = _make_room(runs, budget_bytes - coming_bytes)
    while dropped < len(runs) - 1 and _free(archive) < LEAST_FREE_BYTES:
        _drop(runs[dropped])
        dropped += 1
    try:
        folder.mkdir(parents=True)
        make_lasting(archive)
    except OSError as error:
        if error.errno not in DISK_TROUBLE:
            with suppress(OSError):
                folder.rmdir()  # the next attempt would leave another empty folder
            raise UsageError(
                f"{archive}: the folder of a new run cannot be made: {error.strerror or error}"
            ) from error
    return NewRun(folder, dropped)


def _free(archive: Path) -> float:
    """Return the free space (bytes) on the disk of the archive, or infinity if it is unknown."""
    try:
        disk = os.statvfs(archive)
    except OSError:
        return math.inf
    return float(disk.f_bavail * disk.f_frsize)


def _drop(run: Path) -> None:
    """Delete the folder of a run. Files that cannot be deleted now are deleted at a later boot."""
    shutil.rmtree(run, ignore_errors=True)


def _numbered(archive: Path) -> list[tuple[int, Path]]:
    """Return the run numbers and paths of all files and folders with the name of a run, sorted by number.

    The list is empty if the disk is failing or damaged.
    """
    try:
        matches = [(_NAME.fullmatch(path.name), path) for path in archive.glob("run-*")]
    except OSError as error:
        if error.errno not in DISK_TROUBLE:
            raise
        return []
    return sorted((int(match[1]), path) for match, path in matches if match)


def _make_room(runs: list[Path], room_bytes: int) -> int:
    """Delete the oldest runs until the others fit into `room_bytes`; return the number of deleted runs."""
    sizes = [_size(run) for run in runs]
    total, dropped = sum(sizes), 0
    while dropped < len(runs) and (total > room_bytes or len(runs) - dropped >= MOST_RUNS):
        _drop(runs[dropped])
        total -= sizes[dropped]
        dropped += 1
    return dropped


def _size(folder: Path) -> int:
    """Return the total size (bytes) of all files below a folder, except files that cannot be examined."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                found = os.lstat(os.path.join(place, name))
                total += found.st_size if stat.S_ISREG(found.st_mode) else 0
    return total


_HUNG_DISK_S = 5.0
_RETRY_NS = 1_000_000_000
_RECENT_NS = 2_000_000_000


class FlightLog:
    """Log of one thread; a ticker writes its bounded queue to disk. The content does not depend on timing."""

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
        patient: bool = False,
        opener: Callable[[Path], SegmentFile] = open_segment,
    ) -> None:
        """Begin a new log.

        If `sync_period_ns` is None, fsync is called only at the end of each segment file, for example in a
        lock-step simulation, which runs faster than real time. If `patient` is true, the folder is that of a
        run in an archive: if the disk fails, writing is retried and no error is raised, and
        `LEAST_FREE_BYTES` of the disk are kept free. Raises UsageError if the folder contains a log of the
        same name and `overwrite` is false, if the sizes are invalid, or if the folder cannot be written.
        """
        if not 0 < segment_bytes <= budget_bytes // 2:
            raise UsageError(
                f"log budget of {budget_bytes} bytes: give at least two segments of {segment_bytes} bytes"
            )
        self._stem, self._clock, self._queue_packets = stem, clock, queue_packets
        self._sync_period_ns = sync_period_ns
        self._queue: deque[bytes] = deque()
        self._refused = 0  # packets lost because the queue was full or the log was closed
        self._unwritten = 0  # packets lost after they were queued
        self._refused_ns = 0  # time at which `write` last lost a packet
        self._failure = ""  # reason why packets cannot be written now
        self._past_failure = ""
        self._retry_ns = 0
        self._busy_since_ns: int | None = None
        self._closed = False
        self._draining = threading.Lock()  # held while the queue is written to disk; write() does not need it
        self._store: SegmentStore | None = None

        def begin() -> SegmentStore:
            nonlocal overwrite
            _clear(folder, stem, overwrite)
            overwrite = True  # a retry may overwrite the files of a failed attempt
            spare_bytes = LEAST_FREE_BYTES if patient else 0
            return SegmentStore(folder, stem, segment_bytes, budget_bytes, opener, spare_bytes)

        self._begin = begin
        try:
            self._store = begin()
        except OSError as error:
            if not patient:
                problem = f"{folder}: a log cannot be written there: {error.strerror or error}"
                raise UsageError(problem) from error
            self._fail(error)
        self._synced_ns = clock.now_ns()
        self._ticker = clock.ticker(f"log-{stem}", drain_period_ns, self._drain)

    def write(self, packet: bytes) -> None:
        """Queue a packet without blocking. If the queue is full, the packet is lost and counted."""
        if self._closed or len(self._queue) >= self._queue_packets:
            self._refused += 1
            self._refused_ns = self._clock.now_ns()
        else:
            self._queue.append(packet)

    @property
    def lost(self) -> int:
        """Number of packets passed to `write` that are lost, or possibly lost because a sync failed."""
        doubtful = self._store.doubtful if self._store is not None else 0
        return self._refused + self._unwritten + doubtful

    @property
    def dropped_segments(self) -> int:
        """Number of segment files deleted because of the budget or of little free space."""
        return self._store.dropped if self._store is not None else 0

    def error(self) -> str:
        """Return the present problem and the number of lost packets, or an empty text without a problem."""
        problem = self._problem()
        waiting = len(self._queue)
        waits = f", {waiting} waiting" if problem and waiting else ""
        return f"log {self._stem}: {problem}; {self.lost} packets lost{waits}" if problem else ""

    def _problem(self) -> str:
        now_ns, busy_since_ns = self._clock.now_ns(), self._busy_since_ns
        if self._failure:
            return self._failure
        if busy_since_ns is not None and now_ns - busy_since_ns > _HUNG_DISK_S * 1e9:
            return "the disk does not answer"
        if self._refused and (self._closed or now_ns - self._refused_ns <= _RECENT_NS):
            return self._past_failure or "the queue was full or the log was closed"
        return ""

    def close(self) -> None:
        """Write the queue, sync and close the log, waiting at most 5 s. May be called twice."""
        if self._closed:
            return
        self._ticker.stop()
        if not self._draining.acquire(timeout=_HUNG_DISK_S):
            self._closed = True
            self._failure = "the disk does not answer"
            self._give_up()
            return
        try:
            self._closed = True
            self._write_queue()
            self._give_up()
            if self._store is not None:
                self._store.close()
        except OSError as error:
            self._fail(error)
        finally:
            self._draining.release()

    def _drain(self) -> None:
        """Write the queue to disk, and sync the file if a sync is due. The ticker calls this method."""
        with self._draining:
            now_ns = self._clock.now_ns()
            if self._closed or (self._failure and now_ns < self._retry_ns):
                return
            self._busy_since_ns = now_ns
            self._look()
            self._write_queue()
            now_ns = self._clock.now_ns()
            due = self._sync_period_ns is not None and now_ns - self._synced_ns >= self._sync_period_ns
            if due and not self._failure and self._store is not None:
                self._synced_ns = now_ns
                try:
                    self._store.sync()
                except OSError as error:
                    self._fail(error)
            self._busy_since_ns = None

    def _look(self) -> None:
        """Report a failure if another process has removed the log files. The next write creates new files."""
        store = self._store
        with suppress(OSError):
            if store is not None and store.removed():
                self._store = None
                self._unwritten += store.packets
                self._fail(FileNotFoundError(errno.ENOENT, "the run's files were removed"))
                store.close()

    def _write_queue(self) -> None:
        """Write the queued packets. Packets that cannot be written remain in the queue."""
        if self._store is None:
            if self._failure and self._clock.now_ns() < self._retry_ns and not self._closed:
                return
            try:
                self._store = self._begin()
            except OSError as error:
                self._fail(error)
                return
        packets = [self._queue.popleft() for _ in range(len(self._queue))]
        before = self._store.packets
        try:
            self._store.append(packets)
            self._failure = ""
        except OSError as error:
            self._fail(error)
            self._queue.extendleft(reversed(packets[self._store.packets - before :]))

    def _fail(self, error: OSError) -> None:
        self._failure = self._past_failure = f"writing stopped: {error.strerror or error}"
        self._retry_ns = self._clock.now_ns() + _RETRY_NS

    def _give_up(self) -> None:
        """Empty the queue and count its packets as lost."""
        self._unwritten += len(self._queue)
        self._queue.clear()


def _clear(folder: Path, stem: str, overwrite: bool) -> None:
    """Create the folder of a log, and remove an old log if `overwrite`.

    Raises UsageError if there is an old log that must not be removed, and OSError if the disk fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    old = find_segments(folder, stem)
    if old and not overwrite:
        raise UsageError(f"{old[0]} exists: give another folder, or remove the log")
    for path in old:
        path.unlink()


_STATUS = (RUN, CONTROL, ATTITUDE, HOUSEKEEPING, HEALTH)
_STATUS_EVENTS = 2
"""Number of events in a status report. The number is small enough for a status report and a command answer to
fit into one Ethernet frame."""


class Log(Protocol):
    """Destination of packets."""

    def write(self, packet: bytes) -> None:
        """Store a packet without blocking."""


class Recorder:
    """Recorder that packs values into packets, converts clock time to mission time and writes to the logs.

    A record that cannot be packed is lost and counted. The calling task receives no error.

    Attributes:
        epoch_ns: clock time (ns) of mission time zero.
        lost: number of records lost because their values did not fit into the packet.
        lost_text: reason for the loss of the newest lost record.
    """

    def __init__(self, flight: Log, performance: Log) -> None:
        self._flight, self._performance = flight, performance
        self._flight_packer = Packer()
        self._performance_packer = Packer()
        self._newest: dict[str, bytes] = {}
        self._events: deque[bytes] = deque(maxlen=_STATUS_EVENTS)
        self.epoch_ns = self.lost = 0
        self.lost_text = ""

    def record(self, packet: Packet, time_ns: int, **values: Any) -> bytes | None:
        """Write a packet of values to the flight log, and return it, or None if the values do not fit."""
        packed = self._pack(self._flight_packer, packet, time_ns, values)
        if packed is not None:
            self._newest[packet.name] = packed
            self._flight.write(packed)
        return packed

    def status(self) -> bytes:
        """Return a status report: the newest status packets, followed by the newest events, oldest first.

        Events about executed commands are omitted, because each status request would add such an event.
        """
        newest = [self._newest[packet.name] for packet in _STATUS if packet.name in self._newest]
        return b"".join([*newest, *self._events])

    def newest(self, packet: Packet) -> bytes:
        """Return the newest packet of a type, or empty bytes if no such packet was written."""
        return self._newest.get(packet.name, b"")

    def time(self, packet: Packet, time_ns: int, **values: Any) -> None:
        """Pack values and write the packet to the performance log."""
        packed = self._pack(self._performance_packer, packet, time_ns, values)
        if packed is not None:
            self._performance.write(packed)

    def event(self, kind: EventKind, time_ns: int, suppressed: int, text: str) -> None:
        """Write an event to the flight log. `flight.loop.facts.EventLog` calls this method."""
        packed = self.record(
            EVENT,
            time_ns,
            code=kind.code,
            severity=int(kind.severity),
            suppressed=suppressed,
            name=kind.name,
            text=text,
        )
        if packed is not None and kind is not COMMANDED:
            self._events.append(packed)

    def _pack(self, packer: Packer, packet: Packet, time_ns: int, values: dict[str, Any]) -> bytes | None:
        try:
            return packer.pack(packet, time_ns - self.epoch_ns, values)
        except TelemetryError as error:
            self.lost += 1
            self.lost_text = str(error)
            return None
