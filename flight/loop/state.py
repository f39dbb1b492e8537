"""The state that outlives the process: its content, its two copies on disk, and the thread that writes them.

The state is typed, bounded and validated. UTC is a label for people, never used in computations. Crashes are
counted per operating time, the sum over all boots of monotonic running time: a wrong or stepped clock has no
effect, and a board that crashes at once, repeatedly, does not age its crashes out.

The learned parameters are the parts of an estimate that belong to the devices, not to the motion. The next
boot starts from them, with the covariance increased by a fraction of the configured prior, for changes
meanwhile. Values that the prior makes implausible are rejected.

A copy is one line of JSON and a line with the CRC-32 of the first. Both copies are written each time, one
after the other, so that one copy survives a crash or damage to the other. A file is replaced atomically: a
crash at any moment leaves either the old or the new content. The order is that of Pillai et al., "All File
Systems Are Not Created Equal" (OSDI 2014), section 2: write a temporary file, sync it, rename it over the old
one, sync the folder. Each call goes through `LinuxFiles`, so that a test can simulate a power loss before any
of them.

The number of each boot is also noted in the state's folder and in the folder of its run. Intact copies may
still be old, after the repair of a file system or from a backup: a state that counts fewer boots than a note
is recognised.

The control thread sets values in memory, a ticker's thread writes them. The disk is written at the start,
before the loop, by the clock's ticker during the flight, and at the end, when the coils are at zero; a
hanging disk delays only the ticker.
"""

from __future__ import annotations

import dataclasses
import math
import os
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from flight.link import events
from flight.link.events import EventKind
from flight.link.regular_files import make_lasting, read_regular
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import Clock
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import (
    BIAS,
    FIELD_BIAS,
    LATENCY,
    PARAMETERS,
    Estimate,
    Parameters,
    SlowPrior,
)

Count = Annotated[int, Meta(ge=0, le=2**53)]
Seconds = Annotated[float, Meta(ge=0.0)]
LONGEST_LABEL = 32
Label = Annotated[str, Meta(max_length=LONGEST_LABEL)]

REMEMBERED = 32
"""Number of newest unclean shutdowns that are kept."""


class StatePart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the state; unknown keys are rejected."""


class Learned(StatePart, frozen=True):
    """Parameters learned in flight: `values` (n,) and their covariance (n, n), by rows, in SI units."""

    values: Annotated[tuple[float, ...], Meta(min_length=1, max_length=16)]
    covariance: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(values: FloatArray, covariance: FloatArray) -> Learned:
        """Return the stored form of arrays; the covariance is made exactly symmetric."""
        even = 0.5 * (covariance + covariance.T)
        return Learned(tuple(values.tolist()), tuple(map(tuple, even.tolist())))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Return values (n,) and covariance (n, n)."""
        return np.array(self.values), np.array(self.covariance)


class UncleanShutdown(StatePart, frozen=True):
    """An unclean shutdown: boot number, and operating time and UTC label of its last stored state."""

    boot: Count
    operated: Seconds
    utc: Label


class KeptTable(StatePart, frozen=True, kw_only=True):
    """A table of parameters that was loaded: values by the configuration's keys.

    Attributes:
        before: the values that flew before it, empty for those of the configuration.
        proven: whether it has flown long enough to be trusted after an unclean shutdown.
        loads: tables loaded so far.
    """

    values: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    before: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    proven: bool = True
    loads: Count = 0


class StoredState(StatePart, frozen=True, kw_only=True, omit_defaults=True):
    """The stored state.

    Attributes:
        boot_count: how often the application has started.
        operated: s, total operating time by the monotonic clock: the time scale of crash counts.
        running: set at the start and cleared at a clean end.
        unclean: unclean shutdowns, oldest first.
        mode: the mode at the last write.
        utc: a label of the last write.
        learned: parameters by name.
        devices: digest of the configuration of the devices that the parameters belong to.
        table: the table of parameters that an operator loaded.
    """

    boot_count: Count = 0
    operated: Seconds = 0.0
    running: bool = False
    unclean: Annotated[tuple[UncleanShutdown, ...], Meta(max_length=REMEMBERED)] = ()
    mode: Label = ""
    utc: Label = ""
    learned: Annotated[dict[Label, Learned], Meta(max_length=32)] = {}
    devices: Label = ""
    table: KeptTable = KeptTable()


