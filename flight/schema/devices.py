"""The configuration sections of the devices, and the registrations of their drivers.

A section contains the wiring of a device and the device's assumed properties. Values are in SI units, unless
their name contains another unit. The key `driver` of a section names the driver's registration, by a built-in
name (`DRIVERS`) or as `module:object` of a package outside this repository. The functions of the built-in
drivers are referenced by texts, because the schema imports neither drivers nor simulator.
"""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import numpy as np
from msgspec import Meta

from flight.schema.document import (
    Address,
    BaudRate,
    Bus,
    Channel,
    ConfigError,
    Document,
    DriverName,
    Estimator,
    NotNegative,
    Positive,
    Quaternion,
    Section,
    Share,
    Sign,
    SignedAxis,
    Vector,
    call_named,
    derived_struct,
    imported,
)
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import Rig
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.errors import UsageError
from knightcube.gnc.control.coil_map import LEAST_SPREAD, CoilMap, coil_field, missing_direction
from knightcube.vision.camera.lens import CameraKnowledge, CameraModel, Lens, Pinhole
from knightcube.vision.frame import LONGEST_LINE_TIME
from knightcube.vision.horizon_camera_job import polygon_mask
from knightcube.vision.startracker.survey import PSF_SIGMAS
from knightcube.vision.streaks.streak_result import LikelihoodSettings

_KNOWN = CameraKnowledge()
_MOST_HIDDEN = 0.5
"""Largest fraction of a horizon camera's image that the configured structure may cover."""
Polygon = Annotated[tuple[tuple[float, float], ...], Meta(min_length=3, max_length=64)]
Quantity = Literal["gyro", "magnetic", "acceleration"]
ExposureTime = Annotated[float, Meta(ge=1e-6, le=10.0, description="s")]


class UnitAccuracy(Section, frozen=True, kw_only=True):
    """Largest errors of the calibrated inertial unit; the true errors are assumed uniform within them.

    `gyro_scale` is the relative error of the scale factor of each gyro, `gyro_alignment` (rad) the
    misalignment of each gyro toward each other axis. `field_matrix` is the error of each element of the
    magnetometer's matrix, and `field_bias` (T) the bias of each axis.
    """

    gyro_scale: Annotated[float, Meta(ge=0.0, le=0.1)] = 3e-3
    gyro_alignment: Annotated[float, Meta(ge=0.0, le=0.1)] = 2e-3
    field_matrix: Annotated[float, Meta(ge=0.0, le=0.2)] = 0.01
    field_bias: NotNegative = 5e-7


class UnitCalibration(Section, frozen=True, kw_only=True):
    """The calibration of the inertial unit, whose errors the driver removes from each reading.

    The unit measures `gyro_matrix` times the rate, and `field_matrix` times the magnetic field plus
    `field_bias` (T). The rows of the matrices and the bias are in body axes.
    """

    gyro_matrix: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    field_matrix: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    field_bias: Vector = (0.0, 0.0, 0.0)


class UnitSection(Section, frozen=True, kw_only=True):
    """The configuration keys that all inertial units share; the section of each driver adds keys of its own.

    The coils are switched off if a reading would become older than `max_age` s before the next reading is
    used.
    """

    driver: DriverName = "vn100"
    rate_hz: Literal[1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200] = 40
    mounting: Quaternion = (0.0, 0.0, 0.0, 1.0)
    field_range: Positive = 6.0e-4
    max_age: Positive = 0.1
    angle_noise: Positive = 2.02e-3
    rate_noise: Positive = 1.01e-4
    calibration: UnitCalibration = UnitCalibration()
    accuracy: UnitAccuracy = UnitAccuracy()

    def has_gyro(self) -> bool:
        """Return whether the unit measures the rate."""
        return True


class InertialUnitSection(UnitSection, frozen=True, kw_only=True):
    """The inertial unit, a VN-100, and its serial line."""

    device: str = "/dev/knightcube-imu"
    baud_rate: BaudRate = 115200
    output: Literal["binary", "ascii"] = "binary"


class Sensor(Section, frozen=True, kw_only=True):
    """One of the sensors from which the driver `sensors` composes an inertial unit.

    The value `part` is `icm20948`, `lis3mdl`, `adis16470`, or `module:class` of a CircuitPython driver. The
    sensor has the I2C `address` on the bus `bus`, by default the bus of the coils, or it is the SPI device
    `spi`. The mapping `measures` gives, for each quantity that is read from the sensor, the sensor axes along
    the axes x, y and z of the unit, such as `gyro: [y, -x, z]`. The mapping `set` names attributes of the
    CircuitPython driver, for example a data rate, and the values that these attributes receive after each
    start. If the simulator has no emulator of the sensor, the value `emulator` names one as
    `module:function`.
    """

    part: Annotated[str, Meta(min_length=1, max_length=200)]
    address: Address | None = None
    bus: Bus | None = None
    spi: Annotated[str, Meta(pattern=r"^/[A-Za-z0-9_./:+-]+$", description="a device file")] | None = None
    measures: dict[Quantity, tuple[SignedAxis, SignedAxis, SignedAxis]]
    set: dict[str, int | float] | None = None
    emulator: Annotated[str, Meta(min_length=3, max_length=200)] | None = None


