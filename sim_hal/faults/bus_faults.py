"""Faults of the I2C bus and the parts on it: PWM chip, current monitor, bridges and coils.

An upset is a single register bit that radiation flips; the driver has to find and repair the effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hal.drivers.pca9685 import CHANNELS, LED0_ON_L, MODE1, MODE2, PRE_SCALE
from sim_hal.emulators.coil_circuit import Condition
from sim_hal.emulators.i2c_bus import I2cPart
from sim_hal.emulators.ina219 import CALIBRATION, CONFIG
from sim_hal.emulators.vn100_registers import FIELD_BITS
from sim_hal.faults.bench import (
    CHANCE,
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

_MOST_BYTES = 32


class DisturbedPart:
    """A part whose data are altered between it and the bus; it acknowledges as before."""

    def __init__(
        self,
        part: I2cPart,
        written: Callable[[int, bytes], None] | None = None,
        read: Callable[[bytes], bytes] | None = None,
    ) -> None:
        """Pass writes to `written` in place of the part, and reads through `read`."""
        self._part = part
        self._written = written or part.write
        self._read = read or (lambda data: data)

    def answers(self, address: int) -> bool:
        """Return the part's answer."""
        return self._part.answers(address)

    def write(self, address: int, data: bytes) -> None:
        """Accept a write; a register pointer alone is never altered."""
        if len(data) == 1:
            self._part.write(address, data)
        else:
            self._written(address, data)

    def read(self, count: int) -> bytes:
        """Return altered bytes."""
        return self._read(self._part.read(count))


def part_of(bench: Bench, device: str) -> I2cPart | None:
    """Return the part of a device; None where it is not fitted."""
    return bench.hardware.pwm if device == "pwm" else bench.hardware.monitor


def _disturbed(
    bench: Bench,
    device: str,
    written: Callable[[int, bytes], None] | None = None,
    read: Callable[[bytes], bytes] | None = None,
) -> Lift:
    part = part_of(bench, device)
    return (
        no_lift if part is None else bench.hardware.bus.put_before(part, DisturbedPart(part, written, read))
    )


def _off(device: str) -> Begin:
    def begin(bench: Bench, _: Parameters) -> Lift:
        part = part_of(bench, device)
        if part is None:
            return no_lift
        part.brown_out()  # type: ignore[attr-defined]  # both parts can
        bench.hardware.bus.detach(part)
        return lambda: bench.hardware.bus.attach(part)

    return begin


def _brown_out(device: str) -> Begin:
    def begin(bench: Bench, _: Parameters) -> Lift:
        part = part_of(bench, device)
        if part is not None:
            part.brown_out()  # type: ignore[attr-defined]  # both parts can
        return no_lift

    return begin


def _stuck_pwm(bench: Bench, _: Parameters) -> Lift:
    return _disturbed(bench, "pwm", written=lambda address, data: None)


def _stuck_monitor(bench: Bench, _: Parameters) -> Lift:
    monitor = bench.hardware.monitor
    if monitor is None:
        return no_lift
    monitor.frozen = {number: monitor.register(number) for number in range(6)}
    monitor.frozen[2] |= 0b10  # keep the conversion-ready flag set
    return monitor.frozen.clear


def _garbage(device: str) -> Begin:
    def begin(bench: Bench, _: Parameters) -> Lift:
        return _disturbed(bench, device, read=lambda data: bench.generator.bytes(len(data)))

    return begin


def _bits(device: str) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        part = part_of(bench, device)

        def flipped(data: bytes) -> bytes:
            flips = np.packbits(bench.generator.random(8 * len(data)) < given["chance"])
            return (np.frombuffer(data, dtype=np.uint8) ^ flips).tobytes()

        def write(address: int, data: bytes) -> None:
            assert part is not None
            part.write(address, data[:1] + flipped(data[1:]))

        return _disturbed(bench, device, write, flipped)

    return begin


def _wrong_pwm(bench: Bench, _: Parameters) -> Lift:
    bench.hardware.pwm.upset(PRE_SCALE, 0x1E)
    return no_lift


