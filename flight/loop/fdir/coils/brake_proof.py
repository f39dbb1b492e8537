"""Verifies brakes that rest on an unconfirmed verdict: a leg stuck low drives its coil while braked."""

from __future__ import annotations

from collections import deque

_PROOFS = 2
"""Conversions in a row that must agree."""


class BrakeProof:
    """Collects conversions made under brakes that are not confirmed yet."""

    def __init__(self) -> None:
        self._axes: set[int] = set()
        self._exceeds: deque[bool] = deque(maxlen=_PROOFS)

    def __bool__(self) -> bool:
        """Return whether any brake is unconfirmed."""
        return bool(self._axes)

    def add(self, axis: int) -> None:
        """Add an axis that is braked on a verdict alone."""
        self._axes.add(axis)

    def discard(self, axis: int) -> None:
        """Remove an axis."""
        self._axes.discard(axis)

    def ingest(self, exceeds: bool) -> frozenset[int]:
        """Note whether a conversion shows current despite the brakes; return the axes braked wrongly."""
        self._exceeds.append(exceeds)
        if len(self._exceeds) < _PROOFS:
            return frozenset()
        wrong = frozenset(self._axes) if all(self._exceeds) else frozenset()
        if len(set(self._exceeds)) == 1:
            self._axes.clear()
            self._exceeds.clear()
        return wrong