def check(state: StoredState) -> None:
    """Raise ValueError for a state that must not be stored: a non-finite number, an invalid covariance."""
    if not all(
        math.isfinite(t) for t in (state.operated, *(shutdown.operated for shutdown in state.unclean))
    ):
        raise ValueError("an operating time is not finite")
    tables = (state.table.values, state.table.before)
    if not all(math.isfinite(value) for table in tables for value in table.values()):
        raise ValueError("a parameter is not finite")
    for name, learned in state.learned.items():
        size = len(learned.values)
        if [len(row) for row in learned.covariance] != [size] * size:
            raise ValueError(f"{name}: the covariance of {size} values is not a {size} x {size} matrix")
        values, covariance = learned.arrays()
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise ValueError(f"{name}: a value or its covariance is not finite")
        if not np.array_equal(covariance, covariance.T):
            raise ValueError(f"{name}: the covariance is not symmetric")
        scale = float(np.max(np.abs(covariance)))
        if scale > 0.0 and float(np.linalg.eigvalsh(covariance / scale)[0]) < -1e-9:
            raise ValueError(f"{name}: the covariance has a negative eigenvalue")


@dataclass(frozen=True, slots=True)
class BootRecord:
    """The history of earlier boots, as needed at the start.

    Attributes:
        boot_count: this boot's number, 1 the first.
        unclean_recent: unclean shutdowns within the given window of operating time.
        after_unclean: whether the previous boot ended uncleanly.
        mode: the mode at the last stop; empty when there was none.
    """

    boot_count: int
    unclean_recent: int
    after_unclean: bool
    mode: str


@dataclass(frozen=True, slots=True)
class Noted:
    """The loop's values for the next write: the mode, the learned parameters, and the table of parameters."""

    mode: str
    learned: Mapping[str, Learned]
    table: KeptTable


def begin_boot(state: StoredState, utc: str, devices: str = "") -> StoredState:
    """Return the state of the next boot: running, and with a crash of the last boot recorded.

    Parameters learned of other `devices` are discarded. After a crash, an unproven table is replaced by the
    table that flew before it.
    """
    unclean = state.unclean
    if state.running:
        unclean = (*unclean, UncleanShutdown(state.boot_count, state.operated, state.utc))[-REMEMBERED:]
    table = state.table
    if state.running and not table.proven:
        table = msgspec.structs.replace(table, values=table.before, before={}, proven=True)
    return msgspec.structs.replace(
        state,
        boot_count=state.boot_count + 1,
        running=True,
        unclean=unclean,
        utc=utc,
        learned=state.learned if state.devices == devices else {},
        devices=devices,
        table=table,
    )


def state_after(begun: StoredState, elapsed: float, noted: Noted, utc: str) -> StoredState:
    """Return the state `elapsed` s after the start `begun`; new learned parameters replace the old."""
    return msgspec.structs.replace(
        begun,
        operated=begun.operated + max(elapsed, 0.0),
        mode=noted.mode[:LONGEST_LABEL] or begun.mode,
        learned={**begun.learned, **noted.learned},
        table=noted.table,
        utc=utc,
    )


def end_cleanly(state: StoredState) -> StoredState:
    """Return the state after a clean end."""
    return msgspec.structs.replace(state, running=False)


CRASH_WINDOW = 600.0
"""Operating time (s) in which unclean shutdowns count as recent."""


def boot_record(begun: StoredState, window: float) -> BootRecord:
    """Return the boot record of the state of a new boot; `window` in s of operating time."""
    recent = sum(begun.operated - shutdown.operated <= window for shutdown in begun.unclean)
    after = bool(begun.unclean) and begun.unclean[-1].boot == begun.boot_count - 1
    return BootRecord(begun.boot_count, recent, after, begun.mode)


