"""How the kept state goes on from boot to boot: pure functions.

Crashes are counted in the application's own operating time, the sum over all boots of the monotonic time it
ran: a wrong or stepped clock changes nothing, and a board that crashes at once, again and again, makes no
operating time in which its crashes could be forgotten.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from flight.loop.state.content import LONGEST_LABEL, REMEMBERED, Learned, StoredState, UncleanShutdown


@dataclass(frozen=True, slots=True)
class BootRecord:
    """What a starting application wants to know of its past.

    Attributes:
        boot_count: this boot's number, 1 the first.
        unclean_recent: unclean shutdowns within the window of operating time that was asked for.
        after_unclean: whether the boot before this one ended uncleanly.
        mode: the mode at the last stop; empty when there was none.
    """

    boot_count: int
    unclean_recent: int
    after_unclean: bool
    mode: str


def begin(state: StoredState, utc: str, devices: str = "") -> StoredState:
    """Return the state of the next boot: running, and with the last one's crash remembered.

    What was learned of other `devices` than these is forgotten.
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
    )


def go_on(
    begun: StoredState, elapsed: float, mode: str, learned: Mapping[str, Learned], utc: str
) -> StoredState:
    """Return the state of a boot that `begun`, `elapsed` s later; what is learned anew replaces the old."""
    return msgspec.structs.replace(
        begun,
        operated=begun.operated + max(elapsed, 0.0),
        mode=mode[:LONGEST_LABEL] or begun.mode,
        learned={**begun.learned, **learned},
        utc=utc,
    )


def end(state: StoredState) -> StoredState:
    """Return the state after a clean end."""
    return msgspec.structs.replace(state, running=False)


def boot_record(begun: StoredState, window: float) -> BootRecord:
    """Return what the state of a boot just begun says of the past; `window` in s of operating time."""
    recent = sum(begun.operated - shutdown.operated <= window for shutdown in begun.unclean)
    after = bool(begun.unclean) and begun.unclean[-1].boot == begun.boot_count - 1
    return BootRecord(begun.boot_count, recent, after, begun.mode)
