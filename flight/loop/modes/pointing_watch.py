"""Watches rate and pointing error of a body that is steered."""

from __future__ import annotations

from flight.gnc.estimation.estimate import Estimate
from flight.loop.body import Targets
from flight.loop.fdir import facts
from flight.loop.fdir.facts import Facts
from flight.loop.fdir.hold_timer import HoldTimer
from flight.schema.sections import Modes


class PointingWatch:
    """States the facts TUMBLING and HOLD_IMPOSSIBLE."""

    def __init__(self, settings: Modes, targets: Targets, facts_: Facts) -> None:
        self._settings = settings
        self._targets = targets
        self._facts = facts_
        self._off = HoldTimer(settings.hold_patience)

    def reset(self) -> None:
        """Forget how long the body has been off: another mode is entered."""
        self._off.reset()

    def watch(self, estimate: Estimate, off: float | None, now_ns: int) -> float:
        """State whether the body turns too fast and stays too far `off`, rad; return how far.

        `off` is None while nothing is wanted of the body: then it is not off.
        """
        settings, speed = self._settings, self._targets.speed(estimate)
        text = f"{speed:.3f} rad/s, {settings.tumble_rate:g} allowed"
        self._facts.update(facts.TUMBLING, speed > settings.tumble_rate, now_ns, text)
        error = 0.0 if off is None else off
        impossible = self._off.update(error > settings.hold_error, now_ns)
        text = f"{error:.2f} rad off for {settings.hold_patience:g} s"
        self._facts.update(facts.HOLD_IMPOSSIBLE, impossible, now_ns, text)
        return error
