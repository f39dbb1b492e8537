"""Monitors the rate and the pointing error of a steered body."""

from __future__ import annotations

from flight.loop.body import Targets
from flight.loop.fdir import facts
from flight.loop.fdir.facts import Facts
from flight.loop.fdir.hold_timer import HoldTimer
from flight.schema.sections import Modes
from knightcube.gnc.estimation.estimate import Estimate


class PointingWatch:
    """Updates the facts TUMBLING and HOLD_IMPOSSIBLE."""

    def __init__(self, settings: Modes, targets: Targets, facts_: Facts) -> None:
        self._settings = settings
        self._targets = targets
        self._facts = facts_
        self._off = HoldTimer(settings.hold_patience)

    def adopt(self, settings: Modes) -> None:
        """Go on with other bounds."""
        self._settings = settings
        self._off.require(settings.hold_patience)

    def reset(self) -> None:
        """Restart the timer of the pointing error: another mode is entered."""
        self._off.reset()

    def watch_rate(self, rate: float, now_ns: int) -> None:
        """Update TUMBLING from a rate, rad/s, not negative."""
        limit = self._settings.tumble_rate
        self._facts.update(facts.TUMBLING, rate > limit, now_ns, f"{rate:.3f} rad/s, {limit:g} allowed")

    def watch(self, estimate: Estimate, off: float | None, now_ns: int) -> float:
        """Update both facts from the pointing error `off`, rad; return the error, 0 where `off` is None.

        `off` is None while there is no attitude to be reached yet.
        """
        settings = self._settings
        self.watch_rate(self._targets.speed(estimate), now_ns)
        error = 0.0 if off is None else off
        impossible = self._off.update(error > settings.hold_error, now_ns)
        text = f"{error:.2f} rad off for {settings.hold_patience:g} s"
        self._facts.update(facts.HOLD_IMPOSSIBLE, impossible, now_ns, text)
        return error
