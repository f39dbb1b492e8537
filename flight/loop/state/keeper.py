"""Opens the stored state of a boot, stores it outside the loop, and closes it at the flight's end.

The control thread sets values in memory, a ticker's thread writes them. The disk is written at the start,
before the loop, by the clock's ticker during the flight, and at the end, when the coils are at zero; a
hanging disk delays only the ticker.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from flight.link import events
from flight.link.events import EventKind
from flight.loop.state.content import (
    BootRecord,
    KeptTable,
    Learned,
    Noted,
    StoredState,
    begin_boot,
    boot_record,
    digest_of,
    end_cleanly,
    state_after,
)
from flight.loop.state.store import StateStore, newest_boot, note_boot
from flight.schema.sections import Config
from hal.interfaces.errors import DeviceError
from hal.interfaces.wires import Clock

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
            text = f"boot {last.boot}, last heard of {last.utc}: {self.record.unclean_recent} recently"
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
    """Return the state folder that systemd gives a service, None without one."""
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
    """Count this boot; return None where no state is stored.

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
        window=config.modes.crash_window,
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
