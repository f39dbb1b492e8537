"""The `simulation` section of a configuration: the true properties of the world.

The true value of a constant that the `simulation` section omits is that of the flight configuration. A
constant in the section `simulation` makes the world differ from the flight software's model. All values are
in SI units unless the name of the key states another unit. In `free_body`, each disturbance is given as a
multiple of its worst case, and zero switches the disturbance off.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from flight.schema.devices import Battery, CameraLens, Winding
from flight.schema.document import ConfigError, Inertia, NotNegative, Positive, Quaternion, Section
from hal.interfaces.devices import MOST_COILS

Vector = tuple[float, float, float]
PerCoil = Annotated[tuple[float, ...], Meta(min_length=1, max_length=MOST_COILS)]
Multiple = Annotated[float, Meta(ge=0.0, le=1e4)]
Delay = Annotated[float, Meta(ge=0.0, le=3600.0, description="s")]
Angle = Annotated[float, Meta(ge=-360.0, le=360.0, description="deg")]
ExclusionAngle = Annotated[float, Meta(ge=0.0, le=90.0, description="deg")]
YEARS = 2001, 2043
"""First and last year of a simulation; `sim_hal.worlds.orbit` has the magnetic field of 2000 to 2045."""


def utc_seconds(utc: str) -> float:
    """Return the time since 1970 (s) of an ISO 8601 time, which is UTC unless the text has a time zone.

    Raises ConfigError if the text is not an ISO 8601 time.
    """
    try:
        found = datetime.fromisoformat(utc)
    except ValueError as error:
        raise ConfigError("simulation.utc", f"is {utc!r}: give a UTC such as 2026-03-20T12:00:00Z") from error
    return (found.replace(tzinfo=UTC) if found.tzinfo is None else found).timestamp()


class OrbitSection(Section, frozen=True, kw_only=True):
    """The orbit of the craft at simulation time zero.

    `altitude` (m) is the semi-major axis minus the Earth's radius. The perigee must be higher than 150 km.

    `local_time` (h), the true local solar time of the ascending node, overrides `ascending_node_deg`. True
    and mean local solar time differ by up to 18 min.
    """

    altitude: Annotated[float, Meta(ge=200e3, le=2_000e3, description="m")] = 500e3
    eccentricity: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.001
    inclination_deg: Annotated[float, Meta(ge=0.0, le=180.0)] = 97.4
    ascending_node_deg: Angle = 0.0
    local_time: Annotated[float, Meta(ge=0.0, le=24.0, description="h")] | None = None
    argument_of_perigee_deg: Angle = 0.0
    true_anomaly_deg: Angle = 0.0


class CraftSection(Section, frozen=True, kw_only=True):
    """True values of the craft that differ from its description in the flight configuration.

    The craft is a box of `size` (3,), m. The vector `centre_of_mass` (3,), m, leads from the centre of the
    box to the centre of mass, in body axes. `inertia`, kg m^2, contains the moments of inertia (3,) about the
    body axes, or the inertia tensor (3, 3). The residual dipole in shadow is `residual_dipole` (3,), A m^2,
    plus the residual dipole of the section `disturbances`. The list `windings` describes the coils. An
    omitted value equals the value of the flight configuration.
    """

    inertia: Inertia | None = None
    size: tuple[Positive, Positive, Positive] | None = None
    centre_of_mass: Vector | None = None
    residual_dipole: Vector | None = None
    windings: tuple[Winding, ...] | None = None


class TipOff(Section, frozen=True, kw_only=True):
    """The release of a free body.

    At release the body rotates at `speed` (rad/s) about a random axis or, if `rate` is given, at `rate` (3,),
    rad/s, body axes. `attitude` is the quaternion from ICRS to body axes, scalar last; if it is omitted, the
    attitude is random.
    """

    speed: Annotated[float, Meta(ge=0.0, le=3.5, description="rad/s")] = 0.1745
    rate: Vector | None = None
    attitude: Quaternion | None = None


class Disturbances(Section, frozen=True, kw_only=True):
    """Disturbances as multiples of their worst cases, and the errors of the coils.

    The worst case of `drag` and `solar_pressure` is the torque on a box with a displaced centre of mass. The
    displacement from the configured centre of mass has a random direction and the length
    `craft.accuracy.centre_of_mass`. The worst case of `residual_dipole` is a constant part of 1e-3 A m^2, a
    part of 3e-4 A m^2 in sunlight and a random walk of 5e-5 A m^2. The worst case of `ring_current` is a
    field of 20 nT that varies over hours.

    `day_bulge` scales the variation of the air density between day and night. `walks` scales the random walks
    of air density and residual dipole. The angle between body axes and principal axes is at least a third of
    `principal_turn_deg` and at most `principal_turn_deg`. `coil_scale` and `coil_tilt_deg` are the standard
    deviations of the coils' scale errors and axis tilts. Every 20 s the dipole per ampere of each coil
    changes at random. `coil_variation` is the relative standard deviation of these changes.
    """

    gravity_gradient: Multiple = 1.0
    drag: Multiple = 1.0
    solar_pressure: Multiple = 1.0
    residual_dipole: Multiple = 1.0
    ring_current: Multiple = 1.0
    day_bulge: Annotated[float, Meta(ge=0.0, le=1.0)] = 1.0
    walks: Multiple = 1.0
    principal_turn_deg: Annotated[float, Meta(ge=0.0, le=45.0)] = 3.0
    coil_scale: Annotated[float, Meta(ge=0.0, le=0.3)] = 0.03
    coil_tilt_deg: Annotated[float, Meta(ge=0.0, le=30.0)] = 1.0
    coil_variation: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.0


class FreeBodySection(Section, frozen=True, kw_only=True):
    """The section `free_body`.

    If `craft` is a name, the body is one of the two satellites in `sim_hal.worlds.free_body.CRAFTS`.
    Otherwise the body is the satellite of the flight configuration, with the true values that `craft`
    contains.

    `errors` is the ratio of the largest errors of the configured properties of body, coils and sensors to
    their configured accuracies (`sim_hal.description_errors`).
    """

    craft: Literal["knightcube", "cubesat_3u"] | CraftSection | None = None
    orbit: OrbitSection = OrbitSection()
    release: TipOff = TipOff()
    disturbances: Disturbances = Disturbances()
    errors: Annotated[float, Meta(ge=0.0, le=3.0)] = 1.0


class Release(Section, frozen=True, kw_only=True):
    """The testbed's quaternion component q2 and rate (rad/s) about the thread at mission time zero."""

    q2: Annotated[float, Meta(ge=-0.7, le=0.7), Meta(description="quaternion component q2 at the start")]
    rate: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0


