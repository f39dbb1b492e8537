"""How the stored state changes from boot to boot: pure functions.

Crashes are counted per operating time, the sum over all boots of monotonic running time: a wrong or stepped
clock has no effect, and a board that crashes at once, repeatedly, does not age its crashes out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from flight.loop.state.content import (
    LONGEST_LABEL,
    REMEMBERED,
    KeptTable,
    Learned,
    StoredState,
    UncleanShutdown,
)


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
    """What the loop has for the next write: the mode, what it learned, and the table of parameters."""

    mode: str
    learned: Mapping[str, Learned]
    table: KeptTable


def begin(state: StoredState, utc: str, devices: str = "") -> StoredState:
    """Return the state of the next boot: running, and with a crash of the last boot recorded.

    Parameters learned of other `devices` are discarded, and a loaded table that a crash left unproven.
    """
    unclean = state.unclean
    if state.running:
        unclean = (*unclean, UncleanShutdown(state.boot_count, state.operated, state.utc))[-REMEMBERED:]
    return msgspec.structs.replace(
        state,
        boot_count=state.boot_count + 1,
        running=True,
        unclean=unclean,
        utc=utc,
        learned=state.learned if state.devices == devices else {},
        devices=devices,
        table=_trusted(state.table) if state.running else state.table,
    )


def _trusted(table: KeptTable) -> KeptTable:
    """Return the table to fly after an unclean shutdown: the one before, where it is not proven."""
    if table.proven:
        return table
    return msgspec.structs.replace(table, values=table.before, before={}, proven=True)


def go_on(begun: StoredState, elapsed: float, noted: Noted, utc: str) -> StoredState:
    """Return the state `elapsed` s after the start `begun`; new learned parameters replace the old."""
    return msgspec.structs.replace(
        begun,
        operated=begun.operated + max(elapsed, 0.0),
        mode=noted.mode[:LONGEST_LABEL] or begun.mode,
        learned={**begun.learned, **noted.learned},
        table=noted.table,
        utc=utc,
    )


def end(state: StoredState) -> StoredState:
    """Return the state after a clean end."""
    return msgspec.structs.replace(state, running=False)


def boot_record(begun: StoredState, window: float) -> BootRecord:
    """Return the boot record of the state of a new boot; `window` in s of operating time."""
    recent = sum(begun.operated - shutdown.operated <= window for shutdown in begun.unclean)
    after = bool(begun.unclean) and begun.unclean[-1].boot == begun.boot_count - 1
    return BootRecord(begun.boot_count, recent, after, begun.mode)