class SensorsSection(UnitSection, frozen=True, kw_only=True):
    """An inertial unit of separate gyro, magnetometer and accelerometer (driver `sensors`).

    The attitude follows from acceleration and magnetic field. Without an accelerometer the unit measures no
    attitude: a gyro with a magnetometer suffices only for a satellite in orbit. A magnetometer alone is a
    unit without a gyro: the state estimate is then based on star attitudes, streak rates, the magnetic field
    and the dynamic model.
    """

    sensors: Annotated[tuple[Sensor, ...], Meta(min_length=1, max_length=4)]

    def has_gyro(self) -> bool:
        """Return whether a sensor measures the rate."""
        return any("gyro" in sensor.measures for sensor in self.sensors)


class MagnetometerSection(SensorsSection, frozen=True, kw_only=True):
    """A magnetometer that replaces a silent inertial unit, or is the only unit if `inertial_unit` is none."""

    driver: DriverName = "sensors"


class Winding(Section, frozen=True, kw_only=True):
    """One coil of a satellite, which is a torque rod or an air coil, with its H-bridge.

    A positive current makes a dipole moment along `axis`, which may have any length. The dipole moment per
    ampere is `dipole_per_ampere` (m^2), or `turns` times `area` (m^2) of an air coil. On the testbed, the
    values of the coils are in the section `plant`. The value `current_limit` (A) replaces the limit in the
    section `coils`. The values `channels` are the PWM channels of the inputs A and B of the H-bridge; by
    default, the coils use the channels 0 and 1, 2 and 3, and so on. The value `sign` is -1 for a coil whose
    leads are swapped. The `position` (m, body axes) of the coil's centre relative to the inertial unit gives
    the field that `knightcube bringup` expects at the magnetometer.
    """

    axis: Annotated[Vector, Meta(description="direction of the dipole in body axes, three numbers")]
    dipole_per_ampere: Positive | None = None
    turns: Annotated[int, Meta(gt=0, le=100_000)] | None = None
    area: Positive | None = None
    resistance: Annotated[Positive, Meta(description="resistance of the winding, ohm")]
    current_limit: Annotated[float, Meta(gt=0.0, le=1.0, description="A")] | None = None
    channels: tuple[Channel, Channel] | None = None
    sign: Sign = 1
    position: Vector | None = None

    def direction(self) -> FloatArray:
        """Return the unit vector (3,) along the dipole moment, body axes."""
        return np.asarray(np.array(self.axis) / np.linalg.norm(self.axis))

    def pins(self, index: int) -> tuple[int, int]:
        """Return the PWM channels of the coil with this index in `Coils.windings`."""
        return self.channels or (2 * index, 2 * index + 1)

    def strength(self) -> float:
        """Return the dipole moment per ampere, m^2. Raises ConfigError if it is missing or given twice."""
        if (self.turns is None) != (self.area is None):
            raise ConfigError("turns" if self.area is None else "area", "needs both `turns` and `area`")
        given = self.dipole_per_ampere
        if self.turns is not None and self.area is not None:
            if given is not None:
                raise ConfigError("dipole_per_ampere", "is given: omit `turns` and `area`")
            return self.turns * self.area
        if given is None:
            raise ConfigError("dipole_per_ampere", "is missing: give the dipole, or `turns` and `area`")
        return given


class Coils(Section, frozen=True, kw_only=True):
    """The PWM chip, the H-bridges and the coils. The value `bus` is the number or device file of the I2C bus.

    The driver `drv8830` uses one DRV8830 chip for each coil; the chips have consecutive I2C addresses, of
    which `address` is the first.

    The list `windings` has one entry per coil. A satellite has two to six coils. If the coils lie in a plane,
    the flight application treats the axis normal to the plane like the axis of a broken coil (`slots`). A
    dipole moment along the magnetic field, which produces no torque, is added so that the missing coil needs
    no current. More than three coils share a dipole moment so that their total heat is minimal.
    """

    driver: DriverName = "pca9685"
    bus: Bus = 1
    address: Address = 0x40
    windings: Annotated[tuple[Winding, ...], Meta(min_length=1, max_length=64)]
    supply_voltage: Annotated[Positive, Meta(description="voltage across a coil at full duty, V")]
    current_limit: Annotated[Positive, Meta(description="largest current of a coil, A")]
    stale_after: Annotated[float, Meta(gt=0.0, le=0.4, description="s")] = 0.25

    @property
    def absent(self) -> frozenset[int]:
        """Indices of the entries of `slots` that have no coil."""
        return frozenset(range(len(self.windings), len(self.slots)))

    @property
    def slots(self) -> tuple[Winding, ...]:
        """The coils in the order that the flight application uses; the last coil may be fictitious.

        If the coils lie in a plane, a fictitious coil along the normal of the plane is appended. The
        fictitious coil has two unused PWM channels. The dipole moment of the fictitious coil is half the
        weakest coil's moment, so that plans use it little.
        """
        axes = np.array([coil.direction() for coil in self.windings]).T
        if np.linalg.matrix_rank(axes, LEAST_SPREAD) == 3:
            return self.windings
        normal = missing_direction(axes)
        if normal is None or len(self.windings) == 2:
            normal = np.cross(axes[:, 0], axes[:, 1])
        x, y, z = normal.tolist()
        used = {channel for k, coil in enumerate(self.windings) for channel in coil.pins(k)}
        a, b = [channel for channel in range(16) if channel not in used][:2]
        weaker = min(
            self.windings, key=lambda one: one.strength() * (one.current_limit or self.current_limit)
        )
        half = 0.5 * weaker.strength()
        fictitious = Winding(
            axis=(x, y, z),
            dipole_per_ampere=half,
            resistance=weaker.resistance,
            current_limit=weaker.current_limit,
            channels=(a, b),
        )
        return (*self.windings, fictitious)

    @property
    def channels(self) -> tuple[tuple[int, int], ...]:
        """PWM channels of the bridge inputs A and B of each coil."""
        return tuple(coil.pins(k) for k, coil in enumerate(self.slots))

    @property
    def signs(self) -> tuple[int, ...]:
        """+1 for each coil, or -1 for a coil whose leads are swapped."""
        return tuple(coil.sign for coil in self.slots)

    @property
    def resistance(self) -> tuple[float, ...]:
        """Resistance of each coil, ohm."""
        return tuple(coil.resistance for coil in self.slots)

    @property
    def limits(self) -> tuple[float, ...]:
        """Largest current of each coil, A."""
        return tuple(coil.current_limit or self.current_limit for coil in self.slots)

    def map(self) -> CoilMap:
        """Return the map from dipole moments to currents.

        Raises ConfigError if the dipole moment per ampere of a coil is missing or given twice, and UsageError
        if the coils cannot produce a dipole moment in every direction.
        """
        strength = np.array([coil.strength() for coil in self.slots])
        dipoles = np.array([coil.direction() for coil in self.slots]).T * strength
        return CoilMap(dipoles, np.array(self.limits), np.array(self.resistance))


