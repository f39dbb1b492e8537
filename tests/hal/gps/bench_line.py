"""An emulated GPS receiver in orbit with its driver on a serial line in memory, and a position fix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.drivers.gps import Pvt, UbloxReceiver
from hal.interfaces.devices import GpsReading
from hal.interfaces.wires import SECOND_NS
from sim_hal.clock import SimClock, TimedSimulation
from sim_hal.emulators.gps import EmulatedGps, GpsErrors
from sim_hal.emulators.serial_line import EmulatedSerialLine
from sim_hal.settings import FreeBodySection
from sim_hal.worlds.free_body import FreeBody

UTC = "2026-03-20T12:00:00Z"
EXACT = GpsErrors(walk=0.0, noise=0.0, velocity_noise=0.0)


@dataclass
class GpsBench:
    clock: SimClock
    body: FreeBody
    line: EmulatedSerialLine
    gps: EmulatedGps
    driver: UbloxReceiver

    def fly(self, seconds: float) -> list[GpsReading]:
        """Poll at 10 Hz for some time, and return all readings."""
        readings = []
        for _ in range(round(10 * seconds)):
            self.clock.sleep_until_ns(self.clock.now_ns() + SECOND_NS // 10)
            readings += self.driver.poll()
        return readings


def bench(errors: GpsErrors = EXACT, baud_rate: int = 115200) -> GpsBench:
    clock = SimClock()
    body = FreeBody(FreeBodySection(), lambda: np.zeros(3), utc=UTC)
    line = EmulatedSerialLine(clock.now_ns, baud_rate, np.random.default_rng(1))
    gps = EmulatedGps(body, line.device, np.random.default_rng(2), errors)
    clock.attach(TimedSimulation(body.advance_to, [gps]))
    return GpsBench(clock, body, line, gps, UbloxReceiver(line.host, clock))


PVT = Pvt(
    date=(2026, 3, 20, 12, 34, 56),
    nano=-123_456,
    valid=0b111,
    fix=3,
    flags=1,
    satellites=9,
    longitude=-1_234_567_890,
    latitude=456_789_012,
    height=500_123_456,
    horizontal=2_500,
    vertical=4_000,
    velocity=(-7_123_456, 2_345_678, -123),
    speed_accuracy=55,
)
