"""State that is stored for the next boot: its content, its two copies on disk, and the thread that writes it.

The stored state has typed and bounded values, and is checked when it is read. UTC is stored only as a label,
and is not used in computations. Crashes are counted over the operating time, which is the monotonic running
time summed over all boots. A wrong wall clock therefore does not affect the count, and a flight computer that
crashes repeatedly soon after its start still counts its earlier crashes.

The learned parameters are estimated properties of the devices, such as biases; attitude and rate are not
stored. The next boot starts its filter from the learned parameters. The covariance of the learned parameters
is increased by a fraction of the configured prior, because the devices may have changed since the last boot.
Learned values that are implausible under the configured prior are rejected.

Each copy of the state is a file with a line of JSON and a line with the CRC-32 of the first line. Both copies
are written each time, one after the other, so that at least one copy survives a crash. A file is replaced
atomically, so that it contains either the old or the new content after a crash. The order of the system calls
follows Pillai et al., "All File Systems Are Not Created Equal" (OSDI 2014), section 2: write a temporary
file, sync it, rename it over the old file, sync the folder. All calls go through `LinuxFiles`, so that a test
can simulate a power loss before any call.

The number of each boot is also written to files in the folder of the state and in the folder of the run.
After the repair of a file system or the restoration of a backup, an intact copy of the state may be outdated.
An outdated copy is recognised by a boot count that is smaller than the boot number in the files of the two
folders.

The control thread sets values in memory, and a ticker thread writes them to disk. The state is also written
at the start, before the loop runs, and at the end, when the coil currents are zero. A disk that hangs delays
only the ticker thread.
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
from flight.link.files.store import line_of, make_lasting, read_regular, to_record
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import Clock
from knightcube.astro.arrays import FloatArray
from knightcube.errors import KnightCubeError
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
"""Maximum number of unclean shutdowns in the stored state."""


class StatePart(msgspec.Struct, frozen=True):
    """Base class of the stored types. Unknown keys, which a later release has written, are ignored."""


class Learned(StatePart, frozen=True):
    """Parameters learned in flight: `values` (n,) and the rows of their covariance (n, n), in SI units."""

    values: Annotated[tuple[float, ...], Meta(min_length=1, max_length=64)]
    covariance: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(values: FloatArray, covariance: FloatArray) -> Learned:
        """Return the stored form of values (n,) and covariance (n, n), which is made exactly symmetric."""
        even = 0.5 * (covariance + covariance.T)
        return Learned(tuple(values.tolist()), tuple(map(tuple, even.tolist())))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Return values (n,) and covariance (n, n)."""
        return np.array(self.values), np.array(self.covariance)


class UncleanShutdown(StatePart, frozen=True):
    """An unclean shutdown: boot number, and operating time (s) and UTC label of the last state before it."""

    boot: Count
    operated: Seconds
    utc: Label


class KeptTable(StatePart, frozen=True, kw_only=True):
    """A table of onboard parameters that a command has loaded, with values by configuration key.

    Attributes:
        before: values in use before this table was loaded; empty for the configured values.
        proven: whether the table has been in use long enough to be kept after an unclean shutdown.
        loads: number of tables that have been loaded so far.
    """

    values: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    before: Annotated[dict[Label, float], Meta(max_length=256)] = {}
    proven: bool = True
    loads: Count = 0