def _wrong_monitor(bench: Bench, given: Parameters) -> Lift:
    return held(bench.hardware.monitor, "gain", given["gain"], 1.0)


def _delayed_pwm(bench: Bench, given: Parameters) -> Lift:
    part = bench.hardware.pwm

    def later(address: int, data: bytes) -> None:
        bench.after(given["delay"], lambda: part.write(address, data))

    return _disturbed(bench, "pwm", later)


def _delayed_monitor(bench: Bench, given: Parameters) -> Lift:
    return held(bench.hardware.monitor, "lag_ns", round(given["delay"] * 1e9), 0)


def _address(bench: Bench, device: str) -> int:
    part = part_of(bench, device)
    return getattr(part, "address", 0)


def _nack(device: str) -> Begin:
    return lambda bench, _: bench.hardware.bus.nack(_address(bench, device), times=None)


def _slow(device: str) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        chance = given["chance"]
        return bench.hardware.bus.time_out(_address(bench, device), lambda: bench.generator.random() < chance)

    return begin


def _part(device: str) -> tuple[FaultKind, ...]:
    """Return the faults that both parts have."""
    return (
        FaultKind(device, "off", "no power: nothing acknowledges, the registers are lost", _off(device)),
        FaultKind(device, "nack", "it acknowledges nothing", _nack(device), adds=True),
        FaultKind(device, "garbage", "reads return random bytes", _garbage(device)),
        FaultKind(
            device,
            "bits",
            "each bit read or written flips with this probability",
            _bits(device),
            {"chance": replace(CHANCE, default=5e-3)},
        ),
        FaultKind(
            device,
            "slow",
            "it stretches the clock beyond the bus's time-out, with this probability",
            _slow(device),
            {"chance": CHANCE},
            adds=True,
        ),
        FaultKind(
            device,
            "intermittent",
            "it acknowledges intermittently",
            intermittently(_nack(device)),
            TURNS,
            adds=True,
        ),
        FaultKind(
            device,
            "brown-out",
            "its registers return to their power-on values",
            _brown_out(device),
            momentary=True,
            adds=True,
        ),
    )


PWM = (
    *_part("pwm"),
    FaultKind("pwm", "stuck", "it acknowledges, but its outputs do not change", _stuck_pwm),
    FaultKind("pwm", "delayed", "writes take effect later, s", _delayed_pwm, {"delay": delay(0.2)}),
    FaultKind("pwm", "wrong", "a register upset: wrong PWM frequency", _wrong_pwm, momentary=True, adds=True),
)
MONITOR = (
    *_part("monitor"),
    FaultKind("monitor", "stuck", "always the same conversion", _stuck_monitor),
    FaultKind(
        "monitor", "delayed", "it reports old measurements, s", _delayed_monitor, {"delay": delay(2.0)}
    ),
    FaultKind(
        "monitor",
        "wrong",
        "measured values are multiplied by gain",
        _wrong_monitor,
        {"gain": Parameter(2.0, 0.0, 10.0)},
    ),
)
BUS = (
    FaultKind(
        "bus",
        "off",
        "no part acknowledges",
        lambda bench, _: bench.hardware.bus.nack(None, times=None),
        adds=True,
    ),
    FaultKind(
        "bus",
        "nack",
        "no acknowledge, with this probability",
        lambda bench, given: bench.hardware.bus.nack(
            None, times=None, chance=lambda: bench.generator.random() < given["chance"]
        ),
        {"chance": CHANCE},
        adds=True,
    ),
    FaultKind(
        "bus",
        "arbitration",
        "another master always wins",
        lambda bench, _: bench.hardware.bus.lose_arbitration(times=None),
        adds=True,
    ),
    FaultKind(
        "bus",
        "hang",
        "the clock line is held low",
        lambda bench, _: bench.hardware.bus.hang(times=None),
        adds=True,
    ),
    FaultKind(
        "bus",
        "intermittent",
        "the clock line is held low intermittently",
        intermittently(lambda bench, _: bench.hardware.bus.hang(times=None)),
        TURNS,
        adds=True,
    ),
)


