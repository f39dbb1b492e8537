"""Position fixes for several tests of the GPS receiver."""

from __future__ import annotations

from hal.drivers.gps import Pvt

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
