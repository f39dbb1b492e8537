"""Is it known what the coils carry? Not while their chip does not obey, nor while the loop stands."""

from __future__ import annotations

from dataclasses import dataclass

from hal.interfaces.readings import CoilState

_UNSEEN_NS = 600_000_000
"""The coils' driver reads its outputs back twice a second: what it finds wrong may be so since then."""
STOOD_NS = 200_000_000
"""A loop that stood still for longer may have been taken for dead, the coils zeroed by the guardian."""


@dataclass(frozen=True, slots=True)
class CurrentValidity:
    """What a look at the coils' driver says of the currents.

    Attributes:
        now: whether the currents in force are known.
        since_last_look: whether those since the look before are, too.
        since_ns: from when on they are.
        uncertain_since_ns: from when on what was believed until now is newly in doubt; None when nothing is.
    """

    now: bool
    since_last_look: bool
    since_ns: int
    uncertain_since_ns: int | None


class CoilKnowledge:
    """Looks at the coils' driver once a cycle."""

    def __init__(self) -> None:
        self._known = True
        self._since_ns = -1
        self._looked_ns: int | None = None

    def look(self, in_force: CoilState, now_ns: int) -> CurrentValidity:
        """Tell what is known, by what the driver says and by how long nobody looked."""
        obeyed, self._known = self._known, not in_force.error
        looked_ns, self._looked_ns = self._looked_ns, now_ns
        stood = looked_ns is not None and now_ns - looked_ns > STOOD_NS
        since_last_look = obeyed and self._known and not stood
        if self._known and not since_last_look:
            self._since_ns = now_ns
        doubts = [now_ns - _UNSEEN_NS] if obeyed and not self._known else []
        if looked_ns is not None and stood:
            doubts.append(looked_ns)
        return CurrentValidity(self._known, since_last_look, self._since_ns, min(doubts, default=None))
