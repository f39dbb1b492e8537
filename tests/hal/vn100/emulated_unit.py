"""An emulated VN-100 for several tests."""

from __future__ import annotations

import numpy as np

from hal.drivers.vn100_protocol import AsciiLine, BinaryPacket, Sentence, StreamParser, build
from sim_hal.emulators.serial_line import EmulatedSerialLine
from sim_hal.emulators.vn100 import Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES
from sim_hal.worlds.world import about_thread


class Bench:
    """An emulated VN-100 on a serial line, and a host that reads the bytes of the line."""

    def __init__(self, unit: Vn100EmulatorSettings | None = None) -> None:
        rng = np.random.default_rng(2)
        self.now_ns = 0
        self.line = EmulatedSerialLine(lambda: self.now_ns, 115200, rng)
        self.unit = Vn100Emulator(
            lambda t: about_thread(t, 0.3, 0.02, 4.5e-4),
            self.line.device,
            rng,
            unit or Vn100EmulatorSettings(noise=PROFILES["none"]),
        )
        self.parser = StreamParser()

    def run(self, seconds: float) -> list[BinaryPacket | AsciiLine]:
        """Return all bytes that the VN-100 sends in a given time."""
        self.now_ns += round(seconds * 1e9)
        self.unit.advance(self.now_ns)
        return [item for at, data in self.line.host.receive() for item in self.parser.feed(at, data)]

    def exchange(self, line: bytes, seconds: float = 0.02) -> list[Sentence]:
        """Return the sentences that arrive after a command was sent."""
        self.line.host.send(line)
        return [item.sentence for item in self.run(seconds) if isinstance(item, AsciiLine)]

    def quiet(self) -> Bench:
        """Pause the unit's asynchronous output."""
        self.exchange(build("ASY", 0), 0.05)
        return self