class Thread(Section, frozen=True, kw_only=True):
    """Torsional stiffness (N m/rad) and damping (N m s/rad) of the testbed's thread."""

    stiffness: NotNegative = 0.0
    damping: NotNegative = 0.0


class ImuNoise(Section, frozen=True, kw_only=True):
    """Errors of the emulated inertial unit.

    `quaternion_noise` and `rate_noise` (rad/s) bound the uniform noise of quaternion and rate. `profile:
    datasheet` adds the white noise of the unit's data sheet and a random bias at each start. `gyro_bias`
    (3,), rad/s, is the constant bias of the gyro, and `field_bias` (3,), T, body axes, is the constant bias
    of the magnetometer.
    """

    profile: Literal["bounds", "datasheet"] = "bounds"
    quaternion_noise: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.0
    rate_noise: NotNegative = 0.0
    gyro_bias: Vector = (0.0, 0.0, 0.0)
    field_bias: Vector = (0.0, 0.0, 0.0)
    clock_ppm: Annotated[float, Meta(ge=-100.0, le=100.0)] = 0.0


class Latency(Section, frozen=True, kw_only=True):
    """Latency (s) of the workers' results in lock-step."""

    planner: Delay = 0.05
    vision: Delay = 0.25


class Truth(Section, frozen=True, kw_only=True):
    """True constants of the world that differ from those of the flight configuration.

    `resistance` has one value (ohm) for each coil.
    """

    inertia: Positive | None = None
    field: Positive | None = None
    resistance: Annotated[tuple[Positive, ...], Meta(min_length=1, max_length=MOST_COILS)] | None = None
    supply_voltage: Positive | None = None


