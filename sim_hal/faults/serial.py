"""Faults of the inertial unit, its line and its magnetometer."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.emulators.serial_line import LineFaults
from sim_hal.emulators.vn100_registers import BAUD_RATES, UnitError
from sim_hal.emulators.vn100_sensors import GAUSS_PER_TESLA, Measured
from sim_hal.faults.bench import Bench, Lift, held, no_lift
from sim_hal.faults.kinds import CHANCE, TURNS, Begin, FaultKind, Parameter, Parameters, delay, intermittently


def _line(faults: Callable[[Parameters], LineFaults]) -> Begin:
    return lambda bench, given: bench.disturb(bench.line.to_host, faults(given))


_SILENT = _line(lambda _: LineFaults(silent=True))


def _off(bench: Bench, _: Parameters) -> Lift:
    bench.hardware.unit.switch_off()
    return lambda: bench.hardware.unit.switch_on(bench.now_ns())


def _reset(bench: Bench, _: Parameters) -> Lift:
    bench.hardware.unit.switch_on(bench.now_ns())
    return no_lift


def _unplugged(bench: Bench, _: Parameters) -> Lift:
    host = bench.host
    if host is None:  # a pseudo-terminal cannot be unplugged: silence it both ways
        ours = bench.disturb(bench.line.to_host, LineFaults(silent=True))
        theirs = bench.disturb(bench.line.to_device, LineFaults(silent=True))

        def plug_in() -> None:
            ours()
            theirs()

        return plug_in
    return held(host, "unplugged", True, False)


def _baud(bench: Bench, given: Parameters) -> Lift:
    # The speed changes even where the stream does not fit: no command was given.
    with suppress(UnitError):
        bench.hardware.unit.change_baud_rate(round(given["rate"]), bench.now_ns())
    return no_lift


def _measuring(bench: Bench, alter: Callable[[Measured], Measured]) -> Lift:
    unit = bench.hardware.unit
    unit.alter = alter

    def lift() -> None:
        if unit.alter is alter:
            unit.alter = None

    return lift


def _stuck(bench: Bench, _: Parameters) -> Lift:
    kept: list[Measured] = []

    def same(measured: Measured) -> Measured:
        kept.append(measured)
        return kept[0]

    return _measuring(bench, same)


def _wrong(bench: Bench, given: Parameters) -> Lift:
    turn = from_rotation_vector(np.array([0.0, given["angle"], 0.0]))
    bias = np.array([0.0, given["rate"], 0.0])
    return _measuring(
        bench,
        lambda seen: replace(seen, quaternion=multiply(turn, seen.quaternion), rate=seen.rate + bias),
    )


_WRONG = {"angle": Parameter(0.2, -math.pi, math.pi, "rad"), "rate": Parameter(0.05, -10.0, 10.0, "rad/s")}
_ONE_OF = Parameter(8.0, 2.0, 1000.0, whole=True)
_RATE = Parameter(230400.0, min(BAUD_RATES), max(BAUD_RATES), "baud", choices=BAUD_RATES)

IMU = (
    FaultKind("imu", "off", "no power; restarts from its saved settings afterwards", _off),
    FaultKind("imu", "silent", "no byte arrives", _SILENT, adds=True),
    FaultKind("imu", "unplugged", "the serial port disappears", _unplugged),
    FaultKind("imu", "stuck", "valid packets, constant values", _stuck),
    FaultKind(
        "imu", "garbage", "random bytes replace its own", _line(lambda _: LineFaults(garbage=True)), adds=True
    ),
    FaultKind("imu", "wrong", "valid packets, wrong values", _wrong, _WRONG),
    FaultKind(
        "imu",
        "slow",
        "one packet of n arrives",
        _line(lambda p: LineFaults(thinned=round(p["n"]))),
        {"n": _ONE_OF},
        adds=True,
    ),
    FaultKind(
        "imu",
        "delayed",
        "every byte arrives later, s",
        _line(lambda p: LineFaults(delay_ns=round(p["delay"] * 1e9))),
        {"delay": delay(0.2)},
        adds=True,
    ),
    FaultKind(
        "imu",
        "intermittent",
        "silent intermittently",
        intermittently(_SILENT),
        TURNS,
        adds=True,
    ),
    FaultKind(
        "imu",
        "bits",
        "each bit flips with this probability",
        _line(lambda p: LineFaults(flip_probability=p["chance"])),
        {"chance": replace(CHANCE, default=1e-3)},
        adds=True,
    ),
    FaultKind(
        "imu",
        "cut",
        "packets lose bytes with this probability",
        _line(lambda p: LineFaults(cut_probability=p["chance"])),
        {"chance": replace(CHANCE, default=0.3)},
        adds=True,
    ),
    FaultKind("imu", "reset", "restarts from its saved settings", _reset, momentary=True),
    FaultKind("imu", "baud", "its baud rate changes", _baud, {"rate": _RATE}, momentary=True),
)


# The unit's magnetometer: attitude and rates stay right.


def _stuck_field(bench: Bench, _: Parameters) -> Lift:
    kept: list[Measured] = []

    def same(measured: Measured) -> Measured:
        kept.append(measured)
        return replace(measured, mag=kept[0].mag)

    return _measuring(bench, same)


def _saturated_field(bench: Bench, _: Parameters) -> Lift:
    return _measuring(bench, lambda seen: replace(seen, mag=np.copysign(FULL_SCALE, seen.mag)))


def _false_field(bench: Bench, given: Parameters) -> Lift:
    direction = bench.generator.standard_normal(3)
    false = GAUSS_PER_TESLA * given["field"] * direction / np.linalg.norm(direction)
    return _measuring(bench, lambda seen: replace(seen, mag=seen.mag + false))


FULL_SCALE = 2.5
"""Gauss of an axis [VN-100 data sheet]."""

MAGNETOMETER = (
    FaultKind("magnetometer", "stuck", "the same field for ever", _stuck_field),
    FaultKind("magnetometer", "saturated", "all axes at full scale", _saturated_field),
    FaultKind(
        "magnetometer",
        "false",
        "a constant field is added, T",
        _false_field,
        {"field": Parameter(2e-5, 1e-8, 1e-3, "T")},
    ),
)
