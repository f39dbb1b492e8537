"""Faults of the sensors: inertial unit, magnetometer, GPS receiver, solar strings, and cameras."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.emulators.serial_line import LineFaults
from sim_hal.emulators.star_camera import EmulatedStarCamera
from sim_hal.emulators.vn100_registers import BAUD_RATES, UnitError
from sim_hal.emulators.vn100_sensors import GAUSS_PER_TESLA, Measured
from sim_hal.faults.bench import (
    CHANCE,
    PERIOD,
    TURNS,
    Begin,
    Bench,
    FaultKind,
    Lift,
    Parameter,
    Parameters,
    delay,
    held,
    intermittently,
    no_lift,
)
from sim_hal.faults.bus_faults import DisturbedPart

if TYPE_CHECKING:  # the list of faults needs no devices
    from sim_hal.emulators.gps import EmulatedGps
    from sim_hal.emulators.solar_strings import EmulatedStrings


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


GpsFault = Callable[["EmulatedGps", Bench, Parameters], Lift]
StringsFault = Callable[["EmulatedStrings", Bench, Parameters], Lift]

# GPS receiver.


def _gps_line(faults: Callable[[Parameters], LineFaults]) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        line = bench.gps_line
        return no_lift if line is None else bench.disturb(line.to_host, faults(given))

    return begin


def _receiver(fault: GpsFault) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        gps = bench.hardware.orbit.gps
        return no_lift if gps is None else fault(gps, bench, given)

    return begin


def _gps_off(gps: EmulatedGps, bench: Bench, _: Parameters) -> Lift:
    gps.switch_off()
    return lambda: gps.switch_on(bench.now_ns())


def _false_place(gps: EmulatedGps, bench: Bench, given: Parameters) -> Lift:
    direction = bench.generator.standard_normal(3)
    shift = given["distance"] * direction / np.linalg.norm(direction)
    return held(gps, "shift", shift, np.zeros(3))


def _wrong_clock(gps: EmulatedGps, _: Bench, given: Parameters) -> Lift:
    return held(gps, "clock_ns", round(given["seconds"] * 1e9), 0)


_GPS_SILENT = _gps_line(lambda _: LineFaults(silent=True))

GPS = (
    FaultKind("gps", "off", "no power; afterwards set-up and satellites are lost", _receiver(_gps_off)),
    FaultKind("gps", "silent", "no byte arrives", _GPS_SILENT, adds=True),
    FaultKind(
        "gps", "no-fix", "no satellite is received", _receiver(lambda g, *_: held(g, "blind", True, False))
    ),
    FaultKind(
        "gps", "stuck", "the same epoch repeatedly", _receiver(lambda g, *_: held(g, "frozen", True, False))
    ),
    FaultKind(
        "gps",
        "false",
        "a valid fix at a false place, m away",
        _receiver(_false_place),
        {"distance": Parameter(2e4, 1.0, 2e7, "m")},
    ),
    FaultKind(
        "gps",
        "clock",
        "a valid fix with the wrong time, s",
        _receiver(_wrong_clock),
        {"seconds": Parameter(180.0, -86_400.0, 86_400.0, "s")},
        adds=True,
    ),
    FaultKind(
        "gps",
        "garbage",
        "random bytes replace its own",
        _gps_line(lambda _: LineFaults(garbage=True)),
        adds=True,
    ),
    FaultKind(
        "gps",
        "bits",
        "each bit flips with this probability",
        _gps_line(lambda p: LineFaults(flip_probability=p["chance"])),
        {"chance": replace(CHANCE, default=1e-3)},
        adds=True,
    ),
    FaultKind(
        "gps",
        "delayed",
        "every byte arrives later, s",
        _gps_line(lambda p: LineFaults(delay_ns=round(p["delay"] * 1e9))),
        {"delay": delay(2.0)},
        adds=True,
    ),
    FaultKind("gps", "intermittent", "silent intermittently", intermittently(_GPS_SILENT), TURNS, adds=True),
)

# Solar strings.


def _strings(fault: StringsFault) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        strings = bench.hardware.orbit.strings
        return no_lift if strings is None else fault(strings, bench, given)

    return begin


def _strings_off(strings: EmulatedStrings, bench: Bench, _: Parameters) -> Lift:
    bus = bench.hardware.bus
    for part in strings.parts:
        part.brown_out()
        bus.detach(part)

    def lift() -> None:
        for part in strings.parts:
            bus.attach(part)

    return lift


def _dead(strings: EmulatedStrings, _: Bench, given: Parameters) -> Lift:
    dead = np.zeros(len(strings.dead), dtype=bool)
    number = round(given["string"])
    dead[number - 1 if number else slice(None)] = True
    return held(strings, "dead", dead, np.zeros(len(dead), dtype=bool))


def _noisy(strings: EmulatedStrings, bench: Bench, _: Parameters) -> Lift:
    lifts = [
        bench.hardware.bus.put_before(
            part, DisturbedPart(part, read=lambda data: bench.generator.bytes(len(data)))
        )
        for part in strings.parts
    ]

    def lift() -> None:
        for one in lifts:
            one()

    return lift


STRINGS = (
    FaultKind("strings", "off", "no power: no converter acknowledges", _strings(_strings_off)),
    FaultKind(
        "strings",
        "dead",
        "this string gives no current; 0: none does",
        _strings(_dead),
        {"string": Parameter(1.0, 0.0, 4.0, whole=True)},
    ),
    FaultKind(
        "strings",
        "stuck",
        "the same currents for ever",
        _strings(lambda s, *_: held(s, "frozen", True, False)),
    ),
    FaultKind(
        "strings",
        "wrong",
        "all currents are multiplied by gain",
        _strings(lambda s, _, p: held(s, "gain", p["gain"], 1.0)),
        {"gain": Parameter(0.5, 0.0, 10.0)},
    ),
    FaultKind("strings", "garbage", "reads return random bytes", _strings(_noisy)),
)

# Wide cameras.

_WIDE_NUMBER = Parameter(0.0, 0.0, 6.0, whole=True)


def _cameras(bench: Bench, given: Parameters) -> list[EmulatedStarCamera]:
    """Return the cameras that a fault names: number 1 to 6, or all of them by 0."""
    wide, number = bench.hardware.orbit.wide, round(given["camera"])
    return [camera for index, camera in enumerate(wide, start=1) if number in {0, index}]


def _wide_held(bench: Bench, given: Parameters, attribute: str, value: object, sound: object) -> Lift:
    lifts = [held(camera, attribute, value, sound) for camera in _cameras(bench, given)]

    def lift() -> None:
        for one in lifts:
            one()

    return lift


def _wide_showing(fault: str) -> Begin:
    return lambda bench, given: _wide_held(bench, given, "fault", fault, "")


WIDE = (
    *(
        FaultKind("wide", kind, meaning, _wide_showing(kind), {"camera": _WIDE_NUMBER})
        for kind, meaning in (
            ("off", "ignores triggers, delivers no frame"),
            ("black", "frames without light"),
            ("saturated", "saturated frames"),
            ("blinded", "the Sun's stray light over the whole frame"),
            ("frozen", "the same frame repeatedly"),
            ("garbage", "random pixels"),
            ("wrong", "rows in the opposite order"),
        )
    ),
    FaultKind(
        "wide",
        "delayed",
        "frames arrive later, s",
        lambda bench, given: _wide_held(bench, given, "late_ns", round(given["delay"] * 1e9), 0),
        {"camera": _WIDE_NUMBER, "delay": delay(3.0)},
    ),
    FaultKind(
        "wide",
        "intermittent",
        "off intermittently",
        intermittently(_wide_showing("off")),
        {"camera": _WIDE_NUMBER} | TURNS | {"period": replace(PERIOD, default=6.0)},
    ),
)
"""`camera` is the number of one, in the configuration's order; 0 means all."""