class CageTruth(Section, frozen=True, kw_only=True):
    """Field of the simulated Helmholtz cage, which reproduces the field along `orbit` (elements at time 0).

    `gain` is the ratio of the cage's field to the commanded field. `ring_current` scales the mean field of
    the ring current, 20 nT.
    """

    orbit: OrbitSection = OrbitSection()
    gain: Positive = 1.0
    ring_current: NotNegative = 1.0


class SkySection(Section, frozen=True, kw_only=True):
    """Sky and optics of the emulated star camera.

    The model of Sease 2013, chapter 2, corresponds to `psf: bilinear` and `noise: uniform`. In orbit, stray
    light saturates a frame if the boresight is within `sun_exclusion_deg` of the Sun or within
    `earth_exclusion_deg` of sunlit ground, and also if the Sun or sunlit ground is in the field of view. The
    default exclusion angles are typical of a star tracker with a baffle that fits into a CubeSat. The value
    `lens` describes the true lens, which by default is the lens in the camera section.
    """

    magnitude_limit: Annotated[float, Meta(ge=0.0, le=8.5)] = 8.5
    year: Annotated[float, Meta(ge=1900.0, le=2100.0)] = 2026.5
    aperture: Positive = 0.025
    dark_current: NotNegative = 50.0
    pedestal: NotNegative = 100.0
    full_well: Positive = 20000.0
    readout: Delay = 0.05
    line_time: NotNegative = 0.0
    lens: CameraLens | None = None
    psf: Literal["integrated", "bilinear"] = "integrated"
    noise: Literal["poisson", "uniform"] = "poisson"
    sun_exclusion_deg: ExclusionAngle = 40.0
    earth_exclusion_deg: ExclusionAngle = 18.0


class Tumble(Section, frozen=True, kw_only=True):
    """A sinusoidal variation of an object's brightness by +-`amplitude` magnitudes every `period` s."""

    period: Annotated[Positive, Meta(description="period of the brightness, s")]
    amplitude: Annotated[float, Meta(ge=0.0, le=5.0), Meta(description="amplitude, magnitudes")]
    phase_deg: float = 0.0


class LineOfSight(Section, frozen=True, kw_only=True):
    """A motion along a great circle among the stars, with the position at mission time `at` (s).

    `rate_deg` (deg/s) is the rate towards the position angle `towards_deg`, counted from north through east.
    `acceleration_deg` (deg/s^2) is the acceleration along the great circle.
    """

    right_ascension_deg: Annotated[float, Meta(ge=-360.0, le=360.0), Meta(description="right ascension, deg")]
    declination_deg: Annotated[float, Meta(ge=-90.0, le=90.0), Meta(description="declination, deg")]
    rate_deg: Annotated[float, Meta(ge=0.0, le=20.0)] = 0.0
    towards_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 0.0
    acceleration_deg: Annotated[float, Meta(ge=-5.0, le=5.0)] = 0.0
    at: float = 0.0


class ObjectState(Section, frozen=True, kw_only=True):
    """Geocentric position (3,), m, and velocity (3,), m/s, ICRS, of an object at `simulation.utc`."""

    position: Annotated[Vector, Meta(description="geocentric position, ICRS, m")]
    velocity: Annotated[Vector, Meta(description="geocentric velocity, ICRS, m/s")]