def coil_fields(config: Any) -> FloatArray | None:
    """Return each coil's field (n, 3), T/A, at the inertial unit, or None if a coil's position is unknown."""
    plant, fields = getattr(config, "plant", None), []  # the testbed's plant describes all coils
    for coil in config.coils.windings:
        if coil.position is None or not any(coil.position):
            return None
        area = coil.area if plant is None else plant.coil_area
        strength = coil.strength() if plant is None else plant.coil_turns * area
        fields.append(coil_field(strength * coil.direction(), -np.array(coil.position), area))
    return np.array(fields)


class PowerMonitorSection(Section, frozen=True, kw_only=True):
    """An INA219, which measures the voltage of a supply, and its current by the shunt resistor `shunt` (ohm).

    The chip is on the I2C bus `bus`, by default the bus of the coils. The chip measures currents up to
    `maximum_current` (A) in both directions.
    """

    driver: DriverName = "ina219"
    bus: Bus | None = None
    address: Address = 0x45
    shunt: Positive = 0.1
    maximum_current: Positive = 0.8


class Battery(Section, frozen=True, kw_only=True):
    """The battery: `cells` lithium-ion cells in series, with a capacity of `capacity` (A h).

    The internal resistance of all cells together is `resistance` (ohm). The open-circuit voltage of a cell
    (V) is given by `open_circuit` for states of charge at equal intervals from 0 to 1, and is interpolated
    linearly.
    """

    capacity: Annotated[float, Meta(gt=0.0, le=1000.0), Meta(description="capacity of the battery, A h")]
    cells: Annotated[int, Meta(ge=1, le=3)] = 2
    resistance: Annotated[float, Meta(gt=0.0, le=10.0, description="ohm")] = 0.1
    open_circuit: Annotated[
        tuple[Annotated[float, Meta(gt=1.0, lt=5.0)], ...], Meta(min_length=2, max_length=101)
    ] = (3.0, 3.45, 3.55, 3.6, 3.65, 3.7, 3.78, 3.87, 3.96, 4.06, 4.18)

    def voltage(self, charge: float) -> float:
        """Return the open-circuit voltage (V) of the battery at a state of charge from 0 to 1."""
        known = self.open_circuit
        place = min(max(charge, 0.0), 1.0) * (len(known) - 1)
        index = min(int(place), len(known) - 2)
        return self.cells * (known[index] + (place - index) * (known[index + 1] - known[index]))

    def charge(self, voltage: float) -> float:
        """Return the state of charge from 0 to 1 at an open-circuit voltage (V) of the battery."""
        steps = np.linspace(0.0, 1.0, len(self.open_circuit))
        return float(np.interp(voltage / self.cells, self.open_circuit, steps))


class LowBattery(Section, frozen=True, kw_only=True):
    """The states of charge below which the flight application sheds loads.

    Below `low`, the coils carry at most the fraction `coil_share` of their current limits. Below `very_low`,
    the star camera takes at most one frame every `camera_period` s. Below `critical`, the mode changes to
    safe. A load is switched on again when the state of charge exceeds its limit by `hysteresis`. When the
    state of charge exceeds `critical` by `hysteresis`, the satellite leaves the mode SAFE without a command.
    """

    low: Share = 0.4
    very_low: Share = 0.3
    critical: Share = 0.2
    hysteresis: Annotated[float, Meta(ge=0.01, le=0.5)] = 0.1
    coil_share: Share = 0.3
    camera_period: Annotated[float, Meta(gt=0.0, le=3600.0, description="s")] = 60.0


