"""Tracks whether the coil currents are known; not while the PWM driver fails or the loop has stalled."""

from __future__ import annotations

from dataclasses import dataclass

from hal.interfaces.readings import CoilState

_UNSEEN_NS = 600_000_000
"""The coil driver reads its outputs back twice a second: an error may be this old when found."""
STOOD_NS = 200_000_000
"""If the loop stalls for longer, the guardian may have zeroed the coils."""


@dataclass(frozen=True, slots=True)
class CurrentValidity:
    """Whether the coil currents are known.

    Attributes:
        now: whether the currents in force are known.
        since_last_look: whether all currents since the previous look are known.
        since_ns: time since which they are known.
        uncertain_since_ns: time from which currents assumed so far turn out to be uncertain; None if none do.
    """

    now: bool
    since_last_look: bool
    since_ns: int
    uncertain_since_ns: int | None


class CoilKnowledge:
    """Checks the coil driver once a cycle."""

    def __init__(self) -> None:
        self._known = True
        self._since_ns = -1
        self._looked_ns: int | None = None

    def look(self, in_force: CoilState, now_ns: int) -> CurrentValidity:
        """Return which currents are known, from the driver's state and the time since the last look."""
        obeyed, self._known = self._known, not in_force.error
        looked_ns, self._looked_ns = self._looked_ns, now_ns
        stood = looked_ns is not None and now_ns - looked_ns > STOOD_NS
        since_last_look = obeyed and self._known and not stood
        if self._known and not since_last_look:
            self._since_ns = now_ns
        uncertain = [now_ns - _UNSEEN_NS] if obeyed and not self._known else []
        if looked_ns is not None and stood:
            uncertain.append(looked_ns)
        return CurrentValidity(self._known, since_last_look, self._since_ns, min(uncertain, default=None))