class StoredState(StatePart, frozen=True, kw_only=True, omit_defaults=True):
    """The state that is stored for the next boot.

    Attributes:
        boot_count: number of times that the application was started.
        operated: total operating time (s) by the monotonic clock, over which crashes are counted.
        running: true from the start of the application until its clean end.
        unclean: unclean shutdowns, oldest first.
        mode: name of the mode at the last write.
        utc: UTC of the last write, as a label.
        learned: learned parameters by name.
        devices: digest of the device configuration for which the parameters were learned.
        table: table of onboard parameters that an operator has loaded.
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
    """Raise ValueError for a state that must not be stored, such as one with a non-finite number."""
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
    """Information about earlier boots that is needed at the start.

    Attributes:
        boot_count: number of this boot, which is 1 for the first boot.
        unclean_recent: number of unclean shutdowns in the recent operating time (`CRASH_WINDOW`).
        after_unclean: whether the previous boot ended uncleanly.
        mode: name of the mode at the end of the last boot; empty at the first boot.
    """

    boot_count: int
    unclean_recent: int
    after_unclean: bool
    mode: str


@dataclass(frozen=True, slots=True)
class Noted:
    """Values that the loop has set for the next write: mode, learned parameters and parameter table."""

    mode: str
    learned: Mapping[str, Learned]
    table: KeptTable


def begin_boot(state: StoredState, utc: str, devices: str = "") -> StoredState:
    """Return the state of the next boot, marked as running; a crash of the last boot is recorded in it.

    Parameters that were learned for devices other than `devices` are discarded. After a crash, the previous
    table replaces an unproven table.
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
    """Return the state `elapsed` s after a boot that began with `begun`, with newly learned parameters."""
    return msgspec.structs.replace(
        begun,
        operated=begun.operated + max(elapsed, 0.0),
        mode=noted.mode[:LONGEST_LABEL] or begun.mode,
        learned={**begun.learned, **noted.learned},
        table=noted.table,
        utc=utc,
    )


def end_cleanly(state: StoredState) -> StoredState:
    """Return the state as stored after a clean end."""
    return msgspec.structs.replace(state, running=False)


CRASH_WINDOW = 600.0
"""Operating time (s) within which an unclean shutdown counts as recent."""


def boot_record(begun: StoredState, window: float) -> BootRecord:
    """Return the record of a boot; an unclean shutdown is recent within `window` s of operating time."""
    recent = sum(begun.operated - shutdown.operated <= window for shutdown in begun.unclean)
    after = bool(begun.unclean) and begun.unclean[-1].boot == begun.boot_count - 1
    return BootRecord(begun.boot_count, recent, after, begun.mode)


GYRO_BIAS, PLANT, IMU_LATENCY, MAGNETOMETER_BIAS = "gyro-bias", "plant", "imu-latency", "magnetometer-bias"

_PLAUSIBLE_SIGMAS = 4.0
"""Largest plausible deviation of a learned value from its configured prior, in standard deviations."""


def learned_of(estimate: Estimate) -> dict[str, Learned]:
    """Return the slowly changing parameters of an estimate by name, in the estimate's units and axes.

    The parameters are the gyro bias, the torsion, damping and coil gain of the plant, the latency of the
    inertial unit's samples, and the magnetometer bias. The cross-covariances of the parameters are discarded.
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
    """Return a digest of the hardware sections of a configuration."""
    return f"{zlib.crc32(msgspec.json.encode(config.hardware())):08x}"


def start_from(
    learned: Mapping[str, Learned], configured: SlowPrior, changed: float
) -> tuple[SlowPrior, list[str]]:
    """Return the filter's prior, and the reasons why learned parameters were rejected.

    If nothing was learned, the prior is `configured`. Each learned value is assumed to have changed since the
    last boot by `changed` times its standard deviation in `configured`.
    """
    problems: list[str] = []

    def accept(name: str, values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        if name not in learned:
            return values, covariance
        found, spread = learned[name].arrays()
        variance = np.diag(covariance)
        sigma, problem = np.sqrt(variance), ""
        if found.shape != values.shape:
            problem = f"{len(values)} values are required"
        elif np.any((sigma > 0.0) & (np.abs(found - values) > _PLAUSIBLE_SIGMAS * sigma)):
            problem = f"not within {_PLAUSIBLE_SIGMAS:g} sigma of {values.tolist()} +- {sigma.tolist()}"
        if problem:
            problems.append(f"{name} {found.tolist()}: {problem}")
            return values, covariance
        # Parameters that are not to be estimated keep their configured value.
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
"""Largest size (bytes) of a file that is read."""


class LinuxFiles:
    """The file system calls that store the state. They may raise OSError, and tests can replace them."""

    def read(self, path: Path) -> bytes | None:
        """Return the content of a regular file of at most `LARGEST_FILE` bytes, or None if it is missing."""
        return read_regular(path, LARGEST_FILE)

    def create(self, path: Path) -> int:
        """Create an empty file, which replaces any existing file, and return a descriptor for writing."""
        with suppress(FileNotFoundError):
            os.unlink(path)
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)

    def write(self, file: int, data: bytes) -> int:
        """Write `data` or only its beginning, and return the number of bytes written."""
        return os.write(file, data)

    def sync(self, file: int) -> None:
        """Make the content of a file durable."""
        os.fsync(file)

    def close(self, file: int) -> None:
        """Close a descriptor."""
        os.close(file)

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file atomically; if a file already has the new name, it is replaced."""
        os.rename(old, new)

    def sync_folder(self, folder: Path) -> None:
        """Make the directory entries of a folder durable."""
        make_lasting(folder)


