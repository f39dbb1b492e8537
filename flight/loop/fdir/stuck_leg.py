"""Finds the bridge with a leg stuck high, by setting the coils to zero and braking bridges.

Such a leg drives its coil at zero command. Braking (both inputs high) removes the voltage from any coil,
whether its bridge is healthy or not. When the supply current is far too large or too small, all coils are
commanded to zero: a remaining current was not commanded. Then all bridges are braked at once. If the current
stops, they are released one by one: the bridge with which the current returns is broken. No healthy coil
carries current meanwhile. If neither rest nor brakes change the current, as with a shorted coil or a wrong
monitor, the search ends. When commands change all the time, as in B-dot's windows, the command of a
conversion is ambiguous: then there is a rest every few seconds without a suspicion, as a check.

Verifies brakes that rest on an unconfirmed verdict: a leg stuck low drives its coil while braked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

Axes = tuple[bool, bool, bool]
NONE: Axes = (False, False, False)
_SURE = 2
"""Conversions in a row that must agree."""
_PATIENCE = 12
"""Conversions without agreement after which a step is given up."""
_PAUSE = 50
"""Conversions between a rest without a finding and the next rest: control has priority."""
_UNCLEAR = 20
"""Conversions in a row whose command is ambiguous, after which there is a rest as a check."""


@dataclass(frozen=True, slots=True)
class Supplied:
    """A conversion made entirely under the present brakes, and the current that healthy coils would draw.

    Attributes:
        current: A, measured.
        least, most: A, bounds of the total current of healthy coils.
        spread: A, range of the total command in the conversion's window.
        at_rest: the axes that were not driven and have no known fault.
        driven: whether any axis was driven.
    """

    current: float
    least: float
    most: float
    at_rest: Sequence[int]
    driven: bool
    spread: float = 0.0


class _Step(Enum):
    WATCHING = auto()
    RESTING = auto()
    ALL_BRAKED = auto()
    ONE_RELEASED = auto()
    NO_CURE = auto()


class StuckLeg:
    """Searches for a stuck leg: processes conversions, requests rest and brakes, and returns an axis.

    Attributes:
        brake: which bridges are to be braked now.
        rest: whether all commands are to be zero now.
        suspicion: why there is a search, empty without a suspicion.
    """

    def __init__(self, excess: float) -> None:
        """Take the excess current, A, that only a fault can draw."""
        self._excess = excess
        self._pause = self._unclear = 0
        self._high = self._short = self._normal = self._looks = 0
        self.reset()

    def reset(self) -> None:
        """Release all bridges and end the search."""
        self._step = _Step.WATCHING
        self._left: list[int] = []
        self._braked: tuple[int, ...] = ()
        self._await()
        self.brake = NONE
        self.rest = False
        self.suspicion = ""

    @property
    def is_searching(self) -> bool:
        """Whether a search is running: coils at rest, and perhaps braked."""
        return self.rest

    def exceeds(self, seen: Supplied) -> bool:
        """Return whether a conversion is more than healthy coils can draw."""
        return seen.current > seen.most + self._excess

    def ask_for_rest(self, why: str) -> None:
        """Request a rest, unless a search is running or the last rest was too recent."""
        if self._step is _Step.WATCHING and not self._pause:
            self._rest(why)

    def look(self, seen: Supplied) -> int | None:
        """Process a conversion; return the axis of a stuck leg when found."""
        self._pause = max(self._pause - 1, 0)
        if self.rest and seen.driven:
            return None  # not yet at rest
        high = self.exceeds(seen)
        short = seen.current < seen.least - self._excess
        self._high = self._high + 1 if high else 0
        self._short = self._short + 1 if short else 0
        self._normal = 0 if high or short else self._normal + 1
        self._looks += 1
        if self.is_searching and self._looks > _PATIENCE:
            self._give_up()  # an intermittent current is no stuck leg
            return None
        self._unclear = self._unclear + 1 if seen.spread > self._excess else 0
        if self._unclear >= _UNCLEAR and self._step is _Step.WATCHING:
            self._rest("")
            return None
        if self._high >= _SURE:
            return self._judge_too_much(seen)
        if self._short >= _SURE and self._step is _Step.WATCHING:
            self._put_to_rest(seen)
        elif self._normal >= _SURE:
            self._judge_normal()
        return None

    def _judge_too_much(self, seen: Supplied) -> int | None:
        match self._step:
            case _Step.WATCHING if seen.driven:
                self._put_to_rest(seen)
            case _Step.WATCHING | _Step.RESTING if seen.at_rest:
                self._brake_all(seen)
            case _Step.ONE_RELEASED:
                found = self._left[0]
                self.reset()
                return found
            case _:
                self._give_up()
        return None

    def _judge_normal(self) -> None:
        match self._step:
            case _Step.RESTING if not self.suspicion:
                self.reset()
            case _Step.RESTING:
                self._pause = _PAUSE
                self._give_up()
            case _Step.ALL_BRAKED:
                self._release_next()
            case _Step.ONE_RELEASED:
                del self._left[0]
                self._release_next()
            case _Step.NO_CURE:
                self.reset()
            case _Step.WATCHING:
                pass

    def _brake_all(self, seen: Supplied) -> None:
        self.suspicion = self.suspicion or _reason(seen)
        self._step, self._left, self._braked = _Step.ALL_BRAKED, list(seen.at_rest), tuple(seen.at_rest)
        self.brake, self.rest = _only(seen.at_rest), True
        self._await()

    def _put_to_rest(self, seen: Supplied) -> None:
        if self._pause:
            self._give_up()
            return
        self._rest(_reason(seen))

    def _rest(self, why: str) -> None:
        self.suspicion = self.suspicion or why
        self._step = _Step.RESTING
        self.brake, self.rest = NONE, True
        self._await()

    def _release_next(self) -> None:
        """Release the next bridge; end the search when none is left."""
        if not self._left:
            self.reset()
            return
        self._step = _Step.ONE_RELEASED
        self.brake = _only([axis for axis in self._braked if axis != self._left[0]])
        self._await()

    def _give_up(self) -> None:
        """End the search until the current is normal again."""
        self.reset()
        self._step = _Step.NO_CURE

    def _await(self) -> None:
        self._high = self._short = self._normal = self._looks = 0


def _reason(seen: Supplied) -> str:
    due = f"{1e3 * max(seen.least, 0.0):.0f} to {1e3 * seen.most:.0f} mA"
    return f"supply current {1e3 * seen.current:.0f} mA where {due} are due"


def _only(axes: Sequence[int]) -> Axes:
    return 0 in axes, 1 in axes, 2 in axes


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
