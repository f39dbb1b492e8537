"""An emulated VN-100 for several tests, alone or with its driver on a serial line in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hal.drivers.vn100 import Vn100, Vn100Settings
from hal.drivers.vn100_protocol import AsciiLine, BinaryPacket, Sentence, StreamParser, build
from hal.interfaces.devices import ImuReading
from knightcube.astro.quaternion import IDENTITY, NED_TO_TESTBED, attitude_map
from sim_hal.clock import SimClock
from sim_hal.emulators.serial_line import EmulatedSerialLine
from sim_hal.emulators.vn100 import Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES
from sim_hal.worlds.world import BodyMotion, about_thread

MISSION = Vn100Settings(
    attitude_map=attitude_map(IDENTITY, NED_TO_TESTBED),
    mounting=np.eye(3),
    rate_hz=40,
    output="binary",
    field_range=6e-4,
)


def at_rest(time_ns: int) -> BodyMotion:
    return about_thread(time_ns, 0.4, 0.0, 4.5e-4)


def turning(time_ns: int) -> BodyMotion:
    """Return the motion of a body that rotates at 0.1 rad/s, with q2 = 0 at time zero."""
    return about_thread(time_ns, 0.1 * (time_ns * 1e-9 - 2.0), 0.1, 4.5e-4)


@dataclass(frozen=True, slots=True)
class Alone:
    """A simulated world that contains only one VN-100."""

    unit: Vn100Emulator

    def next_event_ns(self) -> int:
        """Return the time (ns) of the unit's next event."""
        return self.unit.next_event_ns()

    def advance_to(self, time_ns: int) -> None:
        """Advance the unit to a time."""
        self.unit.advance(time_ns)

    run_events = pass_to = advance_to


@dataclass(frozen=True, slots=True)
class BenchLine:
    """Driver, emulated VN-100, line and clock."""

    clock: SimClock
    line: EmulatedSerialLine
    unit: Vn100Emulator
    driver: Vn100

    def run(self, seconds: float) -> list[ImuReading]:
        """Poll at 40 Hz for some time, and return all readings."""
        readings: list[ImuReading] = []
        end_ns = self.clock.now_ns() + round(seconds * 1e9)
        while self.clock.now_ns() < end_ns:
            self.clock.sleep_until_ns(min(end_ns, self.clock.now_ns() + 25_000_000))
            readings += self.driver.poll()
        return readings


def bench_line(
    sense: Callable[[int], BodyMotion] = turning,
    settings: Vn100Settings = MISSION,
    unit_settings: Vn100EmulatorSettings | None = None,
    seed: int = 1,
    baud_rate: int = 115200,
) -> BenchLine:
    clock = SimClock()
    rng = np.random.default_rng(seed)
    line = EmulatedSerialLine(clock.now_ns, baud_rate, rng)
    unit = Vn100Emulator(sense, line.device, rng, replace(unit_settings or Vn100EmulatorSettings()))
    clock.attach(Alone(unit))
    return BenchLine(clock, line, unit, Vn100(line.host, clock, settings))


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
