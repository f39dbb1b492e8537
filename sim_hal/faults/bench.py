"""The simulated hardware that faults act on, and the description of one kind of fault."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from sim_hal.emulators.serial_line import SOUND, EmulatedSerialLine, HostEnd, LineFaults, PtyLine, Wire

if TYPE_CHECKING:  # parsing faults needs no hardware
    from sim_hal.assembly import Hardware

Removal = Callable[[], None]
"""Removes a fault that has begun."""


def no_removal() -> None:
    """Remove nothing: the effect of the fault stays until something repairs it."""


def hold(part: object | None, attribute: str, value: object, sound: object) -> Removal:
    """Set an attribute of a part until the fault is removed; a part that is not fitted is left alone."""
    if part is None:
        return no_removal
    setattr(part, attribute, value)

    def remove() -> None:
        if getattr(part, attribute) is value:
            setattr(part, attribute, sound)

    return remove


def all_of(removals: Sequence[Removal]) -> Removal:
    """Return the removal of several faults together."""

    def remove() -> None:
        for removal in removals:
            removal()

    return remove


@dataclass(slots=True)
class Bench:
    """The parts that faults act on from outside the flight process.

    Attributes:
        line: serial line of the inertial unit.
        now_ns: returns the simulation's time.
        generator: random numbers of the faults.
        host: host end of the line in memory; None for a pseudo-terminal.
        flight_process: process identifier of the flight; None in lock-step.
        gps_line: serial line of the GPS receiver, if one is fitted.
    """

    hardware: Hardware
    line: EmulatedSerialLine | PtyLine
    now_ns: Callable[[], int]
    generator: np.random.Generator
    host: HostEnd | None = None
    flight_process: int | None = None
    gps_line: EmulatedSerialLine | PtyLine | None = None
    _on_wires: dict[int, list[LineFaults]] = field(default_factory=dict)

    def disturb(self, wire: Wire, faults: LineFaults) -> Removal:
        """Add a fault to those of a wire."""
        present = self._on_wires.setdefault(id(wire), [])
        present.append(faults)
        wire.faults = reduce(_combined, present, SOUND)

        def remove() -> None:
            present.remove(faults)
            wire.faults = reduce(_combined, present, SOUND)

        return remove

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run `action` after `seconds` of simulated time."""
        self.hardware.faults.at(self.now_ns() + round(seconds * 1e9), action)

    def toggle(self, begin: Callable[[], Removal], period: float, share: float) -> Removal:
        """Apply a fault intermittently: for `share` of each `period` s."""
        removals: list[Removal] = []
        stopped = False

        def pause() -> None:
            if removals:
                removals.pop()()

        def resume() -> None:
            if stopped:
                return
            removals.append(begin())
            self.after(share * period, pause)
            self.after(period, resume)

        def remove() -> None:
            nonlocal stopped
            stopped = True
            pause()

        resume()
        return remove


def _combined(a: LineFaults, b: LineFaults) -> LineFaults:
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
Begin = Callable[[Bench, "FaultKind", Parameters], Removal]
"""Applies a fault of a kind to the bench and returns its removal."""


def intermittently(begin: Begin) -> Begin:
    """Return the intermittent form of a fault, with the parameters `period` (s) and `share`."""

    def toggled(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
        return bench.toggle(lambda: begin(bench, fault, given), given["period"], given["share"])

    return toggled


class Where(Enum):
    """The kind of simulation in which a fault can occur."""

    BOTH = "in lock-step and in real time"
    REALTIME = "in real time only"
    COMMAND_LINE = "on the command line only"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A numeric parameter of a fault.

    Attributes:
        default: value if none is given; None for a parameter that is then drawn at random.
        low, high: its bounds.
        unit: unit of default and bounds; empty for a number without unit.
        whole: whether it must be a whole number.
        choices: the allowed values; empty if all values between the bounds are allowed.
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
        if not self.choices:
            return f"{'a whole number ' if self.whole else ''}from {self.low:g} to {self.high:g}{unit}"
        runs: list[list[float]] = []
        for value in self.choices:
            if runs and value == runs[-1][-1] + 1.0:
                runs[-1].append(value)
            else:
                runs.append([value])
        words = []
        for run in runs:  # three or more consecutive values are written as a range
            words += [f"{run[0]:g} to {run[-1]:g}"] if len(run) > 2 else [f"{value:g}" for value in run]
        return f"one of {', '.join(words)}{unit}"


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One kind of fault.

    Attributes:
        device, kind: the two parts of its name "device: kind".
        meaning: the effect, in words.
        begin: applies it to the bench and returns its removal; None for faults in the flight process.
        parameters: its parameters by name.
        momentary: whether it has no duration; its effect then stays until something repairs it.
        where: the kind of simulation in which it can occur.
        adds: whether it may be present together with other faults of its device.
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
    def part(self) -> str:
        """The affected part: a coil with its bridge, and the inertial unit with its magnetometer, are one."""
        return self.device.replace("bridge-", "coil-").replace("magnetometer", "imu")
