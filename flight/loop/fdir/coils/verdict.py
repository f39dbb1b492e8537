"""The settings of the coil watch, and its verdicts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flight.loop.fdir.coils.hypotheses import CoilFault
from flight.loop.fdir.coils.response import ResponseSettings


@dataclass(frozen=True, slots=True)
class CoilVerdict:
    """One broken axis: 0, 1, 2 for x, y, z."""

    axis: int
    fault: CoilFault
    time_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class CoilWatchSettings:
    """Properties of the coils' circuit and of the monitor.

    Attributes:
        full_current: A, of a coil that is fully on: supply voltage over resistance.
        current_uncertainty: A, bound on each driven coil's deviation from its command.
        gain_error: relative bound: resistance, supply, and the monitor's sampling of the chopped current.
        monitor_noise: A, bound, at any current.
        window_ns: averaging time of a reading's mean. A longer gap between readings resets the watch.
        persistence: readings in a row that fit no healthy circuit, until there is a suspicion.
        settle: readings after that until the window lies wholly after the fault.
        evidence: readings that a verdict needs.
        probe_current: A, of the wave that distinguishes faults of axes at rest.
        probe_half_ns: half the wave's period.
        response: the body's response to the coils; None where the motion is not used.
        slow: the same over longer bins, which show currents that the monitor can not tell from none.
        tumble_rate: rad/s; a coil that looks reversed while the body turns faster rests until it is slower.
    """

    full_current: tuple[float, float, float]
    current_uncertainty: float = 3.5e-3
    gain_error: float = 0.2
    monitor_noise: float = 1.5e-3
    window_ns: int = 1_100_000_000
    persistence: int = 3
    settle: int = 2
    evidence: int = 3
    probe_current: float = 0.04
    probe_half_ns: int = 800_000_000
    response: ResponseSettings | None = None
    slow: ResponseSettings | None = None
    tumble_rate: float = math.inf
