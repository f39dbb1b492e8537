"""Watches the attitude and the spin of a body that must acquire its attitude."""

from __future__ import annotations

from collections.abc import Callable

from flight.link.modes import POINTING, Mode
from flight.loop.fdir.hold_timer import HoldTimer
from flight.loop.modes.triggers import KNOWN, Trigger
from flight.schema.sections import Modes


class AttitudeWatch:
    """Finds the triggers between acquisition and pointing, and when SAFE has to brake the body.

    Attributes:
        follows: the mode that follows the acquisition; None where the body rests.
        brakes: whether a body in SAFE is being braked.
        seeks: whether a body in SAFE turns to the Sun.
    """

    def __init__(self, settings: Modes, low_rate: float, low_for: float) -> None:
        """`low_rate` rad/s for `low_for` s ends the braking."""
        self.follows = None if settings.acquired == Mode.ACQUIRE.label else Mode.named(settings.acquired)
        self.brakes = self.seeks = False
        self._fast, self._low = settings.tumble_rate, low_rate
        self._known = HoldTimer(settings.known_for)
        self._lost = HoldTimer(settings.lost_for)
        self._spins = HoldTimer(settings.known_for)
        self._slow = HoldTimer(low_for)

    def adopt(self, settings: Modes) -> None:
        """Go on with other bounds."""
        self._fast = settings.tumble_rate
        self._lost.require(settings.lost_for)
        for timer in (self._known, self._spins):
            timer.require(settings.known_for)

    def reset(self) -> None:
        """Begin again: another mode is entered."""
        self.brakes = self.seeks = False
        for timer in (self._known, self._lost, self._spins, self._slow):
            timer.reset()

    def trigger(self, mode: Mode, known: bool, now_ns: int) -> Trigger | None:
        """Return the trigger that is due; `known`: whether there is an attitude to steer by."""
        if mode is Mode.ACQUIRE and self.follows is not None and self._known.update(known, now_ns):
            return KNOWN[self.follows]
        if mode in POINTING and self._lost.update(not known, now_ns):
            return Trigger.LOST
        return None

    def watch_safe(
        self,
        rate: float,
        barred: bool,
        brake: Callable[[int], None],
        seek: Callable[[int], None],
        now_ns: int,
    ) -> None:
        """Brake a body in SAFE that turns fast until it is slow, else have it seek the Sun.

        Neither while `barred` by a latched fault. `brake` and `seek` are called when either begins.
        """
        if self.brakes:
            self.brakes = not (barred or self._slow.update(rate < self._low, now_ns))
        elif self._spins.update(rate > self._fast and not barred, now_ns):
            self._slow.reset()
            self.brakes = True
            brake(now_ns)
        seeks = not (barred or self.brakes)
        if seeks and not self.seeks:
            seek(now_ns)
        self.seeks = seeks