GYRO_BIAS, PLANT, IMU_LATENCY, MAGNETOMETER_BIAS = "gyro-bias", "plant", "imu-latency", "magnetometer-bias"

_PLAUSIBLE_SIGMAS = 4.0
"""Largest deviation of a learned value from the configured prior, in sigmas."""


def learned_of(estimate: Estimate) -> dict[str, Learned]:
    """Return the estimate's slow parts by name, in its units and axes.

    The gyro's bias; torsion, damping and coil gain of the plant; the age of the inertial unit's samples; the
    magnetometer's bias. Cross-covariances are dropped.
    """
    parts: dict[str, tuple[FloatArray, slice]] = {
        GYRO_BIAS: (estimate.bias, BIAS),
        PLANT: (np.array(estimate.parameters), PARAMETERS),
        IMU_LATENCY: (np.array([estimate.latency]), slice(LATENCY, LATENCY + 1)),
        MAGNETOMETER_BIAS: (estimate.field_bias, FIELD_BIAS),
    }
    return {
        name: Learned.of(values, estimate.covariance[where, where]) for name, (values, where) in parts.items()
    }


def digest_of(config: Config) -> str:
    """Return a digest of the devices of a configuration."""
    return f"{zlib.crc32(msgspec.json.encode(config.hardware())):08x}"


def start_from(
    learned: Mapping[str, Learned], configured: SlowPrior, changed: float
) -> tuple[SlowPrior, list[str]]:
    """Return the filter's prior, and why learned parameters were rejected.

    `configured` is the prior without learning; since the last boot a value may have changed by the fraction
    `changed` of its standard deviation in `configured`.
    """
    problems: list[str] = []

    def accept(name: str, values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        if name not in learned:
            return values, covariance
        found, spread = learned[name].arrays()
        variance = np.diag(covariance)
        sigma, problem = np.sqrt(variance), ""
        if found.shape != values.shape:
            problem = f"{len(values)} values are wanted"
        elif np.any((sigma > 0.0) & (np.abs(found - values) > _PLAUSIBLE_SIGMAS * sigma)):
            problem = f"not within {_PLAUSIBLE_SIGMAS:g} sigma of {values.tolist()} +- {sigma.tolist()}"
        if problem:
            problems.append(f"{name} {found.tolist()}: {problem}")
            return values, covariance
        # Values that the configuration does not estimate stay as configured.
        estimated = variance > 0.0
        wide = np.where(np.outer(estimated, estimated), spread, 0.0) + np.diag(changed**2 * variance)
        return np.where(estimated, found, values), wide

    bias, bias_covariance = accept(GYRO_BIAS, configured.bias, configured.bias_covariance)
    plant, plant_covariance = accept(PLANT, np.array(configured.parameters), configured.parameters_covariance)
    age, age_covariance = accept(
        IMU_LATENCY, np.array([configured.latency]), np.array([[configured.latency_variance]])
    )
    torsion, damping, gain = plant.tolist()
    prior = dataclasses.replace(
        configured,
        bias=bias,
        bias_covariance=bias_covariance,
        parameters=Parameters(torsion, damping, gain),
        parameters_covariance=plant_covariance,
        latency=float(age[0]),
        latency_variance=float(age_covariance[0, 0]),
    )
    return prior, problems


LARGEST_FILE = 1 << 20
"""Size (bytes) of the largest file that is read."""


class LinuxFiles:
    """The file system calls in use; each raises OSError. Tests replace them to simulate a power loss."""

    def read(self, path: Path) -> bytes | None:
        """Return the content of a regular file of at most `LARGEST_FILE` bytes; None if it does not exist."""
        return read_regular(path, LARGEST_FILE)

    def create(self, path: Path) -> int:
        """Return the descriptor of an empty file for writing, which replaces whatever has its name."""
        with suppress(FileNotFoundError):
            os.unlink(path)
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)

    def write(self, file: int, data: bytes) -> int:
        """Write at most all of `data`; return the number of bytes written."""
        return os.write(file, data)

    def sync(self, file: int) -> None:
        """Make the file's content durable."""
        os.fsync(file)

    def close(self, file: int) -> None:
        """Close a descriptor."""
        os.close(file)

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file atomically, replacing a file of the new name."""
        os.rename(old, new)

    def sync_folder(self, folder: Path) -> None:
        """Make the names in a folder durable."""
        make_lasting(folder)


def replace_file(files: LinuxFiles, path: Path, data: bytes) -> None:
    """Replace the file's content, durably. Raises OSError; the old content then remains."""
    temporary = path.with_suffix(".tmp")
    file = files.create(temporary)
    try:
        written = 0
        while written < len(data):
            written += files.write(file, data[written:])
        files.sync(file)
    except OSError:
        with suppress(OSError):
            files.close(file)
        raise
    files.close(file)
    files.rename(temporary, path)
    files.sync_folder(path.parent)


