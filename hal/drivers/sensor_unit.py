"""Inertial unit of separate sensors, each with a driver that has the properties of CircuitPython drivers.

A unit without a gyro gives readings without a rate. `CheckedUnit` rejects implausible readings of a driver
that is not part of this package.

CircuitPython drivers of motion sensors have the properties `gyro` (rad/s), `magnetic` (microtesla) and
`acceleration` (m/s^2). They use an I2C bus with the methods of `busio.I2C`, and wait while they start. All
sensors are started before the control loop, and are read by a separate periodic job, never by the control
loop. After a failure the job starts all sensors again, because a brown-out clears their settings. A gyro or
magnetometer that repeats the same value for three seconds counts as a failure, because after a brown-out many
sensors sleep and answer with their last value or zero.

`Adis16470` is the driver of an inertial sensor of Analog Devices on an SPI bus (data sheet, revision C). An
SPI frame has 16 bits, and the answer to a read request comes in the next frame. The value of each axis has 32
bits in two registers. The sample counter is read before and after all axes; equal values show that the axes
belong to one sample. The decimation is read as well, because a brown-out resets it.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hal.interfaces.devices import FloatArray, ImuLink, ImuReading, InertialUnit
from hal.interfaces.errors import DeviceError, NotResponding, Refused
from hal.interfaces.wires import SECOND_NS, Clock, RawI2cBus, SpiDevice

TESLA_PER_UNIT = 1e-6
_FAILURES = 3
"""Number of consecutive failures after which the sensors are started again."""
_ALIKE = 10
"""Number of repetitions of a sample after which it counts as stuck; a working sensor has noise."""
_STUCK_S, _AGAIN_S = 3, 60
"""Time (s) of equal values after which the sensors are started again, and interval of further starts."""
LARGEST_RATE = math.radians(2000.0)
"""Default of the largest accepted body rate (rad/s) per axis, which is the range of common gyros."""
_NORM_TOLERANCE = 1e-2
"""Largest accepted deviation of a quaternion's norm from 1."""
_MOST_AHEAD_NS = SECOND_NS // 10
"""Largest time (ns) by which the time of a reading may be ahead of the clock."""
_RANGED = "gyro", "magnetic"
_SHAPES = {"quaternion": (4,), "rate": (3,), "field": (3,), "acceleration": (3,)}
_NO_RATE = np.full(3, math.nan)
_FREE_FALL = 1.0
"""Specific force (m/s^2) below which the vertical direction counts as unknown."""


class CircuitPythonI2c:
    """An I2C bus with the interface that CircuitPython drivers expect (`busio.I2C`)."""

    def __init__(self, bus: RawI2cBus) -> None:
        self._bus = bus
        self._lock = threading.Lock()

    def try_lock(self) -> bool:
        """Reserve the bus for one driver, and return whether the bus was free."""
        return self._lock.acquire(blocking=False)

    def unlock(self) -> None:
        """Release the bus."""
        self._lock.release()

    def writeto(self, address: int, buffer: Any, *, start: int = 0, end: int | None = None) -> None:
        """Write the bytes of a buffer."""
        self._bus.exchange(address, bytes(buffer[start:end]), 0)

    def readfrom_into(self, address: int, buffer: Any, *, start: int = 0, end: int | None = None) -> None:
        """Read bytes into a buffer."""
        place = slice(start, len(buffer) if end is None else end)
        buffer[place] = self._bus.exchange(address, b"", place.stop - start)

    def writeto_then_readfrom(
        self,
        address: int,
        out_buffer: Any,
        in_buffer: Any,
        *,
        out_start: int = 0,
        out_end: int | None = None,
        in_start: int = 0,
        in_end: int | None = None,
    ) -> None:
        """Write bytes, and read bytes after a repeated START."""
        place = slice(in_start, len(in_buffer) if in_end is None else in_end)
        sent = bytes(out_buffer[out_start:out_end])
        in_buffer[place] = self._bus.exchange(address, sent, place.stop - in_start)


