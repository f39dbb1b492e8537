"""H-bridges DRV8830 with an I2C interface and a regulated output voltage (TI SLVSAB2), one for each coil.

The output voltage has 58 steps of 0.08 V, and no values between zero and 0.48 V. A periodic job therefore
modulates the voltage: it writes the step nearest to the wanted voltage plus the accumulated error. To the
coil driver (`hal.drivers.coils`), which retries, checks and brakes, the chips look like a PWM chip.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

from hal.drivers.coils import CoilSettings, PwmTorqueCoils
from hal.drivers.pca9685 import COUNTS, FULL_OFF, PwmCounts
from hal.interfaces.errors import NotResponding, answering
from hal.interfaces.wires import Clock, I2cBus, Ticker

CONTROL, FAULT = 0x00, 0x01
CLEAR, OFF, BRAKE = 0x80, 0x00, 0b11
FORWARD, REVERSE = 0b01, 0b10
STEP_V = 4.0 * 1.285 / 64
FIRST_STEP, LAST_STEP = 0x06, 0x3F
PERIOD_NS = 10_000_000


def control_of(volts: float) -> int:
    """Return the value of the register CONTROL whose signed output voltage is nearest to `volts` (V)."""
    steps = round(abs(volts) / STEP_V)
    if steps < FIRST_STEP:
        steps = FIRST_STEP if 2.0 * abs(volts) > FIRST_STEP * STEP_V else 0
    if steps == 0:
        return OFF
    return min(steps, LAST_STEP) << 2 | (FORWARD if volts > 0.0 else REVERSE)


def volts_of(control: int) -> float:
    """Return the output voltage (V) of a value of the register CONTROL."""
    direction = {FORWARD: 1.0, REVERSE: -1.0}.get(control & 0b11, 0.0)
    return direction * (control >> 2) * STEP_V


class Drv8830Bridges:
    """DRV8830 chips at consecutive addresses, with the interface of `hal.drivers.coils.PwmOutputs`."""

    def __init__(self, bus: I2cBus, address: int, clock: Clock, settings: CoilSettings) -> None:
        self.name = f"drv8830 at 0x{address:02x}"
        self._bus, self._address, self._clock = bus, address, clock
        self._pins = [coil.channels for coil in settings.coils]
        self._voltage = settings.supply_voltage
        self._duty: dict[int, PwmCounts] = {}
        self._error = [0.0] * len(self._pins)
        self._written = [OFF] * len(self._pins)
        self._ticker: Ticker | None = None
        # The lock is needed because the coil driver's thread sets duties while the modulation runs.
        self._lock = threading.RLock()

    def configure(self) -> None:
        """Switch all bridges off, and clear their faults. Raises NotResponding."""
        self.all_off()
        for index in range(len(self._pins)):
            self._write(index, FAULT, CLEAR)
        if self._ticker is None:
            self._ticker = self._clock.ticker("drv8830", PERIOD_NS, self._modulate)

    def is_configured(self) -> bool:
        """Return whether every chip has kept its output and reports no fault. Raises NotResponding."""
        with self._lock:
            return all([self._is_intact(index) for index in range(len(self._pins))])

    def holds(self, first: int, channels: Sequence[PwmCounts]) -> bool:
        """Return whether the outputs from channel `first` on were written last and are intact.

        Raises NotResponding.
        """
        written = [self._duty.get(first + offset, FULL_OFF) for offset in range(len(channels))]
        return written == list(channels) and self.is_configured()

    def write_channels(self, first: int, channels: Sequence[PwmCounts]) -> None:
        """Set the duties of the bridge inputs from channel `first` on. Raises NotResponding."""
        with self._lock:
            self._duty |= {first + offset: counts for offset, counts in enumerate(channels)}
            self._modulate()

    def all_off(self) -> None:
        """Switch all bridges off. Raises NotResponding after all chips have been tried."""
        failed: NotResponding | None = None
        with self._lock:
            self._duty.clear()
            self._error = [0.0] * len(self._pins)
            for index in range(len(self._pins)):
                try:
                    self._write(index, CONTROL, OFF)
                except NotResponding as error:
                    failed = error
        if failed is not None:
            raise failed

    def stop(self) -> None:
        """Stop the modulation."""
        if self._ticker is not None:
            self._ticker.stop()

    def _is_intact(self, index: int) -> bool:
        with answering(self.name):
            control, fault = self._bus.read_i2c_block_data(self._address + index, CONTROL, 2)
        return control == self._written[index] and not fault & 1

    def _modulate(self) -> None:
        """Write the next voltage step of every coil. The clock calls this method periodically."""
        with self._lock:
            for index, pins in enumerate(self._pins):
                a, b = (_high(self._duty.get(pin, FULL_OFF)) for pin in pins)
                wanted = (a - b) / COUNTS * self._voltage + self._error[index]
                control = control_of(wanted)
                if a == b:
                    control, wanted = (BRAKE, 0.0) if a else (OFF, 0.0)
                self._error[index] = wanted - volts_of(control)
                if control != self._written[index]:
                    self._write(index, CONTROL, control)

    def _write(self, index: int, register: int, value: int) -> None:
        with answering(f"drv8830 at 0x{self._address + index:02x}"):
            self._bus.write_byte_data(self._address + index, register, value)
        if register == CONTROL:
            self._written[index] = value


class Drv8830Coils(PwmTorqueCoils):
    """Driver of torque coils on DRV8830 bridges."""

    def __init__(self, bridges: Drv8830Bridges, clock: Clock, settings: CoilSettings) -> None:
        super().__init__(bridges, clock, settings)
        self._bridges = bridges

    def close(self) -> None:
        """Stop the modulation and set the coils to zero."""
        self._bridges.stop()
        super().close()


def _high(counts: PwmCounts) -> int:
    """Return the number of counts per PWM period during which an output is high."""
    on, off = counts
    return 0 if off >= COUNTS else COUNTS if on >= COUNTS else off - on
