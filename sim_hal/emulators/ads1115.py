"""An emulated ADS1115: Config and Conversion, conversions at its own pace (TI SBAS444, Table 8-3).

Single-ended inputs and single shots, as the driver uses them; other settings are kept but convert nothing.
The voltage is that of the conversion's end.
"""

from __future__ import annotations

from collections.abc import Callable

CONVERSION, CONFIG = 0x00, 0x01
_GENERAL_CALL, _RESET = 0x00, b"\x06"
POWER_ON_CONFIG = 0x8583
_START = 0x8000
_SINGLE_SHOT = 0x0100
_FULL_SCALE = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
_RATES = (8, 16, 32, 64, 128, 250, 475, 860)


class EmulatedAds1115:
    """One converter; `measure(channel)` returns the voltage at an input now.

    Attributes:
        address: on the bus.
    """

    def __init__(self, address: int, now_ns: Callable[[], int], measure: Callable[[int], float]) -> None:
        self.address = address
        self._now_ns = now_ns
        self._measure = measure
        self.brown_out()

    def brown_out(self) -> None:
        """Return to the power-on state."""
        self._pointer = CONVERSION
        self._config = POWER_ON_CONFIG & ~_START
        self._conversion = 0
        self._ready_ns = self._now_ns()
        self._converting = False

    def answers(self, address: int) -> bool:
        """Return whether the part acknowledges this address: its own and the general call."""
        return address in {_GENERAL_CALL, self.address}

    def write(self, address: int, data: bytes) -> None:
        """Take the register pointer, and a word for Config; thresholds are not modelled.

        The reset by general call is the power-on state (9.5.1.2).
        """
        if address == _GENERAL_CALL:
            if data == _RESET:
                self.brown_out()
            return
        self._complete()
        self._pointer = data[0] & 0b11
        if len(data) >= 3 and self._pointer == CONFIG:
            word = data[1] << 8 | data[2]
            self._config = word & ~_START
            if word & _START and word & _SINGLE_SHOT:
                self._converting = True
                self._ready_ns = self._now_ns() + 1_000_000_000 // _RATES[word >> 5 & 0b111]

    def read(self, count: int) -> bytes:
        """Return bytes of the register that the pointer names, over again beyond its two."""
        self._complete()
        word = self._conversion if self._pointer == CONVERSION else self._config
        if self._pointer == CONFIG and not self._converting:
            word |= _START
        return (word.to_bytes(2, "big") * (count // 2 + 1))[:count]

    def _complete(self) -> None:
        """End a conversion whose time is over."""
        if not self._converting or self._now_ns() < self._ready_ns:
            return
        self._converting = False
        mux = self._config >> 12 & 0b111
        volts = self._measure(mux & 0b11) if mux & 0b100 else 0.0
        counts = round(volts / _FULL_SCALE[self._config >> 9 & 0b111] * 32_768)
        self._conversion = min(0x7FFF, max(-0x8000, counts)) & 0xFFFF
