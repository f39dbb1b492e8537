"""The hardware that faults act on, and the ways to apply, combine and repeat faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sim_hal.emulators.serial_line import SOUND, HostEnd, LineFaults, Wire

if TYPE_CHECKING:  # parsing faults needs no hardware
    from sim_hal.assembly import Hardware

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
