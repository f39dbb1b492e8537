"""Faults of the devices of an orbit: GPS receiver, solar strings, wide cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sim_hal.emulators.serial_line import LineFaults
from sim_hal.emulators.star_camera import EmulatedStarCamera
from sim_hal.faults.bench import Bench, Lift, held, no_lift
from sim_hal.faults.kinds import (
    CHANCE,
    PERIOD,
    TURNS,
    Begin,
    FaultKind,
    Parameter,
    Parameters,
    delay,
    intermittently,
)
from sim_hal.faults.parts import DisturbedPart

if TYPE_CHECKING:  # the list of faults needs no devices
    from sim_hal.emulators.gps import EmulatedGps
    from sim_hal.emulators.strings import EmulatedStrings

GpsFault = Callable[["EmulatedGps", Bench, Parameters], Lift]
StringsFault = Callable[["EmulatedStrings", Bench, Parameters], Lift]

# GPS receiver.


def _line(faults: Callable[[Parameters], LineFaults]) -> Begin:
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


_SILENT = _line(lambda _: LineFaults(silent=True))

GPS = (
    FaultKind("gps", "off", "no power; afterwards set-up and satellites are lost", _receiver(_gps_off)),
    FaultKind("gps", "silent", "no byte arrives", _SILENT, adds=True),
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
        "gps", "garbage", "random bytes replace its own", _line(lambda _: LineFaults(garbage=True)), adds=True
    ),
    FaultKind(
        "gps",
        "bits",
        "each bit flips with this probability",
        _line(lambda p: LineFaults(flip_probability=p["chance"])),
        {"chance": replace(CHANCE, default=1e-3)},
        adds=True,
    ),
    FaultKind(
        "gps",
        "delayed",
        "every byte arrives later, s",
        _line(lambda p: LineFaults(delay_ns=round(p["delay"] * 1e9))),
        {"delay": delay(2.0)},
        adds=True,
    ),
    FaultKind("gps", "intermittent", "silent intermittently", intermittently(_SILENT), TURNS, adds=True),
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

_CAMERA = Parameter(0.0, 0.0, 6.0, whole=True)


def _cameras(bench: Bench, given: Parameters) -> list[EmulatedStarCamera]:
    """Return the cameras that a fault names: number 1 to 6, or all of them by 0."""
    wide, number = bench.hardware.orbit.wide, round(given["camera"])
    return [camera for index, camera in enumerate(wide, start=1) if number in {0, index}]


def _held(bench: Bench, given: Parameters, attribute: str, value: object, sound: object) -> Lift:
    lifts = [held(camera, attribute, value, sound) for camera in _cameras(bench, given)]

    def lift() -> None:
        for one in lifts:
            one()

    return lift


def _showing(fault: str) -> Begin:
    return lambda bench, given: _held(bench, given, "fault", fault, "")


WIDE = (
    *(
        FaultKind("wide", kind, meaning, _showing(kind), {"camera": _CAMERA})
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
        lambda bench, given: _held(bench, given, "late_ns", round(given["delay"] * 1e9), 0),
        {"camera": _CAMERA, "delay": delay(3.0)},
    ),
    FaultKind(
        "wide",
        "intermittent",
        "off intermittently",
        intermittently(_showing("off")),
        {"camera": _CAMERA} | TURNS | {"period": replace(PERIOD, default=6.0)},
    ),
)
"""`camera` is the number of one, in the configuration's order; 0 means all."""
