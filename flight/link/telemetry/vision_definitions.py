"""Packets of the star camera: streaks, stars and objects."""

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

MOST_SIGHTINGS = 8
"""Of a frame that its packet holds."""

SIGHTINGS = Packet(
    "sightings",
    0x123,
    "each frame searched for objects",
    "What in one frame is no star: objects, and what only tracks over frames distinguish from them",
    (
        counter("sequence", "the camera's count"),
        Field("middle_ns", "i8", "ns", "mission time of the exposure's middle"),
        Field("found", "u2", "-", "sightings, of which the packet holds the brightest"),
        Field("x", "f4", "px", "column of each, brightest first; NaN for none", MOST_SIGHTINGS),
        Field("y", "f4", "px", "row of each; NaN for none", MOST_SIGHTINGS),
        Field("magnitude", "f4", "mag", "V by the frame's stars; NaN when unknown", MOST_SIGHTINGS),
    ),
)

TRACK = Packet(
    "track",
    0x124,
    "each object in each frame searched",
    "The line of sight to an object, tracked over frames; directions in the axes of the attitude's reference",
    (
        Field("number", "u4", "-", "of the object in this flight, from 1"),
        Field("middle_ns", "i8", "ns", "mission time of the exposure's middle"),
        Field("seen", "u1", "-", "the frame shows it; no: predicted", states=NO_YES),
        Field("sightings", "u4", "-", "since the start of the track"),
        Field("measured", "f8", "-", "direction in this frame; NaN when not seen", 3),
        Field(
            "measured_sigma", "f8", "rad", "along an axis, the attitude's share included; NaN when not seen"
        ),
        Field("direction", "f8", "-", "of the track", 3),
        Field("rate", "f8", "rad/s", "change of the direction", 3),
        Field("acceleration", "f8", "rad/s^2", "change of the rate, at right angles to the direction", 3),
        Field("covariance", "f8", "rad^2", "xx yy zz xy xz yz of the direction", 6),
        Field("rate_covariance", "f8", "rad^2/s^2", "xx yy zz xy xz yz of the rate", 6),
        Field("magnitude", "f8", "mag", "V, mean over the last sightings; NaN when unknown"),
        Field("magnitude_sigma", "f8", "mag", "of that, by their scatter; NaN when unknown"),
        Field("place", "f8", "m", "of the camera, about the Earth's centre; NaN when unknown", 3),
        Field("velocity", "f8", "m/s", "likewise", 3),
        Field("place_sigma", "f8", "m", "of an axis of the place"),
    ),
    version=2,
)
