"""The configurations of the testbed and of a satellite: sections in addition to the shared sections."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

import msgspec
import numpy as np
from msgspec import Meta

from flight.schema.document import (
    Q2,
    Aim,
    ConfigError,
    GoalName,
    Inertia,
    NotNegative,
    Positive,
    Section,
    Share,
    Vector,
    inertia_matrix,
)
from flight.schema.sections import Config, Detumble, Estimation
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.pointing_target import PointingTarget


class Plant(Section, frozen=True, kw_only=True):
    """The flight application's model of body and actuator (Sease thesis, tables 5.1, 5.3 and 5.4)."""

    inertia: Annotated[
        float, Meta(gt=0.0, le=1e3), Meta(description="moment of inertia about the thread, kg m^2")
    ]
    coil_turns: Annotated[int, Meta(gt=0, le=100_000), Meta(description="number of turns of a coil")]
    coil_area: Annotated[float, Meta(gt=0.0, le=100.0), Meta(description="area of a coil, m^2")]
    field: Annotated[float, Meta(gt=0.0, le=1.0), Meta(description="horizontal magnetic field, T")]
    thread_stiffness: NotNegative = 0.0
    thread_damping: NotNegative = 0.0


class ThreadEstimation(Estimation, frozen=True, kw_only=True):
    """The testbed's filter, which also estimates changes of the plant's torsion (1/s^2) and damping (1/s)."""

    torsion_start: NotNegative = 0.02
    damping_start: NotNegative = 4.0e-3


class BdotDetumble(Detumble, frozen=True, kw_only=True):
    """Detumbling by B-dot (`knightcube.gnc.control.detumble`).

    Each cycle removes the fraction `share` of the rate, as far as the coils' limits permit. If the direction
    of the field rotates at `field_turn` rad/s, the fraction `share` is computed from this rate. On a testbed
    without a cage, `field_turn` is zero.
    """

    share: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.3
    field_turn: NotNegative = 0.0


class Guidance(Section, frozen=True, kw_only=True):
    """Path planning by virtual motion camouflage (Sease thesis, eqs. 5.8-5.15).

    The planning strategies are described in `flight.bodies.testbed.control`.

    Paths minimise the energy `cost`: the heat R I^2 of the mean current, or the supplied power V |I|.
    """

    strategy: Literal["goal", "receding", "step"] = "goal"
    horizon: Positive = 10.0
    cost: Literal["heat", "supply"] = "heat"
    time_price: Positive | None = None
    current_share: Annotated[float, Meta(ge=0.5, le=1.0)] = 0.95
    replan_period: Positive = 5.0
    late_after: Positive = 1.0
    nodes: Annotated[int, Meta(ge=8, le=40)] | None = None


class PidGains(Section, frozen=True, kw_only=True):
    """Gains of the PID controller for the angle (1/s^2), its integral (1/s^3) and the rate (1/s)."""

    proportional: Annotated[Positive, Meta(description="gain of the angle, 1/s^2")]
    integral: Annotated[Positive, Meta(description="gain of the integral of the angle, 1/s^3")]
    derivative: Annotated[Positive, Meta(description="gain of the rate, 1/s")]


class Control(Section, frozen=True, kw_only=True):
    """The controller.

    The controllers `lq` and `thesis` use the weights of the Sease thesis, eqs. 5.30-5.32: Q = state_weight I
    and R = control_weight. The controllers `pid` and `adaptive` use `bandwidth`. The value `target_weight`
    belongs to `pid`, and `adaptation` and `reference_bandwidth` belong to `adaptive`. If `gains` are given,
    `pid` uses them instead of the bandwidth. The controller `excitation` is used by `knightcube identify`.
    """

    tracker: Literal["lq", "thesis", "pid", "adaptive", "excitation"] = "lq"
    state_weight: Positive = 2.0
    control_weight: Positive = 1.0
    bandwidth: Positive = 1.0
    gains: PidGains | None = None
    target_weight: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    adaptation: Positive = 1.0
    reference_bandwidth: Positive | None = None


class Identification(Section, frozen=True, kw_only=True):
    """Motion of the body during `knightcube identify`.

    The coils use at most the fraction `current_share` of their current limit. The quaternion component q2
    stays within `largest_q2`, and each free oscillation lasts `swing` s.
    """

    current_share: Annotated[float, Meta(gt=0.0, le=0.9)] = 0.6
    largest_q2: Annotated[float, Meta(ge=0.05, le=0.5)] = 0.4
    swing: Positive = 45.0