NOTE = "boots"


def note_boot(folders: Iterable[Path], number: int) -> None:
    """Note the number of a boot in some folders. Never raises."""
    for folder in folders:
        with suppress(OSError):
            replace_file(LinuxFiles(), folder / NOTE, b"%d\n" % number)


def newest_boot(folders: Iterable[Path]) -> int:
    """Return the highest boot number noted in some folders, 0 without a note. Never raises."""
    numbers = [0]
    for folder in folders:
        with suppress(OSError):
            text = (LinuxFiles().read(folder / NOTE) or b"").strip()
            if text.isdigit() and len(text) < 16:  # 2^53, the highest count, has 16 digits
                numbers.append(int(text))
    return max(numbers)


COPIES = ("state-a.json", "state-b.json")

Report = Callable[[EventKind, str], None]
"""Reports an event: kind and text."""


class _StateCopy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of one file."""

    generation: Annotated[int, Meta(ge=1, le=2**62)]
    state: StoredState


@dataclass(frozen=True, slots=True)
class _ReadCopy:
    """One file as read; `problem` is empty when the copy is valid, or missing."""

    name: str
    copy: _StateCopy | None
    problem: str


class StateStore:
    """Stores a StoredState in a folder. Not for two processes at once."""

    def __init__(self, folder: Path, report: Report, files: LinuxFiles | None = None) -> None:
        self._folder = folder
        self._report = report
        self._files = files or LinuxFiles()
        self._generation = 0
        self._order: tuple[str, ...] = COPIES

    def load(self) -> StoredState:
        """Return the newest valid copy; defaults when there is none. Never raises.

        A lost state counts as an unclean shutdown.
        """
        read = [self._read(name) for name in COPIES]
        whole = [r for r in read if r.copy is not None]
        newest = max(whole, key=lambda r: r.copy.generation if r.copy else 0, default=None)
        # A missing copy is written first: only an interrupted first write leaves one copy alone.
        self._order = tuple(r.name for r in sorted(read, key=lambda r: r.copy is not None or bool(r.problem)))
        first = newest is None or newest.copy is None or newest.copy.generation == 1
        problems = ((r.name, r.problem or ("is gone" if r.copy is None and not first else "")) for r in read)
        bad = "; ".join(f"{name}: {problem}" for name, problem in problems if problem)
        if newest is None or newest.copy is None:
            if not bad:
                return StoredState()
            self._report(events.STATE_LOST, f"{bad}: defaults are used, which counts as an unclean shutdown")
            return StoredState(running=True)
        self._generation = newest.copy.generation
        if bad:
            self._report(events.STATE_RECOVERED, f"{bad}: read from {newest.name}")
        return newest.copy.state

    def store(self, state: StoredState) -> bool:
        """Write both copies; return whether at least one is durable. Raises ValueError if invalid."""
        data = encode(self._generation + 1, state)
        failures = []
        for name in self._order:
            try:
                replace_file(self._files, self._folder / name, data)
            except OSError as error:
                failures.append(f"{name}: {error.strerror or error}")
        if failures:
            self._report(events.STATE_UNWRITTEN, "; ".join(failures))
        # A copy whose write failed late may still be on disk: a generation is never used twice.
        self._generation += 1
        return len(failures) < len(COPIES)

    def _read(self, name: str) -> _ReadCopy:
        try:
            data = self._files.read(self._folder / name)
        except OSError as error:
            return _ReadCopy(name, None, f"cannot be read: {error.strerror or error}")
        if data is None:
            return _ReadCopy(name, None, "")
        try:
            return _ReadCopy(name, decode(data), "")
        except ValueError as error:
            return _ReadCopy(name, None, str(error))


def encode(generation: int, state: StoredState) -> bytes:
    """Return the bytes of one copy. Raises ValueError for a state that `decode` would reject."""
    check(state)
    line = msgspec.json.encode(_StateCopy(generation, state)) + b"\n"
    data = line + b"%08x\n" % zlib.crc32(line)
    decode(data)
    return data


def decode(data: bytes) -> _StateCopy:
    """Return the content of one copy. Raises ValueError for anything that `encode` does not produce."""
    if len(data) > LARGEST_FILE:
        raise ValueError(f"{len(data)} bytes are too many")
    line, end, crc = data.partition(b"\n")
    if crc != b"%08x\n" % zlib.crc32(line + end):
        raise ValueError(f"torn or corrupt, {len(data)} bytes")
    try:
        copy = msgspec.json.decode(line, type=_StateCopy)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"holds another kind of state: {str(error)!r}") from error
    check(copy.state)
    return copy


_HUNG_DISK_S = 5.0
_NOTICES = 64


class Notices:
    """Keeps the newest events of threads without an event log, until the loop collects them."""

    def __init__(self) -> None:
        self._kept: deque[tuple[EventKind, str]] = deque(maxlen=_NOTICES)

    def report(self, kind: EventKind, text: str) -> None:
        """Keep an event. Safe from any thread."""
        self._kept.append((kind, text))

    def drain(self) -> list[tuple[EventKind, str]]:
        """Return the events since the last call, oldest first."""
        return [self._kept.popleft() for _ in range(len(self._kept))]


class StateKeeper:
    """The state of one boot, from its begin to its end.

    Attributes:
        record: the history of earlier boots.
        learned: the parameters that earlier boots learned, by name.
        counted: whether this boot is on disk.
        table: the table of parameters to fly.
    """

    def __init__(
        self,
        store: StateStore,
        notices: Notices,
        clock: Clock,
        *,
        window: float,
        devices: str = "",
        period_ns: int,
        boots: int = 0,
    ) -> None:
        """Load the state, count this boot and store it as running.

        `window` is the operating time, s, in which unclean shutdowns count as recent; `devices` is the digest
        of the devices flown: parameters learned of others are discarded. A state of fewer `boots` than known
        from elsewhere is old or lost, and the last boot counts as unclean.
        """
        self._store = store
        self._notices = notices
        self._clock = clock
        self._begun_ns = clock.now_ns()
        loaded = store.load()
        if boots > loaded.boot_count:
            notices.report(events.STATE_OLD, f"of boot {loaded.boot_count}, but boot {boots} was noted")
            loaded = msgspec.structs.replace(loaded, boot_count=boots, running=True)
        self._begun = begin_boot(loaded, self._label(), devices)
        self.record: BootRecord = boot_record(self._begun, window)
        self.learned: Mapping[str, Learned] = self._begun.learned
        self.table = self._begun.table
        self._noted = Noted(self._begun.mode, {}, self.table)
        self._writing = threading.Lock()  # held while writing, never acquired by note()
        self._closed = False
        self._report_changes(loaded)
        self.counted = store.store(self._begun)
        self._ticker = clock.ticker("state", period_ns, self._write)

    def _report_changes(self, loaded: StoredState) -> None:
        """Report how the begin of this boot changed the stored state."""
        begun, report = self._begun, self._notices.report
        if loaded.learned and not begun.learned:
            text = (
                f"learned of the devices {loaded.devices or 'of an older version'}, these are {begun.devices}"
            )
            report(events.LEARNED_REFUSED, text)
        if begun.table.values != loaded.table.values:
            report(events.PARAMETERS_LEFT, "it had just been loaded when the last boot ended uncleanly")
        if self.record.after_unclean:
            last = begun.unclean[-1]
            recent = self.record.unclean_recent
            text = f"boot {last.boot}, last state of {last.utc}; recent unclean shutdowns: {recent}"
            report(events.UNCLEAN_SHUTDOWN, text)

    def note(self, mode: str, learned: Mapping[str, Learned] | None = None) -> None:
        """Set the mode and the learned parameters for the next write. Never waits."""
        self._noted = replace(
            self._noted, mode=mode, learned=self._noted.learned if learned is None else learned
        )

    def note_table(self, table: KeptTable) -> None:
        """Set the table of parameters for the next write. Never waits."""
        self._noted = replace(self._noted, table=table)

    def notices(self) -> list[tuple[EventKind, str]]:
        """Return the events of the state since the last call, for the event log."""
        return self._notices.drain()

    def close(self, clean: bool) -> None:
        """Write the last state, as a clean end or not. Safe to call twice; waits 5 s at most."""
        self._ticker.stop()
        if self._closed or not self._writing.acquire(timeout=_HUNG_DISK_S):
            self._closed = True
            return
        try:
            self._closed = True
            self._put(ended=clean)
        finally:
            self._writing.release()

    def _write(self) -> None:
        """Write the newest values: the ticker's job."""
        with self._writing:
            if not self._closed:
                self._put(ended=False)

    def _put(self, ended: bool) -> None:
        noted = self._noted
        elapsed = (self._clock.now_ns() - self._begun_ns) * 1e-9
        state = state_after(self._begun, elapsed, noted, self._label())
        try:
            self._store.store(end_cleanly(state) if ended else state)
        except ValueError as error:
            # Only the learned parameters are invalid; operating time and ending must still be stored.
            self._notices.report(events.STATE_UNWRITTEN, str(error))
            self._noted = replace(noted, learned={})
            state = state_after(self._begun, elapsed, self._noted, self._label())
            self._store.store(end_cleanly(state) if ended else state)

    def _label(self) -> str:
        """Return UTC as text."""
        return f"{datetime.fromtimestamp(self._clock.utc_ns() * 1e-9, UTC):%Y-%m-%dT%H:%M:%SZ}"


