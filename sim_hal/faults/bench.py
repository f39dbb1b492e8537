"""Simulated hardware that faults affect, and the description of a kind of fault."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from sim_hal.emulators.serial_line import SOUND, EmulatedSerialLine, HostEnd, LineFaults, PtyLine, Wire

if TYPE_CHECKING:  # imported only for types, because faults can be parsed without the hardware
    from sim_hal.assembly import Hardware

Removal = Callable[[], None]
"""Function that ends a fault."""


def no_removal() -> None:
    """Do nothing; the fault's effect lasts until the flight software repairs it."""


def hold(part: object | None, attribute: str, value: object, sound: object) -> Removal:
    """Set an attribute of a device until the fault is removed; do nothing if the device is None."""
    if part is None:
        return no_removal
    setattr(part, attribute, value)

    def remove() -> None:
        if getattr(part, attribute) is value:
            setattr(part, attribute, sound)

    return remove


def all_of(removals: Sequence[Removal]) -> Removal:
    """Return one function that removes several faults."""

    def remove() -> None:
        for removal in removals:
            removal()

    return remove


@dataclass(slots=True)
class Bench:
    """Emulated devices and lines to which faults are applied; the flight software itself is not changed.

    Attributes:
        line: serial line of the inertial unit.
        now_ns: function that returns the simulation time, ns.
        generator: random generator of the faults.
        host: host end of a serial line in memory, or None for a pseudo-terminal.
        flight_process: process identifier of the flight process, or None in lock-step.
        gps_line: serial line of the GPS receiver, or None without a receiver.
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
        """Add faults to the present faults of a wire, and return a function that removes them."""
        present = self._on_wires.setdefault(id(wire), [])
        present.append(faults)
        wire.faults = reduce(_combined, present, SOUND)

        def remove() -> None:
            present.remove(faults)
            wire.faults = reduce(_combined, present, SOUND)

        return remove

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run `action` after `seconds` s of simulated time."""
        self.hardware.faults.at(self.now_ns() + round(seconds * 1e9), action)

    def toggle(self, begin: Callable[[], Removal], period: float, share: float) -> Removal:
        """Apply a fault intermittently, during the fraction `share` of each period of `period` s."""
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
"""Function that applies a fault to the bench and returns a function that removes the fault."""


def intermittently(begin: Begin) -> Begin:
    """Return the intermittent form of a fault, with the parameters `period` (s) and `share` (fraction)."""

    def toggled(bench: Bench, fault: FaultKind, given: Parameters) -> Removal:
        return bench.toggle(lambda: begin(bench, fault, given), given["period"], given["share"])

    return toggled


class Where(Enum):
    """Kind of simulation in which a fault can occur."""

    BOTH = "in lock-step and in real time"
    REALTIME = "in real time only"
    COMMAND_LINE = "on the command line only"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A numeric parameter of a kind of fault.

    Attributes:
        default: default value, or None for a parameter that is drawn at random by default.
        low, high: its bounds.
        unit: physical unit of the value, or an empty text for a number without unit.
        whole: whether the value must be an integer.
        choices: allowed values, or empty if all values between the bounds are allowed.
    """

    default: float | None
    low: float
    high: float
    unit: str = ""
    whole: bool = False
    choices: tuple[float, ...] = ()

    def accepts(self, value: float) -> bool:
        """Return whether a value of a fault parameter is allowed. NaN is never allowed."""
        if self.choices:
            return value in self.choices
        return self.low <= value <= self.high and not (self.whole and value % 1.0)

    def bounds(self) -> str:
        """Return a text that describes the allowed values."""
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
    """Kind of fault, such as `imu: silent`.

    Attributes:
        device, kind: the two parts of the fault's name "device: kind".
        meaning: description of the fault's effect.
        begin: function that applies the fault to the bench and returns a function that removes it, or None
            for faults in the flight process.
        parameters: parameters of the fault by name.
        momentary: whether the fault is an event without duration, such as a reset. Its effect lasts until
            the flight software repairs it.
        where: kind of simulation in which the fault can occur.
        adds: whether the fault may be present together with other faults of the same device.
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
        """Name of the fault as users write it, "device: kind"."""
        return f"{self.device}: {self.kind}"

    @property
    def part(self) -> str:
        """Name of the affected part.

        A coil and its bridge are one part, as are inertial unit and magnetometer.
        """
        return self.device.replace("bridge-", "coil-").replace("magnetometer", "imu")