class Power(Section, frozen=True, kw_only=True):
    """The power system: a battery on an unregulated bus, which solar panels charge.

    The INA219 `battery_monitor` measures the current out of the battery, which is negative while the battery
    is charged. The INA219 `bus_monitor` measures the current of all loads; if it is `null`, a stuck
    `battery_monitor` is not detected.
    """

    battery: Battery
    battery_monitor: PowerMonitorSection = PowerMonitorSection(address=0x41, maximum_current=2.0)
    bus_monitor: PowerMonitorSection | None = PowerMonitorSection(address=0x44, maximum_current=2.0)
    low_battery: LowBattery = LowBattery()

    def monitors(self) -> dict[str, PowerMonitorSection]:
        """Return the sections of the current monitors by their dotted keys, the battery's monitor first."""
        found = {"power.battery_monitor": self.battery_monitor}
        if self.bus_monitor is not None:
            found["power.bus_monitor"] = self.bus_monitor
        return found


class CameraLens(Section, frozen=True, kw_only=True):
    """The lens parameters that `knightcube calibrate` reports.

    The focal length `focal_length` is in px, `centre` is the pixel (x, y) on the optical axis, and `k1` and
    `k2` are the coefficients of radial distortion. The values `aspect` and `shear` describe pixels that are
    not square, and `p1` and `p2` are the coefficients of tangential distortion.
    """

    focal_length: Annotated[Positive, Meta(description="focal length, px")]
    centre: Annotated[tuple[float, float], Meta(description="pixel (x, y) on the optical axis")]
    k1: float = 0.0
    k2: float = 0.0
    aspect: float = 0.0
    shear: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


class CameraAccuracy(Section, frozen=True, kw_only=True):
    """Standard deviations of the camera model, which affect the reported uncertainty of rates from streaks.

    The error `focal_length` is relative, `centre` is in px along x and y, `distortion` is the displacement of
    an image corner relative to its distance from the centre, and `line_time` is in s. A zero means that the
    value is exact, as in an emulated camera. If `accuracy.line_time` is omitted, a `line_time` that the
    camera section states is considered exact. The angle `mounting_deg` is the largest rotation of the camera
    about each body axis from its `mounting`; the true rotation is assumed to be uniform within it.
    """

    focal_length: NotNegative = _KNOWN.focal_length
    centre: NotNegative = _KNOWN.centre
    distortion: NotNegative = _KNOWN.distortion
    line_time: NotNegative | None = _KNOWN.line_time
    mounting_deg: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.1


class StarTrackerSection(Section, frozen=True, kw_only=True):
    """The star tracker.

    The value `index` is the file of the sky index; by default the index in the cache folder is used. The
    value `scale_error` is the largest relative error of the focal length, or 0 for a calibrated camera. The
    value `velocity` is the velocity relative to the Sun (m/s, in the reference axes of the attitude) for
    which stellar aberration is corrected; it is omitted for a testbed.
    """

    index: str | None = None
    scale_error: Annotated[float, Meta(ge=0.0, lt=0.5)] = 0.0
    velocity: Vector | None = None


class ObjectTracking(Section, frozen=True, kw_only=True):
    """Search for moving objects among the stars of each frame, and tracking of the detected objects.

    Detections fainter than the V magnitude `faintest` are ignored. A track begins after `needed` detections
    in `within` frames, and ends after `coast` s without a detection. If there is no `star_tracker`, or if its
    sky index is missing or damaged, objects are detected by the common motion of the stars from frame to
    frame; `faintest` then has no effect, because magnitudes are unknown.
    """

    faintest: Annotated[float, Meta(ge=-5.0, le=8.0)] = 7.0
    needed: Annotated[int, Meta(ge=3, le=16)] = 4
    within: Annotated[int, Meta(ge=3, le=32)] = 6
    coast: Positive = 15.0


# fmt: off
PixelName = Literal[
    "GREY", "Y10", "Y12", "Y14", "Y16", "Y16-BE", "Y10P", "Y12P", "Y10B", "YUYV", "UYVY", "MJPG",
    "BA81", "GBRG", "GRBG", "RGGB", "BG10", "GB10", "BA10", "RG10", "BG12", "GB12", "BA12", "RG12",
    "BYR2", "GB16", "GR16", "RG16", "pBAA", "pGAA", "pgAA", "pRAA", "pBCC", "pGCC", "pgCC", "pRCC",
]
# fmt: on
"""Names of the pixel formats of V4L2 that `hal.drivers.camera` reads."""


class V4l2Device(Section, frozen=True, kw_only=True, tag_field="driver", tag="v4l2"):
    """A Video for Linux camera (`hal.drivers.v4l2_camera`).

    The value `gain` is in the camera's own steps, and `stamp_delay` is in s. The pixel format is the name
    that `v4l2-ctl --list-formats` prints. Bayer mosaics and Motion JPEG are converted to grey images.
    """

    path: Annotated[str, Meta(min_length=1)] = "/dev/knightcube-camera"
    pixel_format: PixelName = "GREY"
    gain: int | None = None
    stamp: Literal["told", "start", "end"] = "told"
    stamp_delay: Annotated[float, Meta(ge=0.0, le=1.0, description="s")] = 0.0