def replace_file(files: LinuxFiles, path: Path, data: bytes) -> None:
    """Replace the content of a file durably. After an OSError, the file has its old or its new content."""
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
    """Write the number of a boot to a file in each folder. Never raises."""
    for folder in folders:
        with suppress(OSError):
            replace_file(LinuxFiles(), folder / NOTE, to_record(b"%d" % number))


def newest_boot(folders: Iterable[Path]) -> int:
    """Return the highest boot number that `note_boot` wrote to the folders, or 0. Never raises."""
    numbers = [0]
    for folder in folders:
        with suppress(OSError):
            text = line_of(LinuxFiles().read(folder / NOTE) or b"") or b""
            if text.isdigit() and len(text) < 16:  # 2^53, the largest boot count, has 16 digits
                numbers.append(int(text))
    return max(numbers)


COPIES = ("state-a.json", "state-b.json")

Report = Callable[[EventKind, str], None]
"""Function that reports an event, given its kind and text."""


class _StateCopy(msgspec.Struct, frozen=True):
    """JSON content of one copy of the state."""

    generation: Annotated[int, Meta(ge=1, le=2**62)]
    state: StoredState


@dataclass(frozen=True, slots=True)
class _ReadCopy:
    """Result of reading one copy of the state. The text `problem` is empty for a valid or missing copy."""

    name: str
    copy: _StateCopy | None
    problem: str


class StateStore:
    """Stores a StoredState in a folder. Only one process may use a folder at a time."""

    def __init__(self, folder: Path, report: Report, files: LinuxFiles | None = None) -> None:
        self._folder, self._report = folder, report
        self._files = files or LinuxFiles()
        self._generation = 0
        self._order: tuple[str, ...] = COPIES

    def load(self) -> StoredState:
        """Return the newest valid copy, or defaults. Losing the state counts as an unclean shutdown.

        Never raises.
        """
        read = [self._read(name) for name in COPIES]
        whole = [r for r in read if r.copy is not None]
        newest = max(whole, key=lambda r: r.copy.generation if r.copy else 0, default=None)
        # A missing copy is written first, so that an interrupted write leaves the existing copy intact.
        self._order = tuple(r.name for r in sorted(read, key=lambda r: r.copy is not None or bool(r.problem)))
        first = newest is None or newest.copy is None or newest.copy.generation == 1
        problems = (
            (r.name, r.problem or ("is missing" if r.copy is None and not first else "")) for r in read
        )
        bad = "; ".join(f"{name}: {problem}" for name, problem in problems if problem)
        if newest is None or newest.copy is None:
            if not bad:
                return StoredState()
            self._report(events.STATE_LOST, f"{bad}: defaults are used; the last shutdown counts as unclean")
            return StoredState(running=True)
        self._generation = newest.copy.generation
        if bad:
            self._report(events.STATE_RECOVERED, f"{bad}: read from {newest.name}")
        return newest.copy.state

    def store(self, state: StoredState) -> bool:
        """Write both copies, and return whether one is durable. Raises ValueError for an invalid state."""
        data = encode(self._generation + 1, state)
        failures = []
        for name in self._order:
            try:
                replace_file(self._files, self._folder / name, data)
            except OSError as error:
                failures.append(f"{name}: {error.strerror or error}")
        if failures:
            self._report(events.STATE_UNWRITTEN, "; ".join(failures))
        # A generation number is never reused, because a write that failed may have reached the disk.
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
    """Return the bytes of one copy of the state. Raises ValueError for a state that `decode` would reject."""
    check(state)
    data = to_record(msgspec.json.encode(_StateCopy(generation, state)))
    decode(data)
    return data


