"""Which bridge has a leg that is stuck high: found by rest and by braking, not by driving.

Such a leg drives its coil while nothing is commanded. With both inputs of its bridge high no voltage is
across the coil, whichever leg it is; nor is there across that of a sound bridge. So when the supply gives far
too much or too little, all that is driven is put to rest: a current that stays is nobody's command. Then all
bridges are braked at once, and if that ends it, they are let go one after the other: the one with which it
comes back is broken. No coil but the broken one carries anything meanwhile; and where rest or brakes show
nothing, as with a shorted coil or a monitor that lies, they are taken back. Where commands come and go all
the time, as in B-dot's windows, a conversion may be of the one or of the other and tells nothing: then there
is a rest every few seconds without a suspicion, only to look.
"""

from __future__ import annotations

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
"""Conversions after a rest that showed nothing before there may be another: control goes first."""
_UNCLEAR = 20
"""Conversions in a row that could have been of one command or of quite another, until one looks at rest."""


@dataclass(frozen=True, slots=True)
class Supplied:
    """A conversion that was made wholly under the present brakes, and what sound coils would have drawn.

    Attributes:
        current: A, measured.
        least, most: A, that all sound coils would have drawn together.
        spread: A, between the least and the most of what was commanded in its window.
        at_rest: the axes that were not driven and are not known to be broken.
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
    """Takes conversions of the monitor, asks for rest and brakes, and names an axis.

    Attributes:
        brake: which bridges are to be braked now to find out.
        rest: whether nothing is to be driven now, to find out.
        suspicion: why that is so, empty while it is not.
    """

    def __init__(self, excess: float) -> None:
        """Take how much more than is due, in A, only a fault can draw."""
        self._excess = excess
        self._pause = self._unclear = 0
        self._high = self._short = self._normal = self._looks = 0
        self.reset()

    def reset(self) -> None:
        """Let all go and watch again."""
        self._step = _Step.WATCHING
        self._left: list[int] = []
        self._braked: tuple[int, ...] = ()
        self._await()
        self.brake = NONE
        self.rest = False
        self.suspicion = ""

    @property
    def is_at_work(self) -> bool:
        """Tell whether coils are at rest, and perhaps braked, to find out."""
        return self.rest

    def exceeds(self, seen: Supplied) -> bool:
        """Tell whether a conversion is more than sound coils can have drawn."""
        return seen.current > seen.most + self._excess

    def ask_for_rest(self, why: str) -> None:
        """Have what is driven put to rest, unless there was a rest a moment ago or something is under way."""
        if self._step is _Step.WATCHING and not self._pause:
            self._rest(why)

    def look(self, seen: Supplied) -> int | None:
        """Take a conversion; return an axis that is found."""
        self._pause = max(self._pause - 1, 0)
        if self.rest and seen.driven:
            return None  # not yet at rest
        high = self.exceeds(seen)
        short = seen.current < seen.least - self._excess
        self._high = self._high + 1 if high else 0
        self._short = self._short + 1 if short else 0
        self._normal = 0 if high or short else self._normal + 1
        self._looks += 1
        if self.is_at_work and self._looks > _PATIENCE:
            self._give_up()  # what comes and goes is no leg that is stuck
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
        """Let the next go; where none is left nothing was broken, or it is whole again."""
        if not self._left:
            self.reset()
            return
        self._step = _Step.ONE_RELEASED
        self.brake = _only([axis for axis in self._braked if axis != self._left[0]])
        self._await()

    def _give_up(self) -> None:
        """Leave it to others, until all is normal again."""
        self.reset()
        self._step = _Step.NO_CURE

    def _await(self) -> None:
        self._high = self._short = self._normal = self._looks = 0


def _reason(seen: Supplied) -> str:
    due = f"{1e3 * max(seen.least, 0.0):.0f} to {1e3 * seen.most:.0f} mA"
    return f"supply current {1e3 * seen.current:.0f} mA where {due} are due"


def _only(axes: Sequence[int]) -> Axes:
    return 0 in axes, 1 in axes, 2 in axes
