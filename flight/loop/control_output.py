"""The values of one control cycle: target, reference, coil command and results."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

from flight.gnc.estimation.estimate import Estimate
from flight.gnc.math.arrays import FloatArray
from flight.link.modes import Mode
from flight.loop.executive.rate_group import Cycle
from hal.interfaces.readings import CoilState

COMMANDED = 1000
"""Commanded slews are numbered from here on."""
KEPT = 65535
"""The number of an attitude that is only held."""


class Reference(Protocol):
    """The motion wanted at one instant; each body has its own cheap form of it."""

    @property
    def quaternion(self) -> FloatArray:
        """(4,) reference frame into body."""

    @property
    def body_rate(self) -> FloatArray:
        """(3,) rad/s, body axes."""


class AttitudeLaw(Protocol):
    """Which attitude is wanted over time, as a body writes it."""

    @property
    def text(self) -> str:
        """The law in words, for events."""

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached, as it stands at `now_ns`, reference into body."""


@dataclass(frozen=True, slots=True)
class Target:
    """An attitude law that is wanted; `index` numbers it in packets: a step, COMMANDED and up, or KEPT."""

    index: int
    law: AttitudeLaw


@dataclass(frozen=True, slots=True, eq=False)
class CoilCommand:
    """What a tracker asks of the coils: the dipole (3,) A m^2, and the currents (3,) A that make it."""

    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


class SteeringState(IntEnum):
    """What the coils are used for; the values are those of the control packet."""

    OFF = 0
    FOLLOWING = 1
    HOLDING = 2
    BRAKING = 3


@dataclass(frozen=True, slots=True, eq=False)
class Steered:
    """What steering did in one cycle.

    Attributes:
        reference: the body's `Reference` now; None without a path.
        dipole: (3,) A m^2, wanted of the coils.
        currents: (3,) A, asked of the driver: after reallocation, with a probe of the coil watch, and zero
            where a fault of this cycle switched the coils off.
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
        estimate: None where there is none; it may be carried on by the model alone.
        target: in force, None before the first.
        written: what is on the wire at the end of the cycle.
    """

    cycle: Cycle
    mode: Mode
    estimate: Estimate | None
    target: Target | None
    steered: Steered
    written: CoilState