class AravisDevice(Section, frozen=True, kw_only=True, tag_field="driver", tag="aravis"):
    """A GenICam camera (`hal.drivers.aravis_camera`), named as the tool `arv-tool-0.8` lists it."""

    name: Annotated[str, Meta(min_length=1)]
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono12"
    gain: float | None = None


FAST = 0.02
"""Body rate (rad/s) at which the scale and alignment errors of the gyro add 0.01 deg to the attitude error in
10 s."""


class Camera(Section, frozen=True, kw_only=True):
    """The star camera: properties that are needed to process its frames, and the real camera `device`.

    The exposure time of a frame in which stars form streaks depends on the body's rate, within the range
    `streak_exposure` (s). Frames without streaks, and all frames if `streak_exposure` is omitted, are exposed
    for `exposure` s. A frame is taken every `period` s or, if `fine_period` is given, every `fine_period` s
    while the attitude is fine and the body rotates slower than 0.02 rad/s. If `max_rate` is given, no
    exposure begins while the body rotates faster than `max_rate` rad/s. A frame counts as late `late_after` s
    after the end of its exposure, and vision counts as slow if a frame takes longer than `vision_slow_after`
    s. The newest `keep_frames` frames are kept in the folder `frames` of the run.

    The value `gain` is in electrons per count, `saturation` in counts (by default the highest count of
    `bits`), `psf_sigma` in px, and `line_time` in s per row. The value `read_noise`, in electrons, is that of
    the simulated camera.

    With `learn_lens`, the star tracker estimates lens parameters, line time and point spread from its solved
    frames, and the next boot continues with the estimates. Nothing is estimated for a camera that is exact
    according to `accuracy`.
    """

    device: V4l2Device | AravisDevice | None = None

    columns: Annotated[int, Meta(ge=64, le=8192, description="px")] = 1024
    rows: Annotated[int, Meta(ge=64, le=8192, description="px")] = 1024
    field_of_view_deg: Annotated[float, Meta(gt=1.0, lt=120.0)] = 20.0
    lens: CameraLens | None = None
    accuracy: CameraAccuracy = CameraAccuracy()
    exposure: ExposureTime = 1.0
    streak_exposure: tuple[ExposureTime, ExposureTime] | None = None
    period: Positive = 5.0
    fine_period: Positive | None = None
    bits: Annotated[int, Meta(ge=8, le=16)] = 16
    gain: Positive = 1.0
    read_noise: Positive = 10.0
    saturation: Positive | None = None
    psf_sigma: Annotated[float, Meta(ge=PSF_SIGMAS[0], le=PSF_SIGMAS[1], description="px")] = 1.0
    line_time: Annotated[float, Meta(ge=0.0, le=LONGEST_LINE_TIME, description="s per row")] | None = None
    estimator: Estimator = "likelihood"
    star_tracker: StarTrackerSection | None = None
    objects: ObjectTracking | None = None
    endpoint_bias: float | None = None
    mounting: Quaternion = (0.0, 0.0, 0.0, 1.0)
    max_rate: Positive | None = None
    max_age: Positive = 12.0
    late_after: Positive = 1.0
    vision_slow_after: Positive = 1.0
    keep_frames: Annotated[int, Meta(ge=0, le=1000)] = 0
    learn_lens: bool = True


class Gps(Section, frozen=True, kw_only=True):
    """The GPS receiver on its own serial line, a u-blox receiver or (driver `nmea`) any NMEA 0183 receiver.

    The receiver reports a fix every `period` s; the position is unknown after `max_age` s without a fix.
    """

    driver: DriverName = "ublox"
    device: Annotated[str, Meta(min_length=1)] = "/dev/knightcube-gps"
    baud_rate: BaudRate = 115200
    period: Annotated[float, Meta(ge=0.1, le=60.0, description="s")] = 1.0
    max_age: Positive = 60.0


class SolarString(Section, frozen=True, kw_only=True):
    """A string of solar cells, and the ADC input that measures its current.

    The string's outward unit vector `normal` is in body axes; its current is `peak` A at perpendicular
    sunlight. An amplifier of `volt_per_ampere` feeds the input `channel` of the ADS1115 chip at the I2C
    address `address`.
    """

    normal: Annotated[Vector, Meta(description="outward normal of the cells in body axes, three numbers")]
    address: Address = 0x48
    channel: Annotated[int, Meta(ge=0, le=3), Meta(description="input of the ADC, 0 to 3")]
    peak: Positive = 0.5
    volt_per_ampere: Positive = 2.0


class SolarStringsSection(Section, frozen=True, kw_only=True):
    """The solar cell strings, which are measured every `period` s; a reading is stale after `max_age` s.

    The converters are on the I2C bus `bus`, by default the bus of the coils.
    """

    driver: DriverName = "ads1115"
    bus: Bus | None = None
    strings: Annotated[tuple[SolarString, ...], Meta(min_length=4, max_length=16)]
    period: Annotated[float, Meta(ge=0.04, le=60.0, description="s")] = 0.5
    max_age: Positive = 2.0


