"""Packets of the star camera: streaks and stars."""

from __future__ import annotations

from flight.link.telemetry.form import Field, Packet, counter
from flight.link.telemetry.states import NO_YES

STREAK = Packet(
    "streak",
    0x121,
    "each frame",
    "What vision found in one frame",
    (
        counter("sequence", "the camera's count"),
        Field("exposure_start_ns", "i8", "ns", "mission time of the exposure's start"),
        Field("exposure", "f8", "s", "exposure time"),
        Field("status", "S32", "-", "rate, ambiguous, too-short, too-few, failed, black, saturated, frozen"),
        Field("streaks", "u2", "-", "streaks found"),
        Field("used", "u2", "-", "streaks used in the rate"),
        Field("length", "f8", "px", "median length of the streaks"),
        Field("rate", "f8", "rad/s", "mean body rate over the exposure, body axes; NaN when none", 3),
        Field("covariance", "f8", "rad^2/s^2", "xx yy zz xy xz yz of the rate, body axes; NaN when none", 6),
        Field("residual", "f8", "rad", "rms residual of the endpoints; NaN when none"),
        Field("accepted", "u1", "-", "entered the estimate", states=NO_YES),
    ),
)

STARS = Packet(
    "stars",
    0x122,
    "each frame",
    "Which stars one frame shows, and the attitude that they give",
    (
        counter("sequence", "the camera's count"),
        Field("middle_ns", "i8", "ns", "mission time of the exposure's middle"),
        Field("status", "S32", "-", "solved, no-stars, too-few-stars, no-match, ambiguous"),
        Field(
            "tracked",
            "u1",
            "-",
            "searched at the estimate's attitude; no: lost in space",
            states=NO_YES,
        ),
        Field("found", "u2", "-", "what was taken for a star"),
        Field("matched", "u2", "-", "of them guide stars"),
        Field("quaternion", "f8", "-", "reference into body, scalar last; NaN when none", 4),
        Field("covariance", "f8", "rad^2", "xx yy zz xy xz yz of small turns, body axes; NaN when none", 6),
        Field("log10_false_alarm", "f8", "-", "log10 of the chance matches expected in the whole sky"),
        Field("accepted", "u1", "-", "entered the estimate", states=NO_YES),
    ),
)