class SkyObject(Section, frozen=True, kw_only=True):
    """An object in the sky of the star camera, with either a `line_of_sight` or the `state` of an orbit.

    `magnitude` is the Johnson V magnitude. For an object in orbit, it is the magnitude in full sunlight.
    """

    magnitude: Annotated[float, Meta(ge=-10.0, le=20.0), Meta(description="Johnson V magnitude")]
    line_of_sight: LineOfSight | None = None
    state: ObjectState | None = None
    tumble: Tumble | None = None


class OrbitDeviceTruth(Section, frozen=True, kw_only=True):
    """Errors of the emulated GPS receiver and solar cells.

    `gps_walk` and `gps_noise` (m) are the standard deviations of the slow error and the white noise of each
    axis. `gps_start` (s) is the time from power-on to the first fix. `string_gain` is the relative standard
    deviation of the gains of the solar cell strings, and `string_noise` (A) the standard deviation of the
    noise of their currents. `albedo` is the mean reflectance of the Earth, from 0 to 1.
    """

    gps_walk: NotNegative = 2.0
    gps_noise: NotNegative = 1.0
    gps_start: NotNegative = 30.0
    string_gain: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.02
    string_noise: NotNegative = 2e-3
    albedo: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.3


class SolarPanel(Section, frozen=True, kw_only=True):
    """A solar panel on a face of the body.

    The outward `normal` (3,), in body axes, need not be a unit vector. `peak` (W) is the electrical power in
    sunlight at normal incidence and one astronomical unit.
    """

    normal: Annotated[Vector, Meta(description="outward normal in body axes, three numbers")]
    peak: Annotated[Positive, Meta(description="power in sunlight at normal incidence, W")]


class PowerTruth(Section, frozen=True, kw_only=True):
    """The true power system of a configuration with a section `power`.

    The battery starts at the state of charge `charge`. `battery` is the true battery, by default the
    configured battery. `load` (W) is the constant power of board, sensors and radio, and `frame` (J) the
    energy that the star camera and its processing use for one frame. The coils draw their current at 5 V. The
    `panels` need a world with an orbit.
    """

    charge: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.8
    battery: Battery | None = None
    load: NotNegative = 0.8
    frame: NotNegative = 2.0
    panels: Annotated[tuple[SolarPanel, ...], Meta(max_length=32)] = ()


class FaultEntry(Section, frozen=True, kw_only=True):
    """A fault that begins at mission time `at` (s, by default 0) and lasts `for` s (by default to the end).

    The module `sim_hal.faults.schedule` parses the text `fault`.
    """

    fault: Annotated[str, Meta(description="fault, such as imu: silent")]
    at: NotNegative | None = None
    span: Positive | None = msgspec.field(default=None, name="for")


class Simulation(Section, frozen=True, kw_only=True):
    """Section `simulation`; the value `world` is a key of `sim_hal.worlds.world.WORLDS` or `module:factory`.

    The three rows of `coil_field`, T/A, map the coil currents to the components of the coils' field at the
    magnetometer, body axes. Each row of `coil_field` has one value for each coil.
    """

    seed: Annotated[int, Meta(ge=0, le=(1 << 63) - 1)] = 1
    utc: str = "2026-01-01T00:00:00Z"
    world: Annotated[str, Meta(min_length=1, max_length=200)] = "testbed"
    release: Release | None = None
    thread: Thread = Thread()
    current_noise: NotNegative = 0.0
    coil_field: tuple[PerCoil, PerCoil, PerCoil] | None = None
    imu: ImuNoise = ImuNoise()
    sky: SkySection = SkySection()
    objects: Annotated[tuple[SkyObject, ...], Meta(max_length=32)] = ()
    truth: Truth = Truth()
    free_body: FreeBodySection | None = None
    cage: CageTruth | None = None
    orbit_devices: OrbitDeviceTruth = OrbitDeviceTruth()
    power: PowerTruth = PowerTruth()
    latency: Latency = Latency()
    faults: tuple[FaultEntry, ...] = ()
