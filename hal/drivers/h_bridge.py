"""Torque coils on the SN754410's H-bridges: wiring, settings, and the PWM count of a current.

A coil is connected to two inputs of the bridge (Sease 2013, Table 5.2, eq. 5.33). The sign of a count gives
the direction and its magnitude the duty: +n drives input A for n/4096 of the period with input B low, -n
drives input B, and 0 keeps both inputs low. The coil's L/R of 0.1 ms is far below the PWM period of 20 ms,
so the mean current over a period follows from the mean voltage: n/4096 V/R.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hal.drivers.pca9685 import BLOCK_CHANNELS, CHANNELS, COUNTS, FULL_OFF, FULL_ON, PwmCounts
from hal.interfaces.errors import OutOfRange

DEVICE = "coils"


@dataclass(frozen=True, slots=True)
class CoilWiring:
    """Wiring of one coil to the PWM chip, as measured.

    Attributes:
        channel_a: PWM channel of bridge input A, high for a positive current.
        channel_b: PWM channel of input B.
        resistance: ohm, of the coil.
        sign: +1, or -1 for a coil with its leads swapped.
    """

    channel_a: int
    channel_b: int
    resistance: float
    sign: int = 1

    def __post_init__(self) -> None:
        if not 0.0 < self.resistance < math.inf:
            raise OutOfRange(DEVICE, "coil resistance", self.resistance, 0.0, math.inf, "ohm")
        if self.sign not in {1, -1}:
            raise OutOfRange(DEVICE, "coil sign", self.sign, -1, 1, "(-1 or +1)")

    @property
    def channels(self) -> tuple[int, int]:
        """The PWM channels of inputs A and B."""
        return self.channel_a, self.channel_b


Wirings = tuple[CoilWiring, CoilWiring, CoilWiring]


def wirings(
    channels: Sequence[tuple[int, int]], resistance: Sequence[float], signs: Sequence[int]
) -> Wirings:
    """Return the wiring of the three coils from three values of each kind. Raises OutOfRange."""
    x, y, z = (
        CoilWiring(a, b, ohm, sign) for (a, b), ohm, sign in zip(channels, resistance, signs, strict=True)
    )
    return x, y, z


@dataclass(frozen=True, slots=True)
class CoilSettings:
    """Wiring and drive of the three coils.

    Attributes:
        coils: wiring of the coils on body x, y, z.
        supply_voltage: V across a coil that is fully on, after the losses of the bridge.
        current_limit: A, of each coil; V/R is a limit too.
        stale_after: s without a command until the coils go to zero; at most 0.4, so that they are at zero
            within 0.5.
        tries: attempts of one write before it counts as failed.
        retry_wait: s between them.
    """

    coils: Wirings
    supply_voltage: float
    current_limit: float
    stale_after: float
    tries: int = 3
    retry_wait: float = 0.002

    def __post_init__(self) -> None:
        for quantity, value, low, high, unit in (
            ("number of coils", len(self.coils), 3, 3, ""),
            ("supply voltage", self.supply_voltage, 0.1, 36.0, "V"),
            ("current limit", self.current_limit, 1e-3, 1.0, "A"),
            ("stale_after", self.stale_after, 0.05, 0.4, "s"),
            ("tries", self.tries, 1, 5, ""),
            ("retry_wait", self.retry_wait, 0.0, 0.01, "s"),
        ):
            # Written so that NaN is rejected too.
            if not low <= value <= high:
                raise OutOfRange(DEVICE, quantity, value, low, high, unit)
        used = [channel for coil in self.coils for channel in coil.channels]
        for channel in used:
            if not 0 <= channel < CHANNELS or used.count(channel) > 1:
                raise OutOfRange(DEVICE, "PWM channel (each once)", channel, 0, CHANNELS - 1, "")

    def blocks(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Return the pins grouped into blocks of neighbouring channels: (first channel, pins).

        Pins are numbered coil by coil, in the order of `CoilWiring.channels`; a block is one transaction.
        """
        channels = [channel for coil in self.coils for channel in coil.channels]
        blocks: list[tuple[int, tuple[int, ...]]] = []
        for pin in sorted(range(len(channels)), key=channels.__getitem__):
            first, pins = blocks[-1] if blocks else (-1, ())
            if pins and channels[pin] == first + len(pins) and len(pins) < BLOCK_CHANNELS:
                blocks[-1] = (first, (*pins, pin))
            else:
                blocks.append((channels[pin], (pin,)))
        return tuple(blocks)


def current_step(resistance: float, supply_voltage: float) -> float:
    """Return the mean current in A of one count, V/R/4096, from ohm and volt."""
    return supply_voltage / resistance / COUNTS


def largest_counts(step: float, current_limit: float) -> int:
    """Return the largest count whose current exceeds neither the limit in A nor V/R."""
    # A limit that is a whole number of steps must not lose one to rounding.
    return min(COUNTS, math.floor(current_limit / step * (1.0 + 1e-12)))


def counts_for(current: float, step: float, largest: int) -> tuple[int, bool]:
    """Return the signed counts nearest to a mean current in A, and whether it was limited.

    Raises ValueError for NaN.
    """
    bound = largest * step
    if current > bound:
        return largest, True
    if current < -bound:
        return -largest, True
    return round(current / step), False


def mean_current(counts: int, step: float) -> float:
    """Return the mean current in A of signed counts."""
    return counts * step


def inputs_for(counts: int) -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of inputs A and B; the idle one is low the whole period (Table 5.2)."""
    if counts > 0:
        return _pulse(counts), FULL_OFF
    if counts < 0:
        return FULL_OFF, _pulse(-counts)
    return FULL_OFF, FULL_OFF


def brake() -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of both inputs that hold a coil at zero although a leg is stuck high.

    Both ends of the coil are then at the upper rail, for either leg and for a sound bridge.
    """
    return FULL_ON, FULL_ON


def _pulse(counts: int) -> PwmCounts:
    return FULL_ON if counts >= COUNTS else (0, counts)
