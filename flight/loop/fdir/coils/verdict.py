"""What is known of the coils' circuit beforehand, and what is found to be wrong with it."""

from __future__ import annotations

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
    """What is known of the circuit and of the monitor.

    Attributes:
        full_current: A, of a coil that is fully on: supply voltage over resistance.
        current_uncertainty: A, bound on each driven coil's current beside its command.
        gain_error: relative bound: resistance, supply, and the monitor's windows in the chopped current.
        monitor_noise: A, bound, at any current.
        window_ns: how far back a reading's mean reaches. Readings further apart than this begin anew.
        persistence: readings in a row without a healthy explanation until there is a suspicion.
        settle: readings after that until one tells of the time after the fault only.
        evidence: readings that a verdict takes.
        probe_current: A, of the wave by which axes that are not driven are told apart.
        probe_half_ns: half of its period.
        response: how the body answers to the coils; None where it cannot tell.
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
