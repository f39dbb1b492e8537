"""Checks a verdict on a coil against the motion; if the motion contradicts it, the monitor is wrong."""

from __future__ import annotations

import math

from flight.loop.fdir.coils.hypotheses import CoilFault
from flight.loop.fdir.coils.response import CoilResponse

_DRIVEN = {CoilFault.A_HIGH: 1.0, CoilFault.B_HIGH: -1.0}
"""A leg stuck high drives its coil continuously, in this direction."""
_LITTLE_RESPONSE = 0.4
_DOUBTED_FOR_NS = 60_000_000_000
"""After a false verdict, how long the monitor is not trusted where the motion is inconclusive."""


class MotionWitness:
    """Compares verdicts with the torque observed in the body's motion.

    Attributes:
        doubt: why the monitor, not a coil, is doubted; empty while the monitor is trusted.
    """

    def __init__(self, response: CoilResponse | None, full_current: tuple[float, float, float]) -> None:
        """Take the fit of the motion, and the current (3,) A of each coil when fully on."""
        self._response = response
        self._full_current = full_current
        self._doubted_ns = -_DOUBTED_FOR_NS
        self.doubt = ""

    def trust_monitor(self) -> None:
        """Trust the monitor: its readings fit a healthy circuit."""
        self.doubt = ""

    def doubt_monitor(self, why: str, now_ns: int) -> None:
        """Doubt the monitor from now on."""
        self.doubt, self._doubted_ns = why, now_ns

    def contradicts(self, axis: int, fault: CoilFault, begun_ns: int, suspected_ns: int, now_ns: int) -> bool:
        """Return whether the coil's torque is unchanged, so that the monitor is wrong.

        The fault began after `begun_ns`, when the coil last drew the expected current, and was suspected at
        `suspected_ns`; the newest reading is of `now_ns`.
        """
        if self._response is None:
            return False
        carried = _DRIVEN.get(fault, 0.0) * self._full_current[axis]
        observed = self._response.observed_share(axis, carried, begun_ns, suspected_ns)
        if (observed is None or math.isnan(observed)) and now_ns - self._doubted_ns < _DOUBTED_FOR_NS:
            return True
        if observed is None:
            return fault not in _DRIVEN and self._response.is_healthy(axis)
        if math.isnan(observed):
            # No data from before the fault; a coil driven at zero command would show its torque by now.
            return fault in _DRIVEN or self._response.is_healthy(axis)
        return observed < _LITTLE_RESPONSE
