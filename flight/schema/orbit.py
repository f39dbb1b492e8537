"""The shape of the configuration of a satellite in orbit: its own sections beside those of every body."""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import Meta

from flight.schema.aim import Aim, GoalName
from flight.schema.errors import ConfigError
from flight.schema.orbit_devices import Normal
from flight.schema.sections import Config, Detumble, Estimation
from flight.schema.values import NotNegative, Positive, Section
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget

LEAST_FIELD, LARGEST_FIELD = 5e-6, 2e-4
"""T: the Earth's field in a low orbit is 1.5e-5 to 6.5e-5; acting coils add or take as much."""


ConeAngle = Annotated[float, Meta(ge=0.0, le=90.0)]


class Craft(Section, frozen=True, kw_only=True):
    """The flight application's model of the satellite.

    `inertia` kg m^2 of the body axes; `dipole_per_ampere` m^2, n A of every coil.
    """

    inertia: tuple[Positive, Positive, Positive]
    dipole_per_ampere: Positive


class FieldDetumble(Detumble, frozen=True, kw_only=True):
    """Detumbling by the momentum plan in the measured field (`knightcube.gnc.control.three_axes`).

    `field_noise` T of an axis of a sample, constant errors of the magnetometer included; `torque_noise`
    rad/s per sqrt(s), from torques that are not modelled. Times in s: the plan looks `horizon` ahead and is
    made again every `replan`. A body that turned by less than `gentle` rad/s when its braking began is never
    made faster than then, a faster one up to `spin_up` times its first rate.
    """

    field_noise: Positive = 5.0e-7
    torque_noise: Positive = 1.0e-5
    horizon: Positive = 1500.0
    replan: Annotated[float, Meta(ge=1.0)] = 5.0
    gentle: Positive = 0.052
    spin_up: Annotated[float, Meta(ge=1.0)] = 2.0


class OrbitEstimation(Estimation, frozen=True, kw_only=True):
    """The filter of a satellite in orbit (`knightcube.gnc.estimation.free_filter`).

    `bias_walk` rad/s per sqrt(s), of the gyro's bias; `field_noise` T of an axis of a sample of the
    magnetometer; `field_error` T of an axis of the field's model. `torque_start` N m, of
    drag at 500 km, twice that of sunlight, before any is learned; `torque_walk` N m per sqrt(s). Of a
    light craft they are smaller: what is taken for a torque along the field is planned for an hour ahead.
    Since the last boot the gyro's bias may have `changed` by 10 deg/h, the dipole by a twentieth.
    """

    bias_walk: NotNegative = 2.0e-6
    field_noise: Positive = 1.0e-7
    field_error: Positive = 5.0e-8
    gate_sigma: Annotated[float, Meta(ge=3.0)] = 5.0
    history: Positive = 12.0
    changed: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.05
    torque_start: Positive = 3.0e-9
    torque_walk: Positive = 5.0e-12


class ExclusionCones(Section, frozen=True, kw_only=True):
    """How far the star camera's boresight stays from `sun` and `moon`, and from the limb of the `earth`."""

    sun_deg: ConeAngle | None = None
    earth_deg: ConeAngle | None = None
    moon_deg: ConeAngle | None = None

    def angles(self) -> dict[str, float]:
        """Return the angles, rad, of the cones that are kept, by their bodies' names."""
        found = {"sun": self.sun_deg, "earth": self.earth_deg, "moon": self.moon_deg}
        return {name: math.radians(angle) for name, angle in found.items() if angle is not None}


class PointingSection(Section, frozen=True, kw_only=True):
    """How a satellite points (`knightcube.gnc.control.three_axes`).

    `axis` of the body points; a given roll is measured from `across`, normal to it. `turn` rad, `rate` rad/s
    and `dipole` A m^2 are the errors and the dipole that cost the same, as does `roll` rad of a turn about
    `axis`; without it that costs as any other turn. The coils act for `act` s between
    pauses as long as those of detumbling. A plan is made again every `replan_period` s. From far off a target
    is slewed to in `slew` s, where that suffices, with the star camera outside the `cones`.
    """

    axis: Normal = (0.0, 0.0, 1.0)
    across: Normal = (1.0, 0.0, 0.0)
    turn: Positive = 0.0175
    rate: Positive = 1.0
    dipole: Positive = 1.0e-4
    roll: Positive | None = None
    act: Annotated[float, Meta(ge=0.1, le=10.0)] = 1.8
    replan_period: Annotated[float, Meta(ge=10.0, le=900.0)] = 300.0
    slew: Annotated[float, Meta(ge=60.0, le=1500.0)] = 600.0
    cones: ExclusionCones = ExclusionCones()


class TargetStep(Aim, frozen=True, kw_only=True):
    """From `at` s of mission time point to a goal."""

    at: NotNegative
    point: GoalName

    def target(self) -> PointingTarget:
        """Return the target. Raises UsageError for values that do not belong to the goal, or lack."""
        return self.target_at(self.point)


class Requirements(Section, frozen=True, kw_only=True):
    """What `flight report` judges an orbit flight by; what is left out is not judged.

    `slow_within` s from the start to the end of the braking; `fine_within` s from there to a fine attitude.
    In deg, rms: `knowledge_deg` of the attitude with stars, three axes; `pointing_deg` of the pointed axis,
    once a target was pointed to for ten minutes.
    """

    slow_within: Positive | None = None
    fine_within: Positive | None = None
    knowledge_deg: Positive | None = None
    pointing_deg: Positive | None = None


class OrbitConfig(Config, frozen=True, kw_only=True):
    """The configuration of a satellite in orbit; `elements` are the two lines of its orbit, where known."""

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
        """Return the smallest and the largest strength of a valid magnetometer reading, T."""
        return LEAST_FIELD, LARGEST_FIELD

    def replan_period(self) -> float:
        """Return how often the pointing is planned again, s."""
        return self.pointing.replan_period

    def hardware(self) -> tuple[Section, ...]:
        """Return the sections of body and devices for which learned parameters hold."""
        return (self.craft, *super().hardware())


def as_orbit(config: Config) -> OrbitConfig:
    """Return a configuration as that of a satellite in orbit. Raises ConfigError for another body's."""
    if not isinstance(config, OrbitConfig):
        raise ConfigError("body", f"is {config.body}: this needs the configuration of a satellite in orbit")
    return config