class Step(Section, frozen=True, kw_only=True):
    """One commanded attitude: `q2` at mission time `at` (s), then rotation at `rate` rad/s."""

    at: Annotated[NotNegative, Meta(description="mission time, s")]
    q2: Annotated[Q2, Meta(description="second quaternion component, -0.68 to 0.68")]
    rate: Annotated[float, Meta(ge=-0.1, le=0.1, description="rad/s")] = 0.0


class Cage(Section, frozen=True, kw_only=True):
    """A Helmholtz cage that reproduces the field of an orbit as a function of UTC (`bodies.testbed.control`).

    The orbit is given by the two-line elements `elements`, and `scale` is the ratio of the cage's field to
    the orbit's field. If there is a cage, `plant.field` is the weakest field that plans assume.
    """

    elements: Annotated[tuple[str, str], Meta(description="two lines of two-line elements")]
    scale: Annotated[float, Meta(gt=0.0, le=100.0)] = 10.0


class TestbedConfig(Config, frozen=True, kw_only=True):
    """The testbed's configuration."""

    __test__ = False  # without this, pytest would collect the class

    plant: Plant
    estimation: ThreadEstimation = ThreadEstimation()
    detumble: BdotDetumble = BdotDetumble()
    guidance: Guidance = Guidance()
    control: Control = Control()
    identification: Identification = Identification()
    steps: Annotated[tuple[Step, ...], Meta(min_length=1)]
    cage: Cage | None = None

    def field_range(self) -> tuple[float, float]:
        """Return the minimum and the maximum strength (T) of a valid magnetometer reading."""
        return 0.2 * self.plant.field, 3.0 * self.plant.field

    def replan_period(self) -> float:
        """Return the planning period (s); each plan starts from the newest estimate."""
        return self.guidance.replan_period

    def hardware(self) -> tuple[Section, ...]:
        """Return the hardware sections on which the validity of learned parameters depends."""
        return (self.plant, *super().hardware())

    def shortened(self, duration: float) -> Self:
        """Return the configuration with another flight duration (s), without the steps after its end."""
        steps = tuple(step for step in self.steps if step.at < duration)
        return msgspec.structs.replace(self, duration=duration, steps=steps)


def as_testbed(config: Config) -> TestbedConfig:
    """Return the same configuration as a `TestbedConfig`. Raises ConfigError for any other body."""
    if not isinstance(config, TestbedConfig):
        raise ConfigError("body", f"is {config.body}: this needs a configuration of the testbed")
    return config


LEAST_FIELD, LARGEST_FIELD = 5e-6, 2e-4
"""Range of valid magnetometer readings, T. At a height of 200 km the field is up to 6.5e-5 T, and the coils
may add as much. The field is at least 7e-6 T up to a height of 2,840 km, the apogee of the highest orbit that
is flown."""

_FIELD = 3.3e-5
"""Typical magnetic field in a low orbit, T."""
_PRESSURE = 5.0e-6
"""Expected pressure (Pa) of air drag and solar radiation on a face at an altitude of 500 km. The expected
pressure is a tenth of the largest pressure (solar maximum, perpendicular incidence)."""
_LARGEST_PRESSURE = 10.0
"""Ratio of the largest to the expected pressure."""
_DIPOLE, _MOMENT = 3.0e-4, 1.047e-3
"""Dipole (A m^2) that costs as much as an attitude error of 1 deg on a 1U CubeSat, and the mean moment of
inertia (kg m^2) of this CubeSat."""

_DIPOLE_PER_MASS = 3.5e-3
"""Residual dipole (A m^2) per kg of a satellite of class II that does not spin (NASA SP-8018)."""

ConeAngle = Annotated[float, Meta(ge=0.0, le=90.0, description="deg")]


class CraftAccuracy(Section, frozen=True, kw_only=True):
    """Largest errors of the configured satellite; the true errors are assumed uniform within them.

    `centre_of_mass` (m) is the distance of the true from the configured centre of mass; the default is the
    largest offset that the CubeSat Design Specification permits.

    `moments` is the relative error of the principal moments of inertia, and `axes_deg` the rotation of the
    principal axes about each body axis. `coil_gain` is the relative error of the dipole of each coil, and
    `coil_axes_deg` the misalignment of its axis. `residual_dipole` (A m^2) is the error of the residual
    dipole along each body axis, by default computed (`OrbitConfig.dipole_errors`).
    """

    moments: Annotated[float, Meta(ge=0.0, le=0.3)] = 0.1
    axes_deg: Annotated[float, Meta(ge=0.0, le=30.0)] = 5.0
    coil_gain: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.2
    coil_axes_deg: Annotated[float, Meta(ge=0.0, le=30.0)] = 3.0
    centre_of_mass: Annotated[float, Meta(ge=0.0, le=1.0, description="m")] = 0.02
    residual_dipole: Annotated[float, Meta(ge=0.0, le=100.0, description="A m^2")] | None = None