class WideCamera(Section, frozen=True, kw_only=True):
    """A wide-angle camera, which measures the directions of the Sun and of the horizon.

    A logarithmic `response` maps `decades` decades of intensity to the counts above `pedestal`; all
    wide-angle cameras must have the same response. The polygons `structure` and the image file
    `structure_file` show where the spacecraft itself is in view. Each polygon is a list of corners (x, y) in
    px. In `structure_file`, a PGM or PNG image of the camera's size, pixels above 0 show the spacecraft. All
    cameras are triggered together, with the shortest `period` of the cameras or, while the attitude is known
    to 0.05 deg, with the shortest `fine_period`. With `sun: false`, the images of a camera are not searched
    for the Sun. The angle `lens_error_deg` is the residual error of the calibrated lens. The angle
    `mounting_deg` is the largest rotation of a camera about each body axis from its `mounting`; the true
    rotation is assumed to be uniform within it.
    """

    device: V4l2Device | AravisDevice | None = None
    columns: Annotated[int, Meta(ge=64, le=2048, description="px")] = 384
    rows: Annotated[int, Meta(ge=64, le=2048, description="px")] = 384
    field_of_view_deg: Annotated[float, Meta(gt=10.0, lt=150.0)] = 67.0
    lens: CameraLens | None = None
    response: Literal["logarithmic", "linear"] = "logarithmic"
    decades: Annotated[float, Meta(ge=1.0, le=12.0)] = 6.0
    bits: Annotated[int, Meta(ge=8, le=16)] = 8
    pedestal: Annotated[float, Meta(ge=0.0, le=200.0)] = 8.0
    exposure: Annotated[float, Meta(ge=1e-6, le=1.0, description="s")] = 0.005
    period: Annotated[float, Meta(ge=0.5, description="s")] = 5.0
    fine_period: Annotated[float, Meta(ge=0.5, description="s")] = 60.0
    sun: bool = True
    max_age: Positive = 30.0
    lens_error_deg: NotNegative = 0.02
    mounting_deg: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.1
    mounting: Quaternion = (0.0, 0.0, 0.0, 1.0)
    structure: Annotated[tuple[Polygon, ...], Meta(max_length=32)] = ()
    structure_file: Annotated[str, Meta(min_length=1)] | None = None

    def counts_per_decade(self) -> float:
        """Return the increase of a logarithmic camera's counts for a tenfold increase of the intensity."""
        return float((1 << self.bits) - 1 - self.pedestal) / self.decades


def camera_model(camera: Camera | WideCamera) -> CameraModel:
    """Return the calibrated lens of a camera, or else a pinhole with the camera's field of view.

    Raises LensError for lens parameters outside their ranges.
    """
    if camera.lens is None:
        return Pinhole.from_field_of_view(camera.columns, camera.rows, math.radians(camera.field_of_view_deg))
    return lens_model(camera.lens, camera.columns, camera.rows)


def lens_model(lens: CameraLens, columns: int, rows: int) -> Lens:
    """Return a lens in front of a detector of `columns` x `rows` pixels.

    Raises LensError for lens parameters outside their ranges.
    """
    shape = lens.aspect, lens.shear, lens.p1, lens.p2
    return Lens(columns, rows, lens.focal_length, lens.centre, lens.k1, lens.k2, *shape)


def structure_mask(camera: WideCamera, *, of_file: bool = True) -> BoolArray:
    """Return the mask (rows, columns) of the pixels that show the spacecraft.

    The image file is ignored if `of_file` is false. Raises UsageError if the file is not an image of the
    camera's size, or if more than half of the image is hidden.
    """
    mask = polygon_mask(camera.rows, camera.columns, camera.structure)
    if of_file and camera.structure_file is not None:
        from knightcube.vision.camera.images import read_image, read_raw  # noqa: PLC0415 - only with a file

        path = Path(camera.structure_file)
        # Pillow is not installed on a flight computer, but a PGM file can be read without it.
        is_pgm = path.suffix == ".pgm"
        pixels = read_raw(path, camera.columns, camera.rows, 8, None) if is_pgm else read_image(path)
        if pixels.shape != mask.shape:
            sizes = [f"{shape[1]} x {shape[0]}" for shape in (pixels.shape, mask.shape)]
            raise UsageError(f"{camera.structure_file}: {sizes[0]} pixels, but the camera has {sizes[1]}")
        mask |= pixels > 0
    if np.mean(mask) > _MOST_HIDDEN:
        share = 100.0 * float(np.mean(mask))
        raise UsageError(f"structure covers {share:.0f} % of the image: at most half may be hidden")
    return mask


def stated_accuracy(camera: Camera) -> CameraKnowledge:
    """Return the standard deviations of the camera parameters, as stated in the configuration."""
    accuracy = camera.accuracy
    return CameraKnowledge(accuracy.focal_length, accuracy.centre, accuracy.distortion, accuracy.line_time)


def likelihood_settings(camera: Camera) -> LikelihoodSettings:
    """Return the settings of the streak fit for the camera's frames."""
    return LikelihoodSettings(
        gain=camera.gain,
        saturation=camera.saturation,
        psf_sigma=camera.psf_sigma,
        line_time=camera.line_time,
        knowledge=stated_accuracy(camera),
    )