_SET_UP = (MODE1, MODE2, PRE_SCALE)
_OUTPUTS = tuple(range(LED0_ON_L, LED0_ON_L + 4 * CHANNELS))
_MONITOR = (CONFIG, CALIBRATION)
_UNIT = (6, 7, 75)
"""The registers of the unit's stream: sentence, its rate, and packet."""
_MOST_FIELDS = 11  # of register 75: ports, divisor, groups and a word for each of eight groups


def _one_of(bench: Bench, given: Parameters, name: str, values: Sequence[int]) -> int:
    return round(given[name]) if name in given else int(bench.generator.choice(values))


def _pwm(bench: Bench, given: Parameters) -> Lift:
    # Uniform draws over all registers would seldom reach the three that configure the stream.
    among = _SET_UP if bench.generator.random() < 0.5 else _OUTPUTS
    register = _one_of(bench, given, "register", among)
    bench.hardware.pwm.flip(register, _one_of(bench, given, "bit", range(8)))
    return no_lift


def _monitor(bench: Bench, given: Parameters) -> Lift:
    monitor = bench.hardware.monitor
    if monitor is not None:
        register = _one_of(bench, given, "register", _MONITOR)
        monitor.upset(register, _one_of(bench, given, "bit", range(16)))
    return no_lift


def _imu(bench: Bench, given: Parameters) -> Lift:
    unit = bench.hardware.unit
    register = _one_of(bench, given, "register", _UNIT)
    held = FIELD_BITS * len(unit.registers.read(register))
    unit.upset(register, _one_of(bench, given, "bit", range(held)), bench.now_ns())
    return no_lift


def _upset(
    device: str,
    begin: Begin,
    registers: tuple[int, ...],
    bits: int,
    meaning: str,
) -> FaultKind:
    given = {
        "register": Parameter(None, min(registers), max(registers), choices=tuple(sorted(registers))),
        "bit": Parameter(None, 0.0, bits - 1.0, whole=True),
    }
    return FaultKind(device, "upset", meaning, begin, given, momentary=True, adds=True)


_MEANING = "a bit of a register flips"
PWM_UPSET = _upset("pwm", _pwm, (*_SET_UP, *_OUTPUTS), 8, _MEANING)
MONITOR_UPSET = _upset("monitor", _monitor, _MONITOR, 16, _MEANING)
IMU_UPSET = _upset(
    "imu", _imu, _UNIT, FIELD_BITS * _MOST_FIELDS, f"{_MEANING}, {FIELD_BITS} to each of its fields"
)


_OHM = Parameter(5.0, 0.1, 1000.0, "ohm")
_COIL = (
    (Condition.OPEN, "open", "broken wire: no current"),
    (Condition.SHORTED, "shorted", "the bridge drives `ohm`, the coil carries no current"),
    (Condition.REVERSED, "reversed", "reversed polarity"),
)
_BRIDGE = (
    (Condition.A_HIGH, "a-high", "the output of input A stays high"),
    (Condition.A_LOW, "a-low", "the output of input A stays low"),
    (Condition.B_HIGH, "b-high", "the output of input B stays high"),
    (Condition.B_LOW, "b-low", "the output of input B stays low"),
)


def _broken(axis: int, condition: Condition) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        circuit = bench.hardware.circuit
        circuit.become(axis, condition, given.get("ohm", 0.0))
        return lambda: circuit.become(axis, Condition.SOUND)

    return begin


def _kinds() -> tuple[FaultKind, ...]:
    found = []
    for axis, letter in enumerate("xyz"):
        for condition, kind, meaning in _COIL:
            given = {"ohm": _OHM} if condition is Condition.SHORTED else {}
            found.append(FaultKind(f"coil-{letter}", kind, meaning, _broken(axis, condition), given))
        for condition, kind, meaning in _BRIDGE:
            found.append(FaultKind(f"bridge-{letter}", kind, meaning, _broken(axis, condition)))
    return tuple(found)


COILS = _kinds()