class Craft(Section, frozen=True, kw_only=True):
    """The model of the satellite that the flight application uses.

    The satellite is a box with the edges `size` (m) along the body axes. The vector `centre_of_mass` (m)
    leads from the centre of the box to the centre of mass. The value `inertia` holds the moments of inertia
    about the body axes, or the rows of the inertia tensor, kg m^2. By default, the moments are those of a
    homogeneous box of `mass` (kg). The coils are described in the section `coils`. The vector
    `residual_dipole` (A m^2) is the expected magnetic dipole of the satellite in shadow with the coils off.
    """

    size: Annotated[
        tuple[Positive, Positive, Positive], Meta(description="edges along the body axes x, y, z, m")
    ]
    mass: Annotated[Positive | None, Meta(description="mass, kg")] = None
    centre_of_mass: Vector = (0.0, 0.0, 0.0)
    inertia: Inertia | None = None
    residual_dipole: Vector = (0.0, 0.0, 0.0)
    accuracy: CraftAccuracy = CraftAccuracy()

    def inertia_matrix(self) -> FloatArray:
        """Return the inertia tensor (3, 3), kg m^2.

        Raises ValueError if `inertia` mixes moments with matrix rows, or if `inertia` and `mass` are missing.
        """
        if self.inertia is not None:
            return inertia_matrix(self.inertia)
        if self.mass is None:
            raise ValueError("neither `inertia` nor `mass` is given")
        squares = np.square(self.size)
        return np.diag(self.mass / 12.0 * (squares.sum() - squares))


class FieldDetumble(Detumble, frozen=True, kw_only=True):
    """Detumbling by a minimum-time plan of the angular momentum in the measured magnetic field.

    The noise `field_noise` is that of a magnetometer sample, T per axis; the bias is estimated. The noise
    `torque_noise` (rad/s per sqrt(s)) represents unmodelled torques, and is computed by default
    (`OrbitConfig.torque_noise`). The plan (`knightcube.gnc.control.field_detumbler`) covers `horizon` s and
    is renewed every `replan` s. A body that starts slower than `gentle` rad/s should not exceed its initial
    rate; a faster body may reach `spin_up` times its initial rate.
    """

    field_noise: Positive = 5.0e-7
    torque_noise: Positive | None = None
    horizon: Positive = 1500.0
    replan: Annotated[float, Meta(ge=1.0, description="s")] = 5.0
    gentle: Positive = 0.052
    spin_up: Annotated[float, Meta(ge=1.0)] = 3.0


BlockName = Literal[
    "gyro_bias",
    "dipole",
    "sunlit_dipole",
    "field_bias",
    "torques",
    "inertia",
    "coils",
    "gyro_matrix",
    "field_matrix",
    "camera",
]
"""A block of the filter's error state whose role can be configured."""


class OrbitEstimation(Estimation, frozen=True, kw_only=True):
    """The attitude filter of a satellite in orbit (`knightcube.gnc.estimation.free_filter`).

    The value `bias_walk` is the random walk of the gyro bias, rad/s per sqrt(s), and `field_noise` is the
    noise of a magnetometer sample, T per axis. The value `torque_start` is the expected amplitude (N m) of
    the disturbance torques at an altitude of 500 km before they are estimated, and `torque_walk` their random
    walk, N m per sqrt(s). By default, `torque_start` and `torque_walk` are computed
    (`OrbitConfig.torque_sizes`). From one boot to the next, the gyro bias may change by 10 deg/h, and the
    residual dipole by the fraction `changed` of its initial standard deviation. The mapping `roles` sets the
    role of blocks of the error state: `estimated`, `considered` (the block is not corrected, but its
    uncertainty is part of every covariance) or `fixed` (the block is known exactly). With `compare: meller`,
    the attitude is also determined as the ION-F satellites do (`knightcube.reference.sensor_fusion`), for
    comparison in the telemetry; this attitude is not used for control.
    """

    bias_walk: NotNegative = 2.0e-6
    field_noise: Positive = 1.0e-7
    gate_sigma: Annotated[float, Meta(ge=3.0)] = 5.0
    history: Positive = 12.0
    changed: Share = 0.05
    torque_start: Positive | None = None
    torque_walk: Positive | None = None
    roles: dict[BlockName, Literal["estimated", "considered", "fixed"]] = msgspec.field(default_factory=dict)
    compare: Literal["meller"] | None = None