def _showing(fault: str) -> Begin:
    def begin(bench: Bench, _: Parameters) -> Lift:
        camera = bench.hardware.camera
        if camera is None:
            return no_lift
        camera.fault = fault

        def lift() -> None:
            if camera.fault == fault:
                camera.fault = ""

        return lift

    return begin


def _slow(bench: Bench, given: Parameters) -> Lift:
    return held(bench.hardware.camera, "one_of", round(given["n"]), 1)


def _delayed(bench: Bench, given: Parameters) -> Lift:
    return held(bench.hardware.camera, "late_ns", round(given["delay"] * 1e9), 0)


CAMERA = (
    FaultKind("camera", "off", "ignores triggers, delivers no frame", _showing("off")),
    FaultKind("camera", "black", "frames without light", _showing("black")),
    FaultKind("camera", "saturated", "saturated frames", _showing("saturated")),
    FaultKind("camera", "blinded", "the Sun's stray light over the whole frame", _showing("blinded")),
    FaultKind("camera", "frozen", "the same frame repeatedly", _showing("frozen")),
    FaultKind("camera", "torn", "upper part of the previous frame, lower part of this one", _showing("torn")),
    FaultKind("camera", "garbage", "random pixels", _showing("garbage")),
    FaultKind("camera", "wrong", "rows in the opposite order", _showing("wrong")),
    FaultKind(
        "camera",
        "slow",
        "one trigger of n gives a frame",
        _slow,
        {"n": Parameter(3.0, 2.0, 1000.0, whole=True)},
    ),
    FaultKind("camera", "delayed", "frames arrive later, s", _delayed, {"delay": delay(3.0)}),
    FaultKind(
        "camera",
        "intermittent",
        "off intermittently",
        intermittently(_showing("off")),
        TURNS | {"period": replace(PERIOD, default=6.0)},
    ),
)
