"""What a kind of fault is: a row of the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from sim_hal.faults.bench import Bench, Lift

Parameters = Mapping[str, float]


class Where(Enum):
    """In which kind of simulation a fault makes sense."""

    BOTH = "in lock-step and in real time"
    REALTIME = "in real time only"
    COMMAND_LINE = "on the command line only"


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One fault.

    Attributes:
        device, kind: its name is "device: kind".
        meaning: what happens, in words.
        begin: breaks the bench and returns what mends it; None for what breaks in the flight process.
        parameters: with their defaults.
        momentary: there is nothing to lift: it happens, and what it leaves is for others to mend.
        where: in which kind of simulation.
    """

    device: str
    kind: str
    meaning: str
    begin: Callable[[Bench, Parameters], Lift] | None
    parameters: Parameters = field(default_factory=dict)
    momentary: bool = False
    where: Where = Where.BOTH

    @property
    def name(self) -> str:
        """How it is written."""
        return f"{self.device}: {self.kind}"
