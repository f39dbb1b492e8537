"""Single register bits that radiation flips; the driver has to find and repair the effect."""

from __future__ import annotations

from collections.abc import Sequence

from hal.drivers.pca9685 import CHANNELS, LED0_ON_L, MODE1, MODE2, PRE_SCALE
from sim_hal.emulators.ina219 import CALIBRATION, CONFIG
from sim_hal.emulators.vn100_registers import FIELD_BITS
from sim_hal.faults.bench import Bench, Lift, no_lift
from sim_hal.faults.kinds import Begin, FaultKind, Parameter, Parameters

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