def nothing(_: Any) -> tuple[()]:
    """Return an empty tuple, for any section."""
    return ()


def _own_file(section: Any) -> Sequence[str]:
    """Return the device file in the key `device` of a section, if it has this key."""
    device = getattr(section, "device", None)
    return (device,) if isinstance(device, str) else ()


def later(named: str) -> Callable[..., Any]:
    """Return a function that imports the function `module:function` at its first call, and calls it.

    An emulator is registered in this way, so that a flight computer does not load the simulator.
    """
    module, _, function = named.partition(":")

    def call(*arguments: Any) -> Any:
        return getattr(importlib.import_module(module), function)(*arguments)

    return call


@dataclass(frozen=True, slots=True)
class Driver:
    """Registration of a device driver.

    Attributes:
        kind: section of the configuration, such as `inertial_unit`; drivers of the kind `camera` also apply
            to `wide_cameras`.
        section: type of the section, which adds the driver's own keys to those of the kind's base section.
        open: function that takes the rig and the section, and returns the driver (`hal.interfaces.devices`).
            A driver of coils must be passive until its method `start` is called.
        probe: function that takes a rig and the section, and returns the device's answer to a query as text.
            The query does not change the state of the device. Raises DeviceError if the device does not
            answer. Only the driver `sensors` starts its sensors; `knightcube check` locks the bus of the
            coils for this.
        emulate: function that takes a `sim_hal.emulation.Emulation` and the section, connects an emulated
            device to the emulated wires, and returns the device. A camera driver needs no function `emulate`,
            because the simulator emulates the cameras of all drivers. Any other device without this function
            can only be used on hardware.
        files: function that returns the device files that the section names, which a service on a board may
            open; by default the file in the key `device`, if the section has this key.
        check: function that raises OutOfRange for a section that the driver does not accept.
        off: for coils, function that returns the I2C writes (address, register, value) that switch all coils
            off in any state of the chips; the guardian executes these writes if the flight process fails.
        addresses: lowest and highest I2C address to which the address pins of the chip can be set.
    """

    kind: str
    section: type[Any]
    open: Callable[[Rig, Any], Any]
    probe: Callable[[Rig, Any], str]
    emulate: Callable[[Any, Any], Any] | None = None
    files: Callable[[Any], Sequence[str]] = _own_file
    check: Callable[[Any], object] = nothing
    off: Callable[[Any], Sequence[tuple[int, int, int]]] = nothing
    addresses: tuple[int, int] = (0, 0x7F)


def _ours(kind: str, section: type[Any], name: str, *more: str, **values: Any) -> Driver:
    """Return the registry entry of a built-in driver, whose functions are in `flight.app.devices`.

    The words `more` name the functions besides `open`, `probe` and `files`; `values` are other attributes of
    the entry.
    """
    words = ("open", "probe", "files", *more)
    functions: dict[str, Any] = {word: later(f"flight.app.devices:{word}_{name}") for word in words}
    emulate = None if kind == "camera" else later(f"sim_hal.emulation:emulate_{name}")
    return Driver(kind, section, emulate=emulate, **functions, **values)


VN100 = _ours("inertial_unit", InertialUnitSection, "vn100", "check")
SENSORS = _ours("inertial_unit", SensorsSection, "sensors")
MAGNETOMETER = _ours("magnetometer", MagnetometerSection, "sensors")
PCA9685 = _ours("coils", Coils, "pca9685", "check", "off", addresses=(0x40, 0x77))
DRV8830 = _ours("coils", Coils, "drv8830", "check", "off", addresses=(0x60, 0x68))
INA219 = _ours("power_monitor", PowerMonitorSection, "ina219", "check", addresses=(0x40, 0x4F))
UBLOX = _ours("gps", Gps, "ublox")
NMEA = _ours("gps", Gps, "nmea")
ADS1115 = _ours("solar_strings", SolarStringsSection, "ads1115", addresses=(0x48, 0x4B))
V4L2 = _ours("camera", V4l2Device, "v4l2")
ARAVIS = _ours("camera", AravisDevice, "aravis")

DRIVERS: Mapping[str, Mapping[str, str]] = {
    "inertial_unit": {"vn100": f"{__name__}:VN100", "sensors": f"{__name__}:SENSORS"},
    "magnetometer": {"sensors": f"{__name__}:MAGNETOMETER"},
    "coils": {"pca9685": f"{__name__}:PCA9685", "drv8830": f"{__name__}:DRV8830"},
    "power_monitor": {"ina219": f"{__name__}:INA219"},
    "gps": {"ublox": f"{__name__}:UBLOX", "nmea": f"{__name__}:NMEA"},
    "solar_strings": {"ads1115": f"{__name__}:ADS1115"},
    "camera": {"v4l2": f"{__name__}:V4L2", "aravis": f"{__name__}:ARAVIS"},
}
"""Driver registrations (`module:object`) for each section, by built-in name; the first name is the
default."""


SENSOR_PARTS: Mapping[str, str] = {
    "icm20948": "adafruit_icm20x:ICM20948",
    "lis3mdl": "adafruit_lis3mdl:LIS3MDL",
    "adis16470": "hal.drivers.sensor_unit:Adis16470",
}
"""Classes (`module:class`) of the sensors with an emulator, by name."""


