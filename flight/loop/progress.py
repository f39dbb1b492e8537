"""The state of a flight for the progress line, once a second."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """Times in s, currents (3,) in A; `attitude` is the body's text of target and attitude."""

    mission_time: float
    duration: float
    attitude: str
    currents: tuple[float, float, float]
    state: str
    slips: int
    events: int
