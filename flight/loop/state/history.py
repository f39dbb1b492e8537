"""How the stored state changes from boot to boot: pure functions.

Crashes are counted per operating time, the sum over all boots of monotonic running time: a wrong or stepped
clock has no effect, and a board that crashes at once, repeatedly, does not age its crashes out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from flight.loop.state.content import LONGEST_LABEL, REMEMBERED, Learned, StoredState, UncleanShutdown


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


def begin(state: StoredState, utc: str, devices: str = "") -> StoredState:
    """Return the state of the next boot: running, and with a crash of the last boot recorded.

    Parameters learned of other `devices` are discarded.
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
    """Return the state `elapsed` s after the start `begun`; new learned parameters replace the old."""
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
    """Return the boot record of the state of a new boot; `window` in s of operating time."""
    recent = sum(begun.operated - shutdown.operated <= window for shutdown in begun.unclean)
    after = bool(begun.unclean) and begun.unclean[-1].boot == begun.boot_count - 1
    return BootRecord(begun.boot_count, recent, after, begun.mode)
