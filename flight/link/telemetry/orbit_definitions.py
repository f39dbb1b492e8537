"""The packets that only a satellite in orbit writes."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet, counter
from flight.link.telemetry.states import KNOWLEDGE, LOST_ALARM, NO_YES

SPIN = Packet(
    "spin",
    0x115,
    "4 Hz",
    "The rate by the magnetometer alone, of a satellite in orbit",
    (
        Field("known", "u1", "-", "enough samples of the field agree", states=NO_YES),
        Field("rate", "f8", "rad/s", "body rate, body axes", 3),
        Field("rate_sigma", "f4", "rad/s", "standard deviation of the rate's worst axis"),
        Field("field", "f8", "T", "magnetic field, body axes", 3),
        counter("restarts", "how often the samples contradicted the rate until it was found again"),
        Field("dipole", "f4", "A m^2", "dipole wanted of the coils, body axes", 3),
    ),
)

NAVIGATION = Packet(
    "navigation",
    0x116,
    "1 Hz",
    "How well a satellite in orbit knows its attitude, and what its filter has learned",
    (
        Field("knowledge", "u1", "-", "of the attitude", states=KNOWLEDGE, alarms=LOST_ALARM),
        Field("placed", "u1", "-", "the orbit is known", states=NO_YES),
        counter("refused", "measurements that did not pass their gate, replays included"),
        counter("fixes_refused", "GPS fixes that contradict what is known of the orbit"),
        counter("restarts", "how often the estimate was discarded for a new one"),
        Field("gyro_bias", "f8", "rad/s", "body axes, NaN before an estimate", 3),
        Field("field_bias", "f8", "T", "of the magnetometer, body axes", 3),
        Field("residual_dipole", "f8", "A m^2", "in the present light, body axes", 3),
    ),
)

DIRECTIONS = Packet(
    "directions",
    0x117,
    "each round of the wide cameras",
    "The Sun and nadir that the wide cameras show, of a satellite in orbit",
    (
        Field("middle_ns", "i8", "ns", "mission time of the exposures' middle"),
        Field("frames", "u1", "-", "cameras whose frames were read, by bits"),
        Field("sun", "f8", "-", "direction of the Sun, body axes; NaN when none", 3),
        Field("sun_sigma", "f4", "rad", "standard deviation of an axis; NaN when none"),
        Field(
            "sun_cameras", "u1", "-", "the camera that shows it, by bits; none: the solar strings stand in"
        ),
        Field("sun_used", "u1", "-", "entered the estimate", states=NO_YES),
        Field("nadir", "f8", "-", "direction of nadir, body axes; NaN when none", 3),
        Field("nadir_sigma", "f4", "rad", "standard deviation of an axis; NaN when none"),
        Field("nadir_cameras", "u1", "-", "those whose limb gave it, by bits; none: the light in all frames"),
        Field("nadir_used", "u1", "-", "entered the estimate", states=NO_YES),
    ),
)

ORBIT_TRUTH = Packet(
    "orbit_truth",
    0x141,
    "1 Hz, simulation of an orbit only",
    "What surrounded the satellite and turned it; written by sim_hal beside truth; NaN is not known",
    (
        Field("utc", "f8", "day", "Julian date UTC of the simulated world"),
        Field("position", "f8", "m", "geocentric, ICRS", 3),
        Field("velocity", "f8", "m/s", "ICRS", 3),
        Field("field", "f8", "T", "of the Earth, ICRS", 3),
        Field("sun", "f8", "-", "direction of the Sun, ICRS", 3),
        Field("sunlit", "f8", "-", "share of the Sun's disc that is seen"),
        Field("residual_dipole", "f8", "A m^2", "body axes", 3),
        Field("coil_torque", "f8", "N m", "body axes", 3),
        Field("dipole_torque", "f8", "N m", "of the residual dipole, body axes", 3),
        Field("gravity_torque", "f8", "N m", "of the gravity gradient, body axes", 3),
        Field("drag_torque", "f8", "N m", "body axes", 3),
        Field("sunlight_torque", "f8", "N m", "body axes", 3),
    ),
)
