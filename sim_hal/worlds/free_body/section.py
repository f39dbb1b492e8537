"""The shape of `simulation.free_body`: the true craft, its orbit, and how large the disturbances are.

SI units unless the name says otherwise. Each disturbance is a multiple of its worst case, so 0.1, 0.3 and 1
of the worst case are flown by one number each; zero switches it off.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from flight.schema.values import NotNegative, Positive, Quaternion, Section

Vector = tuple[float, float, float]
Angle = Annotated[float, Meta(ge=-360.0, le=360.0)]


class OrbitSection(Section, frozen=True, kw_only=True):
    """The orbit at the simulation's time zero; `altitude` m is the semi-major axis above the equator.

    `local_time` in hours, the mean local time of the ascending node, takes the place of `ascending_node_deg`.
    """

    altitude: Annotated[float, Meta(ge=200e3, le=1_000e3)] = 500e3
    eccentricity: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.001
    inclination_deg: Annotated[float, Meta(ge=0.0, le=180.0)] = 97.4
    ascending_node_deg: Angle = 0.0
    local_time: Annotated[float, Meta(ge=0.0, le=24.0)] | None = None
    argument_of_perigee_deg: Angle = 0.0
    true_anomaly_deg: Angle = 0.0


class CraftSection(Section, frozen=True, kw_only=True):
    """A craft that is neither of the named ones: a box of `size` m with its origin in the middle.

    `inertia` kg m^2 is of the principal axes; `dipole_per_ampere` m^2 of every coil.
    """

    inertia: tuple[Positive, Positive, Positive]
    size: tuple[Positive, Positive, Positive]
    dipole_per_ampere: Positive


class TipOff(Section, frozen=True, kw_only=True):
    """How the body is released: `speed` rad/s about an axis that is drawn, or `rate` rad/s, body axes.

    `attitude` is ICRS into body, scalar last; without it every attitude is equally likely.
    """

    speed: NotNegative = 0.1745
    rate: Vector | None = None
    attitude: Quaternion | None = None


class Disturbances(Section, frozen=True, kw_only=True):
    """Multiples of the worst cases, and the errors of the coils.

    `drag` and `solar_pressure` of a centre of pressure 2 cm beside the centre of mass; `residual_dipole`
    of 1e-3 A m^2 that stays, 3e-4 A m^2 in sunlight and a walk of 5e-5 A m^2; `ring_current` of 20 nT,
    changing by hours; `day_bulge` of the air about its mean, and `walks` of air and dipole.
    `principal_turn_deg` bounds the turn of the principal axes, drawn between a third of it and the whole.
    `coil_scale` and `coil_tilt_deg` are standard deviations.
    """

    gravity_gradient: NotNegative = 1.0
    drag: NotNegative = 1.0
    solar_pressure: NotNegative = 1.0
    residual_dipole: NotNegative = 1.0
    ring_current: NotNegative = 1.0
    day_bulge: Annotated[float, Meta(ge=0.0, le=1.0)] = 1.0
    walks: NotNegative = 1.0
    principal_turn_deg: Annotated[float, Meta(ge=0.0, le=45.0)] = 3.0
    coil_scale: Annotated[float, Meta(ge=0.0, le=0.3)] = 0.03
    coil_tilt_deg: Annotated[float, Meta(ge=0.0, le=30.0)] = 1.0


class FreeBodySection(Section, frozen=True, kw_only=True):
    """The whole section; `craft` is one of `sim_hal.worlds.free_body.craft.CRAFTS`, or described in full."""

    craft: Literal["knightcube", "cubesat_3u"] | CraftSection = "knightcube"
    orbit: OrbitSection = OrbitSection()
    release: TipOff = TipOff()
    disturbances: Disturbances = Disturbances()
