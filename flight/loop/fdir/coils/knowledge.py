"""Tracks whether the coil currents are known.

They are not while the PWM driver fails, the loop has stalled, or the supply current speaks against them.
"""

from __future__ import annotations

from dataclasses import dataclass

from hal.interfaces.readings import CoilState

_UNSEEN_NS = 600_000_000
"""The coil driver reads its outputs back twice a second: an error may be this old when found."""
_UNSUSPECTED_NS = 800_000_000
"""Four readings of the monitor: `CoilWatchSettings.persistence` of them in a row begin a suspicion."""
STOOD_NS = 200_000_000
"""If the loop stalls for longer, the guardian may have zeroed the coils."""


@dataclass(frozen=True, slots=True)
class CurrentValidity:
    """Whether the coil currents are known.

    Attributes:
        now: whether the currents in force are known.
        since_last_look: whether the chip kept all commands since the previous look.
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
        self._obeys = True
        self._suspected = False
        self._since_ns = -1
        self._looked_ns: int | None = None

    def look(self, in_force: CoilState, now_ns: int, *, suspected: bool = False) -> CurrentValidity:
        """Return which currents are known, from the driver's state and the time since the last look.

        `suspected` is whether the supply current fits no healthy circuit: a coil may carry any current then.
        """
        obeyed, self._obeys = self._obeys, not in_force.error
        was_suspected, self._suspected = self._suspected, suspected
        looked_ns, self._looked_ns = self._looked_ns, now_ns
        stood = looked_ns is not None and now_ns - looked_ns > STOOD_NS
        since_last_look = obeyed and self._obeys and not stood
        now = self._obeys and not suspected
        if now and (was_suspected or not since_last_look):
            self._since_ns = now_ns
        uncertain = [now_ns - _UNSEEN_NS] if obeyed and not self._obeys else []
        if suspected and not was_suspected:
            uncertain.append(now_ns - _UNSUSPECTED_NS)
        if looked_ns is not None and stood:
            uncertain.append(looked_ns)
        return CurrentValidity(now, since_last_look, self._since_ns, min(uncertain, default=None))