def decode(data: bytes) -> _StateCopy:
    """Return the content of one copy of the state. Raises ValueError for a damaged or invalid copy."""
    if len(data) > LARGEST_FILE:
        raise ValueError(f"{len(data)} bytes are too many")
    line = line_of(data)
    if line is None:
        raise ValueError(f"torn or corrupt, {len(data)} bytes")
    try:
        copy = msgspec.json.decode(line, type=_StateCopy)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"contains another kind of state: {str(error)!r}") from error
    check(copy.state)
    return copy


_HUNG_DISK_S = 5.0
_NOTICES = 64


class Notices:
    """Stores the newest events of threads that have no event log, until the loop collects them."""

    def __init__(self) -> None:
        self._kept: deque[tuple[EventKind, str]] = deque(maxlen=_NOTICES)

    def report(self, kind: EventKind, text: str) -> None:
        """Store an event. Any thread may call this method."""
        self._kept.append((kind, text))

    def drain(self) -> list[tuple[EventKind, str]]:
        """Return the events since the last call, oldest first."""
        return [self._kept.popleft() for _ in range(len(self._kept))]


class StateKeeper:
    """Keeps the stored state up to date from the start of a boot to its end.

    The `record` and the parameters `learned` come from earlier boots. The flag `counted` states whether the
    number of this boot was written. The attribute `table` is the table of onboard parameters to be used. The
    flag `is_flying` states whether the flight has called `note`, which it does about once a second.
    """

    def __init__(
        self,
        store: StateStore,
        notices: Notices,
        clock: Clock,
        *,
        devices: str = "",
        period_ns: int,
        boots: int = 0,
    ) -> None:
        """Load the state, increase its boot count, and store it as running.

        The digest `devices` identifies the present devices; parameters learned for other devices are
        discarded. The argument `boots` is the highest boot number that `note_boot` has written. If the boot
        count of the state is smaller than `boots`, the state is outdated or lost, and the last boot counts as
        unclean.
        """
        self._store, self._notices, self._clock = store, notices, clock
        self._begun_ns = clock.now_ns()
        loaded = store.load()
        if boots > loaded.boot_count:
            notices.report(
                events.STATE_OLD,
                f"the state was saved in boot {loaded.boot_count}, but boot {boots} is recorded",
            )
            loaded = msgspec.structs.replace(loaded, boot_count=boots, running=True)
        self._begun = begin_boot(loaded, self._label(), devices)
        self.record: BootRecord = boot_record(self._begun, CRASH_WINDOW)
        self.learned: Mapping[str, Learned] = self._begun.learned
        self.table = self._begun.table
        self._noted = Noted(self._begun.mode, {}, self.table)
        self._writing = threading.Lock()  # lock held while writing, not acquired by note()
        self._closed = self.is_flying = False
        self._report_changes(loaded)
        self.counted = store.store(self._begun)
        self._ticker = clock.ticker("state", period_ns, self._write)

    def _report_changes(self, loaded: StoredState) -> None:
        """Report how this boot changed the stored state."""
        begun, report = self._begun, self._notices.report
        if loaded.learned and not begun.learned:
            former = loaded.devices or "of an older version"
            text = f"learned with devices {former}, but the present devices are {begun.devices}"
            report(events.LEARNED_REFUSED, text)
        if begun.table.values != loaded.table.values:
            report(
                events.PARAMETERS_LEFT, "the table had just been loaded when the last boot ended uncleanly"
            )
        if self.record.after_unclean:
            last = begun.unclean[-1]
            recent = self.record.unclean_recent
            text = f"boot {last.boot}, last state of {last.utc}; recent unclean shutdowns: {recent}"
            report(events.UNCLEAN_SHUTDOWN, text)

    def note(self, mode: str, learned: Mapping[str, Learned] | None = None) -> None:
        """Set mode and learned parameters for the next write. Never waits."""
        self.is_flying = True
        self._noted = replace(
            self._noted, mode=mode, learned=self._noted.learned if learned is None else learned
        )

    def note_table(self, table: KeptTable) -> None:
        """Set the table of onboard parameters for the next write. Never waits."""
        self._noted = replace(self._noted, table=table)

    def notices(self) -> list[tuple[EventKind, str]]:
        """Return the events about the stored state since the last call."""
        return self._notices.drain()

    def close(self, clean: bool) -> None:
        """Write the final state and whether the end is `clean`, waiting at most 5 s. May be called twice."""
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
        """Write the newest values to disk, as the periodic job of the ticker."""
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
            # Only the learned parameters can be invalid, so the state is stored without them.
            self._notices.report(events.STATE_UNWRITTEN, str(error))
            self._noted = replace(noted, learned={})
            state = state_after(self._begun, elapsed, self._noted, self._label())
            self._store.store(end_cleanly(state) if ended else state)

    def _label(self) -> str:
        """Return UTC as text."""
        return f"{datetime.fromtimestamp(self._clock.utc_ns() * 1e-9, UTC):%Y-%m-%dT%H:%M:%SZ}"