def state_folder(config: Config, environment: Mapping[str, str]) -> Path | None:
    """Return the state's folder: as configured, else systemd's for a flight of real devices, else None."""
    if config.state.folder is not None:
        return Path(config.state.folder)
    if config.simulation is not None:
        return None
    return service_folder(environment)


def service_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the state folder of a systemd service; None outside a service."""
    # systemd separates several folders by colons; the first is the application's own.
    first = environment.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(first) if first else None


def open_state(
    config: Config,
    environment: Mapping[str, str],
    clock: Clock,
    stack: ExitStack,
    runs: Sequence[Path] = (),
) -> StateKeeper | None:
    """Count this boot and return its state; None if no state is stored.

    `runs` are the folders of the newest runs, this one the last: the boot's number is noted in them.
    `stack` closes the state: cleanly, unless an exception passes. A DeviceError counts as clean: the device
    is reported, and safe mode would not help.
    """
    folder = state_folder(config, environment)
    if folder is None:
        return None
    with suppress(OSError):  # the first write will fail and be reported; the flight goes on
        folder.mkdir(parents=True, exist_ok=True)
    notices = Notices()
    keeper = StateKeeper(
        StateStore(folder, notices.report),
        notices,
        clock,
        window=CRASH_WINDOW,
        devices=digest_of(config),
        period_ns=round(config.state.period * 1e9),
        boots=newest_boot([folder, *runs]),
    )
    if keeper.counted:
        note_boot([folder, *runs[-1:]], keeper.record.boot_count)

    def close(kind: type[BaseException] | None, *_: object) -> bool:
        keeper.close(clean=kind is None or issubclass(kind, DeviceError))
        return False

    stack.push(close)
    return keeper
