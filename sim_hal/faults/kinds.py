"""What a kind of fault is: a row of the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
class Parameter:
    """A number that a fault is given.

    Attributes:
        default: what it is when it is not given; None where it is drawn then.
        low, high: the least and the most that it may be.
        unit: of all three, empty for a mere number.
        whole: whether it counts something.
        choices: the only values that it may have, where not all between the bounds make sense.
    """

    default: float | None
    low: float
    high: float
    unit: str = ""
    whole: bool = False
    choices: tuple[float, ...] = ()

    def accepts(self, value: float) -> bool:
        """Tell whether a value is within the bounds; NaN is not."""
        if self.choices:
            return value in self.choices
        return self.low <= value <= self.high and not (self.whole and value % 1.0)

    def bounds(self) -> str:
        """Return in words what it may be."""
        unit = f" {self.unit}" if self.unit else ""
        if self.choices:
            return f"one of {', '.join(_runs(self.choices))}{unit}"
        return f"{'a whole number ' if self.whole else ''}from {self.low:g} to {self.high:g}{unit}"


def _runs(values: Sequence[float]) -> list[str]:
    """Return values in words, three and more in a row by their ends."""
    runs: list[list[float]] = []
    for value in values:
        if runs and value == runs[-1][-1] + 1.0:
            runs[-1].append(value)
        else:
            runs.append([value])
    words = (
        [f"{run[0]:g} to {run[-1]:g}"] if len(run) > 2 else [f"{value:g}" for value in run] for run in runs
    )
    return [word for run in words for word in run]


CHANCE = Parameter(0.5, 1e-6, 1.0)
"""That something happens; at 0 nothing would."""
PERIOD = Parameter(0.5, 0.05, 3600.0, "s")
SHARE = Parameter(0.5, 0.01, 0.99)
"""How long a fault that comes and goes is there, of its period."""


def delay(default: float) -> Parameter:
    """Return how much later something comes."""
    return Parameter(default, 1e-3, 60.0, "s")


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One fault.

    Attributes:
        device, kind: its name is "device: kind".
        meaning: what happens, in words.
        begin: breaks the bench and returns what mends it; None for what breaks in the flight process.
        parameters: what it is given, by name.
        momentary: there is nothing to lift: it happens, and what it leaves is for others to mend.
        where: in which kind of simulation.
        adds: it may be there beside another fault of its device: neither takes the other's place.
    """

    device: str
    kind: str
    meaning: str
    begin: Callable[[Bench, Parameters], Lift] | None
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    momentary: bool = False
    where: Where = Where.BOTH
    adds: bool = False

    @property
    def name(self) -> str:
        """How it is written."""
        return f"{self.device}: {self.kind}"

    @property
    def thing(self) -> str:
        """What breaks: a coil and the bridge that drives it are one, for the circuit has one condition."""
        return self.device.replace("bridge-", "coil-")