def state_folder(config: Config, environment: Mapping[str, str]) -> Path | None:
    """Return the configured folder of the state, or systemd's for real devices; None if there is none."""
    if config.state.folder is not None:
        return Path(config.state.folder)
    if config.simulation is not None:
        return None
    return service_folder(environment)


def service_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the state folder of a systemd service, or None outside a service."""
    # systemd separates several folders by colons; the first folder belongs to the application.
    first = environment.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(first) if first else None


def open_state(
    config: Config, environment: Mapping[str, str], clock: Clock, stack: ExitStack, runs: Sequence[Path] = ()
) -> StateKeeper | None:
    """Open the stored state and count this boot, or return None if no state is stored.

    The sequence `runs` holds the folders of the newest runs, which contain files with boot numbers. The last
    folder belongs to the present run. When `stack` closes, the final state is written, as a clean end unless
    an exception was raised. A DeviceError counts as a clean end, because it is reported as a device error and
    safe mode would not help. During the start, KnightCubeError and OSError also count as a clean end, because
    the start is retried after them.
    """
    folder = state_folder(config, environment)
    if folder is None:
        return None
    with suppress(OSError):  # the first write reports a missing folder
        folder.mkdir(parents=True, exist_ok=True)
    notices = Notices()
    keeper = StateKeeper(
        StateStore(folder, notices.report),
        notices,
        clock,
        devices=digest_of(config),
        period_ns=round(config.state.period * 1e9),
        boots=newest_boot([folder, *runs]),
    )
    if keeper.counted:
        note_boot([folder, *runs[-1:]], keeper.record.boot_count)

    def close(kind: type[BaseException] | None, *_: object) -> bool:
        harmless = DeviceError if keeper.is_flying else DeviceError | KnightCubeError | OSError
        keeper.close(clean=kind is None or issubclass(kind, harmless))
        return False

    stack.push(close)
    return keeper
