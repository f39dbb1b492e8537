"""The hardware that faults act on, the types of the fault tables, and combined and repeated faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sim_hal.emulators.serial_line import SOUND, HostEnd, LineFaults, Wire

if TYPE_CHECKING:  # parsing faults needs no hardware
    from sim_hal.assembly import Hardware
from collections.abc import Mapping
from enum import Enum

Lift = Callable[[], None]
"""Removes a fault."""


class Line(Protocol):
    """A serial line, in memory or on a pseudo-terminal."""

    to_host: Wire
    to_device: Wire


def no_lift() -> None:
    """Remove nothing: the effect stays until something repairs it."""


def held(part: object | None, attribute: str, value: object, sound: object) -> Lift:
    """Give an attribute of a part a value until the fault is removed; a part that is not fitted has none."""
    if part is None:
        return no_lift
    setattr(part, attribute, value)
    return lambda: setattr(part, attribute, sound)


@dataclass(slots=True)
class Bench:
    """The parts that faults act on from outside the flight process.

    Attributes:
        now_ns: the simulation's time.
        generator: for random faults.
        host: the line's host end, where it is in memory.
        flight_process: its process identifier, where it is not this process.
        gps_line: the GPS receiver's line, where one is fitted.
    """

    hardware: Hardware
    line: Line
    now_ns: Callable[[], int]
    generator: np.random.Generator
    host: HostEnd | None = None
    flight_process: int | None = None
    gps_line: Line | None = None
    _on_wires: dict[int, list[LineFaults]] = field(default_factory=dict)

    def disturb(self, wire: Wire, faults: LineFaults) -> Lift:
        """Add a fault to those of a wire."""
        present = self._on_wires.setdefault(id(wire), [])
        present.append(faults)
        wire.faults = _together(present)

        def lift() -> None:
            present.remove(faults)
            wire.faults = _together(present)

        return lift

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run `action` after `seconds` of simulated time."""
        self.hardware.faults.at(self.now_ns() + round(seconds * 1e9), action)

    def toggle(self, begin: Callable[[], Lift], period: float, share: float) -> Lift:
        """Apply a fault intermittently: for `share` of each `period` s."""
        state: dict[str, Lift | None] = {"lift": None}
        stopped = False

        def mend() -> None:
            lift, state["lift"] = state["lift"], None
            if lift is not None:
                lift()

        def turn() -> None:
            if stopped:
                return
            state["lift"] = begin()
            self.after(share * period, mend)
            self.after(period, turn)

        def lift() -> None:
            nonlocal stopped
            stopped = True
            mend()

        turn()
        return lift


def _together(faults: Sequence[LineFaults]) -> LineFaults:
    return reduce(_both, faults, SOUND)


def _both(a: LineFaults, b: LineFaults) -> LineFaults:
    return replace(
        a,
        silent=a.silent or b.silent,
        garbage=a.garbage or b.garbage,
        cut_probability=max(a.cut_probability, b.cut_probability),
        flip_probability=max(a.flip_probability, b.flip_probability),
        delay_ns=max(a.delay_ns, b.delay_ns),
        thinned=max(a.thinned, b.thinned),
    )


Parameters = Mapping[str, float]

Begin = Callable[[Bench, Parameters], Lift]
"""Applies a fault to the bench and returns its removal."""


class Where(Enum):
    """The kind of simulation in which a fault can occur."""

    BOTH = "in lock-step and in real time"
    REALTIME = "in real time only"
    COMMAND_LINE = "on the command line only"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A numeric parameter of a fault.

    Attributes:
        default: where it is not given; None where it is then drawn.
        low, high: its bounds.
        unit: of all three, empty for a mere number.
        whole: whether it must be a whole number.
        choices: the allowed values, where not all between the bounds are.
    """

    default: float | None
    low: float
    high: float
    unit: str = ""
    whole: bool = False
    choices: tuple[float, ...] = ()

    def accepts(self, value: float) -> bool:
        """Return whether a value is allowed; NaN is not."""
        if self.choices:
            return value in self.choices
        return self.low <= value <= self.high and not (self.whole and value % 1.0)

    def bounds(self) -> str:
        """Return the allowed values in words."""
        unit = f" {self.unit}" if self.unit else ""
        if self.choices:
            return f"one of {', '.join(_runs(self.choices))}{unit}"
        return f"{'a whole number ' if self.whole else ''}from {self.low:g} to {self.high:g}{unit}"


def _runs(values: Sequence[float]) -> list[str]:
    """Return values in words; three or more consecutive values as a range."""
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
"""Probability; at 0 a fault would have no effect."""
PERIOD = Parameter(0.5, 0.05, 3600.0, "s")
SHARE = Parameter(0.5, 0.01, 0.99)
"""Fraction of its period for which an intermittent fault is present."""
TURNS = {"period": PERIOD, "share": SHARE}


def intermittently(begin: Begin) -> Begin:
    """Return the fault that comes and goes, with the parameters TURNS."""
    return lambda bench, given: bench.toggle(lambda: begin(bench, given), given["period"], given["share"])


def delay(default: float) -> Parameter:
    """Return the parameter of a delay."""
    return Parameter(default, 1e-3, 60.0, "s")


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One fault.

    Attributes:
        device, kind: its name is "device: kind".
        meaning: what happens, in words.
        begin: applies it to the bench and returns its removal; None for faults in the flight process.
        parameters: by name.
        momentary: it has no duration; its effect stays until something repairs it.
        where: in which kind of simulation.
        adds: it may be present together with other faults of its device.
    """

    device: str
    kind: str
    meaning: str
    begin: Begin | None
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    momentary: bool = False
    where: Where = Where.BOTH
    adds: bool = False

    @property
    def name(self) -> str:
        """The fault as a user writes it."""
        return f"{self.device}: {self.kind}"

    @property
    def thing(self) -> str:
        """The affected part: coil and bridge share one condition, as do unit and magnetometer."""
        return self.device.replace("bridge-", "coil-").replace("magnetometer", "imu")