def axis_matrix(names: Sequence[str]) -> FloatArray:
    """Return the matrix (3, 3) from sensor to unit axes, for the signed sensor axes along x, y and z."""
    return np.array([[(1.0, -1.0)[name[0] == "-"] * (name[-1] == axis) for axis in "xyz"] for name in names])


def fitted_devices(config: Any) -> list[tuple[str, str, Any]]:
    """Return the dotted key, the kind and the section of each configured device except the cameras."""
    found = [(kind, kind, getattr(config, kind)) for kind in DRIVERS if kind != "camera"]
    if config.power is not None:
        found += [(key, "power_monitor", one) for key, one in config.power.monitors().items()]
    return [row for row in found if row[2] is not None]


def driver_of(kind: str, section: Any, key: str = "") -> Driver:
    """Return the registration of the driver that a section names. Raises ConfigError if there is none.

    A flight computer imports only permitted objects (`flight.schema.document.imported`).
    """
    named = getattr(section, "driver", None) or section.__struct_config__.tag
    return _named(kind, named, key or f"{kind}.driver")


def _named(kind: str, named: str, key: str) -> Driver:
    driver = imported(key, named, DRIVERS[kind], os.environ)
    if not isinstance(driver, Driver) or driver.kind != kind:
        raise ConfigError(
            key, f"is {named!r}: this object is not a Driver (flight.schema.devices) of `{kind}`"
        )
    return driver if named in DRIVERS[kind] else _explained(driver, named, key)


def _explained(driver: Driver, named: str, key: str) -> Driver:
    """Return a driver of another package, with functions that report mistakes in its code (`call_named`)."""

    def explained(word: str) -> Any:
        function, device = getattr(driver, word), word in {"open", "probe", "off"}

        def run(*arguments: Any) -> Any:
            made = call_named(key, named, function, *arguments, device=device)
            if made is None and word in {"open", "emulate"}:
                problem = f"is {named!r}, whose function `{word}` returns None: return the device"
                raise NotResponding(f"`{key}`", problem) if device else ConfigError(key, problem)
            return made

        return None if function is None else run

    functions: dict[str, Any] = {
        word: explained(word) for word in ("open", "probe", "emulate", "files", "check", "off")
    }
    return replace(driver, **functions)


def with_drivers(shape: type[Any], document: Document) -> type[Any]:
    """Return a type of configuration with the sections that the drivers registered. Raises ConfigError."""
    fields: list[tuple[str, Any]] = []
    others: dict[str, type[Any]] = {}
    for kind, dotted, section in _driven(document.values):
        named, place = section["driver"], f"{dotted}.driver"
        if kind != "camera" and named != next(iter(DRIVERS[kind])):
            fields.append((kind, _named(kind, named, place).section))
        elif named not in DRIVERS[kind]:
            others[named] = _named(kind, named, place).section
    if others:
        fields += _camera_fields(tuple(sorted(others.items())))
    return derived_struct(cast(Hashable, shape), tuple(fields)) if fields else shape


def drop_inherited(document: Document) -> None:
    """Remove keys that an extended file gives for another driver, because they do not apply.

    A key is removed if the section of the named driver does not have it, and if its file is extended by the
    file that names the driver. Raises ConfigError for an unknown driver.
    """
    for kind, dotted, section in _driven(document.values):
        place = f"{dotted}.driver"
        try:
            shape = _named(kind, section["driver"], place).section
        except ConfigError as error:
            raise document.error(error.where, error.problem) from error
        known = {field.encode_name for field in msgspec.structs.fields(shape)}
        for key in set(section) - known:
            if document.depth(f"{dotted}.{key}") > document.depth(place):
                del section[key]


def _driven(values: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Return the kind, the dotted name and the values of each section that names a driver."""
    found = [(kind, kind, values.get(kind)) for kind in DRIVERS if kind != "camera"]
    found += [("camera", f"{key}.device", camera.get("device")) for key, camera in _cameras(values)]
    return [
        (kind, dotted, section)
        for kind, dotted, section in found
        if isinstance(section, dict) and isinstance(section.get("driver"), str)
    ]


def _cameras(values: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    wide = values.get("wide_cameras")
    named = [("camera", values.get("camera"))]
    named += [(f"wide_cameras[{n}]", one) for n, one in enumerate(wide if isinstance(wide, list) else ())]
    return [(key, camera) for key, camera in named if isinstance(camera, dict)]


@lru_cache(maxsize=32)
def _camera_fields(others: tuple[tuple[str, type[Any]], ...]) -> list[tuple[str, Any]]:
    """Return the fields of the cameras, whose `device` may also have one of the types `others`, by tag."""
    device: Any = V4l2Device | AravisDevice | None
    for named, section in others:
        name, bases = section.__name__, (section,)
        device |= msgspec.defstruct(
            name, [], bases=bases, tag_field="driver", tag=named, frozen=True, kw_only=True
        )
    camera, wide = (derived_struct(kind, (("device", device),)) for kind in (Camera, WideCamera))
    return [("camera", camera | None), ("wide_cameras", tuple[wide, ...])]  # type: ignore[valid-type]