class ExclusionCones(Section, frozen=True, kw_only=True):
    """Minimum angles from the star camera's boresight to the Sun, the Moon and the limb of the Earth."""

    sun_deg: ConeAngle | None = None
    earth_deg: ConeAngle | None = None
    moon_deg: ConeAngle | None = None

    def angles(self) -> dict[str, float]:
        """Return the configured cone angles, rad, by the name of the celestial body."""
        found = {"sun": self.sun_deg, "earth": self.earth_deg, "moon": self.moon_deg}
        return {name: math.radians(angle) for name, angle in found.items() if angle is not None}


class PointingSection(Section, frozen=True, kw_only=True):
    """Pointing of a satellite in orbit (`knightcube.gnc.control`).

    The body axis `axis` points at the target; a commanded roll angle is measured from the body axis `across`,
    which is perpendicular to it. An attitude error of `turn` rad, a rate error of `rate` rad/s and a dipole
    of `dipole` A m^2 have equal cost. A roll error of `roll` rad about `axis` has the same cost; without
    `roll`, a roll error costs as much as any other attitude error. The coils act for `act` s between pauses
    for the magnetometer, which last as long as in detumbling. Plans are renewed every `replan_period` s. A
    coil that pointing rarely uses is tested by a short current every `coil_test` s; 0 switches the tests off.
    A slew to a distant target takes `slew` s, or longer if necessary, and respects the exclusion `cones` of
    the star camera. The `planner` of slews is `collocation` or `vmc` (virtual motion camouflage). By
    default, `dipole` and `slew` are computed (`OrbitConfig.dipole_weight`, `OrbitConfig.slew_duration`).
    """

    axis: Vector = (0.0, 0.0, 1.0)
    across: Vector = (1.0, 0.0, 0.0)
    turn: Positive = 0.0175
    rate: Positive = 1.0
    dipole: Positive | None = None
    roll: Positive | None = None
    act: Annotated[float, Meta(ge=0.1, le=10.0, description="s")] = 1.8
    replan_period: Annotated[float, Meta(ge=10.0, le=900.0, description="s")] = 300.0
    coil_test: Annotated[float, Meta(ge=0.0, le=86400.0, description="s")] = 600.0
    slew: Annotated[float, Meta(ge=60.0, le=1500.0, description="s")] | None = None
    cones: ExclusionCones = ExclusionCones()
    planner: Literal["collocation", "vmc"] = "collocation"


class TargetStep(Aim, frozen=True, kw_only=True):
    """A pointing goal that is in force from mission time `at` (s) on."""

    at: Annotated[NotNegative, Meta(description="mission time, s")]
    point: GoalName

    def target(self) -> PointingTarget:
        """Return the target. Raises UsageError for a missing value, and for a value of another goal."""
        return self.target_at(self.point)


class Requirements(Section, frozen=True, kw_only=True):
    """Requirements that `knightcube report` checks for an orbit flight; omitted requirements are not checked.

    Detumbling must end within `slow_within` s of the start, and the attitude must be fine within
    `fine_within` s after that. The value `knowledge_deg` limits the rms error of the attitude with star
    fixes, over all axes. The value `pointing_deg` limits the rms error of the pointing axis, beginning ten
    minutes after the start of pointing. The value `camera_missed_percent` limits the percentage of the
    instants at which the unobstructed star camera gave neither an attitude nor a rate.
    """

    slow_within: Positive | None = None
    fine_within: Positive | None = None
    knowledge_deg: Positive | None = None
    pointing_deg: Positive | None = None
    camera_missed_percent: Positive | None = None