@dataclass(frozen=True, slots=True)
class SensorPart:
    """One sensor of a unit.

    Attributes:
        name: name of the sensor in messages.
        make: function that starts the sensor and returns its driver.
        measures: matrix (3, 3) from the axes of the sensor to the axes of the inertial unit, for each
            quantity that the sensor measures.
    """

    name: str
    make: Callable[[], Any]
    measures: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class UnitSettings:
    """Settings of an inertial unit.

    Attributes:
        mounting: (3, 3) rotation matrix from unit axes into body axes.
        gyro_matrix: (3, 3) matrix from the true to the measured rate, body axes.
        field_matrix: (3, 3) matrix from the true to the measured magnetic field, body axes, without the
            magnetometer's bias.
        field_bias: (3,) bias of the magnetometer, T, body axes.
        rate_hz: samples per second.
        rate_range: largest accepted body rate per axis, rad/s.
        field_range: largest accepted magnetic field per axis, T.
    """

    mounting: FloatArray
    gyro_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    field_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    field_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    rate_hz: int
    rate_range: float = LARGEST_RATE
    field_range: float

    def body_maps(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return matrices (3, 3) that correct measured rate and field, and an offset of the field (3,), T.

        The corrected rate and field are in body axes. The offset is caused by the magnetometer's bias, and is
        subtracted from the corrected field.
        """
        gyro, magnetometer = (
            np.asarray(np.linalg.inv(matrix), dtype=float) for matrix in (self.gyro_matrix, self.field_matrix)
        )
        return gyro @ self.mounting, magnetometer @ self.mounting, magnetometer @ self.field_bias


class SensorUnit:
    """Inertial unit of separate sensors, which implements `hal.interfaces.devices.InertialUnit`."""

    def __init__(self, clock: Clock, parts: Sequence[SensorPart], settings: UnitSettings) -> None:
        self.name = "inertial unit"
        self._clock, self._parts, self._settings = clock, parts, settings
        self._rate_map, self._field_map, self._field_offset = settings.body_maps()
        self._drivers: list[Any] = []
        self._readings: list[ImuReading] = []
        self._lock = threading.Lock()
        self._failures = self._samples = self._out_of_range = self._not_finite = 0
        self._alike = Counter[str]()  # number of equal consecutive values of each quantity
        self._error = self._rejection = ""
        self._last_ns = -1
        self._before: dict[str, FloatArray] = {}
        self._ticker = clock.ticker("sensors", SECOND_NS // settings.rate_hz, self._serve)

    def configure(self) -> None:
        """Start all sensors, which may take seconds. Raises NotResponding."""
        with self._lock:
            self._start()

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call. Raises NotResponding while a sensor does not answer."""
        # The list is replaced without the lock, which is held for seconds while a sensor starts.
        readings, self._readings = self._readings, []
        if not readings and self._failures >= _FAILURES:
            raise NotResponding(self.name, self._error)
        return readings

    def link(self) -> ImuLink:
        """Return the counters of the samples; each sample counts as one byte."""
        counts = self._samples, self._samples, 0, 0, self._out_of_range, self._not_finite
        return ImuLink(*counts, self._last_ns, self._rejection)

    def close(self) -> None:
        """Stop reading."""
        self._ticker.stop()

    def _start(self) -> None:
        self._drivers = []
        for part in self._parts:
            try:
                self._drivers.append(part.make())
            # CircuitPython drivers raise RuntimeError or ValueError for a missing or a different sensor.
            except (OSError, RuntimeError, ValueError, DeviceError) as error:
                self._drivers = []
                raise NotResponding(self.name, f"{part.name}: {error}; check power and wiring") from error

    def _serve(self) -> None:
        """Read all sensors once. The clock calls this method periodically."""
        with self._lock:
            try:
                if not self._drivers or self._failures == _FAILURES:
                    self._failures = _FAILURES
                    self._start()
                begun_ns, values = self._clock.now_ns(), self._read()
            except (OSError, RuntimeError, ValueError, DeviceError) as error:
                self._error, self._failures = str(error), min(self._failures + 1, _FAILURES)
                return
            self._failures, self._error = 0, ""
        self._samples += 1
        self._last_ns = self._clock.now_ns()
        if self._accepts(values):
            self._readings.append(self._reading(values, (begun_ns + self._last_ns) // 2))
        rate = self._settings.rate_hz
        stuck = [name for name in _RANGED if self._alike[name] % (_AGAIN_S * rate) == _STUCK_S * rate]
        if stuck:
            self._error, self._failures = f"{stuck[0]} repeats the same value: started again", _FAILURES

    def _read(self) -> dict[str, FloatArray]:
        return {
            quantity: axes @ np.array(getattr(driver, quantity), dtype=float)
            for part, driver in zip(self._parts, self._drivers, strict=True)
            for quantity, axes in part.measures.items()
        }

    def _accepts(self, values: dict[str, FloatArray]) -> bool:
        """Return whether a sample is finite, within the ranges and not stuck; count rejected samples.

        If only the rate is stuck, the rate is removed from `values`.
        """
        settings, before = self._settings, self._before
        for name, value in values.items():
            alike = name in before and np.array_equal(value, before[name])
            self._alike[name] = self._alike[name] + 1 if alike else 0
        self._before = dict(values)
        for name, value in values.items():
            if not np.isfinite(value).all():
                self._not_finite += 1
                self._rejection = f"{name} = {value.tolist()}"
                return False
        largest = dict(
            zip(_RANGED, (settings.rate_range, settings.field_range / TESLA_PER_UNIT), strict=True)
        )
        beyond = [name for name in largest if name in values and np.abs(values[name]).max() > largest[name]]
        equal, equal_rates = min(self._alike[name] for name in values), self._alike["gyro"]
        if beyond:
            self._rejection = f"{beyond[0]} = {values[beyond[0]].tolist()}"
        elif equal >= _ALIKE:
            self._rejection = f"{equal + 1} samples in a row are identical"
        elif equal_rates >= max(_ALIKE, settings.rate_hz // 2):
            self._rejection = f"{equal_rates + 1} rates in a row are identical"
            del values["gyro"]
        else:
            return True
        self._out_of_range += 1
        return not (beyond or equal >= _ALIKE)

    def _reading(self, values: dict[str, FloatArray], time_ns: int) -> ImuReading:
        mounting = self._settings.mounting
        field = self._field_map @ values["magnetic"] * TESLA_PER_UNIT - self._field_offset
        acceleration = mounting @ values.get("acceleration", np.zeros(3))
        return ImuReading(
            time_ns=time_ns,
            arrival_ns=self._last_ns,
            device_time_ns=time_ns,
            quaternion=level_attitude(field, acceleration),
            rate=self._rate_map @ values.get("gyro", _NO_RATE),
            field=field,
            acceleration=acceleration,
        )


class CheckedUnit:
    """Inertial unit whose readings are checked, because another team wrote its driver.

    Readings with a value that is not finite or out of range, or with a time in the future, are counted and
    omitted. If only the rate is out of range, the rate of the reading is NaN. The value `field_range` is the
    largest accepted magnetic field per axis, T.
    """

    def __init__(self, unit: InertialUnit, field_range: float, clock: Clock) -> None:
        self._unit, self._field_range, self._clock = unit, field_range, clock
        self._out_of_range = self._not_finite = 0
        self._rejection = ""

    def configure(self) -> None:
        """Configure the unit. Raises DeviceError."""
        self._unit.configure()

    def poll(self) -> list[ImuReading]:
        """Return the plausible samples since the last call. Raises NotResponding."""
        return [checked for reading in self._unit.poll() if (checked := self._checked(reading)) is not None]

    def link(self) -> ImuLink:
        """Return the counters of the unit, plus the readings that this class has rejected."""
        link = self._unit.link()
        return link._replace(
            out_of_range=link.out_of_range + self._out_of_range,
            not_finite=link.not_finite + self._not_finite,
            rejection=self._rejection or link.rejection,
        )

    def close(self) -> None:
        """Stop the driver."""
        self._unit.close()

    def _checked(self, reading: ImuReading) -> ImuReading | None:
        """Return the reading, with NaN for an implausible rate, or None if another value is implausible."""
        values: dict[str, Any] = {name: np.asarray(getattr(reading, name), dtype=float) for name in _SHAPES}
        for name, value in values.items():
            if name != "rate" and not np.isfinite(value).all():
                self._not_finite += 1
                self._rejection = f"{name} = {value.tolist()}"
                return None
        norm, field, rate = float(np.linalg.norm(values["quaternion"])), values["field"], values["rate"]
        shapes = {name: value.shape for name, value in values.items() if value.shape != _SHAPES[name]}
        ahead_ns, problem = reading.time_ns - self._clock.now_ns(), ""
        if not ahead_ns <= _MOST_AHEAD_NS:  # NaN compares false
            problem = f"time_ns {ahead_ns / SECOND_NS:.6g} s ahead of the clock"
        elif shapes:
            problem = ", ".join(f"{name} of shape {shape}" for name, shape in shapes.items())
        elif abs(norm - 1.0) > _NORM_TOLERANCE:
            problem = f"quaternion of norm {norm:.3g}, not 1"
        elif np.abs(field).max() > self._field_range:
            problem = f"field {field.tolist()} T, beyond {self._field_range:g} T"
        wrong = bool(problem)
        if not np.isfinite(rate).all():
            values["rate"] = _NO_RATE
        elif not wrong and np.abs(rate).max() > LARGEST_RATE:
            problem = f"rate {rate.tolist()} rad/s, beyond {LARGEST_RATE:.3g} rad/s"
        if problem:
            self._out_of_range += 1
            self._rejection = problem
            values["rate"] = _NO_RATE
        return None if wrong else reading._replace(**values)


def level_attitude(field: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Return a resting body's quaternion (4,), testbed frame to body axes, from its field and specific force.

    The testbed's y axis points down, and the horizontal field points along its -z axis. In free fall the
    quaternion is the identity.
    """
    size = float(np.linalg.norm(acceleration))
    if size >= _FREE_FALL:
        y = -acceleration / size
        z = -(field - float(field @ y) * y)
        length = float(np.linalg.norm(z))
        if length > 0.0:
            z = z / length
            # The columns of the attitude matrix are the testbed's axes in body axes.
            return quaternion_of(np.column_stack((np.cross(y, z), y, z)))
    return np.array([0.0, 0.0, 0.0, 1.0])


def quaternion_of(matrix: FloatArray) -> FloatArray:
    """Return the quaternion (4,), scalar last and not negative, of an attitude matrix (3, 3)."""
    a = matrix
    squares = np.array(
        [
            1.0 + a[0, 0] - a[1, 1] - a[2, 2],
            1.0 - a[0, 0] + a[1, 1] - a[2, 2],
            1.0 - a[0, 0] - a[1, 1] + a[2, 2],
            1.0 + a[0, 0] + a[1, 1] + a[2, 2],
        ]
    )
    largest = int(squares.argmax())
    vector = (a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0])
    sums = (a[1, 2] + a[2, 1], a[2, 0] + a[0, 2], a[0, 1] + a[1, 0])
    q = np.empty(4)
    if largest == 3:
        q[:3], q[3] = vector, squares[3]
    else:
        q[:3] = [squares[largest] if axis == largest else sums[3 - axis - largest] for axis in range(3)]
        q[3] = vector[largest]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0.0 else -q


X_GYRO_LOW, X_ACCL_LOW, DATA_CNTR, MSC_CTRL, DEC_RATE, PROD_ID = 0x04, 0x10, 0x22, 0x60, 0x64, 0x72
PRODUCT = 16470
GYRO_STEP = math.radians(0.1) / 65536
"""Rate (rad/s) of one count of 32 bits."""
ACCELERATION_STEP = 1.25e-3 * 9.80665 / 65536
"""Specific force (m/s^2) of one count of 32 bits."""
SAMPLE_HZ = 2000.0
_TRIES = 3


class Adis16470:
    """An ADIS16470, read without waiting: `gyro` is in rad/s and `acceleration` in m/s^2."""

    SPEED_HZ, MODE = 1_000_000, 3

    def __init__(self, device: SpiDevice) -> None:
        """Check the product number.

        Raises NotResponding if no chip answers, and Refused if a different chip answers.
        """
        self._device = device
        (product,) = self._read([PROD_ID])
        if product in {0x0000, 0xFFFF}:
            raise NotResponding("ADIS16470", "the SPI line is silent: check power, wiring and chip select")
        if product != PRODUCT:
            raise Refused("ADIS16470", f"PROD_ID is {product}: is another chip connected?")
        self.decimation = 24

    @property
    def decimation(self) -> int:
        """Decimation d: d + 1 samples are averaged, so that the data rate is 2000 Hz / (d + 1)."""
        return self._read([DEC_RATE])[0]

    @decimation.setter
    def decimation(self, value: int) -> None:
        self._decimation = value
        halves = (DEC_RATE, value & 0xFF), (DEC_RATE + 1, value >> 8)
        self._device.transfer([bytes((0x80 | address, byte)) for address, byte in halves])

    @property
    def gyro(self) -> tuple[float, ...]:
        """Rotation rate (3,), rad/s, in sensor axes."""
        return self._vector(X_GYRO_LOW, GYRO_STEP)

    @property
    def acceleration(self) -> tuple[float, ...]:
        """Specific force (3,), m/s^2, in sensor axes."""
        return self._vector(X_ACCL_LOW, ACCELERATION_STEP)

    def _vector(self, first: int, step: float) -> tuple[float, ...]:
        for _ in range(_TRIES):
            registers = [DATA_CNTR, *range(first, first + 12, 2), DATA_CNTR, DEC_RATE]
            before, *halves, after, decimation = self._read(registers)
            if decimation != self._decimation:
                text = f"DEC_RATE is {decimation} instead of {self._decimation} (brown-out?)"
                raise NotResponding("ADIS16470", text)
            if before == after:
                words = [high << 16 | low for low, high in zip(halves[::2], halves[1::2], strict=True)]
                return tuple((word - (word >> 31 << 32)) * step for word in words)
        raise NotResponding("ADIS16470", f"the sample changed during each of {_TRIES} reads")

    def _read(self, registers: Sequence[int]) -> list[int]:
        """Return the values of 16-bit registers, each received in the frame after the register's request."""
        frames = self._device.transfer([bytes((register, 0)) for register in (*registers, 0)])
        return [int.from_bytes(frame, "big") for frame in frames[1:]]
