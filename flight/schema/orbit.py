"""The configuration of a satellite in orbit: its own sections beside those of every body."""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import Meta

from flight.schema.document import ConfigError
from flight.schema.sections import Config, Detumble, Estimation
from flight.schema.values import Aim, GoalName, NotNegative, Positive, Section, Share, Vector
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget

LEAST_FIELD, LARGEST_FIELD = 5e-6, 2e-4
"""Range of valid magnetometer readings, T: 1.5e-5 to 6.5e-5 in a low orbit, and as much from the coils."""

ConeAngle = Annotated[float, Meta(ge=0.0, le=90.0)]


class Craft(Section, frozen=True, kw_only=True):
    """The flight application's model of the satellite.

    `inertia` are the moments of inertia about the body axes, kg m^2; `dipole_per_ampere` is turns times area
    of each coil, m^2.
    """

    inertia: tuple[Positive, Positive, Positive]
    dipole_per_ampere: Positive


class FieldDetumble(Detumble, frozen=True, kw_only=True):
    """Detumbling by the momentum plan in the measured field (`knightcube.gnc.control`).

    `field_noise` (T, per axis and sample) includes constant errors of the magnetometer. `torque_noise` (rad/s
    per sqrt(s)) stands for unmodelled torques. The plan covers `horizon` s and is renewed every `replan` s. A
    body slower than `gentle` rad/s at the start never exceeds its initial rate; a faster body may reach
    `spin_up` times its initial rate.
    """

    field_noise: Positive = 5.0e-7
    torque_noise: Positive = 1.0e-5
    horizon: Positive = 1500.0
    replan: Annotated[float, Meta(ge=1.0)] = 5.0
    gentle: Positive = 0.052
    spin_up: Annotated[float, Meta(ge=1.0)] = 2.0


class OrbitEstimation(Estimation, frozen=True, kw_only=True):
    """The filter of a satellite in orbit (`knightcube.gnc.estimation.free_filter`).

    `bias_walk` is the random walk of the gyro bias, rad/s per sqrt(s); `field_noise` the noise per axis of a
    magnetometer sample, T. `torque_start` is the torque expected before any is estimated, N m: drag at 500 km
    and twice the solar pressure. `torque_walk` is its random walk, N m per sqrt(s). Both are smaller for a
    light satellite, because an estimated torque along the field enters plans for an hour. Since the last boot
    the gyro bias may have changed by 10 deg/h, the dipole by the part `changed` of its initial deviation.
    """

    bias_walk: NotNegative = 2.0e-6
    field_noise: Positive = 1.0e-7
    gate_sigma: Annotated[float, Meta(ge=3.0)] = 5.0
    history: Positive = 12.0
    changed: Share = 0.05
    torque_start: Positive = 3.0e-9
    torque_walk: Positive = 5.0e-12


class ExclusionCones(Section, frozen=True, kw_only=True):
    """Smallest angles between the star camera's boresight and the Sun, the Moon and the limb of the Earth."""

    sun_deg: ConeAngle | None = None
    earth_deg: ConeAngle | None = None
    moon_deg: ConeAngle | None = None

    def angles(self) -> dict[str, float]:
        """Return the angles of the given cones, rad, by the name of the body."""
        found = {"sun": self.sun_deg, "earth": self.earth_deg, "moon": self.moon_deg}
        return {name: math.radians(angle) for name, angle in found.items() if angle is not None}


class PointingSection(Section, frozen=True, kw_only=True):
    """Pointing of a satellite (`knightcube.gnc.control`).

    `axis` of the body points at the target; a given roll is measured from `across`, perpendicular to it.
    Errors of `turn` rad and `rate` rad/s and a dipole of `dipole` A m^2 have equal cost, as does a rotation
    of `roll` rad about `axis`; without `roll` this costs as any other rotation. The coils act for `act` s
    between pauses as long as the detumbler's. Plans are renewed every `replan_period` s. A slew to a distant
    target takes `slew` s, if that suffices, with the star camera outside the `cones`.
    """

    axis: Vector = (0.0, 0.0, 1.0)
    across: Vector = (1.0, 0.0, 0.0)
    turn: Positive = 0.0175
    rate: Positive = 1.0
    dipole: Positive = 1.0e-4
    roll: Positive | None = None
    act: Annotated[float, Meta(ge=0.1, le=10.0)] = 1.8
    replan_period: Annotated[float, Meta(ge=10.0, le=900.0)] = 300.0
    slew: Annotated[float, Meta(ge=60.0, le=1500.0)] = 600.0
    cones: ExclusionCones = ExclusionCones()


class TargetStep(Aim, frozen=True, kw_only=True):
    """A goal to point to from `at` s of mission time on."""

    at: NotNegative
    point: GoalName

    def target(self) -> PointingTarget:
        """Return the target. Raises UsageError for a missing value or one of another goal."""
        return self.target_at(self.point)


class Requirements(Section, frozen=True, kw_only=True):
    """Requirements that `flight report` checks for an orbit flight; an absent requirement is not checked.

    `slow_within` s is the longest time from the start to the end of detumbling, `fine_within` s from there to
    a fine attitude. `knowledge_deg` limits the rms error of the attitude with stars, all axes; `pointing_deg`
    limits the rms error of the pointed axis after a target was pointed to for ten minutes.
    """

    slow_within: Positive | None = None
    fine_within: Positive | None = None
    knowledge_deg: Positive | None = None
    pointing_deg: Positive | None = None


class OrbitConfig(Config, frozen=True, kw_only=True):
    """The configuration of a satellite in orbit; `elements` are its two-line elements, if known."""

    craft: Craft
    elements: tuple[str, str] | None = None
    estimation: OrbitEstimation = OrbitEstimation()
    detumble: FieldDetumble = FieldDetumble()
    pointing: PointingSection = PointingSection()
    targets: Annotated[tuple[TargetStep, ...], Meta(min_length=1)] = (TargetStep(at=0.0, point="nadir"),)
    requirements: Requirements = Requirements()

    def looks_for_objects(self) -> bool:
        """Return whether the star camera finds moving objects."""
        camera = self.camera
        return camera is not None and camera.star_tracker is not None and camera.objects is not None

    def field_range(self) -> tuple[float, float]:
        """Return the smallest and the largest magnitude of a valid magnetometer reading, T."""
        return LEAST_FIELD, LARGEST_FIELD

    def replan_period(self) -> float:
        """Return the period of planning, s."""
        return self.pointing.replan_period

    def hardware(self) -> tuple[Section, ...]:
        """Return the sections of the hardware to which learned parameters apply."""
        return (self.craft, *super().hardware())


def as_orbit(config: Config) -> OrbitConfig:
    """Return the configuration of a satellite in orbit. Raises ConfigError for another body."""
    if not isinstance(config, OrbitConfig):
        raise ConfigError("body", f"is {config.body}: this needs the configuration of a satellite in orbit")
    return config
