"""The commands of an emulated VN-100's attitude filter: disturbances, heading, and biases to start from.

VectorNav UM001 ch. 8; set initial heading and set filter bias as VectorNav's SDK 0.99 sends them, and its
units with satellite navigation answer. Assumed: in the absolute heading mode the magnetometer sets the
heading, so tare and set initial heading change nothing; gravity sets pitch and roll in every mode, so only
the yaw of a given attitude has an effect. The filter knows its gyro bias exactly and finds no other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply, normalise
from sim_hal.emulators.vn100_registers import (
    FILTER_STARTUP_BIAS,
    GYRO_STARTUP_BIAS,
    INVALID_PARAMETER,
    TOO_FEW,
    RegisterFile,
    UnitError,
    expect_count,
)
from sim_hal.emulators.vn100_sensors import Measured

ATTITUDE_COMMANDS = frozenset({"KMD", "KAD", "TAR", "SIH", "SGB", "SFB"})
_DISTURBANCES = {"KMD": 1 << 11, "KAD": 1 << 12}
_VPE_CONTROL, _HEADING_MODE, _ABSOLUTE = 35, 1, 0


class AttitudeCommands:
    """The attitude filter of one unit as far as commands reach it.

    Attributes:
        status: the VPE status word; KMD and KAD set its disturbance bits.
    """

    def __init__(self, registers: RegisterFile, gyro_bias: FloatArray) -> None:
        """`gyro_bias` (3,) rad/s, sensor axes, is the filter's estimate, which SGB and SFB store."""
        self._registers = registers
        self._gyro_bias = gyro_bias
        self._turn: FloatArray | None = None
        self.status = 0

    def reset(self) -> None:
        """Discard the state that commands have set."""
        self._turn = None
        self.status = 0

    def turned(self, measured: Measured) -> Measured:
        """Return a sample with the heading that commands have set."""
        if self._turn is None:
            return measured
        return replace(measured, quaternion=multiply(measured.quaternion, self._turn))

    def execute(self, command: str, fields: tuple[str, ...], sample: Callable[[], Measured]) -> None:
        """Execute one of ATTITUDE_COMMANDS; `sample` measures now. Raises UnitError."""
        if command in _DISTURBANCES:
            bit = _DISTURBANCES[command]
            self.status = self.status | bit if flag(fields) else self.status & ~bit
        elif command == "SIH":
            self._set_heading(_yaw_of(_numbers_of(fields)), sample)
        else:
            expect_count(fields, 0, 0)
            if command == "TAR":
                self._set_heading(0.0, sample)
            else:
                self._store_biases(everything=command == "SFB")

    def _set_heading(self, yaw: float, sample: Callable[[], Measured]) -> None:
        """Turn the attitude about the vertical so that the yaw is now `yaw`, rad."""
        if self._registers.integer(_VPE_CONTROL, _HEADING_MODE) == _ABSOLUTE:
            return
        change = from_rotation_vector(np.array([0.0, 0.0, yaw - math.radians(sample().yaw_pitch_roll[0])]))
        self._turn = change if self._turn is None else normalise(multiply(self._turn, change))

    def _store_biases(self, everything: bool) -> None:
        gyro = tuple(f"{value:+010.6f}" for value in self._gyro_bias.tolist())
        self._registers.write(GYRO_STARTUP_BIAS, gyro)
        kept = self._registers.read(FILTER_STARTUP_BIAS)[3:]
        self._registers.write(FILTER_STARTUP_BIAS, (*gyro, *(("+00.000000",) * 4 if everything else kept)))


def flag(fields: tuple[str, ...]) -> bool:
    """Return the one field, 0 or 1, of a command. Raises UnitError."""
    expect_count(fields, 1, 1)
    if fields[0] not in {"0", "1"}:
        raise UnitError(INVALID_PARAMETER)
    return fields[0] == "1"


def _numbers_of(fields: tuple[str, ...]) -> list[float]:
    """Return a heading, yaw, pitch and roll, all in degrees, or a quaternion. Raises UnitError."""
    expect_count(fields, 1, 4)
    if len(fields) == 2:
        raise UnitError(TOO_FEW)
    try:
        values = [float(text) for text in fields]
    except ValueError as error:
        raise UnitError(INVALID_PARAMETER) from error
    if not all(map(math.isfinite, values)):
        raise UnitError(INVALID_PARAMETER)
    return values


def _yaw_of(values: list[float]) -> float:
    """Return the yaw in rad of `_numbers_of`; a quaternion needs no unit length. Raises UnitError."""
    if len(values) < 4:
        return math.radians(values[0])
    if not any(values):
        raise UnitError(INVALID_PARAMETER)
    attitude = Measured(normalise(np.array(values)), np.zeros(3), np.zeros(3), np.zeros(3))
    return math.radians(attitude.yaw_pitch_roll[0])
