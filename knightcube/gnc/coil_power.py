"""The power of torque coils on a chopped supply (Sease 2013, ch. 5: PWM of 20 ms through an H-bridge).

A coil's L/R of 0.1 ms is short against the period: the coil carries V/R in either direction while its bridge
drives it, and no current otherwise. The supply gives current only while a coil is driven, so it delivers
V |I| for a mean current I over the period, and the coil turns this power into heat. R I^2 of the mean
current, the cost of Sease 5.1, is the heat of a steady current I. It is V |I| times the duty cycle: the two
are equal for a coil that is driven all the time, and R I^2 is smaller for any other.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray


def supply_power(current: FloatArray, voltage: float) -> FloatArray:
    """Return V |I|, the power that each coil takes from its supply, W.

    Args:
        current: mean currents over a PWM period, A, of any shape.
        voltage: V. The voltage across a driven coil (`coils.supply_voltage`, after the losses of the bridge)
            gives the power at the coils. The voltage of the bus before the bridge, which carries the same
            current, gives the power at the bus.
    """
    return np.asarray(voltage * np.abs(current))


def steady_heat(current: FloatArray, resistance: float | FloatArray) -> FloatArray:
    """Return R I^2, the heat of steady currents, W: a cost of paths, not the consumption of chopped coils.

    Args:
        current: mean currents over a PWM period, A.
        resistance: ohm, of a shape that broadcasts with `current`.
    """
    return np.asarray(resistance * current * current)
