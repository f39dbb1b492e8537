"""Measurement of solar cell string currents by ADS1115 A/D converters (TI SBAS444) with four inputs each.

The current of a string flows through a shunt, whose voltage is amplified; the output voltage per current is
`volt_per_ampere`. A periodic job reads the completed conversion of one channel and starts the conversion of
the next channel, on all converters at once. No call waits for a conversion, because a conversion takes 7.8 ms
and the job runs at intervals of at least 10 ms.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.interfaces.devices import StringReading
from hal.interfaces.errors import DeviceError, OutOfRange, Refused, answering
from hal.interfaces.wires import Clock, I2cBus

CONVERSION, CONFIG = 0x00, 0x01
START = 0x8000
"""Bit of the Config register: writing 1 starts a conversion, and reading 1 means that none is running."""
_SINGLE_ENDED, _MUX_BIT = 0b100, 12
_RANGE_2_048 = 0b010 << 9
_SINGLE_SHOT = 1 << 8
_RATE_128 = 0b100 << 5
_NO_COMPARATOR = 0b11
FULL_SCALE = 2.048
STEP = FULL_SCALE / 32_768
"""Voltage (V) of one ADC count."""
CHANNELS = 4
_SHORTEST_NS = 10_000_000


def config_for(channel: int) -> int:
    """Return the Config word that starts a conversion of one channel.

    The input is measured against ground in the range +-2.048 V, at 128 conversions per second.
    """
    mux = (_SINGLE_ENDED | channel) << _MUX_BIT
    return START | mux | _RANGE_2_048 | _SINGLE_SHOT | _RATE_128 | _NO_COMPARATOR


@dataclass(frozen=True, slots=True)
class StringWiring:
    """Connection of a solar cell string to an A/D converter.

    Attributes:
        address: I2C address of the converter.
        channel: input channel of the converter, 0 to 3.
        volt_per_ampere: output voltage of the current amplifier per current, V/A.
    """

    address: int
    channel: int
    volt_per_ampere: float


class AdsSolarStrings:
    """Monitor of the solar cell strings, which implements `hal.interfaces.devices.SolarStrings`."""

    def __init__(
        self, bus: I2cBus, clock: Clock, wirings: Sequence[StringWiring], period_ns: int = 500_000_000
    ) -> None:
        """Measure all strings once per `period_ns`. Raises OutOfRange for an invalid period or wiring."""
        self.name = "solar strings"
        self._bus = bus
        self._clock = clock
        self._wirings = tuple(wirings)
        self._parts = sorted({wiring.address for wiring in wirings})
        self._counts = dict.fromkeys(((w.address, w.channel) for w in wirings), 0)
        if len(self._counts) != len(self._wirings) or not wirings:
            raise OutOfRange(self.name, "number of different channels", len(self._counts), 1, 16, "")
        for wiring in wirings:
            if not 0 <= wiring.channel < CHANNELS:
                raise OutOfRange(self.name, "channel", wiring.channel, 0, CHANNELS - 1, "")
            if not 0.0 < wiring.volt_per_ampere < 1e6:
                raise OutOfRange(self.name, "volt per ampere", wiring.volt_per_ampere, 0.0, 1e6, "V/A")
        self._channels = sorted({wiring.channel for wiring in wirings})
        step_ns = period_ns // len(self._channels)
        if step_ns < _SHORTEST_NS:
            shortest = _SHORTEST_NS * len(self._channels)
            raise OutOfRange(self.name, "period", period_ns * 1e-9, shortest * 1e-9, 60.0, "s")
        self._lock = threading.Lock()
        self._latest: StringReading | None = None
        self._error = ""
        self._step = -1
        self._ticker = clock.ticker("solar strings", step_ns, self._serve)

    def latest(self) -> StringReading | None:
        """Return the newest reading, or None before the first reading."""
        with self._lock:
            return self._latest

    def error(self) -> str:
        """Return the text of the current failure, or an empty text while readings arrive."""
        with self._lock:
            return self._error

    def close(self) -> None:
        """Stop reading. Calling `close` again has no effect."""
        self._ticker.stop()

    def _serve(self) -> None:
        try:
            for address in self._parts if self._step >= 0 else ():
                self._collect(address, self._channels[self._step])
            self._step += 1
            if self._step == len(self._channels):
                self._step = 0
                self._publish()
            word = config_for(self._channels[self._step])
            for address in self._parts:
                with answering(_name(address)):
                    self._bus.write_i2c_block_data(address, CONFIG, [word >> 8, word & 0xFF])
        except DeviceError as error:
            # A reading contains all strings, so after a failure the measurement begins again at the first
            # channel.
            self._step = -1
            with self._lock:
                self._error = str(error)

    def _collect(self, address: int, channel: int) -> None:
        config = self._read(address, CONFIG)
        if config != config_for(channel):
            busy = config == config_for(channel) & ~START
            cause = "the conversion does not end" if busy else f"Config reads 0x{config:04x} (brown-out?)"
            raise Refused(_name(address), cause)
        word = self._read(address, CONVERSION)
        if (address, channel) in self._counts:
            self._counts[address, channel] = word - 0x10000 if word & 0x8000 else word

    def _publish(self) -> None:
        currents = np.empty(len(self._wirings))
        for index, wiring in enumerate(self._wirings):
            counts = self._counts[wiring.address, wiring.channel]
            if abs(counts) >= 0x7FFF:
                bound = FULL_SCALE / wiring.volt_per_ampere
                current = counts * STEP / wiring.volt_per_ampere
                raise OutOfRange(self.name, f"current of string {index + 1}", current, -bound, bound, "A")
            currents[index] = counts * STEP / wiring.volt_per_ampere
        with self._lock:
            self._latest = StringReading(self._clock.now_ns(), currents)
            self._error = ""

    def _read(self, address: int, register: int) -> int:
        with answering(_name(address)):
            high, low = self._bus.read_i2c_block_data(address, register, 2)
        return high << 8 | low


def _name(address: int) -> str:
    return f"ads1115 at 0x{address:02x}"
