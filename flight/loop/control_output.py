"""The values of one control cycle: target, reference, coil command and results."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

from flight.link.modes import Mode
from flight.loop.executive.rate_group import Cycle
from hal.interfaces.readings import CoilState
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import Estimate

COMMANDED = 1000
"""Commanded slews are numbered from here on."""
KEPT = -1
"""The number of an attitude that is only held: no step or slew reaches it, and no packet carries it."""


class Reference(Protocol):
    """The reference motion at one instant; each body has its own implementation."""

    @property
    def quaternion(self) -> FloatArray:
        """(4,) reference frame into body."""

    @property
    def body_rate(self) -> FloatArray:
        """(3,) rad/s, body axes."""


class AttitudeLaw(Protocol):
    """The attitude to be reached over time, in a body's own form."""

    @property
    def text(self) -> str:
        """The law as text, for events."""

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached at `now_ns`, reference into body."""


@dataclass(frozen=True, slots=True)
class Target:
    """An attitude law with its number in packets: that of a step, COMMANDED and up, or KEPT."""

    index: int
    law: AttitudeLaw


@dataclass(frozen=True, slots=True, eq=False)
class CoilCommand:
    """A tracker's command: the dipole (3,) A m^2, and the currents (3,) A that make the dipole."""

    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


class SteeringState(IntEnum):
    """The use of the coils; the values are those of the control packet."""

    OFF = 0
    FOLLOWING = 1
    HOLDING = 2
    BRAKING = 3


@dataclass(frozen=True, slots=True, eq=False)
class Steered:
    """The result of steering in one cycle.

    Attributes:
        reference: the body's `Reference` now; None without a path.
        dipole: (3,) A m^2, commanded.
        currents: (3,) A, sent to the driver: after reallocation, with the coil watch's probe, and zero when a
            fault of this cycle switched the coils off.
    """

    state: SteeringState
    reference: Any | None
    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ControlOutput:
    """The results of one control cycle.

    Attributes:
        estimate: measured, or propagated by the model alone; None without one.
        target: in force, None before the first.
        written: the coil command on the wire at the end of the cycle.
    """

    cycle: Cycle
    mode: Mode
    estimate: Estimate | None
    target: Target | None
    steered: Steered
    written: CoilState