class OrbitConfig(Config, frozen=True, kw_only=True):
    """The configuration of a satellite in orbit, with its two-line elements (`elements`), if known."""

    craft: Craft
    elements: tuple[str, str] | None = None
    estimation: OrbitEstimation = OrbitEstimation()
    detumble: FieldDetumble = FieldDetumble()
    pointing: PointingSection = PointingSection()
    targets: Annotated[tuple[TargetStep, ...], Meta(min_length=1)] = (TargetStep(at=0.0, point="nadir"),)
    requirements: Requirements = Requirements()

    def looks_for_objects(self) -> bool:
        """Return whether the star camera searches for moving objects."""
        camera = self.camera
        return camera is not None and camera.objects is not None

    def field_range(self) -> tuple[float, float]:
        """Return the minimum and the maximum strength (T) of a valid magnetometer reading."""
        return LEAST_FIELD, LARGEST_FIELD

    def replan_period(self) -> float:
        """Return the planning period, s."""
        return self.pointing.replan_period

    def hardware(self) -> tuple[Section, ...]:
        """Return the hardware sections on which the validity of learned parameters depends."""
        return (self.craft, *super().hardware())

    def torque_noise(self) -> float:
        """Return the noise of unmodelled torques in detumbling, rad/s per sqrt(s).

        The default is a tenth of the rms angular acceleration about the principal axes that the mean dipole
        limit causes in a typical field.
        """
        if self.detumble.torque_noise is not None:
            return self.detumble.torque_noise
        rates = 1.0 / np.linalg.eigvalsh(self.craft.inertia_matrix())
        torque = _FIELD * float(self.coils.map().limits.mean())
        return _two_digits(0.1 * torque * float(np.sqrt(np.mean(rates**2))))

    def dipole_errors(self) -> tuple[float, float]:
        """Return the largest errors (A m^2 per axis) of the residual dipole and of its increase in sunlight.

        The default error of the residual dipole in shadow is proportional to the mass, as for a satellite
        with some magnetic cleanliness. A missing mass is computed from the moments of inertia of a
        homogeneous box. In sunlight, an additional dipole arises, whose largest error is three tenths of the
        default error in shadow.
        """
        craft = self.craft
        mass = craft.mass
        if mass is None:
            mass = 6.0 * float(np.trace(craft.inertia_matrix())) / sum(edge**2 for edge in craft.size)
        usual, given = _two_digits(_DIPOLE_PER_MASS * mass), craft.accuracy.residual_dipole
        return usual if given is None else given, 0.3 * usual

    def torque_sizes(self) -> tuple[float, float]:
        """Return the amplitude (N m) and random walk (N m per sqrt(s)) of the disturbance torques at 500 km.

        The default amplitude is the torque of air drag and solar radiation pressure on the largest face. The
        lever arm is the sum of the configured and the unknown offset of the centre of mass. The default
        random walk is the amplitude times 2e-3 per sqrt(s), because plans extrapolate an estimated torque
        along the field for an hour.
        """
        craft, section = self.craft, self.estimation
        x, y, z = craft.size
        arm = craft.accuracy.centre_of_mass + math.hypot(*craft.centre_of_mass)
        start = section.torque_start or _two_digits(_PRESSURE * max(x * y, y * z, z * x) * arm)
        return start, section.torque_walk or _two_digits(2.0e-3 * start)

    def largest_torques(self) -> tuple[float, float]:
        """Return the largest torques (N m) of air drag at 500 km and of an unknown residual dipole."""
        return _LARGEST_PRESSURE * self.torque_sizes()[0], sum(self.dipole_errors()) * _FIELD

    def dipole_weight(self) -> float:
        """Return the dipole (A m^2) that costs as much as an attitude error of `pointing.turn`.

        The default is proportional to the square root of the mean moment of inertia, with a factor tuned for
        a 1U and a 3U CubeSat, but at most a fiftieth of the mean dipole limit.
        """
        if self.pointing.dipole is not None:
            return self.pointing.dipole
        moment = float(np.trace(self.craft.inertia_matrix())) / 3.0
        largest = 0.02 * float(self.coils.map().limits.mean())
        return _two_digits(min(_DIPOLE * math.sqrt(moment / _MOMENT), largest))

    def slew_duration(self) -> float:
        """Return the requested duration of a slew to a distant target, s.

        The default is 16 sqrt(J / T) s, rounded to 10 s and limited to 60 s to 1500 s, where J is the largest
        moment of inertia and T the torque of the mean dipole limit in a typical field.
        """
        if self.pointing.slew is not None:
            return self.pointing.slew
        moment = float(np.linalg.eigvalsh(self.craft.inertia_matrix())[-1])
        torque = _FIELD * float(self.coils.map().limits.mean())
        return min(max(10.0 * round(1.6 * math.sqrt(moment / torque)), 60.0), 1500.0)


def _two_digits(value: float) -> float:
    """Return a value rounded to two significant digits."""
    return float(f"{value:.1e}")


def as_orbit(config: Config) -> OrbitConfig:
    """Return the same configuration as an `OrbitConfig`. Raises ConfigError for any other body."""
    if not isinstance(config, OrbitConfig):
        raise ConfigError("body", f"is {config.body}: this needs the configuration of a satellite in orbit")
    return config
